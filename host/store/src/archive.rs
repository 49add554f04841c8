//! The long memory: thinned history of loops and points, for years, within a bound.
//!
//! Owns: the folder `history` in the store's directory, the thread that writes it, and the way back from it.
//! Never: makes a cycle wait. A record is offered through a bounded queue without a lock; when the queue is full, the record is
//! dropped from the history (not from the log of cycles) and counted.
//!
//! ```text
//!   offer ──queue──► pieces of 1 s, 10 s, 1 min, 15 min in memory ──half a second──► journal ──minutes──► packed files
//!                                                                                     over the bound: oldest of the finest go
//! ```
//! A killed process loses 0.6 s at most. What a dying one left half written is cut at the next start, and said; a damaged block is
//! skipped and counted, a damaged file moved aside. A full disk costs history, never a cycle: pieces wait in memory, the oldest
//! of the finest go from there too. A date that goes back leaves two histories of one hour, which are told as one.

use std::{
    sync::{
        Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc::{SyncSender, sync_channel},
    },
    thread::JoinHandle,
    time::Duration,
};

use bumpless_core::{
    PointId, Record,
    history::{Bucket, Layout, Row, STEPS_NS, Series},
};

use self::{
    disk::{Disk, Place},
    memory::Memory,
    writer::{Offer, Request, Writer},
};
use crate::{error::Error, store::Store};

mod block;
mod disk;
mod file;
mod memory;
mod writer;
pub(crate) mod parsing {
    //! The forms of blocks and files, for [`crate::parsers`].
    pub(crate) use super::{
        block::{Head, rows},
        file::frames,
    };
}

pub use block::{RowBlock, pack as pack_rows, unpack as unpack_rows};

const FOLDER: &str = "history";

/// Least and greatest bound of the history's files, in bytes: below it there is no room for its steps; beyond it a disk of its
/// own is due.
pub const BYTES_MAX: std::ops::RangeInclusive<u64> = 4 * 1024 * 1024..=1024 * 1024 * 1024 * 1024;

/// Offers that wait in the queue, between two looks of the thread: 160,000 a second.
pub(crate) const QUEUE_MAX: usize = 16_384;

/// Series at most: a cell's loops, and as many points. Each takes some 100 KB of memory.
pub(crate) const SERIES_MAX: usize = 40_000;

/// The longest wait for the thread: it may be in the middle of a sync.
const ANSWER_SECONDS: u64 = 10;

/// Requests to the thread that may wait. More callers at once get [`Error::Slow`].
const REQUESTS_MAX: usize = 64;

/// Pieces that one reading gives at most, of each step: 60 MB.
pub const ROWS_MAX: usize = 200_000;

/// How a loop's records are read.
#[derive(Debug, Clone)]
pub struct Lens {
    /// Names of its outputs, and its period.
    pub layout: Arc<Layout>,
    /// Number of the measured port.
    pub measured: Option<usize>,
}

/// Says whether a record's loop is kept here, and how it is read. Called on the history's thread, about once a second and loop.
pub type Judge = Box<dyn Fn(&Record) -> Option<Lens> + Send>;

/// How much is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Bytes of all files, within [`BYTES_MAX`].
    pub bytes_max: u64,
    /// How long pieces are kept, in ns, by their step; see [`STEPS_NS`].
    pub keep_ns: [u64; STEPS_NS.len()],
}

/// What the history did since it was opened.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ArchiveCounts {
    /// Cycles and values offered.
    pub offered: u64,
    /// Those dropped because too many waited.
    pub dropped: u64,
    /// Those of series that are kept here.
    pub taken: u64,
    /// Those that are in a file.
    pub written: u64,
    /// Pieces dropped from memory because the disk took nothing for long.
    pub dropped_rows: u64,
    /// Writes that failed.
    pub failed_writes: u64,
    /// Does the disk take nothing now?
    pub failing: bool,
    /// Blocks that could not be read and were skipped; each reading counts.
    pub damaged: u64,
    /// Bytes that were left out at the start because a write had broken off.
    pub cut_bytes: u64,
    /// Files that went to make room.
    pub removed_files: u64,
    /// Bytes of all files.
    pub bytes: u64,
}

