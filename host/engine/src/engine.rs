//! The sandbox as the host sees it: inspect, prepare, forget.
//!
//! Owns: the table of prepared components by digest, and the way from bytes to compiled code (table, cache, compiler).
//! Never: compiles while a lock is held that a cycle could want.

use std::{
    collections::HashMap,
    path::PathBuf,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use bumpless_core::Digest;
use wasmtime::component::Component;

use crate::{
    Capacity, Config, Error, Inspection, Prepared, PreparedPlant, PreparedProgram, Profile, Programs,
    admission::{check_bytes, check_plant_export},
    cache::{Cache, deserialize},
    capacity::{Places, Turnstile},
    compile::compile,
    config::Compile,
    error::brief,
    prepared::Core,
    profile::{INSPECTED_AT_ONCE, Maps, TRIAL_INSTANCES},
    ticker::{Calls, Ticker},
};

/// Instances that may be asked for: beyond it, memory is gone before.
const INSTANCES_MAX: u32 = 1_000_000;

/// The sandbox. Cheap to clone; its clock thread ends with the last clone, component and instance.
#[derive(Clone)]
pub struct Engine(Arc<Shared>);

struct Shared {
    core: Arc<Core>,
    profile: Profile,
    cache: Option<Cache>,
    compile: Compile,
    /// One compilation at a time: each may take gigabytes.
    compilations: Turnstile,
    programs: Programs,
    prepared: Mutex<HashMap<Digest, Arc<Prepared>>>,
}

/// What a component is.
#[derive(Debug)]
pub enum Either {
    /// What loops run: inspected, and ready for a trial.
    Controller(Inspection, Arc<Prepared>),
    /// What simulated buses run, and how long its compilation took where there was one.
    Plant(Arc<PreparedPlant>, Option<Duration>),
    /// What runs freely, and how long its compilation took where there was one.
    Program(Arc<PreparedProgram>, Option<Duration>),
}

impl Engine {
    /// Starts the engine and its clock thread.
    ///
    /// # Errors
    /// [`Error::Setting`] for a bound that makes no sense, [`Error::Maps`] where the kernel allows too few memory maps,
    /// [`Error::Engine`] and [`Error::Thread`] where the machine refuses, [`Error::File`] for the cache's folder.
    pub fn new(config: Config) -> Result<Self, Error> {
        check(&config)?;
        let programs = Programs::new(&config)?;
        let Config {
            cache_dir,
            cache_key,
            instances_max,
            compile,
            limits,
            lines,
        } = config;
        let mut profile = Profile::choose(instances_max, &limits, Maps::read())?;
        let engine = match profile.runtime(instances_max, &limits, lines) {
            Err(error) if profile == Profile::Pooled => {
                // For example under a limit on address space.
                tracing::warn!(%error, "slots for {instances_max} instances cannot be reserved; allocating on demand");
                profile = Profile::OnDemand;
                profile.runtime(instances_max, &limits, lines)?
            }
            other => other?,
        };
        let cache = cache_dir
            .map(|dir| Cache::open(dir, cache_key, limits.cached_max, &engine, profile))
            .transpose()?;
        let calls = Calls::default();
        let core = Core {
            linker: Core::linker(&engine)?,
            limits,
            places: Places::new(instances_max),
            trials: Places::new(TRIAL_INSTANCES),
            inspections: Turnstile::new(INSPECTED_AT_ONCE, "inspected"),
            _ticker: Ticker::start(engine.clone(), calls.clone())?,
            calls,
            engine,
        };
        Ok(Self(Arc::new(Shared {
            core: Arc::new(core),
            profile,
            cache,
            compile,
            compilations: Turnstile::new(1, "compiled"),
            programs,
            prepared: Mutex::default(),
        })))
    }

    /// Finds out what the bytes are, and whether this host can run them. Compiled code of an accepted component is kept in
    /// the cache, so that [`Engine::prepare`] need not compile again.
    ///
    /// # Errors
    /// Everything that makes bytes no acceptable controller; the text says what and what to do.
    pub fn inspect(&self, bytes: &[u8]) -> Result<Inspection, Error> {
        self.open(bytes).map(|(inspection, _)| inspection)
    }

    /// As [`Engine::inspect`], with the component ready for a trial. It takes no place among the prepared ones, so it is
    /// gone when it is dropped.
    ///
    /// # Errors
    /// As [`Engine::inspect`].
    pub fn open(&self, bytes: &[u8]) -> Result<(Inspection, Arc<Prepared>), Error> {
        let (prepared, compile_time) = self.make(bytes)?;
        let inspection = Inspection {
            digest: *prepared.digest(),
            descriptor: prepared.descriptor().clone(),
            imports: prepared.imports().to_vec(),
            bytes: bytes.len(),
            compile_time,
        };
        Ok((inspection, Arc::new(prepared)))
    }

    /// Makes a component ready for instances, from the table, the cache or the compiler, in this order.
    ///
    /// # Errors
    /// As [`Engine::inspect`]; [`Error::TooManyPrepared`] where the table is full.
    pub fn prepare(&self, bytes: &[u8]) -> Result<Arc<Prepared>, Error> {
        let digest = Digest::of(bytes);
        if let Some(prepared) = self.prepared(&digest) {
            return Ok(prepared);
        }
        let max = self.0.core.limits.prepared_max;
        if self.table().len() >= max {
            return Err(Error::TooManyPrepared { max });
        }
        let made = Arc::new(self.make(bytes)?.0);
        let mut table = self.table();
        // Another thread may have been faster, or have taken the last place, meanwhile.
        if !table.contains_key(&digest) && table.len() >= max {
            return Err(Error::TooManyPrepared { max });
        }
        Ok(Arc::clone(table.entry(digest).or_insert(made)))
    }

    /// A component that is ready.
    #[must_use]
    pub fn prepared(&self, digest: &Digest) -> Option<Arc<Prepared>> {
        self.table().get(digest).cloned()
    }

    /// Forgets a component, in memory and on disk. Instances of it live on until they are dropped.
    pub fn forget(&self, digest: &Digest) {
        // Taken out first, so that unmapping its code does not hold the lock.
        let forgotten = self.table().remove(digest);
        drop(forgotten);
        if let Some(cache) = &self.0.cache {
            cache.remove(digest);
        }
    }

    /// Instances that there may be and are.
    #[must_use]
    pub fn capacity(&self) -> Capacity {
        self.0.core.places.capacity()
    }

    /// The shape of memory that was chosen.
    #[must_use]
    pub fn profile(&self) -> Profile {
        self.0.profile
    }

    /// The engine of free-running programs.
    #[must_use]
    pub fn programs(&self) -> &Programs {
        &self.0.programs
    }

    /// Makes a simulated plant ready for instances, from the cache or the compiler. It takes no place among the prepared
    /// components: a plant is used by one bus or one experiment, which keeps what this gives.
    ///
    /// # Errors
    /// Everything that makes bytes no acceptable plant; the text says what and what to do.
    pub fn open_plant(&self, bytes: &[u8]) -> Result<Arc<PreparedPlant>, Error> {
        let (plant, _) = self.make_as(bytes, PreparedPlant::new)?;
        Ok(Arc::new(plant))
    }

    /// A component of any world, ready for a trial: what somebody uploads says itself what it is. `imports` are those of
    /// its own list.
    ///
    /// # Errors
    /// As [`Engine::inspect`]; what is neither is told as no controller.
    pub fn open_either(&self, bytes: &[u8]) -> Result<Either, Error> {
        enum Made {
            Controller(Prepared),
            Plant(PreparedPlant),
        }
        if Programs::is_likely(bytes) {
            match self.0.programs.open(bytes) {
                // A controller that only speaks of programs.
                Err(Error::ProgramWorld { .. } | Error::Import { .. }) => {}
                opened => return opened.map(|(program, compile_time)| Either::Program(program, compile_time)),
            }
        }
        let new = |core: Arc<Core>, digest, component: &Component| {
            if check_plant_export(component).is_ok() {
                PreparedPlant::new(core, digest, component).map(Made::Plant)
            } else {
                Prepared::new(core, digest, component).map(Made::Controller)
            }
        };
        let (made, compile_time) = self.make_as(bytes, new)?;
        Ok(match made {
            Made::Controller(prepared) => {
                let inspection = Inspection {
                    digest: *prepared.digest(),
                    descriptor: prepared.descriptor().clone(),
                    imports: prepared.imports().to_vec(),
                    bytes: bytes.len(),
                    compile_time,
                };
                Either::Controller(inspection, Arc::new(prepared))
            }
            Made::Plant(prepared) => Either::Plant(Arc::new(prepared), compile_time),
        })
    }

    /// From bytes to a described controller; with the time of the compilation where there was one.
    fn make(&self, bytes: &[u8]) -> Result<(Prepared, Option<Duration>), Error> {
        self.make_as(bytes, Prepared::new)
    }

    /// From bytes to a described component of a world: `new` checks and describes it.
    fn make_as<T>(
        &self,
        bytes: &[u8],
        new: impl Fn(Arc<Core>, Digest, &Component) -> Result<T, Error>,
    ) -> Result<(T, Option<Duration>), Error> {
        check_bytes(bytes, &self.0.core.limits)?;
        let digest = Digest::of(bytes);
        let core = &self.0.core;
        let limits = &core.limits;
        let cached = || {
            self.0
                .cache
                .as_ref()
                .and_then(|cache| cache.load(&digest, &core.engine))
        };
        if let Some(component) = cached() {
            return Ok((new(Arc::clone(core), digest, &component)?, None));
        }
        // One whole compilation may be ahead of this one; more is a crowd.
        let turn = self.0.compilations.enter(limits.compile_time_max * 2)?;
        // It may have been this very component.
        if let Some(component) = cached() {
            drop(turn);
            return Ok((new(Arc::clone(core), digest, &component)?, None));
        }
        let started = Instant::now();
        let exchange_in = self
            .0
            .cache
            .as_ref()
            .map_or_else(std::env::temp_dir, |c| PathBuf::from(c.dir()));
        let code = compile(
            &core.engine,
            self.0.profile,
            &self.0.compile,
            limits,
            &exchange_in,
            bytes,
        )?;
        let compile_time = started.elapsed();
        let component = self.load(&code)?;
        let prepared = new(Arc::clone(core), digest, &component)?;
        // Only what passed every check is kept.
        if let Some(cache) = &self.0.cache {
            cache.store(&digest, &code);
        }
        drop(turn);
        Ok((prepared, Some(compile_time)))
    }

    fn load(&self, code: &[u8]) -> Result<Component, Error> {
        // The engine's settings are the compiler's own, so what it refuses here is a need beyond the limits of a slot.
        deserialize(&self.0.core.engine, code).map_err(|error| Error::Needs { reason: brief(&error) })
    }

    fn table(&self) -> MutexGuard<'_, HashMap<Digest, Arc<Prepared>>> {
        self.0.prepared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl std::fmt::Debug for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Engine")
            .field("profile", &self.0.profile)
            .field("capacity", &self.capacity())
            .finish_non_exhaustive()
    }
}

fn check(config: &Config) -> Result<(), Error> {
    let wrong = |name, value, cure| Err(Error::Setting { name, value, cure });
    if !(1..=INSTANCES_MAX).contains(&config.instances_max) {
        return wrong("instances_max", u64::from(config.instances_max), "use 1 to 1,000,000");
    }
    let memory = config.limits.memory_bytes_max;
    if !(64 * 1024..=1 << 32).contains(&memory) || !memory.is_multiple_of(64 * 1024) {
        return wrong(
            "memory_bytes_max",
            memory as u64,
            "use a multiple of 65,536 up to 4 GiB",
        );
    }
    if config.lines && (config.cache_dir.is_some() || !matches!(config.compile, Compile::InProcess)) {
        return wrong(
            "lines",
            1,
            "it is for tools: compile in this process, and keep nothing on disk",
        );
    }
    if config.limits.prepared_max == 0 {
        return wrong("prepared_max", 0, "use 1 or more");
    }
    if config.limits.describe_time_max.is_zero() || config.limits.compile_time_max.as_secs() == 0 {
        return wrong(
            "describe_time_max or compile_time_max",
            0,
            "use more than 0, and whole seconds for compiling",
        );
    }
    Ok(())
}
