//! What a component's trial at its upload found: the report that is kept with it and travels with it.
//!
//! Owns: the report's nouns, their bounds, and the comparison of measured steps with a loop's limit.
//! Never: runs a trial (deployment does), and never trust in one: a component that passed may still misbehave in service,
//! which is what policy and probation are for.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{limits::TEXT_CHARS_MAX, name::HostId};

/// Findings of one report: enough to tell every kind of misdeed once.
pub const FINDINGS_MAX: usize = 32;

/// Steps that a trial must have measured before its times say anything about a loop.
pub const STEPS_MEASURED_MIN: u32 = 50;

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Severity {
    /// Good to know.
    Info,
    /// It may run, but look at this first.
    Warning,
    /// It may not come in, except by force.
    Refusal,
}

/// One thing that a trial found.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// What, in words; at most 512 characters.
    pub text: String,
}

/// What the trial says in one word.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// Nothing against it.
    Passed,
    /// It may run; there are warnings.
    Warned,
    /// It may not come in.
    Refused,
    /// It was refused, and somebody took it in nevertheless.
    Forced,
}

impl Verdict {
    /// The name used in API and command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Passed => "passed",
            Self::Warned => "warned",
            Self::Refused => "refused",
            Self::Forced => "forced",
        }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What the component did with a state of its own that it was to take over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Migrated {
    /// The trial did not come to it.
    Untried,
    /// It went on from it.
    Accepted,
    /// It declined in words, so a swap starts it from the actuators.
    Declined,
}

impl Migrated {
    /// The name used in API and command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Untried => "untried",
            Self::Accepted => "accepted",
            Self::Declined => "declined",
        }
    }
}

/// The report of a trial. Times are the component's own processor time on the host that tried it, in ns.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Admission {
    /// When it was tried, in ms since 1970-01-01 UTC by that host's clock.
    pub checked_at_unix_ms: u64,
    /// The host that tried it.
    pub host: HostId,
    /// What the trial says in one word.
    pub verdict: Verdict,
    /// Cycles that were tried.
    pub cycles: u32,
    /// Good steps among them, which the times below are of.
    pub steps: u32,
    /// Half of the steps took no longer.
    pub step_p50_ns: u64,
    /// 99 of 100 steps took no longer.
    pub step_p99_ns: u64,
    /// The longest step; one that seemed to be it was measured twice, and the shorter time counts.
    pub step_worst_ns: u64,
    /// Time of `start`.
    pub start_ns: u64,
    /// What it did with its own state.
    pub migrated: Migrated,
    /// Time of that `migrate`; 0 where it was not tried.
    pub migrate_ns: u64,
    /// The largest state that it returned, in bytes.
    pub state_bytes: u64,
    /// Linear memory of its instance after the trial, in bytes.
    pub memory_bytes: u64,
    /// Time of the compilation by the clock, in ms; none where compiled code was at hand.
    pub compile_ms: Option<u64>,
    /// What was found, the gravest first; at most [`FINDINGS_MAX`].
    pub findings: Vec<Finding>,
}

/// What is wrong with a report that came from another host.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AdmissionError {
    /// Too many findings.
    #[error("{0} findings; at most {FINDINGS_MAX} are kept")]
    Findings(usize),
    /// A text over the limit.
    #[error("a finding is longer than {TEXT_CHARS_MAX} characters")]
    TextTooLong,
    /// Times that cannot be.
    #[error("step times {p50} <= {p99} <= {worst} ns do not hold")]
    Times {
        /// Half of the steps.
        p50: u64,
        /// 99 of 100.
        p99: u64,
        /// All.
        worst: u64,
    },
}

/// What the measured steps mean for a loop's step limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fit {
    /// They fit, or too little was measured to say so.
    Fits,
    /// The longest step came near the limit.
    Near,
    /// The longest step passed the limit: in service it would be stopped, and count as a fault.
    Beyond,
}

