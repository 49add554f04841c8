//! Looking back: recorded cycles, replays, backtests and shadows.

use std::collections::BTreeMap;

use bumpless_deploy::{Window, report};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Record, finite};

/// Recorded cycles of a loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Cycles {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// The records, oldest first.
    pub records: Vec<Record>,
    /// Are there more in the window?
    pub more: bool,
    /// Then: where they begin. Ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
    /// Pieces of the log that were damaged and left out.
    pub unread: u64,
}

/// Which recorded cycles: the newest, or those between two times. The last 1,000 where nothing is said.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReplayRequest {
    /// The newest: a number of cycles (`5000`), or a time (`500ms`, `30s`, `10m`, `2h`).
    pub last: Option<String>,
    /// From this time on, in µs since 1970-01-01 UTC by the clock of the loop's home.
    pub from_unix_us: Option<u64>,
    /// Up to this time.
    pub to_unix_us: Option<u64>,
}

/// A candidate, and which recorded cycles it shall be tried on: as for a replay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct BacktestRequest {
    /// The component: `name`, `name@version`, or a digest or its first 8 digits.
    pub component: String,
    /// Parameters that differ from those that a swap would take over.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// The newest: a number of cycles (`5000`), or a time (`500ms`, `30s`, `10m`, `2h`).
    #[serde(default)]
    pub last: Option<String>,
    /// From this time on, in µs since 1970-01-01 UTC by the clock of the loop's home.
    #[serde(default)]
    pub from_unix_us: Option<u64>,
    /// Up to this time.
    #[serde(default)]
    pub to_unix_us: Option<u64>,
}

/// A candidate that shall follow a loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ShadowRequest {
    /// The component: `name`, `name@version`, or a digest or its first 8 digits.
    pub component: String,
    /// Parameters that differ from those that a swap would take over.
    #[serde(default)]
    pub parameters: BTreeMap<String, f64>,
    /// For so many cycles, 1 to 1,000,000.
    pub cycles: u64,
}

/// Cycles that were left out, and why.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Skipped {
    /// In words.
    pub reason: String,
    /// How many.
    pub cycles: u64,
}

/// Something that one cycle showed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct CycleFinding {
    /// Number of the ownership.
    pub term: u64,
    /// Number of the cycle.
    pub seq: u64,
    /// In words.
    pub text: String,
}

/// What a replay found: every recorded step again, through the component that made it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Replay {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// Time of the first cycle, in µs since 1970-01-01 UTC; 0 where there was none.
    pub from_unix_us: u64,
    /// Time of the last one.
    pub to_unix_us: u64,
    /// Steps made again and compared.
    pub compared: u64,
    /// Those that came out equal to the last bit: outputs, state, messages, alarms and log.
    pub equal: u64,
    /// Cycles that were not stepped again.
    pub skipped: Vec<Skipped>,
    /// The first step that came out otherwise.
    pub first_difference: Option<CycleFinding>,
    /// Pieces of the log that were damaged and left out.
    pub unread: u64,
    /// Why it stopped before the end of the window; none where it did not.
    pub stopped_early: Option<String>,
}

/// How a trial ended, in one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TrialVerdict {
    /// The outputs are the same, up to a ten-thousandth of their span.
    Same,
    /// They never differ by more than the loop allows a swap to step.
    Close,
    /// They do.
    Differs,
    /// The component faulted.
    Fails,
}

/// One output of the candidate beside the recorded one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct OutputTrial {
    /// The candidate's port.
    pub port: String,
    /// Its unit.
    pub unit: String,
    /// Its span, in that unit.
    pub span: f64,
    /// Greatest difference, in % of span.
    pub max_percent: Option<f64>,
    /// Number of the ownership in the cycle with that difference.
    pub max_term: u64,
    /// Number of that cycle.
    pub max_seq: u64,
    /// Mean of the differences without their signs, in % of span.
    pub mean_percent: Option<f64>,
    /// Root of their mean square, in % of span.
    pub rms_percent: Option<f64>,
    /// How far the recorded output travelled (total variation), in its unit.
    pub recorded_travel: Option<f64>,
    /// How far the candidate's would have.
    pub candidate_travel: Option<f64>,
}

