//! Programs compiled and run in the sandbox, cycle by cycle: what they give, what they refuse, how they take over.
//!
//! Never: looks at the compiler's inside; texts go in, components come out.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod cell;
mod errors;
mod folding;
mod language;
mod library;
mod lines;
mod takeover;
