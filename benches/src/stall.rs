//! What the machine itself stalled: one bare thread per core that only sleeps to absolute deadlines.
//!
//! Owns: the threads, and the list of times at which they woke more than 1 ms late (beside a fast loop: a quarter of its
//! period). They run beside a bench, in the same class as the threads of the hosts' cycles, so what holds them up holds any
//! thread up: another machine on the same hardware, another program. Never: makes a gap or a lost cycle disappear; it says how
//! much of it the machine took.
//!
//! Times are ns since 1970 on a steady clock, as in an I/O host's journal.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
};

use bumpless_app::realtime::{self, Realtime};
use bumpless_io::Clock;
use rustix::{
    thread::{ClockId as SleepClock, CpuSet, clock_nanosleep_absolute, sched_getaffinity, sched_setaffinity},
    time::{ClockId, Timespec, clock_gettime},
};

use crate::{report::Report, spread::Spread};

/// Longest time between two deadlines, in ns. A wake-up later than that is a stall.
const PERIOD_NS_MAX: u64 = 1_000_000;
/// Deadlines per period of the loop that is measured: a stall that hides between two of them is a quarter of a cycle at most.
const LOOKS_PER_CYCLE: u64 = 4;
/// Shortest time between two deadlines, in ns: more would be a load of its own.
const PERIOD_NS_MIN: u64 = 200_000;
/// Stalls kept per core. A machine that stalls more often than this is no machine to measure on.
const STALLS_MAX: usize = 1_000_000;

/// Threads at work.
#[derive(Debug)]
pub(crate) struct Watch {
    stop: Arc<AtomicBool>,
    before: Ticks,
    threads: Vec<JoinHandle<(Vec<Stall>, Spread)>>,
}

/// From the deadline to the wake-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Stall {
    from_ns: u64,
    to_ns: u64,
}

/// What was found.
#[derive(Debug)]
pub(crate) struct Stalls {
    /// Times in which at least one core was stalled, in order, none touching the next.
    united: Vec<Stall>,
    count: usize,
    lateness: Spread,
    /// How the processors' time went, over the whole run.
    ticks: Ticks,
}

/// Time of all processors together since the machine started, in the kernel's ticks. Source: proc(5), `/proc/stat`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Ticks {
    all: u64,
    idle: u64,
    /// Taken by other machines on the same hardware.
    stolen: u64,
}

impl Ticks {
    fn now() -> Self {
        std::fs::read_to_string("/proc/stat").map_or_else(|_| Self::default(), |text| Self::of(&text))
    }

    /// The first line: user, nice, system, idle, iowait, irq, softirq, steal; what follows is part of the first two.
    fn of(text: &str) -> Self {
        let line = text.lines().next().unwrap_or_default();
        let fields: Vec<u64> = line
            .split_whitespace()
            .skip(1)
            .take(8)
            .filter_map(|f| f.parse().ok())
            .collect();
        let field = |number: usize| fields.get(number).copied().unwrap_or(0);
        Self {
            all: fields.iter().sum(),
            idle: field(3) + field(4),
            stolen: field(7),
        }
    }

    const fn since(self, before: Self) -> Self {
        Self {
            all: self.all.saturating_sub(before.all),
            idle: self.idle.saturating_sub(before.idle),
            stolen: self.stolen.saturating_sub(before.stolen),
        }
    }
}

impl Watch {
    /// Starts one thread per core that this process may use.
    pub(crate) fn start() -> Self {
        Self::beside(u64::MAX)
    }

    /// The same, fine enough for a loop of this period, in ns.
    pub(crate) fn beside(cycle_ns: u64) -> Self {
        let period_ns = (cycle_ns / LOOKS_PER_CYCLE).clamp(PERIOD_NS_MIN, PERIOD_NS_MAX);
        let stop = Arc::new(AtomicBool::new(false));
        let allowed = sched_getaffinity(None).ok();
        let cores: Vec<usize> = allowed
            .map(|set| (0..CpuSet::MAX_CPU).filter(|&core| set.is_set(core)).collect())
            .unwrap_or_default();
        let clock = Clock::start();
        let threads = cores
            .into_iter()
            .filter_map(|core| {
                let stop = Arc::clone(&stop);
                let thread = std::thread::Builder::new().name(format!("stall-{core}"));
                thread.spawn(move || watch(core, clock, period_ns, &stop)).ok()
            })
            .collect();
        Self {
            stop,
            before: Ticks::now(),
            threads,
        }
    }

    /// Ends the threads and gives what they found.
    pub(crate) fn finish(self) -> Stalls {
        self.stop.store(true, Ordering::Relaxed);
        let ticks = Ticks::now().since(self.before);
        let mut lateness = Spread::new();
        let mut all = Vec::new();
        for thread in self.threads {
            if let Ok((stalls, late)) = thread.join() {
                all.extend(stalls);
                lateness.join(&late);
            }
        }
        Stalls::of(all, lateness, ticks)
    }
}

/// Puts the threads that there are where a host's are: for benches that are a host themselves, once their rooms run.
pub(crate) fn as_a_host() {
    // Refusals only cost precision, and a wish that may be refused is no error.
    drop(realtime::raise(Realtime::Auto));
}

fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    // Never negative on Linux.
    u64::try_from(now.tv_sec).unwrap_or(0) * 1_000_000_000 + u64::try_from(now.tv_nsec).unwrap_or(0)
}

fn timespec(ns: u64) -> Timespec {
    Timespec {
        tv_sec: i64::try_from(ns / 1_000_000_000).unwrap_or(i64::MAX),
        // Below 10⁹, so it fits.
        tv_nsec: (ns % 1_000_000_000) as _,
    }
}

