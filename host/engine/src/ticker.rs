//! The watch over running calls: one thread that advances the engine's epoch when a call has run past its deadline.
//!
//! ```text
//!   call begins: its deadline stands in its thread's seat ──► guest runs ──► call ends: the seat is empty
//!
//!   the thread:  look ── nobody late ──► sleep until the next deadline that stands there, at most the shortest limit
//!                  ▲ └── somebody late ──► advance the epoch ──► sleep 125 µs ──┐
//!                  └────────────────────────────────────────────────────────────┘
//! ```
//! A call that begins after a look is seen at the next one, at the latest when its limit is over: so looking as often as the
//! shortest limit keeps every limit exactly, and a loop at 1 kHz costs two looks per cycle and not eight.
//!
//! Owns: that thread, from creation to its end on drop (at most one look later), and the seats.
//! Never: decides that a step has taken too long; each store compares its own deadline when the epoch reaches it.

use std::{
    num::NonZeroU64,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    thread::JoinHandle,
};

use rustix::{
    thread::{clock_nanosleep_absolute, set_current_timer_slack},
    time::{ClockId, Timespec, clock_gettime},
};

use crate::Error;

/// Longest time between looks, in ns: who begins with a short limit after a pause waits this long at most.
const LOOK_MAX_NS: u64 = 2_000_000;
/// Shortest time between looks, and between ticks while a call is late, in ns: a loop at 1 kHz must know within its period
/// that a step spins.
const LOOK_MIN_NS: u64 = 125_000;
/// A short limit is looked after for so long after the last call that had it, in ns.
const SHORT_FOR_NS: u64 = 1_000_000_000;
/// Threads with a seat of their own. Calls of further ones are not seen: while there are any, every look is a tick.
const SEATS: usize = 64;

/// Nobody sits here.
const EMPTY: u64 = 0;

/// Which seats of the process are taken, a bit each.
static TAKEN: AtomicU64 = AtomicU64::new(0);

/// A thread's seat, the same in every engine; given back when the thread ends.
struct Seat {
    number: Option<usize>,
    taken: &'static AtomicU64,
}

impl Seat {
    /// The first free one of those that `seats` has a bit each for, or none.
    fn take(seats: &'static AtomicU64) -> Self {
        let mut taken = seats.load(Ordering::Relaxed);
        let number = loop {
            let free = taken.trailing_ones();
            if free as usize >= SEATS {
                break None;
            }
            match seats.compare_exchange_weak(taken, taken | 1 << free, Ordering::Relaxed, Ordering::Relaxed) {
                Ok(_) => break Some(free as usize),
                Err(now) => taken = now,
            }
        };
        Self { number, taken: seats }
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        if let Some(number) = self.number {
            self.taken.fetch_and(!(1 << number), Ordering::Relaxed);
        }
    }
}

thread_local! {
    static SEAT: Seat = Seat::take(&TAKEN);
}

/// A seat's deadline on a line of its own, so that threads do not fight for it.
#[derive(Debug, Default)]
#[repr(align(64))]
struct Deadline(AtomicU64);

/// Calls that run, as the watching thread sees them. Cheap to clone.
#[derive(Debug, Clone)]
pub(crate) struct Calls(Arc<Seen>);

#[derive(Debug)]
struct Seen {
    seats: [Deadline; SEATS],
    /// Calls of threads without a seat.
    unseen: AtomicUsize,
    /// Time between looks, in ns.
    look_ns: AtomicU64,
    /// Until when that is needed, in ns of the monotonic clock.
    look_until_ns: AtomicU64,
}

impl Default for Calls {
    fn default() -> Self {
        Self(Arc::new(Seen {
            seats: std::array::from_fn(|_| Deadline::default()),
            unseen: AtomicUsize::new(0),
            look_ns: AtomicU64::new(LOOK_MAX_NS),
            look_until_ns: AtomicU64::new(0),
        }))
    }
}

/// A call that is watched until this is dropped.
#[derive(Debug)]
pub(crate) struct Watched<'a> {
    seen: &'a Seen,
    seat: Option<usize>,
    outer_ns: u64,
}

impl Drop for Watched<'_> {
    fn drop(&mut self) {
        match self.seat.and_then(|seat| self.seen.seats.get(seat)) {
            Some(deadline) => {
                deadline.0.store(self.outer_ns, Ordering::Relaxed);
            }
            None => {
                self.seen.unseen.fetch_sub(1, Ordering::Relaxed);
            }
        }
    }
}

