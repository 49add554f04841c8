//! The engine of programs: its own wasmtime, its own epochs, its own table of compiled code.
//!
//! Owns: the way from bytes to a program that can run, and the thread that advances the epoch while programs run.
//! Never: shares a setting, a lock or a counter with the engine of controllers, except the way of compiling.
//!
//! ```text
//!  beats:  no program runs ──► the thread sleeps without end ──► one is polled: it is woken ──► an epoch each ms
//!                  ▲────────────── nothing was polled for 50 ms ◄──────────────────────────────────┘
//! ```

use std::{
    collections::HashMap,
    path::PathBuf,
    pin::pin,
    sync::{
        Arc, Mutex, PoisonError, Weak,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    task::{Context, Poll, Waker},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_core::Digest;
use wasmtime::{
    Store,
    component::{Component, HasSelf, Linker},
};

use crate::{
    Capacity, Config, Error, Limits, Profile,
    admission::{PROGRAM_EXPORT, check_bytes, check_needs, check_program_export, check_program_imports},
    cache::{Cache, deserialize},
    capacity::{Places, Turnstile},
    compile::compile,
    config::Compile,
    error::brief,
    prepared::nanos,
    program::{Ground, Metered, Nowhere, PreparedProgram, ProgramInfo, Usage, store},
    program_bindings::{Program, ProgramPre},
    sandbox::cut,
    script,
};

/// Programs that one host runs at most: each has a fiber and a memory, some 300 KiB together for a small script, and two to four
/// memory maps of the kernel's 65,530.
const PROGRAMS_MAX: u32 = 10_000;

/// Time between epochs while programs run: how soon one that spins is paused, and how long a turn is at least.
const BEAT: Duration = Duration::from_millis(1);
/// Beats without a poll after which the thread sleeps.
const IDLE_BEATS: u32 = 50;

/// The engine of programs. Cheap to clone.
#[derive(Clone)]
pub struct Programs(Arc<Own>);

struct Own {
    shared: Arc<Shared>,
    cache: Option<Cache>,
    compile: Compile,
    compilations: Turnstile,
    /// Code that somebody uses.
    codes: Mutex<HashMap<Digest, Weak<Code>>>,
}

/// What all programs of an engine share.
pub(crate) struct Shared {
    engine: wasmtime::Engine,
    linker: Linker<Ground>,
    pub(crate) limits: Limits,
    pub(crate) places: Places,
    pub(crate) beats: Beats,
    _ticker: Ticker,
}

/// Compiled code, with what it says of itself.
pub(crate) struct Code {
    pub(crate) shared: Arc<Shared>,
    pub(crate) imports: Vec<String>,
    pub(crate) pre: ProgramPre<Ground>,
    /// Places that a run takes.
    pub(crate) weight: u32,
    info: ProgramInfo,
}

impl Code {
    pub(crate) fn store(&self, ground: Ground) -> Store<Ground> {
        store(&self.shared.engine, ground)
    }
}

impl Programs {
    pub(crate) fn new(config: &Config) -> Result<Self, Error> {
        let limits = config.limits.clone();
        let engine = Profile::Program.runtime(0, &limits, false)?;
        let cache = config
            .cache_dir
            .as_ref()
            .map(|dir| {
                Cache::open(
                    dir.join("programs"),
                    config.cache_key,
                    limits.cached_max,
                    &engine,
                    Profile::Program,
                )
            })
            .transpose()?;
        let mut linker = Linker::new(&engine);
        Program::add_to_linker::<_, HasSelf<Ground>>(&mut linker, |ground| ground)
            .map_err(|error| Error::Engine { reason: brief(&error) })?;
        let beats = Beats::default();
        Ok(Self(Arc::new(Own {
            cache,
            compile: config.compile.clone(),
            compilations: Turnstile::new(1, "compiled"),
            codes: Mutex::default(),
            shared: Arc::new(Shared {
                _ticker: Ticker::start(engine.clone(), beats.clone())?,
                engine,
                linker,
                limits,
                places: Places::new(PROGRAMS_MAX),
                beats,
            }),
        })))
    }

    /// Do these bytes look like a program? A look costs next to nothing; [`Programs::open`] finds out.
    #[must_use]
    pub fn is_likely(bytes: &[u8]) -> bool {
        bytes
            .windows(PROGRAM_EXPORT.len())
            .any(|window| window == PROGRAM_EXPORT.as_bytes())
    }

    /// Makes a program ready, from code that is in use, the cache or the compiler, in this order; and how long a compilation
    /// took, where there was one. Blocks.
    ///
    /// # Errors
    /// Everything that makes bytes no acceptable program; the text says what and what to do.
    pub fn open(&self, bytes: &[u8]) -> Result<(Arc<PreparedProgram>, Option<Duration>), Error> {
        check_bytes(bytes, &self.0.shared.limits)?;
        let (code_bytes, script) = script::split(bytes);
        let (code, compile_time) = self.code(code_bytes)?;
        let mut info = code.info.clone();
        if let Some(script) = &script {
            info.text = cut(&format!("a script for {} {}", info.name, info.version));
            info.name.clone_from(&script.name);
            info.version.clone_from(&script.version);
            info.check()?;
        }
        let prepared = PreparedProgram {
            code,
            digest: Digest::of(bytes),
            info,
            script,
        };
        Ok((Arc::new(prepared), compile_time))
    }

    /// Programs that there may be and are.
    #[must_use]
    pub fn capacity(&self) -> Capacity {
        self.0.shared.places.capacity()
    }

    fn in_use(&self, digest: &Digest) -> Option<Arc<Code>> {
        let codes = self.0.codes.lock().unwrap_or_else(PoisonError::into_inner);
        codes.get(digest).and_then(Weak::upgrade)
    }

    fn code(&self, bytes: &[u8]) -> Result<(Arc<Code>, Option<Duration>), Error> {
        let digest = Digest::of(bytes);
        if let Some(code) = self.in_use(&digest) {
            return Ok((code, None));
        }
        let own = &*self.0;
        let limits = &own.shared.limits;
        // One whole compilation may be ahead of this one; more is a crowd.
        let _turn = own.compilations.enter(limits.compile_time_max * 2)?;
        // It may have been this very code.
        if let Some(code) = self.in_use(&digest) {
            return Ok((code, None));
        }
        let cached = own
            .cache
            .as_ref()
            .and_then(|cache| cache.load(&digest, &own.shared.engine));
        let (code, compile_time) = match cached {
            Some(component) => (Code::new(&own.shared, &component)?, None),
            None => {
                let started = Instant::now();
                let exchange_in = own
                    .cache
                    .as_ref()
                    .map_or_else(std::env::temp_dir, |cache| PathBuf::from(cache.dir()));
                let machine = compile(
                    &own.shared.engine,
                    Profile::Program,
                    &own.compile,
                    limits,
                    &exchange_in,
                    bytes,
                )?;
                let compile_time = started.elapsed();
                let component = deserialize(&own.shared.engine, &machine)
                    .map_err(|error| Error::Needs { reason: brief(&error) })?;
                let code = Code::new(&own.shared, &component)?;
                // Only what passed every check is kept.
                if let Some(cache) = &own.cache {
                    cache.store(&digest, &machine);
                }
                (code, Some(compile_time))
            }
        };
        let code = Arc::new(code);
        let mut codes = own.codes.lock().unwrap_or_else(PoisonError::into_inner);
        codes.retain(|_, code| code.strong_count() > 0);
        codes.insert(digest, Arc::downgrade(&code));
        Ok((code, compile_time))
    }
}

impl std::fmt::Debug for Programs {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Programs")
            .field("capacity", &self.capacity())
            .finish_non_exhaustive()
    }
}

impl Code {
    /// Checks and links compiled code and lets it say what it is.
    fn new(shared: &Arc<Shared>, component: &Component) -> Result<Self, Error> {
        let imports = check_program_imports(component)?;
        check_program_export(component)?;
        let weight = check_needs(component, &shared.limits)?;
        let world = |error: wasmtime::Error| Error::ProgramWorld { reason: brief(&error) };
        let pre = ProgramPre::new(shared.linker.instantiate_pre(component).map_err(world)?).map_err(world)?;
        let info = describe(shared, &pre)?;
        info.check()?;
        Ok(Self {
            shared: Arc::clone(shared),
            imports,
            pre,
            weight,
            info,
        })
    }
}

/// Asks a program what it is, in a store of its own. There it has nothing to wait for, so it is polled until it is done.
fn describe(shared: &Shared, pre: &ProgramPre<Ground>) -> Result<ProgramInfo, Error> {
    let limits = &shared.limits;
    let usage = Arc::new(Usage::default());
    let nowhere = Arc::new(Nowhere {
        limit_ns: nanos(limits.describe_time_max),
    });
    let ground = Ground::new(
        nowhere,
        Arc::clone(&usage),
        limits.memory_bytes_max,
        limits.table_elements_max,
    );
    let asked = Metered {
        work: Box::pin(async {
            let mut store = store(&shared.engine, ground);
            let guest = match pre.instantiate_async(&mut store).await {
                Ok(guest) => guest,
                Err(error) => return Err(Error::Instantiate(store.data().fault(&error))),
            };
            match guest
                .bumpless_control_free_run()
                .call_describe_program(&mut store)
                .await
            {
                Ok(said) => Ok(ProgramInfo {
                    name: said.name,
                    version: said.version,
                    text: cut(&said.text),
                }),
                Err(error) => Err(Error::Describe(store.data().fault(&error))),
            }
        }),
        usage,
        beats: shared.beats.clone(),
    };
    let mut asked = pin!(asked);
    loop {
        if let Poll::Ready(said) = asked.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            return said;
        }
    }
}

