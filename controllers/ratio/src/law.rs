//! One flow in proportion to another: pure, without ports, clocks or bytes.
//!
//! ```text
//!   output = ratio · wild, filtered + bias            actual ratio = (pv − bias) / wild
//!   New ── first wild flow: the filter is at rest with it ──► Running
//! ```
//! Source: the RATIO block of Foundation Fieldbus; Shinskey, *Process Control Systems* (1996), ch. 6.
//! Never: limits of the output; those are the station's.

use bumpless_sdk::blocks::{lag_part, limit};
use serde::{Deserialize, Serialize};

/// The parameters; the table has their texts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// Least ratio.
    pub low: f64,
    /// Greatest ratio.
    pub high: f64,
    /// Added to the output, in its unit.
    pub bias: f64,
    /// Time constant of the filter on the wild flow, s.
    pub filter_s: f64,
}

/// The state: the wild flow after its filter, once there was one, and the ratio that counted last.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Memory {
    wild: Option<f64>,
    ratio: f64,
}

impl Memory {
    /// One step of `dt_s`: what the controlled flow should be.
    pub fn step(&mut self, t: &Tuning, ratio: f64, wild: f64, dt_s: f64) -> f64 {
        let before = self.wild.unwrap_or(wild);
        let now = before + (wild - before) * lag_part(t.filter_s, dt_s);
        self.wild = Some(now);
        self.ratio = ratio;
        wanted(t, ratio, now)
    }

    /// What the last step would have said with another tuning; none before the first.
    #[must_use]
    pub fn output(&self, t: &Tuning) -> Option<f64> {
        self.wild.map(|wild| wanted(t, self.ratio, wild))
    }

    /// The ratio that a controlled flow is in; none without a wild flow.
    #[must_use]
    pub fn actual(&self, t: &Tuning, controlled: f64) -> Option<f64> {
        let wild = self.wild.filter(|wild| *wild != 0.0)?;
        Some((controlled - t.bias) / wild).filter(|ratio| ratio.is_finite())
    }

    /// There is no wild flow: the next one finds the filter at rest.
    pub const fn forget(&mut self) {
        self.wild = None;
    }
}

fn wanted(t: &Tuning, ratio: f64, wild: f64) -> f64 {
    limit(ratio, t.low, t.high) * wild + t.bias
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_output_is_in_proportion_and_the_ratio_within_its_limits() {
        let t = Tuning {
            low: 0.5,
            high: 2.0,
            bias: 1.0,
            filter_s: 2.0,
        };
        let mut memory = Memory::default();
        assert_eq!(memory.step(&t, 1.5, 10.0, 0.1), 16.0);
        assert_eq!(memory.step(&t, 9.0, 10.0, 0.1), 21.0);
        assert_eq!(memory.step(&t, 0.0, 10.0, 0.1), 6.0);
        let filtered = memory.step(&t, 1.0, 20.0, 2.0);
        assert!((filtered - (21.0 - 10.0 * (-1.0f64).exp())).abs() < 1e-12);
        assert_eq!(Memory::default().actual(&t, 5.0), None);
        memory.forget();
        memory.step(&t, 1.0, 4.0, 0.1);
        assert_eq!(memory.actual(&t, 9.0), Some(2.0));
        memory.forget();
        memory.step(&t, 1.0, 0.0, 0.1);
        assert_eq!(memory.actual(&t, 9.0), None);
    }
}
