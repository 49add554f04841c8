//! The course of a rollout: which loop is changed or brought back next, given what was seen. Pure.
//!
//! Owns: the order, and that nothing is changed before the canary passed, or after a failure or a stop. Never: asks,
//! waits, measures, or knows what time it is; the shell around it (`tour`) does.
//!
//! ```text
//!            chosen           changed           all its cycles seen
//!   Waiting ───────► Changing ───────► Watched ────────────────────► Done
//!      ▲                │ │              │ │                           │
//!      └─ failure or ───┘ └─ refused ─►  │ └─ it went back itself ──►  │ another failed, and all shall go back,
//!         stop before     Refused        │    RolledBack               │ newest first (also from Watched)
//!         it was asked                   │                             ▼
//!                                        └─ failed ─────────────► GoingBack ──► RolledBack | Failed
//!                                        └─ changed by others ──► Failed
//! ```
//! Refused, Failed and a RolledBack that began the fall are failures: from then on nothing is changed forwards.

use bumpless_core::LoopId;
use serde::{Deserialize, Serialize};

use super::{OnFailure, Rule, Stage};

/// Characters of a reason that are kept: a rollout of many loops must fit into one row of the disk.
const REASON_CHARS_MAX: usize = 500;

/// Was what a leg is about asked for already? Not kept: after a restart nobody knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Asked {
    /// This process found the leg so when it started.
    #[default]
    Unknown,
    /// Chosen, and not asked yet.
    NotYet,
    /// Under way.
    UnderWay,
}

/// One loop of a rollout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Leg {
    /// The loop.
    pub(crate) id: LoopId,
    pub(crate) stage: Stage,
    /// Why it is so, in words; empty where there is nothing to say.
    pub(crate) reason: String,
    /// The revision in force when the rollout began.
    pub(crate) before: u64,
    /// The greatest revision number that was given by then.
    pub(crate) last_before: u64,
    /// The revision that runs the new component.
    pub(crate) revision: Option<u64>,
    /// Place among the changes of the rollout, from 1; none where it changed nothing here.
    pub(crate) changed: Option<u64>,
    /// Cycles of its watch, when that ended.
    pub(crate) cycles: u32,
    /// Time between cycles, in ns.
    pub(crate) period_ns: u64,
    /// Errors below this are none, in the unit of the measurement.
    pub(crate) floor: f64,
    /// Mean absolute error before the change.
    pub(crate) error_before: Option<f64>,
    /// Mean absolute error since.
    pub(crate) error: Option<f64>,
    #[serde(skip)]
    pub(crate) asked: Asked,
}

impl Leg {
    /// A loop that waits.
    pub(crate) fn new(id: LoopId, before: u64, last_before: u64, period_ns: u64, floor: f64) -> Self {
        Self {
            id,
            stage: Stage::Waiting,
            reason: String::new(),
            before,
            last_before,
            revision: None,
            changed: None,
            cycles: 0,
            period_ns,
            floor,
            error_before: None,
            error: None,
            asked: Asked::Unknown,
        }
    }

    fn to(&mut self, stage: Stage, reason: &str) {
        self.stage = stage;
        self.asked = Asked::Unknown;
        if !reason.is_empty() {
            self.reason = reason.chars().take(REASON_CHARS_MAX).collect();
        }
    }
}

/// What is to be asked now, by number of the leg.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Action {
    /// Change it.
    Change(usize),
    /// Find out whether it was changed. Nothing may be changed any more.
    Find(usize),
    /// Bring it back.
    Back(usize),
}

/// How a watched loop failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fall {
    /// It still runs what the rollout brought.
    Runs,
    /// It went back by itself.
    WentBack,
    /// Somebody else changed it.
    Others,
}

/// A rollout as it stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Course {
    pub(crate) rule: Rule,
    /// In the order of the rollout; the first is the canary.
    pub(crate) legs: Vec<Leg>,
    /// Changes so far.
    changes: u64,
    /// The first failure, in words.
    failure: Option<String>,
    stopped: bool,
}

impl Course {
    pub(crate) const fn new(rule: Rule, legs: Vec<Leg>) -> Self {
        Self {
            rule,
            legs,
            changes: 0,
            failure: None,
            stopped: false,
        }
    }

