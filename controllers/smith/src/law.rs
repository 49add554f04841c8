//! A model of the process beside the process: what the measurement would be without dead time. Pure, without ports, clocks or
//! bytes.
//!
//! ```text
//!   u ─┬─► K/(1 + T·s) ──────────────► x        predicted = pv + (x − late)
//!      └─► e^(−L·s) ─► K/(1 + T·s) ──► late     With a true model pv = late, and the PID sees a process without dead time.
//!   New ── first sample: both models at rest with what the actuator holds ──► Running
//! ```
//! Source: O. J. M. Smith, *Closer control of loops with dead time* (Chem. Eng. Progress 53, 1957); Åström and Hägglund,
//! *Advanced PID Control* (2006), ch. 8. Exact for an actuator that holds between two steps. Never: an integrating process,
//! for which this scheme leaves an error after a load.

use bumpless_sdk::blocks::{Delay, lag_part};
use serde::{Deserialize, Serialize};

/// The process as first order with dead time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Model {
    /// Units of the measurement per unit of the output, with its sign.
    pub gain: f64,
    /// Time constant, s.
    pub lag_s: f64,
    /// Dead time, s.
    pub delay_s: f64,
}

/// The state, once there was a sample.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Predictor {
    models: Option<Models>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Models {
    prompt: f64,
    late: f64,
    delay: Delay,
}

impl Predictor {
    /// `held` was the actuator's value for the last `dt_s`. Gives what to add to the measurement.
    pub fn step(&mut self, m: &Model, held: f64, dt_s: f64) -> f64 {
        let models = self.models.get_or_insert_with(|| Models {
            prompt: m.gain * held,
            late: m.gain * held,
            delay: Delay::holding(held, m.delay_s),
        });
        let toward = |x: &mut f64, input: f64, for_s: f64| *x += (m.gain * input - *x) * lag_part(m.lag_s, for_s);
        toward(&mut models.prompt, held, dt_s);
        let late = &mut models.late;
        models
            .delay
            .shift(dt_s, held, |piece| toward(late, piece.value, piece.for_s));
        models.prompt - models.late
    }

    /// What the last step gave.
    #[must_use]
    pub fn ahead(&self) -> f64 {
        self.models.as_ref().map_or(0.0, |m| m.prompt - m.late)
    }

    /// Another model: it is brought to where it would be, as far as the old one's memory reaches.
    pub fn retune(&mut self, old: &Model, new: &Model) {
        let Some(models) = &mut self.models else { return };
        if old.gain == 0.0 {
            self.models = None;
            return;
        }
        let scale = new.gain / old.gain;
        models.prompt *= scale;
        models.late *= scale;
        models.delay.stretch(new.delay_s);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_prediction_is_the_model_without_its_dead_time() {
        let m = Model {
            gain: 2.0,
            lag_s: 5.0,
            delay_s: 1.0,
        };
        let mut predictor = Predictor::default();
        assert_eq!(predictor.step(&m, 10.0, 0.5), 0.0, "at rest");
        for i in 1..60 {
            let t = 0.5 * f64::from(i);
            let answer = |t: f64| if t > 0.0 { 2.0 * (1.0 - (-t / 5.0).exp()) } else { 0.0 };
            let expected = answer(t) - answer(t - 1.0);
            let found = predictor.step(&m, 11.0, 0.5);
            assert!((found - expected).abs() < 1e-9, "{i}: {found} and {expected}");
        }
    }
}
