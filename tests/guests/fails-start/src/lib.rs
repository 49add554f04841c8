//! A test guest: it does not start.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{OUT, PORTS};
use serde::{Deserialize, Serialize};

struct FailsStart;

/// Nothing is remembered.
#[derive(Serialize, Deserialize)]
struct Empty;

impl Controller for FailsStart {
    const DESCRIPTION: Description = Description {
        name: "fails-start",
        version: env!("CARGO_PKG_VERSION"),
        text: "Fails to start",
        ports: PORTS,
        parameters: &[],
        state_layout: 1,
    };

    type State = Empty;

    fn start(_: &Parameters<'_>, _: &Track<'_>) -> Result<Empty, Fault> {
        Err(Fault::failed("this guest never starts"))
    }

    fn step(_: &mut Empty, _: &Parameters<'_>, _: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        io.write(OUT, io.held(OUT).value);
        Ok(())
    }
}

bumpless_sdk::export!(FailsStart);
