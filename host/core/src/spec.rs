//! A loop's specification: what the engineer decides. One revision of it is current at a time.
//!
//! Owns the checks that need nothing but the text itself; what needs a component or the points is checked at deployment.

use std::{borrow::Cow, collections::BTreeMap};

use serde::{Deserialize, Serialize};

use crate::{
    digest::Digest,
    limits::{MESSAGES_PER_STEP_MAX, PERIOD_NS_MAX, PERIOD_NS_MIN, PREFER_MAX, REPLICAS_MAX},
    name::{HostId, LoopId, PointId},
};

/// Who decides the output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// The operator.
    Manual,
    /// The controller.
    Automatic,
}

/// How the owner chooses the replica that steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Strategy {
    /// Each in turn, by cycle number.
    RoundRobin,
    /// Any, evenly.
    Random,
    /// The least loaded processor.
    Cpu,
    /// The shortest smoothed latency.
    Latency,
    /// Two at random, the better by latency times load.
    P2c,
    /// The owner itself.
    Local,
    /// The same one for a loop, by rendezvous hash.
    Shard,
    /// So many step each cycle, and what a majority of them gives to the last bit is taken; 2 to 16.
    Vote(u8),
}

impl Strategy {
    /// Those that one replica steps under, in the order in which they are documented.
    pub const ALL: [Self; 7] = [
        Self::RoundRobin,
        Self::Random,
        Self::Cpu,
        Self::Latency,
        Self::P2c,
        Self::Local,
        Self::Shard,
    ];

    /// The name used in configuration, API and command line.
    #[must_use]
    pub fn name(self) -> Cow<'static, str> {
        Cow::Borrowed(match self {
            Self::RoundRobin => "round-robin",
            Self::Random => "random",
            Self::Cpu => "cpu",
            Self::Latency => "latency",
            Self::P2c => "p2c",
            Self::Local => "local",
            Self::Shard => "shard",
            Self::Vote(n) => return Cow::Owned(format!("vote({n})")),
        })
    }
}

impl std::str::FromStr for Strategy {
    type Err = SpecError;
    fn from_str(text: &str) -> Result<Self, SpecError> {
        let votes = text.strip_prefix("vote(").and_then(|rest| rest.strip_suffix(')'));
        // `parse` would take a sign, and then two words would mean one strategy.
        let votes = votes.filter(|digits| digits.bytes().all(|b| b.is_ascii_digit()));
        let votes = votes.and_then(|digits| digits.parse().ok()).map(Self::Vote);
        Self::ALL
            .into_iter()
            .find(|s| s.name() == text)
            .or(votes)
            .ok_or_else(|| SpecError::Strategy(text.chars().take(64).collect()))
    }
}

impl Mode {
    /// The name used in configuration, API and command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Manual => "manual",
            Self::Automatic => "automatic",
        }
    }
}

impl std::str::FromStr for Mode {
    type Err = SpecError;
    fn from_str(text: &str) -> Result<Self, SpecError> {
        [Self::Manual, Self::Automatic]
            .into_iter()
            .find(|m| m.name() == text)
            .ok_or_else(|| SpecError::Mode(text.chars().take(64).collect()))
    }
}

/// What an output may do, outside the sandbox, whatever the controller says.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputLimit {
    /// Least value, in the point's unit.
    pub low: f64,
    /// Greatest value.
    pub high: f64,
    /// Greatest change per second; none for no limit. Always written: the wire and disk form has no field names, so a field
    /// that is left out would shift all that follow.
    #[serde(default)]
    pub rate_per_s: Option<f64>,
    /// Where the output goes when the policy says "safe value".
    pub safe: f64,
}

/// What a loop does when it has no good step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnFault {
    /// Keep the output.
    Hold,
    /// Move the output to its safe value, at its rate limit.
    SafeValue,
    /// Keep the output and put the loop in manual.
    Manual,
}

