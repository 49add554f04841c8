//! The component `rust-pid`: the example law as a crate of this tree, for `wasm32-unknown-unknown`.
//!
//! Never: arithmetic (`law.rs`), or anything but names (`block.rs` has the rest).

pub mod block;
pub mod law;

use bumpless_sdk::prelude::*;
use law::Memory;

/// The controller.
#[derive(Debug)]
pub struct RustPid;

impl Controller for RustPid {
    const DESCRIPTION: Description = block::description(
        "rust-pid",
        env!("CARGO_PKG_VERSION"),
        "The example law in Rust: PI(D) with clamping",
    );

    type State = Memory;

    fn start(_: &Parameters<'_>, track: &Track<'_>) -> Result<Memory, Fault> {
        Ok(Memory::new(track.of(block::OUT)))
    }

    fn step(memory: &mut Memory, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        block::step(memory, parameters, cycle, io)
    }

    fn retune(memory: &mut Memory, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        block::retune(memory, old, new);
        Ok(())
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<Memory>, Fault> {
        block::adopt(from, parameters)
    }
}

bumpless_sdk::export!(RustPid);
