//! Histograms and counts of single loops, from the records of their cycles.
//!
//! A loop is observed at its home, which orders its records, so the sum over all hosts counts each cycle once. Records come by the
//! live feed, long after the cycle has gone on: nothing here can make one late. Never: more loops than [`METRIC_TIMED_LOOPS_MAX`],
//! or a loop that is gone.

use std::{
    collections::HashMap,
    sync::{Mutex, PoisonError},
};

use bumpless_core::{Event, LoopId, Record};
use prometheus_client::{
    metrics::{counter::Counter, family::Family, histogram::Histogram},
    registry::{Registry, Unit},
};

use super::Labels;
use crate::limits::METRIC_TIMED_LOOPS_MAX;

/// Upper bounds for times of a loop, in s: from what a good machine does to what stops a 10 Hz loop.
const TIMES_S: [f64; 12] = [
    20e-6, 50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3, 200e-3,
];

/// The core's own words for a step beyond its limit; a fault comes as text.
const OVERRAN: &str = "ran past its limit";

fn times() -> Histogram {
    Histogram::new(TIMES_S)
}

type Times = Family<Labels, Histogram, fn() -> Histogram>;

/// A loop that is observed: its place in each family, so that no label is written anew for a cycle.
struct Observed {
    step: Histogram,
    jitter: Histogram,
    commit: Histogram,
    overruns: Counter,
    /// Number and time of the cycle before, in ns of the home's clock.
    before: Option<(u64, u64)>,
    period_ns: u64,
    revision: u64,
}

/// All loops that are observed.
pub(super) struct Loops {
    step: Times,
    jitter: Times,
    commit: Times,
    overruns: Family<Labels, Counter>,
    events: Family<Labels, Counter>,
    observed: Mutex<HashMap<LoopId, Observed>>,
}

fn labels(id: &LoopId) -> Labels {
    vec![("loop".to_owned(), id.to_string())]
}

/// What an event is called: the same words as in a record over the API.
const fn name(event: &Event) -> &'static str {
    match event {
        Event::TookOver { .. } => "took-over",
        Event::Hedged { .. } => "hedged",
        Event::Faulted { .. } => "faulted",
        Event::PolicyHeld => "policy-held",
        Event::Revised { .. } => "revised",
        Event::OverBump { .. } => "over-bump",
        Event::RolledBack { .. } => "rolled-back",
        Event::Limited(_) => "limited",
        Event::BadInput(_) => "bad-input",
        Event::RedundancyLost { .. } => "redundancy-lost",
        Event::RedundancyRestored { .. } => "redundancy-restored",
        Event::Dissent { .. } => "dissent",
        Event::Readmitted { .. } => "readmitted",
        Event::NoMajority { .. } => "no-majority",
        Event::Forced(_) => "forced",
        Event::Unforced(_) => "unforced",
    }
}

impl Loops {
    pub(super) fn new() -> Self {
        Self {
            step: Family::new_with_constructor(times),
            jitter: Family::new_with_constructor(times),
            commit: Family::new_with_constructor(times),
            overruns: Family::default(),
            events: Family::default(),
            observed: Mutex::default(),
        }
    }

    pub(super) fn register(&self, registry: &mut Registry) {
        registry.register_with_unit(
            "loop_step",
            "Time of a loop's step as its owner saw it, network included",
            Unit::Seconds,
            self.step.clone(),
        );
        registry.register_with_unit(
            "loop_jitter",
            "Distance of the time between two cycles in a row from the loop's period, either way",
            Unit::Seconds,
            self.jitter.clone(),
        );
        registry.register_with_unit(
            "loop_commit",
            "Time from a loop's deadline to the actuator's write",
            Unit::Seconds,
            self.commit.clone(),
        );
        registry.register(
            "loop_overruns",
            "Cycles in which a step ran past its limit",
            self.overruns.clone(),
        );
        registry.register("loop_events", "What cycles met, by kind", self.events.clone());
    }

