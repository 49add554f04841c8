//! What a replay, a backtest or a shadow found: plain data, copied out.
//!
//! Never: decides anything; replays and rehearsals fill it in.

use std::collections::BTreeMap;

use bumpless_core::{Digest, LoopId, Record};
use serde::{Deserialize, Serialize};

/// Points of a series at most: more than a screen has columns, and some 100 KB of JSON.
pub const POINTS_MAX: usize = 2_000;

/// Recorded cycles of a loop, for a reader.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CyclesView {
    /// The records, oldest first.
    pub records: Vec<Record>,
    /// Are there more in the window than fit into one answer? They go on after the last of these.
    pub more: bool,
    /// Pieces of the log that were damaged and left out.
    pub unread: u64,
}

/// Cycles that were left out, and why.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Skipped {
    /// In words.
    pub reason: String,
    /// How many.
    pub cycles: u64,
}

/// Something that one cycle showed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// Position of the cycle's record, (term, seq).
    pub position: (u64, u64),
    /// In words.
    pub text: String,
}

/// What a replay found: every recorded step again, through the component that made it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReplayReport {
    /// The loop.
    pub loop_id: LoopId,
    /// Time of the first record looked at, in ns of the home's clock; 0 where there was none.
    pub from_ns: u64,
    /// Time of the last one.
    pub to_ns: u64,
    /// Steps made again and compared.
    pub compared: u64,
    /// Those that came out equal to the last bit: outputs, state, messages, alarms and log.
    pub equal: u64,
    /// Cycles that were not stepped again.
    pub skipped: Vec<Skipped>,
    /// The first step that came out otherwise.
    pub first_difference: Option<Finding>,
    /// Pieces of the log that were damaged and left out.
    pub unread: u64,
    /// Why the replay stopped before the end of the window; none where it did not.
    pub stopped_early: Option<String>,
}

/// A component that shall show what it would do on a loop's cycles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// The component: `name`, `name@version`, or a digest or its beginning.
    pub component: String,
    /// Parameters that differ from those that a swap would take over.
    pub parameters: BTreeMap<String, f64>,
}

/// How a trial ended, in one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verdict {
    /// The outputs are the same, up to a ten-thousandth of their span.
    Same,
    /// They never differ by more than the loop allows a swap to step.
    Close,
    /// They do.
    Differs,
    /// The component faulted.
    Fails,
}

/// Processor time of the candidate's steps, in µs. The same components take a little longer in a loop, where more goes on
/// between two steps.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct StepTimes {
    /// Half of the steps took at most this.
    pub p50_us: f64,
    /// 99 of 100 took at most this.
    pub p99_us: f64,
    /// The longest.
    pub worst_us: f64,
}

/// One output of the candidate beside the recorded one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OutputReport {
    /// The candidate's port.
    pub port: String,
    /// Its unit.
    pub unit: String,
    /// Its span, in that unit.
    pub span: f64,
    /// Greatest difference, in % of span.
    pub max_percent: f64,
    /// Position of the cycle with that difference.
    pub max_at: (u64, u64),
    /// Mean of the differences without their signs, in % of span.
    pub mean_percent: f64,
    /// Root of their mean square, in % of span.
    pub rms_percent: f64,
    /// How far the recorded output travelled, in its unit.
    pub recorded_travel: f64,
    /// How far the candidate's would have.
    pub candidate_travel: f64,
}

/// How well the loop was controlled in the window, by the recorded controller. Units as in `bumpless_core::indices`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct IndexReport {
    /// Time from the first to the last sample, in s.
    pub duration_s: f64,
    /// Integral of the error, in unit·s.
    pub ie: f64,
    /// Integral of the absolute error, in unit·s.
    pub iae: f64,
    /// Integral of the squared error, in unit²·s.
    pub ise: f64,
    /// Integral of the absolute error times time, in unit·s².
    pub itae: f64,
    /// IAE in % of the integral of the setpoint; none where that is 0.
    pub id_percent: Option<f64>,
}

/// One point of the curves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// When the inputs were frozen, in ns of the home's clock.
    pub at_ns: u64,
    /// Wanted value.
    pub setpoint: f64,
    /// Measured value; NaN where the component measures nothing.
    pub measurement: f64,
    /// What the recorded controller wanted, within its limits: one per entry of [`TrialReport::outputs`].
    pub recorded: Vec<f64>,
    /// What the candidate would have wanted, within its limits.
    pub candidate: Vec<f64>,
}

/// What a backtest or a shadow found. The plant was moved by the recorded controller, never by the candidate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrialReport {
    /// The loop.
    pub loop_id: LoopId,
    /// `name@version` of the candidate.
    pub component: String,
    /// Its digest.
    pub digest: Digest,
    /// Its parameters that differ from their defaults.
    pub parameters: BTreeMap<String, f64>,
    /// Parameters of the loop that it does not have, or not with that value.
    pub dropped_parameters: Vec<String>,
    /// Input ports of the loop that it does not have.
    pub dropped_ports: Vec<String>,
    /// How the state came over at first: "same", "migrate" or "start"; none where it never did.
    pub taken_over_by: Option<String>,
    /// How often the candidate began anew because cycles were missing.
    pub anchored_anew: u64,
    /// Time of the first cycle, in ns of the home's clock; 0 where there was none.
    pub from_ns: u64,
    /// Time of the last one.
    pub to_ns: u64,
    /// Cycles that the candidate saw.
    pub cycles: u64,
    /// Cycles whose outputs were compared.
    pub compared: u64,
    /// Compared cycles whose outputs were equal to the last bit.
    pub equal: u64,
    /// Cycles without a step, because an input that the candidate needs was bad.
    pub held: u64,
    /// Cycles in which it faulted.
    pub faults: u64,
    /// The first fault.
    pub first_fault: Option<Finding>,
    /// Cycles that were left out.
    pub skipped: Vec<Skipped>,
    /// Step of the output in the first cycle beyond what the recorded controller did, in % of span.
    pub bump_percent: Option<f64>,
    /// What the loop allows.
    pub bump_limit_percent: f64,
    /// Each output that both have.
    pub outputs: Vec<OutputReport>,
    /// How long the steps took.
    pub steps: StepTimes,
    /// How well the loop was controlled meanwhile.
    pub indices: IndexReport,
    /// In one word; none as long as there is nothing to judge.
    pub verdict: Option<Verdict>,
    /// Why, in words.
    pub reason: String,
    /// The measured port.
    pub measured_port: Option<String>,
    /// Its unit.
    pub measured_unit: String,
    /// Each point stands for so many cycles, and is the one in which the outputs differ most.
    pub cycles_per_point: u64,
    /// The curves, at most [`POINTS_MAX`] points.
    pub points: Vec<CurvePoint>,
    /// Pieces of the log that were damaged and left out.
    pub unread: u64,
    /// Why it stopped before the end of the window; none where it did not.
    pub stopped_early: Option<String>,
}

/// A shadow: a candidate that follows a running loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShadowView {
    /// Its number at the loop's home.
    pub id: u64,
    /// Cycles that it shall see.
    pub cycles_wanted: u64,
    /// Cycles that came while it was behind, and that it did not see.
    pub missed: u64,
    /// When it began, in ms of Unix time by the home's clock.
    pub started_at_unix_ms: u64,
    /// Why it ended, in words; none while it follows.
    pub ended: Option<String>,
    /// Did it see all the cycles that it should?
    pub complete: bool,
    /// What it found so far. Lists have it without its points.
    pub report: TrialReport,
}
