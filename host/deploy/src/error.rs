//! Why the cell did not do what was asked, sorted by what the asker can do about it.
//!
//! An error crosses hosts: what the home refuses is what the caller reads, wherever it asked. So it holds words and no
//! sources; the words of a source are taken in once, where the error is made.
//! Never: says only that something failed.

use std::fmt;

use serde::{Deserialize, Serialize};

/// What is wrong, and what helps.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Words {
    /// What is wrong, naming the place.
    pub reason: String,
    /// What the asker can do; empty where the reason says it.
    pub cure: String,
}

impl Words {
    /// What is wrong, and what helps.
    pub fn new(reason: impl Into<String>, cure: impl Into<String>) -> Self {
        Self {
            reason: reason.into(),
            cure: cure.into(),
        }
    }
}

impl fmt::Display for Words {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.cure.is_empty() {
            f.write_str(&self.reason)
        } else {
            write!(f, "{}; {}", self.reason, self.cure)
        }
    }
}

/// Why the cell did not do what was asked. Each variant is one kind of answer to the asker.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
pub enum Error {
    /// No such loop, component, host, point or revision.
    #[error("{0}")]
    NotFound(Words),
    /// What was given cannot be right, whatever the cell does.
    #[error("{0}")]
    Invalid(Words),
    /// It could be right, but not with what the cell has or does now.
    #[error("{0}")]
    Refused(Words),
    /// The loop is not at the revision that the asker counts on any more.
    #[error("{0}")]
    Stale(Words),
    /// A limit is reached, or another change is under way; later it may do.
    #[error("{0}")]
    Busy(Words),
    /// The host that must answer is not there.
    #[error("{0}")]
    Unreachable(Words),
    /// The host that must answer did not, in time. What was asked may still happen.
    #[error("{0}")]
    Timeout(Words),
    /// The disk.
    #[error("{0}")]
    Store(Words),
    /// A fault of the program.
    #[error("{0}")]
    Internal(Words),
}

impl Error {
    /// What is wrong and what helps, apart.
    #[must_use]
    pub const fn words(&self) -> &Words {
        match self {
            Self::NotFound(w)
            | Self::Invalid(w)
            | Self::Refused(w)
            | Self::Stale(w)
            | Self::Busy(w)
            | Self::Unreachable(w)
            | Self::Timeout(w)
            | Self::Store(w)
            | Self::Internal(w) => w,
        }
    }

    /// Nothing of that name.
    pub fn not_found(reason: impl Into<String>, cure: impl Into<String>) -> Self {
        Self::NotFound(Words::new(reason, cure))
    }

    /// What was given cannot be right.
    pub fn invalid(reason: impl Into<String>, cure: impl Into<String>) -> Self {
        Self::Invalid(Words::new(reason, cure))
    }

    /// Not with what the cell has or does now.
    pub fn refused(reason: impl Into<String>, cure: impl Into<String>) -> Self {
        Self::Refused(Words::new(reason, cure))
    }

    /// Later it may do.
    pub fn busy(reason: impl Into<String>, cure: impl Into<String>) -> Self {
        Self::Busy(Words::new(reason, cure))
    }

    /// The host is not there.
    pub fn unreachable(reason: impl Into<String>, cure: impl Into<String>) -> Self {
        Self::Unreachable(Words::new(reason, cure))
    }

    /// The host did not answer in time.
    pub fn timeout(reason: impl Into<String>, cure: impl Into<String>) -> Self {
        Self::Timeout(Words::new(reason, cure))
    }

    /// A fault of the program.
    pub fn internal(reason: impl Into<String>) -> Self {
        Self::Internal(Words::new(reason, "report this, it is a fault of the program"))
    }
}

/// An error and its sources, in one line.
pub(crate) fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(source) = next {
        text.push_str(": ");
        text.push_str(&source.to_string());
        next = source.source();
    }
    text
}

impl From<bumpless_store::Error> for Error {
    fn from(error: bumpless_store::Error) -> Self {
        Self::Store(Words::new(chain(&error), ""))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_reason_and_cure() {
        assert_eq!(Error::refused("a is b", "do c").to_string(), "a is b; do c");
        assert_eq!(Error::refused("a is b", "").to_string(), "a is b");
    }
}
