//! `page`: what the operator's page costs: the browser that shows it, and the cycles beside it.
//!
//! ```text
//! 50 loops at 10 Hz on four hosts
//!   one page in a browser, for minutes ─► first paint, bytes, frames, processor, memory
//!   rounds: nobody reads ─► 30 read ─► … ─► the cycles' lateness with readers over that without
//! ```
//! The readers ask the host that serves the points, which has the most to do. Each reads the feed as a page does, with the trace
//! of a loop. Never: judges a round by the mean; lateness is from the deadline to the write, 99 of 100.

use std::{
    path::Path,
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use bumpless_tests::{Api, Cell, CellOptions, Feed, first_order_loop};
use serde::Deserialize;

use crate::{
    Options,
    error::Error,
    report::{Bound, Report},
    spread::{Spread, median},
    stall::Watch,
};

/// Loops on the page.
const LOOPS: usize = 50;
/// Their period, in ms.
const PERIOD_MS: f64 = 100.0;
/// Who reads at once.
const READERS: usize = 30;
/// Loops whose cycles are looked at afterwards, and their distance.
const LOOKED_AT: usize = 10;
/// Time between the start of readers and the part of a round that counts.
const SETTLE: Duration = Duration::from_secs(3);
/// Longest wait for the first event of a reader.
const FIRST_MAX: Duration = Duration::from_secs(20);

/// How it is measured.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct Watching {
    /// For so many minutes is one page open.
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
}

/// What the browser's side found.
#[derive(Debug, Deserialize)]
struct Seen {
    first_paint_ms: f64,
    bytes: f64,
    frames_per_s: f64,
    frames_p1_per_s: f64,
    cores: f64,
    heap_start_mb: f64,
    heap_end_mb: f64,
    resident_mb: f64,
}

/// Runs it.
pub(crate) fn run(options: Options, watching: Watching, report: &mut Report) -> Result<(), Error> {
    let stalls = Watch::start();
    let fopdt = format!("{{ count = {LOOPS}, gain = 1.0, tau_s = 2.0, dead_time_s = 0.2, noise = 0.05 }}");
    let mut cell = Cell::start(CellOptions::first_order(&fopdt))?;
    let api = cell.api()?;
    api.upload_stock(&["pid"])?;
    for n in 0..LOOPS {
        api.apply(&first_order_loop(n, "pid", PERIOD_MS))?;
    }
    let base = api.base().to_owned();

    let minutes = if options.quick {
        watching.minutes.min(0.5)
    } else {
        watching.minutes
    };
    report.progress(&format!("one page for {minutes} minutes"));
    let seen = browser(&base, minutes * 60.0)?.wait()?;
    report.figure("page.first_paint", seen.first_paint_ms, "ms", Bound::AtMost(1_000.0));
    report.figure("page.bytes", seen.bytes / 1e3, "kB", Bound::AtMost(300.0));
    report.figure("page.frames", seen.frames_per_s, "1/s", Bound::AtLeast(25.0));
    report.told("page.frames_worst_second", seen.frames_p1_per_s, "1/s");
    report.figure("page.processor", seen.cores, "cores", Bound::AtMost(1.0));
    report.told("page.memory", seen.resident_mb, "MB");
    report.told("page.heap_at_first", seen.heap_start_mb, "MB");
    let growth = seen.heap_end_mb - seen.heap_start_mb;
    report.figure("page.heap_growth", growth, "MB", Bound::AtMost(20.0));

    let round = Duration::from_secs(options.count(20, 8));
    let (mut without, mut with) = (Vec::new(), Vec::new());
    for n in 0..options.count(5, 2) {
        report.progress(&format!("round {n}: nobody, then {READERS} readers"));
        without.push(late_us(&api, round)?);
        let readers = readers(&base)?;
        with.push(late_us(&api, round)?);
        let events: usize = readers.iter().map(|reader| reader.drain().len()).sum();
        report.told(&format!("page.round{n}.events"), events as f64, "events");
        drop(readers);
    }
    let (without, with) = (median(&without), median(&with));
    report.told("page.lateness_without_readers_p99", without, "us");
    report.told("page.lateness_with_readers_p99", with, "us");
    report.figure("page.lateness_ratio", with / without, "1", Bound::AtMost(1.1));
    let lost: f64 = (0..LOOPS)
        .map(|n| api.loop_view(&format!("loop-{n}")))
        .collect::<Result<Vec<_>, _>>()?
        .iter()
        .filter_map(|view| view["tally"]["lost"].as_f64())
        .sum();
    report.figure("page.cycles_lost", lost, "cycles", Bound::AtMost(0.0));
    stalls.finish().tell(report, "page");
    Ok(())
}

/// Thirty that read as a page does.
fn readers(base: &str) -> Result<Vec<Feed>, Error> {
    let mut readers = Vec::new();
    for n in 0..READERS {
        let url = format!("{base}/v1/live?form=rows&every_ms=200&trace=loop-{}", n % LOOPS);
        let reader = Feed::open(&url, None)?;
        reader.next(FIRST_MAX)?;
        readers.push(reader);
    }
    Ok(readers)
}

fn now_us() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(now.as_micros()).unwrap_or_default()
}

/// From deadline to write over a round, 99 of 100, in µs; from the log, after the round, so that looking costs it nothing.
fn late_us(api: &Api, round: Duration) -> Result<f64, Error> {
    thread::sleep(SETTLE);
    let from = now_us();
    let started = Instant::now();
    thread::sleep(round);
    let to = now_us();
    let mut spread = Spread::new();
    for n in (0..LOOPS).step_by(LOOPS / LOOKED_AT) {
        let view = api.get(&format!(
            "/v1/loops/loop-{n}/cycles?from_unix_us={from}&to_unix_us={to}"
        ))?;
        for record in view["records"].as_array().into_iter().flatten() {
            if let Some(us) = record["committed_after_us"].as_f64() {
                spread.add((us * 1e3) as u64);
            }
        }
    }
    if spread.count() == 0 {
        return Err(Error::Waited {
            what: "a recorded cycle".to_owned(),
            seconds: started.elapsed().as_secs(),
        });
    }
    Ok(spread.us(0.99))
}

/// A browser at work.
struct Browser(Child);

fn browser(base: &str, seconds: f64) -> Result<Browser, Error> {
    let browser = xtask::page::browser().map_err(|error| Error::Said {
        who: "the browser".to_owned(),
        said: error.to_string(),
        expected: "to be installed",
    })?;
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/ui");
    let child = Command::new("node")
        .arg("tests/watch.mjs")
        .arg(base)
        .arg(format!("{seconds}"))
        .arg(browser)
        .current_dir(folder)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(Error::io("node cannot be run"))?;
    Ok(Browser(child))
}

impl Browser {
    fn wait(self) -> Result<Seen, Error> {
        let output = self.0.wait_with_output().map_err(Error::io("node broke off"))?;
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let last = text.lines().last().unwrap_or_default();
        serde_json::from_str(last).map_err(|_| Error::Said {
            who: "host/ui/tests/watch.mjs".to_owned(),
            said: last.chars().take(200).collect(),
            expected: "what it saw, as JSON",
        })
    }
}
