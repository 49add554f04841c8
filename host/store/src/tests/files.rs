//! The directory: rights, locks, formats, component files and secrets.

use std::{fs, os::unix::fs::PermissionsExt, path::Path};

use bumpless_core::{Digest, limits::COMPONENT_BYTES_MAX};
use redb::{Durability, TableDefinition};
use tempfile::tempdir;

use super::samples::intent;
use crate::{Error, FORMAT, Store, database::Change};

fn mode(path: &Path) -> u32 {
    fs::metadata(path).unwrap().permissions().mode() & 0o777
}

#[test]
fn the_directory_is_made_with_private_rights() {
    let parent = tempdir().unwrap();
    let dir = parent.path().join("a/b/store");
    let store = Store::open(&dir).unwrap();
    store.secret("cookie").unwrap();
    let digest = store.put_component(b"bytes").unwrap();
    for (path, wanted) in [
        (dir.clone(), 0o700),
        (dir.join("components"), 0o700),
        (dir.join("secrets"), 0o700),
        (dir.join("host.redb"), 0o600),
        (dir.join("lock"), 0o600),
        (dir.join("secrets/cookie"), 0o600),
        (dir.join(format!("components/{digest}.wasm")), 0o600),
    ] {
        assert_eq!(mode(&path), wanted, "{}", path.display());
    }
    drop(store);
    fs::set_permissions(&dir, fs::Permissions::from_mode(0o755)).unwrap();
    Store::open(&dir).unwrap();
    assert_eq!(mode(&dir), 0o700);
}

#[test]
fn a_directory_with_other_files_is_left_alone() {
    let dir = tempdir().unwrap();
    fs::set_permissions(dir.path(), fs::Permissions::from_mode(0o755)).unwrap();
    fs::write(dir.path().join("letter.txt"), "dear").unwrap();
    let error = Store::open(dir.path()).unwrap_err();
    assert!(matches!(error, Error::NotAStore { .. }), "{error}");
    assert_eq!(mode(dir.path()), 0o755);
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn a_second_opener_is_told_who_has_it() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let clone = store.clone();
    drop(store);
    let error = Store::open(dir.path()).unwrap_err().to_string();
    assert!(
        error.contains(&format!("in use by process {}", std::process::id())),
        "{error}"
    );
    drop(clone);
    Store::open(dir.path()).unwrap();
}

#[test]
fn a_newer_format_is_refused_and_left_as_it_is() {
    let dir = tempdir().unwrap();
    let facts: TableDefinition<&str, u64> = TableDefinition::new("facts");
    {
        let store = Store::open(dir.path()).unwrap();
        let write = |txn: &redb::WriteTransaction| {
            txn.open_table(facts)?.insert("format", FORMAT + 1)?;
            Ok(Change::Keep(()))
        };
        store.inner.base.write("test", Durability::Immediate, write).unwrap();
    }
    let error = Store::open(dir.path()).unwrap_err();
    assert!(
        matches!(error, Error::Newer { found, known, .. } if found == FORMAT + 1 && known == FORMAT),
        "{error}"
    );
    assert!(error.to_string().contains("use the newer program"), "{error}");
}

#[test]
fn a_file_that_is_no_database_is_named() {
    let dir = tempdir().unwrap();
    drop(Store::open(dir.path()).unwrap());
    let file = dir.path().join("host.redb");
    fs::write(&file, "not a database").unwrap();
    let error = Store::open(dir.path()).unwrap_err();
    assert!(matches!(error, Error::Damaged { .. }), "{error:?}");
    assert!(
        error.to_string().contains("host.redb is damaged: move it away"),
        "{error}"
    );
}

#[test]
fn a_half_made_database_is_made_again() {
    let dir = tempdir().unwrap();
    fs::write(dir.path().join("lock"), "4711\n").unwrap();
    fs::write(dir.path().join("host.new"), vec![0; 5000]).unwrap();
    let store = Store::open(dir.path()).unwrap();
    store.put_intent(&intent("level-1")).unwrap();
    assert!(!dir.path().join("host.new").exists());
}

#[test]
fn places_that_cannot_be_are_named_with_a_cure() {
    let dir = tempdir().unwrap();
    let file = dir.path().join("file");
    fs::write(&file, "").unwrap();
    for path in [file.clone(), file.join("store")] {
        let error = Store::open(&path).unwrap_err();
        assert!(matches!(error, Error::Io { .. }), "{error:?}");
        assert!(error.to_string().contains(&file.display().to_string()), "{error}");
        assert!(std::error::Error::source(&error).is_some());
    }
}

