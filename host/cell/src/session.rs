//! A host's place on the bus: opened once, shared by all, closed at the end.
//!
//! Owns: the Zenoh session and everything declared on it, and the calls to hosts that are not met. Never: blocks in a `send_*` or
//! `publish_*`.
//!
//! ```text
//! open ─► connected ─► name free? ──no, after lease + 500 ms──► Err(NameTaken)
//!                          │ yes
//!                          ▼
//!                       joined ── a namesake that joined before ─────► Arrival::NameTaken, token taken back
//!                          │
//!                 close, or last clone dropped ─► closed: sends fail and are counted
//! ```

use std::{
    sync::{
        Arc,
        mpsc::{RecvTimeoutError, channel},
    },
    time::{Duration, Instant},
};

use bumpless_core::{
    HostId, LoopId, Record,
    chatter::{ROLL_NS_MIN, pause_ns},
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};
use parking_lot::Mutex;
use tokio::{runtime::Handle, sync::oneshot};
use zenoh::{Wait, liveliness::LivelinessToken, sample::Sample as Put};

use crate::{
    arrival::Sink,
    bus::{self, Bus},
    config::Config,
    counters::{Counters, count},
    error::Error,
    inbox::Inbox,
    keys::{Instance, Key, Keys, Lane},
    lanes::Lanes,
    limits::{NAME_WAIT_MARGIN_MS, NOTICE_BYTES_MAX},
    request,
    roll::{Entry, RollCall},
    vitals::Vitals,
    wire::{self, Letter, Token},
};

/// Pause between two looks for a namesake's token.
const NAME_LOOK_PERIOD: Duration = Duration::from_millis(50);
/// Longest wait for one look.
const NAME_LOOK_TIMEOUT: Duration = Duration::from_secs(1);
/// How often a host looks whom it should have met and has not.
const ROLL_LOOK_PERIOD: Duration = Duration::from_secs(1);

/// What the clones of a session share.
pub(crate) struct Shared {
    pub(crate) inbox: Arc<Inbox>,
    lanes: Lanes,
    token: Mutex<Option<LivelinessToken>>,
    locators: Vec<String>,
    /// None only while the last clone is being dropped.
    zenoh: Option<zenoh::Session>,
    /// What the session runs on.
    bus: Bus,
}

/// A host's place on the bus. Clones are the same place.
#[derive(Clone)]
pub struct Session {
    pub(crate) shared: Arc<Shared>,
}

impl std::fmt::Debug for Session {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Session")
            .field("host", self.host())
            .finish_non_exhaustive()
    }
}

impl Session {
    /// Joins the cell. Hosts to connect to may come later; if any is named, this waits for them up to half a second.
    ///
    /// `sink` gets everything that arrives, from the first moment on: hosts may be up before this returns. It runs on
    /// Zenoh's threads and must not block.
    ///
    /// # Errors
    /// [`Error::Config`], [`Error::Open`] (address in use), [`Error::NameTaken`] after waiting a lease and 500 ms for
    /// an earlier life of this host to be forgotten, [`Error::NoRuntime`] outside tokio.
    pub async fn open(config: &Config, sink: Sink) -> Result<Self, Error> {
        let runtime = Handle::try_current().map_err(Error::NoRuntime)?;
        let zenoh_config = config.zenoh()?;
        let config = config.clone();
        let host = config.host.clone();
        waiting(&host, move || Self::join(&config, zenoh_config, sink, runtime)).await?
    }