/// Processor time of the candidate's steps, in µs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StepTimes {
    /// Half of the steps took at most this.
    pub p50_us: f64,
    /// 99 of 100 took at most this.
    pub p99_us: f64,
    /// The longest.
    pub worst_us: f64,
}

/// How well the loop was controlled in the window, by the recorded controller.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LoopIndices {
    /// Time from the first to the last sample, in s.
    pub duration_s: f64,
    /// Integral of the error, in unit·s.
    pub ie: Option<f64>,
    /// Integral of the absolute error, in unit·s.
    pub iae: Option<f64>,
    /// Integral of the squared error, in unit²·s.
    pub ise: Option<f64>,
    /// Integral of the absolute error times time, in unit·s².
    pub itae: Option<f64>,
    /// IAE in % of the integral of the setpoint; none where that is 0.
    pub id_percent: Option<f64>,
}

/// One point of the curves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CurvePoint {
    /// When the inputs were frozen, in µs since 1970-01-01 UTC.
    pub at_unix_us: u64,
    /// Wanted value.
    pub setpoint: Option<f64>,
    /// Measured value.
    pub measurement: Option<f64>,
    /// What the recorded controller wanted, within its limits: one per entry of `outputs`.
    pub recorded: Vec<Option<f64>>,
    /// What the candidate would have wanted, within its limits.
    pub candidate: Vec<Option<f64>>,
}

/// What a backtest or a shadow found. The plant was moved by the recorded controller, never by the candidate: where the
/// candidate would have moved it elsewhere, only the beginning of that is seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Trial {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// `name@version` of the candidate.
    pub component: String,
    /// Its digest.
    pub digest: String,
    /// Its parameters that differ from their defaults.
    pub parameters: BTreeMap<String, f64>,
    /// Parameters of the loop that it does not have, or not with that value.
    pub dropped_parameters: Vec<String>,
    /// Input ports of the loop that it does not have.
    pub dropped_ports: Vec<String>,
    /// In one word; none as long as there is nothing to judge.
    pub verdict: Option<TrialVerdict>,
    /// Why, in words.
    pub reason: String,
    /// How the state came over at first: "same", "migrate" or "start"; none where it never did.
    pub taken_over_by: Option<String>,
    /// How often the candidate began anew because cycles were missing.
    pub anchored_anew: u64,
    /// Time of the first cycle, in µs since 1970-01-01 UTC; 0 where there was none.
    pub from_unix_us: u64,
    /// Time of the last one.
    pub to_unix_us: u64,
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
    pub first_fault: Option<CycleFinding>,
    /// Cycles that were left out.
    pub skipped: Vec<Skipped>,
    /// Step of the output in the first cycle beyond what the recorded controller did, in % of span.
    pub bump_percent: Option<f64>,
    /// What the loop allows.
    pub bump_limit_percent: f64,
    /// Each output that both have.
    pub outputs: Vec<OutputTrial>,
    /// How long the steps took.
    pub steps: StepTimes,
    /// How well the loop was controlled meanwhile.
    pub indices: LoopIndices,
    /// The measured port.
    pub measured_port: Option<String>,
    /// Its unit.
    pub measured_unit: String,
    /// Each point stands for so many cycles, and is the one in which the outputs differ most.
    pub cycles_per_point: u64,
    /// The curves, at most 2,000 points.
    pub points: Vec<CurvePoint>,
    /// Pieces of the log that were damaged and left out.
    pub unread: u64,
    /// Why it stopped before the end of the window; none where it did not.
    pub stopped_early: Option<String>,
}

