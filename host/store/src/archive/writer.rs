//! The thread that keeps the history: takes what was offered, brings it to the disk, packs it, and makes room.
//!
//! ```text
//!  every 100 ms: queue ─► pieces in memory        every 500 ms: what came since ─► journal        journal full, or 10 min old: packed
//!                                                                     └ disk full ─► said, tried again; memory bounded, oldest go
//! ```
//! Never: holds up whoever offers; holds the lock of the memory while the disk works.

use std::{
    collections::HashMap,
    sync::{
        Arc,
        atomic::Ordering,
        mpsc::{Receiver, RecvTimeoutError, SyncSender},
    },
    time::{Duration, Instant},
};

use bumpless_core::{
    Digest, LoopId, PointId, Record,
    history::{Bucket, Layout, Row, STEPS_NS, Seen, Series},
};

use super::{
    Inner, Judge, Lens,
    block::pack,
    disk::Disk,
    memory::{self, PACKED_MIN},
};
use crate::error::Error;

/// How often the thread empties the queue.
const GATHER_EVERY: Duration = Duration::from_millis(100);

/// How often what came goes into the journal: a process that is killed loses this and a gathering at most.
const WRITE_EVERY: Duration = Duration::from_millis(500);

/// How often the files are synced: what a loss of power may cost. A kill costs less, for the system has what was written.
const SYNC_EVERY: Duration = Duration::from_secs(10);

/// Age at which a journal is packed although it is small.
const PACK_EVERY: Duration = Duration::from_secs(600);

/// Pause after a write that failed.
const FAILED_PAUSE: Duration = Duration::from_secs(5);

/// How often a failing disk is logged.
const COMPLAIN_EVERY: Duration = Duration::from_secs(60);

/// For how long it is believed whether a loop is kept here.
const JUDGED_FOR: Duration = Duration::from_secs(1);

/// Pieces of the finest step in memory at most: some 60 MB. Where the disk takes nothing the oldest go.
const FRESH_MAX: usize = 200_000;

/// Files that go in one turn at most, so that none takes long.
const REMOVED_MAX: usize = 64;

/// What is offered.
#[derive(Debug)]
pub(super) enum Offer {
    Cycle(Arc<Record>),
    Point {
        id: PointId,
        at_ns: u64,
        value: Option<f64>,
        bad: bool,
        period_ns: u64,
    },
}

pub(super) enum Request {
    /// Who says what is kept; none to keep no loop any more.
    Judge(Option<Judge>, SyncSender<()>),
    /// Bring everything to the journal and say how it went; with `true` pack it too.
    Flush(bool, SyncSender<Result<(), Error>>),
    /// Flush, and end.
    Close(SyncSender<Result<(), Error>>),
}

/// An entry of the journal.
type Entry = Vec<(Series, Layout, Bucket)>;

struct Judged {
    digest: Digest,
    revision: u64,
    until: Instant,
    lens: Option<Lens>,
}

pub(super) struct Writer {
    pub(super) inner: Arc<Inner>,
    pub(super) disk: Disk,
    pub(super) offers: Receiver<Offer>,
    judge: Option<Judge>,
    judged: HashMap<LoopId, Judged>,
    points: Arc<Layout>,
    /// What came since the last write into the journal.
    unsaved: HashMap<Series, Vec<Row>>,
    write_at: Instant,
    sync_at: Instant,
    pack_at: Instant,
    complained_at: Option<Instant>,
}

impl Writer {
    pub(super) fn new(inner: Arc<Inner>, disk: Disk, offers: Receiver<Offer>) -> Self {
        let now = Instant::now();
        Self {
            inner,
            disk,
            offers,
            judge: None,
            judged: HashMap::new(),
            points: Arc::default(),
            unsaved: HashMap::new(),
            write_at: now + WRITE_EVERY,
            sync_at: now + SYNC_EVERY,
            pack_at: now + PACK_EVERY,
            complained_at: None,
        }
    }

    pub(super) fn run(mut self, inbox: &Receiver<Request>) {
        loop {
            let request = inbox.recv_timeout(GATHER_EVERY);
            self.gather();
            match request {
                Err(RecvTimeoutError::Timeout) => {}
                Ok(Request::Judge(judge, answer)) => {
                    self.judge = judge;
                    self.judged.clear();
                    let _ = answer.try_send(());
                }
                // Nobody may be waiting for an answer any more; what was asked is done either way.
                Ok(Request::Flush(packed, answer)) => {
                    let end = self.write().and_then(|()| if packed { self.pack() } else { Ok(()) });
                    let _ = answer.try_send(self.told(end));
                }
                Ok(Request::Close(answer)) => {
                    let end = self.write().and_then(|()| self.disk.sync());
                    let _ = answer.try_send(end);
                    return;
                }
                Err(RecvTimeoutError::Disconnected) => {
                    let end = self.write();
                    let _said = self.told(end);
                    return;
                }
            }
            if Instant::now() >= self.write_at {
                let end = self.turn();
                let _said = self.told(end);
            }
        }
    }

