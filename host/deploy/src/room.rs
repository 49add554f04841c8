//! What the parts of deployment share on one host, and the tasks that keep it going.
//!
//! ```text
//! start ──► running: vitals five times a second or less, reconcile every second or when poked, notices as they come
//!              │ shutdown: draining, others take over
//!              ▼
//!           stopped: tasks end, requests are refused
//! ```
//! Never: runs on a cycle's thread.

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use bumpless_cell::{Arrival, Probe, Roles, Session, Vitals};
use bumpless_core::{CommandId, Digest, HostId, LoopId, PointId};
use bumpless_engine::Engine;
use bumpless_io::{Clock, IoServer};
use bumpless_loops::LoopsEvent;
use bumpless_store::{Archive, CycleLog, RecordWriter, Store};
use bumpless_trust::PublicKey;
use parking_lot::Mutex;
use tokio::{
    runtime::Handle,
    sync::{Notify, Semaphore, mpsc, watch},
    time::timeout,
};

use crate::{
    access::Keyring,
    alarms::Alarms,
    audit::Audit,
    beat::every,
    bench::Bench,
    book::Book,
    commissioning::Commissioning,
    drain,
    error::{Error, Words, chain},
    feed::Feed,
    field::Field,
    health::Disk,
    holder::Holder,
    home::Homes,
    library::Library,
    limits::{CHANGES_MAX, NOTICES_WAITING_MAX, RECONCILE_EVERY, REHEARSALS_MAX, SENDING_MAX, UPLOADS_MAX},
    programs::Programs,
    rollout::ledger::Ledger,
    roster::Roster,
    self_watch::{HostAlarms, SelfWatch},
    shadows::Shadows,
    signing::Signing,
    telling::LastTold,
    terms::Terms,
    webhook::{self, WebhookConfig, Webhooks},
    wire::{self, Ask, Notice, Told},
};

/// What deployment works with. The composition root makes it.
pub struct Parts {
    /// The bus.
    pub session: Session,
    /// The disk.
    pub store: Store,
    /// Writes last records behind the cycle. Whoever made it closes it.
    pub writer: Arc<RecordWriter>,
    /// Keeps every cycle of the loops at home here; none to keep none. Whoever made it closes it.
    pub cycles: Option<Arc<CycleLog>>,
    /// Keeps thinned history of the loops that are at home or held here; none to keep none. Ends with the last who has it.
    pub archive: Option<Arc<Archive>>,
    /// Points of this host of which history is kept, whether a loop uses them or not.
    pub history_points: Vec<PointId>,
    /// The sandbox. Every host has one, because every host takes uploads.
    pub engine: Engine,
    /// The points of this host, if it serves any.
    pub io: Option<Arc<IoServer>>,
    /// The host's steady clock.
    pub clock: Clock,
    /// The loops.
    pub field: Arc<dyn Field>,
    /// What this host offers the cell.
    pub roles: Roles,
    /// Where its API listens.
    pub api: Option<String>,
    /// Words that it goes by besides its name, for what loops prefer.
    pub labels: Vec<String>,
    /// Version of the program.
    pub version: String,
    /// Bytes on disk for the audit trail, within [`bumpless_store::AUDIT_BYTES_MAX`].
    pub audit_bytes_max: u64,
    /// Who is told of alarms; at most [`crate::limits::WEBHOOKS_MAX`].
    pub webhooks: Vec<WebhookConfig>,
    /// From when on the host's own clock and disk are alarms.
    pub host_alarms: HostAlarms,
    /// Root keys of which one must sign the first document of trust; any may, where none is named.
    pub trust_roots: Vec<PublicKey>,
    /// Must everybody who asks the API say who he is?
    pub secured: bool,
}

/// What reaches deployment.
#[derive(Debug)]
pub enum DeployArrival {
    /// From the bus: what the loops did not take.
    Bus(Arrival),
    /// From the loops.
    Loops(LoopsEvent),
}

/// The comparisons of copies with other hosts.
#[derive(Debug, Default)]
pub(crate) struct Comparing {
    /// Hosts that are being compared with now.
    pub(crate) now: HashSet<HostId>,
    /// The marks of both sides, joined, after the last whole comparison: the same again need not be compared.
    pub(crate) done: BTreeMap<HostId, (u64, u64)>,
}

