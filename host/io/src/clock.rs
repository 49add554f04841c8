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
        Self::start_off_by(0)
    }

    /// As if the wall clock were this many seconds ahead, or behind where that is negative. For drills: no decision of a cell
    /// may depend on the date.
    #[must_use]
    pub fn start_off_by(offset_s: i64) -> Self {
        // A wall clock before 1970 is a clock that was never set: the steady part still works.
        let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let offset_ns = offset_s.unsigned_abs().saturating_mul(1_000_000_000);
        let unix_at_start_ns = if offset_s < 0 {
            saturating_ns(unix).saturating_sub(offset_ns)
        } else {
            saturating_ns(unix).saturating_add(offset_ns)
        };
        Self {
            unix_at_start_ns,
            start: Instant::now(),
        }
    }

    /// Now, in ms since 1970 by the date at the start: for people.
    #[must_use]
    pub fn unix_ms(&self) -> u64 {
        self.now_ns() / 1_000_000
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
    fn a_drill_moves_the_date_and_not_the_pace() {
        let (now, ahead, behind) = (Clock::start(), Clock::start_off_by(7200), Clock::start_off_by(-7200));
        let hours = |a: Clock, b: Clock| (a.now_ns() as f64 - b.now_ns() as f64) / 3.6e12;
        assert!((hours(ahead, now) - 2.0).abs() < 0.01 && (hours(now, behind) - 2.0).abs() < 0.01);
        let before = ahead.now_ns();
        assert!(ahead.now_ns() >= before && ahead.unix_ms() >= before / 1_000_000);
        assert_eq!(
            Clock::start_off_by(i64::MIN).now_ns() / 3_600_000_000_000,
            0,
            "before 1970 is 1970"
        );
    }

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
