//! A test guest: its start never ends.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{OUT, PORTS};
use serde::{Deserialize, Serialize};

struct StartSpins;

/// Nothing is remembered.
#[derive(Serialize, Deserialize)]
struct Empty;

impl Controller for StartSpins {
    const DESCRIPTION: Description = Description {
        name: "start-spins",
        version: env!("CARGO_PKG_VERSION"),
        text: "Never ends its start",
        ports: PORTS,
        parameters: &[],
        state_layout: 1,
    };

    type State = Empty;

    fn start(_: &Parameters<'_>, _: &Track<'_>) -> Result<Empty, Fault> {
        let mut turns = 0u64;
        loop {
            turns = std::hint::black_box(turns).wrapping_add(1);
        }
    }

    fn step(_: &mut Empty, _: &Parameters<'_>, _: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        io.write(OUT, io.held(OUT).value);
        Ok(())
    }
}

bumpless_sdk::export!(StartSpins);
