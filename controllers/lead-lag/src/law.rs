//! A signal through `gain · (1 + lead·s) / (1 + lag·s) + bias`: pure, without ports, clocks or bytes.
//!
//! ```text
//!   New ── first input: the filter is at rest with it ──► Running ── no input while something else decides ──► New
//! ```
//! Exact for an input that holds between two steps ([`LeadLag`]). Never: limits; those are the station's.

use bumpless_sdk::blocks::LeadLag;
use serde::{Deserialize, Serialize};

/// The parameters; the table has their texts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// Output units per unit of the input.
    pub gain: f64,
    /// Added to the output.
    pub bias: f64,
    /// Time constant of the numerator, s.
    pub lead_s: f64,
    /// Time constant of the denominator, s.
    pub lag_s: f64,
}

/// The state: the filter, once there was an input.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Memory {
    block: Option<LeadLag>,
}

impl Memory {
    /// One step of `dt_s`: what the block says now.
    pub fn step(&mut self, t: &Tuning, input: f64, dt_s: f64) -> f64 {
        let mut block = self.block.unwrap_or(LeadLag::resting(input));
        block.step(input, t.lead_s, t.lag_s, dt_s);
        self.block = Some(block);
        self.output(t).unwrap_or(input)
    }

    /// What the block says for its last input; none before the first.
    #[must_use]
    pub fn output(&self, t: &Tuning) -> Option<f64> {
        self.block
            .map(|block| t.gain * block.output(t.lead_s, t.lag_s) + t.bias)
    }

    /// There is no input: the next one finds the filter at rest.
    pub const fn forget(&mut self) {
        self.block = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_goes_through_gain_lead_lag_and_bias() {
        let t = Tuning {
            gain: 2.0,
            bias: 5.0,
            lead_s: 3.0,
            lag_s: 1.0,
        };
        let mut memory = Memory::default();
        assert_eq!(memory.output(&t), None);
        assert_eq!(memory.step(&t, 10.0, 0.1), 25.0, "at rest with the first input");
        assert_eq!(memory.step(&t, 11.0, 0.1), 5.0 + 2.0 * 13.0, "the lead shows at once");
        let later = (0..200).fold(0.0, |_, _| memory.step(&t, 11.0, 0.1));
        assert!((later - 27.0).abs() < 1e-7);
        memory.forget();
        assert_eq!(memory.step(&t, 0.0, 0.1), 5.0);
    }
}
