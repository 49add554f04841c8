//! A program's part of the processor: so much in each window of 100 ms, and no more than 5 ms at a time.
//!
//! Owns: the account of one run. Pure: times are arguments.

/// Length of a window, in ns: long enough that a script's burst of work passes, short enough that nobody waits long for it.
const WINDOW_NS: u64 = 100_000_000;
/// Longest turn before others may go, in ns.
const TURN_NS: u64 = 5_000_000;

/// How a run goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Next {
    /// At once.
    Go,
    /// When those that wait had their turn.
    Yield,
    /// Then, in ns.
    At(u64),
}

/// The account of one run.
#[derive(Debug)]
pub(crate) struct Share {
    percent: u64,
    window_from_ns: u64,
    /// Processor time when the window began.
    window_used_ns: u64,
    /// Processor time when the turn began.
    turn_used_ns: u64,
}

impl Share {
    pub(crate) fn new(percent: u8, now_ns: u64) -> Self {
        Self {
            percent: u64::from(percent.clamp(1, 100)),
            window_from_ns: now_ns,
            window_used_ns: 0,
            turn_used_ns: 0,
        }
    }

    /// Asked while the guest runs. `used_ns` is its processor time in all.
    pub(crate) fn next(&mut self, now_ns: u64, used_ns: u64) -> Next {
        if now_ns.saturating_sub(self.window_from_ns) >= WINDOW_NS {
            self.window_from_ns = now_ns;
            self.window_used_ns = used_ns;
        }
        let spent_ns = used_ns.saturating_sub(self.window_used_ns);
        if self.percent < 100 && spent_ns >= WINDOW_NS / 100 * self.percent {
            // A turn that went over its part is paid for by a longer pause.
            self.turn_used_ns = used_ns;
            return Next::At(self.window_from_ns + (spent_ns * 100 / self.percent).max(WINDOW_NS));
        }
        if used_ns.saturating_sub(self.turn_used_ns) >= TURN_NS {
            self.turn_used_ns = used_ns;
            return Next::Yield;
        }
        Next::Go
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn a_program_that_spins_gets_its_part_and_no_more() {
        for percent in [1, 10, 25, 50, 100] {
            let mut share = Share::new(percent, 0);
            let (mut now, mut used) = (0, 0);
            while now < 10_000 * MS {
                now += MS;
                used += MS;
                match share.next(now, used) {
                    Next::Go | Next::Yield => {}
                    Next::At(at) => now = now.max(at),
                }
            }
            let part = used as f64 / now as f64 * 100.0;
            assert!((part - f64::from(percent)).abs() <= 1.0, "{percent}: {part}");
        }
    }

    #[test]
    fn turns_are_short_and_a_quiet_program_never_waits() {
        let mut share = Share::new(100, 0);
        let turns: Vec<Next> = (1..=5).map(|ms| share.next(ms * MS, ms * MS)).collect();
        assert_eq!(turns, [Next::Go, Next::Go, Next::Go, Next::Go, Next::Yield]);
        let mut share = Share::new(10, 0);
        assert!((1..1_000).all(|n| share.next(n * 50 * MS, n * MS) != Next::At(0) && n > 0));
        assert_eq!(share.next(60_000 * MS, 1_000 * MS), Next::Yield);
    }
}
