//! The facade: everything that the API may ask of the cell.
//!
//! Never: decides. It looks up where a question belongs, asks there, and copies out what this host sees.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{Command, CommandBody, CommandId, ComponentInfo, Digest, HostId, LoopId, Record};
use futures_util::future::join_all;
use tokio::sync::broadcast;

use crate::{
    book::on_disk,
    draft::{Change, LoopDraft},
    error::Error,
    expect::Expect,
    health::HealthView,
    library::title,
    limits::{ANSWER_MARGIN, ANSWER_WAIT, APPLY_WAIT, DRAIN_ORDER_WAIT, DRAIN_SETTLE, DRAIN_WAIT},
    orders::command_wait,
    plan,
    room::{DeployArrival, Parts, Room},
    view::{
        ApplyEnd, Call, CallEnd, CommandEnd, ComponentView, Counters, DrainEnd, DrainOrder, HostView, Imported,
        LoopView, PointView, Relabel, StageView, Upload,
    },
    wire::{Amend, Ask, Told},
};

mod alarms;
mod field;
mod past;
mod points;
mod rollouts;

/// One host's part in the cell. Clones share it. It lives until [`Deploy::shutdown`].
#[derive(Clone)]
pub struct Deploy {
    room: Arc<Room>,
}

impl std::fmt::Debug for Deploy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Deploy")
            .field("here", &self.room.here)
            .finish_non_exhaustive()
    }
}

fn unexpected() -> Error {
    Error::internal("a host gave an answer to another question")
}

impl Deploy {
    /// Reads the disk and starts the tasks, on the async runtime of the caller. Blocks for as long as the disk takes. Homes
    /// open a second later, when other hosts have been asked for newer records.
    ///
    /// # Errors
    /// [`Error::Store`] where the disk cannot be read, [`Error::Internal`] outside a runtime or where the machine's load
    /// cannot be measured.
    pub fn start(parts: Parts) -> Result<Self, Error> {
        Room::start(parts).map(|room| Self { room })
    }

