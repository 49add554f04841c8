//! The history against real files: what was taken is read back, a kill costs half a second, the bound holds, damage stays local,
//! and a full disk is borne.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::{
    io::{BufRead as _, BufReader, Write as _},
    path::Path,
    sync::Arc,
};

use bumpless_core::{
    Mode, PointId, Reading as Value, Record,
    history::{Layout, Row, STEPS_NS},
};
use proptest::prelude::*;
use tempfile::tempdir;

use super::{Archive, Bounds, Disk, Lens, ROWS_MAX, block::tests::series};
use crate::{
    Error, Store,
    tests::{mortal, samples::record},
};

const S: u64 = STEPS_NS[0];
const MIB: u64 = 1024 * 1024;
/// A whole quarter of an hour, so that pieces begin where cycles do.
const BEGIN_NS: u64 = 1_700_000_100_000_000_000;

const KEEP: Bounds = Bounds {
    bytes_max: 64 * MIB,
    keep_ns: [u64::MAX; STEPS_NS.len()],
};

fn lens(_: &Record) -> Option<Lens> {
    Some(Lens {
        layout: Arc::new(Layout {
            outputs: vec!["out".into()],
            period_ns: S / 10,
        }),
        measured: Some(0),
    })
}

fn open_with(dir: &Path, bounds: Bounds, prepare: impl FnOnce(&mut Disk)) -> Archive {
    let archive = Archive::open_with(&Store::open(dir).unwrap(), bounds, prepare).unwrap();
    archive.judge_by(Box::new(lens)).unwrap();
    archive
}

fn open(dir: &Path) -> Archive {
    open_with(dir, KEEP, |_| {})
}

/// What the nth cycle writes, and whether an operator decided it.
fn written(n: u64) -> (f64, bool) {
    let value = (n as f64 * 0.01).sin() * 30.0 + (n * 7919 % 101) as f64 * 0.01;
    (value * 0.5, n % 1000 >= 500)
}

/// The nth cycle, 100 ms after the one before.
fn cycle(name: &str, n: u64) -> Arc<Record> {
    let (value, manual) = written(n);
    Arc::new(Record {
        at_ns: BEGIN_NS + n * (S / 10),
        readings: vec![Value::good(value * 2.0, 0)],
        outputs: vec![value],
        mode: if manual { Mode::Manual } else { Mode::Automatic },
        ..(*record(name, 1, n + 1)).clone()
    })
}

/// Offers some cycles, in pieces that the queue holds.
fn offer(archive: &Archive, name: &str, range: std::ops::Range<u64>) {
    for (i, n) in range.enumerate() {
        archive.offer(cycle(name, n));
        if i % 8_000 == 7_999 {
            archive.flush().unwrap();
        }
    }
    archive.flush().unwrap();
}

fn read(archive: &Archive, name: &str, level: usize) -> Vec<Row> {
    let step_ns = STEPS_NS[level];
    let found = archive
        .read(&series(name), (0, u64::MAX), step_ns, (false, ROWS_MAX))
        .unwrap();
    found.rows.into_iter().filter(|row| row.step_ns == step_ns).collect()
}

/// Every piece of every step says what the cycles of its time say.
fn holds(archive: &Archive, name: &str, total: u64) {
    for (level, step_ns) in STEPS_NS.into_iter().enumerate() {
        let rows = read(archive, name, level);
        let per_row = step_ns / (S / 10);
        assert_eq!(rows.len() as u64, total.div_ceil(per_row), "level {level}");
        for (i, row) in rows.iter().enumerate() {
            let of = i as u64 * per_row..((i as u64 + 1) * per_row).min(total);
            let values: Vec<f64> = of.clone().map(|n| written(n).0).collect();
            let bucket = &row.bucket;
            assert_eq!(row.start_ns(), BEGIN_NS + i as u64 * step_ns);
            assert_eq!(bucket.cycles, values.len() as u64, "level {level}, piece {i}");
            let manual = of.filter(|n| written(*n).1).count() as u64;
            assert_eq!((bucket.manual, bucket.lost, bucket.bad), (manual, 0, 0));
            let (least, greatest) = (
                values.iter().copied().reduce(f64::min),
                values.iter().copied().reduce(f64::max),
            );
            assert_eq!(
                (bucket.outputs[0].least(), bucket.outputs[0].greatest()),
                (least, greatest)
            );
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            assert!(
                (bucket.outputs[0].mean().unwrap() - mean).abs() < 1e-6,
                "level {level}, piece {i}"
            );
        }
    }
}

