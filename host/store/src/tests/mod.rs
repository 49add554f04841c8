//! Tests of the store against real files.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod audit;
mod cycles;
mod failing_disk;
mod files;
mod kept;
mod killed;
pub(crate) mod mortal;
mod rows;
pub(crate) mod samples;
mod writer;