/// A candidate that follows a running loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Shadow {
    /// Its number at the loop's home.
    pub id: u64,
    /// Cycles that it shall see.
    pub cycles_wanted: u64,
    /// Cycles that came while it was behind, and that it did not see.
    pub missed: u64,
    /// When it began, in ms since 1970-01-01 UTC.
    pub started_at_unix_ms: u64,
    /// Why it ended, in words; none while it follows.
    pub ended: Option<String>,
    /// Did it see all the cycles that it should?
    pub complete: bool,
    /// What it found so far.
    pub report: Trial,
}

/// The shadows of a loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Shadows {
    /// Oldest first, without their points.
    pub shadows: Vec<Shadow>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

/// What a window is where nothing is said.
const WINDOW_DEFAULT: Window = Window::Last(1_000);

/// A window from what was asked, or why it is none.
pub(crate) fn window(last: Option<&str>, from_us: Option<u64>, to_us: Option<u64>) -> Result<Window, String> {
    match (last, from_us, to_us) {
        (None, None, None) => Ok(WINDOW_DEFAULT),
        (Some(last), None, None) => newest(last),
        (None, from, to) => Ok(Window::Between(
            from.unwrap_or_default().saturating_mul(1_000),
            // To the end of that µs.
            to.map_or(u64::MAX, |to| to.saturating_mul(1_000).saturating_add(999)),
        )),
        (Some(_), ..) => Err("last and times are two ways to say it: give one".to_owned()),
    }
}

/// `5000`, `500ms`, `30s`, `10m`, `2h`.
fn newest(text: &str) -> Result<Window, String> {
    let wrong = || {
        let text: String = text.chars().take(40).collect();
        format!("last = {text:?}: give a number of cycles (5000) or a time (500ms, 30s, 10m, 2h)")
    };
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let number: u64 = digits.parse().map_err(|_| wrong())?;
    let unit_ns = match text.get(digits.len()..) {
        Some("") => return Ok(Window::Last(number)),
        Some("ms") => 1_000_000,
        Some("s") => 1_000_000_000,
        Some("m") => 60_000_000_000,
        Some("h") => 3_600_000_000_000,
        _ => return Err(wrong()),
    };
    Ok(Window::Recent(number.saturating_mul(unit_ns)))
}

fn skipped(all: Vec<report::Skipped>) -> Vec<Skipped> {
    let one = |s: report::Skipped| Skipped {
        reason: s.reason,
        cycles: s.cycles,
    };
    all.into_iter().map(one).collect()
}

impl From<report::Finding> for CycleFinding {
    fn from(finding: report::Finding) -> Self {
        Self {
            term: finding.position.0,
            seq: finding.position.1,
            text: finding.text,
        }
    }
}

impl From<report::ReplayReport> for Replay {
    fn from(report: report::ReplayReport) -> Self {
        Self {
            loop_name: report.loop_id.to_string(),
            from_unix_us: report.from_ns / 1_000,
            to_unix_us: report.to_ns / 1_000,
            compared: report.compared,
            equal: report.equal,
            skipped: skipped(report.skipped),
            first_difference: report.first_difference.map(Into::into),
            unread: report.unread,
            stopped_early: report.stopped_early,
        }
    }
}

impl From<report::Verdict> for TrialVerdict {
    fn from(verdict: report::Verdict) -> Self {
        match verdict {
            report::Verdict::Same => Self::Same,
            report::Verdict::Close => Self::Close,
            report::Verdict::Differs => Self::Differs,
            report::Verdict::Fails => Self::Fails,
        }
    }
}

impl TrialVerdict {
    /// The word as JSON has it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Same => "same",
            Self::Close => "close",
            Self::Differs => "differs",
            Self::Fails => "fails",
        }
    }
}

impl From<report::OutputReport> for OutputTrial {
    fn from(output: report::OutputReport) -> Self {
        Self {
            port: output.port,
            unit: output.unit,
            span: output.span,
            max_percent: finite(output.max_percent),
            max_term: output.max_at.0,
            max_seq: output.max_at.1,
            mean_percent: finite(output.mean_percent),
            rms_percent: finite(output.rms_percent),
            recorded_travel: finite(output.recorded_travel),
            candidate_travel: finite(output.candidate_travel),
        }
    }
}

