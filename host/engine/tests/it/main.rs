//! The engine against guests that behave and guests that do not, each a few lines of text in `guest`.
//!
//! Nothing here waits for a time to pass or judges one, except that a spinning guest must come back at all.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod admission;
mod bombs;
mod cache;
mod calls;
mod child;
mod guest;
mod hostile;
mod lifecycle;
mod misdeeds;
mod stock;
