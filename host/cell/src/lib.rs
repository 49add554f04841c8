//! The cell's bus: how hosts find each other and what they send.
//!
//! Owns: key expressions, the wire envelope, the Zenoh session, membership by liveliness, requests with replies, and the
//! sampler of a host's vitals. It is the only room that names `zenoh` and `sysinfo`.
//! Never: decides anything about a loop, stores anything, or blocks a caller of a cycle lane.
//!
//! ```text
//! cycle threads ── send_* / publish_* ──► lanes ──► zenoh ═══ network ═══ zenoh ──► inbox ──► sink(Arrival)
//!                                                        liveliness ──► members ──► sink(HostUp | HostDown)
//! any task ────── request().await ─────► query ═════════════════════════► inbox ──► sink(Request) ── Responder::reply
//! ```
//!
//! Reading order: `config`, `keys`, `wire`, `arrival`, then `session` with `bus`, `lanes`, `inbox`, `members`, `claims`, `roll` and `request`;
//! `vitals` and `probe` stand alone.

pub mod limits;

mod arrival;
mod bus;
mod claims;
mod config;
mod counters;
mod door;
mod error;
mod guarded;
mod inbox;
pub mod keys;
mod lanes;
mod members;
mod probe;
mod request;
mod roll;
mod session;
mod vitals;
pub mod wire;

// The tests inside and outside of this crate send the same messages; outside, it has this crate's name.
#[cfg(test)]
extern crate self as bumpless_cell;
#[cfg(test)]
#[path = "../tests/cell/nouns.rs"]
#[allow(clippy::expect_used, reason = "tests")]
mod nouns;

pub use arrival::{Arrival, Sink};
pub use config::Config;
pub use counters::Counters;
pub use door::Knock;
pub use error::Error;
pub use guarded::{TlsConfig, certificate_name};
pub use probe::{Measured, Probe};
pub use request::Responder;
pub use session::Session;
pub use vitals::{Roles, Vitals};