/// What a loop does when a change would step an output farther than it allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnBump {
    /// The old revision stays.
    Refuse,
    /// The new one takes over, and the record says by how much.
    Alarm,
}

/// What a vote does where fewer replicas are left than it asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnFewer {
    /// A majority of those that are left decides; the last one alone, and then nothing stands against an error of it.
    GoOn,
    /// A majority of the number asked for is needed all the same; without it the cycle is a faulty one.
    Fault,
}

/// The bounds within which the host runs the loop.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Policy {
    /// What happens after `faults_tolerated` faulty cycles in a row; until then the output holds.
    pub on_fault: OnFault,
    /// Faulty cycles in a row that only hold.
    pub faults_tolerated: u32,
    /// What happens when a required input is bad; same scale as `on_fault`.
    pub on_bad_input: OnFault,
    /// Longest time of one step, in µs; 0 for a quarter of the period, at most 10 ms.
    pub step_limit_us: u64,
    /// Part of the period after which a silent replica is given up and the next one asked as well.
    pub hedge_part: f64,
    /// Part of the period after which a missing commit moves the ownership.
    pub takeover_part: f64,
    /// Greatest step of an output at a swap beyond what the old controller would have done, in % of the output's span.
    pub bump_limit_percent: f64,
    /// What happens to a change beyond it.
    pub on_bump: OnBump,
    /// Cycles after a swap during which a fault rolls back to the old component.
    pub probation_cycles: u32,
    /// Greatest difference of an output, in probation, from what the old component would send in the same cycle from the
    /// same state, in % of the output's span; more rolls back. None where the two may differ.
    pub probation_deviation_percent: Option<f64>,
    /// Under `vote(n)`: what happens while fewer than n replicas are left.
    pub on_fewer: OnFewer,
}

impl Default for Policy {
    fn default() -> Self {
        Self {
            on_fault: OnFault::Hold,
            faults_tolerated: 3,
            on_bad_input: OnFault::Hold,
            step_limit_us: 0,
            // The owner must have tried a replica and itself before the arbiter looks elsewhere, so hedge < takeover.
            // A takeover at 0.35 is over well before half of the period has gone, and leaves time for a second and a third.
            hedge_part: 0.12,
            takeover_part: 0.35,
            bump_limit_percent: 5.0,
            on_bump: OnBump::Refuse,
            probation_cycles: 20,
            probation_deviation_percent: None,
            // Whoever asks for a vote fears a machine that errs; it may be the one that is left.
            on_fewer: OnFewer::Fault,
        }
    }
}

/// One revision of a loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LoopSpec {
    /// The loop.
    pub id: LoopId,
    /// Grows by one with each change; given by the loop's I/O host, 0 before that.
    pub revision: u64,
    /// The component.
    pub digest: Digest,
    /// Time between cycles, in ns.
    pub period_ns: u64,
    /// Which point each port is connected to, by port name.
    pub ports: BTreeMap<String, PointId>,
    /// Parameters that differ from their defaults, by name.
    pub parameters: BTreeMap<String, f64>,
    /// Setpoint of the first start; later ones are commands.
    pub setpoint: f64,
    /// Least and greatest setpoint accepted.
    pub setpoint_range: (f64, f64),
    /// Mode of the first start; later ones are commands.
    pub mode: Mode,
    /// How the replica that steps is chosen.
    pub strategy: Strategy,
    /// Hosts that hold the loop: the owner and its standbys, all of them replicas.
    pub replicas: u8,
    /// Bounds of each connected output, by port name. A port without one is bound by its point's range.
    pub limits: BTreeMap<String, OutputLimit>,
    /// Topics whose messages the controller receives; at most 16.
    pub listens: Vec<String>,
    /// The component that takes over, without a person, when this one has failed more often in a row than the policy
    /// tolerates; none where the policy alone decides.
    pub fallback: Option<Digest>,
    /// Parameters of the fallback, by name; what is not named it takes from the loop's, or from its own defaults.
    pub fallback_parameters: BTreeMap<String, f64>,
    /// Where the loop would rather run: names and labels of hosts, the best first. Its members are chosen in this order, and
    /// an owner of a better word gets the loop back once it has been well for some time. At most [`PREFER_MAX`] words.
    pub prefer: Vec<String>,
    /// The bounds within which the host runs the loop.
    pub policy: Policy,
}

