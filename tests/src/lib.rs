//! The harness: real processes of the `bumpless` binary, asked over HTTP, with the actuators' own log beside them.
//!
//! ```text
//!   Cell ──starts──► HostProcess (plant) ─┬─ writes.csv ──► Journal
//!     │                                   └─ API ◄──┐
//!     └───starts──► HostProcess (a, b, c) ── API ◄──┴── Api, Feed
//! ```
//! Tests and benches stand on it. Everything binds port 0 and lives in a folder of its own, so cells run side by side.
//! What is started dies with the test, also when the test itself is killed.
//! Never: looks inside a host; what it knows is what a user can know.

mod api;
mod binary;
mod cell;
mod chaos;
mod device;
mod error;
mod feed;
mod host;
pub mod hostile;
mod journal;
pub mod masters;
mod slots;
mod wait;
mod watchdog;

use std::path::PathBuf;

pub use api::{Answer, Api};
pub use binary::Binary;
pub use cell::{Cell, CellOptions, PLANT, first_order_loop, host_number, pressure_loop};
pub use chaos::{
    Breach, Disk, Fault, Inflictor, Kind, Net, Observer, Operator, Order, Outcome, Profile, Relay, Schedule, Seen, Way,
    Window, kept_commands, unix_ns,
};
pub use device::{FieldDevice, Obeyed};
pub use error::Error;
pub use feed::{Event, Feed};
pub use host::{HostOptions, HostProcess};
pub use journal::{Gap, Journal, Violation, Write};
pub use wait::{POLL, WAIT_MAX, pause, wait_until};
pub use watchdog::Watchdog;

/// The folder with the components, built where they are not: `pid.wasm` and so on, and `guests/traps.wasm` and so on.
///
/// # Errors
/// What the build says.
pub fn components() -> Result<PathBuf, Error> {
    xtask::components::build().map_err(|error| Error::Components(Box::new(error)))
}

/// The repository's root.
#[must_use]
pub fn repository() -> PathBuf {
    let own = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    own.parent().map_or_else(|| own.clone(), PathBuf::from)
}
