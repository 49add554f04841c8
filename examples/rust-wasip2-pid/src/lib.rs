//! The component `rust-wasip2-pid`: the example law, built by plain `cargo build --target wasm32-wasip2`.
//!
//! Never: arithmetic (`law.rs`), or anything but names (`block.rs` has the rest).

#[path = "../../rust-pid/src/block.rs"]
pub mod block;
#[path = "../../rust-pid/src/law.rs"]
pub mod law;

use bumpless_sdk::prelude::*;
use law::Memory;

/// The controller.
#[derive(Debug)]
pub struct RustWasip2Pid;

impl Controller for RustWasip2Pid {
    const DESCRIPTION: Description = block::description(
        "rust-wasip2-pid",
        env!("CARGO_PKG_VERSION"),
        "The example law in Rust, built for wasm32-wasip2",
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

bumpless_sdk::export!(RustWasip2Pid);
