//! Writes last records behind the cycle.
//!
//! Owns: the newest record of each loop that is not in the store yet, and the thread that puts it there. Never: makes the
//! cycle wait for the disk.
//!
//! ```text
//!   offer ──► waiting (newest per loop) ──every 100 ms──► store, in memory ──every 1 s and at close──► disk
//!                ▲                             │                 └──────where somebody waits: at once─────┘
//!                └──────the write failed───────┘   (unless a newer one waits already)
//! ```
//! What is only in the store's memory is gone with the process.
//!
//! Where somebody waits for a record to be on the disk ([`RecordWriter::keep`]), the next write goes to the disk, and whoever was
//! named with [`RecordWriter::tell_on_disk`] hears of it; where it is asked for, that write is made at once.
//!
//! A full map (more loops than a host can run) refuses new loops and counts them; a loop that is in it is always taken.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_core::{LoopId, Record};

use crate::{error::Error, store::Store};

/// How often waiting records go to the store.
const FLUSH_EVERY: Duration = Duration::from_millis(100);

/// How often the store goes to the disk where nobody waits for it: what the end of the process, or a power cut, may cost of what
/// nobody was told of.
const SYNC_EVERY: Duration = Duration::from_secs(1);

/// How often a failing disk is logged.
const COMPLAIN_EVERY: Duration = Duration::from_secs(60);

/// The longest wait for the thread: a disk that needs more for a few megabytes has failed.
const ANSWER_SECONDS: u64 = 10;

/// Loops whose records may wait: beyond what one process runs.
const LOOPS_MAX: usize = 16_384;

/// Requests to the thread that may wait. More callers at once get [`Error::Slow`].
const REQUESTS_MAX: usize = 16;

type Waiting = HashMap<LoopId, Arc<Record>>;

/// Positions, (term, seq), that somebody waits for: the greatest of each loop.
type Asked = HashMap<LoopId, (u64, u64)>;

/// Takes the news that a loop's record up to a position is on the disk; false where it has no room for it now.
pub type OnDisk = Box<dyn Fn(&LoopId, (u64, u64)) -> bool + Send + Sync>;

/// What a writer did so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WriterCounts {
    /// Records offered.
    pub offered: u64,
    /// Records that a newer one of the same loop replaced before they were written: the usual case for fast loops.
    pub overwritten: u64,
    /// Records refused because too many loops wait.
    pub refused: u64,
    /// Records handed to the store.
    pub written: u64,
    /// Writes that failed; their records wait for the next one.
    pub failed_writes: u64,
}

#[derive(Debug, Default)]
struct Counters {
    offered: AtomicU64,
    overwritten: AtomicU64,
    refused: AtomicU64,
    written: AtomicU64,
    failed_writes: AtomicU64,
}

#[derive(Default)]
struct Shared {
    waiting: Mutex<Waiting>,
    asked: Mutex<Asked>,
    on_disk: OnceLock<OnDisk>,
    counters: Counters,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared")
            .field("counters", &self.counters)
            .finish_non_exhaustive()
    }
}

impl Shared {
    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn asked(&self) -> MutexGuard<'_, Asked> {
        self.asked.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Notes positions that are waited for.
    fn ask(&self, positions: impl IntoIterator<Item = (LoopId, (u64, u64))>) {
        let mut asked = self.asked();
        for (loop_id, position) in positions {
            let held = asked.entry(loop_id).or_default();
            *held = position.max(*held);
        }
    }
}

enum Request {
    /// Bring everything to the disk soon; whoever asked hears of it by itself.
    Sync,
    /// Bring everything to the disk and say how it went.
    Flush(SyncSender<Result<(), Error>>),
    /// The same, and end.
    Close(SyncSender<Result<(), Error>>),
}

/// Writes last records behind the cycle. Dropping it flushes as [`RecordWriter::close`] does, and logs an error.
#[derive(Debug)]
pub struct RecordWriter {
    shared: Arc<Shared>,
    requests: SyncSender<Request>,
    thread: Option<JoinHandle<()>>,
    store: Store,
}

impl RecordWriter {
    /// Starts the writer's thread.
    ///
    /// # Errors
    /// [`Error::Io`] when the system gives no thread.
    pub fn start(store: Store) -> Result<Self, Error> {
        let shared = Arc::new(Shared::default());
        let (requests, inbox) = sync_channel(REQUESTS_MAX);
        let worker = Worker {
            store: store.clone(),
            shared: Arc::clone(&shared),
            batch: Waiting::new(),
            unsynced: Waiting::new(),
            synced_at: Instant::now(),
            complained_at: None,
        };
        let thread = std::thread::Builder::new()
            .name("record-writer".into())
            .spawn(move || worker.run(&inbox))
            .map_err(|error| Error::io("start the record writer of", store.directory(), error))?;
        Ok(Self {
            shared,
            requests,
            thread: Some(thread),
            store,
        })
    }

