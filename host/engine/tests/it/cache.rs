//! Compiled code on disk: found again, and never believed where it was touched.

use std::{fs, os::unix::fs::PermissionsExt as _, path::Path};

use bumpless_core::Digest;
use bumpless_engine::{Config, Engine, Limits, cache_key};

use crate::guest::{Guest, PATIENCE_NS, frame, state};

fn engine(dir: &Path, key: u8) -> Engine {
    Engine::new(Config {
        cache_dir: Some(dir.join("code")),
        cache_key: [key; 32],
        instances_max: 2,
        ..Config::default()
    })
    .unwrap()
}

fn files(dir: &Path) -> Vec<std::path::PathBuf> {
    let mut files: Vec<_> = fs::read_dir(dir.join("code"))
        .unwrap()
        .map(|e| e.unwrap().path())
        // Programs' code has a folder of its own.
        .filter(|path| !path.ends_with("programs"))
        .collect();
    files.sort();
    files
}

/// Was the compiler asked? And does the component work?
fn compiled(engine: &Engine, bytes: &[u8]) -> bool {
    let found = engine.inspect(bytes).unwrap();
    let law = engine.prepare(bytes).unwrap();
    let effects = law
        .instantiate()
        .unwrap()
        .step(&frame(1.0), &state(1.0), PATIENCE_NS)
        .unwrap();
    assert_eq!(effects.writes, [(1, 2.0)]);
    engine.forget(&found.digest);
    found.compile_time.is_some()
}

#[test]
fn code_is_found_again_by_another_engine_with_the_same_key() {
    let dir = tempfile::tempdir().unwrap();
    let bytes = Guest::good().build();
    let first = engine(dir.path(), 1).inspect(&bytes).unwrap();
    assert!(first.compile_time.is_some());
    let path = &files(dir.path())[0];
    assert!(
        path.file_name()
            .unwrap()
            .to_str()
            .unwrap()
            .starts_with(&first.digest.to_string())
    );
    assert_eq!(fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o600);
    assert_eq!(
        fs::metadata(dir.path().join("code")).unwrap().permissions().mode() & 0o777,
        0o700
    );
    let again = engine(dir.path(), 1).inspect(&bytes).unwrap();
    assert_eq!((again.compile_time, again.descriptor), (None, first.descriptor));
}

#[test]
fn code_that_was_touched_is_compiled_again_and_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let bytes = Guest::good().build();
    engine(dir.path(), 1).inspect(&bytes).unwrap();
    let path = files(dir.path()).remove(0);
    let good = fs::read(&path).unwrap();

    let flipped = |at: usize| {
        let mut bytes = good.clone();
        bytes[at] ^= 1;
        bytes
    };
    let mut longer = good.clone();
    longer.push(0);
    let cases = [
        ("the MAC", flipped(0)),
        ("the magic", flipped(32)),
        ("the component's digest", flipped(40)),
        ("the engine's hash", flipped(72)),
        ("the code", flipped(good.len() / 2)),
        ("the last byte", flipped(good.len() - 1)),
        ("cut short", good[..good.len() - 1].to_vec()),
        ("only a MAC", good[..32].to_vec()),
        ("empty", vec![]),
        ("longer", longer),
    ];
    for (what, touched) in cases {
        fs::write(&path, touched).unwrap();
        assert!(compiled(&engine(dir.path(), 1), &bytes), "{what}");
        engine(dir.path(), 1).inspect(&bytes).unwrap();
        assert!(
            engine(dir.path(), 1).inspect(&bytes).unwrap().compile_time.is_none(),
            "replaced after: {what}"
        );
    }
}

#[test]
fn code_under_another_key_or_another_name_is_not_ours() {
    let dir = tempfile::tempdir().unwrap();
    let (one, other) = (
        Guest::good().build(),
        Guest {
            name: "other".into(),
            ..Guest::good()
        }
        .build(),
    );
    engine(dir.path(), 1).inspect(&one).unwrap();
    assert!(
        engine(dir.path(), 2).inspect(&one).unwrap().compile_time.is_some(),
        "another host's key"
    );
    // Genuine code of one component under the name of another.
    let path = files(dir.path()).remove(0);
    let name = path.file_name().unwrap().to_str().unwrap();
    let swapped = name.replace(&Digest::of(&one).to_string(), &Digest::of(&other).to_string());
    fs::copy(&path, path.with_file_name(swapped)).unwrap();
    let found = engine(dir.path(), 2).inspect(&other).unwrap();
    assert!(found.compile_time.is_some());
    assert_eq!(found.descriptor.name, "other");
}

