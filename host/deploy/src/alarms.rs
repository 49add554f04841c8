//! Alarms of the loops at home here: looked at, kept, acted on, and listed for the whole cell.
//!
//! ```text
//! records ──► feed ──(looked through ten times a second)──► board of the loop ──► changes ──► disk, live listeners
//!                                                               ▲
//!                                         people: acknowledge, shelve, define …
//! ```
//! Owns: the boards (`core::alarms`) of the loops whose home this host is. Never: wakes up for a record, or makes whoever
//! passes one wait: the cycle's threads do not know that anybody looks.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use bumpless_core::{
    HostId, LoopId,
    alarms::{Board, Change, Definition, Flood, Kind, Shelf, Standing},
};
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::sync::broadcast;

use crate::{
    book::on_disk,
    error::Error,
    limits::{ALARM_EVENTS, ALARM_NUMBERS_SKIPPED},
    room::Room,
    wire::{AlarmAsk, Notice, Told},
};

mod load;
mod watch;

pub use load::{AlarmLoad, FrequentAlarm};

/// One alarm of the cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlarmView {
    /// The loop.
    pub loop_id: LoopId,
    /// Its home, which looks at it.
    pub host: HostId,
    /// Now, by that host's clock, in ns: times in `standing` are of the same clock.
    pub now_ns: u64,
    /// How it stands.
    pub standing: Standing,
}

/// Something happened to an alarm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlarmEvent {
    /// Its number at the home: greater than that of everything that it told before, also before it was started again.
    pub number: u64,
    /// The loop.
    pub loop_id: LoopId,
    /// Its home.
    pub host: HostId,
    /// What happened.
    pub change: Change,
}

/// Alarms of the cell.
#[derive(Debug, Clone, PartialEq)]
pub struct AlarmList {
    /// By priority, then time: the most urgent and newest first.
    pub alarms: Vec<AlarmView>,
    /// What operators were told of in the last ten minutes, by home.
    pub floods: BTreeMap<HostId, Flood>,
    /// Hosts that did not answer, and why.
    pub silent: Vec<(HostId, String)>,
}

/// What a person does with an alarm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum AlarmAct {
    /// Has seen it.
    Acknowledge {
        /// In words; may be empty.
        note: String,
    },
    /// Lets a latched one go back to normal.
    Reset,
    /// Keeps it quiet.
    Shelve {
        /// For so long, in s: 1 s to 12 h.
        seconds: f64,
        /// Why.
        reason: String,
    },
    /// Tells it again.
    Unshelve,
    /// Takes it out of service.
    TakeOut {
        /// Why.
        reason: String,
    },
    /// Puts it back.
    PutBack,
    /// Defines it, or changes its definition.
    Define(Box<Definition>),
    /// Removes it.
    Remove,
}

/// The boards of this host.
pub(crate) struct Alarms {
    pub(crate) boards: Mutex<BTreeMap<LoopId, Board>>,
    /// Loops whose boards the disk does not have as they are.
    pub(crate) dirty: Mutex<BTreeSet<LoopId>>,
    events: broadcast::Sender<Arc<AlarmEvent>>,
    /// The last number that was given.
    number: AtomicU64,
    /// Records that passed unseen because there were more than fit between two looks.
    pub(crate) missed: AtomicU64,
}

impl Default for Alarms {
    fn default() -> Self {
        Self {
            boards: Mutex::default(),
            dirty: Mutex::default(),
            events: broadcast::Sender::new(ALARM_EVENTS),
            number: AtomicU64::new(0),
            missed: AtomicU64::new(0),
        }
    }
}

impl Alarms {
    /// What happens from now on. A receiver that lags loses the oldest; the list says how things stand.
    pub(crate) fn subscribe(&self) -> broadcast::Receiver<Arc<AlarmEvent>> {
        self.events.subscribe()
    }

    /// Goes on behind what is on disk, and behind what was told and may not have come there.
    pub(crate) fn number_on(&self, last_on_disk: u64) {
        let next = last_on_disk.saturating_add(ALARM_NUMBERS_SKIPPED);
        self.number.fetch_max(next, Ordering::Relaxed);
    }

    /// The last number that was given.
    pub(crate) fn last_number(&self) -> u64 {
        self.number.load(Ordering::Relaxed)
    }

    fn next_number(&self) -> u64 {
        self.number.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Passes on what happened at another home.
    pub(crate) fn heard(&self, event: AlarmEvent) {
        // Nobody listening is no error.
        let _ = self.events.send(Arc::new(event));
    }
}

impl Room {
    /// Answers a question about the alarms of loops at home here.
    pub(crate) async fn alarms_here(&self, ask: AlarmAsk) -> Result<Told, Error> {
        match ask {
            AlarmAsk::List => {
                let now_ns = self.alarm_clock_ns();
                let boards = self.alarms.boards.lock();
                let mut flood = Flood {
                    comings: 0,
                    is_flood: false,
                };
                let mut alarms = Vec::new();
                for (loop_id, board) in boards.iter() {
                    flood.comings += board.flood(now_ns).comings;
                    alarms.extend(board.all().map(|standing| AlarmView {
                        loop_id: loop_id.clone(),
                        host: self.here.clone(),
                        now_ns,
                        standing: standing.clone(),
                    }));
                }
                flood.is_flood = flood.comings > bumpless_core::alarms::FLOOD_ALARMS;
                Ok(Told::Alarms(alarms, flood))
            }
            AlarmAsk::Show(loop_id, alarm) => {
                let boards = self.alarms.boards.lock();
                let standing = boards.get(&loop_id).and_then(|board| board.get(&alarm)).cloned();
                Ok(self.told(loop_id, standing))
            }
            AlarmAsk::Past(max) => {
                let store = self.store.clone();
                let past = on_disk(move || store.alarm_changes::<AlarmEvent>(max as usize)).await??;
                Ok(Told::AlarmPast(past))
            }
            AlarmAsk::Act {
                loop_id,
                alarm,
                act,
                by,
            } => {
                let changes = self.act(&loop_id, &alarm, act, &by)?;
                self.keep_alarms(BTreeSet::from([loop_id.clone()]), changes.clone())
                    .await?;
                let standing = {
                    let boards = self.alarms.boards.lock();
                    boards.get(&loop_id).and_then(|board| board.get(&alarm)).cloned()
                };
                Ok(self.told(loop_id, standing))
            }
        }
    }

