//! A test guest: its step never ends.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{Countdown, Misdeed};

struct Spins;

impl Misdeed for Spins {
    const NAME: &'static str = "spins";
    const TEXT: &'static str = "Never ends a step";

    fn strike(_: &Parameters<'_>, _: &mut Io<'_>, _: f64) -> Result<(), Fault> {
        let mut turns = 0u64;
        loop {
            turns = std::hint::black_box(turns).wrapping_add(1);
        }
    }
}

bumpless_sdk::export!(Countdown<Spins>);
