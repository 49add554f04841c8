//! What goes into one step and what comes out of it. A step has no other way in or out.

use serde::{Deserialize, Serialize};

use crate::{reading::Reading, spec::Mode};

/// What one cycle is about; the numbers that a step may depend on besides its readings and state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Cycle {
    /// Number of the cycle; gaps are cycles that were lost.
    pub seq: u64,
    /// When the inputs were frozen, in ns of the I/O server's clock.
    pub at_ns: u64,
    /// Time since the step that produced the state, in ns; at least 1.
    pub dt_ns: u64,
    /// Who decides the output.
    pub mode: Mode,
    /// Wanted value.
    pub setpoint: f64,
}

/// Everything that a step may see.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// The cycle's numbers.
    pub cycle: Cycle,
    /// One reading per port of the component, by number. For an output port: what the actuator holds.
    pub readings: Vec<Reading>,
    /// Messages that arrived since the last step.
    pub messages: Vec<Message>,
}

/// Everything that a step did, to be taken together with its outputs or not at all.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Effects {
    /// The next state.
    pub state: Vec<u8>,
    /// One value per port that was written: (port number, value). Finite; the last write of a port counts.
    pub writes: Vec<(u8, f64)>,
    /// Messages to publish when the cycle commits.
    pub messages: Vec<Message>,
    /// Alarms raised and cleared.
    pub alarms: Vec<AlarmChange>,
    /// Log lines.
    pub log: Vec<LogLine>,
}

/// A message between loops and programs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Message {
    /// Topic, at most 64 characters.
    pub topic: String,
    /// At most 4,096 bytes.
    pub data: Vec<u8>,
}

/// How urgent an alarm is (ISA-18.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Priority {
    /// Act soon.
    Low,
    /// Act promptly.
    Medium,
    /// Act at once.
    High,
}

/// One alarm of a controller, raised or cleared.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AlarmChange {
    /// Name, unique in the loop.
    pub name: String,
    /// Its priority and text when raised; none when cleared.
    pub raised: Option<(Priority, String)>,
}

/// How much a log line matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LogLevel {
    /// For the author.
    Debug,
    /// For the record.
    Info,
    /// Something is odd.
    Warning,
}

/// One line from a guest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogLine {
    /// How much it matters.
    pub level: LogLevel,
    /// At most 512 characters.
    pub text: String,
}

/// Why a step gave no effects. A guest's fault is an outcome, not an error of the host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, thiserror::Error)]
pub enum Fault {
    /// The guest trapped; the text is the engine's.
    #[error("the component trapped: {0}")]
    Trap(String),
    /// The step ran past its limit and was stopped.
    #[error("the step ran past its limit of {limit_us} µs and was stopped")]
    Overrun {
        /// The limit, in µs.
        limit_us: u64,
    },
    /// The guest refused a parameter.
    #[error("the component refused its parameters: {0}")]
    BadParameter(String),
    /// The guest refused the state.
    #[error("the component refused the state: {0}")]
    BadState(String),
    /// The guest lacks an input.
    #[error("the component lacks an input: {0}")]
    BadInput(String),
    /// The guest failed in its own words.
    #[error("the component failed: {0}")]
    Failed(String),
    /// A write that is not finite, or to a port that is no output.
    #[error("the component wrote {value} to port {port:?}, which cannot be")]
    BadWrite {
        /// The port's name or number.
        port: String,
        /// The value as text, for it may be NaN.
        value: String,
    },
    /// A bound of the sandbox was passed.
    #[error("the component passed a limit: {0}")]
    Limit(String),
    /// No instance of the component could be had.
    #[error("the component is not ready on {host}: {reason}")]
    NotReady {
        /// The host that was asked.
        host: String,
        /// Why.
        reason: String,
    },
    /// Good by itself, but not as a component on probation must be.
    #[error("the component is on probation: {0}")]
    Probation(String),
}
