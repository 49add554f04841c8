//! What can go wrong on the command line and at the start of a host, with the exit code that scripts branch on.
//!
//! | code | meaning |
//! |---|---|
//! | 0 | done |
//! | 1 | failed |
//! | 2 | the command line is wrong (clap) |
//! | 3 | the cell refused; nothing changed (of a rollout that failed: what its report says) |
//! | 4 | the API could not be reached |

use std::{io, path::PathBuf};

use bumpless_api::Problem;

/// Why a command failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file or folder.
    #[error("{path} could not be {action}", path = path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// "read", "written" and the like.
        action: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// Something in a configuration or loop file.
    #[error("{path}, {place}: {reason}", path = path.display())]
    Config {
        /// The file.
        path: PathBuf,
        /// Line and key.
        place: String,
        /// What is wrong and what is allowed.
        reason: String,
    },
    /// A part of the host could not be started.
    #[error("{what} could not be started")]
    Start {
        /// Which part.
        what: &'static str,
        /// In that part's words.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A part of a running host failed for good.
    #[error("{what} failed")]
    Failed {
        /// Which part.
        what: &'static str,
        /// In that part's words.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The cell said no.
    #[error("{}: {}", .0.title, .0.detail)]
    Problem(Box<Problem>),
    /// The cell took a part and refused the rest; each part's words are in the answer.
    #[error("{0}")]
    Refused(String),
    /// Not every host is as far as was waited for.
    #[error("{0}")]
    Unready(String),
    /// No answer from the API.
    #[error("{api} could not be reached: {reason}")]
    Unreachable {
        /// The address.
        api: String,
        /// In the client's words.
        reason: String,
    },
    /// An answer that is none of ours.
    #[error("{api} answered what this program does not understand: {reason}")]
    Answer {
        /// The address.
        api: String,
        /// What about it.
        reason: String,
    },
    /// A source that does not build; the message names its places.
    #[error("{0}")]
    Build(Box<bumpless_build::Error>),
    /// What was typed cannot be meant.
    #[error("{0}")]
    Usage(String),
    /// The terminal.
    #[error("the terminal could not be {action}")]
    Terminal {
        /// "written" and the like.
        action: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// The demonstration could not be set up.
    #[error("{0}")]
    Demo(String),
}

impl Error {
    /// A part that could not be started.
    pub fn start(what: &'static str, source: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self::Start {
            what,
            source: source.into(),
        }
    }

    /// The exit code.
    #[must_use]
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Problem(problem) if problem.status < 500 => 3,
            Self::Refused(_) => 3,
            Self::Unreachable { .. } => 4,
            _ => 1,
        }
    }

    /// What helps, where it is known.
    #[must_use]
    pub fn cure(&self) -> Option<String> {
        match self {
            Self::Problem(problem) => problem.cure.clone(),
            Self::Unreachable { .. } => {
                Some("start a host (`bumpless demo` starts a whole cell), or name another with --api".to_owned())
            }
            Self::File { action: "read", .. } => Some("check the path and your rights to it".to_owned()),
            _ => None,
        }
    }

    /// What failed, why, and what helps: one line each.
    #[must_use]
    pub fn report(&self) -> String {
        let mut text = format!("error: {self}");
        let mut source = std::error::Error::source(self);
        while let Some(error) = source {
            text.push_str(&format!("\n  why: {error}"));
            source = error.source();
        }
        if let Some(cure) = self.cure() {
            text.push_str(&format!("\n  try: {cure}"));
        }
        text
    }

    /// The same for programs, as one line of JSON: the API's problem as it came, of anything else its words.
    #[must_use]
    pub fn json(&self) -> String {
        let text = match self {
            Self::Problem(problem) => serde_json::to_string(problem),
            other => serde_json::to_string(&serde_json::json!({ "error": other.report() })),
        };
        // Plain text always serialises.
        text.unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    fn problem(status: u16) -> Error {
        let text = format!(
            r#"{{"type":"urn:x","title":"The cell refuses this now","status":{status},"detail":"it would bump","cure":"wait"}}"#
        );
        Error::Problem(serde_json::from_str(&text).expect("a problem"))
    }

    #[test]
    fn exit_codes_tell_scripts_what_happened() {
        let unreachable = Error::Unreachable {
            api: "http://x".into(),
            reason: "refused".into(),
        };
        for (error, code) in [
            (problem(409), 3),
            (problem(404), 3),
            (problem(503), 1),
            (unreachable, 4),
            (Error::Usage("x".into()), 2),
            (Error::Demo("x".into()), 1),
        ] {
            assert_eq!(error.exit_code(), code, "{error}");
        }
    }

    #[test]
    fn programs_get_the_problem_as_it_came() {
        let text = problem(409).json();
        assert!(
            text.contains("\"type\":\"urn:x\"") && text.contains("\"cure\":\"wait\""),
            "{text}"
        );
        assert_eq!(Error::Usage("x".into()).json(), r#"{"error":"error: x"}"#);
    }

    #[test]
    fn a_report_says_what_why_and_what_helps() {
        assert_eq!(
            problem(409).report(),
            "error: The cell refuses this now: it would bump\n  try: wait"
        );
        let source = io::Error::new(io::ErrorKind::NotFound, "no such file");
        let error = Error::File {
            path: "x.toml".into(),
            action: "read",
            source,
        };
        assert_eq!(
            error.report(),
            "error: x.toml could not be read\n  why: no such file\n  try: check the path and your rights to it"
        );
    }
}
