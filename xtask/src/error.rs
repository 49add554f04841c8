//! Why the project's own tool failed.

use std::{io, path::PathBuf};

use crate::components;

/// Why a command failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The components.
    #[error(transparent)]
    Components(#[from] components::Error),
    /// A program is not there or cannot be run.
    #[error("{program} cannot be run: install it and put it on the path")]
    Program {
        /// Its name.
        program: String,
        /// What the system says.
        source: io::Error,
    },
    /// A program ended badly; what it had to say stands above.
    #[error("`{command}` ended with {status}")]
    Failed {
        /// The command line.
        command: String,
        /// How it ended.
        status: String,
    },
    /// A file or folder.
    #[error("{path}: cannot be written")]
    File {
        /// Which.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The interfaces.
    #[error("wit/: {0}")]
    Wit(String),
    /// An example in another language does not build.
    #[error("examples/{name}: `{command}` failed; it said:\n{said}")]
    Example {
        /// Its folder.
        name: String,
        /// What was run.
        command: String,
        /// The end of what it wrote.
        said: String,
    },
    /// A file or folder that is needed.
    #[error("{path}: cannot be read")]
    Read {
        /// Which.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// A fuzzer.
    #[error("{0}")]
    Fuzz(String),
    /// A step of the checks failed.
    #[error("the step {step:?} failed")]
    Step {
        /// Its name.
        step: &'static str,
        /// Why.
        source: Box<Error>,
    },
}
