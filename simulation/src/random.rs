//! Numbers that follow from a seed, and from nothing else.
//!
//! Never: secret, or the same for two purposes: each part of a simulation draws from a stream of its own, so that a change of
//! one does not move the others.

/// A stream of random numbers (SplitMix64; Steele, Lea, Flood 2014).
#[derive(Debug, Clone)]
pub(crate) struct Random(u64);

impl Random {
    /// The stream of this name under this seed.
    pub(crate) fn new(seed: u64, stream: &str) -> Self {
        let hash = stream.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        });
        let mut random = Self(seed ^ hash);
        // The first numbers of near seeds are near; some steps part them.
        for _ in 0..4 {
            random.next();
        }
        random
    }

    /// Any number.
    pub(crate) const fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// From 0 to below 1.
    pub(crate) fn part(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// From `low` to below `high`; `low` where there is nothing between.
    pub(crate) fn between(&mut self, low: u64, high: u64) -> u64 {
        low + self.next() % high.saturating_sub(low).max(1)
    }

    /// True in this part of cases.
    pub(crate) fn chance(&mut self, part: f64) -> bool {
        part > 0.0 && self.part() < part
    }

    /// Evenly on a logarithmic scale: as many short ones as long ones.
    pub(crate) fn spread(&mut self, low: u64, high: u64) -> u64 {
        let (low, high) = (low.max(1) as f64, high.max(1) as f64);
        (low * (high / low).powf(self.part())) as u64
    }

    /// Exponential with this mean.
    pub(crate) fn exponential(&mut self, mean: f64) -> u64 {
        (-(1.0 - self.part()).ln() * mean) as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_follows_from_its_seed_and_stays_in_its_bounds() {
        let draw = |seed, stream| {
            let mut random = Random::new(seed, stream);
            (0..8).map(|_| random.next()).collect::<Vec<_>>()
        };
        assert_eq!(draw(1, "net"), draw(1, "net"));
        assert_ne!(draw(1, "net"), draw(2, "net"));
        assert_ne!(draw(1, "net"), draw(1, "disk"));
        let mut random = Random::new(3, "bounds");
        for _ in 0..1000 {
            assert!((5..9).contains(&random.between(5, 9)));
            assert!((0.0..1.0).contains(&random.part()));
            assert!((1_000..=60_000).contains(&random.spread(1_000, 60_000)));
        }
        assert_eq!(random.between(7, 7), 7);
        assert!(!random.chance(0.0));
    }
}