    /// Takes what arrives from the bus or the loops. Never blocks, so it may be called from their threads.
    pub fn arrive(&self, arrival: DeployArrival) {
        self.room.arrive(arrival);
    }

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
        self.room.upload(bytes, upload).await.map(|info| (*info).clone())
    }

    /// What [`Deploy::take_in`] would find, with the report of a trial, also of one that it refuses. Nothing stays.
    ///
    /// # Errors
    /// As [`Deploy::take_in`], except for what fails its trial: its report says so.
    pub async fn try_out(&self, bytes: Vec<u8>, upload: &Upload) -> Result<ComponentInfo, Error> {
        self.room.try_out(bytes, upload).await
    }

    /// Changes labels and note of a component, on every host.
    ///
    /// # Errors
    /// [`Error::NotFound`] for the component or a label to remove, [`Error::Invalid`], [`Error::Store`].
    pub async fn relabel(&self, reference: &str, change: &Relabel) -> Result<ComponentInfo, Error> {
        self.room.relabel(reference, change).await.map(|info| (*info).clone())
    }

    /// A file with these components, for a plant without a network: an OCI image layout in a tar, at most 64 components and
    /// 128 MiB.
    ///
    /// # Errors
    /// [`Error::NotFound`] for a component or its bytes, [`Error::Invalid`] for too many.
    pub async fn export(&self, references: &[String]) -> Result<Vec<u8>, Error> {
        self.room.export(references).await
    }

    /// Takes in the components of such a file, each as by [`Deploy::take_in`]. One that is refused does not hold up the
    /// others.
    ///
    /// # Errors
    /// [`Error::Invalid`] where the file is no bundle.
    pub async fn import(&self, bytes: Vec<u8>, by: &str, force: bool) -> Result<Vec<Imported>, Error> {
        self.room.import(bytes, by, force).await
    }

    /// How far each host is with a component, by name. Every host is asked, and given two seconds.
    pub async fn stages(&self, digest: Digest) -> Vec<StageView> {
        self.room.stages(digest).await
    }

    /// The library, by name and version.
    #[must_use]
    pub fn components(&self) -> Vec<ComponentView> {
        let mut used_by = self.room.book.users();
        let mut ready_on: BTreeMap<Digest, Vec<HostId>> = BTreeMap::new();
        for (host, seen) in self.room.roster.all() {
            for digest in seen.vitals.filter(|_| seen.there).into_iter().flat_map(|v| v.ready) {
                ready_on.entry(digest).or_default().push(host.clone());
            }
        }
        let view = |info: Arc<ComponentInfo>| ComponentView {
            used_by: used_by.remove(&info.digest).unwrap_or_default(),
            ready_on: ready_on.remove(&info.digest).unwrap_or_default(),
            info: (*info).clone(),
        };
        self.room.library.all().into_iter().map(view).collect()
    }

    /// The component that a reference means: `name` (the newest version), `name@version`, or a digest or its beginning (at
    /// least 8 digits).
    ///
    /// # Errors
    /// [`Error::NotFound`], with what there is; [`Error::Refused`] where it means more than one.
    pub fn resolve(&self, reference: &str) -> Result<ComponentInfo, Error> {
        self.room.library.resolve(reference).map(|info| (*info).clone())
    }

    /// A component's bytes, from this host or another.
    ///
    /// # Errors
    /// [`Error::NotFound`] where no host has them.
    pub async fn component_bytes(&self, digest: &Digest) -> Result<Vec<u8>, Error> {
        self.room.component_bytes(digest).await
    }

    /// Removes a component from the library of the cell.
    ///
    /// # Errors
    /// [`Error::Refused`] while a loop runs it or can go back to it, [`Error::NotFound`], [`Error::Store`].
    pub async fn remove_component(&self, reference: &str) -> Result<(), Error> {
        self.room.remove_component(reference).await
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
    pub async fn apply_if(&self, mut draft: LoopDraft, expect: Expect) -> Result<ApplyEnd, Error> {
        let id = plan::loop_id(&draft.name)?;
        // By digest, for the home may not have heard of the component yet.
        draft.component = self.room.library.resolve(&draft.component)?.digest.to_string();
        if let Some(fallback) = &mut draft.fallback {
            *fallback = self.room.library.resolve(fallback)?.digest.to_string();
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

    /// All loops of the cell, by name.
    #[must_use]
    pub fn loops(&self) -> Vec<LoopView> {
        self.room
            .book
            .all()
            .iter()
            .map(|intent| self.room.loop_view(intent))
            .collect()
    }

    /// One loop.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub fn loop_view(&self, id: &LoopId) -> Result<LoopView, Error> {
        self.room.book.find(id).map(|intent| self.room.loop_view(&intent))
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
        let intent = self.room.book.find(id)?;
        let wait = command_wait(intent.current.period_ns) * 2 + ANSWER_MARGIN;
        let command = Command {
            id: command_id.unwrap_or_else(|| self.room.new_command_id()),
            body,
        };
        match self
            .room
            .ask(&intent.home, Ask::Command(id.clone(), command), wait)
            .await?
        {
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
    /// As [`Deploy::apply_if`].
    pub async fn swap_if(&self, id: &LoopId, component: &str, expect: Expect) -> Result<ApplyEnd, Error> {
        let digest = self.room.library.resolve(component)?.digest;
        self.amended(id, Amend::Swap(digest.to_string()), expect).await
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
    /// As [`Deploy::apply_if`].
    pub async fn set_if(&self, id: &LoopId, change: Change, expect: Expect) -> Result<ApplyEnd, Error> {
        self.amended(id, Amend::Set(change), expect).await
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
        self.amended(id, Amend::Rollback(revision), expect).await
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
        self.done(id, Ask::Delete(id.clone(), expect), APPLY_WAIT).await
    }

    /// Gives the ownership to another member, between two cycles.
    ///
    /// # Errors
    /// [`Error::Refused`] where that host is no member that is ready, [`Error::NotFound`], [`Error::Unreachable`].
    pub async fn move_owner(&self, id: &LoopId, to: &HostId) -> Result<(), Error> {
        self.done(id, Ask::Move(id.clone(), to.clone()), ANSWER_WAIT).await
    }

    /// The hosts of the cell, by name; hosts that went are shown for ten minutes.
    #[must_use]
    pub fn hosts(&self) -> Vec<HostView> {
        let now = Instant::now();
        let all = self.room.roster.all().into_iter();
        all.map(|(id, seen)| self.room.host_view(id, &seen, now)).collect()
    }

    /// Empties a host, or lets it take loops again. Its loops move between two cycles. Returns when it owns none any more, or
    /// holds all that it shall; after 15 s it says how far it is.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`], [`Error::Timeout`], [`Error::Store`] where the order shall hold over a
    /// restart and the host's disk refuses it: nothing has changed then.
    pub async fn drain(&self, host: &HostId, order: DrainOrder) -> Result<DrainEnd, Error> {
        self.room.roster.known(host)?;
        let wait = DRAIN_ORDER_WAIT + ANSWER_WAIT;
        match self.room.ask(host, Ask::Drain(order), wait).await? {
            Told::Drained(end) => Ok(end),
            _ => Err(unexpected()),
        }
    }

    /// How well a host is, in its own words.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`], [`Error::Timeout`].
    pub async fn health(&self, host: &HostId) -> Result<HealthView, Error> {
        self.room.roster.known(host)?;
        match self.room.ask(host, Ask::Health, ANSWER_WAIT).await? {
            Told::Health(view) => Ok(view),
            _ => Err(unexpected()),
        }
    }

    /// This host.
    #[must_use]
    pub fn here(&self) -> &HostId {
        &self.room.here
    }

    /// The points of all hosts, by name.
    ///
    /// # Errors
    /// Where no I/O host answers.
    pub async fn points(&self) -> Result<Vec<PointView>, Error> {
        self.room.points().await
    }

    /// One step of a component, for a caller from outside.
    ///
    /// # Errors
    /// [`Error::Invalid`] for names and numbers, [`Error::Refused`] for a fault of the component, [`Error::Busy`],
    /// [`Error::Timeout`].
    pub async fn call(&self, call: Call) -> Result<CallEnd, Error> {
        self.room.call(call).await
    }

    /// The live feed of records. A receiver that lags loses the oldest.
    #[must_use]
    pub fn records(&self) -> broadcast::Receiver<Arc<Record>> {
        self.room.feed.subscribe()
    }

    /// What this host counts.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.room.counters()
    }

    /// Empties this host, or lets it take loops again.
    pub fn set_draining(&self, draining: bool) {
        self.room.set_draining(draining);
    }

    /// Gives this host's loops away, waits at most 5 s until it owns none, brings the last records to the disk, and ends
    /// the tasks. The bus, the loops and the store are the caller's to close, afterwards.
    pub async fn shutdown(&self) {
        self.set_draining(true);
        self.room.wait_empty(DRAIN_WAIT).await;
        let owned = self.room.field.owned();
        if owned > 0 {
            tracing::warn!(owned, "the host stops while it owns loops; the others take them over");
        }
        if self.room.others_can_take() && self.room.holder.len() > 0 {
            tokio::time::sleep(DRAIN_SETTLE).await;
        }
        self.room.stop();
        let room = Arc::clone(&self.room);
        let flush = move || match &room.cycles {
            Some(cycles) => room.feed.flush().and(cycles.flush()),
            None => room.feed.flush(),
        };
        let room = Arc::clone(&self.room);
        let flush = move || match &room.archive {
            Some(archive) => flush().and(archive.flush()),
            None => flush(),
        };
        match on_disk(flush).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!(%error, "the last records are not on disk"),
            Err(error) => tracing::warn!(%error, "the last records are not on disk"),
        }
    }
}

impl Room {
    fn loop_view(&self, intent: &bumpless_core::Intent) -> LoopView {
        let id = &intent.loop_id;
        let last = self.feed.last(id);
        let view = if intent.home == self.here {
            self.field.home_view(id)
        } else {
            None
        };
        let known = self.library.get(&intent.current.digest);
        LoopView {
            id: id.clone(),
            home: intent.home.clone(),
            spec: intent.current.clone(),
            pending: intent.pending.as_ref().map(|spec| spec.revision),
            past: intent.past.iter().map(|spec| spec.revision).collect(),
            component: known.map_or_else(|| intent.current.digest.short(), |info| title(&info)),
            last_age_ms: last
                .as_ref()
                .map(|l| u64::try_from(l.came.elapsed().as_millis()).unwrap_or(u64::MAX)),
            last: last.map(|l| l.record),
            members: match &view {
                Some(view) => view.members.clone(),
                None => crate::holder::wanted_members(intent, &self.roster.eligible()),
            },
            tally: view.map(|view| view.tally),
            failures: self.holder.failures(id),
        }
    }

    fn host_view(&self, id: HostId, seen: &crate::roster::Seen, now: Instant) -> HostView {
        let vitals = seen.vitals.as_ref();
        HostView {
            here: id == self.here,
            alive: seen.alive(now),
            io: vitals.is_some_and(|v| v.roles.io),
            control: vitals.is_some_and(|v| v.roles.control),
            draining: vitals.is_some_and(|v| v.draining),
            drain_kept: vitals.is_some_and(|v| v.drain_kept),
            labels: vitals.map(|v| v.labels.clone()).unwrap_or_default(),
            api: vitals.and_then(|v| v.api.clone()),
            cpu: vitals.map_or(0.0, |v| v.cpu),
            cpu_process: vitals.map_or(0.0, |v| v.cpu_process),
            memory_bytes: vitals.map_or(0, |v| v.memory_bytes),
            latency_ns: self.field.latency_ns(&id),
            loops_owned: vitals.map_or(0, |v| v.loops_owned),
            loops_held: vitals.map_or(0, |v| v.loops_held),
            version: vitals.map(|v| v.version.clone()).unwrap_or_default(),
            id,
        }
    }
}
