//! What people should hear of, out of all records that pass: kept in a ring, numbered, told once when it begins.
//!
//! ```text
//! record ─► what it met ─ the loop's record before met the same ─► nothing new
//!                └ new ─► number ─► ring (NOTICES_MAX, the oldest goes) ─► readers, by number
//! ```
//! It reads the same bounded channel as a live feed does, so it never holds a cycle up; when it is too slow it misses records
//! and says so in its own words. It is memory, not a log: the log of cycles has everything. Never: an alarm system; it
//! repeats what controllers and cycles said.

use std::{
    collections::{BTreeMap, HashMap, VecDeque},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{SystemTime, UNIX_EPOCH},
};

use bumpless_core::{Event, LogLevel, LoopId, Priority, Record};
use tokio::sync::broadcast::error::RecvError;

use crate::{
    limits::{NOTICE_LOOPS_MAX, NOTICES_MAX, STANDING_MAX},
    server::App,
    types::{Notice, Notices as Told, PortTable, Weight},
};

/// What one thing is recognised by while it lasts.
type Key = (String, String);

#[derive(Default)]
struct Kept {
    ring: VecDeque<Arc<Notice>>,
    number: u64,
    /// What the last record of each loop met.
    lasting: HashMap<LoopId, Vec<Key>>,
    /// Alarms that are raised.
    standing: BTreeMap<(LoopId, String), Arc<Notice>>,
}

/// The ring.
pub(crate) struct Notices {
    kept: Mutex<Kept>,
    since_unix_ms: u64,
    /// Names this process's numbers.
    boot: u64,
}

impl Notices {
    pub(crate) fn new() -> Self {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self {
            kept: Mutex::default(),
            since_unix_ms: u64::try_from(now.as_millis()).unwrap_or_default(),
            boot: u64::try_from(now.as_micros()).unwrap_or_default(),
        }
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        // A poisoned ring is still a ring: each push is whole.
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Names this process's numbers: another process counts anew.
    pub(crate) const fn boot(&self) -> u64 {
        self.boot
    }

    /// The last number given.
    pub(crate) fn number(&self) -> u64 {
        self.kept().number
    }

    /// Those with a greater number, oldest first, the newest `max` of them.
    pub(crate) fn since(&self, number: u64, max: usize) -> Vec<Arc<Notice>> {
        newest(self.kept().ring.iter().filter(|notice| notice.number > number), max)
    }

    /// Those of later cycles, for a reader that knew another process.
    pub(crate) fn later_than(&self, at_unix_us: u64, max: usize) -> Vec<Arc<Notice>> {
        newest(
            self.kept().ring.iter().filter(|notice| notice.at_unix_us > at_unix_us),
            max,
        )
    }

    /// Everything that is kept, for an answer.
    pub(crate) fn told(&self, after: u64, max: usize) -> Told {
        let own = |notice: &Arc<Notice>| Notice::clone(notice);
        Told {
            notices: self.since(after, max).iter().map(own).collect(),
            standing: self.kept().standing.values().map(own).collect(),
            since_unix_ms: self.since_unix_ms,
        }
    }

    /// Takes up what a record met.
    pub(crate) fn take(&self, record: &Record, ports: &PortTable) {
        let met = of(record, ports);
        let mut kept = self.kept();
        let kept = &mut *kept;
        let before = kept.lasting.remove(&record.loop_id).unwrap_or_default();
        let mut lasting = Vec::new();
        for (weight, kind, subject, text) in met {
            let key = (kind.to_owned(), subject);
            // An alarm that is raised again is news; a limit that is still met is none.
            let again = before.contains(&key) && !kind.starts_with("alarm") && kind != "log";
            if !again {
                kept.number += 1;
                let notice = Arc::new(Notice {
                    number: kept.number,
                    text,
                    ..notice(record, weight, kind)
                });
                let name = (record.loop_id.clone(), key.1.clone());
                if kind == "alarm" && (kept.standing.len() < STANDING_MAX || kept.standing.contains_key(&name)) {
                    kept.standing.insert(name, Arc::clone(&notice));
                } else if kind == "alarm-cleared" {
                    kept.standing.remove(&name);
                }
                if kept.ring.len() >= NOTICES_MAX {
                    kept.ring.pop_front();
                }
                kept.ring.push_back(notice);
            }
            lasting.push(key);
        }
        if !lasting.is_empty() && kept.lasting.len() < NOTICE_LOOPS_MAX {
            kept.lasting.insert(record.loop_id.clone(), lasting);
        }
    }

    /// Follows the records until the host stops.
    pub(crate) async fn follow(app: App) {
        let mut records = app.cell.records();
        let mut stop = app.stop.clone();
        loop {
            let next = tokio::select! {
                biased;
                _ = stop.wait_for(|stop| *stop) => return,
                next = records.recv() => next,
            };
            match next {
                // The cheap look first: most cycles have nothing to tell, and nothing that could have ended.
                Ok(record) if is_quiet(&record) && !app.notices.lasts(&record.loop_id) => {}
                Ok(record) => app.notices.take(&record, &app.ports(&record.digest)),
                Err(RecvError::Lagged(missed)) => tracing::debug!(missed, "notices: records were missed"),
                Err(RecvError::Closed) => return,
            }
        }
    }

    fn lasts(&self, id: &LoopId) -> bool {
        self.kept().lasting.contains_key(id)
    }
}

fn newest<'a>(notices: impl DoubleEndedIterator<Item = &'a Arc<Notice>>, max: usize) -> Vec<Arc<Notice>> {
    let mut found: Vec<Arc<Notice>> = notices.rev().take(max).cloned().collect();
    found.reverse();
    found
}

