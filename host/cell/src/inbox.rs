//! Everything that comes in: messages, tokens and requests become arrivals, or are counted as malformed.
//!
//! Owns: the reading of what others sent, membership, claims to the name, the roll, the limit on reports. Never: panics on what
//! others sent; keeps the session alive (it holds it weakly).

use std::{
    sync::{Arc, OnceLock, Weak, atomic::AtomicUsize},
    time::{Duration, Instant},
};

use bumpless_core::HostId;
use parking_lot::{Mutex, RwLock};
use tokio::runtime::Handle;
use zenoh::{
    query::Query,
    sample::{Sample as Put, SampleKind},
};

use crate::{
    arrival::{Arrival, Sink},
    claims::{Claim, Claims},
    counters::{Tally, count},
    error::{Error, cut},
    keys::{Instance, Key, Keys, Lane},
    limits::{MALFORMED_REPORTS_PER_S, NOTICE_BYTES_MAX, REPORTED_KEY_CHARS_MAX, REQUESTS_IN_FLIGHT_MAX},
    members::{Change, Members},
    request::{self, Place, Responder},
    roll::{Entry, Roll, RollCall},
    session::Shared,
    wire,
};

/// How often namesakes say how long they have been here.
const CLAIM_EVERY: Duration = Duration::from_millis(200);

pub(crate) struct Inbox {
    pub(crate) keys: Keys,
    pub(crate) host: HostId,
    pub(crate) instance: Instance,
    pub(crate) tally: Tally,
    pub(crate) shared: OnceLock<Weak<Shared>>,
    /// Since when this host's own token is out: from then on a namesake is a conflict.
    joined_at: OnceLock<Instant>,
    claims: Mutex<Claims>,
    roll: Mutex<Roll>,
    sink: Sink,
    pub(crate) runtime: Handle,
    in_flight: Arc<AtomicUsize>,
    members: RwLock<Members>,
    /// Held while a change of members is told, so that comings and goings are told in their order. The sink may read
    /// `members` meanwhile.
    telling: Mutex<()>,
    reports: Mutex<Reports>,
}

impl Inbox {
    pub(crate) fn new(keys: Keys, host: HostId, instance: Instance, sink: Sink, runtime: Handle) -> Self {
        Self {
            keys,
            host,
            roll: Mutex::new(Roll::new(instance.clone())),
            instance,
            tally: Tally::default(),
            shared: OnceLock::new(),
            joined_at: OnceLock::new(),
            claims: Mutex::default(),
            sink,
            runtime,
            in_flight: Arc::default(),
            members: RwLock::default(),
            telling: Mutex::default(),
            reports: Mutex::new(Reports::new(Instant::now())),
        }
    }

    /// The other hosts.
    pub(crate) fn hosts(&self) -> Vec<HostId> {
        self.members.read().hosts()
    }

    /// A message on any lane.
    pub(crate) fn on_message(&self, put: &Put) {
        let payload = put.payload();
        match read(&self.keys, put.key_expr().as_str(), payload.len(), || {
            payload.to_bytes()
        }) {
            Ok(arrival) => self.tell(arrival),
            Err(error) => self.malformed(put.key_expr().as_str(), &error),
        }
    }

    /// A token came or went.
    pub(crate) fn on_token(&self, token: &Put) {
        let (host, instance) = match self.keys.parse(token.key_expr().as_str()) {
            Ok(Key::Alive(host, instance)) => (host, instance),
            Ok(_) => return,
            Err(error) => return self.malformed(token.key_expr().as_str(), &error),
        };
        let appears = token.kind() == SampleKind::Put;
        if host == self.host {
            if appears {
                self.on_namesake(&instance);
            } else {
                self.claims.lock().vanish(&instance);
            }
            return;
        }
        let order = self.telling.lock();
        let changes = {
            let mut members = self.members.write();
            if appears {
                members.appear(&host, instance)
            } else {
                members.vanish(&host, &instance)
            }
        };
        for change in changes {
            match change {
                Change::Up(host) => {
                    self.in_background(host.clone(), Shared::warm);
                    (self.sink)(Arrival::HostUp(host));
                }
                Change::Down(host) => {
                    self.in_background(host.clone(), Shared::forget_host);
                    (self.sink)(Arrival::HostDown(host));
                }
            }
        }
        drop(order);
    }

    /// This host's token is out.
    pub(crate) fn joined(&self) {
        // Set once, by whoever put it out.
        let _ = self.joined_at.set(Instant::now());
    }

