//! Linear model predictive control of one loop: pure, without ports, clocks or bytes.
//!
//! ```text
//!   model        y = K·e^(−L·s)/(T·s + 1)·u + d             d: what the measurement is more than the model, filtered
//!   plan         moves Δu_0 … Δu_(M−1), one per interval; after them u rests
//!   prediction   y_i = free_i + Σ_j s_(i−j)·Δu_j             i = 1 … P intervals ahead; s: step response, exact
//!   least        Σ (r_i − y_i)²/K² + w·Σ Δu_j² + ρ·ε²        r_i: the setpoint, approached with the reference time
//!   with         out-low ≤ u ≤ out-high,  |Δu| ≤ out-rate·interval,  pv-low − |K|·ε ≤ y_i ≤ pv-high + |K|·ε
//! ```
//! *free* is what comes if the actuator stays: the lag, and what is still under way in the dead time. The first move goes out;
//! an interval later all is planned anew. In between the output rests and the model goes on, with the true times.
//!
//! ```text
//!                manual, track-on               automatic
//!   New ─────────────────────► Following ────────────────► Running: plans each interval, the first one a step later
//!    └────────── automatic: holds what the actuator holds ──────►
//! ```
//! Source: Cutler and Ramaker, *Dynamic matrix control* (ACC 1980); Maciejowski, *Predictive Control with Constraints* (2002),
//! ch. 2 and 3. Never: more than one output; an integrating process.

use bumpless_isa::{Demand, Phase};
use bumpless_sdk::blocks::{Delay, lag_part, limit};
use serde::{Deserialize, Serialize};

use crate::qp::Program;

/// Moves that are planned at most.
pub const MOVES_MAX: usize = 10;
/// Intervals that are predicted at most.
pub const HORIZON_MAX: usize = 60;
/// ρ: what a broken limit of the measurement costs, against an error of the same size.
const BREACH: f64 = 1e4;
/// A limit of the measurement of this size is none.
const NONE: f64 = 1e9;

/// The parameters; the table has their texts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// K, in units of the measurement per unit of the output, with its sign; not 0.
    pub gain: f64,
    /// T, s.
    pub lag_s: f64,
    /// L, s.
    pub delay_s: f64,
    /// Between two plans, s.
    pub interval_s: f64,
    /// P.
    pub horizon: usize,
    /// M.
    pub moves: usize,
    /// w: what a move costs, against an error of the size that it leads to.
    pub move_weight: f64,
    /// Reference time, s.
    pub reference_s: f64,
    /// Time constant of the filter on d, s.
    pub filter_s: f64,
    /// Least output.
    pub out_low: f64,
    /// Greatest output.
    pub out_high: f64,
    /// Greatest change of the output per second; 0 for none.
    pub out_rate_per_s: f64,
    /// Least measurement, soft.
    pub pv_low: f64,
    /// Greatest measurement, soft.
    pub pv_high: f64,
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    phase: Phase,
    /// Last output.
    pub output: f64,
    /// The model's answer, without d.
    model: f64,
    /// d.
    pub load: f64,
    delay: Delay,
    /// Since the last plan, s.
    since_s: f64,
}

impl Tuning {
    /// Greatest move; endless without a limit of the rate.
    fn reach(&self) -> f64 {
        if self.out_rate_per_s > 0.0 {
            self.out_rate_per_s * self.interval_s
        } else {
            f64::INFINITY
        }
    }
}

/// The model's answer to a step of the output after `after_s`, per K.
fn step_response(t: &Tuning, after_s: f64) -> f64 {
    if after_s > t.delay_s {
        lag_part(t.lag_s, after_s - t.delay_s)
    } else {
        0.0
    }
}

impl Memory {
    /// A first state that starts from what the actuator holds, with the model at rest with it.
    #[must_use]
    pub fn new(t: &Tuning, track: f64) -> Self {
        Self {
            phase: Phase::New,
            output: track,
            model: t.gain * track,
            load: 0.0,
            delay: Delay::holding(track, t.delay_s),
            since_s: 0.0,
        }
    }

