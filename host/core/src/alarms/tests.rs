//! The life of an alarm, as a table of what happens and what follows.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;
use crate::frame::{AlarmChange, Priority};

const S: u64 = 1_000_000_000;

fn level(name: &str, kind: Kind, limit: f64) -> Definition {
    Definition {
        limit: Some(limit),
        ..Definition::new(name, kind, Priority::High)
    }
}

/// One record, at `at_s`, with this measurement.
fn see(board: &mut Board, at_s: u64, value: f64) -> Vec<(String, What)> {
    see_so(board, at_s, Some(value), &[], &[])
}

fn see_so(
    board: &mut Board,
    at_s: u64,
    value: Option<f64>,
    so: &[Kind],
    raised: &[AlarmChange],
) -> Vec<(String, What)> {
    let ports = BTreeMap::from([(String::new(), (value, value.is_some()))]);
    board
        .see(Sight {
            at_ns: at_s * S,
            setpoint: 50.0,
            ports: &ports,
            so,
            raised,
        })
        .into_iter()
        .map(|change| (change.alarm, change.what))
        .collect()
}

fn board(definitions: Vec<Definition>) -> Board {
    let mut board = Board::new();
    for definition in definitions {
        board.define(definition, "eve", 0).unwrap();
    }
    board
}

fn came(name: &str) -> Vec<(String, What)> {
    vec![(name.to_owned(), What::Came)]
}

fn went(name: &str) -> Vec<(String, What)> {
    vec![(name.to_owned(), What::Went)]
}

#[test]
fn an_alarm_comes_is_seen_goes_and_is_normal_again() {
    let mut board = board(vec![level("high", Kind::Hi, 80.0)]);
    assert_eq!(see(&mut board, 1, 79.0), []);
    assert_eq!(see(&mut board, 2, 81.0), came("high"));
    assert_eq!(see(&mut board, 3, 82.0), [], "once is enough");
    let seen = board.acknowledge("high", "ann", "valve opened", 4 * S).unwrap();
    assert_eq!(
        (seen.state, seen.by.as_deref(), seen.note.as_str()),
        (State::Acknowledged, Some("ann"), "valve opened")
    );
    assert_eq!(see(&mut board, 5, 70.0), went("high"));
    let alarm = board.get("high").unwrap();
    assert_eq!(
        (alarm.state, alarm.comings, alarm.value),
        (State::Normal, 1, Some(81.0))
    );
    assert!(board.acknowledge("high", "ann", "", 6 * S).is_err(), "nothing waits");
}

#[test]
fn one_that_went_unseen_waits_and_may_come_again() {
    let mut board = board(vec![level("low", Kind::Lo, 10.0)]);
    assert_eq!(see(&mut board, 1, 9.0), came("low"));
    assert_eq!(see(&mut board, 2, 11.0), went("low"));
    assert_eq!(board.get("low").unwrap().state, State::Returned);
    assert_eq!(see(&mut board, 3, 9.0), came("low"));
    assert_eq!(see(&mut board, 4, 11.0), went("low"));
    board.acknowledge("low", "ann", "", 5 * S).unwrap();
    assert_eq!(board.get("low").unwrap().state, State::Normal);
}

#[test]
fn a_latching_one_waits_for_its_reset() {
    let latching = Definition {
        latching: true,
        ..level("trip", Kind::HiHi, 95.0)
    };
    let mut board = board(vec![latching]);
    see(&mut board, 1, 96.0);
    assert!(board.reset("trip", "ann", 2 * S).is_err(), "it stands");
    see(&mut board, 3, 50.0);
    assert_eq!(
        board.acknowledge("trip", "ann", "", 4 * S).unwrap().state,
        State::Latched
    );
    assert_eq!(board.reset("trip", "ann", 5 * S).unwrap().state, State::Normal);
}

#[test]
fn dead_band_and_delays_keep_it_from_chattering() {
    let definition = Definition {
        dead_band: 2.0,
        on_delay_s: 3.0,
        off_delay_s: 2.0,
        ..level("high", Kind::Hi, 80.0)
    };
    let mut board = board(vec![definition]);
    // (time, value, what changes)
    for (at_s, value, what) in [
        (1, 81.0, None),
        (3, 81.0, None),
        (3, 79.0, None), // too short
        (5, 81.0, None),
        (8, 81.0, Some(What::Came)),
        (9, 79.0, None), // within the dead band
        (12, 77.9, None),
        (13, 78.5, None), // back in the band: the delay starts anew
        (14, 77.0, None),
        (16, 77.0, Some(What::Went)),
    ] {
        let changes: Vec<What> = see(&mut board, at_s, value).into_iter().map(|(_, what)| what).collect();
        assert_eq!(changes, Vec::from_iter(what), "at {at_s} s");
    }
}

