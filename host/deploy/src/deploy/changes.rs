//! The facade's part that changes things: loops, components, hosts. Each change has its entry in the audit trail.
//!
//! Never: decides; the home or the host does.

use std::{collections::HashSet, time::Duration};

use bumpless_core::{Command, CommandBody, CommandId, ComponentInfo, Digest, HostId, LoopId};
use futures_util::future::join_all;
use serde_json::{Value, json};

use super::{Deploy, unexpected};
use crate::{
    audit::{Act, AuditKind, Seen, component, shown},
    draft::{Change, LoopDraft},
    error::Error,
    expect::Expect,
    library::title,
    limits::{ANSWER_MARGIN, ANSWER_WAIT, APPLY_WAIT, DRAIN_ORDER_WAIT},
    orders::command_wait,
    plan,
    view::{ApplyEnd, CommandEnd, DrainEnd, DrainOrder, Imported, Relabel, Upload},
    wire::{Amend, Ask, Told},
};

/// A draft's loop, where its name can be one.
fn of_draft(draft: &LoopDraft) -> Act {
    let asked = shown(draft);
    match LoopId::new(&draft.name) {
        Ok(id) => Act::on_loop(AuditKind::LoopApply, &id, asked),
        Err(_) => Act::new(AuditKind::LoopApply, &draft.name, asked),
    }
}

impl Deploy {
    /// Takes a component in without labels or force; see [`Deploy::take_in`].
    ///
    /// # Errors
    /// As [`Deploy::take_in`].
    pub async fn upload(&self, bytes: Vec<u8>, by: &str, note: &str) -> Result<ComponentInfo, Error> {
        let upload = Upload {
            by: by.to_owned(),
            note: note.to_owned(),
            ..Upload::default()
        };
        self.take_in(bytes, &upload).await
    }

    /// Takes a component in: inspects, compiles, tries, keeps and announces it. The same bytes again change nothing.
    ///
    /// # Errors
    /// [`Error::Invalid`] for what is no controller, for what fails its trial, and for words and labels that cannot be;
    /// [`Error::Refused`] for another component of this name and version; [`Error::Busy`] when too many are being uploaded
    /// or the library is full; [`Error::Store`]. Then nothing of it stays.
    pub async fn take_in(&self, bytes: Vec<u8>, upload: &Upload) -> Result<ComponentInfo, Error> {
        let asked =
            json!({ "bytes": bytes.len(), "labels": upload.labels, "note": upload.note, "force": upload.force });
        let act = Act::new(AuditKind::ComponentUpload, "", asked).by(named(&upload.by));
        let (room, upload) = (self.room.clone(), upload.clone());
        let known: HashSet<Digest> = room.library.all().iter().map(|info| info.digest).collect();
        let work = async move {
            let end = room.upload(bytes, &upload).await;
            let seen = end.as_ref().map_or_else(
                |_| Seen::default(),
                |info| Seen {
                    target: Some(title(info)),
                    ..match known.contains(&info.digest) {
                        true => Seen::default(),
                        false => Seen::of(Value::Null, component(info)),
                    }
                },
            );
            (end.map(|info| (*info).clone()), seen)
        };
        self.room.audited(act, work).await
    }

    /// Changes labels and note of a component, on every host.
    ///
    /// # Errors
    /// [`Error::NotFound`] for the component or a label to remove, [`Error::Invalid`], [`Error::Store`].
    pub async fn relabel(&self, reference: &str, change: &Relabel) -> Result<ComponentInfo, Error> {
        let asked = json!({ "labels": change.labels, "note": change.note });
        let act = Act::new(AuditKind::ComponentRelabel, reference, asked).by(named(&change.by));
        let (room, reference, change) = (self.room.clone(), reference.to_owned(), change.clone());
        let work = async move {
            let before = room.library.resolve(&reference).ok().map(|info| component(&info));
            let end = room.relabel(&reference, &change).await;
            let seen = end.as_ref().map_or_else(
                |_| Seen::default(),
                |info| Seen {
                    target: Some(title(info)),
                    ..Seen::of(before.unwrap_or_default(), component(info))
                },
            );
            (end.map(|info| (*info).clone()), seen)
        };
        self.room.audited(act, work).await
    }

