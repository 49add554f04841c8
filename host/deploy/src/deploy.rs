//! The facade: everything that the API may ask of the cell.
//!
//! Never: decides. It looks up where a question belongs, asks there, and copies out what this host sees.

use std::{collections::BTreeMap, sync::Arc, time::Instant};

use bumpless_core::{ComponentInfo, Digest, HostId, LoopId, Record};
use tokio::sync::broadcast;

use crate::{
    book::on_disk,
    error::Error,
    health::HealthView,
    library::title,
    limits::{ANSWER_WAIT, DRAIN_SETTLE, DRAIN_WAIT},
    room::{DeployArrival, Parts, Room},
    view::{Call, CallEnd, ComponentView, Counters, HostView, LoopView, PointView, StageView, Upload},
    wire::{Ask, Told},
};

mod access;
mod alarms;
mod audit;
mod changes;
mod field;
mod past;
mod points;
mod programs;
mod rollouts;
mod signing;

pub use access::{AccountDraft, SignedIn};

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

    /// What [`Deploy::take_in`] would find, with the report of a trial, also of one that it refuses. Nothing stays.
    ///
    /// # Errors
    /// As [`Deploy::take_in`], except for what fails its trial: its report says so.
    pub async fn try_out(&self, bytes: Vec<u8>, upload: &Upload) -> Result<ComponentInfo, Error> {
        self.room.try_out(bytes, upload).await
    }

    /// A file with these components, for a plant without a network: an OCI image layout in a tar, at most 64 components and
    /// 128 MiB.
    ///
    /// # Errors
    /// [`Error::NotFound`] for a component or its bytes, [`Error::Invalid`] for too many.
    pub async fn export(&self, references: &[String]) -> Result<Vec<u8>, Error> {
        self.room.export(references).await
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

    /// The hosts of the cell, by name; hosts that went are shown for ten minutes.
    #[must_use]
    pub fn hosts(&self) -> Vec<HostView> {
        let now = Instant::now();
        let all = self.room.roster.all().into_iter();
        all.map(|(id, seen)| self.room.host_view(id, &seen, now)).collect()
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
        self.room.end_audit().await;
        self.room.stop();
        self.room.programs.runner.close();
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
            alive: seen.alive(now, self.session.hosts().len()),
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
