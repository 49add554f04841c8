//! What deployment asks of the room that runs loops.
//!
//! A trait, so that deployment is tested without cycle threads: the tests write down what was asked.
//! Never: waits; a reply comes through its box, from a thread of the loops. A box that is dropped uncalled means that
//! nothing will come.

use std::sync::Arc;

use bumpless_cell::Vitals;
use bumpless_core::{Command, CommandId, Digest, Fault, Frame, HostId, LoopId, Record, Strategy};
use bumpless_loops::{CallEnd, CommandReply, Error, HeldRevision, HomeRevision, HomeView, Loops};

/// Takes a command's end.
pub type CommandSink = Box<dyn FnOnce(CommandReply) + Send>;

/// Takes whether a command was taken back.
pub type WithdrawSink = Box<dyn FnOnce(bool) + Send>;

/// Takes the end of a step that was asked for from outside.
pub type CallSink = Box<dyn FnOnce(Result<CallEnd, Fault>) + Send>;

/// The loops of this host. All calls return at once; an error means that nothing was taken.
pub trait Field: Send + Sync + 'static {
    /// Starts a loop's schedule here, from a record or afresh.
    ///
    /// # Errors
    /// A point that is not served here, or a host that is too busy.
    fn open_home(&self, revision: HomeRevision, last: Option<Arc<Record>>) -> Result<(), Error>;
    /// Makes a further revision known, so that a commit with it is understood.
    ///
    /// # Errors
    /// As [`Field::open_home`].
    fn add_home_revision(&self, revision: HomeRevision) -> Result<(), Error>;
    /// Ends a loop's schedule. Its outputs stay as they are.
    ///
    /// # Errors
    /// The host is too busy.
    fn close_home(&self, id: &LoopId) -> Result<(), Error>;
    /// The hosts that may own the loop, best first.
    ///
    /// # Errors
    /// The host is too busy.
    fn set_members(&self, id: &LoopId, members: Vec<HostId>) -> Result<(), Error>;
    /// Hands a command to a loop whose home is here. The box is dropped unused where the command was taken back.
    ///
    /// # Errors
    /// The host is too busy.
    fn command(&self, id: &LoopId, command: Command, reply: CommandSink) -> Result<(), Error>;
    /// A record of a loop at home here, at this position or a later one, is on this host's disk.
    ///
    /// # Errors
    /// The host is too busy.
    fn kept(&self, id: &LoopId, position: (u64, u64)) -> Result<(), Error>;
    /// Takes a command back that no cycle has begun with.
    ///
    /// # Errors
    /// The host is too busy.
    fn withdraw(&self, id: &LoopId, command: CommandId, reply: WithdrawSink) -> Result<(), Error>;
    /// Gives the ownership to a member, between two cycles.
    ///
    /// # Errors
    /// The host is too busy.
    fn move_to(&self, id: &LoopId, host: HostId) -> Result<(), Error>;
    /// This revision can be stepped here now.
    ///
    /// # Errors
    /// The host is too busy.
    fn hold(&self, revision: HeldRevision) -> Result<(), Error>;
    /// Lets go of all but these revisions.
    ///
    /// # Errors
    /// The host is too busy.
    fn keep_revisions(&self, id: &LoopId, keep: Vec<u64>) -> Result<(), Error>;
    /// Lets go of a loop.
    ///
    /// # Errors
    /// The host is too busy.
    fn release(&self, id: &LoopId) -> Result<(), Error>;
    /// How a host is, for the choice of replicas.
    fn set_host(&self, vitals: &Vitals);
    /// A loop whose home is here.
    fn home_view(&self, id: &LoopId) -> Option<HomeView>;
    /// Smoothed latency of a step at that host, in ns.
    fn latency_ns(&self, host: &HostId) -> Option<u64>;
    /// Loops whose latest record names this host as owner.
    fn owned(&self) -> u32;
    /// A step that was asked for from outside, where the strategy says.
    ///
    /// # Errors
    /// The host is too busy.
    fn call(
        &self,
        digest: Digest,
        strategy: Strategy,
        frame: Frame,
        state: Arc<[u8]>,
        limit_ns: u64,
        reply: CallSink,
    ) -> Result<(), Error>;
}

impl Field for Loops {
    fn open_home(&self, revision: HomeRevision, last: Option<Arc<Record>>) -> Result<(), Error> {
        Self::open_home(self, revision, last)
    }
    fn add_home_revision(&self, revision: HomeRevision) -> Result<(), Error> {
        Self::add_home_revision(self, revision)
    }
    fn close_home(&self, id: &LoopId) -> Result<(), Error> {
        Self::close_home(self, id)
    }
    fn set_members(&self, id: &LoopId, members: Vec<HostId>) -> Result<(), Error> {
        Self::set_members(self, id, members)
    }
    fn command(&self, id: &LoopId, command: Command, reply: CommandSink) -> Result<(), Error> {
        Self::command(self, id, command, reply)
    }
    fn kept(&self, id: &LoopId, position: (u64, u64)) -> Result<(), Error> {
        Self::kept(self, id, position)
    }
    fn withdraw(&self, id: &LoopId, command: CommandId, reply: WithdrawSink) -> Result<(), Error> {
        Self::withdraw(self, id, command, reply)
    }
    fn move_to(&self, id: &LoopId, host: HostId) -> Result<(), Error> {
        Self::move_to(self, id, host)
    }
    fn hold(&self, revision: HeldRevision) -> Result<(), Error> {
        Self::hold(self, revision)
    }
    fn keep_revisions(&self, id: &LoopId, keep: Vec<u64>) -> Result<(), Error> {
        Self::keep_revisions(self, id, keep)
    }
    fn release(&self, id: &LoopId) -> Result<(), Error> {
        Self::release(self, id)
    }
    fn set_host(&self, vitals: &Vitals) {
        Self::set_host(self, vitals);
    }
    fn home_view(&self, id: &LoopId) -> Option<HomeView> {
        Self::home_view(self, id)
    }
    fn latency_ns(&self, host: &HostId) -> Option<u64> {
        Self::latency_ns(self, host)
    }
    fn owned(&self) -> u32 {
        Self::owned(self)
    }
    fn call(
        &self,
        digest: Digest,
        strategy: Strategy,
        frame: Frame,
        state: Arc<[u8]>,
        limit_ns: u64,
        reply: CallSink,
    ) -> Result<(), Error> {
        Self::call(self, digest, strategy, frame, state, limit_ns, reply)
    }
}