#[test]
fn deviation_rate_and_quality_are_watched() {
    let mut board = board(vec![
        level("far", Kind::Deviation, 20.0),
        level("fast", Kind::Rate, 5.0),
    ]);
    assert_eq!(see(&mut board, 1, 55.0), []);
    assert_eq!(see(&mut board, 2, 45.0), came("fast"), "10 a second");
    assert_eq!(see(&mut board, 4, 40.0), went("fast"), "2.5 a second");
    assert_eq!(see(&mut board, 5, 29.0), [came("far"), came("fast")].concat());
    assert_eq!(
        see_so(&mut board, 6, None, &[], &[]),
        came("bad-measurement"),
        "the others wait for a value"
    );
    assert!(board.get("far").unwrap().state.stands());
}

#[test]
fn what_belongs_to_the_loop_settles_before_it_goes() {
    let mut board = Board::new();
    assert_eq!(see_so(&mut board, 1, Some(50.0), &[Kind::Fault], &[]), came("fault"));
    assert_eq!(see(&mut board, 2, 50.0), []);
    assert_eq!(see_so(&mut board, 4, Some(50.0), &[Kind::Fault], &[]), []);
    assert_eq!(see(&mut board, 5, 50.0), []);
    assert_eq!(see(&mut board, 10, 50.0), went("fault"));
}

#[test]
fn a_controllers_own_alarms_have_a_place() {
    let raise = |name: &str, text: Option<&str>| AlarmChange {
        name: name.to_owned(),
        raised: text.map(|text| (Priority::Low, text.to_owned())),
    };
    let mut board = board(vec![level("high", Kind::Hi, 80.0)]);
    let first = see_so(
        &mut board,
        1,
        Some(50.0),
        &[],
        &[raise("saturated", Some("output at 100 %"))],
    );
    assert_eq!(first, came("saturated"));
    assert_eq!(see(&mut board, 2, 50.0), [], "it stands until it is cleared");
    assert_eq!(board.get("saturated").unwrap().text, "output at 100 %");
    assert_eq!(
        see_so(&mut board, 3, Some(50.0), &[], &[raise("saturated", None)]),
        went("saturated")
    );
    let taken = see_so(&mut board, 4, Some(50.0), &[], &[raise("high", Some("mine"))]);
    assert_eq!(taken, [], "a name that somebody defined is not the controller's");
    for n in 0..2 * ALARMS_PER_LOOP_MAX {
        see_so(&mut board, 5, Some(50.0), &[], &[raise(&n.to_string(), Some("x"))]);
    }
    assert_eq!(board.all().count(), ALARMS_PER_LOOP_MAX);
}

#[test]
fn shelved_suppressed_and_out_of_service_are_quiet_and_go_on_living() {
    let quiet = Definition {
        suppressed_by: Some("trip".to_owned()),
        ..level("high", Kind::Hi, 80.0)
    };
    let mut board = board(vec![
        quiet,
        level("trip", Kind::HiHi, 95.0),
        level("low", Kind::Lo, 10.0),
    ]);
    let shelf = |until_s: u64, reason: &str| Shelf {
        until_ns: until_s * S,
        by: "ann".to_owned(),
        reason: reason.to_owned(),
    };
    assert!(board.shelve("low", &shelf(20, " "), S).is_err(), "why?");
    assert!(board.shelve("low", &shelf(1, "x"), S).is_err(), "for how long?");
    assert!(
        board.shelve("low", &shelf(60 * 60 * 13, "x"), S).is_err(),
        "longer than a shift"
    );
    board.shelve("low", &shelf(20, "sensor is being cleaned"), S).unwrap();
    assert_eq!(see(&mut board, 2, 5.0), came("low"));
    assert!(board.get("low").unwrap().is_quiet());
    assert_eq!(board.flood(3 * S).comings, 0, "nobody was told");
    let over = see(&mut board, 20, 5.0);
    assert_eq!(over, [("low".to_owned(), What::Unshelved)]);
    assert!(!board.get("low").unwrap().is_quiet() && board.get("low").unwrap().state == State::Active);

    let both = see(&mut board, 30, 99.0);
    assert_eq!(both[0], ("high".to_owned(), What::Suppressed), "before it comes");
    assert!(board.get("high").unwrap().is_quiet() && board.get("high").unwrap().state == State::Active);
    assert!(see(&mut board, 40, 85.0).contains(&("high".to_owned(), What::Unsuppressed)));

    board.service("high", Some("being repaired"), "ann", 41 * S).unwrap();
    assert!(board.service("high", Some("again"), "ann", 42 * S).is_err());
    assert!(board.get("high").unwrap().is_quiet());
    board.service("high", None, "ann", 43 * S).unwrap();
    assert!(!board.get("high").unwrap().is_quiet());
}

