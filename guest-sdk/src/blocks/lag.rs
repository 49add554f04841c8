//! First-order dynamics with memory: a lag, and a lead over a lag.
//!
//! Exact for an input that holds between two steps. Never: dead time; that is [`super::Delay`]'s.

use serde::{Deserialize, Serialize};

use super::lag_part;

/// `(1 + s·lead) / (1 + s·lag)`.
///
/// With x the lag of the input: `y = x + lead/lag · (u − x)`, so a step of the input shows at once by the part lead/lag.
/// x has gone towards the input of the step *before*, which held until now: the zero-order-hold equivalent.
/// Source: Åström and Wittenmark, Computer-Controlled Systems, 3rd ed., ch. 2.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct LeadLag {
    lagged: f64,
    input: f64,
}

impl LeadLag {
    /// At rest with an input.
    #[must_use]
    pub const fn resting(input: f64) -> Self {
        Self { lagged: input, input }
    }

    /// The output with the input of the last step; `lag_s` = 0 gives the input itself.
    #[must_use]
    pub fn output(&self, lead_s: f64, lag_s: f64) -> f64 {
        if lag_s > 0.0 {
            self.lagged + lead_s / lag_s * (self.input - self.lagged)
        } else {
            self.input
        }
    }

    /// `value` held for some time.
    pub fn advance(&mut self, value: f64, lag_s: f64, for_s: f64) {
        self.lagged += (value - self.lagged) * lag_part(lag_s, for_s);
    }

    /// The input from now on.
    pub const fn set(&mut self, input: f64) {
        self.input = input;
    }

    /// One step: `dt_s` since the one before, and the input from now on.
    pub fn step(&mut self, input: f64, lead_s: f64, lag_s: f64, dt_s: f64) -> f64 {
        self.advance(self.input, lag_s, dt_s);
        self.set(input);
        self.output(lead_s, lag_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_shows_its_lead_at_once_and_then_lags() {
        let mut block = LeadLag::resting(0.0);
        assert_eq!(block.step(1.0, 4.0, 2.0, 0.5), 2.0);
        for i in 1..40 {
            let t = 0.5 * f64::from(i);
            let expected = 1.0 + (4.0 / 2.0 - 1.0) * (-t / 2.0f64).exp();
            assert!((block.step(1.0, 4.0, 2.0, 0.5) - expected).abs() < 1e-12);
        }
    }

    #[test]
    fn without_times_it_is_the_input() {
        let mut block = LeadLag::resting(3.0);
        assert_eq!(block.step(5.0, 0.0, 0.0, 0.1), 5.0);
        assert_eq!(LeadLag::resting(3.0).step(5.0, 0.0, 1e9, 0.1), 3.0);
    }
}
