//! The loops that this host holds: which revisions can be stepped here, which should be, and who was told.
//!
//! Owns: the comparison of what is held with what shall be held, and its failures with their pauses.
//! Never: takes an instance from a cycle: the loops drop what they are told to, between two cycles.
//!
//! ```text
//! not ours ──member of the loop──► wanted ──made ready──► held ──no longer a member, 10 s──► released
//!                                    ▲  └─failed─► pause ─┘ │
//!                                    └──── loop removed: released at once
//! ```

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{
    HostId, Intent, LoopId, LoopSpec,
    place::{self, Candidate},
};
use parking_lot::Mutex;

use crate::{
    error::Error,
    limits::{ANSWER_WAIT, HELD_PER_REPORT, RELEASE_AFTER},
    room::{Locks, Room},
    roster::back_off,
    view::FailureView,
    wire::{self, Ask},
};

/// How often a home is asked how much it knows.
const CHECK_EVERY: Duration = Duration::from_secs(5);

#[derive(Debug, Default)]
struct Held {
    revisions: BTreeSet<u64>,
    home: Option<HostId>,
    unwanted_since: Option<Instant>,
}

#[derive(Debug)]
struct Failure {
    reason: String,
    tries: u32,
    again: Instant,
}

type Pairs = BTreeSet<(LoopId, u64)>;

/// What a home was told, and when it last said how much it knows.
#[derive(Debug, Clone, Default)]
struct Told {
    pairs: Pairs,
    checked: Option<Instant>,
}

/// What this host holds.
#[derive(Debug, Default)]
pub(crate) struct Holder {
    held: Mutex<BTreeMap<LoopId, Held>>,
    failures: Mutex<HashMap<(LoopId, u64), Failure>>,
    told: Mutex<HashMap<HostId, Told>>,
    locks: Locks,
}

impl Holder {
    pub(crate) fn len(&self) -> usize {
        self.held.lock().len()
    }

    pub(crate) fn holds(&self, id: &LoopId, revision: u64) -> bool {
        self.held
            .lock()
            .get(id)
            .is_some_and(|held| held.revisions.contains(&revision))
    }

    /// The loop's home is this one, from now on if it was another: that one must be told what is held.
    fn home_is(&self, id: &LoopId, home: &HostId) {
        if let Some(held) = self.held.lock().get_mut(id)
            && held.home.as_ref() != Some(home)
        {
            held.home = Some(home.clone());
        }
    }

    /// A home that came or went must be told everything again.
    pub(crate) fn forget_reports_to(&self, home: &HostId) {
        self.told.lock().remove(home);
    }

    pub(crate) fn failures(&self, id: &LoopId) -> Vec<FailureView> {
        let failures = self.failures.lock();
        let mut of_loop: Vec<_> = failures
            .iter()
            .filter(|((loop_id, _), _)| loop_id == id)
            .map(|((_, revision), f)| FailureView {
                revision: *revision,
                reason: f.reason.clone(),
                tries: f.tries,
            })
            .collect();
        of_loop.sort_by_key(|failure| failure.revision);
        of_loop
    }

    /// Notes a failure, and when it is tried again.
    pub(crate) fn failed(&self, id: &LoopId, revision: u64, error: &Error) {
        let mut failures = self.failures.lock();
        let failure = failures.entry((id.clone(), revision)).or_insert(Failure {
            reason: String::new(),
            tries: 0,
            again: Instant::now(),
        });
        failure.tries = failure.tries.saturating_add(1);
        failure.again = Instant::now() + back_off(failure.tries);
        let reason = error.to_string();
        if failure.reason != reason {
            tracing::warn!(loop_id = %id, revision, %error, "a loop could not be made ready here; it is tried again");
            failure.reason = reason;
        }
    }

    pub(crate) fn succeeded(&self, id: &LoopId, revision: u64) {
        self.failures.lock().remove(&(id.clone(), revision));
    }

