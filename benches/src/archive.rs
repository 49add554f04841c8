//! `history`: what the long memory costs. Cycles a second that it takes, bytes on disk for each piece of a second, and how long a
//! day on a thousand columns takes from the disk.
//!
//! Never: a cell; the archive alone, as a host has it.

use std::{sync::Arc, time::Instant};

use bumpless_core::{
    Digest, HostId, LoopId, Mode, Reading, Record, Redundancy,
    history::{Layout, STEPS_NS, Series, overlay, step_for, thin},
};
use bumpless_store::{Archive, Bounds, HISTORY_ROWS_MAX, Lens, Store};

use crate::{
    Options,
    error::Error,
    report::{Bound, Report},
    spread::Spread,
    stall::Watch,
};

/// A day that begins at a whole quarter of an hour, in ns since 1970.
const BEGIN_NS: u64 = 1_700_000_100_000_000_000;
const DAY_NS: u64 = 86_400 * STEPS_NS[0];
/// Columns of the question.
const COLUMNS: u64 = 1_000;
/// Cycles between two flushes: half of what the queue holds.
const AT_ONCE: u64 = 8_192;
/// Time from cycle to cycle: 10 Hz.
const PERIOD_NS: u64 = 100_000_000;

/// Measures.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let folder = tempfile::tempdir().map_err(Error::io("a folder for the history"))?;
    let store = Store::open(folder.path())?;
    let bounds = Bounds {
        bytes_max: 1 << 30,
        keep_ns: [u64::MAX; STEPS_NS.len()],
    };
    let archive = Archive::open(&store, bounds)?;
    let layout = Arc::new(Layout {
        outputs: vec!["out".to_owned()],
        period_ns: PERIOD_NS,
    });
    archive.judge_by(Box::new(move |_| {
        Some(Lens {
            layout: Arc::clone(&layout),
            measured: Some(0),
        })
    }))?;
    let cycles = DAY_NS / PERIOD_NS / options.count(1, 8);
    report.progress(&format!(
        "{cycles} cycles of a loop at 10 Hz, as fast as they are taken"
    ));
    let watch = Watch::start();
    let template = template()?;
    let began = Instant::now();
    for n in 0..cycles {
        archive.offer(Arc::new(cycle(&template, n)));
        if n % AT_ONCE == AT_ONCE - 1 {
            archive.flush()?;
        }
    }
    archive.flush()?;
    let seconds = began.elapsed().as_secs_f64();
    archive.pack()?;
    report.figure(
        "history.in",
        cycles as f64 / seconds,
        "cycles/s",
        Bound::AtLeast(100_000.0),
    );
    let counts = archive.counts();
    report.figure(
        "history.in.dropped",
        counts.dropped as f64,
        "cycles",
        Bound::AtMost(0.0),
    );
    // All steps together, for each piece of a second: both curves are noise to the last bit, which packs worst.
    let rows = cycles * PERIOD_NS / STEPS_NS[0];
    report.figure(
        "history.disk",
        counts.bytes as f64 / rows as f64,
        "bytes/s",
        Bound::AtMost(80.0),
    );

    report.progress("a day on a thousand columns, from the disk");
    let series = Series::Loop(template.loop_id.clone());
    let window = (BEGIN_NS, BEGIN_NS + cycles * PERIOD_NS);
    let width_ns = (window.1 - window.0).div_ceil(COLUMNS);
    let step_ns = step_for(width_ns).unwrap_or(STEPS_NS[0]);
    let width_ns = width_ns.div_ceil(step_ns) * step_ns;
    let mut spread = Spread::new();
    let mut columns = 0;
    for _ in 0..options.count(1_000, 100) {
        let began = Instant::now();
        let found = archive.read(&series, window, step_ns, (true, HISTORY_ROWS_MAX))?;
        columns = thin(overlay(found.rows, window), width_ns).len();
        spread.add(u64::try_from(began.elapsed().as_nanos()).unwrap_or(u64::MAX));
    }
    let stalls = watch.finish();
    report.figure(
        "history.query.columns",
        columns as f64,
        "columns",
        Bound::AtLeast(500.0),
    );
    report.figure("history.query.p50", spread.us(0.5) / 1e3, "ms", Bound::AtMost(10.0));
    report.figure("history.query.p99", spread.us(0.99) / 1e3, "ms", Bound::AtMost(20.0));
    report.told("history.query.max", spread.max_us() / 1e3, "ms");
    stalls.tell(report, "history");
    archive.close()?;
    Ok(())
}

/// A number between 0 and 1 that looks like chance, from a number: splitmix64 by Sebastiano Vigna.
fn noise(n: u64) -> f64 {
    let mut z = n.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

/// The nth cycle.
fn cycle(template: &Record, n: u64) -> Record {
    let value = 50.0 + 10.0 * (n as f64 * 1e-4).sin() + noise(n);
    Record {
        seq: n + 1,
        after: (1, n),
        at_ns: BEGIN_NS + n * PERIOD_NS,
        readings: vec![Reading::good(value, 0)],
        outputs: vec![30.0 + 5.0 * noise(n / 3)],
        step_ns: 20_000 + (noise(n + 7) * 5_000.0) as u64,
        ..template.clone()
    }
}

fn template() -> Result<Record, Error> {
    let host = HostId::new("io")?;
    Ok(Record {
        loop_id: LoopId::new("pressure")?,
        term: 1,
        seq: 1,
        after: (0, 0),
        revision: 1,
        digest: Digest::of(b"pid"),
        home: host.clone(),
        owner: host.clone(),
        stepped_by: host,
        at_ns: BEGIN_NS,
        dt_ns: PERIOD_NS,
        mode: Mode::Automatic,
        setpoint: 50.0,
        manual: Vec::new(),
        readings: Vec::new(),
        heard: Vec::new(),
        wanted: Vec::new(),
        outputs: Vec::new(),
        state: Arc::from([]),
        faults_in_row: 0,
        probation: None,
        redundancy: Redundancy::default(),
        applied: Vec::new(),
        events: Vec::new(),
        alarms: Vec::new(),
        messages: Vec::new(),
        log: Vec::new(),
        step_ns: 20_000,
        cycle_ns: 100_000,
        committed_after_ns: 200_000,
    })
}
