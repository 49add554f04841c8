//! What a run reaches of the cell: its points by way of its home, other components, all hosts.
//!
//! Never: blocks a thread of programs; what takes time is done on deployment's own runtime.

use std::{collections::BTreeMap, sync::Weak};

use bumpless_core::{Fault, LoopId, Message, NoData, Reading, Strategy};
use bumpless_engine::{Answer, Later, Question, Reply, Sight};
use bumpless_io::{PointIndex, WriteStamp};
use bumpless_programs::Reach;
use tokio::runtime::Handle;

use super::{ProgramAsk, ProgramTold, Spec};
use crate::{
    error::Error,
    limits::ANSWER_WAIT,
    room::Room,
    view::Call,
    wire::{Ask, Notice, Told},
};

/// The reach of one run.
pub(super) struct Arm {
    pub(super) room: Weak<Room>,
    pub(super) runtime: Handle,
    pub(super) spec: Spec,
    pub(super) term: u64,
    /// The granted points in order of their names, where they are served here.
    pub(super) points: Option<Vec<PointIndex>>,
}

fn gone() -> String {
    "the host stops".to_owned()
}

fn missing() -> Sight {
    Sight {
        reading: Reading::missing(NoData::CommsLost, 0.0, 0),
        age_ns: 0,
    }
}

impl Arm {
    /// Asks the program's home.
    async fn ask(&self, ask: ProgramAsk) -> Result<ProgramTold, Error> {
        let Some(room) = self.room.upgrade() else {
            return Err(Error::internal(gone()));
        };
        let home = self.spec.home.clone();
        let asked = self
            .runtime
            .spawn(async move { room.ask(&home, Ask::Program(Box::new(ask)), ANSWER_WAIT).await });
        match asked.await {
            Ok(Ok(Told::Program(told))) => Ok(*told),
            Ok(Ok(_)) => Err(Error::internal("a host gave an answer to another question")),
            Ok(Err(error)) => Err(error),
            Err(_) => Err(Error::internal(gone())),
        }
    }
}

impl Room {
    /// Writes a grant for whoever owns the program under this term. Never blocks.
    pub(super) fn program_write(
        &self,
        spec: &bumpless_core::ProgramSpec,
        from: &bumpless_core::HostId,
        term: u64,
        index: PointIndex,
        value: f64,
    ) -> Result<(), String> {
        let Some(io) = &self.io else { return Err(gone()) };
        let seq = {
            let mut desks = self.programs.desks.lock();
            let kept = desks
                .get_mut(&spec.id)
                .ok_or_else(|| "the program was removed".to_owned())?;
            if !kept.desk.fence.admits(from, term) {
                let fence = &kept.desk.fence;
                return Err(format!(
                    "host {} owns the program now, in ownership {}",
                    fence.owner, fence.term
                ));
            }
            kept.writes += 1;
            kept.writes
        };
        let loop_id = LoopId::new(spec.id.as_str()).map_err(|error| error.to_string())?;
        let stamp = WriteStamp { loop_id, term, seq };
        io.write(&[(index, value)], &stamp, io.clock().now_ns())
            .map_err(|error| error.to_string())
    }
}

impl Reach for Arm {
    fn read(&self, slot: usize) -> Answer<'_, Sight> {
        if let Some(points) = &self.points {
            let sight = self.room.upgrade().and_then(|room| {
                let io = room.io.as_ref()?;
                let now_ns = io.clock().now_ns();
                let reading = io.read_one(*points.get(slot)?, now_ns);
                Some(Sight {
                    reading,
                    age_ns: now_ns.saturating_sub(reading.at_ns),
                })
            });
            return Answer::Now(sight.unwrap_or_else(missing));
        }
        Answer::Later(Box::pin(async move {
            let slot = u32::try_from(slot).unwrap_or(u32::MAX);
            match self.ask(ProgramAsk::Read(self.spec.id.clone(), self.term, slot)).await {
                Ok(ProgramTold::Sight(reading, age_ns)) => Sight { reading, age_ns },
                _ => missing(),
            }
        }))
    }

    fn write(&self, slot: usize, value: f64) -> Answer<'_, Result<(), String>> {
        if let Some(points) = &self.points {
            let end = match (self.room.upgrade(), points.get(slot)) {
                (Some(room), Some(index)) => {
                    room.program_write(&self.spec, &room.here.clone(), self.term, *index, value)
                }
                _ => Err(gone()),
            };
            return Answer::Now(end);
        }
        Answer::Later(Box::pin(async move {
            let slot = u32::try_from(slot).unwrap_or(u32::MAX);
            let asked = self
                .ask(ProgramAsk::Write(self.spec.id.clone(), self.term, slot, value))
                .await;
            asked.map(|_| ()).map_err(|error| error.to_string())
        }))
    }

    fn publish(&self, message: Message) -> Result<(), String> {
        let room = self.room.upgrade().ok_or_else(gone)?;
        room.programs.runner.say(&message);
        room.announce(&Notice::Message(message));
        Ok(())
    }

    fn step(&self, question: Question) -> Later<'_, Result<Reply, Fault>> {
        let room = self.room.upgrade();
        Box::pin(async move {
            let room = room.ok_or_else(|| Fault::Failed(gone()))?;
            let map = |values: Vec<(String, f64)>| values.into_iter().collect::<BTreeMap<_, _>>();
            let call = Call {
                component: question.component,
                strategy: Strategy::Local,
                parameters: map(question.parameters),
                state: question.state,
                track: map(question.track),
                inputs: map(question.inputs),
                setpoint: question.setpoint,
                mode: question.mode,
                dt_ns: question.dt_ns,
                seq: 0,
            };
            let ended = self.runtime.spawn(async move { room.call(call).await }).await;
            let end = ended
                .map_err(|_| Fault::Failed(gone()))?
                .map_err(|error| Fault::Failed(error.to_string()))?;
            Ok(Reply {
                state: end.state,
                outputs: end.outputs.into_iter().collect(),
            })
        })
    }

    fn save(&self, data: Vec<u8>) -> Later<'_, Result<(), String>> {
        Box::pin(async move {
            let asked = self.ask(ProgramAsk::Save(self.spec.id.clone(), self.term, data)).await;
            asked.map(|_| ()).map_err(|error| error.to_string())
        })
    }
}
