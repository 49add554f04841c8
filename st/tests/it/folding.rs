//! What is worked out while compiling equals what the compiled code works out, for any expression.

use proptest::prelude::*;

use crate::cell::Cell;

/// Types, each with literals that reach its ends.
const TYPES: [(&str, &[&str]); 10] = [
    ("SINT", &["0", "1", "-1", "127", "-128", "5"]),
    ("INT", &["0", "1", "-1", "32767", "-32768", "77"]),
    ("DINT", &["0", "1", "-1", "2147483647", "-2147483648", "12345"]),
    (
        "LINT",
        &[
            "0",
            "1",
            "-1",
            "9223372036854775807",
            "-9223372036854775808",
            "98765432101",
        ],
    ),
    ("USINT", &["0", "1", "255", "128", "7"]),
    ("UINT", &["0", "1", "65535", "256", "7"]),
    ("UDINT", &["0", "1", "4294967295", "2147483648", "7"]),
    ("ULINT", &["0", "1", "18446744073709551615", "9223372036854775808", "7"]),
    ("REAL", &["0.0", "1.5", "-2.25", "3.4E38", "1.0E-30", "0.1"]),
    ("LREAL", &["0.0", "1.5", "-2.25", "1.7E308", "1.0E-300", "0.1"]),
];

/// An expression of a type, twice: with literals, and with variables that hold them.
#[derive(Debug, Clone)]
struct Both {
    literal: String,
    variable: String,
}

fn leaf(ty: usize) -> impl Strategy<Value = Both> {
    let (name, literals) = TYPES[ty];
    prop::sample::select((0..literals.len()).collect::<Vec<_>>()).prop_map(move |n| Both {
        literal: format!("{name}#{}", literals[n]),
        variable: format!("v{n}"),
    })
}

fn expression(ty: usize) -> impl Strategy<Value = Both> {
    let (name, _) = TYPES[ty];
    let real = name.ends_with("REAL");
    let whole: &[&str] = if real {
        &["+", "-", "*"]
    } else {
        &["+", "-", "*", "MOD", "/"]
    };
    let operators = prop::sample::select(whole.to_vec());
    let functions = prop::sample::select(vec!["MIN", "MAX"]);
    let to = prop::sample::select(TYPES.map(|(name, _)| name).to_vec());
    leaf(ty).prop_recursive(3, 12, 2, move |inner| {
        prop_oneof![
            (inner.clone(), operators.clone(), inner.clone()).prop_map(|(a, op, b)| join(&a, &b, |a, b| {
                // A divisor that may be 0 is another test's.
                if op == "/" || op == "MOD" {
                    format!("({a} {op} MAX({b}, 1))")
                } else {
                    format!("({a} {op} {b})")
                }
            })),
            (inner.clone(), functions.clone(), inner.clone())
                .prop_map(|(a, f, b)| join(&a, &b, |a, b| format!("{f}({a}, {b})"))),
            (inner.clone(), inner.clone(), inner.clone()).prop_map(|(a, b, c)| {
                let chosen = join(&a, &b, |a, b| format!("SEL({a} < {b}, {a}, "));
                join(&chosen, &c, |x, c| format!("{x}{c})"))
            }),
            inner.clone().prop_map(|a| join(&a, &a, |a, _| format!("ABS({a})"))),
            // There and back again through another type.
            (inner, to.clone()).prop_map(move |(a, to)| join(&a, &a, |a, _| {
                if to == name {
                    a.to_owned()
                } else {
                    format!("{to}_TO_{name}({name}_TO_{to}({a}))")
                }
            })),
        ]
    })
}

fn join(a: &Both, b: &Both, make: impl Fn(&str, &str) -> String) -> Both {
    Both {
        literal: make(&a.literal, &b.literal),
        variable: make(&a.variable, &b.variable),
    }
}

fn check(ty: usize, cases: &[Both]) {
    let (name, literals) = TYPES[ty];
    let variables: String = literals
        .iter()
        .enumerate()
        .map(|(n, literal)| format!("v{n} : {name} := {literal}; "))
        .collect();
    let (mut outputs, mut declared, mut body) = (String::new(), String::new(), String::new());
    for (n, case) in cases.iter().enumerate() {
        outputs.push_str(&format!("o{n} : BOOL; "));
        declared.push_str(&format!("c{n} : {name}; "));
        // No number is unequal to itself; both sides must have it then.
        body.push_str(&format!(
            "c{n} := {};\no{n} := c{n} = {1} OR (c{n} <> c{n} AND {1} <> {1});\n",
            case.variable, case.literal
        ));
    }
    let source =
        format!("PROGRAM p VAR_OUTPUT {outputs} END_VAR VAR {variables} {declared} END_VAR\n{body}\nEND_PROGRAM");
    let given = Cell::new(&source).step(&[]);
    for (case, same) in cases.iter().zip(given) {
        assert!(same == 1.0, "{} is not {}", case.literal, case.variable);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 30, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn folding_equals_execution(
        (ty, cases) in (0..TYPES.len()).prop_flat_map(|ty| (Just(ty), prop::collection::vec(expression(ty), 30)))
    ) {
        check(ty, &cases);
    }
}