#[test]
fn the_first_out_of_a_group_is_marked() {
    let of_group = |name: &str, kind, limit, priority| Definition {
        group: Some("pump".to_owned()),
        priority,
        ..level(name, kind, limit)
    };
    let mut board = board(vec![
        of_group("a-low", Kind::Lo, 10.0, Priority::Low),
        of_group("b-trip", Kind::LoLo, 5.0, Priority::High),
        of_group("c-far", Kind::Deviation, 48.0, Priority::Medium),
    ]);
    see(&mut board, 1, 8.0);
    see(&mut board, 2, 1.0);
    let first = |board: &Board, name: &str| board.get(name).unwrap().first_out;
    assert!(first(&board, "a-low") && !first(&board, "b-trip") && !first(&board, "c-far"));
    see(&mut board, 3, 50.0);
    for name in ["a-low", "b-trip", "c-far"] {
        board.acknowledge(name, "ann", "", 4 * S).unwrap();
    }
    see(&mut board, 5, 1.0);
    assert!(
        first(&board, "b-trip") && !first(&board, "a-low"),
        "all at once: the most urgent"
    );
}

#[test]
fn more_than_ten_in_ten_minutes_are_a_flood() {
    let mut board = board(vec![level("high", Kind::Hi, 80.0)]);
    for n in 0..11 {
        see(&mut board, 2 * n + 1, 81.0);
        see(&mut board, 2 * n + 2, 50.0);
    }
    assert_eq!(
        board.flood(23 * S),
        Flood {
            comings: 11,
            is_flood: true
        }
    );
    assert_eq!(board.flood(601 * S).comings, 10);
    assert!(!board.flood(1000 * S).is_flood);
}

#[test]
fn bad_definitions_are_refused_in_words() {
    type Spoil = fn(&mut Definition);
    let table: [(Spoil, &str); 9] = [
        (|d| d.name = String::new(), "1 to 64"),
        (|d| d.name = "a b".into(), "1 to 64"),
        (|d| d.limit = None, "have a limit"),
        (|d| d.limit = Some(f64::NAN), "finite"),
        (|d| d.kind = Kind::Fault, "have a limit"),
        (|d| (d.kind, d.limit) = (Kind::Rate, Some(0.0)), "greater than 0"),
        (|d| (d.kind, d.dead_band) = (Kind::Deviation, 80.0), "never go"),
        (|d| d.on_delay_s = -1.0, "0 to 3600"),
        (|d| d.suppressed_by = Some("high".into()), "itself"),
    ];
    let mut board = Board::new();
    for (spoil, words) in table {
        let mut definition = level("high", Kind::Hi, 80.0);
        spoil(&mut definition);
        let error = board.define(definition, "eve", 0).unwrap_err().to_string();
        assert!(error.contains(words), "{words}: {error}");
    }
    assert!(board.get("high").is_none(), "nothing half-defined");
    board.define(level("high", Kind::Hi, 80.0), "eve", 0).unwrap();
    board.remove("high", "eve", 1).unwrap();
    assert!(board.remove("high", "eve", 2).is_err());
}

proptest! {
    /// Whatever comes, in whatever order: a state stands exactly where its condition does, comings alternate with goings, and
    /// nothing is acknowledged that nobody saw.
    #[test]
    fn a_life_has_an_order(steps in proptest::collection::vec((0_u64..5, 0.0..100.0_f64, 0_u8..6), 1..200)) {
        let mut board = board(vec![Definition { latching: true, dead_band: 1.0, ..level("high", Kind::Hi, 80.0) }]);
        let (mut at_s, mut stands) = (0, false);
        for (passed_s, value, act) in steps {
            at_s += passed_s;
            for (name, what) in see(&mut board, at_s, value) {
                if name == "high" {
                    match what {
                        What::Came => { prop_assert!(!stands); stands = true; }
                        What::Went => { prop_assert!(stands); stands = false; }
                        _ => {}
                    }
                }
            }
            let waits = board.get("high").unwrap().state.waits_for_ack();
            if act == 0 {
                prop_assert_eq!(board.acknowledge("high", "ann", "", at_s * S).is_ok(), waits);
            }
            if act == 1 {
                let latched = board.get("high").unwrap().state == State::Latched;
                prop_assert_eq!(board.reset("high", "ann", at_s * S).is_ok(), latched);
            }
            prop_assert_eq!(board.get("high").unwrap().state.stands(), stands);
        }
    }
}
