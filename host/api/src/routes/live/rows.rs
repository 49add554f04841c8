//! The feed in rows: what a page of many loops needs, on one connection, a few times a second.
//!
//! ```text
//! Last-Event-ID or after= ─► making up: notices and traced cycles since then
//!      └ none ─► the newest of every loop
//! beat (every_ms) ─► all records that passed meanwhile ─► newest of each loop, every one of the traced ─► one event `rows`
//!                 └► notices since the last one ─► `notices`; of alarms ─► `alarms`; each second `hosts`; when it changed
//!                    `loops`; points and jobs: `field`
//! ```
//! A reader that is slow is not polled, so nothing piles up for it but the bounded channel of records; what it lost is made good
//! by the newest record of each loop, and counted. Never: touches a cycle, or wakes for each record.

use std::{
    collections::{BTreeMap, HashMap, HashSet, VecDeque},
    sync::{Arc, PoisonError},
    time::{Duration, Instant},
};

use axum::response::sse::Event;
use bumpless_core::{LoopId, Record};
use bumpless_deploy::{Window, commissioning::FieldEvent};
use tokio::{
    sync::{
        OwnedSemaphorePermit,
        broadcast::{self, error::TryRecvError},
        watch,
    },
    time::{Interval, MissedTickBehavior},
};

use crate::{
    limits::{CATCH_UP_TIME_MAX, FIELD_NEWS_AT_ONCE, HOSTS_EVERY, NOTICES_AT_ONCE, STANDING_EVERY, TRACE_ROWS_MAX},
    server::App,
    types::{AlarmHappening, Hosts, LiveField, LiveRow, LiveRows, Standing},
};

/// Where a reader stopped: the process that it read from, the last notice, the newest cycle, the last happening of an alarm, as
/// `boot-number-time-alarm`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Mark {
    boot: u64,
    number: u64,
    at_unix_us: u64,
    alarm: u64,
}

impl Mark {
    /// From an event's id; none where the text is no id of ours.
    pub(super) fn parse(text: &str) -> Option<Self> {
        let mut parts = text.split('-').map(|part| part.parse().ok());
        let (boot, number, at_unix_us, alarm) = (parts.next()??, parts.next()??, parts.next()??, parts.next()??);
        parts.next().is_none().then_some(Self {
            boot,
            number,
            at_unix_us,
            alarm,
        })
    }

    fn id(self) -> String {
        format!("{}-{}-{}-{}", self.boot, self.number, self.at_unix_us, self.alarm)
    }
}

/// One reader.
pub(super) struct Rows {
    app: App,
    records: broadcast::Receiver<Arc<Record>>,
    news: broadcast::Receiver<FieldEvent>,
    stop: watch::Receiver<bool>,
    beat: Interval,
    loops: Option<HashSet<LoopId>>,
    traced: HashSet<LoopId>,
    /// Newest record of each loop that moved.
    newest: BTreeMap<LoopId, Arc<Record>>,
    trace: VecDeque<Arc<Record>>,
    /// Position and time (µs) of the last traced record that was queued, so that none comes twice.
    traced_to: HashMap<LoopId, ((u64, u64), u64)>,
    lost: u64,
    mark: Mark,
    hosts_at: Option<Instant>,
    standing: Option<Arc<str>>,
    ready: VecDeque<Event>,
    _place: OwnedSemaphorePermit,
}

/// What a reader asked for.
pub(super) struct Wanted {
    pub(super) loops: Option<HashSet<LoopId>>,
    pub(super) traced: HashSet<LoopId>,
    pub(super) every: Duration,
    pub(super) after: Option<Mark>,
}

impl Rows {
    /// A reader, with what it missed.
    pub(super) async fn open(app: App, wanted: Wanted, place: OwnedSemaphorePermit) -> Self {
        let mut beat = tokio::time::interval(wanted.every);
        beat.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let boot = app.notices.boot();
        let mut reader = Self {
            // From here on nothing is missed; what is made up for comes before.
            records: app.cell.records(),
            news: app.cell.field_events(),
            stop: app.stop.clone(),
            beat,
            loops: wanted.loops,
            traced: wanted.traced,
            newest: BTreeMap::new(),
            trace: VecDeque::new(),
            traced_to: HashMap::new(),
            lost: 0,
            mark: Mark {
                boot,
                number: app.notices.number(),
                at_unix_us: 0,
                alarm: app.happenings.number(),
            },
            hosts_at: None,
            standing: None,
            ready: VecDeque::new(),
            app,
            _place: place,
        };
        reader.refill();
        if let Some(after) = wanted.after {
            reader.make_up(after).await;
        }
        reader
    }

