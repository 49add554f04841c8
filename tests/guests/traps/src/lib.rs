//! A test guest: its step ends in a trap.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{Countdown, Misdeed};

struct Traps;

impl Misdeed for Traps {
    const NAME: &'static str = "traps";
    const TEXT: &'static str = "Traps in a step";

    fn strike(_: &Parameters<'_>, _: &mut Io<'_>, _: f64) -> Result<(), Fault> {
        // An `unreachable` instruction on wasm.
        std::process::abort()
    }
}

bumpless_sdk::export!(Countdown<Traps>);