    fn join(config: &Config, zenoh_config: zenoh::Config, sink: Sink, runtime: Handle) -> Result<Self, Error> {
        let host = config.host.clone();
        let (zenoh, bus) = Bus::open(zenoh_config).map_err(|source| Error::Open {
            host: host.clone(),
            listen: config.listen.clone(),
            source,
        })?;
        let keys = Keys::new(config.cell.clone());
        let inbox = Arc::new(Inbox::new(
            keys.clone(),
            host.clone(),
            bus::instance(zenoh.zid()),
            sink,
            runtime,
        ));
        let lanes = Lanes::new(&zenoh, keys.clone(), host.clone())?;
        let locators = zenoh.info().locators().wait().iter().map(ToString::to_string).collect();
        let shared = Arc::new(Shared {
            inbox,
            lanes,
            token: Mutex::new(None),
            locators,
            zenoh: Some(zenoh),
            bus,
        });
        // Set once, here: the error would be that it was set before.
        let _ = shared.inbox.shared.set(Arc::downgrade(&shared));
        let session = Self { shared };

        // Ears before the token: whoever sees the token may send at once.
        session.shared.listen(&keys)?;
        session.shared.wait_for_name(config)?;
        session.shared.put_out_token(&keys)?;
        // Two that looked at the same moment did not see each other: look again, and the greater instance leaves. One that was
        // here before and could not be seen says so itself.
        let others = session.shared.lives(&keys)?;
        if let Some(other) = others.iter().find(|other| **other < session.shared.inbox.instance) {
            return Err(session.shared.name_taken(config, other));
        }
        for other in &others {
            session.shared.inbox.on_namesake(other);
        }
        session.shared.call_the_roll();
        Ok(session)
    }

    /// This host.
    #[must_use]
    pub fn host(&self) -> &HostId {
        &self.shared.inbox.host
    }

    /// This life of it.
    #[must_use]
    pub fn instance(&self) -> &Instance {
        &self.shared.inbox.instance
    }

    /// Where this host really listens, as Zenoh endpoints: with the port that a configured 0 became.
    #[must_use]
    pub fn locators(&self) -> Vec<String> {
        self.shared.locators.clone()
    }

    /// The hosts that are there, this one too, in the order of names.
    #[must_use]
    pub fn hosts(&self) -> Vec<HostId> {
        let mut hosts = self.shared.inbox.hosts();
        if let Err(place) = hosts.binary_search(self.host()) {
            hosts.insert(place, self.host().clone());
        }
        hosts
    }

