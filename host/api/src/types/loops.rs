//! Loops: what is written about them, what they do, and what can be asked of them.

use std::collections::BTreeMap;

use bumpless_core as model;
use bumpless_deploy as deploy;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Mode, OnBump, OnFault, OnFewer, PortTable, Record, Redundancy, Strategy, finite, ms};

const fn three() -> u8 {
    3
}

const fn automatic() -> Mode {
    Mode::Automatic
}

const fn round_robin() -> Strategy {
    Strategy(bumpless_core::Strategy::RoundRobin)
}

/// A loop as people write it: the body of `PUT`, and a loop file in TOML.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct LoopDraft {
    /// Name of the loop.
    pub name: String,
    /// The component: `name`, `name@version`, or a digest (64 digits, or at least the first 8).
    pub component: String,
    /// Time between cycles, in ms; 1 to 3,600,000. Fractions are allowed.
    pub period_ms: f64,
    /// Which point each port is connected to: port name → point name.
    pub ports: BTreeMap<String, String>,
    /// Parameters that differ from their defaults.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// Setpoint of the first start; later ones are commands.
    pub setpoint: f64,
    /// Least and greatest setpoint; the measured point's range where not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub setpoint_range: Option<[f64; 2]>,
    /// Mode of the first start; later ones are commands.
    #[serde(default = "automatic")]
    pub mode: Mode,
    /// How the replica that steps is chosen.
    #[serde(default = "round_robin")]
    pub strategy: Strategy,
    /// Hosts that hold the loop; 1 to 16.
    #[serde(default = "three")]
    pub replicas: u8,
    /// Bounds of outputs by port name; the point's range where not given.
    #[serde(default)]
    pub limits: BTreeMap<String, OutputLimit>,
    /// Topics whose messages the controller receives; at most 16.
    #[serde(default)]
    pub listens: Vec<String>,
    /// The component that takes over by itself when this one has failed more often in a row than the policy tolerates; the
    /// same forms as `component`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fallback: Option<String>,
    /// Its parameters, by name; what is not named it takes from `parameters`, or from its own defaults.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub fallback_parameters: BTreeMap<String, f64>,
    /// Where the loop would rather run: names and labels of hosts, the best first; at most 8. Its members are chosen in this
    /// order, and a better one gets the loop back, without a gap, once it has been well for 5 s (longer where it keeps
    /// failing).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub prefer: Vec<String>,
    /// Fault, hedge, takeover and swap policy.
    #[serde(default)]
    pub policy: Policy,
}

/// What an output may do, outside the sandbox, whatever the controller says.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct OutputLimit {
    /// Least value, in the point's unit.
    pub low: f64,
    /// Greatest value.
    pub high: f64,
    /// Greatest change per second; none for no limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate_per_s: Option<f64>,
    /// Where the output goes when the policy says `safe-value`.
    pub safe: f64,
}

/// The bounds within which the hosts run a loop.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Policy {
    /// What happens after `faults_tolerated` faulty cycles in a row; until then the output holds.
    pub on_fault: OnFault,
    /// Faulty cycles in a row that only hold.
    pub faults_tolerated: u32,
    /// What happens when a required input is bad.
    pub on_bad_input: OnFault,
    /// Longest time of one step, in µs; 0 for a quarter of the period, at most 10 ms.
    pub step_limit_us: u64,
    /// Part of the period after which a silent replica is given up and the next one asked as well.
    pub hedge_part: f64,
    /// Part of the period after which a missing commit moves the ownership.
    pub takeover_part: f64,
    /// Greatest step of an output at a swap, in % of the output's span.
    pub bump_limit_percent: f64,
    /// What happens to a change beyond it.
    pub on_bump: OnBump,
    /// Cycles after a swap during which a fault rolls back.
    pub probation_cycles: u32,
    /// In probation: greatest difference of an output from what the old component would send in the same cycle from the same
    /// state, in % of the output's span; more rolls back. None where the two may differ.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub probation_deviation_percent: Option<f64>,
    /// Under `vote(n)`: what happens while fewer than n replicas are left.
    pub on_fewer: OnFewer,
}

