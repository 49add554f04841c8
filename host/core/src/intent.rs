//! A loop's intent: which revision shall run, which one is on its way, and which ones ran before.
//!
//! ```text
//!   new ──► current ──propose──► current + pending ──commit──► current (the old one goes to past)
//!                                       │
//!                                       └──withdraw──► current (the number is used up)
//!   current ──commit of a past revision (rollback)──► that one is current, the one left goes to past
//! ```
//!
//! Owns: the numbering of revisions. A number is given once and never again, so a late command that names a withdrawn
//! revision finds nothing instead of something else. Never: decides whether a revision is good; that is deployment's.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use crate::{
    digest::Digest,
    name::{HostId, LoopId},
    spec::LoopSpec,
};

/// Past revisions that an intent keeps. A shift of tuning by hand makes a dozen; more belongs to the audit trail.
pub const PAST_REVISIONS_MAX: usize = 16;

/// What shall run for one loop. Kept by the loop's home, copied to every host of the cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Intent {
    /// The loop.
    pub loop_id: LoopId,
    /// The I/O host that owns its points and keeps its time.
    pub home: HostId,
    /// The revision in force.
    pub current: LoopSpec,
    /// The revision on its way in, if there is one.
    pub pending: Option<LoopSpec>,
    /// The revisions left, the one left last first; at most [`PAST_REVISIONS_MAX`].
    pub past: Vec<LoopSpec>,
    /// The greatest revision number that was ever given for this loop.
    pub last_revision: u64,
    /// Grows with each change, so that of two copies the newer one is known.
    pub changes: u64,
}

/// Why an intent was not changed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum IntentError {
    /// The specification is another loop's.
    #[error("the specification is of loop {spec:?}, the intent of loop {intent:?}")]
    OtherLoop {
        /// The loop of the specification.
        spec: LoopId,
        /// The loop of the intent.
        intent: LoopId,
    },
    /// A revision is on its way.
    #[error("revision {0} is still on its way: wait until it is in force, or withdraw it")]
    Busy(u64),
    /// No such revision.
    #[error("loop {loop_id:?} has no revision {revision}; it has {known}")]
    Unknown {
        /// The loop.
        loop_id: LoopId,
        /// The number asked for.
        revision: u64,
        /// The numbers that exist.
        known: String,
    },
    /// Only what is on its way can be withdrawn.
    #[error("revision {0} is not on its way, so it cannot be withdrawn: roll back to an earlier one instead")]
    NotPending(u64),
    /// The revision numbers are used up.
    #[error("loop {0:?} has used all revision numbers: create it under another name")]
    Exhausted(LoopId),
}

impl Intent {
    /// A new loop's intent: `spec` is in force at once, as revision `after + 1`. `after` is 0, or the last revision of a
    /// removed loop of the same name, so that the old loop's copies stay older than the new loop's.
    ///
    /// # Errors
    /// [`IntentError::Exhausted`] when `after` is the greatest number there is.
    pub fn new(home: HostId, mut spec: LoopSpec, after: u64) -> Result<Self, IntentError> {
        let revision = after
            .checked_add(1)
            .ok_or_else(|| IntentError::Exhausted(spec.id.clone()))?;
        spec.revision = revision;
        Ok(Self {
            loop_id: spec.id.clone(),
            home,
            current: spec,
            pending: None,
            past: Vec::new(),
            last_revision: revision,
            changes: 0,
        })
    }

    /// Puts `spec` on its way and gives it the next revision number, which is returned. Its own `revision` is ignored.
    ///
    /// # Errors
    /// [`IntentError::OtherLoop`], [`IntentError::Busy`] while another revision is on its way, [`IntentError::Exhausted`].
    pub fn propose(&mut self, mut spec: LoopSpec) -> Result<u64, IntentError> {
        if spec.id != self.loop_id {
            return Err(IntentError::OtherLoop {
                spec: spec.id,
                intent: self.loop_id.clone(),
            });
        }
        if let Some(pending) = &self.pending {
            return Err(IntentError::Busy(pending.revision));
        }
        let revision = self
            .last_revision
            .checked_add(1)
            .ok_or_else(|| IntentError::Exhausted(self.loop_id.clone()))?;
        spec.revision = revision;
        self.last_revision = revision;
        self.pending = Some(spec);
        self.changed();
        Ok(revision)
    }

