//! What is taken and what is refused, with the words that the uploader reads.

use bumpless_core::{Digest, Direction};
use bumpless_engine::{Config, Engine, Error, Limits, Profile, precompile};

use crate::guest::{Guest, engine};

/// An error with its sources, as an operator sees it.
fn words(error: &Error) -> String {
    let mut text = error.to_string();
    let mut next = std::error::Error::source(error);
    while let Some(source) = next {
        text = format!("{text}: {source}");
        next = source.source();
    }
    text
}

#[test]
fn a_controller_is_described() {
    let bytes = Guest::good().build();
    let found = engine().inspect(&bytes).unwrap();
    assert_eq!(found.digest, Digest::of(&bytes));
    assert_eq!(found.bytes, bytes.len());
    assert!(found.compile_time.is_some());
    assert!(
        found.imports.contains(&"bumpless:control/io@0.1.0".to_owned()),
        "{:?}",
        found.imports
    );
    let d = found.descriptor;
    assert_eq!(
        (d.name.as_str(), d.version.as_str(), d.state_layout),
        ("sum", "1.2.3", 7)
    );
    assert_eq!(
        (d.ports.len(), d.ports[1].name.as_str(), d.ports[1].direction),
        (2, "out", Direction::Output)
    );
    assert_eq!((d.parameters[0].name.as_str(), d.parameters[0].maximum), ("after", 9.0));
}