    /// One turn of the disk's work.
    fn turn(&mut self) -> Result<(), Error> {
        self.write()?;
        let now = Instant::now();
        let full = self.disk.journal.bytes >= self.disk.journal_bytes_max();
        let fresh = self.inner.memory().fresh;
        if fresh > 0 && (full || now >= self.pack_at || fresh >= FRESH_MAX / 2) {
            self.pack()?;
        }
        if now >= self.sync_at {
            self.sync_at = now + SYNC_EVERY;
            self.disk.sync()?;
        }
        Ok(())
    }

    /// Remembers how the disk is, complains now and then, and keeps the memory within its bound.
    fn told(&mut self, end: Result<(), Error>) -> Result<(), Error> {
        let counters = &self.inner.counters;
        counters.bytes.store(self.disk.bytes(), Ordering::Relaxed);
        let Err(error) = &end else {
            counters.failing.store(false, Ordering::Relaxed);
            return end;
        };
        counters.failing.store(true, Ordering::Relaxed);
        counters.failed_writes.fetch_add(1, Ordering::Relaxed);
        self.write_at = Instant::now() + FAILED_PAUSE;
        if self.complained_at.is_none_or(|at| at.elapsed() >= COMPLAIN_EVERY) {
            self.complained_at = Some(Instant::now());
            let source = std::error::Error::source(error)
                .map(ToString::to_string)
                .unwrap_or_default();
            tracing::error!(%error, source, "history waits in memory; cycles go on");
        }
        let mut memory = self.inner.memory_mut();
        if memory.fresh > FRESH_MAX {
            let mut shed = memory.shed();
            for rows in self.unsaved.values_mut() {
                let going = rows.len() / 2;
                rows.drain(..going);
                shed += going as u64;
            }
            counters.dropped_rows.fetch_add(shed, Ordering::Relaxed);
        }
        end
    }