impl Default for Policy {
    fn default() -> Self {
        model::Policy::default().into()
    }
}

impl From<model::Policy> for Policy {
    fn from(policy: model::Policy) -> Self {
        Self {
            on_fault: policy.on_fault.into(),
            faults_tolerated: policy.faults_tolerated,
            on_bad_input: policy.on_bad_input.into(),
            step_limit_us: policy.step_limit_us,
            hedge_part: policy.hedge_part,
            takeover_part: policy.takeover_part,
            bump_limit_percent: policy.bump_limit_percent,
            on_bump: policy.on_bump.into(),
            probation_cycles: policy.probation_cycles,
            probation_deviation_percent: policy.probation_deviation_percent,
            on_fewer: policy.on_fewer.into(),
        }
    }
}

impl From<Policy> for model::Policy {
    fn from(policy: Policy) -> Self {
        Self {
            on_fault: policy.on_fault.into(),
            faults_tolerated: policy.faults_tolerated,
            on_bad_input: policy.on_bad_input.into(),
            step_limit_us: policy.step_limit_us,
            hedge_part: policy.hedge_part,
            takeover_part: policy.takeover_part,
            bump_limit_percent: policy.bump_limit_percent,
            on_bump: policy.on_bump.into(),
            probation_cycles: policy.probation_cycles,
            probation_deviation_percent: policy.probation_deviation_percent,
            on_fewer: policy.on_fewer.into(),
        }
    }
}

impl From<model::OutputLimit> for OutputLimit {
    fn from(limit: model::OutputLimit) -> Self {
        Self {
            low: limit.low,
            high: limit.high,
            rate_per_s: limit.rate_per_s,
            safe: limit.safe,
        }
    }
}

impl From<OutputLimit> for model::OutputLimit {
    fn from(limit: OutputLimit) -> Self {
        Self {
            low: limit.low,
            high: limit.high,
            rate_per_s: limit.rate_per_s,
            safe: limit.safe,
        }
    }
}

impl From<LoopDraft> for deploy::LoopDraft {
    fn from(draft: LoopDraft) -> Self {
        Self {
            name: draft.name,
            component: draft.component,
            period_ms: draft.period_ms,
            ports: draft.ports,
            parameters: draft.parameters,
            setpoint: draft.setpoint,
            setpoint_range: draft.setpoint_range.map(|[low, high]| (low, high)),
            mode: draft.mode.into(),
            strategy: draft.strategy.into(),
            replicas: draft.replicas,
            limits: draft
                .limits
                .into_iter()
                .map(|(port, limit)| (port, limit.into()))
                .collect(),
            listens: draft.listens,
            fallback: draft.fallback,
            fallback_parameters: draft.fallback_parameters,
            prefer: draft.prefer,
            policy: draft.policy.into(),
        }
    }
}

/// Loops, by name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Loops {
    /// The loops, without their last records.
    pub loops: Vec<Loop>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    pub next: Option<String>,
}