#[derive(Debug, Default)]
struct Counters {
    offered: AtomicU64,
    dropped: AtomicU64,
    taken: AtomicU64,
    written: AtomicU64,
    dropped_rows: AtomicU64,
    failed_writes: AtomicU64,
    failing: AtomicBool,
    damaged: AtomicU64,
    cut_bytes: AtomicU64,
    removed_files: AtomicU64,
    bytes: AtomicU64,
}

/// What readers and the thread share.
#[derive(Debug)]
struct Inner {
    memory: RwLock<Memory>,
    counters: Counters,
    // Holds the lock of the directory.
    _store: Store,
}

impl Inner {
    // Poisoned or not: each change of it is whole, and history must not take a host down.
    fn memory(&self) -> RwLockReadGuard<'_, Memory> {
        self.memory.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn memory_mut(&self) -> RwLockWriteGuard<'_, Memory> {
        self.memory.write().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The history. Dropping it brings everything to the disk as [`Archive::close`] does, and logs an error.
#[derive(Debug)]
pub struct Archive {
    inner: Arc<Inner>,
    queue: SyncSender<Offer>,
    requests: SyncSender<Request>,
    thread: Option<JoinHandle<()>>,
}

/// What a reading found.
#[derive(Debug, Clone, PartialEq)]
pub struct Reading {
    /// Pieces, by step and then oldest first. Those of one step do not overlap.
    pub rows: Vec<Row>,
    /// Up to here it is all, in ns since 1970: the end of the window, or where there were too many.
    pub to_ns: u64,
}

impl Archive {
    /// Opens the history in the store's directory, and starts its thread. Nothing of a loop is kept until [`Archive::judge_by`]
    /// was called.
    ///
    /// # Errors
    /// [`Error::Size`] for a bound outside [`BYTES_MAX`], [`Error::Io`].
    pub fn open(store: &Store, bounds: Bounds) -> Result<Self, Error> {
        if !BYTES_MAX.contains(&bounds.bytes_max) {
            return Err(Error::Size {
                what: format!("the bound of the history (at least {} bytes)", BYTES_MAX.start()),
                bytes: usize::try_from(bounds.bytes_max).unwrap_or(usize::MAX),
                max: usize::try_from(*BYTES_MAX.end()).unwrap_or(usize::MAX),
            });
        }
        Self::open_with(store, bounds, |_| {})
    }

    fn open_with(store: &Store, bounds: Bounds, prepare: impl FnOnce(&mut Disk)) -> Result<Self, Error> {
        let folder = store.directory().join(FOLDER);
        let (mut disk, opened) = Disk::open(&folder, bounds.bytes_max, bounds.keep_ns)?;
        prepare(&mut disk);
        let counters = Counters::default();
        counters.cut_bytes.store(opened.cut_bytes, Ordering::Relaxed);
        counters.bytes.store(disk.bytes(), Ordering::Relaxed);
        let inner = Arc::new(Inner {
            memory: RwLock::default(),
            counters,
            _store: store.clone(),
        });
        inner.remember(opened);
        let (queue, offers) = sync_channel(QUEUE_MAX);
        let (requests, inbox) = sync_channel(REQUESTS_MAX);
        let writer = Writer::new(Arc::clone(&inner), disk, offers);
        let thread = std::thread::Builder::new()
            .name("history-writer".into())
            .spawn(move || writer.run(&inbox))
            .map_err(|error| Error::io("start the writer of", &folder, error))?;
        Ok(Self {
            inner,
            queue,
            requests,
            thread: Some(thread),
        })
    }

    /// Who says which loops are kept, and how they are read: of everything that is offered after this returns.
    ///
    /// # Errors
    /// [`Error::Slow`] after 10 s.
    pub fn judge_by(&self, judge: Judge) -> Result<(), Error> {
        self.ask(|answer| Request::Judge(Some(judge), answer))
    }

    /// Keeps no loop any more, soon, and lets go of who said which. Does not wait.
    pub fn stop_judging(&self) {
        let (answer, _nobody) = sync_channel(1);
        // Where the thread has so much to do, it ends with the archive.
        let _ = self.requests.try_send(Request::Judge(None, answer));
    }

    /// Takes a record. Never blocks, and takes no lock that the thread holds.
    pub fn offer(&self, record: Arc<Record>) {
        self.put(Offer::Cycle(record));
    }

    /// Takes a point's value, read every `period_ns`. Never blocks.
    pub fn offer_point(&self, id: PointId, at_ns: u64, value: Option<f64>, bad: bool, period_ns: u64) {
        self.put(Offer::Point {
            id,
            at_ns,
            value,
            bad,
            period_ns,
        });
    }

