//! A Modbus bus as the server of points sees it: an image to read, an outbox to write, tasks that run the connections.
//!
//! Never: waits for the device.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
        mpsc,
    },
    time::Duration,
};

use bumpless_core::Reading;
use parking_lot::Mutex;
use tokio::sync::watch;

use super::{
    Plan,
    link::Link,
    outbox::{Outbox, Wish, encoded},
};
use crate::{
    BusStatus, Clock, Errand, Error,
    config::OnStop,
    errand::{Asked, Post},
    image::Image,
    limits::CLOSE_WAIT_MS,
    master::{Keeper, Mastership, RedundantPlan},
    rest::Rest,
    status::StatusCell,
};

/// What the tasks and the server share.
#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) plan: Plan,
    pub(crate) image: Image,
    pub(crate) outbox: Outbox,
    pub(crate) status: StatusCell,
    pub(crate) clock: Clock,
    /// Of a device with two masters: may this one write? None where there is only one.
    pub(crate) mastership: Option<Arc<Mastership>>,
    /// What came of the last writes, by connection: how many safe values it has, and why they are not confirmed. A connection that
    /// was not there at the end has no entry.
    pub(crate) rests: Mutex<BTreeMap<usize, Option<String>>>,
    /// One bit for each connection over which a unit answers.
    answering: AtomicU32,
}

impl Shared {
    /// May the device be written now?
    pub(crate) fn may_write(&self) -> bool {
        self.mastership.as_ref().is_none_or(|mastership| mastership.may_write())
    }

    /// A connection's units answer, or none of them does.
    pub(crate) fn answers(&self, lane: usize, answers: bool) {
        let bit = 1_u32 << lane.min(31);
        let before = if answers {
            self.answering.fetch_or(bit, Ordering::AcqRel)
        } else {
            self.answering.fetch_and(!bit, Ordering::AcqRel)
        };
        if (before & bit != 0) != answers {
            let any = if answers { true } else { before & !bit != 0 };
            self.status.update(|s| s.connected = any);
        }
    }
}

/// A Modbus bus at work.
#[derive(Debug)]
pub(crate) struct ModbusDriver {
    shared: Arc<Shared>,
    /// Stops the keeper of the lease, which then stops the links; the links themselves where there is no keeper.
    stop: watch::Sender<bool>,
    epoch: watch::Receiver<Option<u32>>,
    /// The units, in order; the connection of one is its rank, round robin.
    units: Vec<u8>,
    /// The way of errands to each connection.
    posts: Vec<Post>,
    /// Closes when every task has ended.
    ended: Mutex<mpsc::Receiver<()>>,
}

impl ModbusDriver {
    /// Starts the tasks, one for each connection that has units.
    pub(crate) fn start(plan: Plan, clock: Clock, runtime: &tokio::runtime::Handle) -> Self {
        // The task says at once when the device is gone; this bound is for a task that cannot even do that.
        let tries = 2 * (1 + u64::from(plan.retries));
        let stale_ns = |period_ms: u64| (3 * period_ms + tries * plan.timeout_ms).saturating_mul(1_000_000);
        let units = plan.units();
        let lane = |unit_id: u8| units.binary_search(&unit_id).unwrap_or(0) % plan.connections.max(1);
        let lanes: Vec<u8> = plan.points.iter().map(|p| lane(p.unit_id) as u8).collect();
        let count = units.len().min(plan.connections.max(1));
        let shared = Arc::new(Shared {
            image: Image::new(plan.points.iter().map(|p| stale_ns(p.period_ms))),
            outbox: Outbox::new(lanes, ms_to_ns(plan.write_repeat_ms), ms_to_ns(plan.write_expiry_ms)),
            status: StatusCell::new(plan.bus.clone(), plan.way.driver(), false, plan.points.len()),
            clock,
            rests: Mutex::default(),
            answering: AtomicU32::new(0),
            mastership: plan.redundant.as_ref().map(|_| Arc::default()),
            plan,
        });
        let (stop, stopped) = watch::channel(false);
        let (ending, ended) = mpsc::channel();
        let mut posts = Vec::with_capacity(count);
        for number in 0..count {
            let (post, errands) = Post::new();
            posts.push(post);
            let own = units.iter().copied().skip(number).step_by(count).collect();
            let link = Link::new(Arc::clone(&shared), number, own, stopped.clone(), errands);
            let ending: mpsc::Sender<()> = ending.clone();
            runtime.spawn(async move {
                // Dropped with the task, however it ends.
                let _ending = ending;
                link.run().await;
            });
        }
        let (told, epoch) = watch::channel(None);
        let mut outer = stop.clone();
        if let (Some(plan), Some(mastership)) = (&shared.plan.redundant, &shared.mastership)
            && let Some(post) = posts.get(units.binary_search(&plan.unit_id).unwrap_or(0) % posts.len().max(1))
        {
            let keeper = Keeper {
                plan: plan.clone(),
                mastership: Arc::clone(mastership),
                post: post.clone(),
                timeout_ms: shared.plan.timeout_ms,
                epoch: told,
            };
            let (bus, (stop_keeper, keeper_stopped)) = (shared.plan.bus.to_string(), watch::channel(false));
            let stop_links = std::mem::replace(&mut outer, stop_keeper);
            runtime.spawn(async move {
                keeper.run(&bus, keeper_stopped).await;
                stop_links.send_replace(true);
            });
        }
        Self {
            shared,
            stop: outer,
            epoch,
            units,
            posts,
            ended: Mutex::new(ended),
        }
    }