fn watch(core: usize, clock: Clock, period_ns: u64, stop: &AtomicBool) -> (Vec<Stall>, Spread) {
    let mut only = CpuSet::new();
    only.set(core);
    // Refusals only cost precision; a host that may not raise its threads runs at the usual priority too.
    let _ = realtime::raise_this_thread();
    let _ = sched_setaffinity(None, &only);
    let _ = rustix::thread::set_current_timer_slack(std::num::NonZeroU64::new(1));
    let (mut stalls, mut lateness) = (Vec::new(), Spread::new());
    let unix_minus_monotonic_ns = clock.now_ns().saturating_sub(monotonic_ns());
    let mut deadline_ns = monotonic_ns() + period_ns;
    loop {
        if clock_nanosleep_absolute(SleepClock::Monotonic, &timespec(deadline_ns)).is_err() {
            // A signal; the same deadline again.
            continue;
        }
        let now_ns = monotonic_ns();
        let late_ns = now_ns.saturating_sub(deadline_ns);
        lateness.add(late_ns);
        if late_ns > period_ns && stalls.len() < STALLS_MAX {
            stalls.push(Stall {
                from_ns: deadline_ns + unix_minus_monotonic_ns,
                to_ns: now_ns + unix_minus_monotonic_ns,
            });
        }
        // Deadlines that passed meanwhile are part of the same stall.
        deadline_ns += period_ns * (late_ns / period_ns + 1);
        if stop.load(Ordering::Relaxed) {
            return (stalls, lateness);
        }
    }
}

impl Stalls {
    fn of(mut all: Vec<Stall>, lateness: Spread, ticks: Ticks) -> Self {
        let count = all.len();
        all.sort_unstable_by_key(|stall| stall.from_ns);
        let mut united: Vec<Stall> = Vec::with_capacity(count);
        for stall in all {
            match united.last_mut() {
                Some(last) if stall.from_ns <= last.to_ns => last.to_ns = last.to_ns.max(stall.to_ns),
                _ => united.push(stall),
            }
        }
        Self {
            united,
            count,
            lateness,
            ticks,
        }
    }

    /// For how much of the time between the two a core was stalled, in ns.
    pub(crate) fn within_ns(&self, from_ns: u64, to_ns: u64) -> u64 {
        let first = self.united.partition_point(|stall| stall.to_ns <= from_ns);
        self.united
            .iter()
            .skip(first)
            .take_while(|stall| stall.from_ns < to_ns)
            .map(|stall| stall.to_ns.min(to_ns) - stall.from_ns.max(from_ns))
            .sum()
    }

    /// Tells what the machine stalled.
    pub(crate) fn tell(&self, report: &mut Report, bench: &str) {
        report.told(&format!("{bench}.machine.stalls"), self.count as f64, "stalls");
        let longest_ns = self.united.iter().map(|stall| stall.to_ns - stall.from_ns).max();
        report.told(
            &format!("{bench}.machine.longest_stall"),
            longest_ns.unwrap_or(0) as f64 / 1e6,
            "ms",
        );
        let Ticks { all, idle, stolen } = self.ticks;
        let percent = |ticks: u64| 100.0 * ticks as f64 / all.max(1) as f64;
        report.told(&format!("{bench}.machine.busy"), percent(all - idle), "%");
        report.told(&format!("{bench}.machine.stolen"), percent(stolen), "%");
        for (part, text) in [(0.5, "p50"), (0.99, "p99"), (0.999, "p99_9")] {
            report.told(
                &format!("{bench}.machine.timer_late.{text}"),
                self.lateness.us(part),
                "µs",
            );
        }
    }
}

impl Stalls {
    /// No stall at all: nothing is taken away then.
    pub(crate) fn none() -> Self {
        Self::of(Vec::new(), Spread::new(), Ticks::default())
    }
}

#[cfg(test)]
impl Stalls {
    /// Stalls of the given times, for tests.
    pub(crate) fn of_times(times: &[(u64, u64)]) -> Self {
        let all = times.iter().map(|&(from_ns, to_ns)| Stall { from_ns, to_ns }).collect();
        Self::of(all, Spread::new(), Ticks::default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stalls_of_several_cores_count_once() {
        let stalls = Stalls::of_times(&[(100, 200), (150, 250), (400, 500), (250, 260)]);
        assert_eq!(stalls.count, 4);
        for (from, to, stalled) in [
            (0, 1000, 260),
            (0, 100, 0),
            (120, 130, 10),
            (240, 420, 40),
            (260, 400, 0),
            (500, 600, 0),
        ] {
            assert_eq!(stalls.within_ns(from, to), stalled, "{from} to {to}");
        }
    }

    #[test]
    fn processor_time_is_read_from_the_first_line() {
        let before = Ticks::of("cpu  10 1 5 100 4 0 1 2 0 0\ncpu0 1 1 1 1 1 1 1 1 0 0\n");
        assert_eq!(
            before,
            Ticks {
                all: 123,
                idle: 104,
                stolen: 2
            }
        );
        let after = Ticks::of("cpu  20 1 5 180 4 0 1 12 7 0\n");
        assert_eq!(
            after.since(before),
            Ticks {
                all: 100,
                idle: 80,
                stolen: 10
            }
        );
        assert_eq!(Ticks::of(""), Ticks::default());
    }

    #[test]
    fn a_watch_takes_times_on_every_core() {
        let watch = Watch::start();
        let threads = watch.threads.len();
        assert!(threads > 0);
        let stalls = watch.finish();
        assert!(
            stalls.lateness.count() >= threads as u64,
            "each thread woke at least once"
        );
    }
}