impl From<report::CurvePoint> for CurvePoint {
    fn from(point: report::CurvePoint) -> Self {
        Self {
            at_unix_us: point.at_ns / 1_000,
            setpoint: finite(point.setpoint),
            measurement: finite(point.measurement),
            recorded: point.recorded.into_iter().map(finite).collect(),
            candidate: point.candidate.into_iter().map(finite).collect(),
        }
    }
}

impl From<report::TrialReport> for Trial {
    fn from(report: report::TrialReport) -> Self {
        Self {
            loop_name: report.loop_id.to_string(),
            component: report.component,
            digest: report.digest.to_string(),
            parameters: report.parameters,
            dropped_parameters: report.dropped_parameters,
            dropped_ports: report.dropped_ports,
            verdict: report.verdict.map(Into::into),
            reason: report.reason,
            taken_over_by: report.taken_over_by,
            anchored_anew: report.anchored_anew,
            from_unix_us: report.from_ns / 1_000,
            to_unix_us: report.to_ns / 1_000,
            cycles: report.cycles,
            compared: report.compared,
            equal: report.equal,
            held: report.held,
            faults: report.faults,
            first_fault: report.first_fault.map(Into::into),
            skipped: skipped(report.skipped),
            bump_percent: report.bump_percent.and_then(finite),
            bump_limit_percent: report.bump_limit_percent,
            outputs: report.outputs.into_iter().map(Into::into).collect(),
            steps: StepTimes {
                p50_us: report.steps.p50_us,
                p99_us: report.steps.p99_us,
                worst_us: report.steps.worst_us,
            },
            indices: LoopIndices {
                duration_s: report.indices.duration_s,
                ie: finite(report.indices.ie),
                iae: finite(report.indices.iae),
                ise: finite(report.indices.ise),
                itae: finite(report.indices.itae),
                id_percent: report.indices.id_percent.and_then(finite),
            },
            measured_port: report.measured_port,
            measured_unit: report.measured_unit,
            cycles_per_point: report.cycles_per_point,
            points: report.points.into_iter().map(Into::into).collect(),
            unread: report.unread,
            stopped_early: report.stopped_early,
        }
    }
}

impl From<report::ShadowView> for Shadow {
    fn from(view: report::ShadowView) -> Self {
        Self {
            id: view.id,
            cycles_wanted: view.cycles_wanted,
            missed: view.missed,
            started_at_unix_ms: view.started_at_unix_ms,
            ended: view.ended,
            complete: view.complete,
            report: view.report.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn windows_are_said_in_cycles_or_times() {
        let s = 1_000_000_000;
        for (text, wanted) in [
            ("5000", Window::Last(5000)),
            ("250ms", Window::Recent(s / 4)),
            ("30s", Window::Recent(30 * s)),
            ("10m", Window::Recent(600 * s)),
            ("2h", Window::Recent(7200 * s)),
            ("99999999999999999h", Window::Recent(u64::MAX)),
        ] {
            assert_eq!(window(Some(text), None, None).unwrap(), wanted, "{text}");
        }
        assert_eq!(window(None, None, None).unwrap(), Window::Last(1_000));
        assert_eq!(window(None, Some(5), None).unwrap(), Window::Between(5_000, u64::MAX));
        assert_eq!(window(None, None, Some(5)).unwrap(), Window::Between(0, 5_999));
        for bad in ["", "m", "-5", "5d", "5 s", "1.5s", "10ms5", "ü"] {
            let error = window(Some(bad), None, None).expect_err(bad);
            assert!(error.contains("500ms, 30s, 10m, 2h"), "{error}");
        }
        assert!(window(Some("5"), Some(1), None).expect_err("both").contains("give one"));
    }
}
