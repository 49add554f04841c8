//! The clock of the engine's epochs: one thread that advances them at absolute times, every millisecond, and eight times as
//! often while calls have limits that a millisecond is too coarse for.
//!
//! ```text
//!   coarse (1 ms) ── a call with a limit under 2 ms ──► fine (125 µs) ── none for a second ──► coarse
//! ```
//!
//! Owns: that thread, from creation to its end on drop (at most one tick later).
//! Never: decides that a step has taken too long; each store compares its own deadline when a tick reaches it.

use std::{
    num::NonZeroU64,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
};

use rustix::{
    thread::{clock_nanosleep_absolute, set_current_timer_slack},
    time::{ClockId, Timespec, clock_gettime},
};

use crate::Error;

/// Time between ticks, in ns: a limit is kept to within two ticks, and the thread costs well under 1 % of a core.
const COARSE_NS: i64 = 1_000_000;
/// The same while fast loops run: a loop at 1 kHz must know within its period that a step spins. Costs 2 to 3 % of a core.
const FINE_NS: i64 = 125_000;
/// Calls with a shorter limit than this need fine ticks, in ns.
const FAST_LIMIT_NS: u64 = 2_000_000;
/// Fine ticks last for so long after the last such call, in ns.
const FINE_FOR_NS: u64 = 1_000_000_000;

/// How finely time is to be cut; told by calls, read by the ticker.
#[derive(Debug, Clone, Default)]
pub(crate) struct Pace(Arc<AtomicU64>);

impl Pace {
    /// A call with this limit begins. Nearly always one load and nothing more.
    pub(crate) fn call(&self, limit_ns: u64) {
        if limit_ns < FAST_LIMIT_NS {
            let until_ns = monotonic_ns() + FINE_FOR_NS;
            // Only now and then, so that the threads of fast loops do not fight for the line.
            if self.0.load(Ordering::Relaxed) + FINE_FOR_NS / 2 < until_ns {
                self.0.store(until_ns, Ordering::Relaxed);
            }
        }
    }

    fn tick_ns(&self) -> i64 {
        // Without fast loops there is no need to look at the clock.
        match self.0.load(Ordering::Relaxed) {
            0 => COARSE_NS,
            until_ns if until_ns > monotonic_ns() => FINE_NS,
            _ => {
                self.0.store(0, Ordering::Relaxed);
                COARSE_NS
            }
        }
    }
}

fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    let (seconds, ns) = (u64::try_from(now.tv_sec), u64::try_from(now.tv_nsec));
    seconds
        .unwrap_or(0)
        .saturating_mul(1_000_000_000)
        .saturating_add(ns.unwrap_or(0))
}

/// Runs until dropped.
pub(crate) struct Ticker {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Ticker {
    /// Starts the thread.
    pub(crate) fn start(engine: wasmtime::Engine, pace: Pace) -> Result<Self, Error> {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name("bl-epoch".to_owned())
            .stack_size(256 * 1024)
            .spawn(move || run(&engine, &pace, &stopped))
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

fn run(engine: &wasmtime::Engine, pace: &Pace, stop: &AtomicBool) {
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
        next = later(plus(next, pace.tick_ns()), now);
        if let Err(error) = clock_nanosleep_absolute(ClockId::Monotonic, &next) {
            // A tick that comes early is harmless.
            tracing::trace!(%error, "a tick was interrupted");
        }
        engine.increment_epoch();
    }
}

fn plus(t: Timespec, tick_ns: i64) -> Timespec {
    let ns = t.tv_nsec + tick_ns;
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
        let half = Timespec {
            tv_sec: 4,
            tv_nsec: 999_500_000,
        };
        let t = plus(half, COARSE_NS);
        assert_eq!((t.tv_sec, t.tv_nsec), (5, 500_000));
        let early = Timespec { tv_sec: 4, tv_nsec: 0 };
        assert_eq!(later(early, t).tv_sec, 5);
        assert_eq!(later(t, early).tv_sec, 5);
    }

    #[test]
    fn only_short_limits_make_ticks_fine_and_only_for_a_while() {
        let pace = Pace::default();
        pace.call(FAST_LIMIT_NS);
        assert_eq!(pace.tick_ns(), COARSE_NS);
        pace.call(FAST_LIMIT_NS - 1);
        assert_eq!(pace.tick_ns(), FINE_NS);
        // As if the second had passed.
        pace.0.store(1, Ordering::Relaxed);
        assert_eq!(pace.tick_ns(), COARSE_NS);
        assert_eq!(
            pace.0.load(Ordering::Relaxed),
            0,
            "the clock is left alone until the next short limit"
        );
    }
}
