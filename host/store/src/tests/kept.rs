//! What this version writes to a disk is kept, byte by byte, for the fuzzers and for later versions: rows and chunks of cycles.
//!
//! Where this fails the form of a stored value changed: give `ROW_VERSION` the next number, then write the new ones with
//! `UPDATE_EXPECT=1`.

use std::{fs, path::Path};

use bumpless_core::{Record, history::STEPS_NS};
use tempfile::tempdir;

use super::samples::{info, intent, record};
use crate::{Archive, Bounds, Lens, Store, format, format::ROW_VERSION, parsers};

fn same(target: &str, name: &str, bytes: &[u8]) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../fuzz/corpus")
        .join(target);
    let path = folder.join(format!("v{ROW_VERSION}-{name}"));
    if std::env::var_os("UPDATE_EXPECT").is_some() {
        fs::create_dir_all(&folder).unwrap();
        fs::write(&path, bytes).unwrap();
    }
    assert_eq!(fs::read(&path).ok().as_deref(), Some(bytes), "{}", path.display());
}

#[test]
fn what_is_written_is_what_this_version_always_wrote() {
    let what = String::new;
    same(
        "store_row",
        "record",
        &format::encode(what, &*record("level-1", 1, 7)).unwrap(),
    );
    same(
        "store_row",
        "intent",
        &format::encode(what, &intent("level-1")).unwrap(),
    );
    same("store_row", "summary", &format::encode(what, &info(b"bytes")).unwrap());
    same("store_row", "number", &format::encode(what, &7_u64).unwrap());
    let records: Vec<_> = (1..=3).map(|seq| record("level-1", 1, seq)).collect();
    let chunk = crate::cycles::parsing::encode(&records).unwrap();
    assert_eq!(parsers::cycles(&chunk, false), Some(3));
    same("cycles", "chunk", &chunk);
    // Its head is version, length, and check.
    let sealed = [&chunk[1..5], &chunk[13..]].concat();
    assert_eq!(parsers::cycles(&sealed, true), Some(3));
    same("cycles", "sealed", &sealed);
}

/// Blocks and entries are cut by the clock, so these are not compared; they are read.
#[test]
fn a_history_of_this_version_is_read() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus");
    let dir = tempdir().unwrap();
    let bounds = Bounds {
        bytes_max: 4 << 20,
        keep_ns: [u64::MAX; STEPS_NS.len()],
    };
    let archive = Archive::open(&Store::open(dir.path()).unwrap(), bounds).unwrap();
    let layout = std::sync::Arc::new(bumpless_core::history::Layout {
        outputs: vec!["out".into()],
        period_ns: 10_000_000,
    });
    let lens = move |_: &Record| {
        Some(Lens {
            layout: layout.clone(),
            measured: Some(0),
        })
    };
    archive.judge_by(Box::new(lens)).unwrap();
    (1..700).for_each(|seq| archive.offer(record("level-1", 1, seq)));
    archive.pack().unwrap();
    (700..900).for_each(|seq| archive.offer(record("level-1", 1, seq)));
    archive.close().unwrap();
    let mut kinds = Vec::new();
    for entry in fs::read_dir(dir.path().join("history")).unwrap() {
        let path = entry.unwrap().path();
        let kind = path
            .file_name()
            .unwrap()
            .to_str()
            .unwrap()
            .split('-')
            .next()
            .unwrap()
            .to_owned();
        let mut files = vec![("history".to_owned(), kind.clone(), fs::read(&path).unwrap())];
        for (n, (head, body)) in crate::archive::parsing::frames(&files[0].2.clone())
            .into_iter()
            .enumerate()
        {
            if !body.is_empty() && n < 2 {
                files.push((
                    "history_block".to_owned(),
                    format!("{kind}-{n}"),
                    [head.as_slice(), body].concat(),
                ));
            }
        }
        for (target, name, bytes) in files {
            let kept = folder.join(&target).join(format!("v{ROW_VERSION}-{name}"));
            if std::env::var_os("UPDATE_EXPECT").is_some() {
                fs::create_dir_all(kept.parent().unwrap()).unwrap();
                fs::write(&kept, &bytes).unwrap();
            }
            for bytes in [
                bytes,
                fs::read(&kept).unwrap_or_else(|error| panic!("{}: {error}", kept.display())),
            ] {
                let read = match target.as_str() {
                    "history" => parsers::history_file(&bytes),
                    _ => parsers::history_block_of(&bytes)
                        .or(parsers::history_entry(&bytes))
                        .unwrap_or(0),
                };
                assert!(read > 0, "{}", kept.display());
            }
        }
        kinds.push(kind);
    }
    kinds.sort();
    assert_eq!(kinds.first().map(String::as_str), Some("1s"), "{kinds:?}");
    assert_eq!(kinds.last().map(String::as_str), Some("journal"), "{kinds:?}");
}
