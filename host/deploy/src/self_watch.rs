//! A host looks at itself: is its clock right, is there room on its disk? What is wrong stands as an alarm of `host.NAME`.
//!
//! ```text
//! vitals of others (their time) ──► how far they are ahead ──┐
//! own date beside own steady clock ──────────────────────────┼── every second ──► board of the host ──► told like all alarms
//! room on the disk, writes that it refused ──────────────────┘
//! ```
//! Owns: the host's own board. Never: decides anything by a date; what is told here is for people.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicI64, AtomicU64, Ordering},
    },
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use bumpless_cell::Vitals;
use bumpless_core::{
    HostId, LoopId,
    alarms::{Board, Kind, Sight},
};
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};

use crate::{
    alarms::AlarmEvent,
    beat::every,
    book::on_disk,
    limits::{SELF_LOOK_EVERY, SELF_REFUSED_FOR},
    room::Room,
};

/// What the name of a host's own board begins with. No loop may be named so.
pub(crate) const HOST_BOARD: &str = "host.";

/// How long the greatest of what was seen of another clock counts, twice: vitals are late at times, and never early.
const WINDOW: Duration = Duration::from_secs(5);

/// From when on a host's clock and disk are alarms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HostAlarms {
    /// The clock: so far off, in ms; 10 to 3,600,000.
    pub clock_offset_max_ms: u64,
    /// The disk: less room than this, in MiB; 1 to 1,048,576.
    pub disk_free_min_mib: u64,
}

impl Default for HostAlarms {
    fn default() -> Self {
        // A second is what people compare logs by; half a gigabyte is days of records, and time to act.
        Self {
            clock_offset_max_ms: 1_000,
            disk_free_min_mib: 512,
        }
    }
}

/// How far another clock is ahead of this one, in ms: the greatest seen lately.
#[derive(Debug, Clone, Copy)]
struct Ahead {
    since: Instant,
    now_ms: i64,
    before_ms: i64,
}

/// What a host knows of itself.
#[derive(Debug)]
pub(crate) struct SelfWatch {
    limits: HostAlarms,
    clocks: Mutex<BTreeMap<HostId, Ahead>>,
    /// Writes that the disk refused as of the last look, and when that last grew.
    refused: Mutex<(u64, Option<Instant>)>,
    offset_ms: AtomicI64,
    free_bytes: AtomicU64,
}

impl SelfWatch {
    pub(crate) fn new(limits: HostAlarms) -> Self {
        Self {
            limits,
            clocks: Mutex::default(),
            refused: Mutex::default(),
            offset_ms: AtomicI64::new(0),
            free_bytes: AtomicU64::new(u64::MAX),
        }
    }

    /// Another host's time came with its vitals.
    pub(crate) fn heard(&self, vitals: &Vitals, own_unix_ms: u64) {
        let apart = i64::try_from(vitals.unix_ms).unwrap_or(i64::MAX) - i64::try_from(own_unix_ms).unwrap_or(i64::MAX);
        let now = Instant::now();
        let mut clocks = self.clocks.lock();
        // Those that went say nothing any more.
        clocks.retain(|_, ahead| ahead.since.elapsed() < WINDOW * 4);
        let ahead = clocks.entry(vitals.host.clone()).or_insert(Ahead {
            since: now,
            now_ms: apart,
            before_ms: apart,
        });
        if ahead.since.elapsed() >= WINDOW {
            *ahead = Ahead {
                since: now,
                now_ms: apart,
                before_ms: ahead.now_ms,
            };
        }
        ahead.now_ms = ahead.now_ms.max(apart);
    }

    /// How far this host's clock is behind the middle one of the others, in ms; none where there is no other.
    fn behind_others_ms(&self) -> Option<i64> {
        let clocks = self.clocks.lock();
        let mut ahead: Vec<i64> = clocks.values().map(|ahead| ahead.now_ms.max(ahead.before_ms)).collect();
        ahead.sort_unstable();
        // Of two in the middle the smaller distance: two hosts that agree with nobody else are not both wrong.
        match (ahead.get((ahead.len().max(1) - 1) / 2), ahead.get(ahead.len() / 2)) {
            (Some(low), Some(high)) => Some(if low.abs() <= high.abs() { *low } else { *high }),
            _ => None,
        }
    }

    /// How far the clock is off, in ms, where one of the two comparisons says more.
    pub(crate) fn offset_ms(&self) -> i64 {
        self.offset_ms.load(Ordering::Relaxed)
    }

    /// Room on the disk, in bytes; none before the first look.
    pub(crate) fn free_bytes(&self) -> Option<u64> {
        Some(self.free_bytes.load(Ordering::Relaxed)).filter(|bytes| *bytes != u64::MAX)
    }

    /// Did the disk refuse anything lately?
    fn refuses(&self, refused: u64) -> bool {
        let mut seen = self.refused.lock();
        if refused > seen.0 {
            *seen = (refused, Some(Instant::now()));
        }
        seen.1.is_some_and(|at| at.elapsed() < SELF_REFUSED_FOR)
    }
}

