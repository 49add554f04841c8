//! Who changed what: an entry for every change that enters the cell through this host, in a chain on its disk.
//!
//! ```text
//! facade ──noted as begun──► the change, in a task of its own ──► its end ──► entry (what, by whom, from where, before, after,
//!   │ who asks: Asker                                                           outcome) ──► on disk ──► the asker is answered
//!   └ the host dies meanwhile ──► at its next start: an entry with the outcome "unknown"
//! disk refuses ──► waits (WAITING_MAX, the oldest is dropped and counted) ──► tried again; changes are never held up by it
//! ```
//! Owns: what an entry says, and that it is on disk before the answer wherever the disk takes it. Never: on a cycle's thread;
//! decides whether somebody may do something.

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant, SystemTime},
};

use bumpless_store::{AuditBegun, AuditFound, AuditHead, AuditLog, Store};
use parking_lot::Mutex;
use serde_json::{Value, json};

use crate::{
    beat::every,
    book::on_disk,
    error::Error,
    limits::{AUDIT_FAILURES_MAX, AUDIT_FAILURES_WINDOW, AUDIT_RETRY, AUDIT_WAITING_MAX},
    room::{Room, count},
};

mod asker;
mod entry;
mod look;
mod sights;

pub use asker::{Asker, Via};
pub(crate) use entry::{Act, Seen};
pub use entry::{AuditEntry, AuditKind, AuditLine, FieldChange};
pub(crate) use look::{AuditAsk, Looked};
pub use look::{AuditFilter, AuditFlaw, AuditList, AuditPage, AuditVerdict};
pub(crate) use sights::component;

/// Entries that are written at once.
const AT_ONCE: usize = 64;

/// What failed lately: so many since then, and so many more that were only counted.
#[derive(Debug)]
struct Failures {
    since: Instant,
    told: u32,
    unlisted: u64,
}

/// The trail of this host.
pub(crate) struct Audit {
    log: Arc<AuditLog>,
    /// Entries that the disk refused, oldest first.
    waiting: Arc<Mutex<VecDeque<String>>>,
    /// Held by whoever writes, on a blocking thread: entries come to the disk in the order in which they waited.
    writing: Arc<Mutex<()>>,
    failures: Mutex<Failures>,
    pub(crate) refused: Arc<AtomicU64>,
    pub(crate) lost: Arc<AtomicU64>,
    unsaid: Arc<AtomicU64>,
}

impl Audit {
    /// Opens the trail. Blocks.
    pub(crate) fn open(
        store: &Store,
        host: &bumpless_core::HostId,
        bytes_max: u64,
    ) -> Result<(Self, AuditFound), Error> {
        let (log, found) = AuditLog::open(store, host, bytes_max)?;
        let audit = Self {
            log: Arc::new(log),
            waiting: Arc::default(),
            writing: Arc::default(),
            failures: Mutex::new(Failures {
                since: Instant::now(),
                told: 0,
                unlisted: 0,
            }),
            refused: Arc::default(),
            lost: Arc::default(),
            unsaid: Arc::default(),
        };
        Ok((audit, found))
    }

    /// How far the trail is.
    pub(crate) fn head(&self) -> AuditHead {
        self.log.head()
    }

    /// Entries that wait for the disk.
    pub(crate) fn waiting(&self) -> usize {
        self.waiting.lock().len()
    }

    /// Is there room for another entry of something that failed? Those who keep knocking must not push out what was done.
    fn lists_failure(&self) -> bool {
        let mut failures = self.failures.lock();
        if failures.since.elapsed() >= AUDIT_FAILURES_WINDOW {
            (failures.since, failures.told) = (Instant::now(), 0);
        }
        if failures.told < AUDIT_FAILURES_MAX {
            failures.told += 1;
            return true;
        }
        failures.unlisted += 1;
        false
    }

    /// How many failures were only counted, once the rush is over.
    fn unlisted(&self) -> Option<u64> {
        let mut failures = self.failures.lock();
        (failures.unlisted > 0 && failures.since.elapsed() >= AUDIT_FAILURES_WINDOW)
            .then(|| std::mem::take(&mut failures.unlisted))
    }

