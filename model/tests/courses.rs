//! Every course of small cells, and the courses that broken rules lead to.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use bumpless_model::{Bounds, Broken, Cell, RULES};
use stateright::{Checker, HasDiscoveries, Model};

const QUIET: Bounds = Bounds {
    hosts: 2,
    cycles: 2,
    losses: 0,
    repeats: 0,
    crashes: 0,
    restarts: 0,
    commands: 0,
    lazy_disk: false,
};

/// Explores every course, and gives the number of states.
#[track_caller]
fn holds(what: &str, bounds: Bounds) -> usize {
    let checker = Cell::new(bounds, None).checker().threads(2).spawn_bfs().join();
    for rule in RULES {
        if let Some(path) = checker.discovery(rule) {
            panic!("{what}: {rule:?} does not hold: {:#?}", path.into_actions());
        }
    }
    assert!(checker.is_done(), "{what}: every course was taken");
    checker.unique_state_count()
}

#[test]
fn the_rules_hold_in_every_course_of_a_small_cell() {
    let table = [
        ("delays and reordering", Bounds { cycles: 3, ..QUIET }),
        (
            "loss",
            Bounds {
                losses: 1,
                commands: 1,
                ..QUIET
            },
        ),
        ("repetition", Bounds { repeats: 1, ..QUIET }),
        ("a death", Bounds { crashes: 1, ..QUIET }),
        ("the home's death", Bounds { restarts: 1, ..QUIET }),
        (
            "commands and another revision",
            Bounds {
                commands: 3,
                cycles: 1,
                ..QUIET
            },
        ),
    ];
    for (what, bounds) in table {
        let states = holds(what, bounds);
        assert!(states > 100, "{what}: only {states} states were seen");
    }
}

/// Looks for a course that breaks a rule.
#[track_caller]
fn shows(what: &str, bounds: Bounds, broken: Option<Broken>, rule: &'static str) {
    let checker = Cell::new(bounds, broken)
        .checker()
        .finish_when(HasDiscoveries::AllOf([rule].into()))
        .threads(2)
        .spawn_bfs()
        .join();
    assert!(checker.discovery(rule).is_some(), "{what}: {rule:?} holds all the same");
}

#[test]
fn each_rule_is_needed_and_its_absence_is_seen() {
    let wide = Bounds {
        cycles: 3,
        losses: 1,
        ..QUIET
    };
    shows("without terms", wide, Some(Broken::NoTerms), RULES[0]);
    shows(
        "from any record",
        Bounds { crashes: 1, ..wide },
        Some(Broken::AnyBase),
        RULES[2],
    );
    shows("output and state apart", QUIET, Some(Broken::OutputsApart), RULES[2]);
    shows(
        "terms that begin anew",
        Bounds { restarts: 1, ..QUIET },
        Some(Broken::TermsAgain),
        RULES[1],
    );
    // What the product does not promise: with the home's disk behind, and its record with nobody else, an acknowledgement is
    // lost with both.
    let lazy = Bounds {
        restarts: 1,
        commands: 1,
        lazy_disk: true,
        ..QUIET
    };
    shows("a disk that is behind", lazy, None, RULES[3]);
}
