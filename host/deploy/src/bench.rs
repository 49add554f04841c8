//! Components made ready: bytes found here or at another host, checked by digest, compiled, instantiated, warmed up.
//!
//! Owns: one compilation at a time, what is ready here, and the pauses after failures.
//! Never: believes bytes: what comes from another host is what its digest says, or is thrown away and asked of the next.
//!
//! ```text
//! wanted ──bytes here, else fetched──► compiled (ready) ──instantiate, start once──► instance for the loops
//! ```

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{ComponentInfo, Descriptor, Digest, HostId, LoopSpec, Wiring};
use bumpless_engine::{Engine, Instance, Prepared};
use bumpless_loops::HeldRevision;
use futures_util::future::join_all;
use parking_lot::Mutex;
use tokio::sync::Semaphore;

use crate::{
    beat::every,
    book::on_disk,
    error::{Error, Words, chain},
    holder::wanted_revisions,
    limits::{FETCH_WAIT, PREPARED_AHEAD_MAX, PREPARED_KEPT_MAX, RECONCILE_EVERY, STAGE_WAIT, WARM_LIMIT_NS},
    room::{Room, count},
    roster::back_off,
    view::{Stage, StageView},
    wire::{Ask, Told},
};

/// The place where components are made ready.
pub(crate) struct Bench {
    pub(crate) engine: Engine,
    compile: Semaphore,
    ready: Mutex<BTreeSet<Digest>>,
    /// Being compiled, or waiting for that.
    compiling: Mutex<BTreeSet<Digest>>,
    /// Could not be made ready at the last try, and why.
    failed: Mutex<BTreeMap<Digest, String>>,
}

/// Says that a component is being compiled, for as long as it lives.
struct Compiling<'a>(&'a Bench, Digest);

impl Drop for Compiling<'_> {
    fn drop(&mut self) {
        self.0.compiling.lock().remove(&self.1);
    }
}

impl Bench {
    pub(crate) fn new(engine: Engine) -> Self {
        Self {
            engine,
            compile: Semaphore::new(1),
            ready: Mutex::default(),
            compiling: Mutex::default(),
            failed: Mutex::default(),
        }
    }

    /// Components that are compiled here.
    pub(crate) fn ready(&self) -> Vec<Digest> {
        self.ready.lock().iter().copied().collect()
    }

    pub(crate) fn is_ready(&self, digest: &Digest) -> bool {
        self.ready.lock().contains(digest)
    }

    /// What is known of a component here beside its bytes.
    pub(crate) fn stage(&self, digest: &Digest) -> Option<Stage> {
        if self.is_ready(digest) {
            Some(Stage::Ready)
        } else if self.compiling.lock().contains(digest) {
            Some(Stage::Compiling)
        } else {
            self.failed.lock().get(digest).cloned().map(Stage::Failed)
        }
    }

    /// Forgets a removed component.
    pub(crate) fn forget(&self, digest: &Digest) {
        self.ready.lock().remove(digest);
        self.failed.lock().remove(digest);
        self.engine.forget(digest);
    }
}

/// The engine's refusal for people: the component's fault, or this host's limits.
pub(crate) fn engine_error(error: &bumpless_engine::Error) -> Error {
    use bumpless_engine::Error as E;
    let words = Words::new(chain(error), "");
    match error {
        E::Full { .. } | E::TooManyPrepared { .. } | E::Busy { .. } => Error::Busy(words),
        E::CompileChild { .. } | E::Setting { .. } | E::Maps { .. } | E::Engine { .. } | E::Thread(_) => {
            Error::Internal(words)
        }
        E::File { .. } | E::Key { .. } => Error::Store(words),
        _ => Error::Invalid(words),
    }
}

impl Room {
    /// A component's bytes from the disk, else from `first` or any other host. What comes is checked and kept.
    pub(crate) async fn bytes_of(self: &Arc<Self>, digest: Digest, first: Option<&HostId>) -> Result<Vec<u8>, Error> {
        let store = self.store.clone();
        if let Some(bytes) = on_disk(move || store.component(&digest)).await?? {
            return Ok(bytes);
        }
        let mut hosts = self.roster.others();
        // Hosts that have it ready surely have its bytes.
        let ready: BTreeSet<HostId> = self
            .roster
            .all()
            .into_iter()
            .filter(|(_, seen)| seen.vitals.as_ref().is_some_and(|v| v.ready.contains(&digest)))
            .map(|(host, _)| host)
            .collect();
        hosts.sort_by_key(|host| (Some(host) != first, !ready.contains(host)));
        let mut reasons = Vec::new();
        for host in &hosts {
            match self.fetch(digest, host).await {
                Ok(bytes) => return Ok(bytes),
                Err(error) => {
                    count(&self.tallies.fetches_failed);
                    tracing::debug!(%digest, %host, %error, "a component could not be fetched");
                    reasons.push(format!("{host}: {}", error.words().reason));
                }
            }
        }
        reasons.truncate(4);
        Err(Error::not_found(
            format!(
                "no host has the bytes of component {}{}",
                digest.short(),
                list(&reasons)
            ),
            "upload it again",
        ))
    }