impl Admission {
    /// Checks a report that came from another host.
    ///
    /// # Errors
    /// The first thing that does not hold.
    pub fn check(&self) -> Result<(), AdmissionError> {
        if self.findings.len() > FINDINGS_MAX {
            return Err(AdmissionError::Findings(self.findings.len()));
        }
        if self.findings.iter().any(|f| f.text.chars().count() > TEXT_CHARS_MAX) {
            return Err(AdmissionError::TextTooLong);
        }
        let (p50, p99, worst) = (self.step_p50_ns, self.step_p99_ns, self.step_worst_ns);
        if p50 > p99 || p99 > worst {
            return Err(AdmissionError::Times { p50, p99, worst });
        }
        Ok(())
    }

    /// Adds a warning that is none of the trial's own; a report that passed is one that warns then.
    pub fn warn(&mut self, text: &str) {
        let finding = Finding {
            severity: Severity::Warning,
            text: text.chars().take(TEXT_CHARS_MAX).collect(),
        };
        let place = self
            .findings
            .partition_point(|known| known.severity >= Severity::Warning);
        self.findings.insert(place, finding);
        self.findings.truncate(FINDINGS_MAX);
        if self.verdict == Verdict::Passed {
            self.verdict = Verdict::Warned;
        }
    }

    /// Do the measured steps fit a limit, in ns? Half of it is near: the host that steps may be half as fast as the one
    /// that measured.
    #[must_use]
    pub const fn fit(&self, limit_ns: u64) -> Fit {
        if self.steps < STEPS_MEASURED_MIN {
            Fit::Fits
        } else if self.step_worst_ns > limit_ns {
            Fit::Beyond
        } else if self.step_worst_ns > limit_ns / 2 {
            Fit::Near
        } else {
            Fit::Fits
        }
    }

    /// The findings of one severity.
    pub fn of(&self, severity: Severity) -> impl Iterator<Item = &str> {
        self.findings
            .iter()
            .filter(move |finding| finding.severity == severity)
            .map(|finding| finding.text.as_str())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    fn report() -> Admission {
        Admission {
            checked_at_unix_ms: 1,
            host: HostId::new("h").unwrap(),
            verdict: Verdict::Passed,
            cycles: 400,
            steps: 400,
            step_p50_ns: 1_000,
            step_p99_ns: 2_000,
            step_worst_ns: 9_000,
            start_ns: 5_000,
            migrated: Migrated::Accepted,
            migrate_ns: 3_000,
            state_bytes: 40,
            memory_bytes: 65_536,
            compile_ms: Some(12),
            findings: vec![Finding {
                severity: Severity::Info,
                text: "it is small".into(),
            }],
        }
    }

    #[test]
    fn a_good_report_passes_and_each_bad_part_is_named() {
        assert_eq!(report().check(), Ok(()));
        type Spoil = fn(&mut Admission);
        let table: [(Spoil, &str); 4] = [
            (
                |a| a.findings = vec![a.findings[0].clone(); FINDINGS_MAX + 1],
                "33 findings",
            ),
            (|a| a.findings[0].text = "x".repeat(TEXT_CHARS_MAX + 1), "a finding"),
            (|a| a.step_p50_ns = 3_000, "3000 <= 2000 <= 9000"),
            (|a| a.step_worst_ns = 1_999, "1000 <= 2000 <= 1999"),
        ];
        for (spoil, part) in table {
            let mut bad = report();
            spoil(&mut bad);
            let error = bad.check().expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
    }

    #[test]
    fn steps_are_compared_with_a_limit_only_where_enough_were_measured() {
        let measured = report();
        assert_eq!(measured.fit(18_000), Fit::Fits);
        assert_eq!(measured.fit(17_999), Fit::Near);
        assert_eq!(measured.fit(9_000), Fit::Near);
        assert_eq!(measured.fit(8_999), Fit::Beyond, "whatever 99 of 100 took");
        let few = Admission {
            steps: STEPS_MEASURED_MIN - 1,
            ..report()
        };
        assert_eq!(few.fit(1), Fit::Fits);
    }

    #[test]
    fn findings_are_told_apart_by_how_much_they_matter() {
        let report = report();
        assert_eq!(report.of(Severity::Info).collect::<Vec<_>>(), ["it is small"]);
        assert_eq!(report.of(Severity::Refusal).next(), None);
        assert!(Severity::Refusal > Severity::Warning && Severity::Warning > Severity::Info);
    }
}