    /// Takes a record to be written. Never waits for the disk: it holds a lock for one look into a map, and so does the
    /// thread. A record that is older than the one waiting is passed over.
    pub fn offer(&self, record: Arc<Record>) {
        self.take_in(record);
    }

    /// Names who is told of records that were asked for with [`RecordWriter::keep`]. Called once; a second one changes nothing.
    pub fn tell_on_disk(&self, on_disk: OnDisk) {
        drop(self.shared.on_disk.set(on_disk));
    }

    /// As [`RecordWriter::offer`], and tells when this record, or a later one of its loop, is on the disk: after the next write,
    /// within 100 ms and the time of a sync; at once where `soon` is set. A record that is refused is never told of.
    pub fn keep(&self, record: Arc<Record>, soon: bool) {
        let asked = (record.loop_id.clone(), record.position());
        if !self.take_in(record) {
            return;
        }
        // After it waits to be written, so that a sync that takes the question takes the record too.
        self.shared.ask([asked]);
        if soon {
            // A full queue holds syncs already.
            drop(self.requests.try_send(Request::Sync));
        }
    }

    /// Says whether the record, or a newer one of its loop, waits to be written.
    fn take_in(&self, record: Arc<Record>) -> bool {
        let counters = &self.shared.counters;
        let loop_id = &record.loop_id.clone();
        counters.offered.fetch_add(1, Ordering::Relaxed);
        let mut waiting = self.shared.waiting();
        let room = waiting.len() < LOOPS_MAX;
        // The record that is left over is dropped after the lock: it may be the last owner of its state.
        let (counter, left_over) = match waiting.get_mut(&record.loop_id) {
            Some(held) if held.position() < record.position() => {
                (Some(&counters.overwritten), Some(std::mem::replace(held, record)))
            }
            Some(_) => (Some(&counters.overwritten), Some(record)),
            None if room => {
                waiting.insert(record.loop_id.clone(), record);
                (None, None)
            }
            None => (Some(&counters.refused), Some(record)),
        };
        let taken = waiting.contains_key(loop_id);
        drop(waiting);
        if let Some(counter) = counter {
            counter.fetch_add(1, Ordering::Relaxed);
        }
        drop(left_over);
        taken
    }

    /// Drops what waits for a loop that was removed.
    pub fn forget(&self, loop_id: &LoopId) {
        self.shared.asked().remove(loop_id);
        let left_over = self.shared.waiting().remove(loop_id);
        drop(left_over);
    }

    /// Brings every record offered before to the disk.
    ///
    /// # Errors
    /// The write's error, or [`Error::Slow`] after 10 s.
    pub fn flush(&self) -> Result<(), Error> {
        self.ask(Request::Flush)
    }

    /// Brings every record to the disk and ends the thread.
    ///
    /// # Errors
    /// The write's error, or [`Error::Slow`] after 10 s; the thread then ends by itself when the disk lets it.
    pub fn close(mut self) -> Result<(), Error> {
        self.end()
    }

    /// What it did so far.
    #[must_use]
    pub fn counts(&self) -> WriterCounts {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let c = &self.shared.counters;
        WriterCounts {
            offered: read(&c.offered),
            overwritten: read(&c.overwritten),
            refused: read(&c.refused),
            written: read(&c.written),
            failed_writes: read(&c.failed_writes),
        }
    }

    fn ask(&self, request: impl FnOnce(SyncSender<Result<(), Error>>) -> Request) -> Result<(), Error> {
        let slow = || Error::Slow {
            seconds: ANSWER_SECONDS,
            path: self.store.directory().to_owned(),
        };
        let (answer, answers) = sync_channel(1);
        self.requests.try_send(request(answer)).map_err(|_| slow())?;
        answers
            .recv_timeout(Duration::from_secs(ANSWER_SECONDS))
            .map_err(|_| slow())?
    }

    fn end(&mut self) -> Result<(), Error> {
        let Some(thread) = self.thread.take() else {
            return Ok(());
        };
        let result = self.ask(Request::Close);
        if !matches!(result, Err(Error::Slow { .. })) && thread.join().is_err() {
            tracing::error!("the record writer panicked");
        }
        result
    }
}

impl Drop for RecordWriter {
    fn drop(&mut self) {
        if let Err(error) = self.end() {
            tracing::error!(%error, "the last records were not written");
        }
    }
}