/// A loop as a host sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Loop {
    /// Its name.
    pub name: String,
    /// Its I/O host: serves the points and orders the records.
    pub home: String,
    /// `name@version` of the component in force, or its short digest where the library does not know it.
    pub component: String,
    /// SHA-256 of the component in force.
    pub digest: String,
    /// The revision in force.
    pub revision: u64,
    /// A revision on its way.
    pub pending_revision: Option<u64>,
    /// Revisions that can be gone back to, newest first.
    pub past_revisions: Vec<u64>,
    /// The revision in force, as it would be written: it can be edited and put again.
    pub spec: LoopDraft,
    /// Live hosts that hold it, in rank order.
    pub members: Vec<String>,
    /// The host that ran the last cycle.
    pub owner: Option<String>,
    /// Number of that ownership.
    pub term: Option<u64>,
    /// Number of the last cycle.
    pub seq: Option<u64>,
    /// What the last cycle could count on.
    #[serde(default)]
    pub redundancy: Option<Redundancy>,
    /// Mode in force.
    pub mode: Option<Mode>,
    /// Setpoint in force.
    pub setpoint: Option<f64>,
    /// The measured port: `pv`, else the first input.
    pub measured_port: Option<String>,
    /// Its last value.
    pub measurement: Option<f64>,
    /// Unit of the measured port, as its component says.
    pub measured_unit: Option<String>,
    /// Last outputs, by port.
    pub outputs: BTreeMap<String, Option<f64>>,
    /// Age of the last record, in ms.
    pub last_age_ms: Option<u64>,
    /// Counts; only the home has them.
    pub tally: Option<Tally>,
    /// What the answering host should do for the loop, could not, and tries again.
    pub failures: Vec<Failure>,
    /// The last record; only in the answer about one loop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<Record>,
}

/// Something that a host could not do for a loop and tries again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Failure {
    /// The revision that it is about.
    pub revision: u64,
    /// What went wrong.
    pub reason: String,
    /// How often it was tried.
    pub tries: u32,
}

/// Counts since the home started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Tally {
    /// Cycles whose commit was taken.
    pub taken: u64,
    /// Cycles that began and ended without a commit.
    pub lost: u64,
    /// Cycles that the home itself came too late for.
    pub skipped: u64,
    /// Changes of ownership after a silence.
    pub takeovers: u64,
    /// Commits refused.
    pub refused: u64,
}

/// How much of the last record an answer holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Depth {
    /// Its main numbers.
    Numbers,
    /// All of it but the state.
    Record,
    /// The state too.
    State,
}

impl Loop {
    /// The view with its ports' names.
    pub(crate) fn new(view: deploy::LoopView, ports: &PortTable, depth: Depth) -> Self {
        let last = view
            .last
            .as_ref()
            .map(|record| Record::new(record, ports, depth == Depth::State));
        let spec = draft(&view.spec, &view.component);
        Self {
            name: view.id.to_string(),
            home: view.home.to_string(),
            component: view.component,
            digest: view.spec.digest.to_string(),
            revision: view.spec.revision,
            pending_revision: view.pending,
            past_revisions: view.past,
            spec,
            members: view.members.iter().map(ToString::to_string).collect(),
            owner: last.as_ref().map(|r| r.owner.clone()),
            term: last.as_ref().map(|r| r.term),
            seq: last.as_ref().map(|r| r.seq),
            redundancy: last.as_ref().map(|r| r.redundancy.clone()),
            mode: last.as_ref().map(|r| r.mode),
            setpoint: last.as_ref().and_then(|r| r.setpoint),
            measured_port: ports.measured.and_then(|port| ports.names.get(port).cloned()),
            measurement: last.as_ref().and_then(|r| r.measurement),
            measured_unit: ports.measured_unit.clone(),
            outputs: last.as_ref().map(|r| r.outputs.clone()).unwrap_or_default(),
            last_age_ms: view.last_age_ms,
            tally: view.tally.map(|t| Tally {
                taken: t.taken,
                lost: t.lost,
                skipped: t.skipped,
                takeovers: t.takeovers,
                refused: t.refused,
            }),
            failures: view
                .failures
                .into_iter()
                .map(|f| Failure {
                    revision: f.revision,
                    reason: f.reason,
                    tries: f.tries,
                })
                .collect(),
            last: if depth == Depth::Numbers { None } else { last },
        }
    }
}

