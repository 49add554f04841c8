//! The publishers of a session: declared once per (host, lane), per loop, and for the host's own news.
//!
//! Owns: the two caches and the quality of service of each lane. Never: blocks a sender; waits for the network.
//!
//! ```text
//! lane                              priority     when the link is full
//! sample answer step … ping pong    real time    drop: the cycle's deadline copes
//! record                            real time    drop: in one queue with the samples, so that a record is not overtaken
//! vitals notice claim roll               data high    drop: the next one says more
//! request and reply                 data low     block, on a thread that may wait
//! ```
//!
//! A priority has one queue and one lock in Zenoh. So a lane that blocks shares its priority with no lane that drops.

use std::{collections::HashMap, sync::Arc};

use bumpless_core::{HostId, LoopId};
use parking_lot::{Mutex, RwLock};
use zenoh::{
    Wait,
    pubsub::Publisher,
    qos::{CongestionControl, Priority},
    sample::Locality,
};

use crate::{
    error::Error,
    keys::{Key, Keys, Lane},
    limits::{HOSTS_MAX, RECORD_LANES_MAX},
};

/// The lanes to one host.
#[derive(Debug)]
struct HostLanes {
    sample: Publisher<'static>,
    answer: Publisher<'static>,
    step: Publisher<'static>,
    step_answer: Publisher<'static>,
    ping: Publisher<'static>,
    pong: Publisher<'static>,
}

impl HostLanes {
    const fn get(&self, lane: Lane) -> &Publisher<'static> {
        match lane {
            Lane::Sample => &self.sample,
            Lane::Answer => &self.answer,
            Lane::Step => &self.step,
            Lane::StepAnswer => &self.step_answer,
            Lane::Ping => &self.ping,
            Lane::Pong => &self.pong,
        }
    }
}

/// Every publisher of a session.
#[derive(Debug)]
pub(crate) struct Lanes {
    keys: Keys,
    host: HostId,
    hosts: RwLock<HashMap<HostId, Arc<HostLanes>>>,
    records: RwLock<HashMap<LoopId, Arc<Publisher<'static>>>>,
    /// Held while lanes are declared or let go. Two declarations of one key at a time confuse Zenoh: an interest is taken
    /// back before it was sent, and what was sent between is lost.
    declaring: Mutex<()>,
    vitals: Publisher<'static>,
    notice: Publisher<'static>,
    claim: Publisher<'static>,
    roll: Publisher<'static>,
}

impl Lanes {
    pub(crate) fn new(zenoh: &zenoh::Session, keys: Keys, host: HostId) -> Result<Self, Error> {
        let news = |key| declare(zenoh, keys.build(&key), Priority::DataHigh, Locality::Remote);
        Ok(Self {
            vitals: news(Key::Vitals(host.clone()))?,
            notice: news(Key::Notice(host.clone()))?,
            claim: news(Key::Claim(host.clone()))?,
            roll: news(Key::Roll(host.clone()))?,
            keys,
            host,
            hosts: RwLock::default(),
            records: RwLock::default(),
            declaring: Mutex::default(),
        })
    }

    /// Sends to one host. Its lanes are declared by the first call, if [`Lanes::warm`] did not come first.
    pub(crate) fn direct(&self, zenoh: &zenoh::Session, to: &HostId, lane: Lane, bytes: Vec<u8>) -> Result<(), Error> {
        put(self.host_lanes(zenoh, to)?.get(lane), lane.name(), bytes)
    }

    /// Sends a record to all.
    pub(crate) fn record(&self, zenoh: &zenoh::Session, id: &LoopId, bytes: Vec<u8>) -> Result<(), Error> {
        let publisher = self.record_lane(zenoh, id)?;
        put(&publisher, "record", bytes)
    }

    pub(crate) fn vitals(&self, bytes: Vec<u8>) -> Result<(), Error> {
        put(&self.vitals, "vitals message", bytes)
    }

    pub(crate) fn notice(&self, bytes: Vec<u8>) -> Result<(), Error> {
        put(&self.notice, "notice", bytes)
    }

