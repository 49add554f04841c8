//! Simulated processes and numbers without a pattern, the same in every run.
//!
//! Never: anything of the code under test.

use std::collections::VecDeque;

/// Numbers from a seed (SplitMix64).
pub(crate) struct Draw(pub(crate) u64);

impl Draw {
    /// Between two bounds.
    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^= z >> 31;
        low + (high - low) * (z >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Rounded to a grid.
    pub(crate) fn on_grid(&mut self, low: f64, high: f64, grid: f64) -> f64 {
        (self.between(low, high) / grid).round() * grid
    }
}

/// K·e^(−L·s) / ((T1·s + 1)(T2·s + 1)), at rest at an input; exact for a held input where T1 and T2 differ, else by small steps.
pub(crate) struct Plant {
    pub(crate) gain: f64,
    pub(crate) lags_s: [f64; 2],
    pub(crate) delay_s: f64,
    dt_s: f64,
    x: [f64; 2],
    under_way: VecDeque<f64>,
}

/// Steps of the integration within one cycle.
const PARTS: u32 = 20;

impl Plant {
    pub(crate) fn resting(gain: f64, lags_s: [f64; 2], delay_s: f64, dt_s: f64, input: f64) -> Self {
        Self {
            gain,
            lags_s,
            delay_s,
            dt_s,
            x: [gain * input; 2],
            under_way: vec![input; (delay_s / dt_s).round() as usize].into(),
        }
    }

    pub(crate) fn output(&self) -> f64 {
        self.x[1]
    }

    /// One cycle with an input.
    pub(crate) fn advance(&mut self, input: f64) {
        self.under_way.push_back(input);
        let u = self.under_way.pop_front().unwrap_or(input);
        let part_s = self.dt_s / f64::from(PARTS);
        for _ in 0..PARTS {
            let towards = |x: f64, to: f64, lag: f64| {
                if lag > 0.0 {
                    to + (x - to) * (-part_s / lag).exp()
                } else {
                    to
                }
            };
            let before = self.x[0];
            self.x[0] = towards(before, self.gain * u, self.lags_s[0]);
            // The second lag sees the mean of the first over the part.
            self.x[1] = towards(self.x[1], 0.5 * (before + self.x[0]), self.lags_s[1]);
        }
    }
}