    /// Another process has this host's name: both say how long they have been here, until one of them leaves. Before the token
    /// is out, opening sees to it.
    pub(crate) fn on_namesake(&self, other: &Instance) {
        if *other == self.instance || self.joined_at.get().is_none() || !self.claims.lock().appear(other) {
            return;
        }
        tracing::warn!(host = %self.host, instance = other.as_str(), "another host of this name is here; the one that joined later will leave");
        let Some(shared) = self.shared.get().cloned() else {
            return;
        };
        drop(self.runtime.spawn(async move {
            let mut beat = tokio::time::interval(CLAIM_EVERY);
            loop {
                beat.tick().await;
                let Some(shared) = shared.upgrade().filter(|shared| shared.say_claim()) else {
                    return;
                };
                drop(shared);
            }
        }));
    }

    /// This host's claim, while there is somebody to say it to.
    pub(crate) fn claim(&self) -> Option<Claim> {
        let joined_for_us = self.joined_for_us()?;
        self.claims.lock().speak().then(|| Claim {
            instance: self.instance.clone(),
            joined_for_us,
        })
    }

    fn joined_for_us(&self) -> Option<u64> {
        let joined_at = self.joined_at.get()?;
        Some(u64::try_from(joined_at.elapsed().as_micros()).unwrap_or(u64::MAX))
    }

    /// A namesake says how long it has been here.
    pub(crate) fn on_claim(&self, put: &Put) {
        let payload = put.payload();
        let claim = wire::fits::<Claim>(payload.len()).and_then(|()| wire::decode::<Claim>(&payload.to_bytes()));
        let claim = match claim {
            Ok(claim) => claim,
            Err(error) => return self.malformed(put.key_expr().as_str(), &error),
        };
        // Its token may come later.
        self.on_namesake(&claim.instance);
        let Some(joined_for_us) = self.joined_for_us() else {
            return;
        };
        if self.claims.lock().hear(&self.instance, joined_for_us, &claim) {
            self.in_background(self.host.clone(), |shared, _| shared.take_back_token());
            (self.sink)(Arrival::NameTaken {
                instance: claim.instance.as_str().to_owned(),
            });
        }
    }

    /// A host called the roll.
    pub(crate) fn on_roll_call(&self, put: &Put) {
        let (key, payload) = (put.key_expr().as_str(), put.payload());
        let call = wire::fits::<RollCall>(payload.len()).and_then(|()| wire::decode::<RollCall>(&payload.to_bytes()));
        let sender = self.keys.parse(key);
        match (call, sender) {
            (Ok(call), Ok(Key::Roll(host))) if call.own.host == host => self.roll.lock().hear(call, Instant::now()),
            (Ok(_), Ok(_)) => {
                let reason = "it names another sender than its key".to_owned();
                let (what, bytes) = ("roll call", payload.len());
                self.malformed(key, &Error::Undecodable { what, bytes, reason });
            }
            (Err(error), _) | (_, Err(error)) => self.malformed(key, &error),
        }
    }

    /// Who is named in this host's next call.
    pub(crate) fn named(&self) -> Vec<Entry> {
        let members = self.members.read();
        self.roll.lock().name(|e| members.has(&e.host, &e.instance))
    }

    /// Whom this host calls now.
    pub(crate) fn due(&self) -> Vec<Entry> {
        let members = self.members.read();
        self.roll
            .lock()
            .due(Instant::now(), |e| members.has(&e.host, &e.instance))
    }

    /// One that was called is linked now, or is not: is the link to be closed?
    pub(crate) fn called(&self, instance: &Instance, is_linked: bool) -> bool {
        self.roll.lock().called(instance, is_linked, Instant::now())
    }

    /// A query for this host.
    pub(crate) fn on_query(&self, query: Query) {
        count(&self.tally.requests);
        let key = query.key_expr().as_str();
        let read = match self.keys.parse(key) {
            Ok(Key::Request { from, .. }) => request::payload(&query).map(|payload| (from, payload)),
            Ok(_) => Err(Error::Key {
                key: cut(key, REPORTED_KEY_CHARS_MAX),
                reason: "it is no request",
            }),
            Err(error) => Err(error),
        };
        let (from, payload) = match read {
            Ok(request) => request,
            Err(error) => {
                self.malformed(key, &error);
                return self.refuse(query, error.to_string());
            }
        };
        match Place::take(&self.in_flight) {
            Some(place) => {
                let responder = Responder::new(query, place, self.runtime.clone());
                self.tell(Arrival::Request {
                    from,
                    payload,
                    responder,
                });
            }
            None => {
                count(&self.tally.requests_busy);
                self.refuse(
                    query,
                    format!("the host is busy with {REQUESTS_IN_FLIGHT_MAX} requests; ask again later"),
                );
            }
        }
    }

    /// A refusal waits for the link, and this thread reads the network.
    fn refuse(&self, query: Query, reason: String) {
        drop(self.runtime.spawn_blocking(move || request::send(&query, Err(reason))));
    }

    fn tell(&self, arrival: Arrival) {
        count(&self.tally.received);
        (self.sink)(arrival);
    }

