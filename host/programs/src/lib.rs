//! Free-running programs on one host: their threads, their time, their part of the processor, and their mail.
//!
//! ```text
//!  deploy: start(order) ──► a task on the programs' own threads (few, at low priority)
//!                              │ guest runs ── every ms: stopped? paused? share used up? ── waits, or goes on
//!                              │ reads, writes, publishes, saves ──► Reach (deploy: the program's home)
//!                              └ ends ──► Stopped or Fault; the place is free
//! ```
//! Owns: runs from start to end, the timer that wakes them, the messages that wait for them, their last lines.
//! Never: runs anything on a thread of a cycle, decides where a program runs, or touches a point: `Reach` does.

mod error;
mod exchange;
mod gate;
mod run;
mod runner;
mod share;
mod timer;

pub use error::Error;
pub use exchange::Exchange;
pub use run::{Line, Reach, RunView};
pub use runner::{Order, Runner};
