//! The steady clock of the I/O host: every time in a record is its time.
//!
//! Never: steps back or jumps when the wall clock is set. The wall clock is looked at once, at the start, so that the
//! numbers also mean something to people.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// Nanoseconds since 1970 as they were at the start, plus the time that has steadily passed since.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    unix_at_start_ns: u64,
    start: Instant,
}

impl Clock {
    /// Looks at the wall clock, once.
    #[must_use]
    pub fn start() -> Self {
        // A wall clock before 1970 is a clock that was never set: the steady part still works.
        let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self {
            unix_at_start_ns: saturating_ns(unix),
            start: Instant::now(),
        }
    }

    /// Now, in ns. Two calls on any threads never go back.
    #[must_use]
    pub fn now_ns(&self) -> u64 {
        self.unix_at_start_ns
            .saturating_add(saturating_ns(self.start.elapsed()))
    }
}

/// A duration in ns; 584 years is the most that fits.
fn saturating_ns(duration: std::time::Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn never_goes_back_and_means_a_date() {
        let clock = Clock::start();
        let copy = clock;
        let mut last_ns = clock.now_ns();
        // 2020-01-01: any machine that builds this is later.
        assert!(last_ns > 1_577_836_800_000_000_000);
        for _ in 0..10_000 {
            let now_ns = copy.now_ns();
            assert!(now_ns >= last_ns);
            last_ns = now_ns;
        }
    }
}
