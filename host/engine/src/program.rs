//! Free-running programs in the sandbox: what one says of itself, what it may ask its host for, and its run.
//!
//! Owns: the calls of the world `program`, their bounds, and the measure of processor time that a program uses.
//! Never: waits by itself, or knows a runtime: what a program waits for are futures of its [`Surroundings`], and whoever polls
//! the run decides on which thread it goes on.
//!
//! ```text
//!            ┌──────────── the guest runs ───────────┐ every ms that it does: Surroundings::turn
//!  run ──────┤                                       ├── Go ──► on
//!            │ waits (sleep, read, write, publish …) ├── Wait(future) ──► the thread is free ──► on
//!            └───────────────────────────────────────┴── Stop ──► Fault
//!  the future is dropped at any of these waits: the program is gone
//! ```

mod imports;
mod nowhere;

pub(crate) use nowhere::Nowhere;

use std::{
    fmt,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    task::{Context, Poll},
};

use bumpless_core::{Digest, Fault, LogLevel, Message, Mode, Reading};
use wasmtime::{ResourceLimiter, Store, Trap, UpdateDeadline, WasmBacktrace};

use crate::{
    Error, convert,
    programs::{Beats, Code},
    sandbox::{CALL_BYTES_MAX, CORE_INSTANCES_MAX, MEMORIES_MAX, Stop, TABLES_MAX, cut, thread_time_ns},
    script::Script,
};

/// Something that comes later.
pub type Later<'a, T> = Pin<Box<dyn Future<Output = T> + Send + 'a>>;

/// An answer that is there, or comes later.
pub enum Answer<'a, T> {
    /// At once: the guest goes on without giving its thread away.
    Now(T),
    /// Later.
    Later(Later<'a, T>),
}

impl<T> Answer<'_, T> {
    async fn come(self) -> T {
        match self {
            Self::Now(value) => value,
            Self::Later(later) => later.await,
        }
    }
}

/// How a guest that runs shall go on.
pub enum Turn {
    /// As before.
    Go,
    /// When this is over.
    Wait(Later<'static, ()>),
    /// Not at all.
    Stop(Fault),
}

/// A point that a program is granted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProgramSlot {
    /// The program's name for it.
    pub name: String,
    /// May it be written?
    pub writable: bool,
    /// Unit as text.
    pub unit: String,
}

/// What a point shows now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// The reading.
    pub reading: Reading,
    /// Age of its value, in ns.
    pub age_ns: u64,
}

/// A step of another component.
#[derive(Debug, Clone, PartialEq)]
pub struct Question {
    /// The component, by reference.
    pub component: String,
    /// Parameters that differ from their defaults.
    pub parameters: Vec<(String, f64)>,
    /// What the step before gave.
    pub state: Option<Vec<u8>>,
    /// What the input ports read.
    pub inputs: Vec<(String, f64)>,
    /// What the output ports hold.
    pub track: Vec<(String, f64)>,
    /// Wanted value.
    pub setpoint: f64,
    /// Who decides the output.
    pub mode: Mode,
    /// Time since the step before, in ns.
    pub dt_ns: u64,
}

/// What such a step gave.
#[derive(Debug, Clone, PartialEq)]
pub struct Reply {
    /// For the next one.
    pub state: Vec<u8>,
    /// Output ports.
    pub outputs: Vec<(String, f64)>,
}

/// Everything that a program sees of the world. Called on the thread that polls its run; nothing here may block it.
pub trait Surroundings: Send + Sync {
    /// What it is granted, by number; at most 64.
    fn slots(&self) -> &[ProgramSlot];
    /// What a granted point shows now.
    fn read(&self, slot: usize) -> Answer<'_, Sight>;
    /// Writes a granted point that is writable; the refusal is in words.
    fn write(&self, slot: usize, value: f64) -> Answer<'_, Result<(), String>>;
    /// The steady clock, in ns.
    fn now_ns(&self) -> u64;
    /// Waits until then.
    fn sleep_until(&self, time_ns: u64) -> Later<'_, ()>;
    /// Publishes; the refusal is in words.
    fn publish(&self, message: Message) -> Answer<'_, Result<(), String>>;
    /// Keeps the newest so many messages of a topic from now on.
    fn listen(&self, topic: String, depth: usize) -> Result<(), String>;
    /// Listens to nothing.
    fn forget(&self);
    /// The oldest message that waits.
    fn receive(&self) -> Option<Message>;
    /// As `receive`, waiting at most so long.
    fn wait(&self, timeout_ns: u64) -> Later<'_, Option<Message>>;
    /// A step of another component.
    fn step(&self, question: Question) -> Later<'_, Result<Reply, Fault>>;
    /// Keeps a checkpoint.
    fn save(&self, data: Vec<u8>) -> Later<'_, Result<(), String>>;
    /// Takes a line.
    fn log(&self, level: LogLevel, text: String);
    /// Asked about every ms for as long as the guest runs. `used_ns` is its processor time so far.
    fn turn(&self, used_ns: u64) -> Turn;
}