    /// Is the bus open? It is until [`Session::close`], or until Zenoh gives up.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.shared.zenoh().is_ok_and(|zenoh| !zenoh.is_closed())
    }

    /// What was sent, received and lost so far.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.shared.inbox.tally.read()
    }

    // The cycle lanes. None blocks. A message that cannot be sent is counted; one that Zenoh drops because the link is
    // full is not even that, the sequence shows it. To this host itself, the sink is called before the call returns.

    /// Home to owner.
    pub fn send_sample(&self, to: &HostId, sample: &Sample) {
        self.direct(to, Lane::Sample, sample);
    }

    /// Owner to home.
    pub fn send_answer(&self, to: &HostId, answer: &Answer) {
        self.direct(to, Lane::Answer, answer);
    }

    /// Owner to replica.
    pub fn send_step(&self, to: &HostId, request: &StepRequest) {
        self.direct(to, Lane::Step, request);
    }

    /// Replica to owner.
    pub fn send_step_answer(&self, to: &HostId, answer: &StepAnswer) {
        self.direct(to, Lane::StepAnswer, answer);
    }

    /// Arbiter to every other host.
    pub fn publish_record(&self, record: &Record) {
        let sent = wire::encode(record)
            .and_then(|bytes| self.shared.lanes.record(self.shared.zenoh()?, &record.loop_id, bytes));
        self.counted("record", sent);
    }

    /// Lets the record lane of a loop go, when the loop is removed or its home moves. It comes back if it is used.
    pub fn forget_loop(&self, id: &LoopId) {
        self.shared.lanes.forget_loop(id);
    }

    /// Asks a host's step workers for a sign of life. `token` comes back in [`Arrival::Pong`](crate::Arrival::Pong).
    pub fn ping(&self, to: &HostId, token: u64) {
        self.direct(to, Lane::Ping, &Token(token));
    }

    /// Answers [`Arrival::Ping`](crate::Arrival::Ping).
    pub fn pong(&self, to: &HostId, token: u64) {
        self.direct(to, Lane::Pong, &Token(token));
    }

    /// How this host is, to every other host.
    pub fn publish_vitals(&self, vitals: &Vitals) {
        let sent = wire::encode(vitals).and_then(|bytes| self.shared.lanes.vitals(bytes));
        self.counted(Vitals::NAME, sent);
    }

    /// Something changed here, to every other host. At most 64 KiB. It may be lost: what matters must also be found by
    /// asking.
    pub fn publish_notice(&self, payload: &[u8]) {
        let sent = if payload.len() > NOTICE_BYTES_MAX {
            Err(Error::TooLarge {
                what: "notice",
                bytes: payload.len(),
                limit: NOTICE_BYTES_MAX,
            })
        } else {
            self.shared.lanes.notice(payload.to_vec())
        };
        self.counted("notice", sent);
    }

    /// Asks a host for something and waits for its reply, at most `timeout` (1 ms to 10 min).
    ///
    /// # Errors
    /// [`Error::Timeout`] where the host is there and silent; [`Error::NoSuchHost`] where none is, or it went away;
    /// [`Error::Refused`] with the other side's words; [`Error::TooLarge`] beyond 33 MiB either way.
    pub async fn request(&self, to: &HostId, payload: Vec<u8>, timeout: Duration) -> Result<Vec<u8>, Error> {
        let inbox = &self.shared.inbox;
        let key = inbox.keys.build(&Key::Request {
            to: to.clone(),
            from: inbox.host.clone(),
        });
        request::ask(Arc::clone(&self.shared), key, to, payload, timeout).await
    }

    /// Leaves the cell: the others see this host go at once. Every clone is closed with it.
    pub async fn close(self) {
        self.shared.take_back_token();
        let Ok(zenoh) = self.shared.zenoh().cloned() else {
            return;
        };
        let bus = self.shared.bus.clone();
        let closed = waiting(self.host(), move || bus.close(&zenoh)).await;
        match closed {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::debug!(host = %self.host(), %error, "the bus did not close cleanly"),
            Err(error) => tracing::debug!(host = %self.host(), %error, "the bus did not close cleanly"),
        }
    }

    fn direct<L: Letter>(&self, to: &HostId, lane: Lane, letter: &L) {
        let sent =
            wire::encode(letter).and_then(|bytes| self.shared.lanes.direct(self.shared.zenoh()?, to, lane, bytes));
        self.counted(L::NAME, sent);
    }

    fn counted(&self, what: &'static str, sent: Result<(), Error>) {
        let tally = &self.shared.inbox.tally;
        match sent {
            Ok(()) => count(&tally.sent),
            Err(error) => {
                count(&tally.send_failed);
                tracing::debug!(host = %self.host(), what, %error, "a message was not sent");
            }
        }
    }
}

impl Shared {
    pub(crate) fn zenoh(&self) -> Result<&zenoh::Session, Error> {
        self.zenoh.as_ref().ok_or_else(|| Error::Closed {
            host: self.inbox.host.clone(),
        })
    }

