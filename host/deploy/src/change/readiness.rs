//! How the members of a loop answered when they were asked to try or hold a revision, and what that means for the asker.
//!
//! Never: asks; `change` does.

use bumpless_core::HostId;

use crate::error::{Error, Words};

/// How the members answered.
pub(super) struct Readiness {
    pub(super) ready: Vec<HostId>,
    pub(super) missing: Vec<(HostId, Error)>,
}

impl Readiness {
    fn reasons(&self) -> String {
        self.missing
            .iter()
            .map(|(host, error)| format!("{host}: {}", error.words()))
            .collect::<Vec<_>>()
            .join("; ")
    }

    /// The error where nobody can run it: what the component or the parameters did wrong is wrong everywhere, so its kind
    /// counts before a host that is away.
    pub(super) fn failure(&self, what: &str, cure: &str) -> Error {
        let words = Words::new(format!("{what} ({})", self.reasons()), cure);
        let kinds = || self.missing.iter().map(|(_, error)| error);
        if kinds().any(|e| matches!(e, Error::Invalid(_) | Error::Refused(_) | Error::NotFound(_))) {
            Error::Refused(words)
        } else if kinds().any(|e| matches!(e, Error::Busy(_))) {
            Error::Busy(words)
        } else if kinds().any(|e| matches!(e, Error::Timeout(_))) {
            Error::Timeout(words)
        } else {
            Error::Unreachable(words)
        }
    }
}