    /// One alarm, or none, as an answer.
    fn told(&self, loop_id: LoopId, standing: Option<Standing>) -> Told {
        let view = standing.map(|standing| AlarmView {
            loop_id,
            host: self.here.clone(),
            now_ns: self.alarm_clock_ns(),
            standing,
        });
        let none = Flood {
            comings: 0,
            is_flood: false,
        };
        Told::Alarms(view.into_iter().collect(), none)
    }

    fn act(&self, loop_id: &LoopId, alarm: &str, act: AlarmAct, by: &str) -> Result<Vec<AlarmEvent>, Error> {
        let own = self.own_board().as_ref() == Some(loop_id);
        let intent = if own { None } else { Some(self.book.find(loop_id)?) };
        if intent.as_ref().is_some_and(|intent| intent.home != self.here) {
            return Err(Error::refused(
                format!("host {} is not the home of loop {loop_id}", self.here),
                "ask again",
            ));
        }
        if let AlarmAct::Define(definition) = &act
            && own
            && !matches!(definition.kind, Kind::Clock | Kind::Disk | Kind::Signature)
        {
            return Err(Error::invalid(
                format!("alarm {alarm:?}: {loop_id} is a host and no loop"),
                "a host has alarms of the kinds clock, disk and signature",
            ));
        }
        if let AlarmAct::Define(definition) = &act
            && let Some(port) = &definition.port
            && let Some(intent) = &intent
            && let Some(info) = self.library.get(&intent.current.digest)
            && info.descriptor.port(port).is_none()
        {
            let known: Vec<&str> = info.descriptor.ports.iter().map(|port| port.name.as_str()).collect();
            return Err(Error::invalid(
                format!("alarm {alarm:?}: the loop's component has no port {port:?}"),
                format!("use one of {}", known.join(", ")),
            ));
        }
        let now_ns = self.alarm_clock_ns();
        let mut boards = self.alarms.boards.lock();
        let board = boards.entry(loop_id.clone()).or_default();
        let change = match act {
            AlarmAct::Acknowledge { note } => board.acknowledge(alarm, by, &note, now_ns),
            AlarmAct::Reset => board.reset(alarm, by, now_ns),
            AlarmAct::Shelve { seconds, reason } => {
                let until_ns = now_ns.saturating_add((seconds.max(0.0) * 1e9) as u64);
                let by = by.to_owned();
                board.shelve(alarm, &Shelf { until_ns, by, reason }, now_ns)
            }
            AlarmAct::Unshelve => board.unshelve(alarm, by, now_ns),
            AlarmAct::TakeOut { reason } => board.service(alarm, Some(&reason), by, now_ns),
            AlarmAct::PutBack => board.service(alarm, None, by, now_ns),
            AlarmAct::Define(definition) => {
                if definition.name != alarm {
                    return Err(Error::invalid(
                        format!(
                            "the definition is of {:?}, and alarm {alarm:?} was named",
                            definition.name
                        ),
                        "give both the same name",
                    ));
                }
                board.define(*definition, by, now_ns)
            }
            AlarmAct::Remove => board.remove(alarm, by, now_ns),
        };
        let change = change.map_err(|error| match error {
            bumpless_core::alarms::AlarmError::Unknown(_) => Error::not_found(error.to_string(), ""),
            bumpless_core::alarms::AlarmError::State { .. } => Error::refused(error.to_string(), "look at it again"),
            other => Error::invalid(other.to_string(), ""),
        })?;
        Ok(vec![self.happened(loop_id, change)])
    }

    /// A change of an alarm here, with its number.
    pub(crate) fn happened(&self, loop_id: &LoopId, change: Change) -> AlarmEvent {
        AlarmEvent {
            number: self.alarms.next_number(),
            loop_id: loop_id.clone(),
            host: self.here.clone(),
            change,
        }
    }

    /// The clock that records of loops at home here are stamped with.
    pub(crate) fn alarm_clock_ns(&self) -> u64 {
        self.io.as_ref().map_or(self.clock, |io| io.clock()).now_ns()
    }

    /// Brings boards and what happened to the disk, and tells it.
    pub(crate) async fn keep_alarms(&self, loops: BTreeSet<LoopId>, events: Vec<AlarmEvent>) -> Result<(), Error> {
        for event in &events {
            self.announce(&Notice::Alarm(Box::new(event.clone())));
            self.alarms.heard(event.clone());
        }
        let boards: Vec<(String, Board)> = {
            let boards = self.alarms.boards.lock();
            loops
                .iter()
                .filter_map(|id| Some((id.to_string(), boards.get(id)?.clone())))
                .collect()
        };
        let store = self.store.clone();
        let numbered: Vec<(u64, AlarmEvent)> = events.into_iter().map(|event| (event.number, event)).collect();
        on_disk(move || store.keep_alarms(&boards, &numbered)).await??;
        Ok(())
    }
}
