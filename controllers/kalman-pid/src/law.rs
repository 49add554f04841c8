//! A Kalman filter of two states, the measurement and an unknown load: pure, without ports, clocks or bytes.
//!
//! ```text
//!   x' = (K·u(t − L) + d − x) / T          measured: x + noise of standard deviation σ
//!   d' = drift of intensity q_d            (units of the measurement)
//!
//!   predict, over dt:  x ← a·x + (1−a)(K·u + d)      a = e^(−dt/T)      P ← F·P·Fᵀ + Q,  F = [a 1−a; 0 1]
//!   update, new value: k = P₀/(P₀₀ + σ²)             x, d += k·(y − x)  P ← (1 − k·H)·P
//!   New ── first sample: x = y, d = y − K·u, P = σ² ──► Running
//! ```
//! Q = diag(q_x², q_d²)·dt. A step without a new measurement only predicts, so a lost sample costs accuracy and nothing else.
//! Source: Åström and Wittenmark, *Computer-Controlled Systems*, 3rd ed., ch. 11. Never: tuning of the PID behind it.

use bumpless_sdk::blocks::{Delay, lag_part};
use serde::{Deserialize, Serialize};

/// The process and its noise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Model {
    /// Units of the measurement per unit of the output, with its sign.
    pub gain: f64,
    /// Time constant T, s.
    pub lag_s: f64,
    /// Dead time L, s.
    pub delay_s: f64,
    /// σ: standard deviation of the measurement's noise, in its units.
    pub noise: f64,
    /// q_x: standard deviation of the process's own noise after 1 s, in units of the measurement.
    pub unrest: f64,
    /// q_d: standard deviation of the load after 1 s, in units of the measurement.
    pub drift: f64,
}

/// The state, once there was a sample.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Filter {
    estimate: Option<Estimate>,
}

/// What is known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// x, the measurement without its noise.
    pub x: f64,
    /// d, the load as the measurement that it leads to.
    pub d: f64,
    /// Covariance: of x, of x with d, of d.
    pub p: [f64; 3],
    delay: Delay,
}

impl Filter {
    /// `held` was the actuator's value for the last `dt_s`; `fresh` says whether `pv` is a new measurement.
    pub fn step(&mut self, m: &Model, held: f64, pv: f64, fresh: bool, dt_s: f64) -> &Estimate {
        let variance = m.noise * m.noise;
        if let Some(estimate) = &mut self.estimate {
            estimate.predict(m, held, dt_s);
            if fresh {
                estimate.update(pv, variance);
            }
        }
        self.estimate.get_or_insert_with(|| Estimate {
            x: pv,
            d: pv - m.gain * held,
            p: [variance, 0.0, variance],
            delay: Delay::holding(held, m.delay_s),
        })
    }

    /// Another model. What is estimated stays; the load takes up what another gain means.
    pub fn retune(&mut self, old: &Model, new: &Model) {
        if let Some(estimate) = &mut self.estimate {
            estimate.d += (old.gain - new.gain) * estimate.delay.oldest();
            estimate.delay.stretch(new.delay_s);
        }
    }

    /// There is no measurement: the next one starts anew.
    pub fn forget(&mut self) {
        self.estimate = None;
    }
}

impl Estimate {
    fn predict(&mut self, m: &Model, held: f64, dt_s: f64) {
        let (x, d) = (&mut self.x, self.d);
        self.delay.shift(dt_s, held, |piece| {
            *x += (m.gain * piece.value + d - *x) * lag_part(m.lag_s, piece.for_s);
        });
        let b = lag_part(m.lag_s, dt_s);
        let a = 1.0 - b;
        let [xx, xd, dd] = self.p;
        self.p = [
            a * a * xx + 2.0 * a * b * xd + b * b * dd + m.unrest * m.unrest * dt_s,
            a * xd + b * dd,
            dd + m.drift * m.drift * dt_s,
        ];
    }

    fn update(&mut self, pv: f64, variance: f64) {
        let [xx, xd, dd] = self.p;
        let (kx, kd) = (xx / (xx + variance), xd / (xx + variance));
        let surprise = pv - self.x;
        self.x += kx * surprise;
        self.d += kd * surprise;
        self.p = [(1.0 - kx) * xx, (1.0 - kx) * xd, dd - kd * xd];
    }

    /// Are all numbers numbers?
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.x.is_finite() && self.d.is_finite() && self.p.iter().all(|p| p.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MODEL: Model = Model {
        gain: 2.0,
        lag_s: 10.0,
        delay_s: 0.0,
        noise: 0.5,
        unrest: 0.01,
        drift: 0.05,
    };

    #[test]
    fn noise_is_taken_away_and_a_load_is_found() {
        let mut filter = Filter::default();
        let (mut y, mut worst) = (0.0, 0.0_f64);
        for i in 0..4000u32 {
            let load = if i < 1000 { 0.0 } else { 3.0 };
            y += (2.0 * 5.0 + load - y) * (1.0 - (-0.1f64 / 10.0).exp());
            let noise = (2.0 * (f64::from(i) * 0.618_033_988_749_895).fract() - 1.0) * 0.5;
            let estimate = filter.step(&MODEL, 5.0, y + noise, true, 0.1);
            if i > 3000 {
                worst = worst.max((estimate.x - y).abs());
                assert!((estimate.d - 3.0).abs() < 0.5, "{i}: {}", estimate.d);
            }
        }
        assert!(worst < 0.15, "noise of 0.5 leaves {worst}");
    }

    #[test]
    fn without_a_measurement_it_predicts() {
        let mut filter = Filter::default();
        filter.step(&MODEL, 5.0, 10.0, true, 0.1);
        let first = filter.step(&MODEL, 6.0, 99.0, false, 10.0).x;
        assert!((first - (12.0 - 2.0 * (-1.0f64).exp())).abs() < 1e-9, "{first}");
    }
}
