//! Who is there, from liveliness tokens. Pure: tokens in, comings and goings out.
//!
//! Never: asks the network.
//!
//! ```text
//!          token                       last token gone
//! absent ────────► present(instance) ─────────────────► absent
//!                   │        ▲
//!                   └────────┘ first token gone, a later one left: Down, then Up
//! ```
//!
//! Two tokens of one name are a restart within the lease, or a namesake that is about to leave. The one that came first counts
//! until it goes: a restart is told once the old life is over, and a namesake disturbs nobody. No clock says which came first;
//! each host goes by what it saw.

use std::collections::BTreeMap;

use bumpless_core::HostId;

use crate::keys::Instance;

/// Tokens of one name that are remembered: more are no restart, and the first counts in any case.
const LIVES_MAX: usize = 16;

/// What a change of tokens means.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Change {
    Up(HostId),
    Down(HostId),
}

/// The tokens that are there.
#[derive(Debug, Default)]
pub(crate) struct Members {
    /// Each host's, in the order in which they came. A host has one or two.
    lives: BTreeMap<HostId, Vec<Instance>>,
}

impl Members {
    /// A token came.
    pub(crate) fn appear(&mut self, host: &HostId, instance: Instance) -> Vec<Change> {
        self.change(host, |lives| {
            if !lives.contains(&instance) && lives.len() < LIVES_MAX {
                lives.push(instance);
            }
        })
    }

    /// A token went.
    pub(crate) fn vanish(&mut self, host: &HostId, instance: &Instance) -> Vec<Change> {
        self.change(host, |lives| {
            lives.retain(|life| life != instance);
        })
    }

    /// Is this life's token there?
    pub(crate) fn has(&self, host: &HostId, instance: &Instance) -> bool {
        self.lives.get(host).is_some_and(|lives| lives.contains(instance))
    }

    /// Everyone, in the order of names.
    pub(crate) fn hosts(&self) -> Vec<HostId> {
        self.lives.keys().cloned().collect()
    }

    fn change(&mut self, host: &HostId, edit: impl FnOnce(&mut Vec<Instance>)) -> Vec<Change> {
        let lives = self.lives.entry(host.clone()).or_default();
        let before = lives.first().cloned();
        edit(lives);
        let after = lives.first().cloned();
        if lives.is_empty() {
            self.lives.remove(host);
        }
        let mut changes = Vec::new();
        if before != after {
            changes.extend(before.map(|_| Change::Down(host.clone())));
            changes.extend(after.map(|_| Change::Up(host.clone())));
        }
        changes
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn comings_and_goings() {
        let host = HostId::new("a").unwrap();
        let (up, down) = (Change::Up(host.clone()), Change::Down(host.clone()));
        // Whatever their numbers: the second sorts first.
        let (first, second) = (Instance::new(2, 7), Instance::new(1, 3));
        let mut members = Members::default();
        assert_eq!(members.appear(&host, first.clone()), vec![up.clone()]);
        assert_eq!(members.appear(&host, first.clone()), [], "a token that is repeated");
        assert_eq!(members.hosts(), vec![host.clone()]);
        assert_eq!(
            members.appear(&host, second.clone()),
            [],
            "a namesake, or a restart that is not over"
        );
        assert_eq!(members.vanish(&host, &second), [], "the namesake leaves");
        members.appear(&host, second.clone());
        assert_eq!(members.vanish(&host, &first), [down.clone(), up.clone()], "a restart");
        assert_eq!(members.vanish(&host, &first), [], "a token that went before");
        // A frozen life that goes on came later, and counts when it is the one that is left.
        assert_eq!(members.appear(&host, first.clone()), []);
        assert_eq!(members.vanish(&host, &second), [down.clone(), up]);
        assert_eq!(members.vanish(&host, &first), [down]);
        assert!(members.hosts().is_empty());
    }
}
