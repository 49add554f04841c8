//! Who is in the cell and where each listens, by each one's own word and by that of those who met it. Pure.
//!
//! Owns: the table of lives, whom to name to others, when to call one that is not met, and when to give a link up. Never: calls anybody; reads a clock;
//! decides how often the roll is called (`core/chatter`).
//!
//! ```text
//!  own word, or a third's ─► known ── its token is there ──────────────────────────► met
//!                              │ ▲                                                    │
//!                              │ └───────────────── its token is gone ◄───────────────┘
//!                              ├─ not met for 2 s (7 s at the lesser of the two lives) ─► called, again after 1, 2, 4, 8, 10, 10 … s
//!                              │      └─ a link is there, for 3 s, and no token ─► the link is closed, and made anew
//!                              └─ named by nobody for 10 minutes ─► forgotten
//! ```
//! Zenoh tries a link for ever only where its far end is in `connect`. Two hosts that know each other through a third get one
//! attempt when the third tells of them, and none after a cut that outlasts the lease. The roll gives them further ones.
//! A cut that only one of the two noticed leaves the other with a link that it believes whole: a new one becomes part of it, and what it
//! declared once it does not declare again. The one that sees a link and no token closes it, for both.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use bumpless_core::HostId;
use serde::{Deserialize, Serialize};

use crate::{keys::Instance, wire::Letter};

/// Hosts that one call names besides its sender: a call stays near 4 KiB, and in a cell of 64 hosts each of the others names each
/// every 20 s.
const NAMED_MAX: usize = 16;
/// Lives that are known at a time; a further one is left out until one is forgotten. Four times the hosts that a cell is made for.
const KNOWN_MAX: usize = 256;
/// Locators of one life: a host listens on a few addresses.
const LOCATORS_MAX: usize = 8;
/// Bytes of one locator.
const LOCATOR_BYTES_MAX: usize = 256;
/// Bytes of an encoded call.
const ROLL_CALL_BYTES_MAX: usize = 64 * 1024;
/// Lives that are called in one look. Each attempt may take 10 s per locator, on Zenoh's own threads.
const CALLED_MAX: usize = 4;

/// Zenoh's own first attempts come before ours.
const PATIENCE: Duration = Duration::from_secs(2);
/// The lesser of two lives waits longer: connections that cross close each other. It calls at all because one of the two may not
/// be reachable.
const PATIENCE_OF_THE_LESSER: Duration = Duration::from_secs(7);
/// First and longest pause between two calls.
const PAUSES: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(10));
/// A link over which no token has come for so long is deaf. Tokens come with the first messages of a link.
const DEAF_AFTER: Duration = Duration::from_secs(3);
/// A life that nobody has named for so long is over.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(600);

/// One life of a host, and where it listens.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Entry {
    /// Whose.
    pub(crate) host: HostId,
    /// Which life.
    pub(crate) instance: Instance,
    /// As Zenoh locators, such as `tcp/10.0.0.5:7447`.
    pub(crate) locators: Vec<String>,
}

/// What a host says every five seconds, in a large cell less often.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct RollCall {
    /// Itself.
    pub(crate) own: Entry,
    /// Some of those whose token it sees, in turn.
    pub(crate) met: Vec<Entry>,
}

impl Letter for RollCall {
    const NAME: &'static str = "roll call";
    const BYTES_MAX: usize = ROLL_CALL_BYTES_MAX;
    fn check(&self) -> Result<(), String> {
        if self.met.len() > NAMED_MAX {
            return Err(format!(
                "it names {} hosts, at most {NAMED_MAX} are allowed",
                self.met.len()
            ));
        }
        self.met.iter().chain([&self.own]).try_for_each(Entry::check)
    }
}

impl Entry {
    fn check(&self) -> Result<(), String> {
        let host = &self.host;
        if !self.instance.is_sound() {
            return Err(format!("the instance of {host} is not 32 hexadecimal digits"));
        }
        if self.locators.len() > LOCATORS_MAX || self.locators.iter().any(|l| l.len() > LOCATOR_BYTES_MAX) {
            return Err(format!(
                "{host} has more than {LOCATORS_MAX} locators, or one of more than {LOCATOR_BYTES_MAX} bytes"
            ));
        }
        Ok(())
    }

    /// With as many of the locators as a call may hold.
    pub(crate) fn new(host: HostId, instance: Instance, locators: &[String]) -> Self {
        let fitting = locators.iter().filter(|l| l.len() <= LOCATOR_BYTES_MAX);
        Self {
            host,
            instance,
            locators: fitting.take(LOCATORS_MAX).cloned().collect(),
        }
    }
}

