//! What is wrong is said with its line and column, once, and with what to do.

use bumpless_st::{Error, compile};
use proptest::prelude::*;

/// Within a program with some variables, in line 2.
fn body(text: &str) -> String {
    format!(
        "PROGRAM p VAR_INPUT i : INT; END_VAR VAR_OUTPUT r : REAL; END_VAR VAR b : BOOL; a : ARRAY[1..3] OF INT; t : TON; s : SINT; w : WORD; l : LREAL; END_VAR\n{text}\nEND_PROGRAM"
    )
}

#[track_caller]
fn says(source: &str, wanted: &[&str]) {
    let error = compile(source).expect_err(source).to_string();
    assert_eq!(error.lines().collect::<Vec<_>>(), wanted, "{source}");
}

#[test]
fn statements_and_expressions() {
    let mut wrong = Vec::new();
    for (text, wanted) in [
        ("r := x;", "2:6: there is no variable X"),
        ("r := rr + 1.0;", "2:6: there is no variable RR"),
        (
            "r := i + 1.5 + r * l;",
            "2:6: LREAL does not become REAL by itself: write LREAL_TO_REAL(…)",
        ),
        ("i := 5;", "2:1: an input cannot be assigned within its own block"),
        ("s := 300;", "2:6: 300 does not fit into SINT, which holds -128 to 127"),
        (
            "s := i;",
            "2:6: INT does not become SINT by itself: write INT_TO_SINT(…)",
        ),
        ("r := 1 / 0;", "2:6: this divides by 0"),
        ("r := i / 0;", "2:6: this divides by 0"),
        (
            "b := i;",
            "2:6: INT does not become BOOL by itself: write INT_TO_BOOL(…)",
        ),
        ("b := i AND 1;", "2:6: AND needs BOOL or bits, not INT"),
        ("IF i THEN r := 1.0; END_IF;", "2:4: a condition needs BOOL, not INT"),
        ("a[4] := 1;", "2:3: the index 4 lies outside of 1..3"),
        ("a[1, 2] := 1;", "2:1: 1 indices are needed here, not 2"),
        ("r[1] := 1.0;", "2:1: REAL is no array"),
        (
            "t.was := TRUE;",
            "2:3: WAS is a variable inside of TON: make it a VAR_OUTPUT",
        ),
        ("t.Q := TRUE;", "2:1: an output is assigned by its own block only"),
        ("t(INN := b);", "2:3: TON has no input INN"),
        (
            "r := t(IN := b);",
            "2:6: a call of a block stands alone as a statement; its outputs are fields",
        ),
        (
            "TON(IN := b);",
            "2:1: TON is no function: declare an instance of it in VAR and call that",
        ),
        ("r := SIN(1.0, 2.0);", "2:6: SIN takes 1 arguments, not 2"),
        ("r := FOO(1.0);", "2:6: there is no function FOO"),
        ("EXIT;", "2:1: EXIT stands within FOR, WHILE or REPEAT only"),
        (
            "r = 1.0;",
            "2:1: this compares and does nothing with the answer: an assignment is written `:=`",
        ),
        ("r := 1.0", "2:9: `;` is expected here, before `END_PROGRAM`"),
        ("r := (1.0 + ;", "2:13: a value is expected here, not `;`"),
        (
            "r := 1.0 $ 2.0;",
            "2:10: the character '$' has no meaning in Structured Text",
        ),
        (
            "r := 'text';",
            "2:6: texts are outside the subset: a controller has numbers only",
        ),
        ("w := w + 1;", "2:6: + needs numbers, not WORD"),
        ("w := SHL(i, 1);", "2:10: SHL needs BYTE, WORD, DWORD or LWORD, not INT"),
        ("r := -w;", "2:7: - needs a number, not WORD"),
        (
            "b := T#5s > 3;",
            "2:6: > cannot take TIME and DINT together: TIME + TIME, TIME - TIME, TIME * number and TIME / number are possible",
        ),
        (
            "b := T#5 = T#1s;",
            "2:6: this is no duration: write it like T#1h30m or T#1.5s, units d, h, m, s, ms, us, ns from large to small, at most 292 years",
        ),
        (
            "CASE i OF 1: r := 1.0; 1..2: r := 2.0; END_CASE;",
            "2:24: this label is in a case before: it is never reached",
        ),
        (
            "FOR r := 1.0 TO 2.0 DO b := TRUE; END_FOR;",
            "2:5: FOR counts with SINT, INT, DINT, LINT, USINT, UINT or UDINT",
        ),
        ("(* never closed", "2:1: this comment has no end: close it with `*)`"),
        (
            "r := 2#12;",
            "2:6: this is no number: digits of its base, at most 64 bits, are expected",
        ),
        (
            "r := UINT#-1;",
            "2:6: -1 does not fit into UINT, which holds 0 to 65535",
        ),
        (
            "WHILE b DO r := 1.0; END_IF;",
            "2:22: END_WHILE is expected here, not `END_IF`",
        ),
        ("r := POINTER;", "2:6: POINTER is outside the subset: use VAR_IN_OUT"),
    ] {
        check(&body(text), wanted, &mut wrong);
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Notes where the first diagnostic is another one.
fn check(source: &str, wanted: &str, wrong: &mut Vec<String>) {
    let said = match compile(source) {
        Ok(_) => "nothing".to_owned(),
        Err(error) => error.to_string(),
    };
    if said.lines().next() != Some(wanted) {
        wrong.push(format!("{source}\n  says {said}\n  not  {wanted}"));
    }
}

#[test]
fn each_slip_is_told_once_and_in_order() {
    says(
        &body("r := x; r := x + y;\nr := TRUE;\na := 5;"),
        &[
            "2:6: there is no variable X",
            "2:18: there is no variable Y",
            "3:6: BOOL does not become REAL by itself: compare it with a number",
            "4:6: a variable is expected here",
        ],
    );
    says(
        &body("r := ;\nr := 1.0;\nb := TRUE OR;\nIF b THEN r := 2.0 END_IF;"),
        &[
            "2:6: a value is expected here, not `;`",
            "4:13: a value is expected here, not `;`",
            "5:19: `;` is expected here, before `END_IF`",
        ],
    );
}

#[test]
fn declarations() {
    let mut wrong = Vec::new();
    for (source, wanted) in [
        (
            "",
            "1:1: there is no PROGRAM: a controller is one PROGRAM with its blocks and functions",
        ),
        (
            "FUNCTION f : INT f := 1; END_FUNCTION",
            "1:1: there is no PROGRAM: a controller is one PROGRAM with its blocks and functions",
        ),
        (
            "PROGRAM p END_PROGRAM",
            "1:9: a controller moves something: declare at least one VAR_OUTPUT",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : STRING; END_VAR END_PROGRAM",
            "1:26: STRING is outside the subset: a controller has numbers only",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : RAEL; END_VAR END_PROGRAM",
            "1:26: there is no type RAEL",
        ),
        (
            "PROGRAM p VAR_OUTPUT r, r : REAL; END_VAR END_PROGRAM",
            "1:25: R is declared twice",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : REAL; END_VAR END_PROGRAM PROGRAM q END_PROGRAM",
            "1:60: a second PROGRAM: a controller has one; make this one a FUNCTION_BLOCK",
        ),
        (
            "PROGRAM p VAR_OUTPUT level : REAL; END_VAR levl := 1.0; END_PROGRAM",
            "1:44: there is no variable LEVL; did you mean LEVEL?",
        ),
        (
            "PROGRAM p VAR_OUTPUT r AT q : REAL; END_VAR END_PROGRAM",
            "1:24: AT is outside the subset: a loop's file connects ports to points",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : TIME; END_VAR END_PROGRAM",
            "1:26: a port carries BOOL or a number, not TIME",
        ),
        (
            "PROGRAM p VAR_OUTPUT r AT %QX1 : REAL; END_VAR END_PROGRAM",
            "1:27: the character '%' has no meaning in Structured Text",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : REAL; {unti := 'bar'} END_VAR END_PROGRAM",
            "1:33: there is no attribute unti here; there are unit, low, high, required, text",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : REAL; {low := 5} END_VAR END_PROGRAM",
            "1:22: a range has both ends: {low := …, high := …}",
        ),
        (
            "PROGRAM p VAR CONSTANT k : REAL := 5.0; {low := 0, high := 1} END_VAR VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:24: 5 lies outside of 0 to 1",
        ),
        (
            "PROGRAM p VAR_EXTERNAL setpont : LREAL; END_VAR VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:24: the host has no variable SETPONT; it has SETPOINT, AUTOMATIC, TRACK, FIRST, DT, CYCLE",
        ),
        (
            "PROGRAM p VAR_EXTERNAL dt : REAL; END_VAR VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:29: DT is of type TIME",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : REAL; END_VAR VAR a : ARRAY[3..1] OF INT; END_VAR END_PROGRAM",
            "1:54: 3..1 is empty",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : REAL; END_VAR VAR a : ARRAY[1..99999] OF LREAL; END_VAR END_PROGRAM",
            "1:48: this array has 799992 bytes; a variable has at most 65536",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : REAL; END_VAR VAR a : ARRAY[1..2] OF INT := [1, 2, 3]; END_VAR END_PROGRAM",
            "1:77: more values than the 2 elements of this array",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : REAL; END_VAR VAR i : INT := r; END_VAR END_PROGRAM",
            "1:55: REAL does not become INT by itself: write REAL_TO_INT(…)",
        ),
        (
            "TYPE t : STRUCT a : t; END_STRUCT; END_TYPE PROGRAM p VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:21: the type T holds itself",
        ),
        (
            "FUNCTION_BLOCK b VAR x : b; END_VAR END_FUNCTION_BLOCK PROGRAM p VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:26: B holds an instance of itself",
        ),
        (
            "FUNCTION f : INT f := f(); END_FUNCTION PROGRAM p VAR_OUTPUT r : INT; END_VAR r := f(); END_PROGRAM",
            "1:10: F calls itself, at once or through others: use a loop",
        ),
        (
            "FUNCTION sin : INT sin := 1; END_FUNCTION PROGRAM p VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:10: the name SIN is taken; choose another",
        ),
        (
            "FUNCTION_BLOCK ton END_FUNCTION_BLOCK PROGRAM p VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:16: TON: the standard library has one of this name; choose another",
        ),
        (
            "VAR_GLOBAL g : INT; END_VAR PROGRAM p VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:1: VAR_GLOBAL is outside the subset, but for VAR_GLOBAL CONSTANT: the state of a controller is its PROGRAM's",
        ),
        (
            "CONFIGURATION c END_CONFIGURATION",
            "1:1: CONFIGURATION is outside the subset: the loop's file says period, points and parameters",
        ),
        (
            "PROGRAM p VAR_OUTPUT r : INT (0..5); END_VAR END_PROGRAM",
            "1:30: subranges are outside the subset: use LIMIT where a value must stay in a range",
        ),
        (
            "PROGRAM this_is_a_very_long_name_of_a_program VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:9: names of programs, ports and parameters have at most 32 characters",
        ),
        (
            "PROGRAM p {version := '1'} VAR_OUTPUT r : REAL; END_VAR END_PROGRAM",
            "1:12: a version is three numbers, as in '1.0.0'",
        ),
        (
            "FUNCTION f : INT VAR_INPUT x : INT; END_VAR f := x; END_FUNCTION PROGRAM p VAR_OUTPUT r : INT; END_VAR r := f(); END_PROGRAM",
            "1:109: F is called without X",
        ),
    ] {
        check(source, wanted, &mut wrong);
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn limits_are_said() {
    let long = " ".repeat(bumpless_st::SOURCE_BYTES_MAX + 1);
    assert!(matches!(compile(&long), Err(Error::TooLong { .. })));
    let large = "PROGRAM p VAR_OUTPUT r : REAL; END_VAR VAR a, b : ARRAY[1..5000] OF LREAL; END_VAR END_PROGRAM";
    assert!(matches!(compile(large), Err(Error::State { bytes, .. }) if bytes > 80_000));
    for deep in [
        body(&format!("r := {}1.0{};", "(".repeat(2000), ")".repeat(2000))),
        body(&"IF b THEN ".repeat(2000)),
        body(&format!("r := {}1.0;", "-".repeat(5000))),
        body(&format!("l := {}l;", "l + ".repeat(5000))),
        body(&format!("l := l{};", ".x".repeat(5000))),
        body(&format!("l := {}l;", "l ** ".repeat(5000))),
    ] {
        let error = compile(&deep).expect_err("too deep").to_string();
        assert!(
            error.contains("nested deeper than 64") || error.contains("operations in a row"),
            "{error}"
        );
    }
    let many = body(&"r := TRUE;\n".repeat(500));
    let Err(Error::Source(found)) = compile(&many) else {
        panic!("500 slips")
    };
    assert_eq!(found.len(), bumpless_st::DIAGNOSTICS_MAX);
}

/// Pieces of the language in any order come nearer to the compiler's inside than any bytes.
fn soup() -> impl Strategy<Value = String> {
    let word = prop::sample::select(vec![
        "PROGRAM",
        "p",
        "END_PROGRAM",
        "VAR",
        "VAR_INPUT",
        "VAR_OUTPUT",
        "END_VAR",
        "r",
        ":",
        "INT",
        "REAL",
        ";",
        ":=",
        "1",
        "2.5",
        "T#1s",
        "(",
        ")",
        "[",
        "]",
        "+",
        "-",
        "*",
        "/",
        "MOD",
        "AND",
        "NOT",
        "IF",
        "THEN",
        "ELSE",
        "END_IF",
        "FOR",
        "TO",
        "BY",
        "DO",
        "END_FOR",
        "WHILE",
        "END_WHILE",
        "CASE",
        "OF",
        "END_CASE",
        "FUNCTION",
        "f",
        "END_FUNCTION",
        "FUNCTION_BLOCK",
        "TYPE",
        "STRUCT",
        "END_STRUCT",
        "END_TYPE",
        "ARRAY",
        "..",
        ",",
        ".",
        "TON",
        "=>",
        "{",
        "}",
        "unit",
        "'bar'",
        "INT#",
        "16#FF",
        "SIN",
        "MUX",
        "LIMIT",
        "EXIT",
        "RETURN",
        "CONSTANT",
        "=",
        "<",
        "**",
        "REPEAT",
        "UNTIL",
        "END_REPEAT",
        "low",
        "high",
        "TRUE",
        "DINT_TO_INT",
    ]);
    prop::collection::vec(word, 0..120).prop_map(|words| words.join(" "))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_text_makes_the_compiler_panic(text in ".{0,200}") {
        let _ = compile(&text);
        let _ = compile(&body(&text));
    }

    #[test]
    fn no_words_make_the_compiler_panic(text in soup()) {
        let _ = compile(&text);
        let _ = compile(&body(&text));
        let _ = compile(&format!("PROGRAM p VAR_OUTPUT r : REAL; END_VAR VAR {text} END_VAR END_PROGRAM"));
    }
}