/// Polls of programs that run now, as the ticker sees them. Cheap to clone.
#[derive(Debug, Clone, Default)]
pub(crate) struct Beats(Arc<Seen>);

#[derive(Debug, Default)]
struct Seen {
    running: AtomicU64,
    begun: AtomicU64,
    asleep: AtomicBool,
    ticker: Mutex<Option<std::thread::Thread>>,
}

/// A poll, until it is dropped.
pub(crate) struct Beating<'a>(&'a Seen);

impl Drop for Beating<'_> {
    fn drop(&mut self) {
        self.0.running.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Beats {
    /// A poll begins.
    pub(crate) fn begin(&self) -> Beating<'_> {
        let seen = &*self.0;
        seen.running.fetch_add(1, Ordering::SeqCst);
        seen.begun.fetch_add(1, Ordering::Relaxed);
        if seen.asleep.load(Ordering::SeqCst) {
            seen.wake();
        }
        Beating(seen)
    }
}

impl Seen {
    fn wake(&self) {
        let ticker = self.ticker.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(ticker) = ticker.as_ref() {
            ticker.unpark();
        }
    }
}

/// Advances the epoch; ends when dropped.
struct Ticker {
    stop: Arc<AtomicBool>,
    beats: Beats,
    thread: Option<JoinHandle<()>>,
}

