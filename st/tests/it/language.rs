//! Types, operators, statements, structures, functions and blocks.

use bumpless_core::{Fault, Mode, PortKind};

use crate::cell::{Cell, values};

#[test]
fn operators_have_the_precedence_of_the_standard() {
    values(
        "",
        "",
        "",
        &[
            ("1.0 + 2.0 * 3.0", 7.0),
            ("(1.0 + 2.0) * 3.0", 9.0),
            ("-2.0 ** 2.0", 4.0),
            ("2.0 ** 3.0 ** 2.0", 64.0),
            ("10.0 - 4.0 - 3.0", 3.0),
            ("BOOL_TO_LREAL(TRUE OR FALSE AND FALSE)", 1.0),
            ("BOOL_TO_LREAL(TRUE XOR TRUE AND FALSE)", 1.0),
            ("BOOL_TO_LREAL(NOT FALSE AND FALSE)", 0.0),
            ("BOOL_TO_LREAL(1 + 1 = 2)", 1.0),
            ("BOOL_TO_LREAL(1 < 2 = TRUE)", 1.0),
            ("BOOL_TO_LREAL(3 >= 3 & 2 <> 3)", 1.0),
            ("7 / 2", 3.0),
            ("-7 / 2", -3.0),
            ("7 MOD -2", 1.0),
            ("-7 MOD 2", -1.0),
            ("16#FF", 255.0),
            ("2#1010_0101", 165.0),
            ("8#17", 15.0),
            ("1_000", 1000.0),
            ("1.5E-3", 0.0015),
            ("INT#-5", -5.0),
            ("REAL#1.5", 1.5),
            ("TIME_TO_LREAL(T#1h1m1s1ms)", 3_661_001.0),
            ("TIME_TO_LREAL(T#-1.5s)", -1500.0),
            ("TIME_TO_LREAL(T#1d_2h)", 93_600_000.0),
        ],
    );
}

#[test]
fn whole_numbers_wrap_in_their_type() {
    let variables = "s : SINT := 127; us : USINT := 255; i : INT := 32767; ui : UINT := 65535; d : DINT := 2147483647; \
                     ud : UDINT := 4294967295; l : LINT := 9223372036854775807; sm : SINT := -128; dm : DINT := -2147483648; \
                     b : BYTE := 16#81; w : WORD := 16#8001; m1 : SINT := -1; d1 : DINT := -1; n : INT := 3";
    let statements = "s := s + 1; us := us + 1; i := i + 1; ui := ui + 1; d := d + 1; ud := ud + 1; l := l + 1;";
    values(
        "",
        &format!("{variables};"),
        statements,
        &[
            ("s", -128.0),
            ("us", 0.0),
            ("i", -32768.0),
            ("ui", 0.0),
            ("d", -2_147_483_648.0),
            ("ud", 0.0),
            ("LINT_TO_LREAL(l)", -9_223_372_036_854_775_808.0),
            ("sm / m1", -128.0),
            ("dm / d1", -2_147_483_648.0),
            ("dm MOD d1", 0.0),
            ("ABS(sm)", -128.0),
            ("BYTE_TO_USINT(NOT b)", 126.0),
            ("BYTE_TO_USINT(SHL(b, 1))", 2.0),
            ("BYTE_TO_USINT(SHR(b, n))", 16.0),
            ("BYTE_TO_USINT(ROL(b, 1))", 3.0),
            ("BYTE_TO_USINT(ROR(b, 1))", 192.0),
            ("BYTE_TO_USINT(ROL(b, 9))", 3.0),
            ("WORD_TO_UINT(ROL(w, n))", 12.0),
            ("WORD_TO_UINT(SHL(w, 16))", 0.0),
            ("WORD_TO_UINT(w AND 16#FF OR 16#100)", 257.0),
            ("BYTE_TO_USINT(b XOR b)", 0.0),
        ],
    );
}

