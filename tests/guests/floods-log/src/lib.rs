//! A test guest: its step logs without measure.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{AFTER, Countdown, Misdeed};

const TABLE: &[ParameterSpec] = &[
    AFTER,
    ParameterSpec::number("lines", "", 1000.0, 0.0, 1e6, "Lines per step"),
    ParameterSpec::number("bytes", "", 4096.0, 0.0, 1e6, "Length of a line"),
];
const LINES: Parameter = Parameter::of(TABLE, "lines");
const BYTES: Parameter = Parameter::of(TABLE, "bytes");

struct FloodsLog;

impl Misdeed for FloodsLog {
    const NAME: &'static str = "floods-log";
    const TEXT: &'static str = "Logs far more than is allowed";
    const PARAMETERS: &'static [ParameterSpec] = TABLE;

    fn strike(parameters: &Parameters<'_>, io: &mut Io<'_>, _: f64) -> Result<(), Fault> {
        let line = "x".repeat(parameters.of(BYTES) as usize);
        for _ in 0..parameters.of(LINES) as u64 {
            io.log(Level::Warning, &line);
        }
        Ok(())
    }
}

bumpless_sdk::export!(Countdown<FloodsLog>);