    /// As the disk brings it back: nobody knows what was asked for.
    pub(crate) fn as_kept(&self) -> Self {
        let mut kept = self.clone();
        for leg in &mut kept.legs {
            leg.asked = Asked::Unknown;
        }
        kept
    }

    /// The first failure, in words.
    pub(crate) fn failure(&self) -> Option<&str> {
        self.failure.as_deref()
    }

    /// Did a person stop it?
    pub(crate) const fn stopped(&self) -> bool {
        self.stopped
    }

    /// May nothing be changed forwards any more?
    const fn halted(&self) -> bool {
        self.stopped || self.failure.is_some()
    }

    fn count(&self, stages: &[Stage]) -> usize {
        self.legs.iter().filter(|leg| stages.contains(&leg.stage)).count()
    }

    /// The legs whose turn it is to be changed, ready or not.
    pub(crate) fn due(&self) -> Vec<usize> {
        if self.halted() {
            return Vec::new();
        }
        let canary_passed = self.legs.first().is_some_and(|leg| leg.stage == Stage::Done);
        let most = if canary_passed { self.rule.at_once as usize } else { 1 };
        let free = most.saturating_sub(self.count(&[Stage::Changing, Stage::Watched]));
        let waiting = |(_, leg): &(usize, &Leg)| leg.stage == Stage::Waiting;
        let due = self.legs.iter().enumerate().filter(waiting).map(|(number, _)| number);
        // Before that, the canary alone is due.
        due.filter(|number| canary_passed || *number == 0).take(free).collect()
    }

    /// Chooses what is changed next: in order, those that are ready. Says whether there is any; they are asked for by
    /// [`Course::actions`], after the choice was kept.
    pub(crate) fn choose(&mut self, ready: impl Fn(usize) -> bool) -> bool {
        let due = self.due();
        let chosen: Vec<usize> = due.into_iter().take_while(|number| ready(*number)).collect();
        for number in &chosen {
            if let Some(leg) = self.legs.get_mut(*number) {
                leg.to(Stage::Changing, "");
                leg.asked = Asked::NotYet;
            }
        }
        !chosen.is_empty()
    }

    /// Chooses what is brought back next because something failed: newest first. Says whether there is any.
    pub(crate) fn choose_back(&mut self) -> bool {
        let back = self.rule.on_failure == OnFailure::Back && self.failure.is_some() && !self.stopped;
        if !back {
            return false;
        }
        let free = (self.rule.at_once as usize).saturating_sub(self.count(&[Stage::GoingBack]));
        let mut changed: Vec<(u64, usize)> = self
            .legs
            .iter()
            .enumerate()
            .filter(|(_, leg)| matches!(leg.stage, Stage::Watched | Stage::Done))
            .filter_map(|(number, leg)| leg.changed.map(|place| (place, number)))
            .collect();
        changed.sort_unstable_by(|a, b| b.cmp(a));
        changed.truncate(free);
        for (_, number) in &changed {
            if let Some(leg) = self.legs.get_mut(*number) {
                leg.to(Stage::GoingBack, "another loop failed");
                leg.asked = Asked::NotYet;
            }
        }
        !changed.is_empty()
    }

    /// What is to be asked now. Each is given once. Changes only where the choice is `kept` on disk, so that a restart
    /// finds every loop that may have been changed.
    pub(crate) fn actions(&mut self, kept: bool) -> Vec<Action> {
        let halted = self.halted();
        let mut actions = Vec::new();
        for (number, leg) in self.legs.iter_mut().enumerate() {
            let action = match (leg.stage, leg.asked) {
                (Stage::Changing, Asked::NotYet) if kept => Action::Change(number),
                // What was asked before a restart is asked again: the loop's home does it once.
                (Stage::Changing, Asked::Unknown) if halted => Action::Find(number),
                (Stage::Changing, Asked::Unknown) if kept => Action::Change(number),
                (Stage::GoingBack, Asked::NotYet | Asked::Unknown) => Action::Back(number),
                _ => continue,
            };
            leg.asked = Asked::UnderWay;
            actions.push((leg.changed, action));
        }
        // The newest change is the first to go back; what has none yet keeps its order.
        actions.sort_by(|(a, _), (b, _)| b.cmp(a));
        actions.into_iter().map(|(_, action)| action).collect()
    }

    fn leg_in(&mut self, number: usize, stage: Stage) -> Option<&mut Leg> {
        self.legs.get_mut(number).filter(|leg| leg.stage == stage)
    }