#[test]
fn what_is_no_controller_is_refused_in_words() {
    let wat = |text: &str| wat::parse_str(text).unwrap();
    let wasi = wat(r#"(component (import "wasi:cli/environment@0.2.0" (instance)))"#);
    let other = wat(r#"(component (import "my:own/files" (func)))"#);
    let newer = wat(r#"(component (import "bumpless:control/clairvoyance@0.1.0" (instance)))"#);
    let typed = wat(r#"(component
             (core module $m (func (export "f")))
             (core instance $i (instantiate $m))
             (func $f (canon lift (core func $i "f")))
             (instance $c (export "describe" (func $f)) (export "start" (func $f)) (export "step" (func $f)) (export "migrate" (func $f)))
             (export "bumpless:control/control@0.1.0" (instance $c)))"#);
    let lacking = wat(r#"(component (instance $c) (export "bumpless:control/control@0.1.0" (instance $c)))"#);
    let mistyped_import = wat(
        r#"(component (import "bumpless:control/io@0.1.0" (instance (export "count" (func (param "x" u32)))))
             (core module $m (func (export "f")))
             (core instance $i (instantiate $m))
             (func $f (canon lift (core func $i "f")))
             (instance $c (export "describe" (func $f)) (export "start" (func $f)) (export "step" (func $f)) (export "migrate" (func $f)))
             (export "bumpless:control/control@0.1.0" (instance $c)))"#,
    );
    let invalid = {
        let mut bytes = wat("(component)");
        bytes.extend([0x7f, 1, 0]);
        bytes
    };
    let name_lie = Guest {
        name: "Not A Name".into(),
        ..Guest::good()
    }
    .build();
    let twice = Guest {
        out_name: "in".into(),
        ..Guest::good()
    }
    .build();
    let traps = Guest {
        describe: "(unreachable)".into(),
        ..Guest::good()
    }
    .build();
    let spins = Guest {
        describe: "(loop $l (br $l)) (unreachable)".into(),
        ..Guest::good()
    }
    .build();
    let writes = Guest {
        describe: "(call $write (i32.const 1) (f64.const 1)) (i32.const 1024)".into(),
        ..Guest::good()
    }
    .build();
    let start_traps = Guest {
        extra: "(func $begin (unreachable))".into(),
        start_section: "(start $begin)".into(),
        ..Guest::good()
    }
    .build();
    let start_spins = Guest {
        extra: "(func $begin (loop $l (br $l)))".into(),
        start_section: "(start $begin)".into(),
        ..Guest::good()
    }
    .build();
    let exporting = |core: &str| {
        wat(&format!(
            r#"(component
                 (core module $m (func (export "f")))
                 (core module $e)
                 (core module $mem (memory 1))
                 (core instance $i (instantiate $m))
                 {core}
                 (func $f (canon lift (core func $i "f")))
                 (instance $c (export "describe" (func $f)) (export "start" (func $f)) (export "step" (func $f)) (export "migrate" (func $f)))
                 (export "bumpless:control/control@0.1.0" (instance $c)))"#
        ))
    };
    let many = exporting(&"(core instance (instantiate $e))".repeat(48));
    let memories = exporting(&"(core instance (instantiate $mem))".repeat(5));
    let hungry = Guest {
        pages: 300,
        ..Guest::good()
    }
    .build();
    let precompiled = precompile(&Guest::good().build(), Profile::Pooled, &Limits::default()).unwrap();

    let cases: [(&str, &[u8], &str); 19] = [
        ("garbage", b"MZ\x90", "no WebAssembly component but something else"),
        (
            "core module",
            &wat("(module)"),
            "but a core module; make a component of it",
        ),
        (
            "compiled code",
            &precompiled,
            "but machine code that wasmtime compiled; upload the .wasm file",
        ),
        ("invalid", &invalid, "the component does not compile: "),
        (
            "empty component",
            &wat("(component)"),
            "must export the interface bumpless:control/control@0.1.0; it exports nothing",
        ),
        (
            "lacks functions",
            &lacking,
            "its export bumpless:control/control@0.1.0 lacks the function describe",
        ),
        (
            "other types",
            &typed,
            "this is no controller of the world bumpless:control@0.1.0: ",
        ),
        (
            "other import types",
            &mistyped_import,
            "this is no controller of the world bumpless:control@0.1.0: ",
        ),
        (
            "wasi",
            &wasi,
            "import \"wasi:cli/environment@0.2.0\" is not offered to controllers; a controller has no operating system",
        ),
        (
            "other import",
            &other,
            "import \"my:own/files\" is not offered to controllers; a controller may import",
        ),
        ("newer interface", &newer, "it may be of a newer version"),
        (
            "name",
            &name_lie,
            "not acceptable: component name \"Not A Name\": use 1 to 32",
        ),
        ("twice", &twice, "not acceptable: port \"in\" is described twice"),
        (
            "describe traps",
            &traps,
            "cannot say what it is: the component trapped: wasm `unreachable` instruction executed",
        ),
        (
            "describe writes",
            &writes,
            "cannot say what it is: the component wrote 1 to port \"1\", which cannot be",
        ),
        (
            "start traps",
            &start_traps,
            "cannot be instantiated: the component trapped: wasm `unreachable` instruction executed",
        ),
        ("many instances", &many, "needs more than an instance may have: "),
        ("many memories", &memories, "needs more than an instance may have: "),
        ("hungry", &hungry, "needs more than an instance may have: "),
    ];
    let engine = engine();
    for (name, bytes, expected) in cases {
        let error = words(&engine.inspect(bytes).expect_err(name));
        assert!(error.contains(expected), "{name}: {error}");
        assert!(!error.ends_with('.'), "{name}: {error}");
        // What is refused at the inspection is refused at the preparation too, and leaves nothing behind.
        assert!(engine.prepare(bytes).is_err(), "{name}");
        assert!(engine.prepared(&Digest::of(bytes)).is_none(), "{name}");
    }

    // The spinning ones with a shorter limit, for each takes all of it.
    let limits = Limits {
        describe_time_max: std::time::Duration::from_millis(20),
        ..Limits::default()
    };
    let engine = Engine::new(Config {
        instances_max: 1,
        limits,
        ..Config::default()
    })
    .unwrap();
    for (bytes, expected) in [
        (
            spins,
            "cannot say what it is: the step ran past its limit of 20000 µs and was stopped",
        ),
        (
            start_spins,
            "cannot be instantiated: the step ran past its limit of 20000 µs and was stopped",
        ),
    ] {
        let error = words(&engine.inspect(&bytes).unwrap_err());
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn settings_that_make_no_sense_are_refused() {
    let with = |limits| {
        Engine::new(Config {
            limits,
            ..Config::default()
        })
        .map(drop)
        .unwrap_err()
        .to_string()
    };
    assert_eq!(
        Engine::new(Config {
            instances_max: 0,
            ..Config::default()
        })
        .map(drop)
        .unwrap_err()
        .to_string(),
        "engine setting instances_max = 0: use 1 to 1,000,000"
    );
    assert_eq!(
        with(Limits {
            memory_bytes_max: 1000,
            ..Limits::default()
        }),
        "engine setting memory_bytes_max = 1000: use a multiple of 65,536 up to 4 GiB"
    );
    assert_eq!(
        with(Limits {
            prepared_max: 0,
            ..Limits::default()
        }),
        "engine setting prepared_max = 0: use 1 or more"
    );
}

#[test]
fn a_component_of_several_with_memories_of_their_own_compiles() {
    // The text goes from one memory to the other, by an adapter that knows both.
    let joined = wat::parse_str(
        r#"(component
             (component $inner
               (core module $m
                 (memory (export "memory") 1)
                 (func (export "length") (param i32 i32) (result i32) local.get 1)
                 (func (export "realloc") (param i32 i32 i32 i32) (result i32) i32.const 0))
               (core instance $i (instantiate $m))
               (func (export "length") (param "text" string) (result u32)
                 (canon lift (core func $i "length") (memory (core memory $i "memory")) (realloc (core func $i "realloc")))))
             (component $outer
               (import "length" (func $length (param "text" string) (result u32)))
               (core module $memory (memory (export "memory") 1))
               (core instance $own (instantiate $memory))
               (core func $lowered (canon lower (func $length) (memory (core memory $own "memory"))))
               (core module $m
                 (import "inner" "length" (func $length (param i32 i32) (result i32)))
                 (func (export "run") (result i32) (call $length (i32.const 0) (i32.const 3))))
               (core instance $i (instantiate $m (with "inner" (instance (export "length" (func $lowered))))))
               (func (export "run") (result u32) (canon lift (core func $i "run"))))
             (instance $one (instantiate $inner))
             (instance $two (instantiate $outer (with "length" (func $one "length"))))
             (export "run" (func $two "run")))"#,
    )
    .unwrap();
    for profile in [Profile::Pooled, Profile::OnDemand] {
        let compiled = precompile(&joined, profile, &Limits::default());
        assert!(compiled.is_ok(), "{profile:?}: {:?}", compiled.err());
    }
}
