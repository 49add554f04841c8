//! What one cycle leaves behind: enough for anyone to go on from here, and for history to say what happened.
//! PID 4.0's shift register, generalised.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::{
    digest::Digest,
    frame::{AlarmChange, LogLine, Message},
    name::{HostId, LoopId},
    reading::Reading,
    redundancy::Redundancy,
    spec::Mode,
};

/// Names a command, so that asking twice does it once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct CommandId(pub u128);

/// What an operator or engineer wants of a running loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum CommandBody {
    /// A new setpoint.
    Setpoint(f64),
    /// Manual or automatic.
    Mode(Mode),
    /// The outputs in manual, one per connected output port in order.
    Output(Vec<f64>),
    /// Go on with this revision of the specification: other parameters, strategy, limits or component.
    Revise(u64),
}

/// A command on its way. It waits at the arbiter, rides in every sample until a record holds its outcome.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Command {
    /// Names it.
    pub id: CommandId,
    /// What is wanted.
    pub body: CommandBody,
}

/// How a command ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Outcome {
    /// It is part of this record.
    Done,
    /// It is not, and why.
    Refused(String),
}

/// A command and how it ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Applied {
    /// The command.
    pub id: CommandId,
    /// Its end.
    pub outcome: Outcome,
}

/// Something that a cycle met and that people should hear of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Event {
    /// The first step of this ownership.
    TookOver {
        /// The owner before, if there was one.
        from: Option<HostId>,
    },
    /// A replica did not answer in time, and the next was asked.
    Hedged {
        /// The silent replica.
        replica: HostId,
    },
    /// A step ended with a fault.
    Faulted {
        /// Where.
        replica: HostId,
        /// In words.
        fault: String,
    },
    /// The policy decided the output because no step was good.
    PolicyHeld,
    /// The loop went on with another revision.
    Revised {
        /// The revision before.
        from: u64,
        /// The digest before.
        from_digest: Digest,
        /// How the state came over: "migrate", "start" or "same".
        by: String,
        /// Output step beyond what the old controller would have done, in % of span.
        bump_percent: f64,
    },
    /// The switch to this revision moved an output farther than the loop allows, and its policy lets that pass.
    OverBump {
        /// Step of the output beyond what the old controller would have done, in % of span.
        bump_percent: f64,
        /// What the loop allows, in % of span.
        limit_percent: f64,
    },
    /// A fault in probation sent the loop back to the revision before.
    RolledBack {
        /// The revision left.
        from: u64,
        /// In words.
        reason: String,
    },
    /// An output met a limit: port number.
    Limited(u8),
    /// A required input was bad.
    BadInput(u8),
    /// Fewer replicas than the loop asks for can step now, and fewer than before.
    RedundancyLost {
        /// Those that can, the owner among them.
        have: u8,
        /// Those that the loop asks for.
        want: u8,
    },
    /// As many replicas as the loop asks for can step again.
    RedundancyRestored {
        /// Those that the loop asks for.
        want: u8,
    },
    /// A replica's step was not what the majority's was, to the last bit: it has no vote until further notice.
    Dissent {
        /// The replica.
        replica: HostId,
    },
    /// A replica without a vote agreed often enough to have one again.
    Readmitted {
        /// The replica.
        replica: HostId,
    },
    /// Too few equal answers came in time; the cycle is a faulty one.
    NoMajority {
        /// Answers that came.
        answers: u8,
        /// Of these, the most that were equal.
        agreed: u8,
        /// Equal answers that were needed.
        needed: u8,
    },
    /// A person holds this port's point at a value, from this cycle on.
    Forced(u8),
    /// The point of this port is held no more.
    Unforced(u8),
}

