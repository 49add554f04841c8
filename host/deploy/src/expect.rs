//! What a change of a loop relies on, checked by the loop's home at the moment of the change.
//!
//! Two people who read a loop and then change it must not undo each other's work unseen. The home makes one change of a loop at
//! a time, so it alone can say whether the revision is still the one that was read. Never: looks at anything but the number.

use bumpless_core::LoopId;
use serde::{Deserialize, Serialize};

use crate::error::Error;

/// What must be in force for a change to be made.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum Expect {
    /// Whatever there is, or nothing.
    #[default]
    Anything,
    /// No loop of that name.
    Nothing,
    /// A loop, at any revision.
    Something,
    /// One of these revisions.
    OneOf(Vec<u64>),
}

impl Expect {
    /// Does it hold of the revision in force (none where there is no loop)?
    ///
    /// # Errors
    /// [`Error::Stale`], with what there is.
    pub(crate) fn check(&self, id: &LoopId, revision: Option<u64>) -> Result<(), Error> {
        let holds = match self {
            Self::Anything => true,
            Self::Nothing => revision.is_none(),
            Self::Something => revision.is_some(),
            Self::OneOf(revisions) => revision.is_some_and(|now| revisions.contains(&now)),
        };
        if holds {
            return Ok(());
        }
        let stands = match revision {
            Some(revision) => format!("loop {id} is at revision {revision}"),
            None => format!("there is no loop {id}"),
        };
        Err(Error::Stale(crate::Words::new(
            format!("{stands}, which is not what the change counts on"),
            "read the loop again, look at what changed, and send the change with its revision",
        )))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn what_is_relied_on_holds_or_is_told() {
        let id = LoopId::new("l").unwrap();
        // What is relied on: does it hold of nothing, of revision 3?
        for (expect, of_nothing, of_three) in [
            (Expect::Anything, true, true),
            (Expect::Nothing, true, false),
            (Expect::Something, false, true),
            (Expect::OneOf(vec![2, 3]), false, true),
            (Expect::OneOf(vec![2]), false, false),
            (Expect::OneOf(vec![]), false, false),
        ] {
            assert_eq!(expect.check(&id, None).is_ok(), of_nothing, "{expect:?}");
            assert_eq!(expect.check(&id, Some(3)).is_ok(), of_three, "{expect:?}");
        }
        let error = Expect::Nothing.check(&id, Some(3)).expect_err("it is there");
        assert!(error.to_string().contains("loop l is at revision 3"), "{error}");
    }
}