/// Counts that only grow.
#[derive(Debug, Default)]
pub(crate) struct Tallies {
    pub(crate) uploads: AtomicU64,
    pub(crate) uploads_refused: AtomicU64,
    pub(crate) applies: AtomicU64,
    pub(crate) applies_refused: AtomicU64,
    pub(crate) fetches: AtomicU64,
    pub(crate) fetches_failed: AtomicU64,
    pub(crate) fetches_corrupt: AtomicU64,
    pub(crate) prepares_failed: AtomicU64,
    pub(crate) requests: AtomicU64,
    pub(crate) malformed: AtomicU64,
    pub(crate) arrivals_dropped: AtomicU64,
}

/// Adds one. Counts order nothing, so relaxed is enough.
pub(crate) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// One lock per loop, made when it is wanted.
#[derive(Debug, Default)]
pub(crate) struct Locks(Mutex<HashMap<LoopId, Arc<tokio::sync::Mutex<()>>>>);

impl Locks {
    pub(crate) fn of(&self, id: &LoopId) -> Arc<tokio::sync::Mutex<()>> {
        let mut locks = self.0.lock();
        // Those that nobody has are forgotten, before there are many.
        if locks.len() >= 1024 {
            locks.retain(|_, lock| Arc::strong_count(lock) > 1);
        }
        Arc::clone(locks.entry(id.clone()).or_default())
    }
}

/// Everything that deployment has on one host.
pub(crate) struct Room {
    pub(crate) here: HostId,
    pub(crate) session: Session,
    pub(crate) store: Store,
    pub(crate) io: Option<Arc<IoServer>>,
    pub(crate) clock: Clock,
    pub(crate) field: Arc<dyn Field>,
    pub(crate) book: Book,
    pub(crate) library: Library,
    pub(crate) bench: Bench,
    pub(crate) signing: Signing,
    pub(crate) roster: Roster,
    pub(crate) feed: Feed,
    pub(crate) cycles: Option<Arc<CycleLog>>,
    pub(crate) archive: Option<Arc<Archive>>,
    pub(crate) shadows: Shadows,
    pub(crate) rollouts: Ledger,
    pub(crate) programs: Programs,
    pub(crate) alarms: Alarms,
    pub(crate) terms: Terms,
    pub(crate) audit: Audit,
    pub(crate) keyring: Keyring,
    pub(crate) webhooks: Webhooks,
    pub(crate) self_watch: SelfWatch,
    pub(crate) commissioning: Commissioning,
    /// Whether the disk takes writes, as it was when it was last tried.
    pub(crate) disk: Disk,
    /// Replays and backtests.
    pub(crate) rehearsals: Semaphore,
    pub(crate) holder: Holder,
    pub(crate) homes: Homes,
    pub(crate) tallies: Tallies,
    pub(crate) uploads: Semaphore,
    /// One trial at a time: each takes a core for as long as it lasts.
    pub(crate) trials: Semaphore,
    pub(crate) changes: Semaphore,
    /// Components on their way to other hosts.
    pub(crate) sending: Semaphore,
    /// Held while an upload is let in, so that two of one name do not pass at once.
    pub(crate) admission: tokio::sync::Mutex<()>,
    pub(crate) comparing: Mutex<Comparing>,
    pub(crate) own: Mutex<Vitals>,
    pub(crate) told: Mutex<LastTold>,
    draining: AtomicBool,
    /// The drain holds over a restart.
    pub(crate) drain_kept: AtomicBool,
    poke_homes: Notify,
    poke_holds: Notify,
    notices: mpsc::Sender<(HostId, Notice)>,
    stop: watch::Sender<bool>,
    runtime: Handle,
    ids: AtomicU64,
}