/// Processor time of one run, in ns; read from anywhere.
#[derive(Debug, Default)]
pub struct Usage {
    done_ns: AtomicU64,
    /// The thread's processor time when the present poll began.
    from_ns: AtomicU64,
    memory_bytes: AtomicU64,
}

impl Usage {
    /// Processor time of all polls that are over.
    #[must_use]
    pub fn used_ns(&self) -> u64 {
        self.done_ns.load(Ordering::Relaxed)
    }

    /// Linear memory that the guest has, in bytes.
    #[must_use]
    pub fn memory_bytes(&self) -> u64 {
        self.memory_bytes.load(Ordering::Relaxed)
    }

    /// With the present poll; on its own thread only.
    fn used_now_ns(&self) -> u64 {
        self.used_ns() + thread_time_ns().saturating_sub(self.from_ns.load(Ordering::Relaxed))
    }
}

/// What a program says of itself, checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProgramInfo {
    /// Short name.
    pub name: String,
    /// Semantic version.
    pub version: String,
    /// One line for people.
    pub text: String,
}

impl ProgramInfo {
    pub(crate) fn check(&self) -> Result<(), Error> {
        let good = (1..=32).contains(&self.name.len())
            && self
                .name
                .bytes()
                .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
        if !good {
            return Err(Error::ProgramInfo {
                reason: format!(
                    "name {:?}: use 1 to 32 lower-case letters, digits and dashes",
                    cut(&self.name)
                ),
            });
        }
        if !(1..=32).contains(&self.version.len()) {
            return Err(Error::ProgramInfo {
                reason: "the version must have 1 to 32 characters".to_owned(),
            });
        }
        Ok(())
    }
}

/// A program, ready to run: code that may be shared with others, and its script.
pub struct PreparedProgram {
    pub(crate) code: Arc<Code>,
    pub(crate) digest: Digest,
    pub(crate) info: ProgramInfo,
    pub(crate) script: Option<Script>,
}

impl PreparedProgram {
    /// The digest of its bytes, with the script.
    #[must_use]
    pub const fn digest(&self) -> &Digest {
        &self.digest
    }

    /// What it says of itself; with a script, what that is called.
    #[must_use]
    pub const fn info(&self) -> &ProgramInfo {
        &self.info
    }

    /// Its script, where it is an interpreter with one.
    #[must_use]
    pub const fn script(&self) -> Option<&Script> {
        self.script.as_ref()
    }

    /// Interfaces that it imports, in its own order.
    #[must_use]
    pub fn imports(&self) -> &[String] {
        &self.code.imports
    }

    /// Runs until the guest returns or does wrong. Dropped, it ends at its present wait. `memory_bytes_max` is its bound of
    /// linear memory, at most the engine's own.
    ///
    /// # Errors
    /// The guest's fault: its own words, a trap, a limit, or what [`Surroundings::turn`] stopped it with.
    pub async fn run(
        self: Arc<Self>,
        surroundings: Arc<dyn Surroundings>,
        usage: Arc<Usage>,
        memory_bytes_max: usize,
        checkpoint: Option<Vec<u8>>,
    ) -> Result<(), Fault> {
        let code = &self.code;
        let _place = code
            .shared
            .places
            .take(code.weight)
            .map_err(|error| Fault::Limit(error.to_string()))?;
        let memory_bytes_max = memory_bytes_max.min(code.shared.limits.memory_bytes_max);
        let ground = Ground::new(
            surroundings,
            Arc::clone(&usage),
            memory_bytes_max,
            code.shared.limits.table_elements_max,
        );
        let work = Box::pin(async {
            let mut store = code.store(ground);
            let guest = match code.pre.instantiate_async(&mut store).await {
                Ok(guest) => guest,
                Err(error) => return Err(store.data().fault(&error)),
            };
            let script = self.script.as_ref().map_or(&[][..], |script| &script.text);
            let called = guest
                .bumpless_control_free_run()
                .call_run(&mut store, script, checkpoint.as_deref())
                .await;
            match called {
                Ok(said) => said.map_err(|fault| convert::fault(&fault)),
                Err(error) => Err(store.data().fault(&error)),
            }
        });
        Metered {
            work,
            usage,
            beats: code.shared.beats.clone(),
        }
        .await
    }
}

impl fmt::Debug for PreparedProgram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PreparedProgram")
            .field("info", &self.info)
            .field("digest", &self.digest)
            .finish_non_exhaustive()
    }
}

