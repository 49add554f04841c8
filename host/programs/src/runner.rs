//! All programs that run on this host, and the threads that run them.
//!
//! Owns: one run per name, from its start until another one of the name begins; threads at low priority, apart from those of
//! cycles, of the API and of deployment. Never: starts anything by itself.

use std::{collections::BTreeMap, num::NonZeroUsize, sync::Arc};

use bumpless_core::{Fault, Message, ProgramId, ProgramSpec};
use bumpless_engine::PreparedProgram;
use parking_lot::Mutex;
use tokio::runtime::Runtime;

use crate::{Error, Exchange, Line, Reach, RunView, run::Run, timer::Timer};

/// Niceness of the programs' threads: whatever a host does for its cycles comes first.
const NICE: i32 = 10;
/// Threads at most: a program is no reason to take a whole large machine.
const THREADS_MAX: usize = 8;

/// A program that shall run.
pub struct Order {
    /// As it shall be.
    pub spec: ProgramSpec,
    /// Number of the ownership.
    pub term: u64,
    /// Its code.
    pub prepared: Arc<PreparedProgram>,
    /// What the last run saved.
    pub checkpoint: Option<Vec<u8>>,
    /// What it reaches of the cell.
    pub reach: Arc<dyn Reach>,
    /// It begins paused.
    pub paused: bool,
}

/// The programs of one host.
pub struct Runner {
    runs: Mutex<BTreeMap<ProgramId, Arc<Run>>>,
    exchange: Exchange,
    timer: Timer,
    runtime: Mutex<Option<Runtime>>,
}

impl Runner {
    /// Starts the threads: as many as half the processors, one at least.
    ///
    /// # Errors
    /// [`Error::Thread`].
    pub fn start() -> Result<Self, Error> {
        let processors = std::thread::available_parallelism().map_or(1, NonZeroUsize::get);
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads((processors / 2).clamp(1, THREADS_MAX))
            .thread_name("bl-programs")
            // The stack of guests is their fiber's.
            .thread_stack_size(1024 * 1024)
            .enable_time()
            .on_thread_start(|| {
                // On Linux this is the thread's own; without it programs are only less polite.
                if let Err(error) = rustix::process::setpriority_process(None, NICE) {
                    tracing::debug!(%error, "the priority of programs stays as it is");
                }
            })
            .build()
            .map_err(Error::Thread)?;
        Ok(Self {
            runs: Mutex::default(),
            exchange: Exchange::default(),
            timer: Timer::start()?,
            runtime: Mutex::new(Some(runtime)),
        })
    }

    /// The way of messages to programs.
    #[must_use]
    pub fn exchange(&self) -> &Exchange {
        &self.exchange
    }

    /// A message was said somewhere in the cell.
    pub fn say(&self, message: &Message) {
        self.exchange.say(message);
    }

    /// Runs a program. One of the name under an earlier term gives way.
    ///
    /// # Errors
    /// [`Error::Runs`] where it runs, or ran, under this term or a later one: a run that has ended is not begun again.
    pub fn run(&self, order: Order) -> Result<(), Error> {
        let Order {
            spec,
            term,
            prepared,
            checkpoint,
            reach,
            paused,
        } = order;
        let id = spec.id.clone();
        let memory_bytes_max = usize::try_from(spec.memory_bytes).unwrap_or(usize::MAX);
        let run = Arc::new(Run::new(spec, term, reach, self.timer.clone(), self.exchange.clone()));
        if paused {
            run.gate.pause(true);
        }
        {
            let mut runs = self.runs.lock();
            if let Some(before) = runs.get(&id) {
                if before.term >= term {
                    return Err(Error::Runs(id, before.term));
                }
                before.gate.end();
            }
            runs.insert(id, Arc::clone(&run));
        }
        let runtime = self.runtime.lock();
        let Some(runtime) = runtime.as_ref() else {
            run.end(Err(Fault::Failed("the host stops".to_owned())));
            return Ok(());
        };
        runtime.spawn(async move {
            run.gate.pass().await;
            let surroundings: Arc<dyn bumpless_engine::Surroundings> = Arc::clone(&run) as _;
            let work = prepared.run(surroundings, Arc::clone(&run.usage), memory_bytes_max, checkpoint);
            let end = tokio::select! {
                biased;
                () = run.gate.ended() => Ok(()),
                end = work => end,
            };
            if let Err(fault) = &end {
                tracing::warn!(program = %run.spec.id, %fault, "a program is in fault");
            }
            run.end(end);
        });
        Ok(())
    }

    /// Lets what runs under a term stand where it is, or go on.
    ///
    /// # Errors
    /// [`Error::NotHere`].
    pub fn pause(&self, id: &ProgramId, term: u64, paused: bool) -> Result<(), Error> {
        let run = self.runs.lock().get(id).filter(|run| run.term == term).cloned();
        run.ok_or_else(|| Error::NotHere(id.clone()))?.gate.pause(paused);
        Ok(())
    }

    /// Ends what runs under this term or an earlier one; nothing where there is no such run. It writes and says nothing more from
    /// now on, and is gone at its next wait, or within a few ms of running.
    pub fn stop(&self, id: &ProgramId, term: u64) {
        let run = self.runs.lock().get(id).filter(|run| run.term <= term).cloned();
        if let Some(run) = run {
            run.gate.end();
            run.end(Ok(()));
        }
    }

    /// The same, and forgets it with its lines.
    pub fn forget(&self, id: &ProgramId, term: u64) {
        self.stop(id, term);
        let mut runs = self.runs.lock();
        if runs.get(id).is_some_and(|run| run.term <= term) {
            runs.remove(id);
        }
    }

    /// How a program is; none where none of the name ran here.
    #[must_use]
    pub fn view(&self, id: &ProgramId) -> Option<RunView> {
        self.runs.lock().get(id).map(|run| run.view())
    }

    /// How all are, by name.
    #[must_use]
    pub fn views(&self) -> Vec<RunView> {
        self.runs.lock().values().map(|run| run.view()).collect()
    }

    /// Lines of a program after one of that number, the newest so many, oldest first.
    #[must_use]
    pub fn lines(&self, id: &ProgramId, after: u64, max: usize) -> Vec<Line> {
        self.runs
            .lock()
            .get(id)
            .map_or_else(Vec::new, |run| run.lines(after, max))
    }

    /// Ends all runs and the threads. Does not wait for runs: they are dropped where they stand.
    pub fn close(&self) {
        for run in self.runs.lock().values() {
            run.gate.end();
            run.end(Ok(()));
        }
        let runtime = self.runtime.lock().take();
        if let Some(runtime) = runtime {
            runtime.shutdown_background();
        }
        self.timer.close();
    }
}

impl Drop for Runner {
    fn drop(&mut self) {
        self.close();
    }
}

impl std::fmt::Debug for Runner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Runner")
            .field("runs", &self.runs.lock().len())
            .finish_non_exhaustive()
    }
}
