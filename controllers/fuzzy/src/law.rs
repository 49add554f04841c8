//! Fuzzy PD with an integral beside it: pure, without ports, clocks or bytes.
//!
//! ```text
//!   E = e / error-span,  R = (de/dt) / rate-span       both within ±1
//!   sets: NB ─1 · NS ─½ · ZE 0 · PS +½ · PB +1         triangles, each as wide as to its neighbours' peaks
//!   rules (Mamdani: least of both, greatest of those that agree):
//!            R: NB NS ZE PS PB
//!        E: NB  NB NB NB NS ZE
//!           NS  NB NB NS ZE PS
//!           ZE  NB NS ZE PS PB
//!           PS  NS ZE PS PB PB
//!           PB  ZE PS PB PB PB
//!   f = centroid of the sets of the output, cut at their strengths, over −1½ to +1½
//!   U = out-span · f + I        Ti·I' = out-span · E + (H − U)        H: what the actuator holds
//! ```
//! Source: Mamdani and Assilian, *An experiment in linguistic synthesis with a fuzzy logic controller* (Int. J. Man-Machine
//! Studies 7, 1975); MacVicar-Whelan's rule base; external reset as in the ISA block. The centroid is exact: the cut sets are
//! straight between their corners. Between New, Following and Running it moves as the ISA block does.
//! Never: a learned rule.

use bumpless_isa::{Demand, Phase};
use bumpless_sdk::blocks::{derivative, lag_part, limit, rate_limit};
use serde::{Deserialize, Serialize};

/// How many sets a value has.
const SETS: usize = 5;

/// Output set of each pair of sets of the error (rows) and its rate (columns), counted from NB.
pub const RULES: [[usize; SETS]; SETS] = [
    [0, 0, 0, 1, 2],
    [0, 0, 1, 2, 3],
    [0, 1, 2, 3, 4],
    [1, 2, 3, 4, 4],
    [2, 3, 4, 4, 4],
];

/// The parameters; the table has their texts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// Error that counts as big, in units of the measurement; negative for direct action.
    pub error_span: f64,
    /// Rate of the error that counts as big, per second; its sign is the error span's.
    pub rate_span: f64,
    /// Output at the biggest, in its units.
    pub out_span: f64,
    /// Integral time, s; 0 for none.
    pub ti_s: f64,
    /// Time constant of the filter on the rate, s.
    pub rate_filter_s: f64,
    /// Least output.
    pub out_low: f64,
    /// Greatest output.
    pub out_high: f64,
    /// Greatest change of the output per second; 0 for none.
    pub out_rate_per_s: f64,
}

/// What one step is about.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Measurement.
    pub pv: f64,
    /// Setpoint.
    pub setpoint: f64,
    /// What the actuator holds.
    pub held: f64,
    /// Who decides.
    pub demand: Demand,
    /// Time since the step before, s; greater than 0.
    pub dt_s: f64,
}

/// The state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    phase: Phase,
    /// Last output.
    pub output: f64,
    integral: f64,
    pv: f64,
    error: f64,
    /// de/dt of the measurement's part, filtered: a step of the setpoint is no rate.
    rate: f64,
}

/// How far a value, −1 to 1, belongs to each set.
#[must_use]
pub fn membership(value: f64) -> [f64; SETS] {
    std::array::from_fn(|i| {
        let peak = 0.5 * i as f64 - 1.0;
        limit(1.0 - 2.0 * (value - peak).abs(), 0.0, 1.0)
    })
}

/// The rules at an error and a rate, both −1 to 1: −1 to 1.
#[must_use]
pub fn infer(error: f64, rate: f64) -> f64 {
    let (of_error, of_rate) = (membership(error), membership(rate));
    let mut strength = [0.0_f64; SETS];
    for (row, e) in RULES.iter().zip(of_error) {
        for (out, r) in row.iter().zip(of_rate) {
            if let Some(s) = strength.get_mut(*out) {
                *s = s.max(e.min(r));
            }
        }
    }
    centroid(&strength)
}

/// Centroid of the greatest of the cut sets.
///
/// Between two peaks only their two sets are there: `max(min(h, 1 − t), min(g, t))` with t from 0 to 1, which is straight
/// between the corners below. Beyond the outer peaks half a triangle is left.
fn centroid(strength: &[f64; SETS]) -> f64 {
    let (mut area, mut moment) = (0.0, 0.0);
    for cell in 0..=SETS {
        let h = cell
            .checked_sub(1)
            .and_then(|i| strength.get(i))
            .copied()
            .unwrap_or(0.0);
        let g = strength.get(cell).copied().unwrap_or(0.0);
        let at = |t: f64| h.min(1.0 - t).max(g.min(t));
        let mut corners = [0.0, 1.0 - h, h, g, 1.0 - g, 0.5, 1.0];
        corners.sort_by(f64::total_cmp);
        let left = 0.5 * cell as f64 - 1.5;
        for pair in corners.windows(2) {
            let [from, to] = *pair else { continue };
            let (width, y0, y1) = (0.5 * (to - from), at(from), at(to));
            let part = 0.5 * (y0 + y1) * width;
            // Centroid of a trapezoid, times its area; without a division by its height.
            let x = left + 0.5 * from;
            area += part;
            moment += x * part + width * width * (y0 + 2.0 * y1) / 6.0;
        }
    }
    if area > 0.0 { moment / area } else { 0.0 }
}