    /// Computes one step and gives the output; none where the plan has no solution in numbers.
    #[must_use]
    pub fn step(&mut self, t: &Tuning, sample: &Sample) -> Option<f64> {
        if self.phase == Phase::New {
            // The actuator may have been moved since the state was made.
            *self = Self::new(t, sample.held);
            self.load = sample.pv - self.model;
        } else {
            let model = &mut self.model;
            self.delay.shift(sample.dt_s, sample.held, |piece| {
                *model += (t.gain * piece.value - *model) * lag_part(t.lag_s, piece.for_s);
            });
            self.load += (sample.pv - self.model - self.load) * lag_part(t.filter_s, sample.dt_s);
        }
        self.since_s += sample.dt_s;
        let output = match (sample.demand, self.phase) {
            (Demand::Follow(value), _) => {
                self.phase = Phase::Following;
                value
            }
            (Demand::Automatic, Phase::New | Phase::Following | Phase::Bypassed) => {
                self.phase = Phase::Running;
                self.since_s = t.interval_s;
                limit(sample.held, t.out_low, t.out_high)
            }
            // Half a cycle early is nearer than half a cycle late.
            (Demand::Automatic, Phase::Running) if self.since_s + 0.5 * sample.dt_s < t.interval_s => self.output,
            (Demand::Automatic, Phase::Running) => {
                self.since_s = 0.0;
                limit(sample.held + self.plan(t, sample)?, t.out_low, t.out_high)
            }
        };
        self.output = output;
        Some(output)
    }

    /// Where the measurement goes if the actuator stays, one value per interval.
    #[must_use]
    pub fn free(&self, t: &Tuning, held: f64) -> Vec<f64> {
        let (mut model, mut delay) = (self.model, self.delay.clone());
        (0..t.horizon)
            .map(|_| {
                delay.shift(t.interval_s, held, |piece| {
                    model += (t.gain * piece.value - model) * lag_part(t.lag_s, piece.for_s);
                });
                model + self.load
            })
            .collect()
    }

    /// The program of the moves, in this order of constraints: rate up and down, level up and down, measurement up and down.
    #[must_use]
    pub fn program(&self, t: &Tuning, sample: &Sample) -> Program {
        let free = self.free(t, sample.held);
        let soft = t.pv_low > -NONE || t.pv_high < NONE;
        let size = t.moves + usize::from(soft);
        let response = |i: usize, j: usize| {
            if i > j {
                step_response(t, (i - j) as f64 * t.interval_s)
            } else {
                0.0
            }
        };
        let mut p = Program {
            size,
            h: vec![0.0; size * size],
            g: vec![0.0; size],
            a: Vec::new(),
            b: Vec::new(),
            start: vec![0.0; size],
        };
        for (n, y) in free.iter().enumerate() {
            let i = n + 1;
            let ahead_s = i as f64 * t.interval_s;
            let wanted = sample.setpoint - (sample.setpoint - sample.pv) * (1.0 - lag_part(t.reference_s, ahead_s));
            let row: Vec<f64> = (0..t.moves).map(|j| response(i, j)).collect();
            let error = (wanted - y) / t.gain;
            for (j, s) in row.iter().enumerate() {
                if let Some(g) = p.g.get_mut(j) {
                    *g -= s * error;
                }
                for (k, other) in row.iter().enumerate() {
                    if let Some(h) = p.h.get_mut(j * size + k) {
                        *h += s * other;
                    }
                }
            }
        }
        for j in 0..size {
            let weight = if j < t.moves { t.move_weight } else { BREACH };
            if let Some(h) = p.h.get_mut(j * size + j) {
                *h += weight;
            }
        }
        p.bound_moves(t, sample.held);
        if soft {
            p.bound_measurement(t, &free, &response);
        }
        p.place(t, sample.held);
        p
    }

    /// The first move. An actuator beyond its limits is brought to them first, as fast as it may.
    fn plan(&self, t: &Tuning, sample: &Sample) -> Option<f64> {
        let inside = limit(sample.held, t.out_low, t.out_high);
        if inside != sample.held {
            let reach = t.reach();
            return Some(limit(inside - sample.held, -reach, reach));
        }
        self.program(t, sample).solve()?.first().copied()
    }

    /// The model changes: its answer stays where it is by the load, and the dead time is stretched.
    pub fn retune(&mut self, old: &Tuning, new: &Tuning) {
        let model = self.model * (new.gain / old.gain);
        self.load += self.model - model;
        self.model = model;
        self.delay.stretch(new.delay_s);
    }

    /// There is no measurement and something else decides: starts anew from the next good one.
    pub const fn follow_blind(&mut self, value: f64) {
        self.phase = Phase::New;
        self.output = value;
    }

    /// Are the numbers that last numbers?
    #[must_use]
    pub const fn is_sound(&self) -> bool {
        self.model.is_finite() && self.load.is_finite() && self.output.is_finite()
    }
}