#[derive(Debug)]
struct Known {
    entry: Entry,
    named_at: Instant,
    missing: Option<Missing>,
}

/// Since when a life is not met, and how it is called.
#[derive(Debug)]
struct Missing {
    call_at: Instant,
    pause: Duration,
    /// Since when a link to it is there all the same.
    linked_at: Option<Instant>,
}

/// The lives that this host knows of.
#[derive(Debug)]
pub(crate) struct Roll {
    own: Instance,
    known: BTreeMap<Instance, Known>,
    /// Who was named last.
    last_named: Option<Instance>,
}

impl Roll {
    /// Of the host whose life this is.
    pub(crate) const fn new(own: Instance) -> Self {
        Self {
            own,
            known: BTreeMap::new(),
            last_named: None,
        }
    }

    /// Somebody called the roll. What a host says of itself goes before what others say of it.
    pub(crate) fn hear(&mut self, call: RollCall, now: Instant) {
        self.note(call.own, true, now);
        for entry in call.met {
            self.note(entry, false, now);
        }
    }

    fn note(&mut self, entry: Entry, by_itself: bool, now: Instant) {
        if entry.instance == self.own {
            return;
        }
        if let Some(known) = self.known.get_mut(&entry.instance) {
            known.named_at = now;
            if by_itself {
                known.entry = entry;
            }
        } else if self.known.len() < KNOWN_MAX {
            let instance = entry.instance.clone();
            let known = Known {
                entry,
                named_at: now,
                missing: None,
            };
            self.known.insert(instance, known);
        }
    }

    /// The next of those who are met, for the next call: each has its turn.
    pub(crate) fn name(&mut self, is_met: impl Fn(&Entry) -> bool) -> Vec<Entry> {
        let met: Vec<&Entry> = self.known.values().map(|k| &k.entry).filter(|e| is_met(e)).collect();
        let after = self.last_named.as_ref();
        let first = met.iter().position(|e| after.is_none_or(|last| e.instance > *last));
        let turn = met.iter().cycle().skip(first.unwrap_or(0));
        let named: Vec<Entry> = turn.take(NAMED_MAX.min(met.len())).map(|e| (*e).clone()).collect();
        self.last_named = named.last().map(|entry| entry.instance.clone());
        named
    }

    /// Whom to call now. Those whose turn it is and who do not fit have it at the next look.
    pub(crate) fn due(&mut self, now: Instant, is_met: impl Fn(&Entry) -> bool) -> Vec<Entry> {
        self.known
            .retain(|_, known| now.saturating_duration_since(known.named_at) < FORGOTTEN_AFTER);
        let mut due = Vec::new();
        for (instance, known) in &mut self.known {
            if is_met(&known.entry) {
                known.missing = None;
                continue;
            }
            let missing = known.missing.get_or_insert_with(|| Missing {
                call_at: now
                    + if self.own > *instance {
                        PATIENCE
                    } else {
                        PATIENCE_OF_THE_LESSER
                    },
                pause: PAUSES.0,
                linked_at: None,
            });
            if now >= missing.call_at && !known.entry.locators.is_empty() && due.len() < CALLED_MAX {
                missing.call_at = now + missing.pause;
                missing.pause = (2 * missing.pause).min(PAUSES.1);
                due.push(known.entry.clone());
            }
        }
        due
    }

