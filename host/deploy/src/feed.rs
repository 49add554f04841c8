//! Records as they pass: to the live feed, to the disk's writer, and into the table of last ones.
//!
//! Never: blocks, or answers to a cycle. It runs on the bus's and the loops' threads.

use std::{
    collections::HashMap,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use bumpless_core::{LoopId, Record};
use bumpless_store::RecordWriter;
use parking_lot::RwLock;
use tokio::sync::broadcast;

use crate::limits::{FEED_RECORDS, LOOPS_MAX};

/// How long the record of an unknown loop is kept: its intent may be on its way.
const UNKNOWN_KEPT: Duration = Duration::from_secs(10);

/// A last record and when it came.
#[derive(Debug, Clone)]
pub(crate) struct Last {
    pub(crate) record: Arc<Record>,
    pub(crate) came: Instant,
}

/// The passage of records.
pub(crate) struct Feed {
    live: broadcast::Sender<Arc<Record>>,
    last: RwLock<HashMap<LoopId, Last>>,
    writer: Arc<RecordWriter>,
    count: AtomicU64,
}

impl Feed {
    pub(crate) fn new(writer: Arc<RecordWriter>) -> Self {
        Self {
            live: broadcast::Sender::new(FEED_RECORDS),
            last: RwLock::default(),
            writer,
            count: AtomicU64::new(0),
        }
    }

    /// A record passes. One that is older than the last of its loop only counts.
    pub(crate) fn pass(&self, record: Arc<Record>) {
        self.count.fetch_add(1, Ordering::Relaxed);
        if self.remember(&record) {
            self.writer.offer(Arc::clone(&record));
            // Nobody listening is no error.
            let _ = self.live.send(record);
        }
    }

    /// A record that passed before holds an outcome that somebody waits for.
    pub(crate) fn keep(&self, record: Arc<Record>, soon: bool) {
        self.writer.keep(record, soon);
    }

    /// Takes a record into the table only. Says whether it is the newest of its loop.
    pub(crate) fn remember(&self, record: &Arc<Record>) -> bool {
        let mut last = self.last.write();
        let full = last.len() >= LOOPS_MAX;
        match last.get_mut(&record.loop_id) {
            Some(held) if held.record.position() >= record.position() => false,
            Some(held) => {
                *held = Last {
                    record: Arc::clone(record),
                    came: Instant::now(),
                };
                true
            }
            None if full => false,
            None => {
                last.insert(
                    record.loop_id.clone(),
                    Last {
                        record: Arc::clone(record),
                        came: Instant::now(),
                    },
                );
                true
            }
        }
    }

    pub(crate) fn last(&self, id: &LoopId) -> Option<Last> {
        self.last.read().get(id).cloned()
    }

    /// Forgets a removed loop.
    pub(crate) fn forget(&self, id: &LoopId) {
        self.last.write().remove(id);
        self.writer.forget(id);
    }

    /// Forgets records of loops that nobody knows.
    pub(crate) fn prune(&self, known: impl Fn(&LoopId) -> bool) {
        let now = Instant::now();
        let kept = |id: &LoopId, last: &Last| known(id) || now.saturating_duration_since(last.came) < UNKNOWN_KEPT;
        self.last.write().retain(|id, last| kept(id, last));
    }

    pub(crate) fn subscribe(&self) -> broadcast::Receiver<Arc<Record>> {
        self.live.subscribe()
    }

    pub(crate) fn count(&self) -> u64 {
        self.count.load(Ordering::Relaxed)
    }

    /// Writes of last records that the disk refused.
    pub(crate) fn failed_writes(&self) -> u64 {
        self.writer.counts().failed_writes
    }

    /// Brings the last records to the disk. Blocks.
    pub(crate) fn flush(&self) -> Result<(), bumpless_store::Error> {
        self.writer.flush()
    }
}
