//! Every cycle of the loops that have their home here: a log with a bound, for replay, backtests and history.
//!
//! Owns: `cycles.redb` beside the store's own file, the thread that writes it, and the way back from it.
//! Never: makes a cycle wait. A record is offered through a bounded queue without a lock; when the queue or the memory for
//! what waits is full, the record is dropped and counted.
//!
//! ```text
//!   offer ──queue──► gathered per loop ──every second and at close──► chunks on disk ──over the bound──► oldest gone
//!                         ▲                        │
//!                         └─────write failed───────┘      (until the memory for what waits is full)
//! ```
//! A record that goes on from none begins a loop's life: what an earlier loop of that name left is thrown away first.
//! After a crash at most the last second is missing. A damaged chunk is skipped and counted. A damaged file is moved
//! aside, for a log must not keep a host from starting.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_core::{LoopId, Record};
use redb::backends::FileBackend;

use self::shelf::{Head, Parcel, Shelf};
use crate::{database::Opener, error::Error, store::Store};

mod chunk;
mod cursor;
pub(crate) mod parsing {
    //! The form of a chunk, for [`crate::parsers`].
    #[cfg(test)]
    pub(crate) use super::chunk::encode;
    pub(crate) use super::chunk::{decode, sealed};
}
mod shelf;

pub use cursor::{Cursor, Window};

const CYCLES_FILE: &str = "cycles.redb";

/// Least and greatest bound of the log's file, in bytes: below it a fast loop has no minute; beyond it a disk of its own is due.
pub const BYTES_MAX: std::ops::RangeInclusive<u64> = 16 * 1024 * 1024..=65_536 * 1024 * 1024;

/// How many times as large as its chunks the file becomes: the database grows by doubling, and keeps pages free to write
/// into. Measured with a thousand loops over many times the bound.
const DATABASE_TIMES: u64 = 2;

/// Records that wait in the queue, between two looks of the thread: 160,000 a second.
const QUEUE_MAX: usize = 16_384;

/// Bytes of records that may wait for the disk, about: some seconds of a thousand loops.
const WAITING_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// How often the thread empties the queue.
const GATHER_EVERY: Duration = Duration::from_millis(100);

/// How often what was gathered goes to the disk: what a crash may cost.
const WRITE_EVERY: Duration = Duration::from_secs(1);

/// Pause after a write that failed: all that waits is compressed anew for the next try.
const FAILED_PAUSE: Duration = Duration::from_secs(5);

/// How often a failing disk is logged.
const COMPLAIN_EVERY: Duration = Duration::from_secs(60);

/// The longest wait for the thread. It may be in the middle of a commit, or forget a long history.
const ANSWER_SECONDS: u64 = 10;

/// Requests to the thread that may wait. More callers at once get [`Error::Slow`].
const REQUESTS_MAX: usize = 64;

/// What the log did since it was opened.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CycleCounts {
    /// Records offered.
    pub offered: u64,
    /// Records dropped because too many waited.
    pub dropped: u64,
    /// Records on disk.
    pub written: u64,
    /// Writes that failed; their records wait for the next one.
    pub failed_writes: u64,
    /// Chunks that could not be read and were skipped; each read counts.
    pub damaged: u64,
    /// Bytes of all chunks now; the file is up to twice as large.
    pub bytes: u64,
}

#[derive(Debug, Default)]
struct Counters {
    offered: AtomicU64,
    dropped: AtomicU64,
    written: AtomicU64,
    failed_writes: AtomicU64,
    damaged: AtomicU64,
    bytes: AtomicU64,
    /// Bytes of records in the queue and gathered.
    waiting_bytes: AtomicU64,
}

/// What readers and the thread share.
#[derive(Debug)]
pub(crate) struct Inner {
    shelf: Shelf,
    counters: Counters,
    // Holds the lock of the directory.
    _store: Store,
}

type Gathered = BTreeMap<LoopId, VecDeque<Arc<Record>>>;

enum Request {
    /// What waits of a loop.
    Tail(LoopId, SyncSender<Result<Vec<Arc<Record>>, Error>>),
    /// Bring everything to the disk and say how it went.
    Flush(SyncSender<Result<(), Error>>),
    /// Throw a loop's records away.
    Forget(LoopId, SyncSender<Result<(), Error>>),
    /// Flush, and end.
    Close(SyncSender<Result<(), Error>>),
}

/// The log. Dropping it flushes as [`CycleLog::close`] does, and logs an error.
#[derive(Debug)]
pub struct CycleLog {
    inner: Arc<Inner>,
    queue: SyncSender<Arc<Record>>,
    requests: SyncSender<Request>,
    thread: Option<JoinHandle<()>>,
}

