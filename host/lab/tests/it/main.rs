//! The lab with the real components: oracles, determinism, what faults do, and the published experiments.
//!
//! Never: a clock; everything here is virtual time.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod cell;
mod oracle;
mod published;
mod setup;
mod votes;
