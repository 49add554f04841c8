//! A test guest: it takes over no state, not even its own.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{OUT, PORTS};
use serde::{Deserialize, Serialize};

struct DeclinesMigrate;

/// Nothing is remembered.
#[derive(Serialize, Deserialize)]
struct Empty;

impl Controller for DeclinesMigrate {
    const DESCRIPTION: Description = Description {
        name: "declines-migrate",
        version: env!("CARGO_PKG_VERSION"),
        text: "Declines every migrate",
        ports: PORTS,
        parameters: &[],
        state_layout: 1,
    };

    type State = Empty;

    fn start(_: &Parameters<'_>, _: &Track<'_>) -> Result<Empty, Fault> {
        Ok(Empty)
    }

    fn step(_: &mut Empty, _: &Parameters<'_>, _: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        io.write(OUT, io.held(OUT).value);
        Ok(())
    }

    fn retune(_: &mut Empty, _: &Parameters<'_>, _: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        Err(Fault::bad_state("this guest takes over no state"))
    }
}

bumpless_sdk::export!(DeclinesMigrate);