#[test]
fn conversions_round_stay_in_range_or_keep_low_bits() {
    let variables = "x : LREAL := 2.5; y : LREAL := 3.5; big : LREAL := 1.0E20; low : REAL := -1.0E20; i : INT := 300; m : INT := -1; \
                     u : UDINT := 4000000000; t : TIME := T#1500ms; z : REAL := -2.7; w : DWORD := 16#FFFF_FFFF";
    values(
        "",
        &format!("{variables};"),
        "",
        &[
            ("LREAL_TO_INT(x)", 2.0),
            ("LREAL_TO_INT(y)", 4.0),
            ("LREAL_TO_INT(big)", 32767.0),
            ("REAL_TO_SINT(low)", -128.0),
            ("REAL_TO_UDINT(low)", 0.0),
            ("REAL_TO_UINT(z)", 0.0),
            ("REAL_TO_INT(z)", -3.0),
            ("TRUNC(z)", -2.0),
            ("REAL_TRUNC_SINT(z)", -2.0),
            ("INT_TO_SINT(i)", 44.0),
            ("INT_TO_UINT(m)", 65535.0),
            ("INT_TO_BOOL(i) AND TRUE = TRUE", 1.0),
            ("UDINT_TO_LREAL(u)", 4e9),
            ("UDINT_TO_DINT(u)", -294_967_296.0),
            ("TIME_TO_DINT(t)", 1500.0),
            ("TIME_TO_LREAL(LREAL_TO_TIME(x))", 2.5),
            ("TIME_TO_LREAL(DINT_TO_TIME(7))", 7.0),
            ("TO_DINT(x)", 2.0),
            ("DWORD_TO_DINT(w)", -1.0),
            ("BOOL_TO_INT(INT_TO_BOOL(i))", 1.0),
            ("TIME_TO_LREAL(t * 2)", 3000.0),
            ("TIME_TO_LREAL(t * 0.5 + T#1s)", 1750.0),
            ("TIME_TO_LREAL(2.0 * t)", 3000.0),
            ("TIME_TO_LREAL(t / 3)", 500.0),
        ]
        .map(|(e, v)| {
            if e.starts_with("INT_TO_BOOL") {
                ("BOOL_TO_LREAL(INT_TO_BOOL(i) AND TRUE = TRUE)", v)
            } else {
                (e, v)
            }
        }),
    );
}

#[test]
fn standard_functions_choose_and_limit() {
    let variables = "k : INT := 2; g : BOOL := TRUE; a : REAL := 3.5; e : colour := green; f : INT := -7";
    values(
        "TYPE colour : (red, green := 5, blue); END_TYPE",
        &format!("{variables};"),
        "",
        &[
            ("MIN(3.0, 1.0, 2.0)", 1.0),
            ("MAX(k, 1, f)", 2.0),
            ("LIMIT(0.0, a, 3.0)", 3.0),
            ("LIMIT(MN := 4, IN := k, MX := 9)", 4.0),
            ("SEL(g, 1.0, 2.0)", 2.0),
            ("SEL(G := NOT g, IN0 := 1.0, IN1 := 2.0)", 1.0),
            ("MUX(k, 10.0, 20.0, 30.0)", 30.0),
            ("MUX(9, 10.0, 20.0, 30.0)", 30.0),
            ("MUX(f, 10.0, 20.0, 30.0)", 10.0),
            ("ABS(f)", 7.0),
            ("ABS(-2.5)", 2.5),
            ("ADD(1, 2, 3)", 6.0),
            ("BOOL_TO_LREAL(GT(a, 3.0))", 1.0),
            ("MOVE(a)", 3.5),
            ("SQRT(16.0)", 4.0),
            ("TO_DINT(e)", 5.0),
            ("TO_DINT(blue)", 6.0),
            ("BOOL_TO_LREAL(e = colour#green)", 1.0),
            ("TO_DINT(SEL(g, red, blue))", 6.0),
            ("EXPT(2.0, 10)", 1024.0),
        ],
    );
}

#[test]
fn loops_and_branches_go_as_they_are_written() {
    let source = "
PROGRAM p
VAR_INPUT x : LREAL; END_VAR
VAR_OUTPUT a, b, c, d, e, f, g, h : LREAL; END_VAR
VAR i : INT; n : DINT; s : SINT; u : USINT; END_VAR
a := 0; b := 0; c := 0; d := 0; e := 0; f := 0; g := 0; h := 0;
FOR i := 1 TO 10 BY 2 DO
    IF i = 5 THEN CONTINUE; END_IF;
    a := a + i;
    IF a > 10 THEN EXIT; END_IF;
END_FOR;
FOR i := 10 TO 1 BY -3 DO b := b + i; END_FOR;
FOR s := 126 TO 127 DO c := c + 1; END_FOR;
FOR u := 2 TO 0 BY -1 DO c := c + 1; END_FOR;
FOR i := 5 TO 1 DO c := 100; END_FOR;
n := 0;
WHILE n < 5 DO n := n + 1; d := d + n; END_WHILE;
REPEAT n := n - 1; e := e + 1; UNTIL n <= 2 END_REPEAT;
CASE LREAL_TO_INT(x) OF
    0: f := 1;
    1, 3..5: f := 2;
    -4..-2: f := 3;
ELSE f := 4;
END_CASE;
IF x > 100.0 THEN g := 1; ELSIF x > 10.0 THEN g := 2; ELSE g := 3; END_IF;
IF x > 50.0 THEN RETURN; END_IF;
h := 1;
END_PROGRAM";
    let mut cell = Cell::new(source);
    assert_eq!(cell.step(&[4.0]), [11.0, 22.0, 5.0, 15.0, 3.0, 2.0, 3.0, 1.0]);
    assert_eq!(cell.step(&[-3.0])[5..], [3.0, 3.0, 1.0]);
    assert_eq!(cell.step(&[60.0])[5..], [4.0, 2.0, 0.0]);
    assert_eq!(cell.step(&[0.2])[5..], [1.0, 3.0, 1.0]);
}

