//! A test guest: its state is larger than any host allows.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{AFTER, OUT, PORTS};
use serde::{Deserialize, Serialize};

const TABLE: &[ParameterSpec] = &[
    AFTER,
    ParameterSpec::number(
        "bytes",
        "",
        65_537.0,
        0.0,
        1e8,
        "Size of the state beyond its first bytes",
    ),
];
const STEPS: Parameter = Parameter::of(TABLE, "after");
const BYTES: Parameter = Parameter::of(TABLE, "bytes");

struct BadState;

/// Steps done so far, and the ballast.
#[derive(Serialize, Deserialize)]
struct Ballast {
    steps: u64,
    bytes: Vec<u8>,
}

impl Controller for BadState {
    const DESCRIPTION: Description = Description {
        name: "bad-state",
        version: env!("CARGO_PKG_VERSION"),
        text: "Returns a huge state",
        ports: PORTS,
        parameters: TABLE,
        state_layout: 1,
    };

    type State = Ballast;

    fn start(_: &Parameters<'_>, _: &Track<'_>) -> Result<Ballast, Fault> {
        Ok(Ballast {
            steps: 0,
            bytes: Vec::new(),
        })
    }

    fn step(state: &mut Ballast, parameters: &Parameters<'_>, _: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        io.write(OUT, io.held(OUT).value);
        if state.steps as f64 >= parameters.of(STEPS) {
            state.bytes = vec![0x5A; parameters.of(BYTES) as usize];
        }
        state.steps += 1;
        Ok(())
    }
}

bumpless_sdk::export!(BadState);
