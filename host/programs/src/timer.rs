//! The clock of programs: one thread that wakes whoever waits, within about 100 µs.
//!
//! The runtime's own timers count in ms, which is as long as the shortest period that a program keeps. Wake-ups of one tenth of a
//! ms are done together, so that thousands of sleepers cost at most ten thousand turns of the thread a second.
//!
//! Owns: the thread and the wakers that wait. Never: runs a program, or holds its lock while it wakes somebody.

use std::{
    collections::BTreeMap,
    num::NonZeroU64,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, Waker},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use parking_lot::{Condvar, Mutex};

use crate::Error;

/// Wake-ups within it are one, in ns.
const GRAIN_NS: u64 = 100_000;
/// Longest entry, in ns: a waker of a run that is gone is forgotten after it, and a longer wait is asked for again.
const ENTRY_NS_MAX: u64 = 1_000_000_000;

/// The clock. Cheap to clone.
#[derive(Clone)]
pub(crate) struct Timer(Arc<Shared>);

struct Shared {
    epoch: Instant,
    state: Mutex<State>,
    changed: Condvar,
    thread: Mutex<Option<JoinHandle<()>>>,
}

#[derive(Default)]
struct State {
    /// By grains since the epoch.
    waiting: BTreeMap<u64, Vec<Waker>>,
    closed: bool,
}

impl Timer {
    pub(crate) fn start() -> Result<Self, Error> {
        let timer = Self(Arc::new(Shared {
            epoch: Instant::now(),
            state: Mutex::default(),
            changed: Condvar::new(),
            thread: Mutex::default(),
        }));
        let shared = Arc::clone(&timer.0);
        let thread = std::thread::Builder::new()
            .name("bl-prog-timer".to_owned())
            .stack_size(128 * 1024)
            .spawn(move || shared.wake())
            .map_err(Error::Thread)?;
        *timer.0.thread.lock() = Some(thread);
        Ok(timer)
    }

    /// Now, in ns of this clock.
    pub(crate) fn now_ns(&self) -> u64 {
        u64::try_from(self.0.epoch.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }

    /// Waits until then.
    pub(crate) fn until(&self, at_ns: u64) -> Until {
        Until {
            timer: self.clone(),
            at_ns,
        }
    }

    /// Ends the thread. Who waits is not woken any more.
    pub(crate) fn close(&self) {
        self.0.state.lock().closed = true;
        self.0.changed.notify_all();
        let thread = self.0.thread.lock().take();
        if let Some(thread) = thread {
            // A panic of the thread was already reported by the panic hook; there is nothing left to stop.
            drop(thread.join());
        }
    }

    fn enter(&self, at_ns: u64, waker: &Waker) {
        let grain = at_ns.div_ceil(GRAIN_NS);
        let mut state = self.0.state.lock();
        let first = state.waiting.first_key_value().map(|(grain, _)| *grain);
        state.waiting.entry(grain).or_default().push(waker.clone());
        if first.is_none_or(|first| grain < first) {
            self.0.changed.notify_one();
        }
    }
}

impl Shared {
    fn wake(&self) {
        // A wish: without it a wake-up comes some 50 µs later.
        if let Err(error) = rustix::thread::set_current_timer_slack(NonZeroU64::new(1)) {
            tracing::debug!(%error, "timer slack of the programs' clock stays as it is");
        }
        let mut state = self.state.lock();
        while !state.closed {
            let now = self.epoch.elapsed();
            let grain = u64::try_from(now.as_nanos()).unwrap_or(u64::MAX) / GRAIN_NS;
            let later = state.waiting.split_off(&(grain + 1));
            let due = std::mem::replace(&mut state.waiting, later);
            if !due.is_empty() {
                parking_lot::MutexGuard::unlocked(&mut state, || {
                    due.into_values().flatten().for_each(Waker::wake);
                });
                continue;
            }
            match state.waiting.first_key_value() {
                Some((first, _)) => {
                    let at = self.epoch + Duration::from_nanos(first.saturating_mul(GRAIN_NS));
                    self.changed.wait_until(&mut state, at);
                }
                None => self.changed.wait(&mut state),
            }
        }
    }
}

/// A wait.
pub(crate) struct Until {
    timer: Timer,
    at_ns: u64,
}

impl Future for Until {
    type Output = ();

    fn poll(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<()> {
        let now_ns = self.timer.now_ns();
        if now_ns >= self.at_ns {
            return Poll::Ready(());
        }
        self.timer
            .enter(self.at_ns.min(now_ns.saturating_add(ENTRY_NS_MAX)), context.waker());
        Poll::Pending
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn nobody_is_woken_too_early_and_a_closed_clock_ends() {
        let timer = Timer::start().unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        for wait_ns in [0, 1, 150_000, 3_000_000] {
            let at_ns = timer.now_ns() + wait_ns;
            runtime.block_on(timer.until(at_ns));
            assert!(timer.now_ns() >= at_ns);
        }
        timer.close();
        assert!(timer.0.thread.lock().is_none());
    }
}
