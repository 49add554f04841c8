//! The component `pid`: glue between the SDK, the shared ISA block and this controller's rule of time (`law.rs`).
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{Memory, block};
use bumpless_sdk::prelude::*;

/// The controller.
#[derive(Debug)]
pub struct Pid;

impl Controller for Pid {
    const DESCRIPTION: Description = block::description(
        "pid",
        env!("CARGO_PKG_VERSION"),
        "PID controller, ISA standard form, with external reset",
    );

    type State = Memory;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Memory, Fault> {
        block::start(parameters, track)
    }

    fn step(memory: &mut Memory, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        block::step(memory, parameters, cycle, io, law::elapsed_s)
    }

    fn retune(memory: &mut Memory, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        block::retune(memory, old, new)
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<Memory>, Fault> {
        block::adopt(from, parameters)
    }
}

bumpless_sdk::export!(Pid);