impl CycleLog {
    /// Opens the log in the store's directory, and starts its thread. `bytes_max` bounds its file, about; cycles that are
    /// `keep_ns` older than the newest go too.
    ///
    /// # Errors
    /// [`Error::Size`] for a bound outside [`BYTES_MAX`], [`Error::Io`], [`Error::Database`], [`Error::Newer`].
    pub fn open(store: &Store, bytes_max: u64, keep_ns: u64) -> Result<Self, Error> {
        if !BYTES_MAX.contains(&bytes_max) {
            return Err(Error::Size {
                what: format!("the bound of the log of cycles (at least {} bytes)", BYTES_MAX.start()),
                bytes: usize::try_from(bytes_max).unwrap_or(usize::MAX),
                max: usize::try_from(*BYTES_MAX.end()).unwrap_or(usize::MAX),
            });
        }
        Self::open_bounded(store, (bytes_max / DATABASE_TIMES, keep_ns))
    }

    /// As [`CycleLog::open`], with any bound of the chunks themselves.
    pub(crate) fn open_bounded(store: &Store, bounds: (u64, u64)) -> Result<Self, Error> {
        Self::open_with(store, bounds, || {
            Box::new(|builder, file| builder.create_with_backend(FileBackend::new(file)?))
        })
    }

    /// The same, on any disk.
    pub(crate) fn open_with(store: &Store, bounds: (u64, u64), opener: impl Fn() -> Opener) -> Result<Self, Error> {
        let path = store.directory().join(CYCLES_FILE);
        let shelf = match Shelf::open(&path, bounds, opener()) {
            Err(error @ (Error::Damaged { .. } | Error::NotAStore { .. })) => {
                let aside = path.with_extension("damaged");
                tracing::error!(%error, aside = %aside.display(), "the log of cycles is moved aside, and begins anew");
                crate::medium::rename(&path, &aside).map_err(|error| Error::io("move away", &path, error))?;
                Shelf::open(&path, bounds, opener())?
            }
            other => other?,
        };
        let counters = Counters::default();
        counters.bytes.store(shelf.bytes()?, Ordering::Relaxed);
        let inner = Arc::new(Inner {
            shelf,
            counters,
            _store: store.clone(),
        });
        let (queue, records) = sync_channel(QUEUE_MAX);
        let (requests, inbox) = sync_channel(REQUESTS_MAX);
        let writer = Writer {
            inner: Arc::clone(&inner),
            records,
            gathered: Gathered::new(),
            begun: BTreeSet::new(),
            write_at: Instant::now() + WRITE_EVERY,
            complained_at: None,
        };
        let thread = std::thread::Builder::new()
            .name("cycle-writer".into())
            .spawn(move || writer.run(&inbox))
            .map_err(|error| Error::io("start the writer of", &path, error))?;
        Ok(Self {
            inner,
            queue,
            requests,
            thread: Some(thread),
        })
    }

    /// Takes a record to be written. Never blocks, and takes no lock that the thread holds: the thread looks at the queue
    /// by itself, so nobody need be woken.
    pub fn offer(&self, record: Arc<Record>) {
        let counters = &self.inner.counters;
        counters.offered.fetch_add(1, Ordering::Relaxed);
        let weight = chunk::weight(&record) as u64;
        let waiting = counters.waiting_bytes.fetch_add(weight, Ordering::Relaxed);
        let room = waiting.saturating_add(weight) <= WAITING_BYTES_MAX;
        let left = match room.then(|| self.queue.try_send(Arc::clone(&record))) {
            Some(Ok(())) => return,
            Some(Err(TrySendError::Full(left) | TrySendError::Disconnected(left))) => left,
            None => record,
        };
        counters.waiting_bytes.fetch_sub(weight, Ordering::Relaxed);
        counters.dropped.fetch_add(1, Ordering::Relaxed);
        drop(left);
    }

    /// The records of a loop in a window, oldest first, in pieces; what is not on disk yet among them. With `before`, the
    /// record before the window comes first, where there is one.
    ///
    /// # Errors
    /// [`Error::Slow`], [`Error::Io`], [`Error::Database`].
    pub fn read(&self, loop_id: &LoopId, window: Window, before: bool) -> Result<Cursor, Error> {
        // What waits first: what goes to the disk meanwhile is then in both, and not in neither.
        let tail = self.ask(|answer| Request::Tail(loop_id.clone(), answer))??;
        Cursor::new(Arc::clone(&self.inner), loop_id.clone(), tail, window, before)
    }