    fn malformed(&self, key: &str, error: &Error) {
        count(&self.tally.malformed);
        let Some(unreported) = self.reports.lock().admit(Instant::now()) else {
            return;
        };
        let more = if unreported > 0 {
            format!(" ({unreported} more were not reported)")
        } else {
            String::new()
        };
        (self.sink)(Arrival::Malformed {
            key: cut(key, REPORTED_KEY_CHARS_MAX),
            reason: format!("{error}{more}"),
        });
    }

    /// Declarations take a while, and Zenoh's reading threads are not the place for them.
    fn in_background(&self, host: HostId, work: fn(&Shared, &HostId)) {
        let Some(shared) = self.shared.get().cloned() else {
            return;
        };
        drop(self.runtime.spawn_blocking(move || {
            if let Some(shared) = shared.upgrade() {
                work(&shared, &host);
            }
        }));
    }
}

/// How many reports of malformed messages may pass in this second.
struct Reports {
    since: Instant,
    passed: u32,
    held_back: u64,
}

impl Reports {
    const fn new(now: Instant) -> Self {
        Self {
            since: now,
            passed: 0,
            held_back: 0,
        }
    }

    /// May one pass now? If so, how many were held back since the last one.
    fn admit(&mut self, now: Instant) -> Option<u64> {
        if now.duration_since(self.since) >= Duration::from_secs(1) {
            (self.since, self.passed) = (now, 0);
        }
        if self.passed >= MALFORMED_REPORTS_PER_S {
            self.held_back += 1;
            return None;
        }
        self.passed += 1;
        Some(std::mem::take(&mut self.held_back))
    }
}

/// Reads one message. `len` is known before the bytes are put together, so a huge one is refused untouched.
fn read<'a>(
    keys: &Keys,
    key: &str,
    len: usize,
    bytes: impl FnOnce() -> std::borrow::Cow<'a, [u8]>,
) -> Result<Arrival, Error> {
    fn letter<'a, L: wire::Letter>(len: usize, bytes: impl FnOnce() -> std::borrow::Cow<'a, [u8]>) -> Result<L, Error> {
        wire::fits::<L>(len)?;
        wire::decode(&bytes())
    }
    // A message that names its sender or loop must agree with its key.
    let agree = |what, agrees: bool| {
        if agrees {
            Ok(())
        } else {
            let reason = "it names another sender or loop than its key".to_owned();
            Err(Error::Undecodable {
                what,
                bytes: len,
                reason,
            })
        }
    };
    match keys.parse(key)? {
        Key::Direct {
            lane: Lane::Sample,
            from,
            ..
        } => {
            let sample: Box<bumpless_core::protocol::Sample> = Box::new(letter(len, bytes)?);
            agree("sample", sample.home == from)?;
            Ok(Arrival::Sample(sample))
        }
        Key::Direct {
            lane: Lane::Answer,
            from,
            ..
        } => Ok(Arrival::Answer {
            from,
            answer: Box::new(letter(len, bytes)?),
        }),
        Key::Direct {
            lane: Lane::Step, from, ..
        } => {
            let request: Box<bumpless_core::protocol::StepRequest> = Box::new(letter(len, bytes)?);
            agree("step request", request.from == from)?;
            Ok(Arrival::StepRequest(request))
        }
        Key::Direct {
            lane: Lane::StepAnswer,
            from,
            ..
        } => {
            let answer: Box<bumpless_core::protocol::StepAnswer> = Box::new(letter(len, bytes)?);
            agree("step answer", answer.from == from)?;
            Ok(Arrival::StepAnswer(answer))
        }
        Key::Direct {
            lane: Lane::Ping, from, ..
        } => letter::<wire::Token>(len, bytes).map(|token| Arrival::Ping { from, token: token.0 }),
        Key::Direct {
            lane: Lane::Pong, from, ..
        } => letter::<wire::Token>(len, bytes).map(|token| Arrival::Pong { from, token: token.0 }),
        Key::Record(id) => {
            let record: bumpless_core::Record = letter(len, bytes)?;
            agree("record", record.loop_id == id)?;
            Ok(Arrival::Record(Arc::new(record)))
        }
        Key::Vitals(host) => {
            let vitals: crate::Vitals = letter(len, bytes)?;
            agree("vitals message", vitals.host == host)?;
            Ok(Arrival::Vitals(vitals))
        }
        Key::Notice(from) if len <= NOTICE_BYTES_MAX => Ok(Arrival::Notice {
            from,
            payload: bytes().into_owned(),
        }),
        Key::Notice(_) => Err(Error::TooLarge {
            what: "notice",
            bytes: len,
            limit: NOTICE_BYTES_MAX,
        }),
        Key::Request { .. } | Key::Alive(..) | Key::Claim(_) | Key::Roll(_) => Err(Error::Key {
            key: cut(key, REPORTED_KEY_CHARS_MAX),
            reason: "it carries no messages",
        }),
    }
}

#[cfg(test)]
mod tests;
