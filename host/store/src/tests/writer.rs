//! The record writer: newest per loop, all of it on disk after a flush, nothing of it in the way.

use tempfile::tempdir;

use super::samples::{loop_id, record};
use crate::{RecordWriter, Store};

/// What another process would find on the disk now.
fn on_disk(dir: &std::path::Path) -> Vec<(String, (u64, u64))> {
    let copy = tempdir().unwrap();
    std::fs::copy(dir.join("host.redb"), copy.path().join("host.redb")).unwrap();
    let store = Store::open(copy.path()).unwrap();
    store
        .last_records()
        .unwrap()
        .iter()
        .map(|r| (r.loop_id.to_string(), r.position()))
        .collect()
}

#[test]
fn records_reach_the_disk_with_the_sync_and_not_before() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    store.put_records(&[record("level-1", 1, 1)]).unwrap();
    assert_eq!(store.last_records().unwrap().len(), 1);
    assert_eq!(on_disk(dir.path()), []);
    store.sync().unwrap();
    assert_eq!(on_disk(dir.path()), [("level-1".to_owned(), (1, 1))]);
}

#[test]
fn only_the_newest_record_of_a_loop_is_written() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let writer = RecordWriter::start(store.clone()).unwrap();
    for seq in 1..=1000 {
        writer.offer(record("level-1", 1, seq));
        writer.offer(record("flow-1", 2, seq));
    }
    // An older one after a newer one changes nothing.
    writer.offer(record("flow-1", 1, 5000));
    writer.flush().unwrap();
    let wanted = [("flow-1".to_owned(), (2, 1000)), ("level-1".to_owned(), (1, 1000))];
    assert_eq!(on_disk(dir.path()), wanted);
    let counts = writer.counts();
    assert_eq!(counts.offered, 2001);
    assert_eq!(counts.written + counts.overwritten, 2001);
    assert_eq!((counts.refused, counts.failed_writes), (0, 0));

    writer.offer(record("level-1", 1, 1001));
    writer.close().unwrap();
    assert_eq!(on_disk(dir.path())[1].1, (1, 1001));
}

#[test]
fn a_dropped_writer_flushes() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let writer = RecordWriter::start(store.clone()).unwrap();
    writer.offer(record("level-1", 3, 4));
    drop(writer);
    assert_eq!(on_disk(dir.path()), [("level-1".to_owned(), (3, 4))]);
}

#[test]
fn a_forgotten_loop_is_not_written() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let writer = RecordWriter::start(store.clone()).unwrap();
    writer.flush().unwrap();
    writer.offer(record("level-1", 1, 1));
    writer.forget(&loop_id("level-1"));
    store.remove_record(&loop_id("level-1")).unwrap();
    writer.offer(record("flow-1", 1, 1));
    writer.close().unwrap();
    assert_eq!(on_disk(dir.path()), [("flow-1".to_owned(), (1, 1))]);
}

#[test]
fn too_many_loops_are_refused_and_counted_while_known_ones_are_taken() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let writer = RecordWriter::start(store.clone()).unwrap();
    // Faster than a flush or not: what is refused is counted, and the rest arrives.
    for n in 0..20_000 {
        writer.offer(record(&format!("loop-{n}"), 1, 1));
    }
    writer.close().unwrap();
    let held = store.last_records().unwrap().len() as u64;
    assert!(held >= 16_384, "{held}");
}
