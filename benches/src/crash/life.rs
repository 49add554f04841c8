//! One life of a process that writes into a host's stores: it does what a host does, and says what was promised to it.
//!
//! ```text
//!   open all ─► n: component, intent, rollout, force, setting, number, terms, alarms, audit entry, record, cycle, history ─► n+1 …
//!                  └ each that returns well is a line "kept KIND N" on the standard output; each that fails is tried anew next time
//! ```
//! Never: judges. `look` reads what is there afterwards, and `crash` judges.

#![allow(clippy::print_stdout, reason = "the lines are what the process is for")]

use std::{collections::BTreeMap, io::Write as _, path::Path, sync::Arc};

use bumpless_core::{
    Digest, HostId, Intent, LoopId, LoopSpec, Mode, PointId, Policy, Reading, Record, Redundancy, Strategy,
    history::{Layout, STEPS_NS, Series},
};
use bumpless_store::{
    AUDIT_BYTES_MAX, Archive, AuditLog, Bounds, CYCLE_BYTES_MAX, CycleLog, HISTORY_BYTES_MAX, Lens, RecordWriter, Store,
};

use super::layer::{CHANGES, Layer, Mishap};
use crate::error::Error;

/// Names of all things, in the order in which they are written.
pub(crate) const KINDS: [&str; 12] = [
    "component",
    "intent",
    "rollout",
    "force",
    "setting",
    "number",
    "terms",
    "alarm",
    "audit",
    "record",
    "cycle",
    "history",
];

/// Time from cycle to cycle.
const PERIOD_NS: u64 = 100_000_000;

/// A host's stores, all open.
pub(crate) struct Stores {
    pub(crate) archive: Archive,
    pub(crate) cycles: CycleLog,
    pub(crate) audit: AuditLog,
    pub(crate) found: bumpless_store::AuditFound,
    pub(crate) writer: RecordWriter,
    pub(crate) store: Store,
}

/// How one life is to be.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct Life {
    /// What happens to it.
    #[arg(long, value_enum)]
    pub(crate) mishap: Mishap,
    /// At which change.
    #[arg(long)]
    pub(crate) at: u64,
    /// Rounds of writing, then it ends by itself.
    #[arg(long)]
    pub(crate) rounds: u64,
    /// Number of its first round; greater than all before it.
    #[arg(long)]
    pub(crate) first: u64,
    /// For what is left to chance.
    #[arg(long)]
    pub(crate) seed: u64,
    /// What it takes for the date, in ns since 1970: dates jump between lives.
    #[arg(long)]
    pub(crate) date_ns: u64,
}

pub(crate) fn host() -> Result<HostId, Error> {
    Ok(HostId::new("io")?)
}

pub(crate) fn loop_id() -> Result<LoopId, Error> {
    Ok(LoopId::new("level-1")?)
}

pub(crate) fn series() -> Result<Series, Error> {
    Ok(Series::Loop(loop_id()?))
}

/// The bytes of a round: their length says which, and so does each of them.
pub(crate) fn component(n: u64) -> Vec<u8> {
    vec![(n % 251) as u8; 1 + usize::try_from(n % 20_011).unwrap_or_default()]
}

/// What stands in rows whose parts must be of one round.
pub(crate) fn row(n: u64) -> (u64, Vec<u64>) {
    (n, vec![n; usize::try_from(n % 40).unwrap_or_default()])
}