impl Room {
    /// Reads the disk, and starts the tasks on the runtime of the caller.
    pub(crate) fn start(parts: Parts) -> Result<Arc<Self>, Error> {
        let runtime = Handle::try_current().map_err(|error| Error::internal(error.to_string()))?;
        let probe =
            Probe::new().map_err(|error| Error::Internal(Words::new(chain(&error), "check that /proc is readable")))?;
        let Parts {
            session,
            store,
            writer,
            cycles,
            archive,
            history_points,
            engine,
            io,
            clock,
            field,
            roles,
            api,
            labels,
            version,
            audit_bytes_max,
            webhooks,
            host_alarms,
            trust_roots,
            secured,
        } = parts;
        // A host that was to stay empty over its restart says so from its first word on.
        let drain_kept = store.host_value::<bool>(drain::KEPT)?.unwrap_or(false);
        let here = session.host().clone();
        let own = Vitals {
            host: here.clone(),
            seq: 0,
            started_at_ms: clock.unix_ms(),
            roles,
            api,
            cpu: 0.0,
            cpu_process: 0.0,
            memory_bytes: 0,
            ready: Vec::new(),
            loops_owned: 0,
            loops_held: 0,
            draining: drain_kept,
            drain_kept,
            labels,
            version,
            unix_ms: clock.unix_ms(),
        };
        let (notices, arrived) = mpsc::channel(NOTICES_WAITING_MAX);
        let told = Arc::clone(&field);
        writer.tell_on_disk(Box::new(move |id, position| told.kept(id, position).is_ok()));
        let (audit, found) = Audit::open(&store, &here, audit_bytes_max)?;
        let (webhooks, hooks) = webhook::ready(webhooks, &here)?;
        let records = store.last_records()?;
        let terms = Terms::begin(&store, &records);
        let book = Book::open(store.clone())?;
        let library = Library::open(store.clone())?;
        let programs = Programs::open(&store)?;
        let signing = Signing::open(store.clone(), trust_roots)?;
        let room = Arc::new(Self {
            book,
            library,
            signing,
            bench: Bench::new(engine),
            roster: Roster::new(own.clone()),
            terms,
            feed: Feed::new(writer),
            cycles,
            archive,
            shadows: Shadows::default(),
            rollouts: Ledger::default(),
            programs,
            alarms: Alarms::default(),
            audit,
            keyring: Keyring::open(store.clone(), secured)?,
            webhooks,
            self_watch: SelfWatch::new(host_alarms),
            commissioning: Commissioning::new(&store, clock)?,
            disk: Disk::default(),
            rehearsals: Semaphore::new(REHEARSALS_MAX),
            holder: Holder::default(),
            homes: Homes::default(),
            tallies: Tallies::default(),
            uploads: Semaphore::new(UPLOADS_MAX),
            trials: Semaphore::new(1),
            changes: Semaphore::new(CHANGES_MAX),
            sending: Semaphore::new(SENDING_MAX),
            admission: tokio::sync::Mutex::default(),
            comparing: Mutex::default(),
            told: Mutex::default(),
            own: Mutex::new(own),
            draining: AtomicBool::new(drain_kept),
            drain_kept: AtomicBool::new(drain_kept),
            poke_homes: Notify::new(),
            poke_holds: Notify::new(),
            notices,
            stop: watch::Sender::new(false),
            runtime,
            ids: AtomicU64::new(0),
            here,
            session,
            store,
            io,
            clock,
            field,
        });
        for record in records {
            room.feed.remember(&Arc::new(record));
        }
        room.forget_strangers();
        if let Some(archive) = &room.archive {
            let keeper = Arc::downgrade(&room);
            archive.judge_by(Box::new(move |record| keeper.upgrade()?.history_lens(record)))?;
        }
        for host in room.session.hosts() {
            room.roster.up(&host);
        }
        room.spawn(Self::tell_vitals(Arc::clone(&room), probe));
        room.spawn(Self::reconcile_homes(Arc::clone(&room)));
        room.spawn(Self::reconcile_holds(Arc::clone(&room)));
        room.spawn(Self::prepare_ahead(Arc::clone(&room)));
        room.spawn(Self::hear_notices(Arc::clone(&room), arrived));
        room.begin_audit(&found);
        room.read_alarms()?;
        room.begin_webhooks(hooks);
        room.spawn(Self::watch_self(Arc::clone(&room)));
        room.spawn(Self::watch_alarms(Arc::clone(&room), room.feed.subscribe()));
        room.resume_rollouts()?;
        room.spawn(Self::keep_programs(Arc::clone(&room)));
        room.spawn(Self::keep_copies(Arc::clone(&room)));
        room.resume_forces()?;
        room.spawn(Self::watch_queues(Arc::clone(&room)));
        room.watch_masters();
        if !history_points.is_empty() {
            room.spawn(Self::watch_points(Arc::clone(&room), history_points));
        }
        Ok(room)
    }

