//! The log of cycles: order, windows, the bound, restarts, damage, a queue that is full.

use std::{
    io::{BufRead, BufReader},
    path::Path,
    sync::Arc,
};

use bumpless_core::{LoopId, Record};
use proptest::prelude::*;
use tempfile::tempdir;

use super::{
    mortal,
    samples::{loop_id, record},
};
use crate::{CycleLog, Error, Store, Window};

const MIB: u64 = 1024 * 1024;

fn open(dir: &Path) -> CycleLog {
    CycleLog::open(&Store::open(dir).unwrap(), 16 * MIB, u64::MAX).unwrap()
}

fn all(log: &CycleLog, id: &LoopId, window: Window, before: bool) -> Vec<Arc<Record>> {
    let mut cursor = log.read(id, window, before).unwrap();
    let mut found = Vec::new();
    while let Some(piece) = cursor.next_piece().unwrap() {
        assert!(!piece.is_empty());
        found.extend(piece);
    }
    found
}

fn seqs(log: &CycleLog, id: &LoopId, window: Window, before: bool) -> Vec<u64> {
    all(log, id, window, before).iter().map(|r| r.seq).collect()
}

#[test]
fn records_are_read_back_in_order_whether_they_wait_or_lie_on_disk() {
    let dir = tempdir().unwrap();
    let log = open(dir.path());
    let (level, flow) = (loop_id("level-1"), loop_id("flow-1"));
    assert_eq!(seqs(&log, &level, Window::Last(10), true), []);
    for seq in 1..=40 {
        log.offer(record("level-1", 1, seq));
        log.offer(record("flow-1", 1, seq));
        if seq % 16 == 0 {
            log.flush().unwrap();
        }
    }
    // One that comes twice, or late, is passed over.
    log.offer(record("level-1", 1, 40));
    log.offer(record("level-1", 1, 3));
    let everything = all(&log, &level, Window::Last(u64::MAX - 1), false);
    let expected: Vec<_> = (1..=40).map(|seq| record("level-1", 1, seq)).collect();
    assert_eq!(everything, expected);
    assert_eq!(seqs(&log, &level, Window::Last(3), false), [38, 39, 40]);
    assert_eq!(seqs(&log, &level, Window::Last(3), true), [37, 38, 39, 40]);
    assert_eq!(
        seqs(&log, &flow, Window::Last(20), false),
        (21..=40).collect::<Vec<_>>()
    );
    // A cycle every 10 ms, the first at 10 ms.
    let ms = 1_000_000;
    assert_eq!(seqs(&log, &level, Window::Recent(20 * ms), false), [38, 39, 40]);
    assert_eq!(
        seqs(&log, &level, Window::Between(95 * ms, 125 * ms), false),
        [10, 11, 12]
    );
    assert_eq!(
        seqs(&log, &level, Window::Between(165 * ms, 185 * ms), true),
        [16, 17, 18]
    );
    assert_eq!(seqs(&log, &level, Window::Between(500 * ms, 600 * ms), true), []);
    assert_eq!(seqs(&log, &level, Window::Between(0, 15 * ms), true), [1]);
    log.close().unwrap();

    let log = open(dir.path());
    assert_eq!(
        seqs(&log, &level, Window::Last(100), false),
        (1..=40).collect::<Vec<_>>()
    );
    log.offer(record("level-1", 17, 41));
    assert_eq!(seqs(&log, &level, Window::Last(2), false), [40, 41]);
    assert_eq!(log.loops().unwrap(), [flow.clone(), level.clone()]);
    log.forget(&level).unwrap();
    assert_eq!(seqs(&log, &level, Window::Last(100), false), []);
    assert_eq!(log.loops().unwrap(), [flow]);
    log.forget(&level).unwrap();
}