    /// One that was called is linked now, or is not. Is the link deaf, and to be closed?
    pub(crate) fn called(&mut self, instance: &Instance, is_linked: bool, now: Instant) -> bool {
        let Some(missing) = self.known.get_mut(instance).and_then(|known| known.missing.as_mut()) else {
            return false;
        };
        if !is_linked {
            missing.linked_at = None;
            return false;
        }
        let linked_at = *missing.linked_at.get_or_insert(now);
        let is_deaf = now.saturating_duration_since(linked_at) >= DEAF_AFTER;
        if is_deaf {
            *missing = Missing {
                call_at: now + PAUSES.0,
                pause: PAUSES.0,
                linked_at: None,
            };
        }
        is_deaf
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn entry(number: u64) -> Entry {
        let host = HostId::new(format!("h{number}")).unwrap();
        Entry::new(host, Instance::new(0, number), &[format!("tcp/10.0.0.{number}:7447")])
    }

    fn call(own: u64, met: &[u64]) -> RollCall {
        RollCall {
            own: entry(own),
            met: met.iter().map(|number| entry(*number)).collect(),
        }
    }

    fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn one_that_a_third_has_met_is_called_until_it_is_met() {
        let start = Instant::now();
        let mut roll = Roll::new(Instance::new(0, 9));
        roll.hear(call(1, &[2, 9]), start);
        let mut called = Vec::new();
        for second in 0..40 {
            let due = roll.due(start + s(second), |e| *e == entry(1));
            assert!(due.iter().all(|e| *e == entry(2)));
            called.extend(due.iter().map(|_| second));
        }
        assert_eq!(called, [2, 3, 5, 9, 17, 27, 37]);
        // Met, and lost again: with patience anew.
        assert!(roll.due(start + s(40), |_| true).is_empty());
        assert!(roll.due(start + s(50), |e| *e == entry(1)).is_empty());
        assert_eq!(roll.due(start + s(52), |e| *e == entry(1)), [entry(2)]);
    }

    #[test]
    fn a_link_without_a_token_is_given_up_and_made_anew() {
        let start = Instant::now();
        let two = Instance::new(0, 2);
        let mut roll = Roll::new(Instance::new(0, 9));
        roll.hear(call(2, &[]), start);
        assert!(!roll.called(&two, true, start), "nobody misses it");
        assert!(roll.due(start, |_| false).is_empty());
        assert!(!roll.called(&two, true, start + s(2)));
        assert!(!roll.called(&two, true, start + s(4)));
        assert!(roll.called(&two, true, start + s(5)));
        assert_eq!(roll.due(start + s(6), |_| false), [entry(2)]);
        // A link that comes and goes is not deaf.
        assert!(!roll.called(&two, true, start + s(6)));
        assert!(!roll.called(&two, false, start + s(8)));
        assert!(!roll.called(&two, true, start + s(10)));
        assert!(!roll.called(&Instance::new(0, 3), true, start + s(60)));
    }

    #[test]
    fn the_lesser_of_two_waits_longer_and_a_host_that_does_not_listen_is_not_called() {
        let start = Instant::now();
        let mut roll = Roll::new(Instance::new(0, 1));
        roll.hear(call(2, &[]), start);
        let silent = Entry::new(HostId::new("mute").unwrap(), Instance::new(0, 3), &[]);
        roll.hear(
            RollCall {
                own: silent,
                met: Vec::new(),
            },
            start,
        );
        for second in 0..7 {
            assert!(roll.due(start + s(second), |_| false).is_empty());
        }
        assert_eq!(roll.due(start + s(7), |_| false), [entry(2)]);
    }

    #[test]
    fn who_is_named_by_nobody_is_forgotten() {
        let start = Instant::now();
        let mut roll = Roll::new(Instance::new(0, 9));
        roll.hear(call(1, &[2]), start);
        assert!(roll.due(start, |_| false).is_empty());
        roll.hear(call(1, &[]), start + s(500));
        assert_eq!(roll.due(start + s(600), |_| false), [entry(1)]);
        assert_eq!(roll.known.len(), 1);
    }

    #[test]
    fn each_has_its_turn_and_those_not_met_are_not_named() {
        let start = Instant::now();
        let mut roll = Roll::new(Instance::new(0, 1000));
        for number in 0..40 {
            roll.hear(call(number, &[]), start);
        }
        let is_met = |e: &Entry| *e != entry(5);
        let mut named: Vec<Entry> = (0..3).flat_map(|_| roll.name(is_met)).collect();
        assert_eq!(named.len(), 3 * NAMED_MAX);
        named.sort_by(|a, b| a.instance.cmp(&b.instance));
        named.dedup();
        assert_eq!(named.len(), 39);
        assert!(!named.contains(&entry(5)));
        assert!(Roll::new(Instance::new(0, 1)).name(|_| true).is_empty());
    }

    #[test]
    fn the_table_and_the_calls_have_their_limits() {
        let start = Instant::now();
        let mut roll = Roll::new(Instance::new(u64::MAX, 0));
        for number in 0..1000 {
            roll.hear(call(number, &[]), start);
        }
        assert_eq!(roll.known.len(), KNOWN_MAX);
        assert!(roll.due(start, |_| false).is_empty());
        let first = roll.due(start + s(2), |_| false);
        assert_eq!(first.len(), CALLED_MAX);
        assert!(roll.due(start + s(2), |_| false).iter().all(|e| !first.contains(e)));

        let mut long = call(1, &[]);
        long.own.locators = vec!["x".repeat(LOCATOR_BYTES_MAX + 1)];
        assert!(long.check().unwrap_err().contains("h1 has more than 8 locators"));
        let many: Vec<u64> = (0..17).collect();
        assert!(call(1, &many).check().unwrap_err().contains("17 hosts"));
        assert!(call(1, &many[..16]).check().is_ok());
    }
}
