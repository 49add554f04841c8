//! The messages between a loop's home (the I/O host with its arbiter) and the hosts that hold the loop.
//!
//! ```text
//! home ── Sample ──► owner ── StepRequest ──► replica
//!                    owner ◄── StepAnswer ──── replica
//! home ◄── Commit ── owner
//! home ── Record ──► owner, standbys, history, live feed
//! home ◄── Held ── a standby or owner, for a record with a new outcome of a command
//! ```
//!
//! The home keeps the loop's time: it freezes the sample at the absolute deadline and names the owner in it. The record
//! stream leaves the arbiter, so what a standby holds is what the actuator took.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::{
    digest::Digest,
    frame::{Effects, Fault, Frame, Message},
    name::{HostId, LoopId},
    reading::Reading,
    record::{Command, Record},
};

/// One frozen cycle, from the home to the owner it names.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// The loop.
    pub loop_id: LoopId,
    /// Ownership under which the commit must come.
    pub term: u64,
    /// Number of the cycle.
    pub seq: u64,
    /// The host that shall run it.
    pub owner: HostId,
    /// The I/O host that sent it and takes the commit.
    pub home: HostId,
    /// When the readings were frozen.
    pub at_ns: u64,
    /// Time left until the commit counts as overdue, in ns, at the moment of sending.
    pub left_ns: u64,
    /// Revision in force, as the arbiter knows it.
    pub revision: u64,
    /// One reading per port of the component in force.
    pub readings: Vec<Reading>,
    /// While a change of revision waits: its number, and one reading per port of its component.
    pub next_readings: Option<(u64, Vec<Reading>)>,
    /// Hosts that hold the loop and are believed alive, in rendezvous order.
    pub members: Vec<HostId>,
    /// Commands that no record holds yet, oldest first.
    pub commands: Vec<Command>,
    /// Messages for the loop that arrived since the last record.
    pub messages: Vec<Message>,
    /// Position of the last record, (term, seq); (0, 0) where there is none.
    pub last: (u64, u64),
    /// The last record itself, where the owner may not have it: at a takeover, or because it asked.
    pub resume: Option<Arc<Record>>,
}

/// The owner's answer to a sample.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Answer {
    /// The cycle's record, to be taken with its outputs or not at all.
    Commit(Box<Record>),
    /// The owner does not hold the last record; the home sends the sample again with it.
    NeedRecord {
        /// The loop.
        loop_id: LoopId,
        /// The sample's term.
        term: u64,
        /// The sample's number.
        seq: u64,
        /// Who asks.
        owner: HostId,
    },
    /// The owner cannot run the loop now; the home names another at once.
    Decline {
        /// The loop.
        loop_id: LoopId,
        /// The sample's term.
        term: u64,
        /// The sample's number.
        seq: u64,
        /// Who declines.
        owner: HostId,
        /// In words.
        reason: String,
    },
    /// A member has this record, which holds an outcome that it had not seen: the outcome outlives the home.
    Held {
        /// The loop.
        loop_id: LoopId,
        /// The record's term.
        term: u64,
        /// The record's number.
        seq: u64,
        /// Who has it.
        host: HostId,
    },
}

impl Answer {
    /// The loop that it is about.
    #[must_use]
    pub fn loop_id(&self) -> &LoopId {
        match self {
            Self::Commit(record) => &record.loop_id,
            Self::NeedRecord { loop_id, .. } | Self::Decline { loop_id, .. } | Self::Held { loop_id, .. } => loop_id,
        }
    }
}

/// Why the arbiter did not take a commit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
pub enum Refusal {
    /// Another host owns the loop.
    #[error("the commit's term is old: another host owns the loop")]
    OldTerm,
    /// The cycle was taken before, or the next one has begun.
    #[error("the commit's cycle was taken before, or the next one has begun")]
    OldSeq,
    /// The record does not go on from the last one taken.
    #[error("the commit does not go on from the last record")]
    WrongBase,
    /// A term or cycle that the arbiter never gave out.
    #[error("the commit names a term or cycle that was never given out")]
    NeverGiven,
    /// The committing host is not the owner.
    #[error("the committing host does not own the loop")]
    NotOwner,
    /// An output is not finite, out of range, or there are too few or too many.
    #[error("an output is not finite, outside its point's range, or missing")]
    BadOutput,
    /// No such loop here.
    #[error("the loop has no home here")]
    NoSuchLoop,
}

/// A change of revision that a replica repeats, so that it can be voted on: the state goes from one component to the other, which
/// then steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Switch {
    /// Revision whose component made the state.
    pub from: u64,
    /// Revision whose component goes on from it.
    pub to: u64,
}

/// A step for a replica.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepRequest {
    /// Where the answer goes.
    pub from: HostId,
    /// Matches the answer to the request.
    pub correlation: u64,
    /// The loop, so that the replica keeps one instance for it.
    pub loop_id: LoopId,
    /// The component.
    pub digest: Digest,
    /// Longest time of the step, in ns.
    pub limit_ns: u64,
    /// What the step sees.
    pub frame: Frame,
    /// The state before.
    pub state: Arc<[u8]>,
    /// In the cycle of a change that is voted on: which; `digest`, `limit_ns` and `frame` are those of the revision that comes in.
    pub switch: Option<Switch>,
}

/// A replica's answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StepAnswer {
    /// Who answers.
    pub from: HostId,
    /// The request's correlation.
    pub correlation: u64,
    /// The loop.
    pub loop_id: LoopId,
    /// What came of it.
    pub result: Result<Effects, Fault>,
    /// Time inside the component, in ns.
    pub step_ns: u64,
}
