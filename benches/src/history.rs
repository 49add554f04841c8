//! What a cell's records said during a run: the live feed, followed by a thread of its own.
//!
//! Never: judges; and never the truth about the actuators, which is the journal's.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_core::indices::{Indices, Rule};
use bumpless_tests::{Api, Feed};
use parking_lot::Mutex;
use serde_json::Value;

use crate::{error::Error, report::Report};

/// Longest wait for anything that a cell has to do.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
/// Pause between two looks.
const LOOK: Duration = Duration::from_millis(2);
/// Longest silence of a feed, which says something every second.
const SILENCE: Duration = Duration::from_secs(10);

/// One record, as far as benches need it.
#[derive(Debug, Clone)]
pub(crate) struct Seen {
    pub(crate) loop_name: String,
    pub(crate) seq: u64,
    /// When the inputs were frozen, ns since 1970 on the plant's clock.
    pub(crate) at_ns: u64,
    pub(crate) digest: String,
    pub(crate) owner: String,
    pub(crate) stepped_by: String,
    pub(crate) setpoint: f64,
    pub(crate) measurement: f64,
    /// A replica was silent, and the next was asked.
    pub(crate) hedged: bool,
    /// The first record of an ownership.
    pub(crate) took_over: bool,
    /// The first record of another revision: output step beyond what the old controller would have done, in % of span.
    pub(crate) bump_percent: Option<f64>,
    /// A fault on probation sent the loop back.
    pub(crate) rolled_back: bool,
    /// A step ended with a fault.
    pub(crate) faulted: bool,
    /// A change is on probation.
    pub(crate) on_probation: bool,
}

impl Seen {
    fn of(record: &Value) -> Option<Self> {
        let text = |key: &str| record[key].as_str().map(str::to_owned);
        let events = record["events"].as_array().map(Vec::as_slice).unwrap_or_default();
        let kind = |kind: &str| events.iter().find(|event| event["kind"] == kind);
        Some(Self {
            loop_name: text("loop")?,
            seq: record["seq"].as_u64()?,
            at_ns: record["at_unix_us"].as_u64()? * 1000,
            digest: text("digest")?,
            owner: text("owner")?,
            stepped_by: text("stepped_by")?,
            setpoint: record["setpoint"].as_f64()?,
            measurement: record["measurement"].as_f64().unwrap_or(f64::NAN),
            hedged: kind("hedged").is_some(),
            took_over: kind("took-over").is_some(),
            bump_percent: kind("revised").map(|event| event["bump_percent"].as_f64().unwrap_or(f64::NAN)),
            rolled_back: kind("rolled-back").is_some(),
            faulted: kind("faulted").is_some(),
            on_probation: record["probation_cycles_left"].is_u64(),
        })
    }
}

#[cfg(test)]
impl Seen {
    /// A quiet cycle at this time, for tests.
    pub(crate) const fn of_cycle(at_ns: u64) -> Self {
        Self {
            loop_name: String::new(),
            seq: 1,
            at_ns,
            digest: String::new(),
            owner: String::new(),
            stepped_by: String::new(),
            setpoint: 40.0,
            measurement: 40.0,
            hedged: false,
            took_over: false,
            bump_percent: None,
            rolled_back: false,
            faulted: false,
            on_probation: false,
        }
    }
}

/// Records of a run, growing.
#[derive(Debug)]
pub(crate) struct History {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    seen: Mutex<Vec<Seen>>,
    lost: AtomicU64,
    stop: AtomicBool,
    ended: AtomicBool,
}

impl History {
    /// Follows these loops, from the feed of a host that stays up.
    pub(crate) fn follow(api: &Api, loops: &[&str]) -> Result<Self, Error> {
        let feed = api.live(&format!("?loops={}", loops.join(",")))?;
        let shared: Arc<Shared> = Arc::default();
        let thread = {
            let shared = Arc::clone(&shared);
            std::thread::Builder::new()
                .name("history".to_owned())
                .spawn(move || read(&feed, &shared))
                .map_err(Error::io("the feed's thread cannot be started"))?
        };
        Ok(Self {
            shared,
            thread: Some(thread),
        })
    }

    /// How many records there are now; a place to look from later.
    pub(crate) fn place(&self) -> usize {
        self.shared.seen.lock().len()
    }

    /// The last record of a loop.
    pub(crate) fn last(&self, loop_name: &str) -> Option<Seen> {
        let seen = self.shared.seen.lock();
        seen.iter().rev().find(|record| record.loop_name == loop_name).cloned()
    }

    /// Waits for a record after `place` that is as wanted.
    pub(crate) fn wait(&self, what: &str, place: usize, is: impl Fn(&Seen) -> bool) -> Result<Seen, Error> {
        let started = Instant::now();
        let mut from = place;
        loop {
            {
                let seen = self.shared.seen.lock();
                if let Some(found) = seen.iter().skip(from).find(|record| is(record)) {
                    return Ok(found.clone());
                }
                from = seen.len();
            }
            if started.elapsed() > PATIENCE || self.shared.ended.load(Ordering::Relaxed) {
                return Err(Error::Waited {
                    what: what.to_owned(),
                    seconds: started.elapsed().as_secs(),
                });
            }
            std::thread::sleep(LOOK);
        }
    }

    /// Waits until a host has stepped each of the loops after `place`.
    pub(crate) fn wait_steps(&self, loops: &[&str], host: &str, place: usize) -> Result<(), Error> {
        for name in loops {
            let what = format!("a step of {name} on {host}");
            self.wait(&what, place, |record| {
                record.loop_name == *name && record.stepped_by == host
            })?;
        }
        Ok(())
    }