/// What is wrong with a specification.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SpecError {
    /// Out of range.
    #[error("period {0} ns: a loop's period is 1 ms to 1 h")]
    Period(u64),
    /// Out of range.
    #[error("replicas = {0}: 1 to {REPLICAS_MAX} are possible")]
    Replicas(u8),
    /// Not a strategy.
    #[error(
        "strategy {0:?} is unknown: use round-robin, random, cpu, latency, p2c, local, shard or vote(n), as in vote(3)"
    )]
    Strategy(String),
    /// More votes than replicas, or a vote of one.
    #[error(
        "strategy vote({n}) with replicas = {replicas}: 2 to {REPLICAS_MAX} can vote, and no more than the loop has replicas"
    )]
    Vote {
        /// Votes.
        n: u8,
        /// Replicas of the loop.
        replicas: u8,
    },
    /// Not a mode.
    #[error("mode {0:?} is unknown: use manual or automatic")]
    Mode(String),
    /// No order, or not finite.
    #[error("setpoint {setpoint} with range {low} to {high}: the range must hold it and be finite")]
    Setpoint {
        /// The setpoint.
        setpoint: f64,
        /// Least.
        low: f64,
        /// Greatest.
        high: f64,
    },
    /// No order, or not finite.
    #[error("limits of {port:?}: low <= safe <= high must hold, rate_per_s must be greater than 0, all finite")]
    Limit {
        /// The port.
        port: String,
    },
    /// Too many topics, or one that is empty or too long.
    #[error("listens: at most {MESSAGES_PER_STEP_MAX} topics of 1 to 64 characters")]
    Listens,
    /// Too many words, or one that no host can go by.
    #[error("prefer: at most {PREFER_MAX} names or labels of hosts, of lower-case letters, digits, '-', '_' and '.'")]
    Prefer,
    /// Out of range.
    #[error("policy: {0}")]
    Policy(&'static str),
    /// The component needs it.
    #[error("port {0:?} of the component must be connected to a point")]
    PortMissing(String),
    /// The component has no such port.
    #[error("the component has no port {name:?}; it has {known}")]
    PortUnknown {
        /// The name given.
        name: String,
        /// The names that exist.
        known: String,
    },
    /// The component refuses a parameter.
    #[error(transparent)]
    Parameter(#[from] crate::descriptor::DescriptorError),
}

impl LoopSpec {
    /// Checks everything that needs nothing but the specification itself.
    pub fn check(&self) -> Result<(), SpecError> {
        if !(PERIOD_NS_MIN..=PERIOD_NS_MAX).contains(&self.period_ns) {
            return Err(SpecError::Period(self.period_ns));
        }
        if self.replicas == 0 || usize::from(self.replicas) > REPLICAS_MAX {
            return Err(SpecError::Replicas(self.replicas));
        }
        if let Strategy::Vote(n) = self.strategy
            && (n < 2 || n > self.replicas)
        {
            return Err(SpecError::Vote {
                n,
                replicas: self.replicas,
            });
        }
        let (low, high) = self.setpoint_range;
        let ordered = low.is_finite() && high.is_finite() && (low..=high).contains(&self.setpoint);
        if !ordered {
            return Err(SpecError::Setpoint {
                setpoint: self.setpoint,
                low,
                high,
            });
        }
        for (port, l) in &self.limits {
            let rate_ok = l.rate_per_s.is_none_or(|r| r.is_finite() && r > 0.0);
            let range_ok = l.low.is_finite() && l.high.is_finite() && (l.low..=l.high).contains(&l.safe);
            if !(rate_ok && range_ok) {
                return Err(SpecError::Limit { port: port.clone() });
            }
        }
        if self.listens.len() > MESSAGES_PER_STEP_MAX || self.listens.iter().any(|t| t.is_empty() || t.len() > 64) {
            return Err(SpecError::Listens);
        }
        if self.prefer.len() > PREFER_MAX || self.prefer.iter().any(|word| HostId::new(word).is_err()) {
            return Err(SpecError::Prefer);
        }
        let p = &self.policy;
        if !(0.01..=0.9).contains(&p.hedge_part) {
            return Err(SpecError::Policy("hedge_part must be 0.01 to 0.9 of the period"));
        }
        if !(p.takeover_part > p.hedge_part && p.takeover_part <= 0.95) {
            return Err(SpecError::Policy(
                "takeover_part must be greater than hedge_part and at most 0.95 of the period",
            ));
        }
        if !(p.bump_limit_percent >= 0.0 && p.bump_limit_percent.is_finite()) {
            return Err(SpecError::Policy("bump_limit_percent must be 0 or more"));
        }
        if p.probation_deviation_percent
            .is_some_and(|limit| !(limit > 0.0 && limit.is_finite()))
        {
            return Err(SpecError::Policy(
                "probation_deviation_percent must be greater than 0, or be left out",
            ));
        }
        if p.step_limit_us.saturating_mul(1000) > self.period_ns {
            return Err(SpecError::Policy("step_limit_us must not be longer than the period"));
        }
        Ok(())
    }

    /// Checks what the component says against what the loop connects and sets.
    pub fn check_against(&self, descriptor: &crate::Descriptor) -> Result<(), SpecError> {
        let known = || {
            descriptor
                .ports
                .iter()
                .map(|p| p.name.as_str())
                .collect::<Vec<_>>()
                .join(", ")
        };
        for name in self.ports.keys().chain(self.limits.keys()) {
            if descriptor.port(name).is_none() {
                return Err(SpecError::PortUnknown {
                    name: name.clone(),
                    known: known(),
                });
            }
        }
        if let Some(p) = descriptor
            .ports
            .iter()
            .find(|p| p.required && !self.ports.contains_key(&p.name))
        {
            return Err(SpecError::PortMissing(p.name.clone()));
        }
        descriptor.parameter_values(self.parameters.iter().map(|(n, v)| (n.as_str(), *v)))?;
        Ok(())
    }

    /// Longest time of one step, in ns: what the policy says, or a quarter of the period but at most 10 ms, so that a
    /// spinning guest is stopped early enough for the fallback to act within the same period.
    #[must_use]
    pub fn step_limit_ns(&self) -> u64 {
        match self.policy.step_limit_us {
            0 => (self.period_ns / 4).min(10_000_000),
            us => us * 1000,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn strategies_are_words_and_back() {
        for strategy in Strategy::ALL.into_iter().chain([Strategy::Vote(2), Strategy::Vote(16)]) {
            assert_eq!(strategy.name().parse::<Strategy>().unwrap(), strategy);
        }
        for bad in [
            "vote",
            "vote()",
            "vote(x)",
            "vote(+3)",
            "vote(-1)",
            "vote(3",
            "vote(300)",
            "vote( 3)",
            "Vote(3)",
            "",
        ] {
            let error = bad.parse::<Strategy>().unwrap_err().to_string();
            assert!(error.contains("use round-robin"), "{bad}: {error}");
        }
    }

    #[test]
    fn a_vote_needs_that_many_replicas() {
        for (n, replicas, good) in [
            (3, 3, true),
            (2, 3, true),
            (4, 3, false),
            (1, 3, false),
            (0, 3, false),
            (16, 16, true),
        ] {
            let spec = LoopSpec {
                strategy: Strategy::Vote(n),
                replicas,
                ..crate::intent::test_spec()
            };
            let checked = spec.check();
            assert_eq!(checked.is_ok(), good, "vote({n}) with {replicas}: {checked:?}");
        }
    }
}