#[test]
fn what_is_refused_or_forgotten_is_not_kept() {
    let dir = tempfile::tempdir().unwrap();
    let engine = engine(dir.path(), 1);
    engine
        .inspect(
            &Guest {
                name: "Not A Name".into(),
                ..Guest::good()
            }
            .build(),
        )
        .unwrap_err();
    assert_eq!(files(dir.path()).len(), 0);
    let bytes = Guest::good().build();
    engine.inspect(&bytes).unwrap();
    assert_eq!(files(dir.path()).len(), 1);
    engine.forget(&Digest::of(&bytes));
    assert_eq!(files(dir.path()).len(), 0);
}

#[test]
fn the_oldest_code_goes_first() {
    let dir = tempfile::tempdir().unwrap();
    let limits = Limits {
        cached_max: 2,
        ..Limits::default()
    };
    let engine = Engine::new(Config {
        cache_dir: Some(dir.path().join("code")),
        instances_max: 1,
        limits,
        ..Config::default()
    })
    .unwrap();
    for (age_s, name) in [(30, "a"), (20, "b"), (10, "c")] {
        let found = engine
            .inspect(
                &Guest {
                    name: name.into(),
                    ..Guest::good()
                }
                .build(),
            )
            .unwrap();
        let made = files(dir.path())
            .into_iter()
            .find(|p| p.to_str().unwrap().contains(&found.digest.to_string()));
        let file = fs::File::options().write(true).open(made.unwrap()).unwrap();
        file.set_modified(std::time::SystemTime::now() - std::time::Duration::from_secs(age_s))
            .unwrap();
    }
    let left = files(dir.path());
    assert_eq!(left.len(), 2);
    let first = Digest::of(
        &Guest {
            name: "a".into(),
            ..Guest::good()
        }
        .build(),
    )
    .to_string();
    assert!(!left.iter().any(|p| p.to_str().unwrap().contains(&first)));
}

#[test]
fn what_a_killed_host_left_behind_is_swept_away_and_live_work_is_not() {
    let dir = tempfile::tempdir().unwrap();
    drop(engine(dir.path(), 1));
    let code = dir.path().join("code");
    let old = std::time::SystemTime::now() - std::time::Duration::from_secs(7200);
    for name in [".old-file", ".new-file", "other.txt"] {
        fs::write(code.join(name), "x").unwrap();
    }
    fs::create_dir(code.join(".compile-1-1")).unwrap();
    fs::write(code.join(".compile-1-1/in.wasm"), "x").unwrap();
    for name in [".old-file", "other.txt", ".compile-1-1"] {
        fs::File::open(code.join(name)).unwrap().set_modified(old).unwrap();
    }
    drop(engine(dir.path(), 1));
    let names: Vec<_> = files(dir.path())
        .iter()
        .map(|p| p.file_name().unwrap().to_owned())
        .collect();
    assert_eq!(names, [".new-file", "other.txt"]);
}

#[test]
fn a_folder_that_cannot_be_is_an_error_with_its_path() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("code"), "a file").unwrap();
    let config = Config {
        cache_dir: Some(dir.path().join("code")),
        instances_max: 1,
        ..Config::default()
    };
    let error = Engine::new(config).map(drop).unwrap_err().to_string();
    assert!(
        error.starts_with("creating ") && error.contains("/code") && error.contains(" failed; check that"),
        "{error}"
    );
}

#[test]
fn the_key_is_drawn_once_and_kept_private() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cache.key");
    let key = cache_key(&path).unwrap();
    assert_ne!(key, [0; 32]);
    assert_eq!(cache_key(&path).unwrap(), key);
    assert_ne!(cache_key(&dir.path().join("other.key")).unwrap(), key);
    assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    assert_eq!(
        fs::read_dir(dir.path()).unwrap().count(),
        2,
        "nothing temporary is left"
    );
    fs::write(&path, [1; 31]).unwrap();
    let error = cache_key(&path).unwrap_err().to_string();
    assert!(
        error.ends_with("cache.key holds 31 bytes and not the 32 of a key; delete it to get a new one"),
        "{error}"
    );
}
