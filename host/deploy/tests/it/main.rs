//! Deployment with real disks, sandboxes, buses and sessions on loopback; only the loops are written down instead of run.
//!
//! Never: sleeps to let something happen. A test waits until what it expects is so, and a generous patience makes it fail.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::needless_pass_by_value,
    reason = "tests"
)]

mod admission;
mod apply;
mod change;
mod distribution;
mod field;
mod harness;
mod library;
mod lifetime;
mod orders;
mod real;
mod rollouts;
mod trials;
mod uploads;