impl Calls {
    /// A call begins now that must be over after `limit_ns`. Nearly always a handful of loads and stores.
    pub(crate) fn begin(&self, now_ns: u64, limit_ns: u64) -> Watched<'_> {
        // A thread that ends has no seat any more.
        let seat = SEAT.try_with(|seat| seat.number).ok().flatten();
        self.begin_in(seat, now_ns, limit_ns)
    }

    fn begin_in(&self, seat: Option<usize>, now_ns: u64, limit_ns: u64) -> Watched<'_> {
        let seen = &*self.0;
        let wish_ns = limit_ns.clamp(LOOK_MIN_NS, LOOK_MAX_NS);
        let look_ns = seen.look_ns.load(Ordering::Relaxed);
        if wish_ns < look_ns {
            seen.look_ns.store(wish_ns, Ordering::Relaxed);
        }
        // Only now and then, so that the threads of fast loops do not fight for the line.
        if wish_ns <= look_ns && seen.look_until_ns.load(Ordering::Relaxed) < now_ns + SHORT_FOR_NS / 2 {
            seen.look_until_ns.store(now_ns + SHORT_FOR_NS, Ordering::Relaxed);
        }
        let mut outer_ns = EMPTY;
        match seat.and_then(|seat| seen.seats.get(seat)) {
            Some(deadline) => {
                // Only this thread writes here: what stands there is a call that this one is within, and it is put back.
                outer_ns = deadline.0.load(Ordering::Relaxed);
                deadline.0.store(now_ns.saturating_add(limit_ns), Ordering::Relaxed);
            }
            None => {
                seen.unseen.fetch_add(1, Ordering::Relaxed);
            }
        }
        Watched { seen, seat, outer_ns }
    }

    /// Looks at all calls: is one late, and when is the next look?
    fn look(&self, now_ns: u64) -> (bool, u64) {
        let seen = &*self.0;
        if seen.look_until_ns.load(Ordering::Relaxed) < now_ns {
            seen.look_ns.store(LOOK_MAX_NS, Ordering::Relaxed);
        }
        let look_ns = seen.look_ns.load(Ordering::Relaxed);
        let first_ns = seen
            .seats
            .iter()
            .map(|seat| seat.0.load(Ordering::Relaxed))
            .filter(|deadline_ns| *deadline_ns != EMPTY)
            .min();
        let is_late = first_ns.is_some_and(|first_ns| first_ns <= now_ns);
        if is_late {
            return (true, now_ns + LOOK_MIN_NS);
        }
        let next_ns = first_ns.map_or(now_ns + look_ns, |first_ns| first_ns.min(now_ns + look_ns));
        (seen.unseen.load(Ordering::Relaxed) > 0, next_ns)
    }
}

/// Now, in ns of the clock that deadlines are told by.
pub(crate) fn monotonic_ns() -> u64 {
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
    pub(crate) fn start(engine: wasmtime::Engine, calls: Calls) -> Result<Self, Error> {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name("bl-epoch".to_owned())
            .stack_size(256 * 1024)
            .spawn(move || run(&engine, &calls, &stopped))
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

fn run(engine: &wasmtime::Engine, calls: &Calls, stop: &AtomicBool) {
    // Both are wishes: without them a look comes some 50 µs, under load some ms, later, and nothing else changes.
    if let Err(error) = set_current_timer_slack(NonZeroU64::new(1)) {
        tracing::debug!(%error, "timer slack of the epoch thread stays as it is");
    }
    if let Err(error) = rustix::process::setpriority_process(None, -15) {
        tracing::debug!(%error, "priority of the epoch thread stays as it is");
    }
    while !stop.load(Ordering::Relaxed) {
        let (is_late, next_ns) = calls.look(monotonic_ns());
        if is_late {
            engine.increment_epoch();
        }
        if let Err(error) = clock_nanosleep_absolute(ClockId::Monotonic, &at(next_ns)) {
            // A look that comes early is harmless.
            tracing::trace!(%error, "a look was interrupted");
        }
    }
}

fn at(ns: u64) -> Timespec {
    Timespec {
        tv_sec: i64::try_from(ns / 1_000_000_000).unwrap_or(i64::MAX),
        tv_nsec: i64::try_from(ns % 1_000_000_000).unwrap_or(0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const T: u64 = 10_000_000_000;

    #[test]
    fn the_next_look_is_at_the_first_deadline_or_after_the_shortest_limit() {
        let calls = Calls::default();
        assert_eq!(calls.look(T), (false, T + LOOK_MAX_NS));
        let slow = calls.begin_in(Some(3), T, 50_000_000);
        assert_eq!(calls.look(T), (false, T + LOOK_MAX_NS));
        assert_eq!(calls.look(T + 49_000_000), (false, T + 50_000_000));
        assert_eq!(calls.look(T + 50_000_000), (true, T + 50_000_000 + LOOK_MIN_NS));
        drop(slow);
        assert!(!calls.look(T + 50_000_000).0);

        let fast = calls.begin_in(Some(3), T, 500_000);
        drop(fast);
        assert_eq!(calls.look(T), (false, T + 500_000));
        // The short limit is forgotten once nobody had it for a second.
        let later = T + SHORT_FOR_NS + 1;
        assert_eq!(calls.look(later), (false, later + LOOK_MAX_NS));
    }

    #[test]
    fn a_call_within_a_call_leaves_the_outer_one_watched() {
        let calls = Calls::default();
        let outer = calls.begin_in(Some(3), T, 1_000_000);
        let inner = calls.begin_in(Some(3), T, 5_000_000);
        drop(inner);
        assert!(calls.look(T + 1_000_000).0);
        drop(outer);
        assert!(!calls.look(T + 1_000_000).0);
    }

    #[test]
    fn calls_without_a_seat_make_every_look_a_tick() {
        let calls = Calls::default();
        let call = calls.begin_in(None, T, 50_000_000);
        assert!(calls.look(T).0);
        drop(call);
        assert!(!calls.look(T).0);
    }

    #[test]
    fn seats_end_and_come_back() {
        static TAKEN: AtomicU64 = AtomicU64::new(0);
        let mut seats: Vec<Seat> = (0..SEATS).map(|_| Seat::take(&TAKEN)).collect();
        assert!(seats.iter().map(|seat| seat.number).eq((0..SEATS).map(Some)));
        assert_eq!(Seat::take(&TAKEN).number, None);
        drop(seats.remove(7));
        assert_eq!(Seat::take(&TAKEN).number, Some(7));
    }
}
