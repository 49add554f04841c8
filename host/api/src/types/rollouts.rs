//! Rollouts: one component for many loops, one loop first.

use std::collections::BTreeMap;

use bumpless_deploy::rollout::{self, RolloutDraft, RolloutList, RolloutView, Rule, Stage, State};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::finite;

/// What happens to the loops that were changed already when one fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum OnFailure {
    /// They stay as they are.
    #[default]
    Stop,
    /// They go back too, newest first.
    Back,
}

fn cycles() -> u32 {
    Rule::default().cycles
}

fn factor() -> f64 {
    Rule::default().factor
}

fn at_once() -> u32 {
    Rule::default().at_once
}

/// A rollout to begin.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RolloutRequest {
    /// The component: `name`, `name@version`, or a digest or its beginning.
    pub component: String,
    /// Parameters that differ from those that a swap takes over.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// The loops in their order, at most 256; the first is the canary.
    #[serde(default)]
    pub loops: Vec<String>,
    /// And after them, by name, all others that run this component now.
    #[serde(default)]
    pub all_of: Option<String>,
    /// Cycles that each loop is watched for, and looked at before: 1 to 10,000.
    #[serde(default = "cycles")]
    pub cycles: u32,
    /// Greatest mean absolute error while a loop is watched, in times that of the cycles before: 1 to 1,000. An error of a
    /// thousandth of the setpoint's range is always good enough.
    #[serde(default = "factor")]
    pub factor: f64,
    /// Loops under change or watch at a time, once the canary passed: 1 to 16.
    #[serde(default = "at_once")]
    pub at_once: u32,
    /// What happens to the loops that were changed already when one fails.
    #[serde(default)]
    pub on_failure: OnFailure,
}

/// How far a loop of a rollout is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RolloutStage {
    /// As it was before; it is looked at until its turn comes.
    Waiting,
    /// It is being changed.
    Changing,
    /// It runs the component and is watched.
    Watched,
    /// It ran all its cycles well.
    Done,
    /// It was not changed; the reason says why.
    Refused,
    /// It is being rolled back.
    GoingBack,
    /// It failed and was not rolled back; the reason says why.
    Failed,
    /// It runs what it ran before; the reason says why.
    RolledBack,
}

/// How far a rollout is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RolloutState {
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RolloutLoop {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// How far it is.
    pub stage: RolloutStage,
    /// Why, in words; empty where there is nothing to say.
    pub reason: String,
    /// Cycles seen before the change, up to those of the rule.
    pub cycles_before: u32,
    /// Cycles seen since, out of those of the rule.
    pub cycles: u32,
    /// Revision in force when the rollout began.
    pub revision_before: u64,
    /// Revision with the component.
    pub revision: Option<u64>,
    /// Mean absolute error before, in the unit of the measurement.
    pub error_before: Option<f64>,
    /// Mean absolute error since.
    pub error: Option<f64>,
}

/// A rollout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Rollout {
    /// Its name: the host that was asked, and a number.
    pub id: String,
    /// That host. It goes on with the rollout after a restart.
    pub host: String,
    /// `name@version` of the component.
    pub component: String,
    /// Its digest.
    pub digest: String,
    /// Parameters that it was given.
    pub parameters: BTreeMap<String, f64>,
    /// Cycles that each loop is watched for.
    pub cycles: u32,
    /// Greatest mean absolute error, in times that before.
    pub factor: f64,
    /// Loops under change or watch at a time.
    pub at_once: u32,
    /// What happens after a failure.
    pub on_failure: OnFailure,
    /// How far it is.
    pub state: RolloutState,
    /// The first failure, in words; it is told while others are still brought back.
    pub failure: Option<String>,
    /// When it began, in ms since 1970-01-01 UTC.
    pub started_at_unix_ms: u64,
    /// When it ended.
    pub ended_at_unix_ms: Option<u64>,
    /// Loops in all.
    pub total: u32,
    /// Loops that are done.
    pub done: u32,
    /// Each loop, in order; a list has a rollout without them.
    pub loops: Vec<RolloutLoop>,
}

/// A host that did not answer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SilentHost {
    /// The host.
    pub host: String,
    /// Why, in words.
    pub reason: String,
}

/// The rollouts of the cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Rollouts {
    /// By host and number. A host keeps the last 16.
    pub rollouts: Vec<Rollout>,
    /// Hosts whose rollouts are not known.
    pub silent: Vec<SilentHost>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

impl TryFrom<RolloutRequest> for RolloutDraft {
    type Error = bumpless_core::NameError;

    fn try_from(request: RolloutRequest) -> Result<Self, Self::Error> {
        let loops = request.loops.iter().map(bumpless_core::LoopId::new);
        Ok(Self {
            loops: loops.collect::<Result<_, _>>()?,
            component: request.component,
            parameters: request.parameters,
            all_of: request.all_of,
            rule: Rule {
                cycles: request.cycles,
                factor: request.factor,
                at_once: request.at_once,
                on_failure: match request.on_failure {
                    OnFailure::Stop => rollout::OnFailure::Stop,
                    OnFailure::Back => rollout::OnFailure::Back,
                },
            },
        })
    }
}

impl From<Stage> for RolloutStage {
    fn from(stage: Stage) -> Self {
        match stage {
            Stage::Waiting => Self::Waiting,
            Stage::Changing => Self::Changing,
            Stage::Watched => Self::Watched,
            Stage::Done => Self::Done,
            Stage::Refused => Self::Refused,
            Stage::GoingBack => Self::GoingBack,
            Stage::Failed => Self::Failed,
            Stage::RolledBack => Self::RolledBack,
        }
    }
}

impl RolloutState {
    /// The word as JSON has it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Running => "running",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Stopped => "stopped",
        }
    }
}

impl From<RolloutView> for Rollout {
    fn from(view: RolloutView) -> Self {
        let one = |leg: rollout::LegView| RolloutLoop {
            loop_name: leg.loop_id.to_string(),
            stage: leg.stage.into(),
            reason: leg.reason,
            cycles_before: leg.cycles_before,
            cycles: leg.cycles,
            revision_before: leg.revision_before,
            revision: leg.revision,
            error_before: leg.error_before.and_then(finite),
            error: leg.error.and_then(finite),
        };
        Self {
            id: view.id,
            host: view.host.to_string(),
            component: view.component,
            digest: view.digest.to_string(),
            parameters: view.parameters,
            cycles: view.rule.cycles,
            factor: view.rule.factor,
            at_once: view.rule.at_once,
            on_failure: match view.rule.on_failure {
                rollout::OnFailure::Stop => OnFailure::Stop,
                rollout::OnFailure::Back => OnFailure::Back,
            },
            state: match view.state {
                State::Running => RolloutState::Running,
                State::Done => RolloutState::Done,
                State::Failed => RolloutState::Failed,
                State::Stopped => RolloutState::Stopped,
            },
            failure: view.failure,
            started_at_unix_ms: view.started_at_unix_ms,
            ended_at_unix_ms: view.ended_at_unix_ms,
            total: view.total,
            done: view.done,
            loops: view.loops.into_iter().map(one).collect(),
        }
    }
}

impl From<RolloutList> for Rollouts {
    fn from(list: RolloutList) -> Self {
        let silent = |(host, reason): (bumpless_core::HostId, String)| SilentHost {
            host: host.to_string(),
            reason,
        };
        Self {
            rollouts: list.rollouts.into_iter().map(Into::into).collect(),
            silent: list.silent.into_iter().map(silent).collect(),
            next: None,
        }
    }
}