#[test]
fn structures_arrays_functions_and_blocks_hold_together() {
    let source = "
TYPE
    point : STRUCT x : INT; y : LREAL := 2.5; END_STRUCT;
    row : ARRAY[1..3] OF point;
    level : LREAL := 7.0;
END_TYPE
VAR_GLOBAL CONSTANT size : INT := 3; END_VAR
FUNCTION scaled : LREAL
VAR_INPUT value : LREAL; times : LREAL := 10.0; END_VAR
VAR_OUTPUT negative : BOOL; END_VAR
scaled := value * times;
negative := scaled < 0.0;
END_FUNCTION
FUNCTION total : LREAL
VAR_INPUT rows : row; END_VAR
VAR i : INT; END_VAR
FOR i := 1 TO size DO total := total + rows[i].y; END_FOR;
END_FUNCTION
FUNCTION swap : BOOL
VAR_IN_OUT a, b : LREAL; END_VAR
VAR t : LREAL; END_VAR
t := a; a := b; b := t;
swap := TRUE;
END_FUNCTION
FUNCTION_BLOCK counter
VAR_INPUT up : INT := 1; END_VAR
VAR_IN_OUT sum : LREAL; END_VAR
VAR_OUTPUT n : INT; END_VAR
n := n + up;
sum := sum + n;
END_FUNCTION_BLOCK
PROGRAM p
VAR_OUTPUT a, b, c, d, e, f, g, h : LREAL; END_VAR
VAR
    r : row := [(x := 1), (x := 2, y := 1.0), (x := 3)];
    m : ARRAY[0..1, -1..1] OF DINT := [1, 2, 3, 3(9)];
    one : counter; many : ARRAY[1..2] OF counter := [(up := 2), (up := 5)];
    i : INT; flag : BOOL; l : level; s : point; left : LREAL := 1.0; right : LREAL := 2.0;
    sum : LREAL;
END_VAR
a := total(r);
scaled(value := -1.0, negative => flag);
b := scaled(2.0) + scaled(value := 1.0, times := scaled(0.5, 2.0)) + BOOL_TO_LREAL(flag);
i := 1;
c := m[i - 1, i] * 10 + m[1, -1];
sum := 0.0;
one(sum := sum);
many[i + 1](sum := sum, n => i);
d := sum; e := one.n + i;
s := r[2]; s.x := s.x + 40; f := s.x + s.y;
swap(left, right); g := left * 10.0 + right;
h := l;
END_PROGRAM";
    let mut cell = Cell::new(source);
    assert_eq!(cell.step(&[]), [6.0, 22.0, 39.0, 6.0, 6.0, 43.0, 21.0, 7.0]);
    assert_eq!(
        cell.step(&[])[3..7],
        [12.0, 12.0, 43.0, 12.0],
        "blocks keep their variables, and so does the program"
    );
}

#[test]
fn a_fault_is_told_with_its_place_and_leaves_no_effects() {
    let source = "PROGRAM p
VAR_INPUT d : DINT; i : INT; x : LREAL; END_VAR
VAR_OUTPUT r : LREAL; END_VAR
VAR a : ARRAY[1..3] OF INT := [1, 2, 3]; END_VAR
r := 10 / d + a[i];
r := r + 1.0 / x;
WHILE d = 0 DO r := 1; END_WHILE;
END_PROGRAM";
    let mut cell = Cell::new(source);
    let state = cell.state.clone();
    for (inputs, text) in [
        ([0.0, 1.0, 1.0], "a division by 0 in P, line 5, column 6"),
        ([1.0, 4.0, 1.0], "an index outside of 1..3 in P, line 5, column 17"),
        ([1.0, 0.0, 1.0], "an index outside of 1..3 in P, line 5, column 17"),
        ([1.0, 1.0, 0.0], "a division by 0 in P, line 6, column 10"),
    ] {
        let fault = cell.try_step(100, &inputs.map(Some)).unwrap_err();
        assert_eq!(fault, Fault::Failed(text.to_owned()), "{inputs:?}");
        assert_eq!(cell.state, state);
    }
    assert_eq!(cell.step(&[5.0, 3.0, 2.0]), [5.5]);
}

