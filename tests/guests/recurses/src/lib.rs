//! A test guest: its step calls itself until the stack ends.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{Countdown, Misdeed};

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

    fn strike(_: &Parameters<'_>, _: &mut Io<'_>, held: f64) -> Result<(), Fault> {
        if deeper(0) == u64::MAX {
            Err(Fault::failed("came back"))
        } else {
            Ok(drop(std::hint::black_box(held)))
        }
    }
}

bumpless_sdk::export!(Countdown<Recurses>);
