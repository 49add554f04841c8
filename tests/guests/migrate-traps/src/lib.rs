//! A test guest: it traps when it is to take over a state.
//!
//! Never: used outside tests.

use bumpless_sdk::prelude::*;
use guest_countdown::{OUT, PORTS};
use serde::{Deserialize, Serialize};

struct MigrateTraps;

/// Nothing is remembered.
#[derive(Serialize, Deserialize)]
struct Empty;

impl Controller for MigrateTraps {
    const DESCRIPTION: Description = Description {
        name: "migrate-traps",
        version: env!("CARGO_PKG_VERSION"),
        text: "Traps in every migrate",
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
        // An `unreachable` instruction on wasm.
        std::process::abort()
    }
}

bumpless_sdk::export!(MigrateTraps);