    /// The newest record of every loop, as the cell remembers it.
    fn refill(&mut self) {
        for view in self.app.cell.loops() {
            if let Some(record) = view.last
                && self.wants(&record.loop_id)
            {
                self.take_newest(record);
            }
        }
    }

    fn wants(&self, id: &LoopId) -> bool {
        self.loops.as_ref().is_none_or(|loops| loops.contains(id))
    }

    fn take_newest(&mut self, record: Arc<Record>) {
        let old = self.newest.get(&record.loop_id).map(|held| held.position());
        if old.is_none_or(|old| old < record.position()) {
            self.newest.insert(record.loop_id.clone(), record);
        }
    }

    fn take_trace(&mut self, record: Arc<Record>) {
        let last = self.traced_to.entry(record.loop_id.clone()).or_default();
        if last.0 >= record.position() {
            return;
        }
        *last = (record.position(), record.at_ns / 1_000);
        if self.trace.len() >= TRACE_ROWS_MAX * self.traced.len().max(1) {
            self.trace.pop_front();
            self.lost += 1;
        }
        self.trace.push_back(record);
    }

    /// Notices and traced cycles since a reader stopped. What the loops' homes do not answer in time is left out: the reader
    /// sees the gap in the numbers of the cycles and may ask for the curve.
    async fn make_up(&mut self, after: Mark) {
        self.mark.number = if after.boot == self.mark.boot {
            after.number
        } else {
            let later = self.app.notices.later_than(after.at_unix_us, NOTICES_AT_ONCE);
            later
                .first()
                .map_or(self.mark.number, |first| first.number.saturating_sub(1))
        };
        self.mark.alarm = if after.boot == self.mark.boot {
            after.alarm
        } else {
            self.app.happenings.number_at(after.at_unix_us)
        };
        self.mark.at_unix_us = after.at_unix_us;
        let from_ns = after.at_unix_us.saturating_mul(1_000).saturating_add(1_000);
        let until = tokio::time::Instant::now() + CATCH_UP_TIME_MAX;
        for id in self.traced.clone() {
            let max = u32::try_from(TRACE_ROWS_MAX).unwrap_or(u32::MAX);
            let asked = self.app.cell.cycles(id, Window::Between(from_ns, u64::MAX), max);
            match tokio::time::timeout_at(until, asked).await {
                Ok(Ok(view)) => {
                    for record in view.records {
                        self.take_trace(Arc::new(record));
                    }
                }
                Ok(Err(error)) => tracing::debug!(%error, "a feed could not be made up for"),
                Err(_) => return,
            }
        }
    }

    /// The next event; none when the host stops.
    pub(super) async fn next(&mut self) -> Option<Event> {
        loop {
            if let Some(event) = self.ready.pop_front() {
                return Some(event);
            }
            tokio::select! {
                biased;
                _ = self.stop.wait_for(|stop| *stop) => return None,
                _ = self.beat.tick() => {}
            }
            if !self.drain() {
                return None;
            }
            self.say();
        }
    }

    /// Takes all records that passed; false when there will be no more.
    fn drain(&mut self) -> bool {
        loop {
            match self.records.try_recv() {
                Ok(record) if self.wants(&record.loop_id) => {
                    if self.traced.contains(&record.loop_id) {
                        self.take_trace(Arc::clone(&record));
                    }
                    self.take_newest(record);
                }
                Ok(_) => {}
                Err(TryRecvError::Empty) => return true,
                Err(TryRecvError::Lagged(missed)) => {
                    self.lost += missed;
                    // The last word of a slow loop may be among them.
                    self.refill();
                }
                Err(TryRecvError::Closed) => return false,
            }
        }
    }