/// The host whose own board this is.
pub(crate) fn host_of_board(id: &LoopId) -> Option<HostId> {
    HostId::new(id.as_str().strip_prefix(HOST_BOARD)?).ok()
}

impl Room {
    /// The name of this host's own board; none where the host's name is too long for one.
    pub(crate) fn own_board(&self) -> Option<LoopId> {
        LoopId::new(format!("{HOST_BOARD}{}", self.here)).ok()
    }

    /// Looks for as long as the room runs.
    pub(crate) async fn watch_self(room: Arc<Self>) {
        let Some(id) = room.own_board() else {
            tracing::warn!(host = %room.here, "the host's name is too long for alarms of its clock and disk");
            return;
        };
        room.alarms
            .boards
            .lock()
            .entry(id.clone())
            .or_insert_with(Board::of_host)
            .complete(Board::of_host());
        let mut tick = every(SELF_LOOK_EVERY);
        loop {
            tick.tick().await;
            room.look_at_self(&id).await;
        }
    }

    async fn look_at_self(&self, id: &LoopId) {
        let limits = self.self_watch.limits;
        let date = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default()
            .as_millis();
        let own = i64::try_from(date).unwrap_or(i64::MAX) - i64::try_from(self.clock.unix_ms()).unwrap_or(i64::MAX);
        let others = self.self_watch.behind_others_ms().unwrap_or(0);
        let offset = if others.abs() > own.abs() { others } else { own };
        self.self_watch.offset_ms.store(offset, Ordering::Relaxed);
        let mut so = Vec::new();
        if offset.unsigned_abs() > limits.clock_offset_max_ms {
            so.push(Kind::Clock);
        }
        let dir = self.store.directory().to_owned();
        // A disk that does not even say how full it is refuses.
        let free =
            on_disk(move || rustix::fs::statvfs(&dir).map(|disk| disk.f_bavail.saturating_mul(disk.f_frsize))).await;
        let free = free.ok().and_then(Result::ok);
        self.self_watch.free_bytes.store(free.unwrap_or(0), Ordering::Relaxed);
        let full = free.is_none_or(|free| free < limits.disk_free_min_mib << 20);
        if full || self.self_watch.refuses(self.writes_refused()) {
            so.push(Kind::Disk);
        }
        if !self.wanting().is_empty() {
            so.push(Kind::Signature);
        }
        let events: Vec<AlarmEvent> = {
            let mut boards = self.alarms.boards.lock();
            let board = boards.entry(id.clone()).or_insert_with(Board::of_host);
            let changes = board.see(Sight {
                at_ns: self.alarm_clock_ns(),
                setpoint: 0.0,
                ports: &BTreeMap::new(),
                so: &so,
                raised: &[],
            });
            changes.into_iter().map(|change| self.happened(id, change)).collect()
        };
        if !events.is_empty()
            && let Err(error) = self.keep_alarms([id.clone()].into(), events).await
        {
            tracing::warn!(%error, "alarms were told, and are not on the disk yet");
            self.alarms.dirty.lock().insert(id.clone());
        }
    }

    /// Writes that the disk refused since the start: of last records, recorded cycles, and the audit trail.
    fn writes_refused(&self) -> u64 {
        let cycles = self.cycles.as_ref().map_or(0, |cycles| cycles.counts().failed_writes);
        self.feed.failed_writes() + cycles + self.audit.refused.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;
    use crate::roster::test_vitals;

    fn vitals(host: &str, unix_ms: u64) -> Vitals {
        Vitals {
            unix_ms,
            ..test_vitals(&HostId::new(host).unwrap())
        }
    }

    #[test]
    fn a_clock_is_off_where_most_others_say_so_and_late_news_says_nothing() {
        let watch = SelfWatch::new(HostAlarms::default());
        assert_eq!(watch.behind_others_ms(), None);
        for (host, ahead) in [("a", 5_000), ("b", 5_010), ("c", 0)] {
            watch.heard(&vitals(host, 100_000 + ahead), 100_000);
        }
        assert_eq!(watch.behind_others_ms(), Some(5_000), "two of three");
        // Vitals that waited on their way are old, not slow.
        watch.heard(&vitals("a", 80_000), 100_000);
        assert_eq!(watch.behind_others_ms(), Some(5_000));
        let one = SelfWatch::new(HostAlarms::default());
        one.heard(&vitals("a", 97_000), 100_000);
        assert_eq!(one.behind_others_ms(), Some(-3_000));
        one.heard(&vitals("b", 100_002), 100_000);
        assert_eq!(one.behind_others_ms(), Some(2), "one of two agrees");
    }

    #[test]
    fn a_disk_that_refused_is_remembered_for_a_while() {
        let watch = SelfWatch::new(HostAlarms::default());
        assert!(!watch.refuses(0));
        assert!(watch.refuses(1) && watch.refuses(1));
    }

    #[test]
    fn a_board_is_of_a_host_by_its_name() {
        let of = |name: &str| host_of_board(&LoopId::new(name).unwrap()).map(|host| host.to_string());
        assert_eq!(of("host.plant.west").as_deref(), Some("plant.west"));
        assert_eq!((of("hosts"), of("pressure")), (None, None));
    }
}