#[test]
fn what_was_taken_is_read_back_whether_it_waits_or_is_packed_and_over_restarts() {
    let dir = tempdir().unwrap();
    let archive = open(dir.path());
    offer(&archive, "level-1", 0..7_003);
    holds(&archive, "level-1", 7_003);
    archive.pack().unwrap();
    holds(&archive, "level-1", 7_003);
    // In the middle of a second, and of every other piece.
    offer(&archive, "level-1", 7_003..12_011);
    drop(archive);
    let archive = open(dir.path());
    holds(&archive, "level-1", 12_011);
    archive.pack().unwrap();
    offer(&archive, "level-1", 12_011..13_000);
    archive.close().unwrap();
    let archive = open(dir.path());
    holds(&archive, "level-1", 13_000);
    let found = archive
        .read(&series("level-1"), (0, u64::MAX), 0, (false, ROWS_MAX))
        .unwrap();
    assert_eq!(found.to_ns, u64::MAX);
    let changes: u64 = read(&archive, "level-1", 3)
        .iter()
        .map(|row| row.bucket.mode_changes)
        .sum();
    assert_eq!(changes, 13_000 / 500 - 1);
    assert_eq!(archive.counts().cut_bytes, 0);
}

#[test]
fn windows_points_and_what_is_not_kept() {
    let dir = tempdir().unwrap();
    let archive = open(dir.path());
    offer(&archive, "level-1", 0..1_000);
    let window = (BEGIN_NS + 15 * S, BEGIN_NS + 25 * S);
    let of = |overlapping| {
        let found = archive
            .read(&series("level-1"), window, 10 * S, (overlapping, ROWS_MAX))
            .unwrap();
        let rows = found.rows.iter().filter(|row| row.step_ns == 10 * S);
        rows.map(|row| (row.start_ns() - BEGIN_NS) / S).collect::<Vec<_>>()
    };
    assert_eq!((of(false), of(true)), (vec![20], vec![10, 20]));
    // Too many for one answer: it says how far it goes, and the next one goes on from there.
    let part = archive.read(&series("level-1"), (0, u64::MAX), S, (false, 30)).unwrap();
    assert_eq!(part.to_ns, BEGIN_NS + 30 * S);
    assert_eq!(part.rows.iter().filter(|row| row.step_ns == S).count(), 30);
    // The same record again, or an older one, is passed over.
    archive.offer(cycle("level-1", 999));
    archive.offer(cycle("level-1", 3));
    archive.flush().unwrap();
    holds(&archive, "level-1", 1_000);
    let id = PointId::new("tt-1").unwrap();
    for i in 0..5 {
        archive.offer_point(id.clone(), BEGIN_NS + i * (S / 5), Some(i as f64), i == 4, S / 5);
    }
    archive.flush().unwrap();
    let point = bumpless_core::history::Series::Point(id);
    let rows = archive.read(&point, (0, u64::MAX), S, (false, ROWS_MAX)).unwrap().rows;
    let bucket = &rows[0].bucket;
    assert_eq!((bucket.cycles, bucket.bad, bucket.setpoint.count), (5, 1, 0));
    assert_eq!(
        (bucket.measurement.mean(), bucket.measurement.greatest()),
        (Some(2.0), Some(4.0))
    );
    assert_eq!(archive.series().len(), 2);
    archive.judge_by(Box::new(|_| None)).unwrap();
    archive.offer(cycle("other", 1));
    archive.flush().unwrap();
    assert!(!archive.has(&series("other")));
    for bytes_max in [0, u64::MAX] {
        let other = tempdir().unwrap();
        let bounds = Bounds { bytes_max, ..KEEP };
        let refused = Archive::open(&Store::open(other.path()).unwrap(), bounds);
        assert!(matches!(refused, Err(Error::Size { .. })), "{refused:?}");
    }
}

fn bytes_of(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().metadata().unwrap().len()).sum()
}