    async fn fetch(self: &Arc<Self>, digest: Digest, host: &HostId) -> Result<Vec<u8>, Error> {
        let Told::Bytes(bytes) = self.ask(host, Ask::Bytes(digest), FETCH_WAIT).await? else {
            return Err(Error::internal("the answer is no component"));
        };
        let store = self.store.clone();
        let bytes = on_disk(move || {
            if Digest::of(&bytes) == digest {
                store.put_component(&bytes)?;
                return Ok(Some(bytes));
            }
            Ok::<_, bumpless_store::Error>(None)
        })
        .await??;
        let Some(bytes) = bytes else {
            count(&self.tallies.fetches_corrupt);
            tracing::warn!(%digest, %host, "a host sent other bytes than its digest says");
            return Err(Error::refused("it sent other bytes than the digest says", ""));
        };
        count(&self.tallies.fetches);
        Ok(bytes)
    }

    /// A component compiled here; compiles it where it is not.
    pub(crate) async fn prepared(
        self: &Arc<Self>,
        digest: Digest,
        first: Option<&HostId>,
    ) -> Result<Arc<Prepared>, Error> {
        if let Some(prepared) = self.bench.engine.prepared(&digest) {
            self.bench.ready.lock().insert(digest);
            return Ok(prepared);
        }
        let end = self.compiled(digest, first).await;
        let mut failed = self.bench.failed.lock();
        match &end {
            Ok(_) => {
                failed.remove(&digest);
                self.bench.ready.lock().insert(digest);
            }
            Err(error) => {
                failed.retain(|known, _| self.library.get(known).is_some());
                failed.insert(digest, error.to_string());
            }
        }
        drop(failed);
        end
    }

    async fn compiled(self: &Arc<Self>, digest: Digest, first: Option<&HostId>) -> Result<Arc<Prepared>, Error> {
        self.may_load(&digest)?;
        let bytes = self.bytes_of(digest, first).await?;
        self.bench.compiling.lock().insert(digest);
        let _compiling = Compiling(&self.bench, digest);
        let _turn = self.bench.compile.acquire().await.map_err(|_| stopping())?;
        let engine = self.bench.engine.clone();
        let made = on_disk(move || engine.prepare(&bytes)).await?;
        made.map_err(|error| {
            count(&self.tallies.prepares_failed);
            engine_error(&error)
        })
    }

    /// How far this host is with a component.
    pub(crate) fn stage_here(&self, digest: &Digest) -> Stage {
        self.bench.stage(digest).unwrap_or_else(|| {
            // A plant is compiled by the bus that runs it, a program by its owner.
            let is_plant = || {
                let info = self.library.get(digest);
                info.is_some_and(|info| info.is_plant() || info.is_program())
            };
            if self.store.has_component(digest) {
                if is_plant() { Stage::Ready } else { Stage::Bytes }
            } else {
                Stage::Nothing
            }
        })
    }

    /// How far each host is with a component, by name.
    pub(crate) async fn stages(self: &Arc<Self>, digest: Digest) -> Vec<StageView> {
        let mut hosts = self.roster.others();
        hosts.push(self.here.clone());
        hosts.sort();
        join_all(hosts.into_iter().map(|host| async move {
            let stage = match self.ask(&host, Ask::Stage(digest), STAGE_WAIT).await {
                Ok(Told::Stage(stage)) => stage,
                Ok(_) => Stage::Unknown("it gave an answer to another question".to_owned()),
                Err(error) => Stage::Unknown(error.words().reason.clone()),
            };
            StageView { host, stage }
        }))
        .await
    }

    /// A revision that can be stepped here: instantiated, and started once so that its first cycle is not its first call.
    pub(crate) async fn made_ready(
        self: &Arc<Self>,
        spec: Arc<LoopSpec>,
        first: Option<&HostId>,
    ) -> Result<HeldRevision, Error> {
        let prepared = self.prepared(spec.digest, first).await?;
        on_disk(move || {
            let wiring = wire_up(&spec, prepared.descriptor())?;
            let instance = warm(&prepared, &spec, &wiring)?;
            let descriptor = Arc::new(prepared.descriptor().clone());
            Ok(HeldRevision {
                spec,
                wiring: Arc::new(wiring),
                descriptor,
                instance,
            })
        })
        .await?
        .inspect_err(|_| count(&self.tallies.prepares_failed))
    }