    /// Takes in the components of such a file, each as by [`Deploy::take_in`]. One that is refused does not hold up the
    /// others.
    ///
    /// # Errors
    /// [`Error::Invalid`] where the file is no bundle.
    pub async fn import(&self, bytes: Vec<u8>, by: &str, force: bool) -> Result<Vec<Imported>, Error> {
        let asked = json!({ "bytes": bytes.len(), "force": force });
        let act = Act::new(AuditKind::ComponentImport, "", asked).by(named(by));
        let (room, by) = (self.room.clone(), by.to_owned());
        let work = async move {
            let end = room.import(bytes, &by, force).await;
            let one = |imported: &Imported| match (&imported.end, imported.known) {
                (Ok(info), false) => (imported.name.clone(), component(info)),
                (Ok(_), true) => (imported.name.clone(), json!("known already")),
                (Err(error), _) => (imported.name.clone(), json!({ "refused": error.to_string() })),
            };
            let after = end.iter().flatten().map(one).collect::<serde_json::Map<_, _>>();
            (end, Seen::of(Value::Null, after.into()))
        };
        self.room.audited(act, work).await
    }

    /// Removes a component from the library of the cell.
    ///
    /// # Errors
    /// [`Error::Refused`] while a loop runs it or can go back to it, [`Error::NotFound`], [`Error::Store`].
    pub async fn remove_component(&self, reference: &str) -> Result<(), Error> {
        let act = Act::new(AuditKind::ComponentRemove, reference, Value::Null);
        let (room, reference) = (self.room.clone(), reference.to_owned());
        let work = async move {
            let known = room.library.resolve(&reference).ok();
            let end = room.remove_component(&reference).await;
            let seen = match (&end, known) {
                (Ok(()), Some(info)) => Seen {
                    target: Some(title(&info)),
                    ..Seen::of(component(&info), Value::Null)
                },
                _ => Seen::default(),
            };
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// Creates or changes a loop. Returns when the change is in force, or when it is certain that it is not.
    ///
    /// # Errors
    /// [`Error::Invalid`], [`Error::NotFound`] for a component or point, [`Error::Refused`] by a host or by the running
    /// loop (for example because of the bump), [`Error::Busy`], [`Error::Unreachable`]. Then nothing has changed.
    /// [`Error::Timeout`] after 28 s without an answer: look at the loop.
    pub async fn apply(&self, draft: LoopDraft) -> Result<ApplyEnd, Error> {
        self.apply_if(draft, Expect::Anything).await
    }

    /// The same, where what the asker relies on is in force at that moment.
    ///
    /// # Errors
    /// As [`Deploy::apply`]; [`Error::Stale`] where it is not.
    pub async fn apply_if(&self, draft: LoopDraft, expect: Expect) -> Result<ApplyEnd, Error> {
        let (act, deploy) = (of_draft(&draft), self.clone());
        self.audited_change(act, async move { deploy.applied(draft, expect).await })
            .await
    }

    async fn applied(&self, mut draft: LoopDraft, expect: Expect) -> Result<ApplyEnd, Error> {
        let id = plan::loop_id(&draft.name)?;
        // By digest, for the home may not have heard of the component yet.
        draft.component = self.room.library.controller(&draft.component)?.digest.to_string();
        if let Some(fallback) = &mut draft.fallback {
            *fallback = self.room.library.controller(fallback)?.digest.to_string();
        }
        let home = match self.room.book.get(&id) {
            Some(intent) => intent.home.clone(),
            None => self.home_for(&draft).await?,
        };
        self.changed(&home, Ask::Apply(Box::new(draft), expect)).await
    }

    /// The one host that serves all points of a draft.
    async fn home_for(&self, draft: &LoopDraft) -> Result<HostId, Error> {
        let points: Vec<_> = plan::points(draft)?.into_iter().collect();
        if points.is_empty() {
            return Err(Error::invalid(
                "no port is connected to a point",
                "connect at least the required ports under [ports]",
            ));
        }
        let hosts = self.room.roster.with_io();
        let asked: Vec<_> = points.iter().map(|(_, point)| point.clone()).collect();
        let asked = &asked;
        let answers = join_all(
            hosts
                .iter()
                .map(|host| async move { self.room.ask(host, Ask::Find(asked.clone()), ANSWER_WAIT).await }),
        );
        let mut served: Vec<Option<&HostId>> = vec![None; points.len()];
        let mut silent = Vec::new();
        for (host, answer) in hosts.iter().zip(answers.await) {
            match answer {
                Ok(Told::Found(found)) => {
                    for (place, _) in served.iter_mut().zip(found).filter(|(_, found)| *found) {
                        *place = Some(host);
                    }
                }
                Ok(_) => return Err(unexpected()),
                Err(error) => silent.push(format!("{host}: {}", error.words().reason)),
            }
        }
        let mut homes: Vec<&HostId> = served.iter().flatten().copied().collect();
        homes.sort();
        homes.dedup();
        let place = |((port, point), host): (&(String, bumpless_core::PointId), &Option<&HostId>)| match host {
            Some(host) => format!("{port} = {point} at {host}"),
            None => format!("{port} = {point} at no host"),
        };
        let places = || points.iter().zip(&served).map(place).collect::<Vec<_>>().join(", ");
        if served.iter().any(Option::is_none) {
            let missing: Vec<_> = points
                .iter()
                .zip(&served)
                .filter(|(_, h)| h.is_none())
                .map(|((_, p), _)| p.to_string())
                .collect();
            return Err(if silent.is_empty() {
                let cure = if hosts.is_empty() {
                    "no I/O host is there; start it"
                } else {
                    "list the points for their names"
                };
                Error::not_found(format!("no host serves {}", missing.join(", ")), cure)
            } else {
                Error::unreachable(
                    format!(
                        "no host that answers serves {} ({})",
                        missing.join(", "),
                        silent.join("; ")
                    ),
                    "try again",
                )
            });
        }
        match homes.as_slice() {
            [home] => Ok((*home).clone()),
            _ => Err(Error::invalid(
                format!(
                    "the points of loop {} are served by different hosts: {}",
                    draft.name,
                    places()
                ),
                "all points of a loop must be served by one host",
            )),
        }
    }

    async fn changed(&self, home: &HostId, ask: Ask) -> Result<ApplyEnd, Error> {
        match self.room.ask(home, ask, APPLY_WAIT).await? {
            Told::Applied(end) => Ok(end),
            _ => Err(unexpected()),
        }
    }

    async fn amended(&self, id: &LoopId, amend: Amend, expect: Expect) -> Result<ApplyEnd, Error> {
        let home = self.room.book.home(id)?;
        self.changed(&home, Ask::Amend(id.clone(), amend, expect)).await
    }

    async fn done(&self, id: &LoopId, ask: Ask, wait: Duration) -> Result<(), Error> {
        let home = self.room.book.home(id)?;
        match self.room.ask(&home, ask, wait).await? {
            Told::Done => Ok(()),
            _ => Err(unexpected()),
        }
    }

    async fn audited_change(
        &self,
        act: Act,
        work: impl Future<Output = Result<ApplyEnd, Error>> + Send + 'static,
    ) -> Result<ApplyEnd, Error> {
        let room = self.room.clone();
        let work = async move {
            let end = work.await;
            let seen = room.revised(&end).await;
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// An operator's command. Returns when a committed record holds its outcome. The same `command_id` again gets the same
    /// outcome and does nothing twice, for as long as the loop remembers it (32 commands).
    ///
    /// # Errors
    /// [`Error::Refused`] by the loop, [`Error::Busy`] when too many wait, [`Error::Unreachable`] when the home is away,
    /// [`Error::Timeout`]: its text says whether the command was taken back.
    pub async fn command(
        &self,
        id: &LoopId,
        command_id: Option<CommandId>,
        body: CommandBody,
    ) -> Result<CommandEnd, Error> {
        let command = Command {
            id: command_id.unwrap_or_else(|| self.room.new_command_id()),
            body,
        };
        let mut asked = self.room.asked_of(id, &command.body);
        if let Some(members) = asked.as_object_mut() {
            members.insert("command".to_owned(), json!(format!("{:032x}", command.id.0)));
        }
        let kind = match command.body {
            CommandBody::Mode(_) => AuditKind::LoopMode,
            CommandBody::Output(_) => AuditKind::LoopOutput,
            CommandBody::Setpoint(_) | CommandBody::Revise(_) => AuditKind::LoopSetpoint,
        };
        let (deploy, id) = (self.clone(), id.clone());
        let act = Act::on_loop(kind, &id, asked);
        let work = async move {
            let before = deploy.room.stood(&id, &command.body);
            let end = deploy.commanded(&id, command.clone()).await;
            let seen = match &end {
                Ok(end) => Seen::of(before, deploy.room.stands(&id, &command.body, end)),
                Err(_) => Seen::default(),
            };
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    async fn commanded(&self, id: &LoopId, command: Command) -> Result<CommandEnd, Error> {
        let intent = self.room.book.find(id)?;
        let wait = command_wait(intent.current.period_ns) * 2 + ANSWER_MARGIN;
        let ask = Ask::Command(id.clone(), command);
        match self.room.ask(&intent.home, ask, wait).await? {
            Told::Commanded(end) => Ok(end),
            _ => Err(unexpected()),
        }
    }

    /// Goes on with another component. Parameters and ports that it does not have are left out and named in the end.
    ///
    /// # Errors
    /// As [`Deploy::apply`].
    pub async fn swap(&self, id: &LoopId, component: &str) -> Result<ApplyEnd, Error> {
        self.swap_if(id, component, Expect::Anything).await
    }

    /// The same, where what the asker relies on is in force at that moment.
    ///
    /// # Errors
    /// As [`Deploy::swap`]; [`Error::Stale`] where it is not.
    pub async fn swap_if(&self, id: &LoopId, component: &str, expect: Expect) -> Result<ApplyEnd, Error> {
        let act = Act::on_loop(AuditKind::LoopSwap, id, json!({ "component": component }));
        let (deploy, id, component) = (self.clone(), id.clone(), component.to_owned());
        let work = async move {
            let digest = deploy.room.library.controller(&component)?.digest;
            deploy.amended(&id, Amend::Swap(digest.to_string()), expect).await
        };
        self.audited_change(act, work).await
    }

    /// Goes on with other parameters or another strategy.
    ///
    /// # Errors
    /// As [`Deploy::apply`].
    pub async fn set(&self, id: &LoopId, change: Change) -> Result<ApplyEnd, Error> {
        self.set_if(id, change, Expect::Anything).await
    }

    /// The same, where what the asker relies on is in force at that moment.
    ///
    /// # Errors
    /// As [`Deploy::set`]; [`Error::Stale`] where it is not.
    pub async fn set_if(&self, id: &LoopId, change: Change, expect: Expect) -> Result<ApplyEnd, Error> {
        let act = Act::on_loop(AuditKind::LoopSet, id, shown(&change));
        let (deploy, id) = (self.clone(), id.clone());
        let work = async move { deploy.amended(&id, Amend::Set(change), expect).await };
        self.audited_change(act, work).await
    }

    /// Goes back to an earlier revision, under a new number; to the one before where none is named.
    ///
    /// # Errors
    /// As [`Deploy::apply`]; [`Error::NotFound`] where there is no such revision.
    pub async fn rollback(&self, id: &LoopId, revision: Option<u64>) -> Result<ApplyEnd, Error> {
        self.rollback_if(id, revision, Expect::Anything).await
    }

    /// The same, where what the asker relies on is in force at that moment.
    ///
    /// # Errors
    /// As [`Deploy::rollback`]; [`Error::Stale`] where it is not.
    pub async fn rollback_if(&self, id: &LoopId, revision: Option<u64>, expect: Expect) -> Result<ApplyEnd, Error> {
        let act = Act::on_loop(AuditKind::LoopRollback, id, json!({ "revision": revision }));
        let (deploy, id) = (self.clone(), id.clone());
        let work = async move { deploy.amended(&id, Amend::Rollback(revision), expect).await };
        self.audited_change(act, work).await
    }

    /// Ends a loop. Its outputs stay as they are.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Busy`] while it is changed, [`Error::Unreachable`], [`Error::Store`].
    pub async fn delete(&self, id: &LoopId) -> Result<(), Error> {
        self.delete_if(id, Expect::Anything).await
    }

    /// The same, where what the asker relies on is in force at that moment.
    ///
    /// # Errors
    /// As [`Deploy::delete`]; [`Error::Stale`] where it is not.
    pub async fn delete_if(&self, id: &LoopId, expect: Expect) -> Result<(), Error> {
        let act = Act::on_loop(AuditKind::LoopDelete, id, Value::Null);
        let (deploy, id) = (self.clone(), id.clone());
        let work = async move {
            let before = deploy
                .room
                .book
                .get(&id)
                .map(|intent| deploy.room.shown_spec(&intent.current));
            let end = deploy.done(&id, Ask::Delete(id.clone(), expect), APPLY_WAIT).await;
            let seen = match (&end, before) {
                (Ok(()), Some(before)) => Seen::of(before, Value::Null),
                _ => Seen::default(),
            };
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// Gives the ownership to another member, between two cycles.
    ///
    /// # Errors
    /// [`Error::Refused`] where that host is no member that is ready, [`Error::NotFound`], [`Error::Unreachable`].
    pub async fn move_owner(&self, id: &LoopId, to: &HostId) -> Result<(), Error> {
        let act = Act::on_loop(AuditKind::LoopMove, id, json!({ "host": to }));
        let (deploy, id, to) = (self.clone(), id.clone(), to.clone());
        let work = async move {
            let before = deploy
                .room
                .feed
                .last(&id)
                .map(|last| json!({ "owner": last.record.owner }));
            let ask = Ask::Move(id.clone(), to.clone());
            let end = deploy.done(&id, ask, ANSWER_WAIT).await;
            let seen = match &end {
                Ok(()) => Seen::of(before.unwrap_or_default(), json!({ "owner": to })),
                Err(_) => Seen::default(),
            };
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// Empties a host, or lets it take loops again. Its loops move between two cycles. Returns when it owns none any more, or
    /// holds all that it shall; after 15 s it says how far it is.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`], [`Error::Timeout`], [`Error::Store`] where the order shall hold over a
    /// restart and the host's disk refuses it: nothing has changed then.
    pub async fn drain(&self, host: &HostId, order: DrainOrder) -> Result<DrainEnd, Error> {
        let kind = if order.drain {
            AuditKind::HostDrain
        } else {
            AuditKind::HostUndrain
        };
        let act = Act::new(kind, host.as_str(), json!({ "keep": order.keep }));
        let (deploy, host) = (self.clone(), host.clone());
        let work = async move {
            let before = deploy.room.roster.all().into_iter().find(|(known, _)| *known == host);
            let before = before.and_then(|(_, seen)| seen.vitals);
            let before = before.map(|vitals| json!({ "draining": vitals.draining, "kept": vitals.drain_kept }));
            let end = deploy.drained(&host, order).await;
            let seen = match &end {
                Ok(end) => {
                    let after = json!({ "draining": end.draining, "kept": end.kept });
                    Seen::of(before.unwrap_or_default(), after)
                }
                Err(_) => Seen::default(),
            };
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    async fn drained(&self, host: &HostId, order: DrainOrder) -> Result<DrainEnd, Error> {
        self.room.roster.known(host)?;
        let wait = DRAIN_ORDER_WAIT + ANSWER_WAIT;
        match self.room.ask(host, Ask::Drain(order), wait).await? {
            Told::Drained(end) => Ok(end),
            _ => Err(unexpected()),
        }
    }
}

/// A name that somebody gave; what stands in for none is none.
fn named(by: &str) -> &str {
    if by == "api" { "" } else { by }
}