    /// Runs a task until it ends or the room stops.
    pub(crate) fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) {
        let mut stop = self.stop.subscribe();
        self.runtime.spawn(async move {
            tokio::select! {
                () = task => {}
                _ = stop.wait_for(|stop| *stop) => {}
            }
        });
    }

    pub(crate) fn stop(&self) {
        self.stop.send_replace(true);
        self.shadows.close();
        if let Some(archive) = &self.archive {
            // So that its thread is never the last who has the room.
            archive.stop_judging();
        }
    }

    pub(crate) fn stopped(&self) -> bool {
        *self.stop.borrow()
    }

    /// Something changed: compare what runs with what shall run.
    pub(crate) fn poke(&self) {
        self.poke_homes.notify_one();
        self.poke_holds.notify_one();
        self.programs.poke.notify_one();
    }

    /// Pokes later.
    pub(crate) fn poke_in(self: &Arc<Self>, wait: Duration) {
        let room = Arc::clone(self);
        self.spawn(async move {
            tokio::time::sleep(wait).await;
            room.poke();
        });
    }

    /// A name for a command that came without one: unique, because host, start and number are in it.
    pub(crate) fn new_command_id(&self) -> CommandId {
        let number = self.ids.fetch_add(1, Ordering::Relaxed);
        let started_ms = self.own.lock().started_at_ms;
        let text = format!("{} {started_ms} {number} {}", self.here, self.clock.now_ns());
        let digest = Digest::of(text.as_bytes());
        let first = digest.as_bytes().iter().take(16);
        CommandId(first.fold(0, |id, byte| (id << 8) | u128::from(*byte)))
    }

    /// Asks a host, this one included, and waits for its answer.
    pub(crate) async fn ask(self: &Arc<Self>, to: &HostId, ask: Ask, wait: Duration) -> Result<Told, Error> {
        if *to == self.here {
            return timeout(wait, Arc::clone(self).answer(self.here.clone(), ask))
                .await
                .map_err(|_| silent(to, wait))?;
        }
        let payload = wire::encode(&ask)?;
        let reply = self
            .session
            .request(to, payload, wait)
            .await
            .map_err(|error| match error {
                bumpless_cell::Error::Timeout { .. } => silent(to, wait),
                bumpless_cell::Error::NoSuchHost { .. }
                | bumpless_cell::Error::Closed { .. }
                | bumpless_cell::Error::Send { .. } => {
                    Error::unreachable(chain(&error), "start the host, or wait until it is back")
                }
                bumpless_cell::Error::Refused { .. } => Error::busy(chain(&error), "try again"),
                other => Error::internal(chain(&other)),
            })?;
        wire::decode_reply(reply)
    }

    /// Takes what arrives. Never blocks.
    pub(crate) fn arrive(self: &Arc<Self>, arrival: DeployArrival) {
        match arrival {
            DeployArrival::Loops(LoopsEvent::Record(record)) => {
                if record.faults_in_row > 0 {
                    self.look_for_fallback(&record);
                }
                self.keep_cycle(&record);
                self.keep_history(&record);
                self.say_of(&record);
                self.feed.pass(record);
            }
            DeployArrival::Loops(LoopsEvent::Outcome { record, alone }) => self.feed.keep(record, alone),
            DeployArrival::Bus(Arrival::Record(record)) => {
                self.say_of(&record);
                self.keep_history(&record);
                self.feed.pass(record);
            }
            // The record with it has passed before, or does now; the reconciliation reads it from there.
            DeployArrival::Loops(LoopsEvent::Revised { loop_id, revision }) => {
                self.homes.revised(&loop_id, revision);
                self.poke();
            }
            DeployArrival::Bus(Arrival::HostUp(host)) => self.host_up(&host),
            DeployArrival::Bus(Arrival::HostDown(host)) => self.host_down(&host),
            DeployArrival::Bus(Arrival::Vitals(vitals)) => {
                self.field.set_host(&vitals);
                self.self_watch.heard(&vitals, self.clock.unix_ms());
                if self.roster.vitals(vitals) {
                    self.poke();
                }
            }
            DeployArrival::Bus(Arrival::Notice { from, payload }) => match wire::decode::<Notice>("notice", &payload) {
                Ok(Notice::Field(event)) => self.commissioning.tell(*event),
                Ok(Notice::Alarm(event)) => self.alarms.heard(*event),
                Ok(Notice::Message(message)) => self.programs.runner.say(&message),
                Ok(notice) => {
                    if self.notices.try_send((from, notice)).is_err() {
                        count(&self.tallies.arrivals_dropped);
                    }
                }
                Err(error) => {
                    count(&self.tallies.malformed);
                    tracing::debug!(%from, %error, "a notice was passed over");
                }
            },
            DeployArrival::Bus(Arrival::Request {
                from,
                payload,
                responder,
            }) => {
                let room = Arc::clone(self);
                // The bus lets only so many requests in at a time.
                self.spawn(async move {
                    let reply = match wire::decode::<Ask>("question", &payload) {
                        Ok(ask) => {
                            drop(payload);
                            count(&room.tallies.requests);
                            Arc::clone(&room).answer(from, ask).await
                        }
                        Err(error) => {
                            count(&room.tallies.malformed);
                            Err(error)
                        }
                    };
                    responder.reply(wire::encode_reply(reply).map_err(|error| error.to_string()));
                });
            }
            DeployArrival::Bus(other) => tracing::debug!(?other, "an arrival that is not for deployment"),
        }
    }

    /// What loops say, to the programs that listen here.
    fn say_of(&self, record: &bumpless_core::Record) {
        for message in &record.messages {
            self.programs.runner.say(message);
        }
    }

    /// The runtime that deployment works on.
    pub(crate) fn async_runtime(&self) -> Handle {
        self.runtime.clone()
    }

    /// A record of a failing loop, taken at its home, which is here. Asked again when the faults have doubled.
    fn look_for_fallback(self: &Arc<Self>, record: &bumpless_core::Record) {
        let Some(intent) = self.book.get(&record.loop_id) else {
            return;
        };
        let beyond = record
            .faults_in_row
            .saturating_sub(intent.current.policy.faults_tolerated);
        if intent.current.fallback.is_some() && intent.current.revision == record.revision && beyond.is_power_of_two() {
            self.fall_back(record);
        }
    }

    fn host_up(&self, host: &HostId) {
        self.roster.up(host);
        // A new life of a host knows nothing of what the old one was told.
        self.holder.forget_reports_to(host);
        self.homes.forget_host(host);
        self.comparing.lock().done.remove(host);
        self.announce_standing();
        self.tell_vitals_now();
        self.poke();
    }

    fn host_down(&self, host: &HostId) {
        self.roster.down(host);
        self.holder.forget_reports_to(host);
        self.homes.forget_host(host);
        self.poke();
    }

    /// Is this host being emptied?
    pub(crate) fn is_draining(&self) -> bool {
        self.draining.load(Ordering::Acquire)
    }

    /// Gives this host's loops away, or takes loops again.
    pub(crate) fn set_draining(&self, draining: bool) {
        self.draining.store(draining, Ordering::Release);
        self.tell_vitals_now();
        self.poke();
    }

    /// Keeps the homes as they shall be. Apart from what is held, for a compilation there must not delay what a home does
    /// about a host that went.
    async fn reconcile_homes(room: Arc<Self>) {
        Self::gather_records(&room).await;
        let mut tick = every(RECONCILE_EVERY);
        loop {
            tokio::select! {
                _ = tick.tick() => {
                    for host in room.session.hosts() {
                        if !room.roster.there(&host) && room.roster.up(&host) {
                            room.poke();
                        }
                    }
                    room.announce_standing_when_due();
                    room.feed.prune(|id| room.book.get(id).is_some());
                }
                () = room.poke_homes.notified() => {}
            }
            room.keep_homes().await;
        }
    }

    /// Keeps what is held as it shall be.
    async fn reconcile_holds(room: Arc<Self>) {
        let mut tick = every(RECONCILE_EVERY);
        loop {
            tokio::select! {
                _ = tick.tick() => {}
                () = room.poke_holds.notified() => {}
            }
            room.keep_holds().await;
        }
    }
}

fn silent(host: &HostId, wait: Duration) -> Error {
    Error::timeout(
        format!("host {host} did not answer within {} s", wait.as_secs_f32()),
        "what was asked may still happen; look before you ask again",
    )
}