    /// A record with `revision` was committed: that revision is in force now. Says whether that changed anything, so the
    /// caller knows whether to keep it on disk. A past revision may come back so: that is a rollback, and what was on its
    /// way stays on its way.
    ///
    /// # Errors
    /// [`IntentError::Unknown`].
    pub fn commit(&mut self, revision: u64) -> Result<bool, IntentError> {
        if self.current.revision == revision {
            return Ok(false);
        }
        let next = if self.pending.as_ref().is_some_and(|p| p.revision == revision) {
            self.pending.take()
        } else {
            let place = self.past.iter().position(|p| p.revision == revision);
            place.map(|place| self.past.remove(place))
        };
        let Some(next) = next else {
            return Err(self.unknown(revision));
        };
        let left = std::mem::replace(&mut self.current, next);
        self.past.insert(0, left);
        self.past.truncate(PAST_REVISIONS_MAX);
        self.changed();
        Ok(true)
    }

    /// Takes back the revision that is on its way, and returns it.
    ///
    /// # Errors
    /// [`IntentError::NotPending`] for one that is or was in force, [`IntentError::Unknown`].
    pub fn withdraw(&mut self, revision: u64) -> Result<LoopSpec, IntentError> {
        match self.pending.take() {
            Some(pending) if pending.revision == revision => {
                self.changed();
                Ok(pending)
            }
            other => {
                self.pending = other;
                let known = self.find(revision).is_some();
                Err(if known {
                    IntentError::NotPending(revision)
                } else {
                    self.unknown(revision)
                })
            }
        }
    }

    /// The loop has another home from now on; what was on its way is not any more. `skipped` revision numbers are passed over,
    /// for those that the home before gave out and could not tell of.
    pub fn adopt(&mut self, home: HostId, skipped: u64) {
        self.home = home;
        self.pending = None;
        self.last_revision = self.last_revision.saturating_add(skipped);
        self.changed();
    }

    /// A revision: in force, on its way, or past.
    #[must_use]
    pub fn find(&self, revision: u64) -> Option<&LoopSpec> {
        self.revisions().find(|spec| spec.revision == revision)
    }

    /// Where "back" leads: the revision left last among those older than the one in force. The revision that a rollback
    /// left is newer, so going back twice never leads forth again.
    #[must_use]
    pub fn previous(&self) -> Option<&LoopSpec> {
        self.past.iter().find(|spec| spec.revision < self.current.revision)
    }

    /// All revisions there are: in force, on its way, then the past ones.
    pub fn revisions(&self) -> impl Iterator<Item = &LoopSpec> {
        std::iter::once(&self.current).chain(&self.pending).chain(&self.past)
    }

    /// Every component that this loop may need: those of all revisions there are, and their fallbacks. Any of these revisions can
    /// be gone back to for as long as its components are there.
    #[must_use]
    pub fn components(&self) -> BTreeSet<Digest> {
        self.revisions()
            .flat_map(|spec| std::iter::once(spec.digest).chain(spec.fallback))
            .collect()
    }

    /// Where this copy stands among the copies of the loop's intent: the greater one is newer. It holds across the removal
    /// and new creation of a loop, because revision numbers go on.
    #[must_use]
    pub const fn position(&self) -> (u64, u64) {
        (self.last_revision, self.changes)
    }

    fn changed(&mut self) {
        // 2^64 changes are out of reach; saturating keeps the copy at least as new as it was.
        self.changes = self.changes.saturating_add(1);
    }