#[test]
fn the_bound_holds_and_the_finest_goes_first() {
    let dir = tempdir().unwrap();
    let bounds = Bounds { bytes_max: MIB, ..KEEP };
    let archive = open_with(dir.path(), bounds, |_| {});
    let cycles = 18_000;
    for hour in 0..60_u64 {
        offer(&archive, "level-1", hour * cycles..(hour + 1) * cycles);
        archive.pack().unwrap();
        let bytes = bytes_of(&dir.path().join("history"));
        assert!(bytes <= MIB, "{bytes} bytes after {hour} turns");
        assert_eq!(archive.counts().bytes, bytes);
    }
    let total = 60 * cycles;
    assert!(archive.counts().removed_files > 10, "{:?}", archive.counts());
    let begins: Vec<u64> = (0..4)
        .map(|level| read(&archive, "level-1", level)[0].start_ns())
        .collect();
    assert!(
        begins[0] > BEGIN_NS && begins[2] == BEGIN_NS && begins[3] == BEGIN_NS,
        "{begins:?}"
    );
    assert!(begins.windows(2).all(|pair| pair[0] >= pair[1]), "{begins:?}");
    // What went from the finer steps is whole in the coarse ones.
    for level in [2, 3] {
        let kept: u64 = read(&archive, "level-1", level)
            .iter()
            .map(|row| row.bucket.cycles)
            .sum();
        assert_eq!(kept, total, "level {level}");
    }
    drop(archive);
    let archive = open_with(dir.path(), bounds, |_| {});
    let kept: u64 = read(&archive, "level-1", 3).iter().map(|row| row.bucket.cycles).sum();
    assert_eq!(kept, total, "after a restart");
}

#[test]
fn what_is_older_than_it_is_kept_goes() {
    let dir = tempdir().unwrap();
    let keep_ns = [600 * S, 6_000 * S, u64::MAX, u64::MAX];
    let archive = open_with(dir.path(), Bounds { keep_ns, ..KEEP }, |_| {});
    for turn in 0..60 {
        offer(&archive, "level-1", turn * 1_000..(turn + 1) * 1_000);
        archive.pack().unwrap();
    }
    let first = |level| (read(&archive, "level-1", level)[0].start_ns() - BEGIN_NS) / S;
    // 6,000 s in all; files span an eighth of what is kept, and a turn is 100 s.
    assert!((5_100..=5_400).contains(&first(0)), "{}", first(0));
    assert_eq!((first(1), first(3)), (0, 0));
}

#[test]
fn a_cut_end_is_cut_away_and_said_and_a_damaged_block_skipped() {
    let dir = tempdir().unwrap();
    let folder = dir.path().join("history");
    let archive = open(dir.path());
    offer(&archive, "level-1", 0..2_000);
    archive.pack().unwrap();
    offer(&archive, "level-1", 2_000..4_000);
    drop(archive);
    let file = |start: &str| {
        let mut names = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path());
        names
            .find(|path| path.file_name().unwrap().to_str().unwrap().starts_with(start))
            .unwrap()
    };
    // Half a frame, as a process leaves it that dies in a write.
    let half = |path: &Path| {
        let mut file = std::fs::OpenOptions::new().append(true).open(path).unwrap();
        file.write_all(&[3, 0, 0, 0, 0, 200, 1]).unwrap();
    };
    half(&file("journal-"));
    half(&file("1s-"));
    let archive = open(dir.path());
    assert_eq!(archive.counts().cut_bytes, 14);
    holds(&archive, "level-1", 4_000);
    archive.close().unwrap();
    // The second entry of the journal: what follows it counts for nothing.
    let path = file("journal-");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() - 3]).unwrap();
    let archive = open(dir.path());
    assert!(archive.counts().cut_bytes > 0);
    assert!(read(&archive, "level-1", 0).len() >= 200);
    archive.close().unwrap();
    // A bit in the body of the first packed block.
    let path = file("1s-");
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let archive = open(dir.path());
    let left = read(&archive, "level-1", 0);
    assert!(archive.counts().damaged > 0);
    assert!(left.iter().all(|row| row.start_ns() >= BEGIN_NS + 200 * S));
    // The coarser steps have lost nothing that was packed in them or can be made anew.
    archive.close().unwrap();
    std::fs::write(file("1s-"), b"no file of ours").unwrap();
    let archive = open(dir.path());
    offer(&archive, "level-1", 4_000..4_100);
    assert!(read(&archive, "level-1", 0).len() >= 10);
    drop(archive);
    assert!(file("1s-").exists());
}

