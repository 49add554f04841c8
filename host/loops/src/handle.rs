//! What other rooms may ask of the loops: a cheap handle; every call hands an event to the loop's worker and returns.
//!
//! The inboxes are bounded. A full one drops messages of the bus, which then show as silence and are counted; a change that
//! somebody waits for is answered with [`Error::Busy`] or by its dropped reply.

use std::{
    hash::{DefaultHasher, Hash, Hasher},
    num::NonZeroU64,
    sync::{
        Arc, OnceLock,
        atomic::{AtomicI64, AtomicU64, Ordering},
    },
    thread::JoinHandle,
};

use bumpless_cell::{Arrival, Vitals};
use bumpless_core::{Command, CommandId, Digest, Fault, Frame, HostId, LoopId, Record, Strategy, limits::REPLICAS_MAX};
use bumpless_engine::{Engine, Instance};
use bumpless_io::{Clock, IoServer};
use parking_lot::{Mutex, RwLock};

use crate::{
    error::Error,
    event::{CallEnd, CallRequest, CommandReply, Event, HeldRevision, HomeRevision, LoopsEvent, Opening},
    home::HomeView,
    inbox::{self, Sender},
    replicas::Replicas,
    shared::Shared,
    testing::FlipBits,
    wire::Wire,
    worker::Worker,
};

/// Events that may wait for one worker: half a second of 100,000 messages a second, more than a host can step.
const INBOX_MAX: usize = 65_536;
/// Instances that may wait to be dropped.
const REAPER_MAX: usize = 4096;

/// How loops are run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Config {
    /// Worker threads, 1 to 64. More than the processors keeps one misbehaving component from holding up the rest.
    pub workers: usize,
    /// A test device: every so-manieth step of this host comes out with a bit turned over. None in service.
    pub flip_bits_every: Option<NonZeroU64>,
}

impl Default for Config {
    fn default() -> Self {
        let processors = std::thread::available_parallelism().map_or(2, usize::from);
        Self {
            workers: (2 * processors).clamp(2, 16),
            flip_bits_every: None,
        }
    }
}

struct Inner {
    shared: Arc<Shared>,
    inboxes: Vec<Sender<Event>>,
    views: RwLock<std::collections::HashMap<LoopId, Arc<Mutex<HomeView>>>>,
    threads: Mutex<Vec<JoinHandle<()>>>,
    next_call: AtomicU64,
}

/// The loops of this host.
#[derive(Clone)]
pub struct Loops {
    inner: Arc<Inner>,
}

impl Loops {
    /// Starts the worker threads. `io` is none on a host without points; `sink` must not block.
    pub fn start(
        config: &Config,
        here: HostId,
        clock: Clock,
        io: Option<Arc<IoServer>>,
        engine: Engine,
        wire: Arc<dyn Wire>,
        sink: Arc<dyn Fn(LoopsEvent) + Send + Sync>,
    ) -> Result<Self, Error> {
        let (reaper, graves) = crossbeam_channel::bounded::<Instance>(REAPER_MAX);
        let shared = Arc::new(Shared {
            here,
            clock,
            io,
            engine,
            wire,
            sink,
            replicas: Replicas::default(),
            reaper,
            owned: AtomicI64::new(0),
            held: AtomicI64::new(0),
            dropped: AtomicU64::new(0),
            turns: (0..config.workers.clamp(1, 64))
                .map(|_| AtomicU64::new(clock.now_ns()))
                .collect(),
            flip_bits: config.flip_bits_every.map(FlipBits::new),
            inboxes: OnceLock::new(),
        });
        // Ends by itself when the last worker, and with it the last sender, is gone.
        std::thread::Builder::new()
            .name("loops-reaper".to_owned())
            .spawn(move || graves.into_iter().for_each(drop))
            .map_err(Error::Thread)?;
        let (mut inboxes, mut threads) = (Vec::new(), Vec::new());
        for index in 0..config.workers.clamp(1, 64) {
            let (inbox, events) = inbox::bounded(INBOX_MAX);
            let worker = Worker::new(index, Arc::clone(&shared), events);
            let thread = std::thread::Builder::new()
                .name(format!("loops-{index}"))
                .spawn(move || worker.run())
                .map_err(Error::Thread)?;
            inboxes.push(inbox);
            threads.push(thread);
        }
        // The workers keep each other's inboxes, so they end by the stop event and not by a lost sender.
        drop(shared.inboxes.set(inboxes.clone()));
        Ok(Self {
            inner: Arc::new(Inner {
                shared,
                inboxes,
                views: RwLock::default(),
                threads: Mutex::new(threads),
                next_call: AtomicU64::new(0),
            }),
        })
    }

    fn place(&self, id: &LoopId) -> usize {
        let mut hasher = DefaultHasher::new();
        id.hash(&mut hasher);
        (hasher.finish() % self.inner.inboxes.len() as u64) as usize
    }

