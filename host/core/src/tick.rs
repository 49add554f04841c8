//! When cycles are due: absolute deadlines, never "now plus a period", so that lateness does not add up.
//!
//! Never: reads a clock. A deadline that was missed by whole periods is skipped and counted, not run in a burst, because
//! an actuator gains nothing from several writes at once.

/// The schedule of one loop.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tick {
    period_ns: u64,
    next_at_ns: u64,
    next_seq: u64,
}

/// One deadline that came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fired {
    /// Number of the cycle.
    pub seq: u64,
    /// The deadline itself, in ns; at or before now.
    pub at_ns: u64,
    /// Cycles that were skipped because the caller came too late for them.
    pub skipped: u64,
}

impl Tick {
    /// The first deadline is the first time after `now_ns` that lies `phase_ns` after a multiple of the period, so loops
    /// of one period keep their phases through restarts.
    #[must_use]
    pub fn start(now_ns: u64, period_ns: u64, phase_ns: u64, first_seq: u64) -> Self {
        let period_ns = period_ns.max(1);
        let phase_ns = phase_ns % period_ns;
        let base = now_ns - now_ns % period_ns + phase_ns;
        let next_at_ns = if base > now_ns { base } else { base + period_ns };
        Self {
            period_ns,
            next_at_ns,
            next_seq: first_seq,
        }
    }

    /// The next deadline, in ns.
    #[must_use]
    pub const fn next_at_ns(&self) -> u64 {
        self.next_at_ns
    }

    /// The period, in ns.
    #[must_use]
    pub const fn period_ns(&self) -> u64 {
        self.period_ns
    }

    /// Takes the deadline that is due, or none where none is.
    pub fn fire(&mut self, now_ns: u64) -> Option<Fired> {
        let late_ns = now_ns.checked_sub(self.next_at_ns)?;
        let skipped = late_ns / self.period_ns;
        let fired = Fired {
            seq: self.next_seq + skipped,
            at_ns: self.next_at_ns + skipped * self.period_ns,
            skipped,
        };
        self.next_seq = fired.seq + 1;
        self.next_at_ns = fired.at_ns + self.period_ns;
        Some(fired)
    }

    /// Goes on with another period from now; cycle numbers continue.
    pub fn set_period(&mut self, now_ns: u64, period_ns: u64, phase_ns: u64) {
        *self = Self::start(now_ns, period_ns, phase_ns, self.next_seq);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn deadlines_never_drift_and_numbers_only_grow(
            start in 0u64..1_000_000_000_000,
            period in 1_000u64..10_000_000,
            phase in 0u64..10_000_000,
            waits in prop::collection::vec(0u64..50_000_000, 1..60),
        ) {
            let mut tick = Tick::start(start, period, phase, 7);
            prop_assert!(tick.next_at_ns() > start && tick.next_at_ns() <= start + period);
            let (mut now, mut last_seq, mut fired_and_skipped) = (start, 6, 0);
            let first = tick.next_at_ns();
            for wait in waits {
                now += wait;
                while let Some(fired) = tick.fire(now) {
                    prop_assert!(fired.at_ns <= now && now - fired.at_ns < period, "at most one period late");
                    prop_assert_eq!(fired.at_ns % period, phase % period, "on the grid");
                    prop_assert_eq!(fired.seq, last_seq + 1 + fired.skipped);
                    last_seq = fired.seq;
                    fired_and_skipped += 1 + fired.skipped;
                }
                prop_assert_eq!(tick.next_at_ns(), first + fired_and_skipped * period);
            }
        }
    }
}