    /// A loop runs the component now. `new` where the rollout brought it there.
    pub(crate) fn changed(&mut self, number: usize, revision: u64, new: bool) {
        let place = self.changes + 1;
        let Some(leg) = self.leg_in(number, Stage::Changing) else {
            return;
        };
        leg.to(Stage::Watched, "");
        leg.revision = Some(revision);
        if new {
            leg.changed = Some(place);
            self.changes = place;
        } else {
            "it ran this component already".clone_into(&mut leg.reason);
        }
    }

    /// A loop was not changed, though it should have been.
    pub(crate) fn refused(&mut self, number: usize, why: &str) {
        if let Some(leg) = self.legs.get_mut(number)
            && matches!(leg.stage, Stage::Waiting | Stage::Changing)
        {
            leg.to(Stage::Refused, why);
            self.fail(number, why);
        }
    }

    /// Nobody knows whether a loop was changed.
    pub(crate) fn unknown(&mut self, number: usize, why: &str) {
        if let Some(leg) = self.leg_in(number, Stage::Changing) {
            leg.to(Stage::Failed, why);
            self.fail(number, why);
        }
    }

    /// It was not changed, and will not be: the rollout was halted meanwhile.
    pub(crate) fn spared(&mut self, number: usize) {
        if let Some(leg) = self.leg_in(number, Stage::Changing) {
            leg.to(Stage::Waiting, "");
        }
    }

    /// A watched loop ran all its cycles well.
    pub(crate) fn passed(&mut self, number: usize) {
        if let Some(leg) = self.leg_in(number, Stage::Watched) {
            leg.to(Stage::Done, "");
        }
    }

    /// A watched loop failed.
    pub(crate) fn fell(&mut self, number: usize, fall: Fall, why: &str) {
        let Some(leg) = self.leg_in(number, Stage::Watched) else {
            return;
        };
        match fall {
            // What it ran before is what it runs: there is no way back.
            Fall::Runs if leg.changed.is_none() => leg.to(Stage::Failed, why),
            Fall::Runs => {
                leg.to(Stage::GoingBack, why);
                leg.asked = Asked::NotYet;
            }
            Fall::WentBack => leg.to(Stage::RolledBack, why),
            Fall::Others => leg.to(Stage::Failed, why),
        }
        self.fail(number, why);
    }

    /// How the way back of a loop ended.
    pub(crate) fn went_back(&mut self, number: usize, end: Result<(), String>) {
        let Some(leg) = self.leg_in(number, Stage::GoingBack) else {
            return;
        };
        match end {
            Ok(()) => leg.to(Stage::RolledBack, ""),
            Err(why) => {
                let reason = format!("{}; it was not rolled back: {why}", leg.reason);
                leg.to(Stage::Failed, &reason);
            }
        }
    }

    fn fail(&mut self, number: usize, why: &str) {
        if self.failure.is_none() {
            let name = self.legs.get(number).map(|leg| leg.id.to_string()).unwrap_or_default();
            let failure = format!("{name}: {why}");
            self.failure = Some(failure.chars().take(REASON_CHARS_MAX).collect());
        }
        self.spare();
    }

    /// A person stops it: nothing further is changed.
    pub(crate) fn stop(&mut self) {
        if !self.ended() {
            self.stopped = true;
            self.spare();
        }
    }

    /// What was chosen and not asked for stays as it is.
    fn spare(&mut self) {
        for leg in &mut self.legs {
            if (leg.stage, leg.asked) == (Stage::Changing, Asked::NotYet) {
                leg.to(Stage::Waiting, "");
            }
        }
    }

    /// Is there nothing left to do?
    pub(crate) fn ended(&self) -> bool {
        if self.count(&[Stage::Changing, Stage::GoingBack]) > 0 {
            return false;
        }
        if self.stopped {
            return true;
        }
        if self.failure.is_none() {
            return self.count(&[Stage::Done]) == self.legs.len();
        }
        let to_bring_back = |leg: &&Leg| leg.stage == Stage::Done && leg.changed.is_some();
        self.count(&[Stage::Watched]) == 0
            && (self.rule.on_failure == OnFailure::Stop || !self.legs.iter().any(|leg| to_bring_back(&leg)))
    }
}

#[cfg(test)]
mod tests;