    /// Brings entries to the disk, those that wait first. What the disk refuses waits.
    async fn write(&self, entries: Vec<AuditEntry>) {
        let texts = entries.iter().map(AuditEntry::text);
        {
            let mut waiting = self.waiting.lock();
            waiting.extend(texts);
            while waiting.len() > AUDIT_WAITING_MAX {
                waiting.pop_front();
                count(&self.lost);
                count(&self.unsaid);
            }
        }
        let (log, waiting) = (Arc::clone(&self.log), Arc::clone(&self.waiting));
        let (writing, unsaid) = (Arc::clone(&self.writing), Arc::clone(&self.unsaid));
        let written = on_disk(move || -> Result<(), Error> {
            let _turn = writing.lock();
            loop {
                // Taken out while they are written: what is dropped meanwhile for want of room is none of these.
                let next: Vec<String> = {
                    let mut waiting = waiting.lock();
                    let count = waiting.len().min(AT_ONCE);
                    waiting.drain(..count).collect()
                };
                if next.is_empty() {
                    break;
                }
                if let Err(error) = log.append(&next) {
                    let mut waiting = waiting.lock();
                    next.into_iter().rev().for_each(|text| waiting.push_front(text));
                    return Err(error.into());
                }
            }
            let lost = unsaid.load(Ordering::Relaxed);
            if lost > 0 {
                let said = AuditEntry::own(AuditKind::TrailLost, json!({ "entries": lost }));
                log.append(&[said.text()])?;
                unsaid.fetch_sub(lost, Ordering::Relaxed);
            }
            while let Some(overdue) = log.overdue()? {
                let removed = json!({ "first": overdue.first, "last": overdue.last, "hash": overdue.hash.to_string() });
                log.trim(&overdue, AuditEntry::own(AuditKind::TrailTrimmed, removed).text())?;
            }
            Ok(())
        });
        if let Err(error) = written.await.and_then(|written| written) {
            count(&self.refused);
            tracing::warn!(%error, waiting = self.waiting(), "the audit trail is not on disk; it is tried again");
        }
    }

    /// Brings what waits to the disk. Blocks.
    fn flush(&self) -> Result<(), Error> {
        let _turn = self.writing.lock();
        let mut waiting = self.waiting.lock();
        let all: Vec<String> = waiting.drain(..).collect();
        for some in all.chunks(AT_ONCE) {
            self.log.append(some)?;
        }
        Ok(())
    }
}

impl Room {
    /// Writes down what was found at the start, and looks after what waits for the disk.
    pub(crate) fn begin_audit(self: &Arc<Self>, found: &AuditFound) {
        let mut entries = vec![AuditEntry::own(
            AuditKind::TrailOpened,
            json!({
                "cut_bytes": found.cut_bytes,
                "unreadable_lines": found.unreadable,
                "missing_to": found.missing_to,
            }),
        )];
        if found.cut_bytes > 0 || found.unreadable > 0 || found.missing_to.is_some() {
            tracing::warn!(?found, "the audit trail is not as it was left");
        }
        entries.extend(found.begun.iter().filter_map(|text| AuditEntry::never_ended(text)));
        let room = Arc::clone(self);
        self.spawn(async move {
            room.audit.write(entries).await;
            let mut tick = every(AUDIT_RETRY);
            loop {
                tick.tick().await;
                let unlisted = room.audit.unlisted();
                let entries = unlisted.map(|n| AuditEntry::own(AuditKind::TrailUnlisted, json!({ "failures": n })));
                if entries.is_some() || room.audit.waiting() > 0 {
                    room.audit.write(entries.into_iter().collect()).await;
                }
            }
        });
    }

    /// Brings what waits to the disk, at the end.
    pub(crate) async fn end_audit(self: &Arc<Self>) {
        let room = Arc::clone(self);
        if let Err(error) = on_disk(move || room.audit.flush()).await.and_then(|end| end) {
            tracing::warn!(%error, "the last entries of the audit trail are not on disk");
        }
    }

    /// Does something that somebody asked for, in a task of its own, so that it has its end and its entry even where the asker
    /// leaves. The entry is on disk when this returns, where the disk takes it.
    pub(crate) async fn audited<T: Send + 'static>(
        self: &Arc<Self>,
        act: Act,
        work: impl Future<Output = (Result<T, Error>, Seen)> + Send + 'static,
    ) -> Result<T, Error> {
        let (room, asker, started) = (Arc::clone(self), Asker::current(), Instant::now());
        let done = tokio::spawn(asker.clone().asks(async move {
            let begun = room.note_begun(&act, &asker).await;
            let (end, seen) = work.await;
            let refused = end.as_ref().err();
            if refused.is_none() || room.audit.lists_failure() {
                let entry = act.ended(&asker, &seen, refused, started.elapsed());
                room.audit.write(vec![entry]).await;
            }
            drop(begun);
            end
        }));
        done.await
            .map_err(|error| Error::internal(format!("a change ended badly: {error}")))?
    }

    async fn note_begun(&self, act: &Act, asker: &Asker) -> Option<AuditBegun> {
        let (log, text) = (Arc::clone(&self.audit.log), act.begun(asker));
        on_disk(move || log.begin(&text)).await.ok().flatten()
    }

    /// Writes down what this host did of itself, or refused before it reached the cell.
    pub(crate) async fn audit_own(self: &Arc<Self>, act: Act, seen: Seen, refused: Option<&Error>) {
        if refused.is_none() || self.audit.lists_failure() {
            let entry = act.ended(&Asker::current(), &seen, refused, Duration::ZERO);
            self.audit.write(vec![entry]).await;
        }
    }
}

/// The wall clock, for people: RFC 3339 in UTC, to the millisecond.
pub(crate) fn now_text() -> String {
    humantime::format_rfc3339_millis(SystemTime::now()).to_string()
}

/// A value as JSON; null where it has no such form.
pub(crate) fn shown(value: &impl serde::Serialize) -> Value {
    serde_json::to_value(value).unwrap_or_default()
}
