//! A test guest: its step calls itself until the stack ends.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{Countdown, Misdeed, OUT};

/// Uses the result of the inner call after it, so that no compiler turns this into a loop.
#[allow(unconditional_recursion, reason = "the misdeed")]
fn deeper(depth: u64) -> u64 {
    let room = std::hint::black_box([depth; 8]);
    deeper(depth.wrapping_add(1)).wrapping_add(room.iter().sum())
}

struct Recurses;

impl Misdeed for Recurses {
    const NAME: &'static str = "recurses";
    const TEXT: &'static str = "Recurses without end";

    fn strike(_: &Parameters<'_>, io: &mut Io<'_>, _: f64) -> Result<(), Fault> {
        io.write(OUT, deeper(0) as f64);
        Ok(())
    }
}

bumpless_sdk::export!(Countdown<Recurses>);
