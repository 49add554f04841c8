//! A writer that is killed at any moment leaves a store that opens and holds everything it promised.

use std::{
    io::{BufRead, BufReader},
    path::Path,
};

use tempfile::tempdir;

use super::{
    mortal,
    samples::{intent, loop_id, record, spec},
};
use crate::Store;

const ROUNDS: u64 = 36;

/// What the child puts in round n: its length says n, and so does every byte.
fn component(n: u64) -> Vec<u8> {
    vec![(n % 251) as u8; 1 + usize::try_from(n).unwrap() % 70_000]
}

/// The writer: writes until it is killed, and says on its output what it was promised.
pub(crate) fn write(dir: &Path) {
    let store = Store::open(dir).unwrap();
    let id = loop_id("level-1");
    let mut held = store.intent(&id).unwrap().unwrap_or_else(|| intent("level-1"));
    loop {
        let n = held.last_revision + 1;
        let digest = store.put_component(&component(n)).unwrap();
        let mut next = spec("level-1", n as f64);
        next.digest = digest;
        held.propose(next).unwrap();
        held.commit(n).unwrap();
        store.put_intent(&held).unwrap();
        store.put_records(&[record("level-1", 1, n)]).unwrap();
        if n.is_multiple_of(4) {
            store.sync().unwrap();
        }
        mortal::say(&format!("promised {n}"));
    }
}

#[test]
fn a_killed_writer_loses_nothing_that_it_promised() {
    let dir = tempdir().unwrap();
    let id = loop_id("level-1");
    let mut promised = 0;
    let mut lines_seen = 0;
    for round in 0..ROUNDS {
        let mut child = mortal::start("store", dir.path());
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        // Some rounds die while the store is being made or opened, the others after some writes. The spin spreads the kill
        // over the next write; it is not there to wait for anything.
        let wanted = round % 5;
        let mut seen = 0;
        while seen < wanted {
            let line = lines.next().expect("the child writes on").unwrap();
            if let Some(n) = line.strip_prefix("promised ") {
                promised = n.parse().unwrap();
                seen += 1;
            }
        }
        for _ in 0..(round * 7919 % 13) * 40_000 {
            std::hint::spin_loop();
        }
        child.kill().unwrap();
        child.wait().unwrap();
        // What it promised between our last look and its death.
        for line in lines.map_while(Result::ok) {
            if let Some(n) = line.strip_prefix("promised ") {
                promised = n.parse().unwrap();
                seen += 1;
            }
        }
        lines_seen += seen;

        let store = Store::open(dir.path()).unwrap();
        assert_eq!(store.skipped_rows(), 0);
        let Some(held) = store.intent(&id).unwrap() else {
            assert_eq!(promised, 0, "round {round}: the intent is gone");
            continue;
        };
        // The write that was cut may have come through, but only as a whole.
        let n = held.last_revision;
        assert!(
            n == promised || n == promised + 1,
            "round {round}: {n} is held, {promised} was promised"
        );
        assert_eq!((held.current.revision, held.current.setpoint), (n, n as f64));
        assert_eq!(store.component(&held.current.digest).unwrap(), Some(component(n)));
        for digest in store.component_digests().unwrap() {
            assert!(
                store.component(&digest).unwrap().is_some(),
                "round {round}: half a component"
            );
        }
        if let Some(record) = store.last_record(&id).unwrap() {
            assert_eq!(*record.state, record.seq.to_le_bytes());
            assert!(record.seq <= n);
        }
        promised = n;
    }
    // Else the test killed nothing but beginners.
    assert!(lines_seen > ROUNDS, "{lines_seen}");
}