    fn with<T>(&self, work: impl FnOnce(&mut HashMap<LoopId, Observed>) -> T) -> T {
        work(&mut self.observed.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Observes a record of a loop at home here. `period_ns` is asked for when the loop or its revision is new.
    pub(super) fn observe(&self, record: &Record, period_ns: impl FnOnce() -> Option<u64>) {
        self.with(|observed| {
            if !observed.contains_key(&record.loop_id) {
                if observed.len() >= METRIC_TIMED_LOOPS_MAX {
                    return;
                }
                let labels = labels(&record.loop_id);
                let new = Observed {
                    step: self.step.get_or_create_owned(&labels),
                    jitter: self.jitter.get_or_create_owned(&labels),
                    commit: self.commit.get_or_create_owned(&labels),
                    overruns: self.overruns.get_or_create_owned(&labels),
                    before: None,
                    period_ns: 0,
                    revision: 0,
                };
                observed.insert(record.loop_id.clone(), new);
            }
            let Some(one) = observed.get_mut(&record.loop_id) else {
                return;
            };
            if one.revision != record.revision {
                // Another revision may have another period; where it is not known yet, the next record asks again.
                let Some(period_ns) = period_ns() else { return };
                (one.revision, one.period_ns, one.before) = (record.revision, period_ns, None);
            }
            one.step.observe(record.step_ns as f64 * 1e-9);
            one.commit.observe(record.committed_after_ns as f64 * 1e-9);
            let now = (record.seq, record.at_ns);
            if let Some((seq, at_ns)) = one.before.replace(now)
                && seq + 1 == record.seq
            {
                let between_ns = record.at_ns.saturating_sub(at_ns);
                one.jitter.observe(between_ns.abs_diff(one.period_ns) as f64 * 1e-9);
            }
            for event in &record.events {
                let overran = |fault: &str| fault.contains(OVERRAN);
                if matches!(event, Event::Faulted { fault, .. } if overran(fault)) {
                    one.overruns.inc();
                }
                let mut labels = labels(&record.loop_id);
                labels.push(("event".to_owned(), name(event).to_owned()));
                self.events.get_or_create(&labels).inc();
            }
        });
    }

    /// Forgets loops that are not at home here any more.
    pub(super) fn keep(&self, is_home: impl Fn(&LoopId) -> bool) {
        let gone: Vec<LoopId> = self.with(|observed| {
            let gone: Vec<LoopId> = observed.keys().filter(|id| !is_home(id)).cloned().collect();
            for id in &gone {
                observed.remove(id);
            }
            gone
        });
        for id in gone {
            let mut labels = labels(&id);
            for family in [&self.step, &self.jitter, &self.commit] {
                family.remove(&labels);
            }
            self.overruns.remove(&labels);
            for event in EVENTS {
                labels.push(("event".to_owned(), event.to_owned()));
                self.events.remove(&labels);
                labels.pop();
            }
        }
    }
}

/// Every kind of event.
const EVENTS: [&str; 16] = [
    "took-over",
    "hedged",
    "faulted",
    "policy-held",
    "revised",
    "over-bump",
    "rolled-back",
    "limited",
    "bad-input",
    "redundancy-lost",
    "redundancy-restored",
    "dissent",
    "readmitted",
    "no-majority",
    "forced",
    "unforced",
];

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use prometheus_client::encoding::text::encode;

    use super::*;
    use crate::tests::fake::a_record;

    fn text(loops: &Loops) -> String {
        let mut registry = Registry::default();
        loops.register(&mut registry);
        let mut text = String::new();
        encode(&mut text, &registry).unwrap();
        text
    }

    /// Jitter of cycles at these times, numbered from 1, with a period of 1,000 ns.
    fn cycles(loops: &Loops, rows: &[(u64, u64)]) {
        for &(seq, at_ns) in rows {
            let record = Record {
                at_ns,
                ..a_record("l", seq)
            };
            loops.observe(&record, || Some(1_000_000));
        }
    }

    #[test]
    fn jitter_is_the_distance_from_the_period_between_neighbours() {
        let loops = Loops::new();
        // On time, 30 µs late, 30 µs early again, one lost in between (which is no jitter).
        cycles(
            &loops,
            &[(1, 0), (2, 1_000_000), (3, 2_030_000), (4, 3_000_000), (6, 5_000_000)],
        );
        let text = text(&loops);
        for line in [
            "loop_jitter_seconds_count{loop=\"l\"} 3",
            "loop_jitter_seconds_bucket{le=\"0.00002\",loop=\"l\"} 1",
            "loop_jitter_seconds_bucket{le=\"0.00005\",loop=\"l\"} 3",
            "loop_step_seconds_count{loop=\"l\"} 5",
        ] {
            assert!(text.contains(line), "{line}\n{text}");
        }
    }

    #[test]
    fn overruns_and_events_are_counted_and_a_loop_that_is_gone_leaves_nothing() {
        let loops = Loops::new();
        let fault = bumpless_core::Fault::Overrun { limit_us: 5 }.to_string();
        let record = Record {
            events: vec![
                Event::Faulted {
                    replica: bumpless_core::HostId::new("h").unwrap(),
                    fault,
                },
                Event::PolicyHeld,
            ],
            ..a_record("l", 1)
        };
        loops.observe(&record, || Some(1_000));
        let before = text(&loops);
        for line in [
            "loop_overruns_total{loop=\"l\"} 1",
            "loop_events_total{loop=\"l\",event=\"faulted\"} 1",
            "loop_events_total{loop=\"l\",event=\"policy-held\"} 1",
        ] {
            assert!(before.contains(line), "{line}\n{before}");
        }
        assert!(record.events.iter().all(|event| EVENTS.contains(&name(event))));
        loops.keep(|_| false);
        assert!(!text(&loops).contains("loop=\"l\""), "{}", text(&loops));
    }

    #[test]
    fn the_number_of_loops_is_bounded() {
        let loops = Loops::new();
        for n in 0..=METRIC_TIMED_LOOPS_MAX {
            loops.observe(&a_record(&format!("l{n}"), 1), || Some(1_000));
        }
        assert_eq!(loops.with(|observed| observed.len()), METRIC_TIMED_LOOPS_MAX);
    }
}