    /// The loops of which there is something on disk.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn loops(&self) -> Result<Vec<LoopId>, Error> {
        let ids = self.inner.shelf.loops()?;
        Ok(ids.into_iter().filter_map(|id| LoopId::new(id).ok()).collect())
    }

    /// Throws a loop's records away, those that wait too. On disk when this returns.
    ///
    /// # Errors
    /// [`Error::Slow`]: it may still happen; [`Error::Io`], [`Error::Database`].
    pub fn forget(&self, loop_id: &LoopId) -> Result<(), Error> {
        self.ask(|answer| Request::Forget(loop_id.clone(), answer))?
    }

    /// Brings every record offered before to the disk.
    ///
    /// # Errors
    /// The write's error, or [`Error::Slow`] after 10 s.
    pub fn flush(&self) -> Result<(), Error> {
        self.ask(Request::Flush)?
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
    pub fn counts(&self) -> CycleCounts {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let c = &self.inner.counters;
        CycleCounts {
            offered: read(&c.offered),
            dropped: read(&c.dropped),
            written: read(&c.written),
            failed_writes: read(&c.failed_writes),
            damaged: read(&c.damaged),
            bytes: read(&c.bytes),
        }
    }

    #[cfg(test)]
    pub(crate) fn spoil(&self, loop_id: &LoopId, first: (u64, u64), spoil: impl Fn(&mut Vec<u8>)) {
        self.inner.shelf.spoil(loop_id, first, spoil);
    }

    fn ask<T>(&self, request: impl FnOnce(SyncSender<T>) -> Request) -> Result<T, Error> {
        let slow = || Error::Slow {
            seconds: ANSWER_SECONDS,
            path: self.inner.shelf.path().to_owned(),
        };
        let (answer, answers) = sync_channel(1);
        self.requests.try_send(request(answer)).map_err(|_| slow())?;
        answers
            .recv_timeout(Duration::from_secs(ANSWER_SECONDS))
            .map_err(|_| slow())
    }

    fn end(&mut self) -> Result<(), Error> {
        let Some(thread) = self.thread.take() else {
            return Ok(());
        };
        let result = self.ask(Request::Close).and_then(|result| result);
        if !matches!(result, Err(Error::Slow { .. })) && thread.join().is_err() {
            tracing::error!("the writer of cycles panicked");
        }
        result
    }
}

impl Drop for CycleLog {
    fn drop(&mut self) {
        if let Err(error) = self.end() {
            tracing::error!(%error, "the last cycles were not written");
        }
    }
}

/// The thread's side.
struct Writer {
    inner: Arc<Inner>,
    records: Receiver<Arc<Record>>,
    gathered: Gathered,
    /// Loops whose first record waits: nothing older of their name may stay.
    begun: BTreeSet<LoopId>,
    write_at: Instant,
    complained_at: Option<Instant>,
}

impl Writer {
    fn run(mut self, inbox: &Receiver<Request>) {
        loop {
            let request = inbox.recv_timeout(GATHER_EVERY);
            self.gather();
            match request {
                Err(RecvTimeoutError::Timeout) => {}
                // Nobody may be waiting for an answer any more; what was asked is done either way.
                Ok(Request::Tail(loop_id, answer)) => {
                    // What is on disk of an earlier life must not be read before this one.
                    let ready = if self.begun.contains(&loop_id) {
                        self.write()
                    } else {
                        Ok(())
                    };
                    let tail = self.gathered.get(&loop_id).into_iter().flatten().cloned().collect();
                    let _ = answer.try_send(ready.map(|()| tail));
                }
                Ok(Request::Flush(answer)) => {
                    let _ = answer.try_send(self.write());
                }
                Ok(Request::Forget(loop_id, answer)) => {
                    let _ = answer.try_send(self.forget(&loop_id));
                }
                Ok(Request::Close(answer)) => {
                    let _ = answer.try_send(self.write());
                    return;
                }
                Err(RecvTimeoutError::Disconnected) => {
                    if let Err(error) = self.write() {
                        self.complain(&error);
                    }
                    return;
                }
            }
            if Instant::now() >= self.write_at
                && let Err(error) = self.write()
            {
                self.complain(&error);
            }
        }
    }

    /// Empties the queue. A record that does not go on from the one gathered before it is passed over: the log is in order.
    fn gather(&mut self) {
        // At most one queue full, so that a flood cannot keep the thread from writing.
        for record in self.records.try_iter().take(QUEUE_MAX) {
            let waiting = self.gathered.entry(record.loop_id.clone()).or_default();
            if record.after == (0, 0) {
                self.begun.insert(record.loop_id.clone());
                waiting.drain(..).for_each(|old| release(&self.inner.counters, &old));
            }
            if waiting.back().is_none_or(|last| last.position() < record.position()) {
                waiting.push_back(record);
            } else {
                release(&self.inner.counters, &record);
            }
        }
    }