    pub(crate) fn read(&self, point: usize, now_ns: u64) -> Reading {
        self.shared.image.read(point, now_ns)
    }

    /// Hands checked values to the tasks.
    pub(crate) fn write(&self, writes: impl Iterator<Item = (usize, f64)>, now_ns: u64) {
        for (point, value) in writes {
            // Of two masters only one has a say; what the other was told by hand or by force would be old when it takes over.
            if let Some(planned) = self.shared.plan.points.get(point).filter(|_| self.shared.may_write()) {
                self.shared.outbox.put(Wish {
                    point,
                    words: encoded(planned, value),
                    at_ns: now_ns,
                });
            }
        }
    }

    /// Puts an errand into the queue of its unit's connection; a unit without points is asked over the first one.
    pub(crate) fn errand(&self, errand: Errand, until: std::time::Instant) -> Result<Asked, Error> {
        let rank = self.units.binary_search(&errand.unit_id()).unwrap_or(0);
        let post = self.posts.get(rank % self.posts.len().max(1)).ok_or(Error::Closed)?;
        post.send(&self.shared.plan.bus, errand, until)
    }

    /// May the device be written by this host now?
    pub(crate) fn may_write(&self) -> bool {
        self.shared.may_write()
    }

    /// Of a device with two masters: does this host's own connection work, so that it could take over?
    pub(crate) fn reaches_the_lease(&self) -> bool {
        let within = |plan: &RedundantPlan, mastership: &Mastership| mastership.reached_within(plan.times.lease_ns);
        let reached = self
            .shared
            .plan
            .redundant
            .as_ref()
            .zip(self.shared.mastership.as_deref());
        self.status().connected && reached.is_some_and(|(plan, mastership)| within(plan, mastership))
    }

    /// The number of the mastership, while this host has it; changes as it goes over. None for a bus with one master.
    pub(crate) fn epoch(&self) -> Option<watch::Receiver<Option<u32>>> {
        self.shared.plan.redundant.as_ref().map(|_| self.epoch.clone())
    }

    /// What the bus was planned with.
    pub(crate) fn plan(&self) -> &Plan {
        &self.shared.plan
    }

    pub(crate) fn status(&self) -> BusStatus {
        self.shared.status.get()
    }

    /// Tells the tasks to bring their outputs to rest and end.
    pub(crate) fn stop(&self) {
        self.stop.send_replace(true);
    }

    /// Waits for them, with a bound. Gives how they left the outputs.
    pub(crate) fn wait_for_end(&self) -> Rest {
        let longest = Duration::from_millis(CLOSE_WAIT_MS + self.shared.plan.timeout_ms);
        if self.ended.lock().recv_timeout(longest) == Err(mpsc::RecvTimeoutError::Timeout) {
            tracing::warn!(bus = %self.shared.plan.bus, "the bus did not end in time");
        }
        self.rest()
    }

    fn rest(&self) -> Rest {
        let plan = &self.shared.plan;
        let mut rest = Rest::held(plan.bus.clone());
        if plan.on_stop == OnStop::Hold {
            return rest;
        }
        rest.wanted = OnStop::Safe;
        let rests = self.shared.rests.lock();
        for planned in plan.points.iter().filter(|planned| planned.safe.is_some()) {
            let lane = self.units.binary_search(&planned.unit_id).unwrap_or(0) % self.posts.len().max(1);
            rest.outputs += 1;
            match rests.get(&lane) {
                Some(None) => rest.confirmed += 1,
                Some(Some(reason)) => rest.reason = Some(reason.clone()),
                None => rest.reason = Some("there was no connection to the device at the end".to_owned()),
            }
        }
        rest
    }
}

const fn ms_to_ns(ms: u64) -> u64 {
    ms.saturating_mul(1_000_000)
}