/// Opens everything that a host opens. The order of the fields is the order in which it is closed.
pub(crate) fn open(dir: &Path) -> Result<Stores, Error> {
    let store = Store::open(dir)?;
    let writer = RecordWriter::start(store.clone())?;
    let cycles = CycleLog::open(&store, *CYCLE_BYTES_MAX.start(), u64::MAX)?;
    let bounds = Bounds {
        bytes_max: *HISTORY_BYTES_MAX.start(),
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
    let (audit, found) = AuditLog::open(&store, &host()?, *AUDIT_BYTES_MAX.start())?;
    Ok(Stores {
        archive,
        cycles,
        audit,
        found,
        writer,
        store,
    })
}

fn spec(n: u64, digest: Digest) -> Result<LoopSpec, Error> {
    Ok(LoopSpec {
        id: loop_id()?,
        revision: 0,
        digest,
        period_ns: PERIOD_NS,
        ports: BTreeMap::from([("input".to_owned(), PointId::new("lt-1")?)]),
        parameters: BTreeMap::from([("gain".to_owned(), n as f64)]),
        setpoint: n as f64,
        setpoint_range: (-1.0e12, 1.0e12),
        mode: Mode::Automatic,
        strategy: Strategy::P2c,
        replicas: 3,
        limits: BTreeMap::new(),
        listens: Vec::new(),
        fallback: None,
        fallback_parameters: BTreeMap::new(),
        prefer: Vec::new(),
        policy: Policy::default(),
    })
}

fn record(n: u64, date_ns: u64) -> Result<Record, Error> {
    Ok(Record {
        loop_id: loop_id()?,
        term: 1,
        seq: n,
        after: (1, n.saturating_sub(1)),
        revision: 1,
        digest: Digest::of(b"pid"),
        home: host()?,
        owner: host()?,
        stepped_by: host()?,
        at_ns: date_ns,
        dt_ns: PERIOD_NS,
        mode: Mode::Automatic,
        setpoint: 50.0,
        manual: Vec::new(),
        readings: vec![Reading::good(n as f64, 0)],
        heard: Vec::new(),
        wanted: Vec::new(),
        outputs: vec![n as f64],
        state: Arc::from(n.to_le_bytes()),
        faults_in_row: 0,
        probation: None,
        redundancy: Redundancy::default(),
        applied: Vec::new(),
        events: Vec::new(),
        alarms: Vec::new(),
        messages: Vec::new(),
        log: Vec::new(),
        step_ns: 1_000,
        cycle_ns: 2_000,
        committed_after_ns: 3_000,
    })
}

/// Says that something is kept. One write, so that nobody reads half a line.
fn kept(kind: &str, n: u64) -> Result<(), Error> {
    let mut out = std::io::stdout();
    out.write_all(format!("kept {kind} {n}\n").as_bytes())
        .and_then(|()| out.flush())
        .map_err(Error::io("telling what is kept"))
}

/// The next revision of the intent, from what is on the disk.
fn revise(store: &Store, n: u64, digest: Digest) -> Result<u64, Error> {
    let wrong = |error: bumpless_core::IntentError| Error::Wish(format!("the intent: {error}"));
    let Some(mut held) = store.intent(&loop_id()?)? else {
        store.put_intent(&Intent::new(host()?, spec(n, digest)?, 0).map_err(wrong)?)?;
        return Ok(1);
    };
    let next = held.last_revision + 1;
    held.propose(spec(n, digest)?).map_err(wrong)?;
    held.commit(next).map_err(wrong)?;
    store.put_intent(&held)?;
    Ok(next)
}

/// One thing of a round. Gives the number that is kept by it.
fn write(stores: &Stores, kind: &str, n: u64, date_ns: u64) -> Result<u64, Error> {
    let store = &stores.store;
    match kind {
        "component" => drop(store.put_component(&component(n))?),
        "intent" => return revise(store, n, Digest::of(&component(n))),
        "rollout" => store.put_rollout(1, &row(n))?,
        "force" => store.put_force(&PointId::new("lt-1")?, &row(n))?,
        "setting" => store.set_host_value("crash", &row(n))?,
        "number" => return Ok(store.count_up("life")?),
        "terms" => store.set_aside_terms(n)?,
        "alarm" => store.keep_alarms(&[("level-1".to_owned(), row(n))], &[(n, row(n))])?,
        "audit" => {
            let begun = stores.audit.begin(&format!("{{\"round\":{n}}}"));
            let links = stores.audit.append(&[format!("{{\"round\":{n}}}")])?;
            drop(begun);
            return Ok(links.last().map_or(0, |link| link.number));
        }
        "record" => {
            stores.writer.offer(Arc::new(record(n, date_ns)?));
            stores.writer.flush()?;
        }
        "cycle" => {
            stores.cycles.offer(Arc::new(record(n, date_ns)?));
            stores.cycles.flush()?;
        }
        _ => {
            stores.archive.offer(Arc::new(record(n, date_ns)?));
            stores.archive.flush()?;
            if n.is_multiple_of(5) {
                stores.archive.pack()?;
            }
        }
    }
    Ok(n)
}

/// Lives. Returns only where nothing ended it; the last line is then how many changes it made.
///
/// # Errors
/// What keeps it from opening its stores, where the disk was not told to fail.
pub(crate) fn live(dir: &Path, attic: &Path, life: &Life) -> Result<(), Error> {
    // What an earlier life kept has no use any more, and has the names that this one gives.
    match std::fs::remove_dir_all(attic) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            return Err(Error::io("emptying the folder of removed files")(error));
        }
        _ => {}
    }
    std::fs::create_dir(attic).map_err(Error::io("a folder for removed files"))?;
    let layer = Layer::new(life.mishap, life.at, life.seed, attic);
    if !bumpless_store::interfere(Box::new(layer)) {
        return Err(Error::Wish("somebody interferes already".to_owned()));
    }
    let refuses = matches!(life.mishap, Mishap::Full | Mishap::Frozen);
    let stores = match open(dir) {
        // A disk that refuses may refuse that; what counts is what is there later.
        Err(_) if refuses => return Ok(()),
        other => other?,
    };
    for round in 0..life.rounds {
        let (n, date_ns) = (life.first + round, life.date_ns + round * PERIOD_NS);
        let mut has_component = false;
        for kind in KINDS {
            // As deployment does it: what is not there is not put in force.
            if kind == "intent" && !has_component {
                continue;
            }
            match write(&stores, kind, n, date_ns) {
                Ok(number) => {
                    has_component |= kind == "component";
                    kept(kind, number)?;
                }
                Err(_) if refuses => {}
                Err(error) => return Err(error),
            }
        }
    }
    let Stores {
        archive,
        cycles,
        writer,
        ..
    } = stores;
    let ends = [archive.close(), cycles.close(), writer.close()];
    if !refuses {
        ends.into_iter().collect::<Result<Vec<()>, _>>()?;
    }
    println!("changes {}", CHANGES.load(std::sync::atomic::Ordering::Relaxed));
    Ok(())
}