    /// Everything after a place.
    pub(crate) fn since(&self, place: usize) -> Vec<Seen> {
        self.shared.seen.lock().iter().skip(place).cloned().collect()
    }

    /// Records of a loop that were frozen between the two times.
    pub(crate) fn between(&self, loop_name: &str, from_ns: u64, to_ns: u64) -> Vec<Seen> {
        let seen = self.shared.seen.lock();
        let wanted = |record: &&Seen| record.loop_name == loop_name && (from_ns..to_ns).contains(&record.at_ns);
        seen.iter().filter(wanted).cloned().collect()
    }

    /// In words, for people: the records of a loop around a pause, so that its cause can be found.
    pub(crate) fn around(&self, loop_name: &str, (from_ns, to_ns): (u64, u64)) -> String {
        let margin_ns = 20_000_000;
        let records = self.between(loop_name, from_ns.saturating_sub(margin_ns), to_ns + margin_ns);
        let words = records.iter().map(|record| {
            let flags = [
                (record.took_over, ", took over"),
                (record.hedged, ", hedged"),
                (record.bump_percent.is_some(), ", revised"),
                (record.rolled_back, ", rolled back"),
            ];
            let flags: String = flags.iter().filter(|(is, _)| *is).map(|(_, text)| *text).collect();
            let at_ms = (record.at_ns as f64 - from_ns as f64) / 1e6;
            format!(
                "{at_ms:+.1} ms: cycle {} by {} for {}{flags}",
                record.seq, record.stepped_by, record.owner
            )
        });
        words.collect::<Vec<_>>().join("; ")
    }

    /// Records that the feed was too slow for. The journal misses none of them.
    pub(crate) fn lost(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed)
    }
}

impl Drop for History {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // It looks at least once in the feed's longest silence.
            drop(thread.join());
        }
    }
}

fn read(feed: &Feed, shared: &Shared) {
    while !shared.stop.load(Ordering::Relaxed) {
        let Ok(event) = feed.next(SILENCE) else { break };
        match event.name.as_str() {
            "record" => {
                if let Some(seen) = Seen::of(&event.data) {
                    shared.seen.lock().push(seen);
                }
            }
            "lost" => {
                shared
                    .lost
                    .fetch_add(event.data["records"].as_u64().unwrap_or(1), Ordering::Relaxed);
            }
            _ => {}
        }
    }
    shared.ended.store(true, Ordering::Relaxed);
}

/// What the home counted of a loop so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Tally {
    /// Cycles that began and ended without a commit.
    pub(crate) lost: u64,
    /// Cycles that the home itself came too late for.
    pub(crate) skipped: u64,
    /// Changes of ownership after a silence.
    pub(crate) takeovers: u64,
}

impl Tally {
    /// Asks the home, or a host that knows it.
    pub(crate) fn ask(api: &Api, loop_name: &str) -> Result<Self, Error> {
        let view = api.loop_view(loop_name)?;
        let count = |key: &str| view["tally"][key].as_u64().unwrap_or(0);
        Ok(Self {
            lost: count("lost"),
            skipped: count("skipped"),
            takeovers: count("takeovers"),
        })
    }

    /// Both together.
    pub(crate) const fn and(self, other: Self) -> Self {
        Self {
            lost: self.lost + other.lost,
            skipped: self.skipped + other.skipped,
            takeovers: self.takeovers + other.takeovers,
        }
    }

    /// Tells what was counted since `before`, as it was counted: the machine's stalls are in it.
    pub(crate) fn tell_since(self, before: Self, report: &mut Report, name: &str) {
        for (key, now, then) in [
            ("cycles_without_commit", self.lost, before.lost),
            ("cycles_home_too_late", self.skipped, before.skipped),
            ("takeovers_counted", self.takeovers, before.takeovers),
        ] {
            report.told(&format!("{name}.home.{key}"), now.saturating_sub(then) as f64, "cycles");
        }
    }
}

/// Integral of the absolute error, in unit·s, of records in order.
pub(crate) fn iae(records: &[Seen]) -> f64 {
    let Some(first) = records.first() else { return f64::NAN };
    let mut indices = Indices::new(Rule::Trapezoid);
    for record in records {
        let t_s = record.at_ns.saturating_sub(first.at_ns) as f64 / 1e9;
        // What is not finite, or out of order, is no sample of an error.
        let _ = indices.add(t_s, record.setpoint, record.measurement);
    }
    indices.iae()
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_record_is_read_from_the_feed() {
        let record = json!({
            "loop": "l", "term": 2, "seq": 17, "at_unix_us": 5, "digest": "d", "owner": "a", "stepped_by": "b", "setpoint": 40.0,
            "measurement": 39.0,
            "events": [{"kind": "hedged", "replica": "c"}, {"kind": "revised", "bump_percent": 0.01}],
        });
        let seen = Seen::of(&record);
        assert_eq!(
            seen.as_ref().map(|s| (s.seq, s.at_ns, s.hedged, s.took_over)),
            Some((17, 5000, true, false))
        );
        assert_eq!(seen.and_then(|s| s.bump_percent), Some(0.01));
        assert!(Seen::of(&json!({"loop": "l"})).is_none());
    }

    #[test]
    fn the_error_is_integrated_over_the_records_times() {
        let record = |at_ns, measurement| Seen {
            loop_name: "l".to_owned(),
            measurement,
            ..Seen::of_cycle(at_ns)
        };
        let records = [
            record(1_000_000_000, 38.0),
            record(2_000_000_000, 42.0),
            record(4_000_000_000, 40.0),
        ];
        assert_eq!(iae(&records), 2.0 + 2.0);
        assert!(iae(&[]).is_nan());
    }
}
