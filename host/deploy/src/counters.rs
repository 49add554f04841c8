//! What a host counts, gathered when somebody asks.
//!
//! Never: counts; those who do the work do.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Instant,
};

use bumpless_core::program::Status;

use crate::{alarms::AlarmLoad, room::Room, view::Counters};

impl Room {
    /// What this host counts.
    pub(crate) fn counters(&self) -> Counters {
        let (now, hosts) = (Instant::now(), self.session.hosts().len());
        let get = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let log = self.cycles.as_ref().map(|cycles| cycles.counts()).unwrap_or_default();
        let kept = self
            .archive
            .as_ref()
            .map(|archive| archive.counts())
            .unwrap_or_default();
        let runs = self.programs.runner.views();
        let in_status = |statuses: &[Status]| runs.iter().filter(|run| statuses.contains(&run.status)).count() as u64;
        let mut counters = Counters {
            programs_home: self.programs.desks.lock().len() as u64,
            programs_running: in_status(&[Status::Running, Status::Paused]),
            programs_faulted: in_status(&[Status::Fault]),
            programs_copied: self.programs.copies.lock().len() as u64,
            hosts_alive: self
                .roster
                .all()
                .iter()
                .filter(|(_, seen)| seen.alive(now, hosts))
                .count() as u64,
            loops_known: self.book.len() as u64,
            loops_held: self.holder.len() as u64,
            loops_owned: u64::from(self.field.owned()),
            components: self.library.len() as u64,
            records: self.feed.count(),
            uploads: get(&self.tallies.uploads),
            uploads_refused: get(&self.tallies.uploads_refused),
            applies: get(&self.tallies.applies),
            applies_refused: get(&self.tallies.applies_refused),
            fetches: get(&self.tallies.fetches),
            fetches_failed: get(&self.tallies.fetches_failed),
            fetches_corrupt: get(&self.tallies.fetches_corrupt),
            prepares_failed: get(&self.tallies.prepares_failed),
            requests: get(&self.tallies.requests),
            malformed: get(&self.tallies.malformed),
            arrivals_dropped: get(&self.tallies.arrivals_dropped),
            cycles_recorded: log.written,
            cycles_unrecorded: log.dropped,
            cycle_log_damaged: log.damaged,
            cycle_log_bytes: log.bytes,
            audit_entries: self.audit.head().number,
            audit_bytes: self.audit.head().bytes,
            audit_waiting: self.audit.waiting() as u64,
            audit_refused: get(&self.audit.refused),
            audit_lost: get(&self.audit.lost),
            clock_offset_ms: self.self_watch.offset_ms(),
            disk_free_bytes: self.self_watch.free_bytes(),
            webhooks: self.webhooks.views(),
            history_taken: kept.taken,
            history_dropped: kept.dropped + kept.dropped_rows,
            history_damaged: kept.damaged,
            history_cut_bytes: kept.cut_bytes,
            history_bytes: kept.bytes,
            history_failing: kept.failing,
            ..Counters::default()
        };
        {
            let now_ns = self.alarm_clock_ns();
            let boards = self.alarms.boards.lock();
            let load = AlarmLoad::of(&[], boards.values().flat_map(bumpless_core::alarms::Board::all), now_ns);
            counters.alarms_standing = load.standing;
            counters.alarms_unacknowledged = load.unacknowledged;
            counters.alarms_stale = load.stale;
            counters.alarms_quiet = load.quiet;
            counters.alarms_recent = boards.values().map(|board| board.flood(now_ns).comings as u64).sum();
        }
        for intent in self.book.all().iter().filter(|intent| intent.home == self.here) {
            counters.loops_home += 1;
            if let Some(view) = self.field.home_view(&intent.loop_id) {
                counters.cycles_taken += view.tally.taken;
                counters.cycles_lost += view.tally.lost;
                counters.cycles_skipped += view.tally.skipped;
                counters.takeovers += view.tally.takeovers;
                counters.commits_refused += view.tally.refused;
            }
        }
        counters
    }
}