    fn unknown(&self, revision: u64) -> IntentError {
        let known = self
            .revisions()
            .map(|s| s.revision.to_string())
            .collect::<Vec<_>>()
            .join(", ");
        IntentError::Unknown {
            loop_id: self.loop_id.clone(),
            revision,
            known,
        }
    }
}

/// A plain specification for tests of this crate.
#[cfg(test)]
pub(crate) fn test_spec() -> LoopSpec {
    use crate::{Digest, Mode, Policy, Strategy};
    LoopSpec {
        id: LoopId::new("level-1").expect("valid"),
        revision: 99,
        digest: Digest::of(b"pid"),
        period_ns: 10_000_000,
        ports: std::collections::BTreeMap::new(),
        parameters: std::collections::BTreeMap::new(),
        setpoint: 0.0,
        setpoint_range: (0.0, 100.0),
        mode: Mode::Automatic,
        strategy: Strategy::Local,
        replicas: 3,
        limits: std::collections::BTreeMap::new(),
        listens: Vec::new(),
        fallback: None,
        fallback_parameters: std::collections::BTreeMap::new(),
        prefer: vec![],
        policy: Policy::default(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn spec(setpoint: f64) -> LoopSpec {
        LoopSpec {
            setpoint,
            ..test_spec()
        }
    }

    fn intent() -> Intent {
        Intent::new(HostId::new("io-1").unwrap(), spec(1.0), 0).unwrap()
    }

    fn numbers(intent: &Intent) -> (u64, Option<u64>, Vec<u64>) {
        let past = intent.past.iter().map(|s| s.revision).collect();
        (
            intent.current.revision,
            intent.pending.as_ref().map(|s| s.revision),
            past,
        )
    }

    #[test]
    fn a_new_home_is_newer_than_whatever_the_old_one_could_not_tell() {
        let (mut old, mut new) = (intent(), intent());
        new.adopt(HostId::new("io-2").unwrap(), 100);
        for _ in 0..9 {
            let revision = old.propose(spec(2.0)).unwrap();
            old.withdraw(revision).unwrap();
        }
        assert!(new.position() > old.position() && new.pending.is_none());
        assert_eq!(new.propose(spec(3.0)).unwrap(), 102);
    }

    #[test]
    fn a_revision_is_proposed_then_committed_once() {
        let mut intent = intent();
        assert_eq!(intent.propose(spec(2.0)), Ok(2));
        assert_eq!(numbers(&intent), (1, Some(2), vec![]));
        assert_eq!(intent.commit(2), Ok(true));
        assert_eq!(intent.commit(2), Ok(false));
        assert_eq!(numbers(&intent), (2, None, vec![1]));
        assert_eq!(intent.find(1).unwrap().setpoint, 1.0);
        assert_eq!(intent.find(2).unwrap().setpoint, 2.0);
    }

    #[test]
    fn a_withdrawn_number_is_never_given_again() {
        let mut intent = intent();
        intent.propose(spec(2.0)).unwrap();
        assert_eq!(intent.withdraw(2).unwrap().setpoint, 2.0);
        assert_eq!(intent.propose(spec(3.0)), Ok(3));
        assert!(intent.find(2).is_none());
        assert!(matches!(
            intent.commit(2),
            Err(IntentError::Unknown { revision: 2, .. })
        ));
    }

    #[test]
    fn back_leads_back_twice_and_never_forth() {
        let mut intent = intent();
        for n in 2..=4 {
            assert_eq!(intent.propose(spec(1.0)), Ok(n));
            intent.commit(n).unwrap();
        }
        for earlier in [3, 2, 1] {
            let back = intent.previous().unwrap().revision;
            assert_eq!(back, earlier);
            intent.commit(back).unwrap();
        }
        assert!(intent.previous().is_none());
        // Forward again: "back" is the one left last, not a revision rolled back from.
        assert_eq!(intent.propose(spec(1.0)), Ok(5));
        intent.commit(5).unwrap();
        assert_eq!(intent.previous().unwrap().revision, 1);
    }

    #[test]
    fn a_rollback_leaves_what_is_on_its_way_alone() {
        let mut intent = intent();
        intent.propose(spec(2.0)).unwrap();
        intent.commit(2).unwrap();
        intent.propose(spec(3.0)).unwrap();
        assert_eq!(intent.commit(1), Ok(true));
        assert_eq!(numbers(&intent), (1, Some(3), vec![2]));
    }

    #[test]
    fn only_so_many_past_revisions_are_kept_the_newest_first() {
        let mut intent = intent();
        for n in 2..=30 {
            intent.propose(spec(1.0)).unwrap();
            intent.commit(n).unwrap();
        }
        assert_eq!(intent.past.len(), PAST_REVISIONS_MAX);
        assert_eq!(numbers(&intent).2, (14..30).rev().collect::<Vec<_>>());
    }

    #[test]
    fn the_components_of_every_revision_and_their_fallbacks_are_needed() {
        let of = |name: &str| Digest::of(name.as_bytes());
        let with = |component: &str, fallback: Option<&str>| LoopSpec {
            digest: of(component),
            fallback: fallback.map(of),
            ..spec(1.0)
        };
        let mut intent = Intent::new(HostId::new("io-1").unwrap(), with("a", Some("fa")), 0).unwrap();
        for (n, component) in [(2, "b"), (3, "c")] {
            intent.propose(with(component, None)).unwrap();
            intent.commit(n).unwrap();
        }
        intent.propose(with("d", Some("fd"))).unwrap();
        let all = ["a", "fa", "b", "c", "d", "fd"].map(of);
        assert_eq!(intent.components(), all.into_iter().collect());
        // One that is too long ago to go back to is needed no more.
        intent.withdraw(4).unwrap();
        for n in 5..5 + PAST_REVISIONS_MAX as u64 {
            intent.propose(with("e", None)).unwrap();
            intent.commit(n).unwrap();
        }
        assert_eq!(intent.components(), ["c", "e"].map(of).into_iter().collect());
    }

    #[test]
    fn bad_requests_change_nothing_and_say_why() {
        let mut intent = intent();
        intent.propose(spec(2.0)).unwrap();
        let before = intent.clone();
        let mut other = spec(1.0);
        other.id = LoopId::new("flow-1").unwrap();
        let table = [
            (
                intent.propose(other).unwrap_err(),
                "loop \"flow-1\", the intent of loop \"level-1\"",
            ),
            (intent.propose(spec(3.0)).unwrap_err(), "revision 2 is still on its way"),
            (intent.commit(7).unwrap_err(), "no revision 7; it has 1, 2"),
            (intent.withdraw(1).unwrap_err(), "revision 1 is not on its way"),
            (intent.withdraw(7).unwrap_err(), "no revision 7"),
        ];
        for (error, part) in table {
            assert!(error.to_string().contains(part), "{part}: {error}");
        }
        assert_eq!(intent, before);
        let home = HostId::new("io-1").unwrap();
        assert!(matches!(
            Intent::new(home, spec(1.0), u64::MAX),
            Err(IntentError::Exhausted(_))
        ));
    }

    #[test]
    fn a_newer_copy_is_greater_even_after_a_removal() {
        let mut intent = intent();
        let mut last = intent.position();
        let mut grown = |intent: &Intent| {
            assert!(intent.position() > last);
            last = intent.position();
        };
        intent.propose(spec(2.0)).unwrap();
        grown(&intent);
        intent.commit(2).unwrap();
        grown(&intent);
        intent.commit(1).unwrap();
        grown(&intent);
        intent.propose(spec(2.0)).unwrap();
        grown(&intent);
        intent.withdraw(3).unwrap();
        grown(&intent);
        grown(&Intent::new(intent.home, spec(1.0), intent.last_revision).unwrap());
    }
}