/// A future whose polls are measured, and during which epochs pass.
pub(crate) struct Metered<'a, T> {
    pub(crate) work: Later<'a, T>,
    pub(crate) usage: Arc<Usage>,
    pub(crate) beats: Beats,
}

impl<T> Future for Metered<'_, T> {
    type Output = T;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<T> {
        let this = &mut *self;
        let from_ns = thread_time_ns();
        this.usage.from_ns.store(from_ns, Ordering::Relaxed);
        let beating = this.beats.begin();
        let polled = this.work.as_mut().poll(context);
        drop(beating);
        let used_ns = thread_time_ns().saturating_sub(from_ns);
        this.usage.done_ns.fetch_add(used_ns, Ordering::Relaxed);
        polled
    }
}

/// Data of a program's store.
pub(crate) struct Ground {
    pub(crate) surroundings: Arc<dyn Surroundings>,
    usage: Arc<Usage>,
    memory_bytes_max: usize,
    table_elements_max: usize,
    refused: Option<String>,
}

impl Ground {
    pub(crate) fn new(
        surroundings: Arc<dyn Surroundings>,
        usage: Arc<Usage>,
        memory_bytes_max: usize,
        table_elements_max: usize,
    ) -> Self {
        Self {
            surroundings,
            usage,
            memory_bytes_max,
            table_elements_max,
            refused: None,
        }
    }

    /// At an epoch, while the guest runs.
    pub(crate) fn beat(&self) -> wasmtime::Result<UpdateDeadline> {
        match self.surroundings.turn(self.usage.used_now_ns()) {
            Turn::Go => Ok(UpdateDeadline::Continue(1)),
            Turn::Wait(until) => Ok(UpdateDeadline::YieldCustom(1, until)),
            Turn::Stop(fault) => stop(fault),
        }
    }

    /// What an engine error means.
    pub(crate) fn fault(&self, error: &wasmtime::Error) -> Fault {
        if let Some(Stop(fault)) = error.downcast_ref::<Stop>() {
            return fault.clone();
        }
        if let Some(refused) = &self.refused {
            return Fault::Limit(refused.clone());
        }
        let root = error.root_cause().to_string();
        // wasmtime keeps this error's type to itself, so its text is all there is to know it by.
        if root.contains("fuel allocated for hostcalls") {
            return Fault::Limit(format!("one call moved more than {CALL_BYTES_MAX} bytes to the host"));
        }
        let cause = error.downcast_ref::<Trap>().map_or(root, ToString::to_string);
        let cause = cause.strip_prefix("wasm trap: ").unwrap_or(&cause);
        let place = error
            .downcast_ref::<WasmBacktrace>()
            .and_then(|trace| trace.frames().iter().find_map(wasmtime::FrameInfo::func_name))
            .map(|name| format!(" in {name}"))
            .unwrap_or_default();
        Fault::Trap(cut(&format!("{cause}{place}")))
    }

    fn slot(&self, slot: u32) -> wasmtime::Result<usize> {
        let slots = self.surroundings.slots().len();
        match usize::try_from(slot) {
            Ok(number) if number < slots => Ok(number),
            _ => stop(Fault::Failed(format!(
                "slot {slot} is not there: the program is granted {slots} points"
            ))),
        }
    }
}

fn stop<T>(fault: Fault) -> wasmtime::Result<T> {
    Err(wasmtime::Error::new(Stop(fault)))
}

impl ResourceLimiter for Ground {
    fn memory_growing(&mut self, _current: usize, desired: usize, _maximum: Option<usize>) -> wasmtime::Result<bool> {
        let max = self.memory_bytes_max;
        let fits = desired <= max;
        if fits {
            self.usage.memory_bytes.store(desired as u64, Ordering::Relaxed);
        } else {
            self.refused = Some(format!(
                "it asked for {desired} bytes of memory; at most {max} are given"
            ));
        }
        Ok(fits)
    }

    fn table_growing(&mut self, _current: usize, desired: usize, _maximum: Option<usize>) -> wasmtime::Result<bool> {
        let max = self.table_elements_max;
        let fits = desired <= max;
        if !fits {
            self.refused = Some(format!(
                "it asked for a table of {desired} elements; at most {max} are given"
            ));
        }
        Ok(fits)
    }

    fn instances(&self) -> usize {
        CORE_INSTANCES_MAX
    }

    fn tables(&self) -> usize {
        TABLES_MAX
    }

    fn memories(&self) -> usize {
        MEMORIES_MAX
    }
}

/// A store within its bounds.
pub(crate) fn store(engine: &wasmtime::Engine, ground: Ground) -> Store<Ground> {
    let mut store = Store::new(engine, ground);
    store.limiter(|ground| ground);
    store.set_hostcall_fuel(CALL_BYTES_MAX);
    store.epoch_deadline_callback(|context| context.data().beat());
    store.set_epoch_deadline(1);
    store
}
