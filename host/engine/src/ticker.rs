//! The clock of the engine's epochs: one thread that advances them every millisecond of absolute time.
//!
//! Owns: that thread, from creation to its end on drop (at most one tick later).
//! Never: decides that a step has taken too long; each store compares its own deadline when a tick reaches it.

use std::{
    num::NonZeroU64,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
};

use rustix::{
    thread::{clock_nanosleep_absolute, set_current_timer_slack},
    time::{ClockId, Timespec, clock_gettime},
};

use crate::Error;

/// Time between ticks, in ns: a limit is kept to within one tick, and the thread costs well under 1 % of a core.
const TICK_NS: i64 = 1_000_000;

/// Runs until dropped.
pub(crate) struct Ticker {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Ticker {
    /// Starts the thread.
    pub(crate) fn start(engine: wasmtime::Engine) -> Result<Self, Error> {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name("bl-epoch".to_owned())
            .stack_size(256 * 1024)
            .spawn(move || run(&engine, &stopped))
            .map_err(Error::Thread)?;
        Ok(Self {
            stop,
            thread: Some(thread),
        })
    }
}

impl Drop for Ticker {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread was already reported by the panic hook; there is nothing left to stop.
            drop(thread.join());
        }
    }
}

fn run(engine: &wasmtime::Engine, stop: &AtomicBool) {
    // Both are wishes: without them a tick comes some 50 µs, under load some ms, later, and nothing else changes.
    if let Err(error) = set_current_timer_slack(NonZeroU64::new(1)) {
        tracing::debug!(%error, "timer slack of the epoch thread stays as it is");
    }
    if let Err(error) = rustix::process::setpriority_process(None, -15) {
        tracing::debug!(%error, "priority of the epoch thread stays as it is");
    }
    let mut next = clock_gettime(ClockId::Monotonic);
    while !stop.load(Ordering::Relaxed) {
        let now = clock_gettime(ClockId::Monotonic);
        // After a suspension the lost ticks are skipped: one tick is enough to make every store look at its deadline.
        next = later(plus_tick(next), now);
        if let Err(error) = clock_nanosleep_absolute(ClockId::Monotonic, &next) {
            // A tick that comes early is harmless.
            tracing::trace!(%error, "a tick was interrupted");
        }
        engine.increment_epoch();
    }
}

fn plus_tick(t: Timespec) -> Timespec {
    let ns = t.tv_nsec + TICK_NS;
    Timespec {
        tv_sec: t.tv_sec + ns / 1_000_000_000,
        tv_nsec: ns % 1_000_000_000,
    }
}

fn later(a: Timespec, b: Timespec) -> Timespec {
    if (a.tv_sec, a.tv_nsec) >= (b.tv_sec, b.tv_nsec) {
        a
    } else {
        b
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_carry_into_seconds() {
        let t = plus_tick(Timespec {
            tv_sec: 4,
            tv_nsec: 999_500_000,
        });
        assert_eq!((t.tv_sec, t.tv_nsec), (5, 500_000));
        let early = Timespec { tv_sec: 4, tv_nsec: 0 };
        assert_eq!(later(early, t).tv_sec, 5);
        assert_eq!(later(t, early).tv_sec, 5);
    }
}
