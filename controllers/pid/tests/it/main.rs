//! Tests of the PID law against plants, exact results and an independent reference table.
//!
//! `items` has what a PID block must have and no other file has; `plant` the simulated processes; `reference` the figures;
//! `transfer` everything that must not bump; `limits` what holds for any numbers.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "tests")]

mod items;
mod limits;
mod plant;
mod reference;
mod transfer;