    pub(crate) fn claim(&self, bytes: Vec<u8>) -> Result<(), Error> {
        put(&self.claim, "claim to a name", bytes)
    }

    pub(crate) fn roll(&self, bytes: Vec<u8>) -> Result<(), Error> {
        put(&self.roll, "roll call", bytes)
    }

    /// Declares the lanes to a host, so that no cycle has to.
    pub(crate) fn warm(&self, zenoh: &zenoh::Session, to: &HostId) -> Result<(), Error> {
        self.host_lanes(zenoh, to).map(drop)
    }

    /// Lets the lanes to a host go. They come back by themselves if they are used.
    pub(crate) fn forget_host(&self, to: &HostId) {
        let _declaring = self.declaring.lock();
        // Undeclared when the value is dropped: after the lock that senders take.
        let gone = self.hosts.write().remove(to);
        drop(gone);
    }

    /// Lets the record lane of a loop go.
    pub(crate) fn forget_loop(&self, id: &LoopId) {
        let _declaring = self.declaring.lock();
        let gone = self.records.write().remove(id);
        drop(gone);
    }

    fn record_lane(&self, zenoh: &zenoh::Session, id: &LoopId) -> Result<Arc<Publisher<'static>>, Error> {
        let known = || self.records.read().get(id).cloned();
        if let Some(lane) = known() {
            return Ok(lane);
        }
        let _declaring = self.declaring.lock();
        // Another thread may have been first.
        if let Some(lane) = known() {
            return Ok(lane);
        }
        if self.records.read().len() >= RECORD_LANES_MAX {
            return Err(Error::TooMany {
                what: "record lanes",
                limit: RECORD_LANES_MAX,
            });
        }
        // Declared outside the lock that senders take, so that no other loop waits for it.
        let key = self.keys.build(&Key::Record(id.clone()));
        let lane = Arc::new(declare(zenoh, key, Priority::RealTime, Locality::Remote)?);
        self.records.write().insert(id.clone(), Arc::clone(&lane));
        Ok(lane)
    }

    fn host_lanes(&self, zenoh: &zenoh::Session, to: &HostId) -> Result<Arc<HostLanes>, Error> {
        let known = || self.hosts.read().get(to).cloned();
        if let Some(lanes) = known() {
            return Ok(lanes);
        }
        let _declaring = self.declaring.lock();
        if let Some(lanes) = known() {
            return Ok(lanes);
        }
        if self.hosts.read().len() >= HOSTS_MAX {
            return Err(Error::TooMany {
                what: "hosts",
                limit: HOSTS_MAX,
            });
        }
        let lane = |lane| {
            let key = self.keys.build(&Key::Direct {
                to: to.clone(),
                lane,
                from: self.host.clone(),
            });
            declare(zenoh, key, Priority::RealTime, Locality::Any)
        };
        let lanes = Arc::new(HostLanes {
            sample: lane(Lane::Sample)?,
            answer: lane(Lane::Answer)?,
            step: lane(Lane::Step)?,
            step_answer: lane(Lane::StepAnswer)?,
            ping: lane(Lane::Ping)?,
            pong: lane(Lane::Pong)?,
        });
        self.hosts.write().insert(to.clone(), Arc::clone(&lanes));
        Ok(lanes)
    }
}

fn declare(
    zenoh: &zenoh::Session,
    key: String,
    priority: Priority,
    destination: Locality,
) -> Result<Publisher<'static>, Error> {
    // No `express`: it gains no latency here, costs several times the processor time, and loses messages.
    zenoh
        .declare_publisher(key.clone())
        .congestion_control(CongestionControl::Drop)
        .priority(priority)
        .allowed_destination(destination)
        .wait()
        .map_err(|source| Error::Declare { key, source })
}

fn put(publisher: &Publisher<'static>, what: &'static str, bytes: Vec<u8>) -> Result<(), Error> {
    publisher
        .put(bytes)
        .wait()
        .map_err(|source| Error::Send { what, source })
}