impl Program {
    fn row(&mut self, row: impl Iterator<Item = f64>, bound: f64) {
        let from = self.a.len();
        self.a.extend(row);
        self.a.resize(from + self.size, 0.0);
        self.b.push(bound);
    }

    /// Rates of the moves, and levels of their sums. `held` is within its limits.
    fn bound_moves(&mut self, t: &Tuning, held: f64) {
        let moves = t.moves;
        let at = |column: usize, sign: f64| (0..moves).map(move |j| if j == column { sign } else { 0.0 });
        let upto = |column: usize, sign: f64| (0..moves).map(move |j| if j <= column { sign } else { 0.0 });
        for j in 0..moves {
            if t.reach().is_finite() {
                self.row(at(j, 1.0), t.reach());
                self.row(at(j, -1.0), t.reach());
            }
            self.row(upto(j, 1.0), t.out_high - held);
            self.row(upto(j, -1.0), held - t.out_low);
        }
    }

    /// Where the solver begins: one small move away from a limit that is near, and a breach that is great enough.
    fn place(&mut self, t: &Tuning, held: f64) {
        let margin = (0.05 * (t.out_high - t.out_low)).min(0.5 * t.reach());
        let inside = limit(held, t.out_low + margin, t.out_high - margin);
        if let Some(first) = self.start.first_mut() {
            *first = inside - held;
        }
        if self.size > t.moves {
            let rows = self.a.chunks_exact(self.size).zip(&self.b);
            let beyond = rows.map(|(row, b)| row.iter().zip(&self.start).map(|(a, x)| a * x).sum::<f64>() - b);
            let breach = beyond.fold(0.0, f64::max) + 1.0;
            if let Some(last) = self.start.last_mut() {
                *last = breach;
            }
        }
    }

    /// Soft limits of the measurement, from the first interval in which a move shows.
    fn bound_measurement(&mut self, t: &Tuning, free: &[f64], response: &dyn Fn(usize, usize) -> f64) {
        let (moves, sign, size) = (t.moves, t.gain.signum(), t.gain.abs());
        for (n, y) in free.iter().enumerate() {
            let i = n + 1;
            if response(i, 0) <= 0.0 {
                continue;
            }
            let row = |way: f64| {
                let moved = (0..moves).map(move |j| way * sign * response(i, j));
                moved.chain(std::iter::once(-1.0))
            };
            if t.pv_high < NONE {
                self.row(row(1.0), (t.pv_high - y) / size);
            }
            if t.pv_low > -NONE {
                self.row(row(-1.0), (y - t.pv_low) / size);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "tests")]

    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(500))]

        #[test]
        fn every_plan_comes_to_its_end(
            gain in prop_oneof![0.01..100.0f64, -100.0..-0.01f64],
            (lag_s, delay_s) in (0.0..50.0f64, 0.0..20.0f64),
            (horizon, moves) in (21usize..=HORIZON_MAX, 1usize..=MOVES_MAX),
            move_weight in prop_oneof![1e-4..1e-2f64, 0.01..10.0f64],
            out_rate_per_s in prop_oneof![Just(0.0), 0.1..10.0f64],
            held in 0.0..=100.0f64,
            (pv, setpoint) in (-50.0..150.0f64, -50.0..150.0f64),
            (pv_low, band) in (prop_oneof![Just(-1e9), -20.0..80.0f64], prop_oneof![Just(1e9), 0.1..60.0f64]),
        ) {
            let t = Tuning {
                gain,
                lag_s,
                delay_s,
                interval_s: 1.0,
                horizon,
                moves,
                move_weight,
                reference_s: 2.0,
                filter_s: 0.0,
                out_low: 0.0,
                out_high: 100.0,
                out_rate_per_s,
                pv_low: gain.abs() * pv_low,
                pv_high: gain.abs() * (pv_low.max(-1e8) + band),
            };
            let mut memory = Memory::new(&t, 50.0);
            let sample = Sample {
                pv: gain * pv,
                setpoint: gain * setpoint,
                held,
                demand: Demand::Automatic,
                dt_s: 1.0,
            };
            for _ in 0..3 {
                let _held = memory.step(&t, &sample);
            }
            let program = memory.program(&t, &sample);
            let steps = program.steps().unwrap();
            let x = program.solve().unwrap();
            prop_assert!(steps < crate::qp::STEPS_MAX, "{steps} steps: {program:?}");
            let sums = (0..moves).map(|j| x[..=j].iter().sum::<f64>());
            for sum in sums {
                prop_assert!((-1e-6..=100.0 + 1e-6).contains(&(held + sum)), "{held} + {sum}");
            }
        }
    }
}