/// What one cycle leaves. Written once by the owner, completed and ordered by the arbiter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// The loop.
    pub loop_id: LoopId,
    /// Number of the ownership.
    pub term: u64,
    /// Number of the cycle.
    pub seq: u64,
    /// Position of the record that this one goes on from; (0, 0) for a first start.
    pub after: (u64, u64),
    /// Revision of the specification that was in force.
    pub revision: u64,
    /// The component that stepped.
    pub digest: Digest,
    /// The I/O host that sent the sample and orders the loop's records.
    pub home: HostId,
    /// The host that ran the cycle.
    pub owner: HostId,
    /// The host whose replica gave the effects.
    pub stepped_by: HostId,
    /// When the sample was frozen, in ns of the I/O server's clock.
    pub at_ns: u64,
    /// Time since the record before, in ns.
    pub dt_ns: u64,
    /// Who decided the output.
    pub mode: Mode,
    /// Wanted value.
    pub setpoint: f64,
    /// What the operator set for manual, one per output port; follows the outputs in automatic.
    pub manual: Vec<f64>,
    /// What the step saw, one reading per port.
    pub readings: Vec<Reading>,
    /// The messages that the step received: with readings and state it is all that the step knew, so that it can be repeated.
    pub heard: Vec<Message>,
    /// What the controller wanted, one per output port; NaN never.
    pub wanted: Vec<f64>,
    /// What the arbiter let through, one per output port.
    pub outputs: Vec<f64>,
    /// The controller's state after the step.
    pub state: Arc<[u8]>,
    /// Faulty cycles in a row, up to and with this one.
    pub faults_in_row: u32,
    /// While a swap is on probation: the revision to fall back to and the cycles left.
    pub probation: Option<(u64, u32)>,
    /// What the cycle could count on.
    pub redundancy: Redundancy,
    /// Outcomes of the latest commands, oldest first.
    pub applied: Vec<Applied>,
    /// What the cycle met.
    pub events: Vec<Event>,
    /// What the controller raised and cleared.
    pub alarms: Vec<AlarmChange>,
    /// What it published.
    pub messages: Vec<Message>,
    /// What it logged.
    pub log: Vec<LogLine>,
    /// Time of the step as the owner saw it, in ns: network included.
    pub step_ns: u64,
    /// Time from the sample's arrival at the owner to its commit, in ns.
    pub cycle_ns: u64,
    /// Time from the deadline to the actuator's write, in ns of the I/O server's clock; set by the arbiter.
    pub committed_after_ns: u64,
}

impl Record {
    /// Where the record stands in the order that the arbiter keeps.
    #[must_use]
    pub const fn position(&self) -> (u64, u64) {
        (self.term, self.seq)
    }

    /// Does it hold an outcome that `before` does not? A member that sees one for the first time tells the home that it has
    /// it; see [`crate::desk::Desk::kept`].
    #[must_use]
    pub fn has_news_for(&self, before: Option<&Self>) -> bool {
        let known = before.map(|r| r.applied.as_slice()).unwrap_or_default();
        // The latest stand at the end, and in almost every cycle both ends are the same.
        if self.applied.last().map(|a| a.id) == known.last().map(|a| a.id) {
            return false;
        }
        self.applied.iter().any(|a| !known.iter().any(|k| k.id == a.id))
    }
}

/// A plain record for tests of this crate.
#[cfg(test)]
pub(crate) fn test_record() -> Record {
    Record {
        loop_id: LoopId::new("l").expect("valid"),
        term: 1,
        seq: 1,
        after: (0, 0),
        revision: 1,
        digest: Digest::of(b"a"),
        home: HostId::new("home").expect("valid"),
        owner: HostId::new("h1").expect("valid"),
        stepped_by: HostId::new("h1").expect("valid"),
        at_ns: 1_000,
        dt_ns: 1_000,
        mode: Mode::Automatic,
        setpoint: 1.0,
        manual: vec![0.0],
        readings: vec![],
        heard: vec![],
        wanted: vec![0.0],
        outputs: vec![0.0],
        state: Arc::from([]),
        faults_in_row: 0,
        probation: None,
        redundancy: Redundancy::default(),
        applied: vec![],
        events: vec![],
        alarms: vec![],
        messages: vec![],
        log: vec![],
        step_ns: 0,
        cycle_ns: 0,
        committed_after_ns: 0,
    }
}
