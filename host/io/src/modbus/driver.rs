//! A Modbus bus as the server sees it: an image to read, an outbox to write, a task that runs the connection.
//!
//! Never: waits for the device.

use std::{
    sync::{Arc, mpsc},
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
    errand::{Asked, Post},
    image::Image,
    limits::CLOSE_WAIT_MS,
    status::StatusCell,
};

/// What the task and the server share.
#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) plan: Plan,
    pub(crate) image: Image,
    pub(crate) outbox: Outbox,
    pub(crate) status: StatusCell,
    pub(crate) clock: Clock,
}

/// A Modbus bus at work.
#[derive(Debug)]
pub(crate) struct ModbusDriver {
    shared: Arc<Shared>,
    stop: watch::Sender<bool>,
    post: Post,
    /// Closes when the task has ended.
    ended: Mutex<mpsc::Receiver<()>>,
}

impl ModbusDriver {
    /// Starts the task.
    pub(crate) fn start(plan: Plan, clock: Clock, runtime: &tokio::runtime::Handle) -> Self {
        // The task says at once when the device is gone; this bound is for a task that cannot even do that.
        let stale_ns = |period_ms: u64| (3 * period_ms + 2 * plan.timeout_ms).saturating_mul(1_000_000);
        let shared = Arc::new(Shared {
            image: Image::new(plan.points.iter().map(|p| stale_ns(p.period_ms))),
            outbox: Outbox::new(
                plan.points.len(),
                ms_to_ns(plan.write_repeat_ms),
                ms_to_ns(plan.write_expiry_ms),
            ),
            status: StatusCell::new(plan.bus.clone(), "modbus-tcp", false, plan.points.len()),
            clock,
            plan,
        });
        let (stop, stopped) = watch::channel(false);
        let (ending, ended) = mpsc::channel();
        let (post, errands) = Post::new();
        let link = Link::new(shared.clone(), stopped, errands);
        runtime.spawn(async move {
            // Dropped with the task, however it ends.
            let _ending: mpsc::Sender<()> = ending;
            link.run().await;
        });
        Self {
            shared,
            stop,
            post,
            ended: Mutex::new(ended),
        }
    }

    pub(crate) fn read(&self, point: usize, now_ns: u64) -> Reading {
        self.shared.image.read(point, now_ns)
    }

    /// Hands checked values to the task.
    pub(crate) fn write(&self, writes: impl Iterator<Item = (usize, f64)>, now_ns: u64) {
        for (point, value) in writes {
            if let Some(planned) = self.shared.plan.points.get(point) {
                self.shared.outbox.put(Wish {
                    point,
                    words: encoded(planned, value),
                    at_ns: now_ns,
                });
            }
        }
    }

    /// Puts an errand into the bus's queue.
    pub(crate) fn errand(&self, errand: Errand, until: std::time::Instant) -> Result<Asked, Error> {
        self.post.send(&self.shared.plan.bus, errand, until)
    }

    /// What the bus was planned with.
    pub(crate) fn plan(&self) -> &Plan {
        &self.shared.plan
    }

    pub(crate) fn status(&self) -> BusStatus {
        self.shared.status.get()
    }

    /// Tells the task to bring its outputs to rest and end.
    pub(crate) fn stop(&self) {
        self.stop.send_replace(true);
    }

    /// Waits for it, with a bound.
    pub(crate) fn wait_for_end(&self) {
        let longest = Duration::from_millis(CLOSE_WAIT_MS + self.shared.plan.timeout_ms);
        if self.ended.lock().recv_timeout(longest) == Err(mpsc::RecvTimeoutError::Timeout) {
            tracing::warn!(bus = %self.shared.plan.bus, "the bus did not end in time");
        }
    }
}

const fn ms_to_ns(ms: u64) -> u64 {
    ms.saturating_mul(1_000_000)
}
