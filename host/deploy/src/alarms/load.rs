//! How many alarms operators had: the figures by which ANSI/ISA-18.2 (16.4) judges an alarm system.
//!
//! | figure | what the standard calls acceptable |
//! |---|---|
//! | alarms in ten minutes, mean | 1, and 2 at most |
//! | the most in any ten minutes | 10 |
//! | part of the ten-minute spans that are floods | 1 % |
//! | the ten most frequent, part of all | 1 % to 5 % |
//! | chattering (three comings within a minute), stale (stands for more than a day) | none |
//!
//! Never: counts what was kept quiet; an operator did not have it.

use std::collections::BTreeMap;

use bumpless_core::{
    LoopId,
    alarms::{Board, FLOOD_ALARMS, FLOOD_WINDOW_NS, Standing, What},
};
use serde::{Deserialize, Serialize};

use super::AlarmEvent;
use crate::{book::on_disk, error::Error, limits::ALARM_LOAD_EVENTS_MAX, room::Room};

/// Spans of ten minutes in a day.
const SPANS: usize = 144;

/// Comings within this time that are chatter, in ns, and how many. Source: ANSI/ISA-18.2-2016, 16.5.3.
const CHATTER: (u64, usize) = (60_000_000_000, 3);

/// An alarm that stands for longer is stale, in ns.
pub(super) const STALE_NS: u64 = 86_400_000_000_000;

/// One alarm and how often it came.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrequentAlarm {
    /// The loop.
    pub loop_id: LoopId,
    /// The alarm.
    pub alarm: String,
    /// Comings in the last day.
    pub comings: u64,
    /// Did it come three times within a minute?
    pub chattered: bool,
}

/// How many alarms operators had in the last day, of the loops at home at one host, or of all.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct AlarmLoad {
    /// Comings in each span of ten minutes, the one that runs now last.
    pub spans: Vec<u64>,
    /// Alarms that stand.
    pub standing: u64,
    /// Alarms that wait for an acknowledgement.
    pub unacknowledged: u64,
    /// Alarms that stand for more than a day.
    pub stale: u64,
    /// Shelved, suppressed, or out of service.
    pub quiet: u64,
    /// Comings by priority: low, medium, high.
    pub by_priority: [u64; 3],
    /// Alarms that came, the most frequent first, at most a hundred.
    pub frequent: Vec<FrequentAlarm>,
    /// Were there more than could be looked at? The figures are then too small.
    pub cut: bool,
}

impl AlarmLoad {
    /// Of what happened and what stands at `now_ns`.
    pub(crate) fn of<'a>(events: &[AlarmEvent], standing: impl Iterator<Item = &'a Standing>, now_ns: u64) -> Self {
        let mut load = Self {
            spans: vec![0; SPANS],
            ..Self::default()
        };
        let mut times: BTreeMap<(LoopId, String), Vec<u64>> = BTreeMap::new();
        let span_now = now_ns / FLOOD_WINDOW_NS;
        for event in events {
            let change = &event.change;
            let age = span_now.saturating_sub(change.at_ns / FLOOD_WINDOW_NS);
            let slot = usize::try_from(age).ok().and_then(|age| (SPANS - 1).checked_sub(age));
            let (Some(slot), What::Came, false) = (slot, change.what, change.quiet) else {
                continue;
            };
            if let Some(span) = load.spans.get_mut(slot) {
                *span += 1;
            }
            if let Some(count) = load.by_priority.get_mut(change.priority as usize) {
                *count += 1;
            }
            let key = (event.loop_id.clone(), change.alarm.clone());
            times.entry(key).or_default().push(change.at_ns);
        }
        for standing in standing {
            let quiet = standing.is_quiet();
            load.quiet += u64::from(quiet);
            if quiet {
                continue;
            }
            load.standing += u64::from(standing.state.stands());
            load.unacknowledged += u64::from(standing.state.waits_for_ack());
            let stale = standing.state.stands() && now_ns.saturating_sub(standing.since_ns) > STALE_NS;
            load.stale += u64::from(stale);
        }
        load.frequent = times
            .into_iter()
            .map(|((loop_id, alarm), mut times)| {
                times.sort_unstable();
                let close = |few: &[u64]| matches!(few, [first, .., last] if last - first <= CHATTER.0);
                FrequentAlarm {
                    loop_id,
                    alarm,
                    comings: times.len() as u64,
                    chattered: times.windows(CHATTER.1).any(close),
                }
            })
            .collect();
        load.settle();
        load
    }

    /// Joins the figures of another home.
    pub(crate) fn join(&mut self, other: &Self) {
        self.spans.resize(SPANS, 0);
        for (span, more) in self.spans.iter_mut().zip(&other.spans) {
            *span += more;
        }
        for (count, more) in self.by_priority.iter_mut().zip(&other.by_priority) {
            *count += more;
        }
        self.standing += other.standing;
        self.unacknowledged += other.unacknowledged;
        self.stale += other.stale;
        self.quiet += other.quiet;
        self.cut |= other.cut;
        self.frequent.extend(other.frequent.iter().cloned());
        self.settle();
    }

    fn settle(&mut self) {
        self.frequent.sort_by(|a, b| {
            b.comings
                .cmp(&a.comings)
                .then_with(|| (&a.loop_id, &a.alarm).cmp(&(&b.loop_id, &b.alarm)))
        });
        // Those that chattered are told whatever their rank.
        let mut rank = 0;
        self.frequent.retain(|alarm| {
            rank += 1;
            rank <= 10 || alarm.chattered
        });
        self.frequent.truncate(100);
    }

    /// Comings in the day.
    #[must_use]
    pub fn comings(&self) -> u64 {
        self.spans.iter().sum()
    }

    /// Spans that were floods.
    #[must_use]
    pub fn floods(&self) -> u64 {
        self.spans.iter().filter(|span| **span > FLOOD_ALARMS as u64).count() as u64
    }
}

