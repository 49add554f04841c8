//! A test guest: its step writes a value that is no number.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{Countdown, Misdeed, OUT};

struct ReturnsNan;

impl Misdeed for ReturnsNan {
    const NAME: &'static str = "returns-nan";
    const TEXT: &'static str = "Writes NaN to its output";

    fn strike(_: &Parameters<'_>, io: &mut Io<'_>, _: f64) -> Result<(), Fault> {
        io.write(OUT, f64::NAN);
        Ok(())
    }
}

bumpless_sdk::export!(Countdown<ReturnsNan>);
