//! Compiling in a child process. The child is this test binary itself, told to run the one test that is the child's entry.

use std::{path::PathBuf, time::Duration};

use bumpless_engine::{Compile, Config, Engine, Error, Limits, Profile, compile_child};

use crate::guest::{Guest, PATIENCE_NS, frame, state};

/// Where the child's life begins. In an ordinary test run it has nothing to do.
#[test]
fn child_entry() {
    if std::env::var_os("BUMPLESS_COMPILE_PROFILE").is_none() {
        return;
    }
    let paths: Vec<PathBuf> = std::env::args_os().rev().take(2).map(PathBuf::from).collect();
    if let Err(error) = compile_child::run(&paths[1], &paths[0]) {
        #[allow(clippy::print_stderr, reason = "a child's words")]
        {
            eprintln!("{error}");
        }
        std::process::exit(1);
    }
    std::process::exit(0);
}

pub(crate) fn engine_with(
    dir: &tempfile::TempDir,
    instances_max: u32,
    limits: Limits,
    compile: Compile,
) -> Result<Engine, Error> {
    Engine::new(Config {
        cache_dir: Some(dir.path().into()),
        instances_max,
        compile,
        limits,
        ..Config::default()
    })
}

pub(crate) fn this_binary() -> Compile {
    let args = ["--exact", "child::child_entry", "--nocapture", "--test-threads=1", "-q"];
    Compile::Child {
        program: std::env::current_exe().unwrap(),
        args: args.map(Into::into).into(),
    }
}

/// What is left in the folder besides compiled code and the folder for programs' code.
pub(crate) fn leftovers(dir: &tempfile::TempDir) -> usize {
    let names = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().path());
    names
        .filter(|p| p.extension().is_none_or(|x| x != "cwasm") && !p.ends_with("programs"))
        .count()
}

#[test]
fn a_child_compiles_for_both_shapes_of_memory() {
    for (instances_max, profile) in [(1, Profile::Pooled), (14_001, Profile::OnDemand)] {
        let dir = tempfile::tempdir().unwrap();
        let engine = engine_with(&dir, instances_max, Limits::default(), this_binary()).unwrap();
        assert_eq!(engine.profile(), profile);
        let law = engine.prepare(&Guest::good().build()).unwrap();
        let effects = law
            .instantiate()
            .unwrap()
            .step(&frame(1.0), &state(1.0), PATIENCE_NS)
            .unwrap();
        assert_eq!(effects.writes, [(1, 2.0)]);
        assert_eq!(leftovers(&dir), 0);
    }
}

#[test]
fn a_child_says_why_it_refuses() {
    let dir = tempfile::tempdir().unwrap();
    let engine = engine_with(&dir, 1, Limits::default(), this_binary()).unwrap();
    let mut bytes = wat::parse_str("(component)").unwrap();
    bytes.extend([0x7f, 1, 0]);
    let error = engine.inspect(&bytes).unwrap_err();
    assert!(matches!(&error, Error::Compile { .. }), "{error}");
    assert!(
        !error.to_string().contains("compile: the component does not compile"),
        "{error}"
    );
    assert_eq!(leftovers(&dir), 0);
}

#[test]
fn a_child_out_of_memory_is_named_as_such() {
    let dir = tempfile::tempdir().unwrap();
    // About what the program itself takes: what a component of some size needs besides is refused.
    let limits = Limits {
        compile_memory_bytes_max: 32 * 1024 * 1024,
        ..Limits::default()
    };
    let error = engine_with(&dir, 1, limits, this_binary())
        .unwrap()
        .inspect(&bumpless_tests::hostile::bombs::many_functions(20_000))
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "compiling the component took more than 32 MiB of memory and was stopped; simplify it or raise the limit"
    );
    assert_eq!(leftovers(&dir), 0);
}

#[test]
fn a_child_that_takes_too_long_is_stopped() {
    let dir = tempfile::tempdir().unwrap();
    let limits = Limits {
        compile_time_max: Duration::from_secs(1),
        ..Limits::default()
    };
    // It sleeps instead of compiling, and takes no notice of the two paths.
    let sleeper = Compile::Child {
        program: "/bin/sh".into(),
        args: ["-c", "sleep 600"].map(Into::into).into(),
    };
    let error = engine_with(&dir, 1, limits, sleeper)
        .unwrap()
        .inspect(&Guest::good().build())
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "compiling the component took longer than 1 s and was stopped; simplify it or raise the limit"
    );
    assert_eq!(leftovers(&dir), 0);
}

#[test]
fn a_child_that_cannot_be_run_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let missing = Compile::Child {
        program: dir.path().join("missing"),
        args: vec![],
    };
    let error = engine_with(&dir, 1, Limits::default(), missing)
        .unwrap()
        .inspect(&Guest::good().build())
        .unwrap_err();
    assert!(error.to_string().ends_with("/missing cannot be run"), "{error}");
    assert_eq!(leftovers(&dir), 0);
}