#[test]
fn a_component_is_kept_once_and_named_by_its_bytes() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let digest = store.put_component(b"one").unwrap();
    assert_eq!(digest, Digest::of(b"one"));
    assert_eq!(store.put_component(b"one").unwrap(), digest);
    let other = store.put_component(b"other").unwrap();
    let mut both = vec![digest, other];
    both.sort();
    assert_eq!(store.component_digests().unwrap(), both);
    assert!(store.has_component(&digest));
    assert!(store.remove_component(&digest).unwrap());
    assert!(!store.remove_component(&digest).unwrap());
    assert!(!store.has_component(&digest));
    assert_eq!(store.component(&digest).unwrap(), None);
    assert_eq!(store.component_digests().unwrap(), [other]);
    for bad in [vec![], vec![0; COMPONENT_BYTES_MAX + 1]] {
        let error = store.put_component(&bad).unwrap_err().to_string();
        assert!(error.contains(&format!("{} bytes", bad.len())), "{error}");
    }
}

#[test]
fn a_damaged_component_is_set_aside_and_can_be_put_again() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let digest = store.put_component(b"the bytes").unwrap();
    let file = dir.path().join(format!("components/{digest}.wasm"));
    for damage in [&b"the bytez"[..], b"", b"the bytes and more"] {
        fs::write(&file, damage).unwrap();
        assert_eq!(store.component(&digest).unwrap(), None);
        assert!(!store.has_component(&digest));
        assert_eq!(fs::read(file.with_extension("corrupt")).unwrap(), damage);
        store.put_component(b"the bytes").unwrap();
        assert_eq!(store.component(&digest).unwrap().unwrap(), b"the bytes");
    }
    // Putting it again heals a file that nobody has read yet.
    fs::write(&file, "damaged").unwrap();
    store.put_component(b"the bytes").unwrap();
    assert_eq!(store.component(&digest).unwrap().unwrap(), b"the bytes");
}

#[test]
fn drafts_of_a_process_that_died_are_removed_and_other_files_stay() {
    let dir = tempdir().unwrap();
    drop(Store::open(dir.path()).unwrap());
    let draft = dir.path().join("components/0123.draft");
    let other = dir.path().join("components/README.txt");
    fs::write(&draft, "half").unwrap();
    fs::write(&other, "mine").unwrap();
    let store = Store::open(dir.path()).unwrap();
    assert!(!draft.exists() && other.exists());
    assert!(store.component_digests().unwrap().is_empty());
}

#[test]
fn a_secret_is_made_once_and_guarded() {
    let dir = tempdir().unwrap();
    let file = dir.path().join("secrets/cookie");
    let store = Store::open(dir.path()).unwrap();
    let secret = store.secret("cookie").unwrap();
    assert_ne!(secret, store.secret("tokens").unwrap());
    drop(store);
    fs::set_permissions(&file, fs::Permissions::from_mode(0o644)).unwrap();
    let store = Store::open(dir.path()).unwrap();
    assert_eq!(store.secret("cookie").unwrap(), secret);
    assert_eq!(mode(&file), 0o600);
    for length in [31, 33] {
        fs::write(&file, vec![1; length]).unwrap();
        let error = store.secret("cookie").unwrap_err();
        assert!(
            matches!(error, Error::Secret { bytes, .. } if bytes == length),
            "{error}"
        );
    }
    for bad in ["", "../cookie", "a/b", "Cookie", "a.draft", &"x".repeat(65)] {
        assert!(matches!(store.secret(bad), Err(Error::Name(_))), "{bad:?}");
        assert!(matches!(store.host_value::<u8>(bad), Err(Error::Name(_))), "{bad:?}");
    }
}

#[test]
fn threads_that_put_the_same_things_do_not_disturb_each_other() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let results: Vec<_> = std::thread::scope(|scope| {
        let run = |n: u8| {
            let store = store.clone();
            move || {
                let digest = store.put_component(&[7; 5000]).unwrap();
                let own = store.put_component(&[n; 100]).unwrap();
                assert_eq!(store.component(&own).unwrap().unwrap(), [n; 100]);
                (
                    digest,
                    store.secret("cookie").unwrap(),
                    store.count_up("epoch").unwrap(),
                )
            }
        };
        let threads: Vec<_> = (0..8).map(|n| scope.spawn(run(n))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    let mut epochs: Vec<u64> = results.iter().map(|r| r.2).collect();
    epochs.sort_unstable();
    assert_eq!(epochs, (1..=8).collect::<Vec<_>>());
    assert!(results.iter().all(|r| r.0 == results[0].0 && r.1 == results[0].1));
    assert_eq!(store.component_digests().unwrap().len(), 9);
}