#[test]
fn the_oldest_of_all_loops_go_when_the_bound_is_reached() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    let bound = 64 * 1024;
    let log = CycleLog::open_bounded(&store, (bound, u64::MAX)).unwrap();
    let (old, busy) = (loop_id("old"), loop_id("busy"));
    log.offer(record("old", 1, 1));
    log.flush().unwrap();
    let mut largest = 0;
    for round in 0..400_u64 {
        for seq in 1..=50 {
            log.offer(record("busy", 1, round * 50 + seq));
        }
        log.flush().unwrap();
        let counts = log.counts();
        assert!(counts.bytes <= bound, "{counts:?}");
        largest = largest.max(std::fs::metadata(dir.path().join("cycles.redb")).unwrap().len());
    }
    assert_eq!(
        seqs(&log, &old, Window::Last(10), false),
        [],
        "the oldest is not the busy loop's"
    );
    let kept = seqs(&log, &busy, Window::Last(u64::MAX - 1), false);
    assert!(kept.len() > 100 && kept.len() < 20_000, "{}", kept.len());
    assert_eq!(kept.last(), Some(&20_000));
    assert!(
        kept.windows(2).all(|pair| pair[0] + 1 == pair[1]),
        "no hole in what is kept"
    );
    // What the database needs for itself is some megabytes, not a multiple that grows with the writes.
    assert!(largest < 8 * MIB, "{largest}");
    let counts = log.counts();
    assert_eq!((counts.offered, counts.dropped, counts.written), (20_001, 0, 20_001));
    drop(log);
    // A smaller bound takes effect with the next write.
    let log = CycleLog::open_bounded(&store, (bound / 4, u64::MAX)).unwrap();
    log.offer(record("busy", 1, 20_001));
    log.flush().unwrap();
    assert!(log.counts().bytes <= bound / 4);
}

#[test]
fn the_file_stays_within_what_was_asked() {
    let dir = tempdir().unwrap();
    let log = open(dir.path());
    let mut seed = 1_u64;
    // A hundred loops with states that do not compress: three times the bound in all.
    for round in 0..150_u64 {
        for number in 0..100 {
            let mut record = (*record(&format!("loop-{number}"), 1, round + 1)).clone();
            let state = (0..200).flat_map(|_| {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                seed.to_be_bytes()
            });
            record.state = state.collect();
            log.offer(Arc::new(record));
        }
        log.flush().unwrap();
    }
    let counts = log.counts();
    assert_eq!((counts.written, counts.dropped), (15_000, 0));
    assert!(
        counts.bytes <= 8 * MIB && counts.bytes > 7 * MIB,
        "the bound was reached: {counts:?}"
    );
    let file = std::fs::metadata(dir.path().join("cycles.redb")).unwrap().len();
    assert!(file <= 17 * MIB, "{file}");
}

#[test]
fn a_damaged_chunk_is_skipped_and_counted() {
    let dir = tempdir().unwrap();
    let log = open(dir.path());
    let id = loop_id("level-1");
    for piece in [1..=10, 11..=20, 21..=30] {
        for seq in piece {
            log.offer(record("level-1", 1, seq));
        }
        log.flush().unwrap();
    }
    log.spoil(&id, (1, 11), |bytes| bytes[40] ^= 1);
    let mut cursor = log.read(&id, Window::Last(25), false).unwrap();
    let mut found = Vec::new();
    while let Some(piece) = cursor.next_piece().unwrap() {
        found.extend(piece.iter().map(|r| r.seq));
    }
    assert_eq!(found, (6..=10).chain(21..=30).collect::<Vec<_>>());
    assert_eq!((cursor.unread(), log.counts().damaged), (1, 1));
    assert_eq!(seqs(&log, &id, Window::Last(12), true).last(), Some(&30));
}

#[test]
fn a_loop_that_begins_anew_leaves_its_namesake_behind() {
    let dir = tempdir().unwrap();
    let log = open(dir.path());
    let id = loop_id("level-1");
    for seq in 1..=5 {
        log.offer(record("level-1", 9, seq));
        log.offer(record("flow-1", 9, seq));
    }
    log.flush().unwrap();
    log.offer(record("level-1", 9, 6));
    let mut first = (*record("level-1", 1, 1)).clone();
    first.after = (0, 0);
    log.offer(Arc::new(first));
    log.offer(record("level-1", 1, 2));
    assert_eq!(seqs(&log, &id, Window::Last(100), false), [1, 2]);
    log.flush().unwrap();
    assert_eq!(seqs(&log, &id, Window::Last(100), false), [1, 2]);
    assert_eq!(
        seqs(&log, &loop_id("flow-1"), Window::Last(100), false),
        [1, 2, 3, 4, 5]
    );
}

#[test]
fn a_file_that_is_no_log_is_moved_aside() {
    let dir = tempdir().unwrap();
    drop(Store::open(dir.path()).unwrap());
    std::fs::write(dir.path().join("cycles.redb"), vec![7; 10_000]).unwrap();
    let log = open(dir.path());
    log.offer(record("level-1", 1, 1));
    assert_eq!(seqs(&log, &loop_id("level-1"), Window::Last(2), false), [1]);
    assert_eq!(
        std::fs::read(dir.path().join("cycles.damaged")).unwrap(),
        vec![7; 10_000]
    );
}

