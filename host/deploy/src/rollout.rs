//! Rollouts: one component for many loops, the first of them alone, the others by rule.
//!
//! Owns: the words of a rollout, its report, and (below) its rule, its watch and its journey. The host that was asked keeps
//! it on disk and goes on with it after a restart. Never: changes a loop otherwise than any person could; each change is
//! asked of the loop's home, which does it once and only if nobody changed the loop meanwhile.
//!
//! ```text
//! asked ──► seen before ──► changed ──► watched ──► done            canary, then `at_once` at a time
//!                              │            └─ failed ──► brought back ──► the rest stays, or all go back
//!                              └─ refused ─────────────────────────────────┘
//! ```
//! Reading order: `course` (what next; pure), `watch` (what a record means; pure), `guarded` (the loop's home), `tour` (the
//! task), `ledger` (all of this host).

use std::collections::BTreeMap;

use bumpless_core::{Digest, HostId, LoopId};
use serde::{Deserialize, Serialize};

use crate::{
    error::Error,
    limits::{ROLLOUT_AT_ONCE_MAX, ROLLOUT_CYCLES_MAX, ROLLOUT_FACTOR_MAX},
};

pub(crate) mod course;
pub(crate) mod guarded;
pub(crate) mod ledger;
mod tour;
mod watch;

/// What happens to the loops that were changed already when one fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnFailure {
    /// They stay as they are.
    #[default]
    Stop,
    /// They go back too, newest first.
    Back,
}

/// The rule of a rollout.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rule {
    /// Cycles that a changed loop is watched for, and looked at before: 1 to 10,000.
    pub cycles: u32,
    /// Greatest mean absolute error while it is watched, in times that of the cycles before: 1 to 1,000. An error of a
    /// thousandth of the setpoint's range is always good enough.
    pub factor: f64,
    /// Loops that may be under change or watch at a time, once the canary passed: 1 to 16.
    pub at_once: u32,
    /// What happens after a failure.
    pub on_failure: OnFailure,
}

impl Default for Rule {
    fn default() -> Self {
        Self {
            cycles: 200,
            factor: 2.0,
            at_once: 1,
            on_failure: OnFailure::Stop,
        }
    }
}

impl Rule {
    /// Is it one that can be followed?
    pub(crate) fn check(&self) -> Result<(), Error> {
        let wrong = |reason: String, cure: String| Err(Error::invalid(reason, cure));
        if !(1..=ROLLOUT_CYCLES_MAX).contains(&self.cycles) {
            return wrong(
                format!("cycles = {}", self.cycles),
                format!("watch each loop for 1 to {ROLLOUT_CYCLES_MAX} cycles"),
            );
        }
        if !(1.0..=ROLLOUT_FACTOR_MAX).contains(&self.factor) {
            return wrong(
                format!("factor = {}", self.factor),
                format!("allow 1 to {ROLLOUT_FACTOR_MAX} times the error before"),
            );
        }
        if !(1..=ROLLOUT_AT_ONCE_MAX).contains(&self.at_once) {
            return wrong(
                format!("at_once = {}", self.at_once),
                format!("change 1 to {ROLLOUT_AT_ONCE_MAX} loops at a time"),
            );
        }
        Ok(())
    }
}

/// What is asked of a host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RolloutDraft {
    /// The component: `name`, `name@version`, or a digest or its beginning.
    pub component: String,
    /// Parameters that differ from those that a swap takes over.
    pub parameters: BTreeMap<String, f64>,
    /// The loops in their order; the first is the canary.
    pub loops: Vec<LoopId>,
    /// And after them, by name, all others that run this component now.
    pub all_of: Option<String>,
    /// How it goes.
    pub rule: Rule,
}

/// How far a loop of a rollout is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Stage {
    /// As it was before; it is looked at until its turn comes.
    Waiting,
    /// It is being changed.
    Changing,
    /// It runs the component and is watched.
    Watched,
    /// It ran all its cycles well.
    Done,
    /// It was not changed, and why.
    Refused,
    /// It failed, and is being rolled back.
    GoingBack,
    /// It failed and was not rolled back, and why.
    Failed,
    /// It runs what it ran before.
    RolledBack,
}