    fn write(&mut self) -> Result<(), Error> {
        self.write_at = Instant::now() + WRITE_EVERY;
        if self.gathered.is_empty() {
            return Ok(());
        }
        let counters = &self.inner.counters;
        while let Some(loop_id) = self.begun.first() {
            self.inner.shelf.forget(loop_id.as_str()).inspect_err(|_| {
                counters.failed_writes.fetch_add(1, Ordering::Relaxed);
                self.write_at = Instant::now() + FAILED_PAUSE;
            })?;
            self.begun.pop_first();
        }
        let parcels = self
            .gathered
            .iter()
            .flat_map(|(loop_id, waiting)| pack(loop_id, waiting));
        let parcels: Vec<Parcel> = parcels.collect();
        match self.inner.shelf.put(&parcels) {
            Ok(bytes) => {
                let written: u64 = parcels.iter().map(|parcel| parcel.head.count).sum();
                counters.written.fetch_add(written, Ordering::Relaxed);
                counters.bytes.store(bytes, Ordering::Relaxed);
                for record in std::mem::take(&mut self.gathered).into_values().flatten() {
                    release(counters, &record);
                }
                Ok(())
            }
            Err(error) => {
                counters.failed_writes.fetch_add(1, Ordering::Relaxed);
                self.write_at = Instant::now() + FAILED_PAUSE;
                Err(error)
            }
        }
    }

    fn forget(&mut self, loop_id: &LoopId) -> Result<(), Error> {
        self.begun.remove(loop_id);
        for record in self.gathered.remove(loop_id).into_iter().flatten() {
            release(&self.inner.counters, &record);
        }
        let bytes = self.inner.shelf.forget(loop_id.as_str())?;
        self.inner.counters.bytes.store(bytes, Ordering::Relaxed);
        Ok(())
    }

    fn complain(&mut self, error: &Error) {
        if self.complained_at.is_some_and(|at| at.elapsed() < COMPLAIN_EVERY) {
            return;
        }
        self.complained_at = Some(Instant::now());
        let source = std::error::Error::source(error)
            .map(ToString::to_string)
            .unwrap_or_default();
        tracing::error!(%error, source, "recorded cycles wait in memory");
    }
}

/// A record no longer waits.
fn release(counters: &Counters, record: &Record) {
    counters
        .waiting_bytes
        .fetch_sub(chunk::weight(record) as u64, Ordering::Relaxed);
}

/// A loop's waiting records as chunks.
fn pack(loop_id: &LoopId, waiting: &VecDeque<Arc<Record>>) -> Vec<Parcel> {
    let mut parcels = Vec::new();
    let mut piece: Vec<Arc<Record>> = Vec::new();
    let mut bytes = 0;
    for record in waiting {
        piece.push(Arc::clone(record));
        bytes += chunk::weight(record);
        if piece.len() >= chunk::RECORDS_MAX || bytes >= chunk::BYTES_FULL {
            parcels.extend(parcel(loop_id, &piece));
            piece.clear();
            bytes = 0;
        }
    }
    parcels.extend(parcel(loop_id, &piece));
    parcels
}

fn parcel(loop_id: &LoopId, records: &[Arc<Record>]) -> Option<Parcel> {
    let (first, last) = (records.first()?, records.last()?);
    let head = Head {
        number: 0,
        first: first.position(),
        last: last.position(),
        first_at_ns: first.at_ns,
        last_at_ns: last.at_ns,
        count: records.len() as u64,
    };
    match chunk::encode(records) {
        Ok(bytes) => Some(Parcel {
            loop_id: loop_id.clone(),
            head,
            bytes,
        }),
        Err(error) => {
            tracing::error!(%loop_id, %error, "some cycles have no written form and are lost; this is a fault of the program");
            None
        }
    }
}

/// Reads a chunk; one that cannot be read is counted, said once in the log, and none.
fn unpack(inner: &Inner, loop_id: &LoopId, head: &Head) -> Result<Option<Vec<Arc<Record>>>, Error> {
    let Some(bytes) = inner.shelf.chunk(head.number)? else {
        return Ok(None);
    };
    match chunk::decode(&bytes) {
        Ok(records) => Ok(Some(records)),
        Err(error) => {
            inner.counters.damaged.fetch_add(1, Ordering::Relaxed);
            let path: &Path = inner.shelf.path();
            tracing::warn!(%loop_id, first = ?head.first, %error, path = %path.display(), "some recorded cycles cannot be read and are skipped");
            Ok(None)
        }
    }
}
