//! The component `pidplus`: glue between the SDK, the shared ISA block and this controller's rule of time (`law.rs`).
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::block::{self, Block};
use bumpless_sdk::prelude::*;

/// The controller.
#[derive(Debug)]
pub struct PidPlus;

impl Controller for PidPlus {
    const DESCRIPTION: Description = block::description(
        "pidplus",
        env!("CARGO_PKG_VERSION"),
        "PIDPlus: PID that waits for fresh measurements",
    );

    type State = Block;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Block, Fault> {
        Ok(block::start(parameters, track)?.into())
    }

    fn step(state: &mut Block, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        block::step(state, parameters, cycle, io, law::elapsed_s)
    }

    fn retune(state: &mut Block, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        block::retune(&mut state.memory, old, new)
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<Block>, Fault> {
        block::adopt_block(from, parameters)
    }
}

bumpless_sdk::export!(PidPlus);
bumpless_sdk::state_form!(
    "phase: enum(new,following,running,bypassed)",
    "output: f64",
    "integral: f64",
    "pv: f64",
    "setpoint: f64",
    "feedforward: f64",
    "derivative: f64",
    "derivative-setpoint: f64",
    "waited-s: f64",
    "remote: bool",
    "alarms: hex8",
    "below: option<(f64, hex8, u8)>",
    "limits: hex8",
);