    fn listen(&self, keys: &Keys) -> Result<(), Error> {
        let zenoh = self.zenoh()?;
        let host = &self.inbox.host;
        let direct = Lane::ALL.into_iter().map(|lane| keys.to_host(host, lane));
        for key in direct.chain([keys.all_records(), keys.all_vitals(), keys.all_notices()]) {
            let inbox = Arc::clone(&self.inbox);
            zenoh
                .declare_subscriber(key.clone())
                .callback(move |put: Put| inbox.on_message(&put))
                .background()
                .wait()
                .map_err(|source| Error::Declare { key, source })?;
        }
        let (key, inbox) = (keys.requests_to(host), Arc::clone(&self.inbox));
        zenoh
            .declare_queryable(key.clone())
            .complete(true)
            .callback(move |query| inbox.on_query(query))
            .background()
            .wait()
            .map_err(|source| Error::Declare { key, source })?;
        let (key, inbox) = (keys.build(&Key::Claim(host.clone())), Arc::clone(&self.inbox));
        zenoh
            .declare_subscriber(key.clone())
            .callback(move |put: Put| inbox.on_claim(&put))
            .background()
            .wait()
            .map_err(|source| Error::Declare { key, source })?;
        let (key, inbox) = (keys.all_rolls(), Arc::clone(&self.inbox));
        zenoh
            .declare_subscriber(key.clone())
            .callback(move |put: Put| inbox.on_roll_call(&put))
            .background()
            .wait()
            .map_err(|source| Error::Declare { key, source })?;
        let (key, inbox) = (keys.all_alive(), Arc::clone(&self.inbox));
        zenoh
            .liveliness()
            .declare_subscriber(key.clone())
            .history(true)
            .callback(move |token: Put| inbox.on_token(&token))
            .background()
            .wait()
            .map_err(|source| Error::Declare { key, source })
    }

    /// An earlier life of this host may be remembered for as long as its lease; only what stays is a namesake.
    fn wait_for_name(&self, config: &Config) -> Result<(), Error> {
        let deadline = Instant::now() + Duration::from_millis(config.lease_ms + NAME_WAIT_MARGIN_MS);
        while let Some(other) = self.lives(&self.inbox.keys)?.into_iter().next() {
            if Instant::now() >= deadline {
                return Err(self.name_taken(config, &other));
            }
            std::thread::sleep(NAME_LOOK_PERIOD);
        }
        Ok(())
    }

    fn name_taken(&self, config: &Config, other: &Instance) -> Error {
        self.take_back_token();
        Error::NameTaken {
            cell: config.cell.clone(),
            host: config.host.clone(),
            instance: other.as_str().to_owned(),
        }
    }