    /// May it be tried now?
    pub(crate) fn due(&self, id: &LoopId, revision: u64) -> bool {
        self.failures
            .lock()
            .get(&(id.clone(), revision))
            .is_none_or(|f| f.again <= Instant::now())
    }
}

/// Revisions that a member keeps ready: in force, on its way, and the one left last, where a probation leads back to.
pub(crate) fn wanted_revisions(intent: &Intent) -> Vec<&LoopSpec> {
    std::iter::once(&intent.current)
        .chain(&intent.pending)
        .chain(intent.past.first())
        .collect()
}

/// The hosts that shall hold a loop.
pub(crate) fn wanted_members(intent: &Intent, eligible: &[Candidate]) -> Vec<HostId> {
    let most = std::iter::once(&intent.current)
        .chain(&intent.pending)
        .map(|s| s.replicas)
        .max()
        .unwrap_or(1);
    place::members(&intent.loop_id, eligible, &intent.current.prefer, usize::from(most))
}

impl Room {
    /// Makes one revision ready here, if it is not. One at a time per loop.
    pub(crate) async fn hold(self: &Arc<Self>, spec: &LoopSpec, home: &HostId) -> Result<(), Error> {
        let lock = self.holder.locks.of(&spec.id);
        let _turn = lock.lock().await;
        if self.holder.holds(&spec.id, spec.revision) {
            return Ok(());
        }
        let made = self.made_ready(Arc::new(spec.clone()), Some(home)).await;
        let taken = made.and_then(|revision| {
            self.field
                .hold(revision)
                .map_err(|error| Error::busy(crate::error::chain(&error), ""))
        });
        match &taken {
            Ok(()) => {
                let mut held = self.holder.held.lock();
                let entry = held.entry(spec.id.clone()).or_default();
                entry.revisions.insert(spec.revision);
                entry.home = Some(home.clone());
                entry.unwanted_since = None;
                drop(held);
                self.holder.succeeded(&spec.id, spec.revision);
            }
            Err(error) => self.holder.failed(&spec.id, spec.revision, error),
        }
        taken
    }

    /// Compares what is held with what shall be held, and does what is missing. Idempotent.
    pub(crate) async fn keep_holds(self: &Arc<Self>) {
        let eligible = self.roster.eligible();
        let mut missing = Vec::new();
        for intent in self.book.all() {
            if !wanted_members(&intent, &eligible).contains(&self.here) {
                continue;
            }
            self.holder.home_is(&intent.loop_id, &intent.home);
            let wanted = wanted_revisions(&intent);
            let numbers: Vec<u64> = wanted.iter().map(|spec| spec.revision).collect();
            self.keep_only(&intent.loop_id, &numbers);
            for spec in wanted {
                if !self.holder.holds(&spec.id, spec.revision) && self.holder.due(&spec.id, spec.revision) {
                    let later = !self.bench.is_ready(&spec.digest);
                    let not_in_force = spec.revision != intent.current.revision;
                    missing.push((later, not_in_force, intent.home.clone(), spec.clone()));
                }
            }
        }
        self.release_unwanted(&eligible);
        // Compilations last, and of each kind first what is in force.
        missing.sort_by_key(|(later, not_in_force, ..)| (*later, *not_in_force));
        let mut told = Instant::now();
        for (_, _, home, spec) in missing {
            if self.stopped() {
                return;
            }
            // The reason is kept with the loop, and logged where it is new.
            let _ = self.hold(&spec, &home).await;
            if told.elapsed() > RELEASE_AFTER / 20 {
                self.tell_homes().await;
                told = Instant::now();
            }
        }
        self.tell_homes().await;
    }

    /// Does this host hold all that it shall, in the revisions in force?
    pub(crate) fn holds_all(&self) -> bool {
        let eligible = self.roster.eligible();
        let ours = |intent: &Arc<Intent>| wanted_members(intent, &eligible).contains(&self.here);
        let held = |intent: &Arc<Intent>| self.holder.holds(&intent.loop_id, intent.current.revision);
        self.book.all().iter().filter(|intent| ours(intent)).all(held)
    }