impl Ticker {
    fn start(engine: wasmtime::Engine, beats: Beats) -> Result<Self, Error> {
        let stop = Arc::new(AtomicBool::new(false));
        let (stopped, seen) = (Arc::clone(&stop), beats.clone());
        let thread = std::thread::Builder::new()
            .name("bl-beats".to_owned())
            .stack_size(256 * 1024)
            .spawn(move || beat(&engine, &seen.0, &stopped))
            .map_err(Error::Thread)?;
        let ticker = Some(thread.thread().clone());
        *beats.0.ticker.lock().unwrap_or_else(PoisonError::into_inner) = ticker;
        Ok(Self {
            stop,
            beats,
            thread: Some(thread),
        })
    }
}

impl Drop for Ticker {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        self.beats.0.wake();
        if let Some(thread) = self.thread.take() {
            // A panic of the thread was already reported by the panic hook; there is nothing left to stop.
            drop(thread.join());
        }
    }
}

fn beat(engine: &wasmtime::Engine, seen: &Seen, stop: &AtomicBool) {
    let (mut begun, mut idle) = (0, 0);
    while !stop.load(Ordering::SeqCst) {
        if idle >= IDLE_BEATS {
            seen.asleep.store(true, Ordering::SeqCst);
            // Whoever begins after this look sees the flag; a wake-up before the wait is kept for it.
            if seen.running.load(Ordering::SeqCst) == 0 && !stop.load(Ordering::SeqCst) {
                std::thread::park();
            }
            seen.asleep.store(false, Ordering::SeqCst);
            idle = 0;
        }
        std::thread::sleep(BEAT);
        let now = seen.begun.load(Ordering::Relaxed);
        if seen.running.load(Ordering::SeqCst) > 0 {
            engine.increment_epoch();
            idle = 0;
        } else if now == begun {
            idle += 1;
        } else {
            idle = 0;
        }
        begun = now;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn epochs_pass_while_something_runs_and_a_sleeping_ticker_is_woken() {
        let engine = Profile::Program.runtime(0, &Limits::default(), false).unwrap();
        let beats = Beats::default();
        let ticker = Ticker::start(engine, beats.clone()).unwrap();
        while !beats.0.asleep.load(Ordering::SeqCst) {
            std::thread::yield_now();
        }
        let beating = beats.begin();
        while beats.0.asleep.load(Ordering::SeqCst) {
            std::thread::yield_now();
        }
        drop(beating);
        assert_eq!(beats.0.running.load(Ordering::SeqCst), 0);
        drop(ticker);
    }
}
