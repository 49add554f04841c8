//! Components made to cost: the compiling child ends within its limits, says why, and the engine goes on.
//!
//! The limits are small here, so that a test is short; what is tested is that they hold.

use std::{fmt::Write as _, time::Duration};

use bumpless_engine::{Engine, Error, Limits};

use crate::{
    child::{engine_with, leftovers, this_binary},
    guest::{Guest, PATIENCE_NS, frame, state},
};

fn with(extra: String) -> Vec<u8> {
    Guest { extra, ..Guest::good() }.build()
}

/// Functions by the ten thousand, none of which is ever called.
pub(crate) fn many_functions(count: u32) -> Vec<u8> {
    let mut text = String::new();
    for n in 0..count {
        let _infallible = write!(
            text,
            "(func (param i64 i64) (result i64) (i64.add (i64.mul (local.get 0) (i64.const {n})) (local.get 1)))"
        );
    }
    with(text)
}

/// One function whose every block jumps to everywhere.
fn huge_tables(tables: u32, targets: u32) -> Vec<u8> {
    let targets = (0..targets).map(|n| (n % 4).to_string()).collect::<Vec<_>>().join(" ");
    let mut text = "(func (param i32)".to_owned();
    for _ in 0..tables {
        let _infallible = write!(
            text,
            "(block (block (block (block (br_table {targets} 0 (local.get 0))))))"
        );
    }
    text.push(')');
    with(text)
}

/// Blocks in blocks.
fn deep_nesting(depth: usize) -> Vec<u8> {
    // The text form is read recursively, so each level is written flat.
    let text = format!(
        "(func (param i32) (result i32) {} local.get 0 {})",
        "block (result i32) ".repeat(depth),
        "end ".repeat(depth)
    );
    with(text)
}

/// One function in which every value lives to its end.
fn long_lives(values: u32) -> Vec<u8> {
    let mut text = "(func (param f64) (result f64) ".to_owned();
    for n in 0..values {
        let _infallible = write!(text, "(f64.mul (local.get 0) (f64.const {n})) ");
    }
    for _ in 1..values {
        text.push_str("f64.add ");
    }
    text.push(')');
    with(text)
}

/// Megabytes to copy into each instance.
fn much_data(mib: u32) -> Vec<u8> {
    let bytes = "x".repeat(1024 * 1024);
    let mut text = String::new();
    for n in 0..mib {
        let _infallible = write!(text, "(data (i32.const {}) \"{bytes}\")", 131_072 + n * 1024 * 1024);
    }
    Guest {
        extra: text,
        pages: 2 + mib * 16,
        ..Guest::good()
    }
    .build()
}

/// The engine still takes an honest component.
fn goes_on(engine: &Engine) {
    let law = engine.prepare(&Guest::good().build()).unwrap();
    let end = law.instantiate().unwrap().step(&frame(1.0), &state(1.0), PATIENCE_NS);
    assert_eq!(end.unwrap().writes, [(1, 2.0)]);
}

#[test]
fn bombs_end_within_the_limits_of_the_child() {
    let dir = tempfile::tempdir().unwrap();
    let limits = Limits {
        compile_time_max: Duration::from_secs(3),
        compile_memory_bytes_max: 512 * 1024 * 1024,
        ..Limits::default()
    };
    let engine = engine_with(&dir, 2, limits, this_binary()).unwrap();
    let bombs = [
        ("many functions", many_functions(60_000), true),
        ("huge tables", huge_tables(400, 2_000), false),
        ("deep nesting", deep_nesting(20_000), false),
        ("long lives", long_lives(60_000), false),
        ("much data", much_data(10), false),
    ];
    for (what, bytes, refused) in bombs {
        match engine.inspect(&bytes) {
            Ok(_) => assert!(!refused, "{what}: taken"),
            Err(error) => {
                let by_a_limit = matches!(
                    error,
                    Error::CompileTime { .. }
                        | Error::CompileMemory { .. }
                        | Error::CompileOutput { .. }
                        | Error::Compile { .. }
                        | Error::Needs { .. }
                );
                assert!(by_a_limit, "{what}: {error}");
            }
        }
        goes_on(&engine);
        assert_eq!(leftovers(&dir), 0, "{what}");
    }
}

#[test]
fn a_component_that_takes_more_memory_than_it_may_is_refused_as_such() {
    let dir = tempfile::tempdir().unwrap();
    let limits = Limits {
        compile_memory_bytes_max: 160 * 1024 * 1024,
        ..Limits::default()
    };
    let engine = engine_with(&dir, 2, limits, this_binary()).unwrap();
    let error = engine
        .inspect(&much_data(15))
        .and_then(|_| engine.inspect(&many_functions(40_000)));
    assert!(matches!(error, Err(Error::CompileMemory { max_mib: 160 })), "{error:?}");
    goes_on(&engine);
    assert_eq!(leftovers(&dir), 0);
}

#[test]
fn more_first_memory_than_an_instance_may_have_is_refused_before_it_is_made() {
    let engine = crate::guest::engine();
    let error = engine.inspect(&much_data(20)).unwrap_err();
    assert!(matches!(error, Error::Needs { .. }), "{error}");
}