impl Room {
    /// The figures of the loops at home here.
    pub(crate) async fn alarm_load_here(&self) -> Result<AlarmLoad, Error> {
        let store = self.store.clone();
        let events = on_disk(move || store.alarm_changes::<AlarmEvent>(ALARM_LOAD_EVENTS_MAX)).await??;
        let now_ns = self.alarm_clock_ns();
        let boards = self.alarms.boards.lock();
        let mut load = AlarmLoad::of(&events, boards.values().flat_map(Board::all), now_ns);
        let oldest_ns = events.last().map_or(0, |event| event.change.at_ns);
        load.cut = events.len() >= ALARM_LOAD_EVENTS_MAX && now_ns.saturating_sub(oldest_ns) < STALE_NS;
        Ok(load)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use bumpless_core::{
        HostId, Priority,
        alarms::{Change, Kind, Sight, State},
    };

    use super::*;

    const MINUTE: u64 = 60_000_000_000;
    const DAY: u64 = 1_440 * MINUTE;

    fn came(alarm: &str, at_ns: u64) -> AlarmEvent {
        AlarmEvent {
            number: at_ns,
            loop_id: LoopId::new("l").unwrap(),
            host: HostId::new("h").unwrap(),
            change: Change {
                at_ns,
                alarm: alarm.to_owned(),
                what: What::Came,
                state: State::Active,
                priority: Priority::High,
                value: None,
                by: None,
                note: String::new(),
                quiet: false,
                first_out: false,
            },
        }
    }

    #[test]
    fn figures_are_those_of_the_last_day() {
        let now = 100 * DAY;
        let mut events = vec![came("old", now - DAY - 11 * MINUTE)];
        events.extend((0..12).map(|n| came("chatter", now - 25 * MINUTE + n * MINUTE / 4)));
        events.extend((0..3).map(|n| came("slow", now - (n + 1) * 100 * MINUTE)));
        events.push(AlarmEvent {
            change: Change {
                quiet: true,
                ..came("slow", now).change
            },
            ..came("slow", now)
        });
        let load = AlarmLoad::of(&events, std::iter::empty(), now);
        assert_eq!((load.comings(), load.floods(), load.spans.len()), (15, 1, SPANS));
        assert_eq!(load.spans.iter().max(), Some(&12));
        let told: Vec<(&str, u64, bool)> = load
            .frequent
            .iter()
            .map(|f| (f.alarm.as_str(), f.comings, f.chattered))
            .collect();
        assert_eq!(told, [("chatter", 12, true), ("slow", 3, false)]);
        assert_eq!(load.by_priority, [0, 0, 15]);
        let mut both = load.clone();
        both.join(&load);
        assert_eq!((both.comings(), both.spans.iter().max()), (30, Some(&24)));
    }

    #[test]
    fn what_stands_for_a_day_is_stale_and_what_is_quiet_is_nobodys() {
        let mut board = Board::of_host();
        let ports = BTreeMap::new();
        let look = |at_ns, so: &'static [Kind]| Sight {
            at_ns,
            setpoint: 0.0,
            ports: &ports,
            so,
            raised: &[],
        };
        board.see(look(MINUTE, &[Kind::Disk, Kind::Clock]));
        let load = |board: &Board, now| AlarmLoad::of(&[], board.all(), now);
        let now = load(&board, 2 * MINUTE);
        assert_eq!((now.standing, now.unacknowledged, now.stale), (2, 2, 0));
        board.acknowledge("disk", "ann", "", 3 * MINUTE).unwrap();
        board.service("clock", Some("known"), "ann", 3 * MINUTE).unwrap();
        let later = load(&board, 2 * DAY);
        assert_eq!(
            (later.standing, later.unacknowledged, later.stale, later.quiet),
            (1, 0, 1, 1)
        );
    }
}
