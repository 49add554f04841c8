//! Who is there, from liveliness tokens. Pure: tokens in, comings and goings out.
//!
//! Never: asks the network.
//!
//! ```text
//!          token                      last token gone
//! absent ────────► present(instance) ────────────────► absent
//!                   │        ▲
//!                   └────────┘ younger instance: Down, then Up
//! ```
//!
//! A host that restarts within its own lease shows two tokens for a while. The younger counts.

use std::collections::{BTreeMap, BTreeSet};

use bumpless_core::HostId;

use crate::keys::Instance;

/// What a change of tokens means.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Change {
    Up(HostId),
    Down(HostId),
}

/// The tokens that are there.
#[derive(Debug, Default)]
pub(crate) struct Members {
    lives: BTreeMap<HostId, BTreeSet<Instance>>,
}

impl Members {
    /// A token came.
    pub(crate) fn appear(&mut self, host: &HostId, instance: Instance) -> Vec<Change> {
        self.change(host, |lives| {
            lives.insert(instance);
        })
    }

    /// A token went.
    pub(crate) fn vanish(&mut self, host: &HostId, instance: &Instance) -> Vec<Change> {
        self.change(host, |lives| {
            lives.remove(instance);
        })
    }

    /// Everyone, in the order of names.
    pub(crate) fn hosts(&self) -> Vec<HostId> {
        self.lives.keys().cloned().collect()
    }

    fn change(&mut self, host: &HostId, edit: impl FnOnce(&mut BTreeSet<Instance>)) -> Vec<Change> {
        let lives = self.lives.entry(host.clone()).or_default();
        let before = lives.last().cloned();
        edit(lives);
        let after = lives.last().cloned();
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
        let (first, second) = (Instance::new(1, 7), Instance::new(2, 3));
        let mut members = Members::default();
        assert_eq!(members.appear(&host, first.clone()), [up.clone()]);
        assert_eq!(members.appear(&host, first.clone()), [], "a token that is repeated");
        assert_eq!(members.hosts(), [host.clone()]);
        assert_eq!(
            members.appear(&host, second.clone()),
            [down.clone(), up.clone()],
            "a restart"
        );
        assert_eq!(members.vanish(&host, &first), [], "the old life's token ends late");
        assert_eq!(members.vanish(&host, &second), [down.clone()]);
        assert_eq!(members.vanish(&host, &second), [], "a token that went before");
        assert!(members.hosts().is_empty());
        // A frozen old life under a young one that ends: the old one counts again.
        members.appear(&host, first.clone());
        members.appear(&host, second.clone());
        assert_eq!(members.vanish(&host, &second), [down, up]);
    }
}