    /// The other lives of this host's name that can be seen now.
    fn lives(&self, keys: &Keys) -> Result<Vec<Instance>, Error> {
        let key = keys.lives_of(&self.inbox.host);
        let (sender, receiver) = channel();
        self.zenoh()?
            .liveliness()
            .get(key.clone())
            .timeout(NAME_LOOK_TIMEOUT)
            .callback(move |reply| {
                if let Ok(token) = reply.result() {
                    // The receiver may have stopped waiting.
                    let _ = sender.send(token.key_expr().to_string());
                }
            })
            .wait()
            .map_err(|source| Error::Declare { key, source })?;
        let mut lives = Vec::new();
        let deadline = Instant::now() + 2 * NAME_LOOK_TIMEOUT;
        loop {
            match receiver.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(text) => {
                    if let Ok(Key::Alive(_, instance)) = keys.parse(&text)
                        && instance != self.inbox.instance
                    {
                        lives.push(instance);
                    }
                }
                // Everyone answered, or Zenoh's own time-out did.
                Err(RecvTimeoutError::Disconnected | RecvTimeoutError::Timeout) => return Ok(lives),
            }
        }
    }

    fn put_out_token(&self, keys: &Keys) -> Result<(), Error> {
        let inbox = &self.inbox;
        let key = keys.build(&Key::Alive(inbox.host.clone(), inbox.instance.clone()));
        let token = self
            .zenoh()?
            .liveliness()
            .declare_token(key.clone())
            .wait()
            .map_err(|source| Error::Declare { key, source })?;
        *self.token.lock() = Some(token);
        inbox.joined();
        Ok(())
    }

    pub(crate) fn take_back_token(&self) {
        let token = self.token.lock().take();
        if let Some(token) = token
            && let Err(error) = token.undeclare().wait()
        {
            tracing::debug!(host = %self.inbox.host, %error, "the token was not taken back");
        }
    }

    /// Says this host's claim to its name. False where there is nobody left to say it to.
    pub(crate) fn say_claim(&self) -> bool {
        let Some(claim) = self.inbox.claim() else { return false };
        if let Err(error) = wire::encode(&claim).and_then(|bytes| self.lanes.claim(bytes)) {
            tracing::debug!(host = %self.inbox.host, %error, "a claim to the name was not sent");
        }
        true
    }

    /// From now on this host says who it has met, and calls those whom it has not, until the session is let go.
    fn call_the_roll(self: &Arc<Self>) {
        let weak = Arc::downgrade(self);
        drop(self.inbox.runtime.spawn(async move {
            let mut beat = tokio::time::interval(ROLL_LOOK_PERIOD);
            beat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
            let mut said_at: Option<Instant> = None;
            loop {
                beat.tick().await;
                let Some(shared) = weak.upgrade() else { return };
                let pause = Duration::from_nanos(pause_ns(ROLL_NS_MIN, shared.inbox.hosts().len() + 1));
                if said_at.is_none_or(|said_at| said_at.elapsed() >= pause) {
                    said_at = Some(Instant::now());
                    shared.say_whom_it_met();
                }
                for entry in shared.inbox.due() {
                    shared.call(entry);
                }
            }
        }));
    }

    fn say_whom_it_met(&self) {
        let inbox = &self.inbox;
        let call = RollCall {
            own: Entry::new(inbox.host.clone(), inbox.instance.clone(), &self.locators),
            met: inbox.named(),
        };
        if let Err(error) = wire::encode(&call).and_then(|bytes| self.lanes.roll(bytes)) {
            tracing::debug!(host = %inbox.host, %error, "a roll call was not sent");
        }
    }

    /// Tries a link to a host, and closes one that is deaf.
    fn call(self: &Arc<Self>, entry: Entry) {
        let weak = Arc::downgrade(self);
        let (instance, locators) = (entry.instance.clone(), entry.locators.clone());
        self.bus.link(&instance, &locators, move |is_linked| {
            let Some(shared) = weak.upgrade() else { return };
            let is_deaf = shared.inbox.called(&entry.instance, is_linked);
            let (host, called, at) = (&shared.inbox.host, &entry.host, &entry.locators);
            tracing::debug!(%host, %called, ?at, is_linked, is_deaf, "a host that was not met was called");
            if is_deaf {
                shared.bus.unlink(&entry.instance);
            }
        });
    }

    pub(crate) fn warm(&self, host: &HostId) {
        if let Err(error) = self.zenoh().and_then(|zenoh| self.lanes.warm(zenoh, host)) {
            tracing::debug!(%host, %error, "the lanes to a host were not declared ahead");
        }
    }

    pub(crate) fn forget_host(&self, host: &HostId) {
        self.lanes.forget_host(host);
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        // Zenoh waits while it closes, and panics if it has to do that on a single-threaded runtime.
        if let Some(zenoh) = self.zenoh.take() {
            let bus = self.bus.clone();
            let closing = move || drop(bus.close(&zenoh));
            drop(
                std::thread::Builder::new()
                    .name("bumpless-bus".to_owned())
                    .spawn(closing),
            );
        }
    }
}

/// Runs a call that waits on a thread of its own: Zenoh's waiting calls panic on a single-threaded runtime.
async fn waiting<T: Send + 'static>(host: &HostId, call: impl FnOnce() -> T + Send + 'static) -> Result<T, Error> {
    let (sender, receiver) = oneshot::channel();
    let call = move || {
        // The caller may have stopped waiting.
        let _ = sender.send(call());
    };
    std::thread::Builder::new()
        .name("bumpless-bus".to_owned())
        .spawn(call)
        .map_err(Error::Thread)?;
    receiver.await.map_err(|_| Error::Closed { host: host.clone() })
}