impl Memory {
    /// A first state that starts from what the actuator holds.
    #[must_use]
    pub const fn new(track: f64) -> Self {
        Self {
            phase: Phase::New,
            output: track,
            integral: track,
            pv: 0.0,
            error: 0.0,
            rate: 0.0,
        }
    }

    /// E of the last step.
    fn part(&self, t: &Tuning) -> f64 {
        limit(self.error / t.error_span, -1.0, 1.0)
    }

    /// The fuzzy part of the output for the last step.
    fn rest(&self, t: &Tuning) -> f64 {
        let sign = t.error_span.signum();
        let rate = limit(sign * self.rate / t.rate_span, -1.0, 1.0);
        t.out_span * infer(self.part(t), rate)
    }

    /// Computes one step and gives the output, within its limits; while following, exactly the value followed.
    #[must_use]
    pub fn step(&mut self, t: &Tuning, sample: &Sample) -> f64 {
        if self.phase == Phase::Running && t.ti_s > 0.0 {
            let missing = sample.held - (self.integral + self.rest(t));
            self.integral += (missing + t.out_span * self.part(t)) * lag_part(t.ti_s, sample.dt_s);
        }
        self.rate = if self.phase == Phase::Running {
            derivative(self.rate, self.pv - sample.pv, 1.0, t.rate_filter_s, sample.dt_s)
        } else {
            0.0
        };
        self.pv = sample.pv;
        self.error = sample.setpoint - sample.pv;
        let rest = self.rest(t);
        self.output = match (sample.demand, self.phase) {
            (Demand::Follow(value), _) => {
                self.phase = Phase::Following;
                self.integral = value - rest;
                value
            }
            (Demand::Automatic, Phase::Running) => {
                let reached = rate_limit(self.integral + rest, sample.held, t.out_rate_per_s, sample.dt_s);
                limit(reached, t.out_low, t.out_high)
            }
            (Demand::Automatic, Phase::New | Phase::Following | Phase::Bypassed) => {
                self.phase = Phase::Running;
                self.integral = sample.held - rest;
                limit(sample.held, t.out_low, t.out_high)
            }
        };
        self.output
    }

    /// The output goes on under a new tuning.
    pub fn retune(&mut self, old: &Tuning, new: &Tuning) {
        if old != new {
            self.integral += self.rest(old) - self.rest(new);
        }
    }

    /// Are the numbers that last numbers?
    #[must_use]
    pub const fn is_sound(&self) -> bool {
        self.integral.is_finite() && self.rate.is_finite() && self.error.is_finite() && self.output.is_finite()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn at_the_peaks_of_the_sets_a_rule_alone_says_its_own_peak() {
        let peaks = [-1.0, -0.5, 0.0, 0.5, 1.0];
        for (row, e) in RULES.iter().zip(peaks) {
            for (out, r) in row.iter().zip(peaks) {
                let found = infer(e, r);
                assert!((found - peaks[*out]).abs() < 1e-12, "{e} {r}: {found}");
            }
        }
    }

    #[test]
    fn a_hand_calculated_centroid() {
        // E = 0.25 is half ZE and half PS, R = 0 is ZE: ZE and PS, both cut at a half. Symmetrical about 0.25.
        assert!((infer(0.25, 0.0) - 0.25).abs() < 1e-12);
        // E = 0.1: ZE at 0.8, PS at 0.2. By trapezoids: area 0.48 + 0.08, moment 0 + 0.0364….
        let (n, mut area, mut moment) = (200_000, 0.0, 0.0);
        for i in 0..n {
            let x = -1.5 + 3.0 * (f64::from(i) + 0.5) / f64::from(n);
            let y = (1.0 - 2.0 * x.abs())
                .min(0.8)
                .max((1.0 - 2.0 * (x - 0.5).abs()).min(0.2))
                .max(0.0);
            area += y;
            moment += x * y;
        }
        assert!((infer(0.1, 0.0) - moment / area).abs() < 1e-6);
    }

    proptest! {
        #[test]
        fn the_surface_is_odd_rises_and_stays_within_one(e in -1.0..1.0f64, r in -1.0..1.0f64) {
            let f = infer(e, r);
            prop_assert!((f + infer(-e, -r)).abs() < 1e-9 && f.abs() <= 1.0 + 1e-12);
            prop_assert!((f - infer(r, e)).abs() < 1e-9, "the rules are symmetrical");
        }
    }
}