/// How far a rollout is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum State {
    /// There is something left to do.
    Running,
    /// All loops run the component.
    Done,
    /// A loop failed or was refused.
    Failed,
    /// A person stopped it.
    Stopped,
}

/// One loop of a rollout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LegView {
    /// The loop.
    pub loop_id: LoopId,
    /// How far it is.
    pub stage: Stage,
    /// Why, in words; empty where there is nothing to say.
    pub reason: String,
    /// Cycles seen before the change, up to those of the rule.
    pub cycles_before: u32,
    /// Cycles seen well since, out of those of the rule.
    pub cycles: u32,
    /// Revision in force when the rollout began.
    pub revision_before: u64,
    /// Revision with the component.
    pub revision: Option<u64>,
    /// Mean absolute error before, in the unit of the measurement; none where nothing was measured.
    pub error_before: Option<f64>,
    /// Mean absolute error since.
    pub error: Option<f64>,
}

/// A rollout as its host sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RolloutView {
    /// Its name: host and number, as `plant.3`.
    pub id: String,
    /// The host that was asked.
    pub host: HostId,
    /// `name@version` of the component.
    pub component: String,
    /// Its digest.
    pub digest: Digest,
    /// Parameters that it was given.
    pub parameters: BTreeMap<String, f64>,
    /// How it goes.
    pub rule: Rule,
    /// How far it is.
    pub state: State,
    /// The first failure, in words; it is told while others are still brought back.
    pub failure: Option<String>,
    /// When it began, in ms of Unix time.
    pub started_at_unix_ms: u64,
    /// When it ended.
    pub ended_at_unix_ms: Option<u64>,
    /// Loops in all.
    pub total: u32,
    /// Loops that are done.
    pub done: u32,
    /// Each loop, in order. Lists have a rollout without them.
    pub loops: Vec<LegView>,
}

/// The rollouts of the cell.
#[derive(Debug, Clone, PartialEq)]
pub struct RolloutList {
    /// By host and number, without their loops.
    pub rollouts: Vec<RolloutView>,
    /// Hosts that did not answer, and why.
    pub silent: Vec<(HostId, String)>,
}

/// The host and the number that the name of a rollout says.
pub(crate) fn place_of(id: &str) -> Result<(HostId, u64), Error> {
    let parts = id.rsplit_once('.');
    let parsed = parts.and_then(|(host, number)| Some((HostId::new(host).ok()?, number.parse().ok()?)));
    parsed.ok_or_else(|| {
        let id: String = id.chars().take(80).collect();
        Error::not_found(
            format!("{id:?} is no rollout: they are named by their host and number, as plant.3"),
            "list the rollouts for their names",
        )
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_name_is_host_and_number() {
        let (host, number) = place_of("io-1.west.12").unwrap();
        assert_eq!((host.as_str(), number), ("io-1.west", 12));
        for bad in ["", "3", "plant", "plant.", "plant.x", ".3", "Plant.3", "plant.-1"] {
            let error = place_of(bad).expect_err(bad).to_string();
            assert!(error.contains("as plant.3"), "{error}");
        }
    }

    #[test]
    fn rules_are_bounded() {
        let good = Rule::default();
        assert_eq!(good.check(), Ok(()));
        for (bad, part) in [
            (
                Rule { cycles: 0, ..good },
                "cycles = 0; watch each loop for 1 to 10000 cycles",
            ),
            (Rule { cycles: 10_001, ..good }, "cycles = 10001"),
            (Rule { factor: 0.9, ..good }, "factor = 0.9; allow 1 to 1000"),
            (
                Rule {
                    factor: f64::NAN,
                    ..good
                },
                "factor = NaN",
            ),
            (Rule { at_once: 0, ..good }, "at_once = 0; change 1 to 16"),
            (Rule { at_once: 17, ..good }, "at_once = 17"),
        ] {
            let error = bad.check().expect_err(part).to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
