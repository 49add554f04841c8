//! What this host answers when another, or it itself, asks.
//!
//! Never: forwards; a question for a loop's home that reaches another host is refused, and the asker looks again.

use std::{pin::Pin, sync::Arc};

use bumpless_core::HostId;

use crate::{
    bench::stopping,
    book::on_disk,
    error::Error,
    limits::RECORDS_ASKED,
    room::Room,
    wire::{Ask, Told},
};

/// An answer on its way. Boxed, because a question may lead to further questions, to this host too.
pub(crate) type Answer = Pin<Box<dyn Future<Output = Result<Told, Error>> + Send>>;

impl Room {
    /// Answers.
    pub(crate) fn answer(self: Arc<Self>, from: HostId, ask: Ask) -> Answer {
        Box::pin(async move {
            match ask {
                Ask::Apply(draft, expect) => self.apply_here(from, *draft, expect).await.map(Told::Applied),
                Ask::Amend(id, amend, expect) => self.amend_here(from, id, amend, expect).await.map(Told::Applied),
                Ask::Command(id, command) => self.command_here(&id, command).await.map(Told::Commanded),
                Ask::Delete(id, expect) => self.delete_here(id, expect).await.map(|()| Told::Done),
                Ask::Drain(order) => self.drain_here(order).await.map(Told::Drained),
                Ask::Health => Ok(Told::Health(self.health_here().await)),
                Ask::Move(id, to) => self.move_here(&id, &to).map(|()| Told::Done),
                Ask::Try(spec) => self.try_here(&from, *spec).await,
                Ask::Hold(intent, revision) => self.hold_here(&from, *intent, revision).await,
                Ask::Held { came, went, afresh } => {
                    let holds = self.homes.told(&from, came, &went, afresh);
                    self.poke();
                    Ok(Told::Holds(holds))
                }
                Ask::Find(points) => Ok(Told::Found(points.iter().map(|point| self.speaks_for(point)).collect())),
                Ask::Read(points) => Ok(self.read_here(&points)),
                Ask::Points(first) => Ok(self.points_here(first)),
                Ask::Bytes(digest) => {
                    let _place = self.sending.acquire().await.map_err(|_| stopping())?;
                    let store = self.store.clone();
                    let missing = || Error::not_found(format!("host {} does not have it", self.here), "");
                    on_disk(move || store.component(&digest))
                        .await??
                        .map(Told::Bytes)
                        .ok_or_else(missing)
                }
                Ask::Info(digest) => Ok(Told::Info(
                    self.library.get(&digest).map(|info| Box::new((*info).clone())),
                )),
                Ask::Stage(digest) => Ok(Told::Stage(self.stage_here(&digest))),
                Ask::Library => {
                    let (components, removals) = self.library.heads();
                    Ok(Told::Library(components, removals))
                }
                Ask::Intents => {
                    let (heads, gone) = self.book.heads();
                    Ok(Told::Intents(heads, gone))
                }
                Ask::Intent(id) => Ok(Told::Intent(
                    self.book.get(&id).map(|intent| Box::new((*intent).clone())),
                )),
                Ask::Cycles(id, window, max) => {
                    self.cycles_here(&id, window, max).await.map(Box::new).map(Told::Cycles)
                }
                Ask::Replay(id, window) => self.replay_here(id, window).await.map(Box::new).map(Told::Replayed),
                Ask::Backtest(id, trial, window) => {
                    let report = self.backtest_here(&from, id, *trial, window).await;
                    report.map(Box::new).map(Told::Tried)
                }
                Ask::Shadow(id, ask) => self.shadow_here(&from, id, ask).await,
                Ask::Alarm(ask) => self.alarms_here(ask).await,
                Ask::Trust => Ok(self.trust_told()),
                Ask::Webhooks => Ok(Told::Webhooks(self.webhooks.views())),
                Ask::AlarmLoad => self.alarm_load_here().await.map(Box::new).map(Told::AlarmLoad),
                Ask::Audit(ask) => self.audit_here(ask).await,
                Ask::History(ask) => self.history_here(*ask).await.map(Box::new).map(Told::History),
                Ask::Program(ask) => self.programs_here(&from, *ask).await.map(Box::new).map(Told::Program),
                Ask::Access => Ok(Told::Access(Box::new((*self.keyring.register()).clone()))),
                Ask::Rollout(ask) => self.rollout_here(ask).await,
                Ask::Field(ask) => self.field_here(*ask).await.map(Box::new).map(Told::Field),
                Ask::Records(ids) => {
                    let last = ids.iter().take(RECORDS_ASKED).filter_map(|id| self.feed.last(id));
                    Ok(Told::Records(last.map(|last| (*last.record).clone()).collect()))
                }
            }
        })
    }
}
