//! Two PI blocks, one inside the other: the outer one's output is the inner one's setpoint.
//!
//! ```text
//! setpoint ─► outer ── inner setpoint ─► inner ── output ─► actuator
//!   pv ───────┘  ▲ external reset          │  ▲ external reset
//!                └──── inner-pv ───────────┘  └──── what the actuator holds
//! ```
//! What the outer block's "actuator" holds is the inner measurement: while the inner loop cannot follow (a limit, a hand, a
//! slow inner process), the outer integral follows it and does not wind up. Source: external reset of cascaded blocks,
//! ISA-TR5.9-2023; Shinskey, *Process Control Systems* (1996), ch. 6.
//!
//! ```text
//!   New ── first sample: the outer follows inner-pv, the inner follows the actuator ──► as `bumpless_isa` draws it
//! ```
//! Never: ports, clocks or bytes.

use bumpless_isa::{Demand, Memory, Phase, Sample as BlockSample, Tuning};
use serde::{Deserialize, Serialize};

/// What one step is about.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Measurement of the outer loop.
    pub pv: f64,
    /// Measurement of the inner loop.
    pub inner_pv: f64,
    /// Setpoint of the outer loop.
    pub setpoint: f64,
    /// What the actuator holds; none where it cannot be read.
    pub held: Option<f64>,
    /// Somebody else decides the output.
    pub manual: bool,
    /// Time since the step before, s; greater than 0.
    pub dt_s: f64,
}

/// The state: that of both blocks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Cascade {
    /// The outer block; its output is the inner setpoint.
    pub outer: Memory,
    /// The inner block.
    pub inner: Memory,
}

impl Cascade {
    /// A first state that starts from what the actuator holds.
    #[must_use]
    pub const fn new(track: f64) -> Self {
        Self {
            outer: Memory::new(0.0),
            inner: Memory::new(track),
        }
    }

    /// Computes one step and gives the output.
    #[must_use]
    pub fn step(&mut self, outer: &Tuning, inner: &Tuning, sample: &Sample) -> f64 {
        let block = |pv, setpoint, held, demand| BlockSample {
            pv,
            setpoint,
            feedforward: 0.0,
            held,
            demand,
            dt_s: sample.dt_s,
            elapsed_s: Some(sample.dt_s),
        };
        // Beyond its limits an inner measurement is no setpoint that the outer block could have asked for.
        let reached = sample.inner_pv.max(outer.out_low).min(outer.out_high);
        let first = self.inner.phase == Phase::New;
        let outer_demand = if sample.manual || first {
            Demand::Follow(reached)
        } else {
            Demand::Automatic
        };
        let held = sample.held.unwrap_or(self.inner.output);
        let inner_demand = if sample.manual {
            Demand::Follow(held)
        } else {
            Demand::Automatic
        };
        let inner_setpoint = self
            .outer
            .step(outer, &block(sample.pv, sample.setpoint, Some(reached), outer_demand));
        self.inner.step(
            inner,
            &block(sample.inner_pv, inner_setpoint, sample.held, inner_demand),
        )
    }

    /// New tunings, outer and inner each: the output goes on without a bump.
    pub fn retune(&mut self, old: &(Tuning, Tuning), new: &(Tuning, Tuning)) {
        self.outer.retune(&old.0, &new.0);
        self.inner.retune(&old.1, &new.1);
    }
}
