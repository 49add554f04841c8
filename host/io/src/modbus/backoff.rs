//! How long to wait before the next attempt: doubling, capped, and spread so that many hosts do not knock together.
//!
//! Pure: randomness comes from a seed.

use std::time::Duration;

use crate::sim::noise::mixed;

/// Waits after failures in a row.
#[derive(Debug, Clone)]
pub(crate) struct Backoff {
    min_ms: u64,
    max_ms: u64,
    seed: u64,
    draws: u64,
    failures: u32,
}

impl Backoff {
    /// `min_ms` is at least 1 and at most `max_ms`.
    pub(crate) const fn new(min_ms: u64, max_ms: u64, seed: u64) -> Self {
        Self {
            min_ms,
            max_ms,
            seed,
            draws: 0,
            failures: 0,
        }
    }

    /// It worked: the next failure starts small again.
    pub(crate) const fn reset(&mut self) {
        self.failures = 0;
    }

    /// It failed: the wait is between half and all of min · 2^failures, at most the cap.
    pub(crate) fn next_wait(&mut self) -> Duration {
        let doubled = self
            .min_ms
            .saturating_mul(1_u64.checked_shl(self.failures.min(40)).unwrap_or(u64::MAX));
        let most = doubled.min(self.max_ms).max(1);
        self.failures = self.failures.saturating_add(1);
        self.draws += 1;
        let half = most / 2;
        Duration::from_millis(half + mixed(self.seed.wrapping_add(self.draws)) % (most - half + 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_double_up_to_the_cap_and_start_again() {
        let mut backoff = Backoff::new(50, 1000, 7);
        for most in [50, 100, 200, 400, 800, 1000, 1000, 1000] {
            let wait = backoff.next_wait().as_millis();
            assert!((most / 2..=most).contains(&wait), "{wait} of {most}");
        }
        for _ in 0..1000 {
            assert!(backoff.next_wait().as_millis() <= 1000);
        }
        backoff.reset();
        assert!(backoff.next_wait().as_millis() <= 50);
        // Two hosts do not wait alike.
        let waits = |seed| {
            let mut b = Backoff::new(1000, 100_000, seed);
            (0..5).map(|_| b.next_wait()).collect::<Vec<_>>()
        };
        assert_ne!(waits(1), waits(2));
    }
}