    /// Empties the queue.
    fn gather(&mut self) {
        let inner = Arc::clone(&self.inner);
        // At most one queue full, so that a flood cannot keep the thread from writing.
        let offers: Vec<Offer> = self.offers.try_iter().take(super::QUEUE_MAX).collect();
        let lenses: Vec<Option<Lens>> = offers.iter().map(|offer| self.lens(offer)).collect();
        let mut memory = inner.memory_mut();
        for (offer, lens) in offers.iter().zip(lenses) {
            let Some(lens) = lens else { continue };
            let (series, position);
            let seen = match offer {
                Offer::Cycle(record) => {
                    series = Series::Loop(record.loop_id.clone());
                    position = Some((record.position(), record.mode));
                    let before = memory.series.get(&series).and_then(|kept| kept.last);
                    if before.is_some_and(|(before, _)| before >= record.position()) && record.after != (0, 0) {
                        continue;
                    }
                    Seen::of(record, lens.measured, lens.layout.period_ns, before)
                }
                Offer::Point {
                    id, at_ns, value, bad, ..
                } => {
                    series = Series::Point(id.clone());
                    position = None;
                    Seen {
                        at_ns: *at_ns,
                        setpoint: f64::NAN,
                        measurement: *value,
                        bad: *bad,
                        ..Seen::default()
                    }
                }
            };
            if memory.series.len() >= super::SERIES_MAX && !memory.series.contains_key(&series) {
                continue;
            }
            memory.take(&series, &lens.layout, &seen).last = position;
            memory::take(
                self.unsaved.entry(series).or_default(),
                STEPS_NS[0],
                &lens.layout,
                &seen,
            );
            inner.counters.taken.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// How an offer is read; none where it is not kept here.
    fn lens(&mut self, offer: &Offer) -> Option<Lens> {
        let record = match offer {
            Offer::Cycle(record) => record,
            Offer::Point { period_ns, .. } => {
                if self.points.period_ns != *period_ns {
                    self.points = Arc::new(Layout {
                        outputs: Vec::new(),
                        period_ns: *period_ns,
                    });
                }
                return Some(Lens {
                    layout: Arc::clone(&self.points),
                    measured: None,
                });
            }
        };
        let judge = self.judge.as_ref()?;
        let now = Instant::now();
        match self.judged.get_mut(&record.loop_id) {
            Some(judged)
                if judged.digest == record.digest && judged.revision == record.revision && now < judged.until =>
            {
                judged.lens.clone()
            }
            held => {
                let mut lens = judge(record);
                // The same layout stays the same place in memory, so that it is quickly compared.
                if let (Some(lens), Some(old)) = (&mut lens, held.and_then(|held| held.lens.as_ref()))
                    && lens.layout == old.layout
                {
                    lens.layout = Arc::clone(&old.layout);
                }
                let judged = Judged {
                    digest: record.digest,
                    revision: record.revision,
                    until: now + JUDGED_FOR,
                    lens: lens.clone(),
                };
                self.judged.insert(record.loop_id.clone(), judged);
                if self.judged.len() > super::SERIES_MAX {
                    self.judged.retain(|_, judged| now < judged.until);
                }
                lens
            }
        }
    }

    /// Brings what came to the journal.
    fn write(&mut self) -> Result<(), Error> {
        self.write_at = Instant::now() + WRITE_EVERY;
        let entry: Entry = self
            .unsaved
            .iter()
            .flat_map(|(series, rows)| {
                rows.iter()
                    .map(|row| (series.clone(), (*row.layout).clone(), row.bucket.clone()))
            })
            .collect();
        if entry.is_empty() {
            return Ok(());
        }
        let bytes = postcard::to_allocvec(&entry).map_err(|source| Error::Row {
            what: "an entry of the history".to_owned(),
            source,
        })?;
        self.disk.journal(&bytes)?;
        let written: u64 = entry.iter().map(|(.., bucket)| bucket.cycles).sum();
        self.inner.counters.written.fetch_add(written, Ordering::Relaxed);
        self.unsaved.clear();
        Ok(())
    }

    /// Packs the journal, and of the coarser steps what is enough for a block; then makes room.
    fn pack(&mut self) -> Result<(), Error> {
        self.pack_at = Instant::now() + PACK_EVERY;
        self.pack_level(0, 1)?;
        for level in 1..STEPS_NS.len() {
            self.pack_level(level, PACKED_MIN)?;
        }
        self.make_room()
    }

    /// Packs what waits of a step, of each series that has at least so many whole pieces.
    fn pack_level(&mut self, level: usize, least: usize) -> Result<(), Error> {
        let mut blocks = Vec::new();
        let mut taken = Vec::new();
        {
            let memory = self.inner.memory();
            for (series, kept) in &memory.series {
                let Some(held) = kept.levels.get(level) else { continue };
                // The open piece of a coarse step stays; that of the finest may be packed in parts.
                let whole = held.waiting.len() - usize::from(level > 0 && !held.waiting.is_empty());
                if whole >= least {
                    blocks.extend(pack(series, held.waiting.get(..whole).unwrap_or_default()));
                    taken.push((series.clone(), whole));
                }
            }
        }
        if blocks.is_empty() {
            return Ok(());
        }
        let places = if level == 0 {
            self.disk.pack_journal(blocks)?
        } else {
            self.disk.put(level, blocks)?
        };
        let mut memory = self.inner.memory_mut();
        for (series, count) in taken {
            if let Some(held) = memory
                .series
                .get_mut(&series)
                .and_then(|kept| kept.levels.get_mut(level))
            {
                held.waiting.drain(..count.min(held.waiting.len()));
            }
            if level == 0 {
                memory.fresh -= count.min(memory.fresh);
            }
        }
        for (series, place) in places {
            let kept = memory.series.entry(series).or_default();
            if let Some(held) = kept.levels.get_mut(level) {
                held.places.push(place);
            }
        }
        Ok(())
    }

    /// Throws files away, the oldest of the finest step first, until there is room. What a coarser step has not packed of them
    /// is packed before.
    pub(super) fn make_room(&mut self) -> Result<(), Error> {
        for _ in 0..REMOVED_MAX {
            let newest_ns = self.inner.memory().newest_ns;
            let Some((number, level)) = self.disk.next_to_go(newest_ns) else {
                break;
            };
            if level + 1 < STEPS_NS.len() {
                self.pack_level(level + 1, 1)?;
            }
            self.disk.remove(number)?;
            self.inner.memory_mut().forget(number, level);
            self.inner.counters.removed_files.fetch_add(1, Ordering::Relaxed);
        }
        self.inner.counters.bytes.store(self.disk.bytes(), Ordering::Relaxed);
        Ok(())
    }
}