/// A specification as it would be written. The component goes by its name where the library knows it.
fn draft(spec: &model::LoopSpec, component: &str) -> LoopDraft {
    LoopDraft {
        name: spec.id.to_string(),
        component: if component.contains('@') {
            component.to_owned()
        } else {
            spec.digest.to_string()
        },
        period_ms: ms(spec.period_ns),
        ports: spec
            .ports
            .iter()
            .map(|(port, point)| (port.clone(), point.to_string()))
            .collect(),
        parameters: spec.parameters.clone(),
        setpoint: spec.setpoint,
        setpoint_range: Some([spec.setpoint_range.0, spec.setpoint_range.1]),
        mode: spec.mode.into(),
        strategy: spec.strategy.into(),
        replicas: spec.replicas,
        limits: spec
            .limits
            .iter()
            .map(|(port, limit)| (port.clone(), (*limit).into()))
            .collect(),
        listens: spec.listens.clone(),
        fallback: spec.fallback.map(|digest| digest.to_string()),
        fallback_parameters: spec.fallback_parameters.clone(),
        prefer: spec.prefer.clone(),
        policy: spec.policy.into(),
    }
}

/// How a change of a loop ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Apply {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// The revision in force now.
    pub revision: u64,
    /// Was the loop new?
    pub created: bool,
    /// Nothing differed, so nothing was done.
    pub unchanged: bool,
    /// How the state of a running loop came over.
    pub hand_over: Option<HandOver>,
    /// Parameters of the old component that the new one does not have, or not with that value: left out.
    pub dropped_parameters: Vec<String>,
    /// Input ports of the old component that the new one does not have: disconnected.
    pub dropped_ports: Vec<String>,
    /// What to look at, for example a step that came near the loop's limit when the component was tried.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// How a state came over, as the committed record says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct HandOver {
    /// "same", "migrate" or "start".
    pub by: String,
    /// Output step beyond what the old controller would have done, in % of span.
    pub bump_percent: Option<f64>,
    /// The component before.
    pub from_digest: String,
}

impl From<deploy::ApplyEnd> for Apply {
    fn from(end: deploy::ApplyEnd) -> Self {
        Self {
            loop_name: end.id.to_string(),
            revision: end.revision,
            created: end.created,
            unchanged: end.unchanged,
            hand_over: end.hand_over.map(|h| HandOver {
                by: h.by,
                bump_percent: finite(h.bump_percent),
                from_digest: h.from_digest.to_string(),
            }),
            dropped_parameters: end.dropped_parameters,
            dropped_ports: end.dropped_ports,
            warnings: end.warnings,
        }
    }
}

/// A command that is in force: it is part of a committed record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Command {
    /// The command, 32 hexadecimal digits: the `Idempotency-Key` where one was given.
    pub command_id: String,
    /// Ownership of the record that holds it.
    pub term: u64,
    /// Cycle of the record that holds it.
    pub seq: u64,
    /// Mode in force with that record.
    pub mode: Mode,
    /// Setpoint in force with that record.
    pub setpoint: Option<f64>,
}

impl From<&deploy::CommandEnd> for Command {
    fn from(end: &deploy::CommandEnd) -> Self {
        Self {
            command_id: format!("{:032x}", end.applied.id.0),
            term: end.position.0,
            seq: end.position.1,
            mode: end.mode.into(),
            setpoint: finite(end.setpoint),
        }
    }
}

/// A new setpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SetpointRequest {
    /// In the unit of the measurement.
    pub setpoint: f64,
}

/// Another mode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ModeRequest {
    /// Manual or automatic.
    pub mode: Mode,
}

/// Outputs in manual.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct OutputRequest {
    /// Values by output port; an output that is not named keeps what it holds.
    pub outputs: BTreeMap<String, f64>,
}

/// Another component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SwapRequest {
    /// `name`, `name@version`, or a digest.
    pub component: String,
}

/// An earlier revision.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RollbackRequest {
    /// Which; the one before where not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<u64>,
}

/// Other parameters or another strategy; what is not named stays.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SetRequest {
    /// Parameters to set, by name.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// Another strategy.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub strategy: Option<Strategy>,
}

/// Another owner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MoveRequest {
    /// The host that shall own the loop.
    pub host: String,
}
