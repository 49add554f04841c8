//! Components made to cost: the compiling child ends within its limits, says why, and the engine goes on.
//!
//! The limits are small here, so that a test is short; what is tested is that they hold.

use std::time::Duration;

use bumpless_engine::{Engine, Error, Limits};
use bumpless_tests::hostile::bombs::{deep_nesting, huge_tables, long_lives, many_functions, much_data};

use crate::{
    child::{engine_with, leftovers, this_binary},
    guest::{Guest, PATIENCE_NS, frame, state},
};

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