#[test]
fn too_much_at_once_is_dropped_and_counted() {
    let dir = tempdir().unwrap();
    let log = open(dir.path());
    let mut large = (*record("level-1", 1, 1)).clone();
    large.state = Arc::from(vec![0; 64 * 1024]);
    // 128 MiB of states: twice what may wait. The thread may take some of it away meanwhile, but not to nowhere.
    for seq in 1..=2048 {
        large.seq = seq;
        log.offer(Arc::new(large.clone()));
    }
    let counts = log.counts();
    assert_eq!(counts.offered, 2048);
    log.flush().unwrap();
    let (written, dropped) = (log.counts().written, log.counts().dropped);
    assert_eq!(written + dropped, 2048);
    // Room again.
    log.offer(record("level-1", 2, 5000));
    assert_eq!(seqs(&log, &loop_id("level-1"), Window::Last(1), false), [5000]);
}

#[test]
fn a_bound_out_of_range_is_refused_in_words() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    for bytes in [0, 16 * MIB - 1, 65_536 * MIB + 1] {
        let error = CycleLog::open(&store, bytes, u64::MAX).unwrap_err();
        assert!(matches!(error, Error::Size { .. }), "{error:?}");
        assert!(error.to_string().contains("bound of the log of cycles"), "{error}");
    }
}

/// The writer: writes until it is killed, and says which record was brought to the disk.
pub(crate) fn write(dir: &Path) {
    let log = open(dir);
    let id = loop_id("level-1");
    let last = all(&log, &id, Window::Last(1), false);
    let mut seq = last.last().map_or(0, |r| r.seq);
    loop {
        for _ in 0..20 {
            seq += 1;
            log.offer(record("level-1", 1, seq));
        }
        log.flush().unwrap();
        mortal::say(&format!("written {seq}"));
    }
}

#[test]
fn a_killed_writer_leaves_a_log_that_opens_and_has_what_was_written() {
    let dir = tempdir().unwrap();
    let id = loop_id("level-1");
    let mut written = 0_u64;
    for round in 0..12_u64 {
        let mut child = mortal::start("cycles", dir.path());
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let mut said = |line: String| {
            if let Some(seq) = line.strip_prefix("written ") {
                written = seq.parse().unwrap();
            }
            line.starts_with("written ")
        };
        let mut seen = 0;
        while seen < round % 4 + 1 {
            seen += u64::from(said(lines.next().expect("the child writes on").unwrap()));
        }
        // Spreads the kill over the next write; it waits for nothing.
        for _ in 0..(round * 7919 % 13) * 40_000 {
            std::hint::spin_loop();
        }
        child.kill().unwrap();
        child.wait().unwrap();
        lines.map_while(Result::ok).for_each(|line| {
            said(line);
        });
        let log = open(dir.path());
        let found = seqs(&log, &id, Window::Last(u64::MAX - 1), false);
        let last = found.last().copied().unwrap_or_default();
        assert!(last == written || last == written + 20, "{last} of {written}");
        assert_eq!(found, (1..=last).collect::<Vec<_>>());
        assert_eq!(log.counts().damaged, 0);
        written = last;
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Whatever is written when, a window of the last n is the end of everything.
    #[test]
    fn the_last_n_are_the_end(
        pieces in prop::collection::vec(1_u64..40, 1..8),
        flushed in prop::collection::vec(any::<bool>(), 8),
        n in 0_u64..200,
        before in any::<bool>(),
    ) {
        let dir = tempdir().unwrap();
        let log = open(dir.path());
        let id = loop_id("level-1");
        let mut total = 0;
        for (count, flush) in pieces.iter().zip(&flushed) {
            for _ in 0..*count {
                total += 1;
                log.offer(record("level-1", 1, total));
            }
            if *flush {
                log.flush().unwrap();
            }
        }
        let wanted = n + u64::from(before);
        let expected: Vec<u64> = (total.saturating_sub(wanted) + 1..=total).collect();
        prop_assert_eq!(seqs(&log, &id, Window::Last(n), before), expected);
    }
}

#[test]
fn cycles_older_than_they_are_kept_go() {
    let dir = tempdir().unwrap();
    let store = Store::open(dir.path()).unwrap();
    // A record every 10 ms; kept for a second.
    let log = CycleLog::open(&store, 16 * MIB, 1_000_000_000).unwrap();
    for seq in 1..=500 {
        log.offer(record("level-1", 1, seq));
        if seq % 50 == 0 {
            log.flush().unwrap();
        }
    }
    let left = seqs(&log, &loop_id("level-1"), Window::Last(u64::MAX - 1), false);
    assert_eq!((left.first(), left.last()), (Some(&351), Some(&500)));
}
