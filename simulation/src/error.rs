//! Why a simulation cannot be made.

use std::{io, path::PathBuf};

/// Why a simulation cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A number out of range.
    #[error("{0}")]
    Plan(String),
    /// Not a kind of fault.
    #[error("fault {found:?} is unknown: use {known}")]
    Fault {
        /// What was given.
        found: String,
        /// What there is.
        known: String,
    },
    /// Not a rule that can be broken.
    #[error("rule {found:?} is unknown: use {known}")]
    Rule {
        /// What was given.
        found: String,
        /// What there is.
        known: String,
    },
    /// The file of faults says something else.
    #[error("the schedule of faults: {0}")]
    Schedule(String),
    /// The file of faults cannot be read.
    #[error("{path} cannot be read: name a file of faults")]
    File {
        /// Which.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
}
