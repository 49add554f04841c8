//! A test guest: its step publishes and raises alarms without measure.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{AFTER, Countdown, Misdeed};

const TABLE: &[ParameterSpec] = &[
    AFTER,
    ParameterSpec::number("messages", "", 1000.0, 0.0, 1e6, "Messages per step"),
    ParameterSpec::number("bytes", "", 16.0, 0.0, 1e6, "Length of a message"),
    ParameterSpec::number("alarms", "", 0.0, 0.0, 1e6, "Alarm changes per step"),
];
const MESSAGES: Parameter = Parameter::of(TABLE, "messages");
const BYTES: Parameter = Parameter::of(TABLE, "bytes");
const ALARMS: Parameter = Parameter::of(TABLE, "alarms");

struct FloodsMessages;

impl Misdeed for FloodsMessages {
    const NAME: &'static str = "floods-messages";
    const TEXT: &'static str = "Publishes and alarms far more than is allowed";
    const PARAMETERS: &'static [ParameterSpec] = TABLE;

    fn strike(parameters: &Parameters<'_>, io: &mut Io<'_>, _: f64) -> Result<(), Fault> {
        let data = vec![0; parameters.of(BYTES) as usize];
        for _ in 0..parameters.of(MESSAGES) as u64 {
            io.publish("flood", &data);
        }
        for _ in 0..parameters.of(ALARMS) as u64 {
            io.raise("flood", Priority::High, "Alarms without end");
        }
        Ok(())
    }
}

bumpless_sdk::export!(Countdown<FloodsMessages>);