#[test]
fn ports_carry_quality_ranges_and_kinds() {
    let source = "PROGRAM p {version := '2.1.0', text := 'Test'}
VAR_INPUT
    {unit := 'bar', low := 0, high := 10} pv : LREAL;
    pv_ok : BOOL; {quality := 'pv'}
    count : INT := 4 {required := FALSE};
    switch : BOOL;
END_VAR
VAR_OUTPUT
    out : REAL; {unit := '%', low := 0, high := 100, text := 'Valve'}
    lamp : BOOL;
END_VAR
out := pv * 30.0;
lamp := switch AND pv_ok;
IF count = 7 THEN out := -5; END_IF;
END_PROGRAM";
    // LREAL does not become REAL by itself.
    let source = source.replace("pv * 30.0", "LREAL_TO_REAL(pv) * 30.0");
    let mut cell = Cell::new(&source);
    assert_eq!((cell.compiled.version.as_str(), cell.compiled.ports), ("2.1.0", 5));
    use PortKind::{Analog, Digital};
    assert_eq!(cell.kinds(), [Analog, Analog, Digital, Analog, Digital]);
    assert_eq!(cell.step(&[2.0, 4.0, 1.0]), [60.0, 1.0]);
    assert_eq!(cell.step(&[5.0, 6.6, 3.0]), [0.0, 1.0], "7 after rounding");
    assert_eq!(cell.step(&[5.0, 4.0, 0.0]), [100.0, 0.0], "held within its range");
    let effects = cell.try_step(100, &[None, Some(4.0), Some(1.0)]).unwrap();
    assert_eq!(
        effects.writes,
        [(3, 100.0), (4, 0.0)],
        "the last good value, and the program knows"
    );
    let fault = cell.try_step(100, &[Some(1.0), Some(4.0), None]).unwrap_err();
    assert_eq!(fault, Fault::BadInput("input switch has no usable value".to_owned()));
}

#[test]
fn the_host_gives_setpoint_mode_and_times() {
    let source = "PROGRAM p
VAR_OUTPUT a, b, c, d, e, f : LREAL; END_VAR
VAR_EXTERNAL setpoint : LREAL; automatic, track, first : BOOL; dt : TIME; cycle : ULINT; END_VAR
IF track AND a = 55.0 THEN f := f + 1.0; END_IF;
b := BOOL_TO_LREAL(automatic); c := BOOL_TO_LREAL(track) * 10.0 + BOOL_TO_LREAL(first);
d := TIME_TO_LREAL(dt); e := ULINT_TO_LREAL(cycle); a := setpoint;
END_PROGRAM";
    let mut cell = Cell::tracking(source, &[55.0]);
    cell.held[0] = 55.0;
    cell.setpoint = 3.0;
    assert_eq!(
        cell.step_of(250, &[]),
        [3.0, 1.0, 11.0, 250.0, 1.0, 1.0],
        "the first cycle goes on from the actuators"
    );
    assert_eq!(cell.step(&[]), [3.0, 1.0, 0.0, 100.0, 2.0, 1.0]);
    cell.mode = Mode::Manual;
    cell.held[0] = 55.0;
    assert_eq!(
        cell.step(&[]),
        [3.0, 0.0, 10.0, 100.0, 3.0, 2.0],
        "so does each in manual"
    );
}

#[test]
fn parameters_come_from_constants_with_a_range() {
    let source = "TYPE way : (up, down); END_TYPE
PROGRAM p
VAR CONSTANT
    k : LREAL := 2.0; {low := 0, high := 10, unit := '%'}
    n : INT := 3 {low := 1, high := 5};
    filter : TIME := T#1.5s; {low := 0, high := T#1m}
    dir : way := down; {text := 'Direction'}
    on : BOOL := TRUE; {text := 'On'}
    fixed : LREAL := 100.0;
END_VAR
VAR_OUTPUT a, b : LREAL; END_VAR
a := k * n + fixed; b := TIME_TO_LREAL(filter) + BOOL_TO_LREAL(dir = down) * 0.5 + BOOL_TO_LREAL(on) * 0.25;
END_PROGRAM";
    let mut cell = Cell::new(source);
    assert_eq!(cell.compiled.parameters, 5);
    assert_eq!(cell.step(&[]), [106.0, 1500.75]);
    cell.retune(&[3.0, 4.0, 2.0, 0.0, 0.0], &[1.0, 2.0]);
    assert_eq!(cell.step(&[]), [112.0, 2000.0]);
}
