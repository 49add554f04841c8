//! Tests of the PID law against plants, exact results and an independent reference table.
//!
//! `items` and `block` have what a PID block must have and no other file has; `chain` speaks of several in a row; `plant` the simulated processes; `reference` the figures;
//! `transfer` everything that must not bump; `limits` what holds for any numbers.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "tests")]

mod block;
mod chain;
mod items;
mod limits;
mod plant;
mod reference;
mod transfer;