    /// From the bus: a full inbox drops it, and the silence is noticed by whoever waits.
    fn offer(&self, index: usize, event: Event) {
        let Some(inbox) = self.inner.inboxes.get(index) else {
            return;
        };
        if inbox.try_send(event).is_err() {
            self.inner.shared.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// From deployment: tells whether it was taken.
    fn hand(&self, id: &LoopId, event: Event) -> Result<(), Error> {
        self.inner.inboxes[self.place(id)]
            .try_send(event)
            .map_err(|_| Error::Busy)
    }

    /// Takes what is the loops' from the bus, and gives back what is not. Never blocks.
    pub fn arrive(&self, arrival: Arrival) -> Option<Arrival> {
        match arrival {
            Arrival::Sample(sample) => self.offer(self.place(&sample.loop_id), Event::Sample(sample)),
            Arrival::Answer { answer, .. } => {
                let index = self.place(answer.loop_id());
                self.offer(index, Event::Answer(answer));
            }
            Arrival::Record(record) => {
                self.record(&record);
                return Some(Arrival::Record(record));
            }
            Arrival::StepRequest(request) => {
                let index = if crate::calls::is_call(&request.loop_id) {
                    request.correlation as usize % self.inner.inboxes.len()
                } else {
                    self.place(&request.loop_id)
                };
                self.offer(index, Event::StepRequest(request));
            }
            Arrival::StepAnswer(answer) => self.offer((answer.correlation >> 56) as usize, Event::StepAnswer(answer)),
            Arrival::Ping { from, token } => {
                let index = token as usize % self.inner.inboxes.len();
                self.offer(index, Event::Ping { from, token });
            }
            Arrival::Pong { from, token } => {
                self.inner
                    .shared
                    .replicas
                    .probed(&from, token, self.inner.shared.now_ns());
            }
            Arrival::HostDown(host) => {
                self.host_gone(&host);
                return Some(Arrival::HostDown(host));
            }
            other => return Some(other),
        }
        None
    }

    fn record(&self, record: &Arc<Record>) {
        let of_loop = self.place(&record.loop_id);
        for index in 0..self.inner.inboxes.len() {
            // Messages may be for homes anywhere; everything else is the loop's own.
            if index == of_loop || !record.messages.is_empty() {
                self.offer(index, Event::Record(Arc::clone(record)));
            }
        }
    }

    /// Starts the schedule of a loop whose points this host serves. `last` is the record to go on from.
    pub fn open_home(&self, revision: HomeRevision, last: Option<Arc<Record>>) -> Result<(), Error> {
        self.check_points(&revision)?;
        let id = revision.spec.id.clone();
        let view = Arc::new(Mutex::new(HomeView::default()));
        self.hand(
            &id,
            Event::OpenHome(Box::new(Opening {
                revision,
                last,
                view: Arc::clone(&view),
            })),
        )?;
        self.inner.views.write().insert(id, view);
        Ok(())
    }

    /// Makes a further revision known to the home: its readings ride along, and a commit under it is understood.
    pub fn add_home_revision(&self, revision: HomeRevision) -> Result<(), Error> {
        self.check_points(&revision)?;
        let id = revision.spec.id.clone();
        self.hand(&id, Event::AddHomeRevision(Box::new(revision)))
    }

    fn check_points(&self, revision: &HomeRevision) -> Result<(), Error> {
        let Some(io) = &self.inner.shared.io else {
            return Err(Error::NoIo(self.inner.shared.here.clone()));
        };
        match revision.wiring.points.iter().flatten().find(|p| io.index(p).is_none()) {
            Some(point) => Err(Error::NoSuchPoint {
                loop_id: revision.spec.id.clone(),
                point: point.clone(),
            }),
            None => Ok(()),
        }
    }

    /// Ends the schedule; the outputs stay as they are.
    pub fn close_home(&self, id: &LoopId) -> Result<(), Error> {
        self.inner.views.write().remove(id);
        self.hand(id, Event::CloseHome(id.clone()))
    }

    /// Tells the home which live hosts hold the loop, best first; at most [`REPLICAS_MAX`] count.
    pub fn set_members(&self, id: &LoopId, mut members: Vec<HostId>) -> Result<(), Error> {
        members.truncate(REPLICAS_MAX);
        self.hand(id, Event::Members(id.clone(), members))
    }

    /// Hands a command to the loop's home here. `reply` is called once, from the loop's worker, when a record holds the
    /// outcome and outlives this host: a member has it, or [`Loops::kept`] says that the disk has. It is dropped uncalled where the command was withdrawn or the host stops.
    pub fn command(
        &self,
        id: &LoopId,
        command: Command,
        reply: Box<dyn FnOnce(CommandReply) + Send>,
    ) -> Result<(), Error> {
        self.hand(id, Event::Command(id.clone(), Box::new(command), reply))
    }

    /// A record of a loop at home here, at this position or a later one, is on this host's disk: the outcomes up to it may be
    /// told. Members tell of theirs by themselves.
    pub fn kept(&self, id: &LoopId, position: (u64, u64)) -> Result<(), Error> {
        self.hand(id, Event::Kept(id.clone(), position))
    }

    /// Takes a command back; `reply` says whether it was still waiting. False: it may take effect with the next record.
    pub fn withdraw(&self, id: &LoopId, command: CommandId, reply: Box<dyn FnOnce(bool) + Send>) -> Result<(), Error> {
        self.hand(id, Event::Withdraw(id.clone(), command, reply))
    }

    /// Moves the ownership to a member, between two cycles.
    pub fn move_to(&self, id: &LoopId, host: HostId) -> Result<(), Error> {
        self.hand(id, Event::MoveTo(id.clone(), host))
    }

    /// This revision can be stepped here from now on; it replaces one of the same number.
    pub fn hold(&self, revision: HeldRevision) -> Result<(), Error> {
        let id = revision.spec.id.clone();
        self.hand(&id, Event::Hold(Box::new(revision)))
    }

    /// Lets go of all revisions but these, what is in force, and what a probation may go back to.
    pub fn keep_revisions(&self, id: &LoopId, keep: Vec<u64>) -> Result<(), Error> {
        self.hand(id, Event::KeepRevisions(id.clone(), keep))
    }

    /// The loop is no longer held here.
    pub fn release(&self, id: &LoopId) -> Result<(), Error> {
        self.hand(id, Event::Release(id.clone()))
    }

    /// What selection needs to know of a host.
    pub fn set_host(&self, vitals: &Vitals) {
        self.inner
            .shared
            .replicas
            .seen(&vitals.host, vitals.roles.control, vitals.cpu, &vitals.ready);
    }

    /// A host is gone: homes and cycles look elsewhere at once.
    pub fn host_gone(&self, host: &HostId) {
        self.inner.shared.replicas.gone(host);
        for index in 0..self.inner.inboxes.len() {
            self.offer(index, Event::HostGone(host.clone()));
        }
    }

    /// Steps a component on a replica chosen by the strategy. `reply` is called once, from a worker.
    pub fn call(
        &self,
        digest: Digest,
        strategy: Strategy,
        frame: Frame,
        state: Arc<[u8]>,
        limit_ns: u64,
        reply: Box<dyn FnOnce(Result<CallEnd, Fault>) + Send>,
    ) -> Result<(), Error> {
        let turn = self.inner.next_call.fetch_add(1, Ordering::Relaxed) as usize % self.inner.inboxes.len();
        let request = CallRequest {
            digest,
            strategy,
            frame,
            state,
            limit_ns,
            reply,
        };
        self.inner.inboxes[turn]
            .try_send(Event::Call(Box::new(request)))
            .map_err(|_| Error::Busy)
    }

    /// What a home here looks like now.
    #[must_use]
    pub fn home_view(&self, id: &LoopId) -> Option<HomeView> {
        self.inner.views.read().get(id).map(|view| view.lock().clone())
    }

    /// Smoothed latency of steps and probes to a host, in ns.
    #[must_use]
    pub fn latency_ns(&self, host: &HostId) -> Option<u64> {
        self.inner.shared.replicas.latency_ns(host)
    }

    /// Loops whose latest record names this host as owner.
    #[must_use]
    pub fn owned(&self) -> u32 {
        u32::try_from(self.inner.shared.owned.load(Ordering::Relaxed)).unwrap_or(0)
    }

    /// Loops that this host holds.
    #[must_use]
    pub fn held(&self) -> u32 {
        u32::try_from(self.inner.shared.held.load(Ordering::Relaxed)).unwrap_or(0)
    }

    /// Messages that were dropped because an inbox was full.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.inner.shared.dropped.load(Ordering::Relaxed)
    }

    /// For how long the worker that came round longest ago has not, in ns. One that has nothing to do comes round each second; one
    /// that hangs does not, and its loops run no cycles.
    #[must_use]
    pub fn longest_turn_ns(&self) -> u64 {
        let shared = &self.inner.shared;
        let now_ns = shared.now_ns();
        let since = |turn: &AtomicU64| now_ns.saturating_sub(turn.load(Ordering::Relaxed));
        shared.turns.iter().map(since).max().unwrap_or(0)
    }

    /// Stops the workers and waits for them, at most two seconds. Blocks.
    pub fn stop(&self) {
        for inbox in &self.inner.inboxes {
            inbox.send_first(Event::Stop);
        }
        for thread in self.inner.threads.lock().drain(..) {
            let name = thread.thread().name().unwrap_or("?").to_owned();
            if thread.join().is_err() {
                tracing::error!(thread = name, "a worker ended with a panic");
            }
        }
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // The workers hold each other's inboxes, so without this they would outlive the last handle.
        for inbox in &self.inboxes {
            inbox.send_first(Event::Stop);
        }
    }
}