    fn put(&self, offer: Offer) {
        let counters = &self.inner.counters;
        counters.offered.fetch_add(1, Ordering::Relaxed);
        if self.queue.try_send(offer).is_err() {
            counters.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Is anything of the series kept?
    #[must_use]
    pub fn has(&self, series: &Series) -> bool {
        self.inner.memory().series.contains_key(series)
    }

    /// Everything of which something is kept.
    #[must_use]
    pub fn series(&self) -> Vec<Series> {
        self.inner.memory().series.keys().cloned().collect()
    }

    /// Pieces of a series of this step and all coarser ones, of those that begin in the window; with `overlapping` also those that
    /// reach into it from before. At most `rows_max` of each step (and [`ROWS_MAX`]); then it ends earlier. Blocks on the disk.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn read(
        &self,
        series: &Series,
        (from_ns, to_ns): (u64, u64),
        step_ns: u64,
        (overlapping, rows_max): (bool, usize),
    ) -> Result<Reading, Error> {
        let rows_max = rows_max.min(ROWS_MAX);
        let mut reading = Reading {
            rows: Vec::new(),
            to_ns,
        };
        for (level, step) in STEPS_NS.into_iter().enumerate().filter(|(_, step)| *step >= step_ns) {
            let begin_ns = if overlapping {
                from_ns.saturating_sub(step.saturating_sub(1))
            } else {
                from_ns
            };
            let mut rows = self.inner.level(series, level, begin_ns, reading.to_ns)?;
            if let Some(beyond) = rows.get(rows_max) {
                reading.to_ns = reading.to_ns.min(beyond.start_ns());
                rows.truncate(rows_max);
            }
            reading.rows.append(&mut rows);
        }
        let end_ns = reading.to_ns;
        reading.rows.retain(|row| row.start_ns() < end_ns);
        Ok(reading)
    }

    /// Brings everything offered before to the journal.
    ///
    /// # Errors
    /// The write's error, or [`Error::Slow`] after 10 s.
    pub fn flush(&self) -> Result<(), Error> {
        self.ask(|answer| Request::Flush(false, answer))?
    }

    /// The same, and packs the journal: what else happens every ten minutes.
    ///
    /// # Errors
    /// As [`Archive::flush`].
    pub fn pack(&self) -> Result<(), Error> {
        self.ask(|answer| Request::Flush(true, answer))?
    }

    /// Brings everything to the disk and ends the thread.
    ///
    /// # Errors
    /// The write's error, or [`Error::Slow`] after 10 s; the thread then ends by itself when the disk lets it.
    pub fn close(mut self) -> Result<(), Error> {
        self.end()
    }

    /// What it did so far.
    #[must_use]
    pub fn counts(&self) -> ArchiveCounts {
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let c = &self.inner.counters;
        ArchiveCounts {
            offered: read(&c.offered),
            dropped: read(&c.dropped),
            taken: read(&c.taken),
            written: read(&c.written),
            dropped_rows: read(&c.dropped_rows),
            failed_writes: read(&c.failed_writes),
            failing: c.failing.load(Ordering::Relaxed),
            damaged: read(&c.damaged),
            cut_bytes: read(&c.cut_bytes),
            removed_files: read(&c.removed_files),
            bytes: read(&c.bytes),
        }
    }

    fn slow(&self) -> Error {
        Error::Slow {
            seconds: ANSWER_SECONDS,
            path: self.inner._store.directory().join(FOLDER),
        }
    }

    fn ask<T>(&self, request: impl FnOnce(SyncSender<T>) -> Request) -> Result<T, Error> {
        let (answer, answers) = sync_channel(1);
        self.requests.try_send(request(answer)).map_err(|_| self.slow())?;
        answers
            .recv_timeout(Duration::from_secs(ANSWER_SECONDS))
            .map_err(|_| self.slow())
    }

    fn end(&mut self) -> Result<(), Error> {
        let Some(thread) = self.thread.take() else {
            return Ok(());
        };
        let result = self.ask(Request::Close).and_then(|result| result);
        if !matches!(result, Err(Error::Slow { .. })) && thread.join().is_err() {
            tracing::error!("the writer of the history panicked");
        }
        result
    }
}

impl Drop for Archive {
    fn drop(&mut self) {
        if let Err(error) = self.end() {
            tracing::error!(%error, "the last of the history was not written");
        }
    }
}

impl Inner {
    /// Takes up what was found on the disk. Coarser pieces that were not packed are made anew from the finer ones.
    fn remember(&self, opened: disk::Opened) {
        let mut memory = self.memory_mut();
        for (level, series, place) in opened.blocks {
            memory.newest_ns = memory.newest_ns.max(place.end_ns);
            let kept = memory.series.entry(series).or_default();
            if let Some(held) = kept.levels.get_mut(level) {
                held.places.push(place);
            }
        }
        for entry in opened.entries {
            let Ok(rows) = postcard::from_bytes::<Vec<(Series, Layout, Bucket)>>(&entry) else {
                self.counters.damaged.fetch_add(1, Ordering::Relaxed);
                continue;
            };
            for (series, layout, bucket) in rows {
                let layout = Arc::new(layout);
                memory.take_entry(
                    series,
                    Row {
                        step_ns: STEPS_NS[0],
                        layout,
                        bucket,
                    },
                );
            }
        }
        for kept in memory.series.values_mut() {
            for level in 1..STEPS_NS.len() {
                let (finer, rest) = kept.levels.split_at_mut(level);
                let (Some(finer), Some(held)) = (finer.last(), rest.first_mut()) else {
                    continue;
                };
                let from_ns = held.packed_to_ns();
                let step_ns = STEPS_NS.get(level).copied().unwrap_or_default();
                let places: Vec<Place> = finer.places.iter().filter(|p| p.end_ns > from_ns).cloned().collect();
                // What cannot be read is missing in the coarser piece as it is in the finer.
                let mut rows = self.unpacked(&places).unwrap_or_default();
                rows.extend(finer.waiting.iter().cloned());
                rows.retain(|row| row.start_ns() >= from_ns);
                rows.sort_by_key(Row::start_ns);
                held.waiting = bumpless_core::history::thin(rows, step_ns);
            }
        }
    }