    /// Lets go of revisions that are no longer needed, for loops that stay.
    fn keep_only(&self, id: &LoopId, wanted: &[u64]) {
        let mut held = self.holder.held.lock();
        let Some(entry) = held.get_mut(id) else { return };
        entry.unwanted_since = None;
        if entry.revisions.iter().all(|r| wanted.contains(r)) {
            return;
        }
        let keep = entry.revisions.iter().copied().filter(|r| wanted.contains(r)).collect();
        match self.field.keep_revisions(id, keep) {
            Ok(()) => entry.revisions.retain(|r| wanted.contains(r)),
            Err(error) => tracing::debug!(loop_id = %id, %error, "old revisions stay for now"),
        }
    }

    fn release_unwanted(&self, eligible: &[Candidate]) {
        let now = Instant::now();
        self.holder.held.lock().retain(|id, entry| {
            let intent = self.book.get(id);
            if intent
                .as_ref()
                .is_some_and(|i| wanted_members(i, eligible).contains(&self.here))
            {
                entry.unwanted_since = None;
                return true;
            }
            let since = *entry.unwanted_since.get_or_insert(now);
            if intent.is_some() && now.saturating_duration_since(since) < RELEASE_AFTER {
                return true;
            }
            // Too busy: the next look asks again.
            self.field.release(id).is_err()
        });
        self.holder
            .failures
            .lock()
            .retain(|(id, revision), _| self.book.get(id).is_some_and(|intent| intent.find(*revision).is_some()));
    }

    /// Tells each home what changed since it was last told.
    pub(crate) async fn tell_homes(self: &Arc<Self>) {
        let mut now: HashMap<HostId, Pairs> = HashMap::new();
        for (id, entry) in self.holder.held.lock().iter() {
            let Some(home) = &entry.home else { continue };
            let pairs = now.entry(home.clone()).or_default();
            pairs.extend(entry.revisions.iter().map(|revision| (id.clone(), *revision)));
        }
        let before = self.holder.told.lock().clone();
        let homes: BTreeSet<HostId> = now.keys().chain(before.keys()).cloned().collect();
        for home in homes.into_iter().filter(|home| self.roster.there(home)) {
            let new = now.remove(&home).unwrap_or_default();
            let old = before.get(&home).cloned().unwrap_or_default();
            if let Err(error) = self.tell_home(&home, &new, &old).await {
                tracing::debug!(%home, %error, "a home could not be told what is held; it is tried again");
            }
        }
    }

    async fn tell_home(self: &Arc<Self>, home: &HostId, new: &Pairs, old: &Told) -> Result<(), Error> {
        let mut came: Vec<_> = new.difference(&old.pairs).cloned().collect();
        let mut went: Vec<_> = old.pairs.difference(new).cloned().collect();
        // The home may have forgotten this host, because it saw it go where this host saw nothing.
        let check = old.checked.is_none_or(|at| at.elapsed() > CHECK_EVERY);
        if came.is_empty() && went.is_empty() && !check {
            return Ok(());
        }
        let mut afresh = old.checked.is_none();
        loop {
            let part = |all: &mut Vec<(LoopId, u64)>| all.split_off(all.len().saturating_sub(HELD_PER_REPORT / 2));
            let (some_came, some_went) = (part(&mut came), part(&mut went));
            let ask = Ask::Held {
                came: some_came.clone(),
                went: some_went.clone(),
                afresh,
            };
            afresh = false;
            let answer = self.ask(home, ask, ANSWER_WAIT).await?;
            let mut told = self.holder.told.lock();
            let told = told.entry(home.clone()).or_default();
            for pair in &some_went {
                told.pairs.remove(pair);
            }
            told.pairs.extend(some_came);
            told.checked = Some(Instant::now());
            if answer != wire::Told::Holds(told.pairs.len() as u64) {
                // Everything again, with the next pass.
                told.pairs.clear();
                told.checked = None;
                return Ok(());
            }
            if came.is_empty() && went.is_empty() {
                return Ok(());
            }
        }
    }
}
