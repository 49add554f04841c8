//! How often somebody may try: a token bucket for each key, bounded in number.
//!
//! ```text
//! full (forgotten) ── take ──► less ── time ──► full
//!                                └ empty: no, and how long to wait
//! ```
//! Never: reads a clock; the caller says the time since his start.

use std::{collections::HashMap, hash::Hash, time::Duration};

/// What one key has left, and when that was so.
#[derive(Debug, Clone, Copy)]
struct Left {
    tokens: f64,
    at: Duration,
}

/// Buckets by key. Keys beyond the bound share one.
#[derive(Debug)]
pub struct Pace<K> {
    burst: f64,
    per_s: f64,
    keys_max: usize,
    left: HashMap<K, Left>,
    shared: Option<Left>,
}

impl<K: Hash + Eq> Pace<K> {
    /// `burst` at once (at least 1), then `per_s` each second (above 0), for at most `keys_max` keys.
    #[must_use]
    pub fn new(burst: f64, per_s: f64, keys_max: usize) -> Self {
        Self {
            burst: burst.max(1.0),
            per_s: per_s.max(1e-6),
            keys_max,
            left: HashMap::new(),
            shared: None,
        }
    }

    fn now(&self, left: Option<Left>, now: Duration) -> f64 {
        left.map_or(self.burst, |left| {
            let gained = now.saturating_sub(left.at).as_secs_f64() * self.per_s;
            (left.tokens + gained).min(self.burst)
        })
    }

    /// May this key try now? Nothing is taken.
    ///
    /// # Errors
    /// How long to wait.
    pub fn look(&self, key: &K, now: Duration) -> Result<(), Duration> {
        let known = self.left.get(key).copied();
        let left = if known.is_none() && self.left.len() >= self.keys_max {
            self.shared
        } else {
            known
        };
        let tokens = self.now(left, now);
        if tokens >= 1.0 {
            return Ok(());
        }
        Err(Duration::from_secs_f64((1.0 - tokens) / self.per_s))
    }

    /// Takes one, if there is one.
    ///
    /// # Errors
    /// How long to wait.
    pub fn take(&mut self, key: K, now: Duration) -> Result<(), Duration> {
        if self.left.len() >= self.keys_max && !self.left.contains_key(&key) {
            // Those that are full again say nothing.
            let (burst, per_s) = (self.burst, self.per_s);
            self.left
                .retain(|_, left| left.tokens + now.saturating_sub(left.at).as_secs_f64() * per_s < burst);
        }
        self.look(&key, now)?;
        if self.left.len() >= self.keys_max && !self.left.contains_key(&key) {
            let tokens = self.now(self.shared, now) - 1.0;
            self.shared = Some(Left { tokens, at: now });
            return Ok(());
        }
        let tokens = self.now(self.left.get(&key).copied(), now) - 1.0;
        self.left.insert(key, Left { tokens, at: now });
        Ok(())
    }

    /// Keys that are not full.
    #[must_use]
    pub fn len(&self) -> usize {
        self.left.len()
    }

    /// Is every key full?
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.left.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn a_burst_then_a_pace() {
        let mut pace = Pace::new(3.0, 0.5, 10);
        for _ in 0..3 {
            assert_eq!(pace.take("a", s(0)), Ok(()));
        }
        assert_eq!(pace.take("a", s(0)), Err(s(2)));
        assert_eq!(pace.take("b", s(0)), Ok(()), "another key has its own");
        assert_eq!(pace.take("a", s(2)), Ok(()));
        assert!(pace.take("a", s(2)).is_err());
        for _ in 0..3 {
            assert_eq!(pace.take("a", s(1_000)), Ok(()), "never more than the burst");
        }
        assert!(pace.take("a", s(1_000)).is_err());
    }

    #[test]
    fn a_flood_of_keys_is_bounded_and_shares_what_is_left() {
        let mut pace = Pace::new(2.0, 1.0, 3);
        for key in 0..3 {
            assert_eq!(pace.take(key, s(0)), Ok(()));
        }
        assert_eq!((pace.take(10, s(0)), pace.take(11, s(0))), (Ok(()), Ok(())));
        assert!(pace.take(12, s(0)).is_err(), "newcomers share one bucket");
        assert_eq!(pace.len(), 3);
        assert_eq!(pace.take(0, s(0)), Ok(()), "the known ones keep theirs");
        assert_eq!(pace.take(13, s(100)), Ok(()), "those that are full again make room");
        assert_eq!(pace.len(), 1);
    }

    #[test]
    fn time_that_goes_back_gives_nothing() {
        let mut pace = Pace::new(1.0, 1.0, 3);
        assert_eq!(pace.take("a", s(10)), Ok(()));
        assert!(pace.take("a", s(5)).is_err());
    }
}
