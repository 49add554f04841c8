//! A test guest: its step asks for memory without end.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{AFTER, Countdown, Misdeed};

const TABLE: &[ParameterSpec] = &[
    AFTER,
    ParameterSpec::number(
        "mebibytes",
        "MiB",
        1024.0,
        0.0,
        4096.0,
        "How much it asks for in one step",
    ),
];
const MEBIBYTES: Parameter = Parameter::of(TABLE, "mebibytes");

struct GrowsMemory;

impl Misdeed for GrowsMemory {
    const NAME: &'static str = "grows-memory";
    const TEXT: &'static str = "Asks for more and more memory";
    const PARAMETERS: &'static [ParameterSpec] = TABLE;

    fn strike(parameters: &Parameters<'_>, _: &mut Io<'_>, _: f64) -> Result<(), Fault> {
        let mut kept: Vec<Vec<u8>> = Vec::new();
        for _ in 0..parameters.of(MEBIBYTES) as usize {
            // Where the host refuses the memory, the allocation ends in a trap.
            kept.push(std::hint::black_box(vec![1; 1024 * 1024]));
        }
        drop(std::hint::black_box(kept));
        Ok(())
    }
}

bumpless_sdk::export!(Countdown<GrowsMemory>);
