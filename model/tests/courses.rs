//! Every course of small cells, and the courses that broken rules lead to.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use bumpless_model::{Bounds, CELLS, Cell, QUIET, REMOVALS, RULES, SIGNS, signs};
use stateright::{Checker, HasDiscoveries, Model};

#[test]
fn the_rules_hold_in_every_course_of_a_small_cell() {
    for (what, bounds) in CELLS {
        let checker = Cell::new(bounds, None).checker().threads(2).spawn_bfs().join();
        for rule in RULES {
            if let Some(path) = checker.discovery(rule) {
                panic!("{what}: {rule:?} does not hold: {:#?}", path.into_actions());
            }
        }
        for sign in signs(&bounds) {
            assert!(checker.discovery(sign).is_some(), "{what}: no course shows {sign}");
        }
        assert!(checker.is_done(), "{what}: every course was taken");
        let states = checker.unique_state_count();
        assert!(states > 100, "{what}: only {states} states were seen");
    }
}

#[test]
fn each_rule_is_needed_and_its_absence_is_seen() {
    for removal in REMOVALS {
        let checker = Cell::new(removal.bounds, Some(removal.broken))
            .checker()
            .finish_when(HasDiscoveries::AllOf([removal.shows].into()))
            .threads(2)
            .spawn_bfs()
            .join();
        let shown = checker.discovery(removal.shows).is_some();
        assert!(shown, "{}: {:?} holds all the same", removal.what, removal.shows);
    }
}

#[test]
fn a_cell_without_its_cause_does_not_show_a_sign() {
    let shows = |bounds: Bounds, sign| {
        let checker = Cell::new(bounds, None).checker().threads(2).spawn_bfs().join();
        checker.discovery(sign).is_some()
    };
    let [takeover, gap, told, revision, restarted] = SIGNS;
    for sign in [gap, told, revision, restarted] {
        assert!(!shows(QUIET, sign), "{sign}");
    }
    // One host alone takes over from nobody.
    assert!(!shows(Bounds { hosts: 1, ..QUIET }, takeover));
}
