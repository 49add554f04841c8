//! Why a test could not be set up, or what it waited for did not come.

use std::{io, path::PathBuf};

/// Why the harness could not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The binary is not built.
    #[error("{path} is not there: `{command}` builds it, or BUMPLESS_BIN names another")]
    NoBinary {
        /// Where it should be.
        path: PathBuf,
        /// What builds it.
        command: &'static str,
    },
    /// The components are not built.
    #[error("the components cannot be built")]
    Components(#[source] Box<xtask::components::Error>),
    /// A file or folder.
    #[error("{path}: cannot be {action}")]
    File {
        /// Which.
        path: PathBuf,
        /// "read", "written" or "removed".
        action: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// A program.
    #[error("{program} cannot be run")]
    Program {
        /// Which.
        program: String,
        /// What the system says.
        source: io::Error,
    },
    /// A host did not come up.
    #[error("host {host} did not start: {why}\n{stderr}")]
    NotReady {
        /// Which.
        host: String,
        /// In words.
        why: String,
        /// The end of its error output.
        stderr: String,
    },
    /// A host did not end.
    #[error("host {host}: {why}\n{stderr}")]
    Process {
        /// Which.
        host: String,
        /// In words.
        why: String,
        /// The end of its error output.
        stderr: String,
    },
    /// No host of that name, or none that runs.
    #[error("{0}")]
    NoHost(String),
    /// The request did not get an answer.
    #[error("{method} {url}: no answer")]
    Http {
        /// The method.
        method: String,
        /// The address.
        url: String,
        /// What the client says.
        source: Box<ureq::Error>,
    },
    /// The answer is not the success that was wanted.
    #[error("{method} {url}: {status}: {body}")]
    Refused {
        /// The method.
        method: String,
        /// The address.
        url: String,
        /// HTTP status.
        status: u16,
        /// Its body: a problem in words.
        body: String,
    },
    /// The answer is not JSON.
    #[error("{url}: the answer is no JSON: {text}")]
    Json {
        /// The address.
        url: String,
        /// The answer, cut.
        text: String,
        /// What the parser says.
        source: serde_json::Error,
    },
    /// A guest that cannot be made.
    #[error("no guest can be made of it: {0}")]
    Guest(String),
    /// Waited in vain.
    #[error("waited {seconds:.1} s for {what}; last seen: {seen}")]
    Waited {
        /// For what.
        what: String,
        /// How long.
        seconds: f64,
        /// What was seen last.
        seen: String,
    },
    /// The live feed ended.
    #[error("the live feed ended: {0}")]
    FeedEnded(String),
    /// The journal has a line that is none.
    #[error("{path}, line {line}: {text:?} is no line of a journal")]
    Journal {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// The text.
        text: String,
    },
}

impl Error {
    /// The HTTP status of a refused request, else 0.
    #[must_use]
    pub const fn status(&self) -> u16 {
        match self {
            Self::Refused { status, .. } => *status,
            _ => 0,
        }
    }
}