#[test]
fn a_full_disk_costs_nothing_that_memory_holds() {
    let dir = tempdir().unwrap();
    let room = Arc::new(std::sync::atomic::AtomicU64::new(20_000));
    let archive = open_with(dir.path(), KEEP, |disk| disk.room = Some(Arc::clone(&room)));
    let mut refused = 0;
    for turn in 0..20 {
        for n in turn * 300..(turn + 1) * 300 {
            archive.offer(cycle("level-1", n));
        }
        match archive.flush().and_then(|()| archive.pack()) {
            Ok(()) => {}
            Err(Error::Io { cure, .. }) => {
                assert!(cure.contains("disk is full"));
                refused += 1;
            }
            Err(other) => panic!("{other}"),
        }
    }
    assert!(refused > 3, "{refused}");
    assert!(archive.counts().failing && archive.counts().failed_writes > 3);
    holds(&archive, "level-1", 6_000);
    room.store(u64::MAX / 2, std::sync::atomic::Ordering::SeqCst);
    archive.flush().unwrap();
    archive.pack().unwrap();
    assert!(!archive.counts().failing);
    archive.close().unwrap();
    holds(&open(dir.path()), "level-1", 6_000);
}

/// The writer: offers cycles in step with real time, 2,000 a second with the times of ten a second, and says what it offered.
pub(crate) fn write(dir: &Path) {
    let archive = open(dir);
    let mut n = read(&archive, "level-1", 0)
        .iter()
        .map(|row| row.bucket.cycles)
        .sum::<u64>();
    loop {
        archive.offer(cycle("level-1", n));
        n += 1;
        if n.is_multiple_of(100) {
            archive.flush().unwrap();
            if n.is_multiple_of(700) {
                archive.pack().unwrap();
            }
            mortal::say(&format!("kept {n}"));
        }
    }
}

#[test]
fn a_killed_process_keeps_everything_that_was_written_and_nothing_half() {
    let dir = tempdir().unwrap();
    for round in 0..14_u64 {
        let mut child = mortal::start("history", dir.path());
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let mut kept = 0;
        for _ in 0..(1 + round * 5 % 23) {
            let line = lines.by_ref().map(|line| line.expect("the child writes on"));
            let mut told = line.filter_map(|line| line.strip_prefix("kept ").map(|n| n.parse::<u64>().unwrap()));
            kept = told.next().unwrap();
        }
        // The spin spreads the kill over the next writes; it is not there to wait for anything.
        for _ in 0..(round * 7919 % 13) * 40_000 {
            std::hint::spin_loop();
        }
        child.kill().unwrap();
        child.wait().unwrap();
        for line in lines.map_while(Result::ok) {
            if let Some(n) = line.strip_prefix("kept ") {
                kept = n.parse().unwrap();
            }
        }
        let archive = open(dir.path());
        let there: u64 = read(&archive, "level-1", 0).iter().map(|row| row.bucket.cycles).sum();
        // What was written after it spoke last may be there too; at most half a second of it, which is how often it writes.
        assert!(there >= kept, "round {round}: {there} of {kept}");
        holds(&archive, "level-1", there);
        archive.close().unwrap();
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    /// However it is written, packed, closed and opened: each cycle is in each step once.
    #[test]
    fn each_cycle_is_in_each_step_once(acts in prop::collection::vec((0_u8..4, 1_u64..900), 1..14)) {
        let dir = tempdir().unwrap();
        let mut archive = Some(open(dir.path()));
        let mut n = 0;
        for (act, count) in acts {
            let held = archive.take().unwrap();
            offer(&held, "level-1", n..n + count);
            n += count;
            archive = Some(match act {
                0 => {
                    held.pack().unwrap();
                    held
                }
                1 => held,
                _ => {
                    held.close().unwrap();
                    open(dir.path())
                }
            });
        }
        holds(archive.as_ref().unwrap(), "level-1", n);
    }
}
