//! A test guest: a law that is good for a while, and then throws its output, or traps.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{AFTER, Countdown, Misdeed, OUT};

const TABLE: &[ParameterSpec] = &[
    AFTER,
    ParameterSpec::number(
        "by",
        "out",
        0.0,
        -1e9,
        1e9,
        "Height of the throw in each step; 0 for a trap",
    ),
];
const BY: Parameter = Parameter::of(TABLE, "by");

struct Jumps;

impl Misdeed for Jumps {
    const NAME: &'static str = "jumps";
    const TEXT: &'static str = "Throws its output after a while";
    const PARAMETERS: &'static [ParameterSpec] = TABLE;

    fn strike(parameters: &Parameters<'_>, io: &mut Io<'_>, held: f64) -> Result<(), Fault> {
        let by = parameters.of(BY);
        if by == 0.0 {
            std::process::abort();
        }
        io.write(OUT, held + by);
        Ok(())
    }
}

bumpless_sdk::export!(Countdown<Jumps>);