    /// Puts what there is to say into events.
    fn say(&mut self) {
        if !self.newest.is_empty() || !self.trace.is_empty() || self.lost > 0 {
            let app = &self.app;
            let row = |record: Arc<Record>| LiveRow::new(&record, &app.ports(&record.digest));
            let rows = LiveRows {
                lost: std::mem::take(&mut self.lost),
                loops: std::mem::take(&mut self.newest).into_values().map(&row).collect(),
                trace: std::mem::take(&mut self.trace).into_iter().map(&row).collect(),
            };
            // Loops are not frozen at the same time: what is made up for begins behind the traced loop that is least far.
            let traced = self.traced_to.values().map(|(_, at_us)| *at_us).min();
            let told = traced.or_else(|| rows.loops.iter().map(|row| row.at_unix_us).max());
            self.mark.at_unix_us = self.mark.at_unix_us.max(told.unwrap_or_default());
            self.push("rows", Event::default().json_data(rows));
        }
        let notices = self.app.notices.since(self.mark.number, NOTICES_AT_ONCE);
        if let Some(last) = notices.last() {
            self.mark.number = last.number;
            let wanted: Vec<_> = notices
                .iter()
                .filter(|notice| {
                    let named = LoopId::new(&notice.loop_name);
                    self.loops.is_none() || named.is_ok_and(|id| self.wants(&id))
                })
                .collect();
            if !wanted.is_empty() {
                self.push("notices", Event::default().json_data(wanted));
            }
        }
        self.say_field();
        let (happened, last) = self.app.happenings.since(self.mark.alarm);
        self.mark.alarm = last;
        let of_ours = |event: &Arc<AlarmHappening>| {
            let named = LoopId::new(&event.loop_name);
            self.loops.is_none() || named.is_ok_and(|id| self.wants(&id))
        };
        let wanted: Vec<_> = happened.iter().filter(|event| of_ours(event)).collect();
        if !wanted.is_empty() {
            self.push("alarms", Event::default().json_data(wanted));
        }
        if self.hosts_at.is_none_or(|at| at.elapsed() >= HOSTS_EVERY) {
            self.hosts_at = Some(Instant::now());
            let standing = standing(&self.app);
            if self.standing.as_ref() != Some(&standing) {
                self.push("loops", Ok(Event::default().data(&*standing)));
                self.standing = Some(standing);
            }
            let hosts = Hosts {
                hosts: self.app.cell.hosts().into_iter().map(Into::into).collect(),
                next: None,
            };
            self.push("hosts", Event::default().json_data(hosts));
        }
    }

    /// What happened to points and jobs. Those of a pause are not made up for: whoever comes back reads them again.
    fn say_field(&mut self) {
        let (mut news, mut lost) = (Vec::new(), 0);
        loop {
            match self.news.try_recv() {
                Ok(event) if news.len() < FIELD_NEWS_AT_ONCE => news.push(event.into()),
                Ok(_) => lost += 1,
                Err(TryRecvError::Lagged(missed)) => lost += missed,
                Err(TryRecvError::Empty | TryRecvError::Closed) => break,
            }
        }
        if lost > 0 || !news.is_empty() {
            self.push("field", Event::default().json_data(LiveField { lost, news }));
        }
    }

    fn push(&mut self, name: &str, event: Result<Event, axum::Error>) {
        match event {
            Ok(event) => self.ready.push_back(event.event(name).id(self.mark.id())),
            // Plain data always serialises; if it ever does not, the feed goes on without it.
            Err(error) => tracing::warn!(%error, "an event of the live feed could not be written"),
        }
    }
}

/// Where all loops stand, as JSON; one answer serves all feeds for a second.
fn standing(app: &App) -> Arc<str> {
    let mut kept = app.standing.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((at, text)) = kept.as_ref()
        && at.elapsed() < STANDING_EVERY
    {
        return Arc::clone(text);
    }
    let mut loops: Vec<Standing> = app
        .cell
        .loops()
        .into_iter()
        .map(|view| Standing {
            loop_name: view.id.to_string(),
            revision: view.spec.revision,
            pending_revision: view.pending,
            members: view.members.iter().map(ToString::to_string).collect(),
            failures: view.failures.len() as u64,
            lost: view.tally.map(|tally| tally.lost),
            takeovers: view.tally.map(|tally| tally.takeovers),
        })
        .collect();
    loops.sort_by(|a, b| a.loop_name.cmp(&b.loop_name));
    // Strings and numbers always serialise.
    let text: Arc<str> = serde_json::to_string(&loops).unwrap_or_else(|_| "[]".to_owned()).into();
    *kept = Some((Instant::now(), Arc::clone(&text)));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_comes_back_as_it_was_and_others_are_none() {
        let mark = Mark {
            boot: 7,
            number: 8,
            at_unix_us: 9,
            alarm: 10,
        };
        assert_eq!(Mark::parse(&mark.id()), Some(mark));
        for bad in [
            "",
            "1",
            "1-2",
            "1-2-3",
            "1-2-3-4-5",
            "a-2-3-4",
            "1--3-4",
            "-1-2-3-4",
            "1-2-99999999999999999999999-4",
        ] {
            assert_eq!(Mark::parse(bad), None, "{bad}");
        }
    }
}
