//! Two PID blocks, one inside the other: the outer one's output is the inner one's setpoint.
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
//!   Hand:  something else decides the output. The inner block follows it, the outer one follows inner-pv.
//!   Inner: the inner block runs on a setpoint of its own; the outer one follows that setpoint.
//!   Both:  the cascade.
//!   Hand → Inner, Hand → Both, Inner → Both, and back: the output and the inner setpoint go on from where they are.
//! ```
//! Never: ports, clocks or bytes.

use bumpless_isa::{Demand, Memory, Memory1, Phase, Sample as BlockSample, Tuning};
use serde::{Deserialize, Serialize};

/// Who decides what.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lead {
    /// Somebody else decides the output: it is this value.
    Hand(f64),
    /// The inner loop is alone, with this setpoint; with none it keeps the one that it has.
    Inner(Option<f64>),
    /// The outer block decides the inner setpoint, the inner one the output.
    Both,
}

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
    /// Who decides.
    pub lead: Lead,
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

/// The state in layout 1: blocks without limits and sources of their setpoints.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Cascade1 {
    /// The outer block.
    pub outer: Memory1,
    /// The inner block.
    pub inner: Memory1,
}

impl From<Cascade1> for Cascade {
    fn from(old: Cascade1) -> Self {
        Self {
            outer: old.outer.into(),
            inner: old.inner.into(),
        }
    }
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
        // Beyond its limits an inner measurement is no setpoint that the outer block could have asked for.
        let reached = sample.inner_pv.max(outer.out_low).min(outer.out_high);
        let inner_runs = self.inner.phase == Phase::Running;
        let own_setpoint = if inner_runs { self.inner.setpoint } else { reached };
        let outer_demand = match sample.lead {
            Lead::Inner(wanted) => Demand::Follow(wanted.unwrap_or(own_setpoint)),
            Lead::Hand(_) => Demand::Follow(reached),
            Lead::Both if self.inner.phase == Phase::New => Demand::Follow(reached),
            Lead::Both => Demand::Automatic,
        };
        let inner_demand = match sample.lead {
            Lead::Hand(value) => Demand::Follow(value),
            Lead::Inner(_) | Lead::Both => Demand::Automatic,
        };
        let inner_setpoint = self.outer.step(
            outer,
            &BlockSample {
                demand: outer_demand,
                // The integral follows what the inner loop reaches; the output goes on from what it was asked for.
                reset: Some(reached),
                ..BlockSample::automatic(sample.pv, sample.setpoint, Some(own_setpoint), sample.dt_s)
            },
        );
        self.inner.step(
            inner,
            &BlockSample {
                demand: inner_demand,
                ..BlockSample::automatic(sample.inner_pv, inner_setpoint, sample.held, sample.dt_s)
            },
        )
    }

    /// Somebody else decides the output and a measurement is missing: both start anew from the first good ones.
    pub const fn follow_blind(&mut self, value: f64) {
        self.outer.follow_blind(0.0);
        self.inner.follow_blind(value);
    }

    /// New tunings, outer and inner each: the output goes on without a bump.
    pub fn retune(&mut self, old: &(Tuning, Tuning), new: &(Tuning, Tuning)) {
        self.outer.retune(&old.0, &new.0);
        self.inner.retune(&old.1, &new.1);
    }
}