/// Must this write reach the disk? An outcome that somebody may be told of does not wait for the second that others wait: a member's
/// memory may be all that has it besides, and is gone where every host is killed at once. At ten syncs a second however
/// many commands there are.
fn is_sync_due(since_last: Duration, somebody_waits: bool) -> bool {
    somebody_waits || since_last >= SYNC_EVERY
}

/// The thread's side.
struct Worker {
    store: Store,
    shared: Arc<Shared>,
    /// What is being written; empty between two writes, and kept for its memory.
    batch: Waiting,
    /// What is in the store's memory and not on the disk yet, the newest of each loop.
    unsynced: Waiting,
    synced_at: Instant,
    complained_at: Option<Instant>,
}

impl Worker {
    fn run(mut self, inbox: &Receiver<Request>) {
        loop {
            match inbox.recv_timeout(FLUSH_EVERY) {
                Err(RecvTimeoutError::Timeout) => {
                    let due = is_sync_due(self.synced_at.elapsed(), !self.shared.asked().is_empty());
                    if let Err(error) = self.write(due) {
                        self.complain(&error);
                    }
                }
                Ok(Request::Sync) => {
                    if let Err(error) = self.write(true) {
                        self.complain(&error);
                    }
                }
                Ok(Request::Flush(answer)) => {
                    // Nobody may be waiting any more; the records are written either way.
                    let _ = answer.try_send(self.write(true));
                }
                Ok(Request::Close(answer)) => {
                    let _ = answer.try_send(self.write(true));
                    return;
                }
                // The writer went without a goodbye, so it did wait too long for an answer.
                Err(RecvTimeoutError::Disconnected) => {
                    if let Err(error) = self.write(true) {
                        self.complain(&error);
                    }
                    return;
                }
            }
        }
    }

    fn write(&mut self, sync: bool) -> Result<(), Error> {
        // Before the records are taken: what is asked for then is among them, or was written before.
        let asked = if sync {
            std::mem::take(&mut *self.shared.asked())
        } else {
            Asked::new()
        };
        std::mem::swap(&mut *self.shared.waiting(), &mut self.batch);
        let records: Vec<Arc<Record>> = self.batch.drain().map(|(_, record)| record).collect();
        let written = self.store.put_records(&records);
        if written.is_ok() {
            self.shared
                .counters
                .written
                .fetch_add(records.len() as u64, Ordering::Relaxed);
        }
        for record in records {
            self.unsynced.insert(record.loop_id.clone(), record);
        }
        let due = sync && !self.unsynced.is_empty();
        let result = written.and_then(|()| if due { self.store.sync() } else { Ok(()) });
        match &result {
            Ok(()) => {
                if due {
                    self.unsynced.clear();
                    self.synced_at = Instant::now();
                }
                self.tell(asked);
            }
            // What only the store's memory held may be gone with it.
            Err(_) => {
                self.put_back();
                self.shared.ask(asked);
                self.shared.counters.failed_writes.fetch_add(1, Ordering::Relaxed);
            }
        }
        result
    }

    /// Everything up to here is on the disk: whoever asked is told, as far as it can be read there. A record that was passed
    /// over, being too large or of a loop that was removed, is not there and not told of.
    fn tell(&self, asked: Asked) {
        let Some(on_disk) = self.shared.on_disk.get() else {
            return;
        };
        for (loop_id, position) in asked {
            let there = self.store.last_record(&loop_id).ok().flatten();
            let there = there.is_some_and(|record| record.position() >= position);
            if there && !on_disk(&loop_id, position) {
                self.shared.ask([(loop_id, position)]);
            }
        }
    }

    fn put_back(&mut self) {
        let mut waiting = self.shared.waiting();
        for (loop_id, record) in self.unsynced.drain() {
            match waiting.get(&loop_id) {
                Some(newer) if newer.position() >= record.position() => {
                    self.shared.counters.overwritten.fetch_add(1, Ordering::Relaxed);
                }
                _ => {
                    waiting.insert(loop_id, record);
                }
            }
        }
    }

    fn complain(&mut self, error: &Error) {
        if self.complained_at.is_some_and(|at| at.elapsed() < COMPLAIN_EVERY) {
            return;
        }
        self.complained_at = Some(Instant::now());
        let source = std::error::Error::source(error)
            .map(ToString::to_string)
            .unwrap_or_default();
        tracing::error!(%error, source, "last records wait in memory");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_that_somebody_waits_for_goes_to_the_disk_with_the_next_write() {
        assert!(is_sync_due(Duration::ZERO, true));
        assert!(!is_sync_due(Duration::ZERO, false));
        assert!(!is_sync_due(SYNC_EVERY - Duration::from_millis(1), false) && is_sync_due(SYNC_EVERY, false));
    }
}