fn is_quiet(record: &Record) -> bool {
    record.events.is_empty()
        && record.alarms.is_empty()
        && !record.log.iter().any(|line| line.level == LogLevel::Warning)
}

fn notice(record: &Record, weight: Weight, kind: &str) -> Notice {
    Notice {
        number: 0,
        at_unix_us: record.at_ns / 1_000,
        loop_name: record.loop_id.to_string(),
        term: record.term,
        seq: record.seq,
        weight,
        kind: kind.to_owned(),
        text: String::new(),
    }
}

/// What a record tells people, without numbers.
pub(crate) fn in_words(record: &Record, ports: &PortTable) -> Vec<Notice> {
    let one = |(weight, kind, _, text): (Weight, &str, String, String)| Notice {
        text,
        ..notice(record, weight, kind)
    };
    of(record, ports).into_iter().map(one).collect()
}

/// Weight, kind, what it is recognised by, and words.
fn of(record: &Record, ports: &PortTable) -> Vec<(Weight, &'static str, String, String)> {
    let mut met = Vec::new();
    for event in &record.events {
        met.push(match event {
            Event::TookOver { from: Some(from) } => (
                Weight::Info,
                "took-over",
                String::new(),
                format!("{} took over from {from}", record.owner),
            ),
            Event::TookOver { from: None } => (
                Weight::Info,
                "took-over",
                String::new(),
                format!("{} is the first owner", record.owner),
            ),
            Event::Hedged { replica } => (
                Weight::Info,
                "hedged",
                replica.to_string(),
                format!("{replica} did not answer in time; another replica was asked as well"),
            ),
            Event::Faulted { replica, fault } => (
                Weight::Warning,
                "faulted",
                replica.to_string(),
                format!("the step on {replica} failed: {fault}"),
            ),
            Event::PolicyHeld => (
                Weight::Urgent,
                "policy-held",
                String::new(),
                "no step was good: the loop's policy decides the output".to_owned(),
            ),
            Event::Revised {
                from, by, bump_percent, ..
            } => (
                Weight::Info,
                "revised",
                String::new(),
                format!(
                    "revision {from} gave way to {} ({by}), bump {bump_percent:.3} % of span",
                    record.revision
                ),
            ),
            Event::OverBump {
                bump_percent,
                limit_percent,
            } => (
                Weight::Warning,
                "over-bump",
                String::new(),
                format!(
                    "the switch moved the output by {bump_percent:.2} % of span; the loop allows {limit_percent} %"
                ),
            ),
            Event::RolledBack { from, reason } => (
                Weight::Urgent,
                "rolled-back",
                String::new(),
                format!("revision {from} was rolled back: {reason}"),
            ),
            Event::Limited(port) => (
                Weight::Info,
                "limited",
                ports.name(usize::from(*port)),
                format!("output {} met a limit", ports.name(usize::from(*port))),
            ),
            Event::RedundancyLost { have, want } => (
                Weight::Warning,
                "redundancy-lost",
                String::new(),
                format!("{have} of {want} replicas can step"),
            ),
            Event::RedundancyRestored { want } => (
                Weight::Info,
                "redundancy-restored",
                String::new(),
                format!("all {want} replicas can step again"),
            ),
            Event::Dissent { replica } => (
                Weight::Urgent,
                "dissent",
                replica.to_string(),
                format!("{replica} stepped otherwise than the majority, and has no vote now"),
            ),
            Event::Readmitted { replica } => (
                Weight::Info,
                "readmitted",
                replica.to_string(),
                format!("{replica} agreed often enough to vote again"),
            ),
            Event::NoMajority {
                answers,
                agreed,
                needed,
            } => (
                Weight::Urgent,
                "no-majority",
                String::new(),
                format!("{agreed} of {answers} answers agree, {needed} are needed"),
            ),
            Event::Forced(port) => (
                Weight::Warning,
                "forced",
                ports.name(usize::from(*port)),
                format!("{} is forced", ports.name(usize::from(*port))),
            ),
            Event::Unforced(port) => (
                Weight::Info,
                "unforced",
                ports.name(usize::from(*port)),
                format!("{} is forced no more", ports.name(usize::from(*port))),
            ),
            Event::BadInput(port) => (
                Weight::Urgent,
                "bad-input",
                ports.name(usize::from(*port)),
                format!("input {} is bad", ports.name(usize::from(*port))),
            ),
        });
    }
    for alarm in &record.alarms {
        met.push(match &alarm.raised {
            Some((priority, text)) => (
                match priority {
                    Priority::Low => Weight::Info,
                    Priority::Medium => Weight::Warning,
                    Priority::High => Weight::Urgent,
                },
                "alarm",
                alarm.name.clone(),
                format!("alarm {}: {text}", alarm.name),
            ),
            None => (
                Weight::Info,
                "alarm-cleared",
                alarm.name.clone(),
                format!("alarm {} is over", alarm.name),
            ),
        });
    }
    for line in record.log.iter().filter(|line| line.level == LogLevel::Warning) {
        met.push((Weight::Warning, "log", line.text.clone(), line.text.clone()));
    }
    met
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use bumpless_core::AlarmChange;

    use super::*;
    use crate::tests::fake::a_record;

    fn ports() -> PortTable {
        PortTable {
            names: vec!["pv".into(), "out".into()],
            outputs: vec!["out".into()],
            ..PortTable::default()
        }
    }

    fn take(notices: &Notices, seq: u64, events: Vec<Event>, alarms: Vec<AlarmChange>) {
        let record = Record {
            events,
            alarms,
            ..a_record("l", seq)
        };
        notices.take(&record, &ports());
    }

    #[test]
    fn what_lasts_is_told_when_it_begins_and_again_when_it_comes_back() {
        let notices = Notices::new();
        for (seq, limited) in [(1, true), (2, true), (3, false), (4, true)] {
            take(
                &notices,
                seq,
                if limited { vec![Event::Limited(1)] } else { vec![] },
                vec![],
            );
        }
        let told: Vec<(u64, u64)> = notices.since(0, 10).iter().map(|n| (n.number, n.seq)).collect();
        assert_eq!(told, [(1, 1), (2, 4)]);
        assert_eq!(notices.since(1, 10).len(), 1);
        assert_eq!(
            notices.since(0, 1)[0].number,
            2,
            "the newest where there is no room for all"
        );
    }

    #[test]
    fn alarms_stand_until_they_are_cleared() {
        let notices = Notices::new();
        let alarm = |raised: bool| AlarmChange {
            name: "high".into(),
            raised: raised.then(|| (Priority::High, "too high".into())),
        };
        take(&notices, 1, vec![], vec![alarm(true)]);
        let told = notices.told(0, 10);
        assert_eq!(told.standing.len(), 1);
        assert_eq!(
            (told.standing[0].weight, told.standing[0].text.as_str()),
            (Weight::Urgent, "alarm high: too high")
        );
        take(&notices, 2, vec![], vec![alarm(false)]);
        assert!(notices.told(0, 10).standing.is_empty());
        assert_eq!(notices.number(), 2);
    }

    #[test]
    fn the_ring_forgets_the_oldest() {
        let notices = Notices::new();
        for seq in 0..NOTICES_MAX as u64 + 5 {
            let from = (seq % 2 == 0).then(|| bumpless_core::HostId::new("a").unwrap());
            take(&notices, seq * 2, vec![Event::TookOver { from }], vec![]);
            take(&notices, seq * 2 + 1, vec![], vec![]);
        }
        let all = notices.since(0, usize::MAX);
        assert_eq!(all.len(), NOTICES_MAX);
        assert_eq!(all[0].number, 6);
    }
}