    /// Compiles the newest components of the library before anyone needs them, one at a time.
    pub(crate) async fn prepare_ahead(room: Arc<Self>) {
        let mut failed: HashMap<Digest, (u32, Instant)> = HashMap::new();
        let mut tick = every(RECONCILE_EVERY);
        loop {
            tick.tick().await;
            let mut infos = room.library.all();
            // Plants are run by buses, each on its own host, from its start.
            infos.retain(|info| !info.is_plant() && !info.is_program());
            infos.sort_by_key(|info| std::cmp::Reverse(info.uploaded_at_unix_ms));
            room.forget_unneeded(&infos);
            let now = Instant::now();
            // What a loop falls back to must be ready before it fails; then the newest.
            let fallbacks = room.book.all().into_iter().filter_map(|intent| intent.current.fallback);
            let newest = infos.iter().take(PREPARED_AHEAD_MAX).map(|info| info.digest);
            let next = fallbacks.chain(newest).find(|digest| {
                !room.bench.is_ready(digest)
                    && room.may_load(digest).is_ok()
                    && failed.get(digest).is_none_or(|(_, again)| *again <= now)
            });
            let Some(digest) = next else {
                continue;
            };
            if let Err(error) = room.prepared(digest, None).await {
                let tries = failed.get(&digest).map_or(1, |(tries, _)| tries.saturating_add(1));
                tracing::warn!(%digest, tries, %error, "a component of the library could not be made ready here");
                failed.insert(digest, (tries, Instant::now() + back_off(tries)));
            }
            failed.retain(|digest, _| infos.iter().any(|info| info.digest == *digest));
            tick.reset_after(Duration::from_millis(1));
        }
    }

    /// Makes room in the engine: what no loop uses and is not among the newest, oldest first.
    fn forget_unneeded(&self, newest_first: &[Arc<ComponentInfo>]) {
        let ready = self.bench.ready();
        let Some(extra) = ready.len().checked_sub(PREPARED_KEPT_MAX).filter(|extra| *extra > 0) else {
            return;
        };
        let mut needed: BTreeSet<Digest> = newest_first
            .iter()
            .take(PREPARED_AHEAD_MAX)
            .map(|info| info.digest)
            .collect();
        for intent in self.book.all() {
            needed.extend(wanted_revisions(&intent).into_iter().map(|spec| spec.digest));
            needed.extend(intent.current.fallback);
        }
        let age = |digest: &Digest| {
            newest_first
                .iter()
                .position(|info| info.digest == *digest)
                .unwrap_or(usize::MAX)
        };
        let mut unneeded: Vec<Digest> = ready.into_iter().filter(|digest| !needed.contains(digest)).collect();
        unneeded.sort_by_key(|digest| std::cmp::Reverse(age(digest)));
        for digest in unneeded.iter().take(extra) {
            self.bench.forget(digest);
        }
    }
}

/// `": a; b"`, or nothing.
fn list(reasons: &[String]) -> String {
    if reasons.is_empty() {
        String::new()
    } else {
        format!(" ({})", reasons.join("; "))
    }
}

pub(crate) fn stopping() -> Error {
    Error::busy("the host is stopping", "ask another host")
}

/// A specification resolved against its component.
pub(crate) fn wire_up(spec: &LoopSpec, descriptor: &Descriptor) -> Result<Wiring, Error> {
    Wiring::new(spec, descriptor).map_err(|error| Error::invalid(chain(&error), ""))
}

/// An instance that has run once. Blocks for as long as the component takes, at most [`WARM_LIMIT_NS`].
fn warm(prepared: &Arc<Prepared>, spec: &LoopSpec, wiring: &Wiring) -> Result<Instance, Error> {
    let mut instance = prepared.instantiate().map_err(|error| engine_error(&error))?;
    let track: Vec<f64> = wiring.limits.iter().map(|limit| limit.safe).collect();
    let limit_ns = spec.step_limit_ns().max(WARM_LIMIT_NS);
    instance.start(&wiring.parameters, &track, limit_ns).map_err(|fault| {
        Error::refused(
            format!("component {} does not start: {fault}", spec.digest.short()),
            "change the parameters, or use another component",
        )
    })?;
    Ok(instance)
}
