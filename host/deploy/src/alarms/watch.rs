//! The look at records that passed: ten times a second, off the cycle's threads.
//!
//! Never: is woken by a record. A live receiver that nobody polls costs its sender a slot in a ring, and no wake-up.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use bumpless_core::{
    Event, LoopId, Quality, Record,
    alarms::{Board, Kind, Sight},
};
use tokio::sync::broadcast::{Receiver, error::TryRecvError};

use super::AlarmEvent;
use crate::{beat::every, plan::measured_port, room::Room};

/// Time between two looks: an operator cannot tell a tenth of a second from none.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Looks between two times at which everything that is dirty goes to the disk and the boards of deleted loops go.
const LOOKS_PER_SWEEP: u32 = 10;

/// The ports of one revision, as records have their readings.
struct Ports {
    revision: u64,
    names: Vec<String>,
    measured: Option<usize>,
}

impl Room {
    /// Reads the boards from the disk. Blocks.
    pub(crate) fn read_alarms(&self) -> Result<(), crate::error::Error> {
        self.alarms.number_on(self.store.last_alarm_change()?);
        let rows = self.store.alarm_boards::<Board>()?;
        let mut boards = self.alarms.boards.lock();
        for (name, board) in rows {
            if let Ok(id) = LoopId::new(&name) {
                boards.insert(id, board);
            }
        }
        Ok(())
    }

    /// Looks for as long as the room runs.
    pub(crate) async fn watch_alarms(room: Arc<Self>, mut records: Receiver<Arc<Record>>) {
        let mut tick = every(LOOK_EVERY);
        let mut ports: HashMap<LoopId, Ports> = HashMap::new();
        let mut looks = 0_u32;
        loop {
            tick.tick().await;
            let mut events = Vec::new();
            let mut changed = BTreeSet::new();
            loop {
                match records.try_recv() {
                    Ok(record) => {
                        let before = events.len();
                        room.look_at(&record, &mut ports, &mut events);
                        if events.len() > before {
                            changed.insert(record.loop_id.clone());
                        }
                    }
                    Err(TryRecvError::Lagged(missed)) => {
                        room.alarms.missed.fetch_add(missed, Ordering::Relaxed);
                    }
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Closed) => return,
                }
            }
            looks += 1;
            if looks.is_multiple_of(LOOKS_PER_SWEEP) {
                room.sweep_alarms(&mut ports).await;
            }
            if !events.is_empty()
                && let Err(error) = room.keep_alarms(changed.clone(), events).await
            {
                tracing::warn!(%error, "alarms were told, and are not on the disk yet");
                room.alarms.dirty.lock().extend(changed);
            }
        }
    }

    fn look_at(&self, record: &Record, known: &mut HashMap<LoopId, Ports>, events: &mut Vec<AlarmEvent>) {
        if self
            .book
            .get(&record.loop_id)
            .is_none_or(|intent| intent.home != self.here)
        {
            return;
        }
        let stale = |ports: &Ports| ports.revision != record.revision;
        if known.get(&record.loop_id).is_none_or(stale) {
            let Some(info) = self.library.get(&record.digest) else {
                return;
            };
            let measured = measured_port(&info.descriptor);
            let names: Vec<String> = info.descriptor.ports.iter().map(|port| port.name.clone()).collect();
            known.insert(
                record.loop_id.clone(),
                Ports {
                    revision: record.revision,
                    measured: names.iter().position(|name| Some(name.as_str()) == measured),
                    names,
                },
            );
        }
        let Some(of_loop) = known.get(&record.loop_id) else {
            return;
        };
        let mut ports = BTreeMap::new();
        for (number, (name, reading)) in of_loop.names.iter().zip(&record.readings).enumerate() {
            let seen = (
                reading.value.ok(),
                reading.value.is_ok() && reading.quality != Quality::Bad,
            );
            if of_loop.measured == Some(number) {
                ports.insert(String::new(), seen);
            }
            ports.insert(name.clone(), seen);
        }
        let so = what_is_so(record);
        let mut boards = self.alarms.boards.lock();
        let board = boards.entry(record.loop_id.clone()).or_default();
        let changes = board.see(Sight {
            at_ns: record.at_ns,
            setpoint: record.setpoint,
            ports: &ports,
            so: &so,
            raised: &record.alarms,
        });
        let happened = |change| self.happened(&record.loop_id, change);
        events.extend(changes.into_iter().map(happened));
    }

    /// Boards of deleted loops go, and what the disk refused before is tried again.
    async fn sweep_alarms(&self, ports: &mut HashMap<LoopId, Ports>) {
        let own = self.own_board();
        let at_home =
            |id: &LoopId| own.as_ref() == Some(id) || self.book.get(id).is_some_and(|intent| intent.home == self.here);
        let gone: Vec<LoopId> = {
            let mut boards = self.alarms.boards.lock();
            let gone = boards.keys().filter(|id| !at_home(id)).cloned().collect::<Vec<_>>();
            boards.retain(|id, _| at_home(id));
            gone
        };
        ports.retain(|id, _| at_home(id));
        for id in gone {
            let store = self.store.clone();
            let name = id.to_string();
            let end = crate::book::on_disk(move || store.remove_alarm_board(&name)).await;
            if let Err(error) = end.and_then(|end| end.map_err(Into::into)) {
                tracing::warn!(loop_id = %id, %error, "the alarms of a deleted loop are still on disk");
            }
        }
        let dirty = std::mem::take(&mut *self.alarms.dirty.lock());
        if !dirty.is_empty()
            && let Err(error) = self.keep_alarms(dirty.clone(), Vec::new()).await
        {
            tracing::warn!(%error, "alarms are not on the disk yet");
            self.alarms.dirty.lock().extend(dirty);
        }
    }
}

/// Which of the kinds that belong to a whole loop a record shows.
fn what_is_so(record: &Record) -> Vec<Kind> {
    let mut so = Vec::new();
    if record.faults_in_row > 0 {
        so.push(Kind::Fault);
    }
    // The words are the core's own: `Fault::Overrun`.
    let overran = |event: &Event| matches!(event, Event::Faulted { fault, .. } if fault.contains("ran past its limit"));
    if record.events.iter().any(overran) {
        so.push(Kind::Overrun);
    }
    if record.redundancy.want > 0 && !record.redundancy.whole() {
        so.push(Kind::RedundancyLost);
    }
    if record.events.iter().any(|event| matches!(event, Event::Dissent { .. })) {
        so.push(Kind::Dissent);
    }
    so
}

#[cfg(test)]
mod tests {
    use bumpless_core::Fault;

    #[test]
    fn an_overrun_is_known_by_its_words() {
        assert!(
            Fault::Overrun { limit_us: 5 }
                .to_string()
                .contains("ran past its limit")
        );
    }
}