    /// Pieces of one step that begin in a window, oldest first.
    fn level(&self, series: &Series, level: usize, from_ns: u64, to_ns: u64) -> Result<Vec<Row>, Error> {
        let (places, waiting) = {
            let memory = self.memory();
            let Some(held) = memory.series.get(series).and_then(|kept| kept.levels.get(level)) else {
                return Ok(Vec::new());
            };
            let places: Vec<Place> = held
                .places
                .iter()
                .filter(|place| place.end_ns > from_ns && place.first_ns < to_ns)
                .cloned()
                .collect();
            let waiting = held.waiting.iter();
            let waiting: Vec<Row> = waiting
                .filter(|row| row.start_ns() >= from_ns && row.start_ns() < to_ns)
                .cloned()
                .collect();
            (places, waiting)
        };
        let mut rows = self.unpacked(&places)?;
        rows.retain(|row| row.start_ns() >= from_ns && row.start_ns() < to_ns);
        rows.extend(waiting);
        rows.sort_by_key(Row::start_ns);
        // One piece may lie in parts: packed in its middle, before and after a restart, or lived through twice by the date.
        rows.dedup_by(|later, kept| {
            let same = later.start_ns() == kept.start_ns();
            if same {
                kept.merge(later);
            }
            same
        });
        Ok(rows)
    }

    /// The pieces of some blocks. One that cannot be read is counted, said in the log, and left out.
    fn unpacked(&self, places: &[Place]) -> Result<Vec<Row>, Error> {
        let mut rows = Vec::with_capacity(places.iter().map(|place| place.rows as usize).sum());
        let mut layout: Option<Arc<Layout>> = None;
        for place in places {
            let shared = match layout.take() {
                Some(known) if known == place.layout => known,
                _ => Arc::clone(&place.layout),
            };
            let unpacked = place.read(&shared);
            layout = Some(shared);
            match unpacked {
                Ok(mut some) => rows.append(&mut some),
                Err(reason) => {
                    self.counters.damaged.fetch_add(1, Ordering::Relaxed);
                    tracing::warn!(
                        file = place.segment,
                        at = place.at,
                        reason,
                        "a block of the history cannot be read and is skipped"
                    );
                }
            }
        }
        Ok(rows)
    }
}

#[cfg(test)]
pub(crate) mod tests;
