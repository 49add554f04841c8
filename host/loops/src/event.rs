//! What reaches a worker, and what leaves it for deployment. Closed lists: nothing else changes a loop.

use std::sync::Arc;

use bumpless_core::{
    Applied, Command, CommandId, Descriptor, Digest, Fault, Frame, HostId, LoopId, LoopSpec, Record, Strategy, Wiring,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};
use bumpless_engine::Instance;
use parking_lot::Mutex;

use crate::home::HomeView;

/// A revision as the home needs it.
#[derive(Debug, Clone)]
pub struct HomeRevision {
    /// The specification.
    pub spec: Arc<LoopSpec>,
    /// Resolved against its component.
    pub wiring: Arc<Wiring>,
    /// The home gives greater terms than this: those up to it may be another home's. 0 where there is no other.
    pub term_floor: u64,
}

/// A revision as a holder needs it: it can be stepped here from now on.
pub struct HeldRevision {
    /// The specification.
    pub spec: Arc<LoopSpec>,
    /// Resolved against its component.
    pub wiring: Arc<Wiring>,
    /// What the component says of itself.
    pub descriptor: Arc<Descriptor>,
    /// Instantiated and warm.
    pub instance: Instance,
}

/// How a command ended.
#[derive(Debug, Clone)]
pub enum CommandReply {
    /// The record holds its outcome.
    Applied {
        /// Its id and outcome.
        applied: Applied,
        /// The record.
        record: Arc<Record>,
    },
    /// Too many commands wait; nothing was taken.
    Full,
    /// The loop has no home here.
    NoSuchLoop,
}

/// How a call ended.
#[derive(Debug, Clone)]
pub struct CallEnd {
    /// The replica's answer.
    pub answer: StepAnswer,
    /// Time until it came, in ns.
    pub total_ns: u64,
}

/// What loops report to deployment, in the order in which it happens. The sink must not block.
#[derive(Debug, Clone)]
pub enum LoopsEvent {
    /// A home here took this record.
    Record(Arc<Record>),
    /// The record before this event holds an outcome that somebody waits for: bring it to the disk, then call
    /// [`crate::Loops::kept`].
    Outcome {
        /// The record.
        record: Arc<Record>,
        /// No other host holds the loop: the disk alone can keep the outcome, so it should be quick.
        alone: bool,
    },
    /// The record before was the first one of another revision.
    Revised {
        /// The loop.
        loop_id: LoopId,
        /// The revision in force now.
        revision: u64,
    },
}

pub(crate) type ReplyToCommand = Box<dyn FnOnce(CommandReply) + Send>;
pub(crate) type ReplyToWithdrawal = Box<dyn FnOnce(bool) + Send>;
pub(crate) type ReplyToCall = Box<dyn FnOnce(Result<CallEnd, Fault>) + Send>;

/// A call from outside, on its way to a worker.
pub(crate) struct CallRequest {
    pub(crate) digest: Digest,
    pub(crate) strategy: Strategy,
    pub(crate) frame: Frame,
    pub(crate) state: Arc<[u8]>,
    pub(crate) limit_ns: u64,
    pub(crate) reply: ReplyToCall,
}

/// A home to open.
pub(crate) struct Opening {
    pub(crate) revision: HomeRevision,
    /// The record to go on from.
    pub(crate) last: Option<Arc<Record>>,
    /// Where the home shows itself.
    pub(crate) view: Arc<Mutex<HomeView>>,
}

/// Everything that reaches a worker.
pub(crate) enum Event {
    Sample(Box<Sample>),
    Answer(Box<Answer>),
    Record(Arc<Record>),
    StepRequest(Box<StepRequest>),
    StepAnswer(Box<StepAnswer>),
    Ping { from: HostId, token: u64 },
    HostGone(HostId),
    OpenHome(Box<Opening>),
    AddHomeRevision(Box<HomeRevision>),
    CloseHome(LoopId),
    Members(LoopId, Vec<HostId>),
    Command(LoopId, Box<Command>, ReplyToCommand),
    Kept(LoopId, (u64, u64)),
    Withdraw(LoopId, CommandId, ReplyToWithdrawal),
    MoveTo(LoopId, HostId),
    Hold(Box<HeldRevision>),
    KeepRevisions(LoopId, Vec<u64>),
    Release(LoopId),
    Call(Box<CallRequest>),
    Stop,
}
