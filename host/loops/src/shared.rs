//! What all workers of a host share, and nothing that a loop's cycle could wait for.

use std::sync::{
    Arc, OnceLock,
    atomic::{AtomicI64, AtomicU64, Ordering},
};

use bumpless_core::{Effects, Fault, HostId, Record};
use bumpless_engine::{Engine, Instance};
use bumpless_io::{Clock, IoServer};

use crate::{
    event::{Event, LoopsEvent},
    inbox::Sender,
    replicas::Replicas,
    testing::FlipBits,
    wire::Wire,
};

/// Where reports to deployment go; must not block.
pub(crate) type Sink = Arc<dyn Fn(LoopsEvent) + Send + Sync>;

pub(crate) struct Shared {
    pub(crate) here: HostId,
    pub(crate) clock: Clock,
    pub(crate) io: Option<Arc<IoServer>>,
    pub(crate) engine: Engine,
    pub(crate) wire: Arc<dyn Wire>,
    pub(crate) sink: Sink,
    pub(crate) replicas: Replicas,
    /// Old instances go here: to drop one unmaps memory, which is no work for a cycle's thread.
    pub(crate) reaper: crossbeam_channel::Sender<Instance>,
    pub(crate) owned: AtomicI64,
    pub(crate) held: AtomicI64,
    pub(crate) dropped: AtomicU64,
    /// When each worker last began a turn, by the host's clock: a worker that does not come round runs no cycle.
    pub(crate) turns: Vec<AtomicU64>,
    /// A test device; none in service.
    pub(crate) flip_bits: Option<FlipBits>,
    /// The workers' inboxes, for messages from a loop on one worker to a home on another.
    pub(crate) inboxes: OnceLock<Vec<Sender<Event>>>,
}

impl Shared {
    pub(crate) fn now_ns(&self) -> u64 {
        self.clock.now_ns()
    }

    /// A step of this host came to this: where it is a test host, some come out wrong.
    pub(crate) fn disturb(&self, step: &mut Result<Effects, Fault>) {
        if let Some(device) = &self.flip_bits {
            device.disturb(step);
        }
    }

    /// Drops an instance elsewhere. Where the reaper's queue is full, here: memory matters more then.
    pub(crate) fn bury(&self, instance: Instance) {
        drop(self.reaper.try_send(instance));
    }

    /// Tells every worker but `from` of a record whose messages may be for a home of theirs. A full inbox loses them.
    pub(crate) fn spread(&self, from: usize, record: &Arc<Record>) {
        for (_, inbox) in self
            .inboxes
            .get()
            .into_iter()
            .flatten()
            .enumerate()
            .filter(|(i, _)| *i != from)
        {
            if inbox.try_send(Event::Record(Arc::clone(record))).is_err() {
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    pub(crate) fn count_owned(&self, by: i64) {
        self.owned.fetch_add(by, Ordering::Relaxed);
    }

    pub(crate) fn count_held(&self, by: i64) {
        self.held.fetch_add(by, Ordering::Relaxed);
    }
}
