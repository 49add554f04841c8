//! The lab: control experiments in virtual time, with the components and the cycle of a live host.
//!
//! Owns: experiments as data, their runs, their figures and reports. A run takes the very functions of `bumpless_core` that a
//! host takes (desk, seat, guard, select, swap), steps real components in the sandbox, and puts a simulated plant, network and
//! cell around them. Minutes take milliseconds, and the same experiment and seed give the same bytes.
//! Never: a live point, a socket, a real-time thread.
//!
//! ```text
//! experiment (TOML) ─ variants ─► lab ─ workers ─► world: plant ◄─► network ◄─► desk ◄─► seats ─► meters ─► results ─► report
//! ```
//! Reading order: `experiment`, `variant`, `network`, `library`, `lab`; a run is `world` with `field`, `seat`, `exchange`,
//! `happening`, `meter`; then `result`, `report`.

pub mod error;
pub mod experiment;
pub mod lab;
pub mod library;
pub mod limits;
pub mod meter;
pub mod network;
pub mod recorded;
pub mod report;
pub mod result;
pub mod sensitivity;
pub mod variant;

mod exchange;
mod field;
mod happening;
mod home;
mod seat;
mod vote;
mod world;

pub use error::Error;
pub use experiment::Experiment;
pub use lab::{Chosen, Lab, Options, Progress};
pub use library::{Library, folders};
pub use meter::{FIGURES, Figure};
pub use result::{Outcome, RunResult, Summary, VariantResult};
