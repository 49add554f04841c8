//! The cells that are checked, and the rules that are taken away to see that their absence shows.
//!
//! Owns the bounds. Never: checks.

use crate::{
    cell::Bounds,
    rules::{Broken, RULES},
};

/// A cell in which nothing goes wrong but delay and reordering, for two cycles.
pub const QUIET: Bounds = Bounds {
    hosts: 2,
    cycles: 2,
    losses: 0,
    repeats: 0,
    crashes: 0,
    restarts: 0,
    commands: &[],
    lazy_disk: false,
};

/// A cell by what may happen in it. A pause is a delay: what goes to a host that stands still, and what comes from it, stays on
/// its way while others go on.
pub const CELLS: [(&str, Bounds); 10] = [
    ("delays, pauses and reordering", Bounds { cycles: 3, ..QUIET }),
    (
        "loss, and a command",
        Bounds {
            losses: 1,
            commands: &[0],
            ..QUIET
        },
    ),
    ("repetition", Bounds { repeats: 1, ..QUIET }),
    ("a death", Bounds { crashes: 1, ..QUIET }),
    ("the home's death", Bounds { restarts: 1, ..QUIET }),
    (
        "two setpoints and another revision",
        Bounds {
            commands: &[0, 1, 2],
            cycles: 1,
            ..QUIET
        },
    ),
    (
        "a swap, and loss",
        Bounds {
            losses: 1,
            commands: &[2],
            ..QUIET
        },
    ),
    (
        "a swap, and a death",
        Bounds {
            crashes: 1,
            commands: &[2],
            cycles: 1,
            ..QUIET
        },
    ),
    (
        "a swap, and the home's death",
        Bounds {
            restarts: 1,
            commands: &[2],
            ..QUIET
        },
    ),
    (
        "the home's death with its disk behind, and a command",
        Bounds {
            restarts: 1,
            commands: &[0],
            lazy_disk: true,
            ..QUIET
        },
    ),
];

/// Larger cells, for a patient machine: minutes and gigabytes.
pub const DEEP: [(&str, Bounds); 4] = [
    (
        "loss, repetition and a death",
        Bounds {
            losses: 1,
            repeats: 1,
            crashes: 1,
            ..QUIET
        },
    ),
    (
        "a death and the home's death, and a command",
        Bounds {
            crashes: 1,
            restarts: 1,
            commands: &[0],
            cycles: 1,
            ..QUIET
        },
    ),
    (
        "a swap, loss, and the home's death with its disk behind",
        Bounds {
            losses: 1,
            restarts: 1,
            commands: &[2],
            lazy_disk: true,
            cycles: 1,
            ..QUIET
        },
    ),
    (
        "three hosts",
        Bounds {
            hosts: 3,
            crashes: 1,
            cycles: 1,
            ..QUIET
        },
    ),
];

/// A rule that is taken away.
#[derive(Debug, Clone, Copy)]
pub struct Removal {
    /// What is left, in words.
    pub what: &'static str,
    /// The cell in which it shows.
    pub bounds: Bounds,
    /// The rule.
    pub broken: Broken,
    /// What then does not hold.
    pub shows: &'static str,
}

/// Each rule that can be taken away.
pub const REMOVALS: [Removal; 7] = [
    Removal {
        what: "without terms",
        bounds: Bounds {
            cycles: 3,
            losses: 1,
            ..QUIET
        },
        broken: Broken::NoTerms,
        shows: RULES[0],
    },
    Removal {
        what: "from any record",
        bounds: Bounds {
            cycles: 3,
            losses: 1,
            crashes: 1,
            ..QUIET
        },
        broken: Broken::AnyBase,
        shows: RULES[2],
    },
    Removal {
        what: "output and state apart",
        bounds: QUIET,
        broken: Broken::OutputsApart,
        shows: RULES[2],
    },
    Removal {
        what: "terms that begin anew",
        bounds: Bounds { restarts: 1, ..QUIET },
        broken: Broken::TermsAgain,
        shows: RULES[1],
    },
    Removal {
        what: "acknowledged while only the home has it",
        bounds: Bounds {
            restarts: 1,
            commands: &[0],
            lazy_disk: true,
            ..QUIET
        },
        broken: Broken::ToldTooSoon,
        shows: RULES[3],
    },
    Removal {
        what: "the last record is given to nobody",
        bounds: Bounds {
            losses: 1,
            crashes: 1,
            cycles: 1,
            ..QUIET
        },
        broken: Broken::NoResume,
        shows: RULES[4],
    },
    Removal {
        what: "a home that comes back with the first revision",
        bounds: Bounds {
            restarts: 1,
            commands: &[2],
            ..QUIET
        },
        broken: Broken::RevisionForgotten,
        shows: RULES[5],
    },
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_rule_has_a_removal_that_shows_it() {
        for rule in RULES {
            assert!(REMOVALS.iter().any(|removal| removal.shows == rule), "{rule}");
        }
    }
}
