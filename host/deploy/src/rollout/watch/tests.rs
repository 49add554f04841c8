//! The watch by hand: what counts, and what it fails for.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::sync::Arc;

use bumpless_core::{AlarmChange, Digest, LoopId, Reading};

use super::*;

const PV: Option<usize> = Some(0);

fn host(name: &str) -> HostId {
    HostId::new(name).unwrap()
}

fn record(revision: u64, error: f64) -> Record {
    Record {
        loop_id: LoopId::new("l").unwrap(),
        term: 1,
        seq: 1,
        after: (0, 0),
        revision,
        digest: Digest::of(b"a"),
        home: host("plant"),
        owner: host("a"),
        stepped_by: host("a"),
        at_ns: 0,
        dt_ns: 0,
        mode: Mode::Automatic,
        setpoint: 50.0,
        manual: vec![],
        readings: vec![Reading::good(50.0 - error, 0)],
        heard: vec![],
        wanted: vec![],
        outputs: vec![],
        state: Arc::from([]),
        faults_in_row: 0,
        probation: None,
        redundancy: bumpless_core::Redundancy::default(),
        applied: vec![],
        events: vec![],
        alarms: vec![],
        messages: vec![],
        log: vec![],
        step_ns: 0,
        cycle_ns: 0,
        committed_after_ns: 0,
    }
}

fn with(revision: u64, event: Event) -> Record {
    Record {
        events: vec![event],
        ..record(revision, 0.0)
    }
}

/// An eye that saw ten cycles with an error of 1, watching revision 2 for ten, with twice the error allowed.
fn watching() -> Eye {
    let mut eye = Eye::new(10, 1);
    for _ in 0..10 {
        assert!(!eye.ready());
        eye.see(&record(1, -1.0), PV);
    }
    assert!(eye.ready());
    let before = eye.error_before();
    assert_eq!(before, Some(1.0));
    eye.changed(2, before, 2.0, 0.1, false);
    eye
}

fn fell(sight: &Sight) -> (Fall, &str) {
    match sight {
        Sight::Fell(fall, why) => (*fall, why),
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_window_holds_the_newest_cycles_and_at_most_a_part_more() {
    for wanted in [1, 5, 32, 33, 200, 10_000] {
        let mut window = Window::default();
        for _ in 0..3 * wanted {
            window.add(7.0, wanted);
        }
        for _ in 0..wanted + wanted.div_ceil(PARTS) {
            window.add(1.0, wanted);
        }
        assert!(
            (wanted..wanted + wanted.div_ceil(PARTS)).contains(&window.cycles),
            "{wanted}: {window:?}"
        );
        assert_eq!(window.mean(), Some(1.0), "{wanted}: nothing older is left");
        assert!(window.parts.len() <= PARTS as usize + 2, "{wanted}");
    }
    assert_eq!(Window::default().mean(), None);
}

#[test]
fn a_good_component_passes_after_its_cycles() {
    let mut eye = watching();
    // Still on its way from before the change.
    assert_eq!(eye.see(&record(1, 9.0), PV), Sight::GoesOn);
    for n in 1..10 {
        assert_eq!(eye.see(&record(2, 1.9), PV), Sight::GoesOn);
        assert_eq!(eye.cycles(), n);
    }
    assert_eq!(eye.see(&record(2, 1.9), PV), Sight::Passed);
    assert!((eye.error().unwrap() - 1.9).abs() < 1e-9);
}

#[test]
fn a_greater_error_fails_as_soon_as_it_is_certain() {
    let mut eye = watching();
    assert_eq!(eye.see(&record(2, 15.0), PV), Sight::GoesOn);
    let sight = eye.see(&record(2, 5.1), PV);
    let (fall, why) = fell(&sight);
    assert_eq!(fall, Fall::Runs);
    assert_eq!(
        why,
        "its mean absolute error is 10.0500 after 2 of 10 cycles; before the change it was 1.0000"
    );
    // A loop at rest had no error at all: what is below the floor is none.
    let mut quiet = Eye::new(2, 1);
    quiet.changed(2, Some(0.0), 2.0, 0.1, false);
    quiet.see(&record(2, 0.09), PV);
    assert_eq!(quiet.see(&record(2, 0.09), PV), Sight::Passed);
    let mut quiet = Eye::new(2, 1);
    quiet.changed(2, Some(0.0), 2.0, 0.1, false);
    assert_eq!(fell(&quiet.see(&record(2, 0.21), PV)).0, Fall::Runs);
}

#[test]
fn cycles_that_show_nothing_count_for_nothing() {
    let mut manual = record(1, 1.0);
    manual.mode = Mode::Manual;
    let mut blind = record(1, 1.0);
    blind.readings = vec![Reading::missing(NoData::CommsLost, 50.0, 0)];
    let mut eye = Eye::new(2, 1);
    for record in [&manual, &blind, &record(7, 1.0)] {
        eye.see(record, PV);
        assert_eq!(eye.cycles_before(), 0);
    }
    // A component that measures nothing is watched for its faults alone.
    let mut unconnected = record(1, 1.0);
    unconnected.readings = vec![Reading::unconnected()];
    for (record, measured) in [(&unconnected, PV), (&record(1, 1.0), None)] {
        let mut eye = Eye::new(2, 1);
        eye.see(record, measured);
        eye.see(record, measured);
        assert!(eye.ready());
        assert_eq!(eye.error_before(), None);
    }
    let mut eye = watching();
    manual.revision = 2;
    blind.revision = 2;
    for record in [manual, blind] {
        assert_eq!(eye.see(&record, PV), Sight::GoesOn);
        assert_eq!(eye.cycles(), 0);
    }
}

#[test]
fn what_fails_a_watched_loop() {
    let fault = |replica: &str, fault: Fault| Event::Faulted {
        replica: host(replica),
        fault: fault.to_string(),
    };
    let trap = fault("b", Fault::Trap("unreachable".into()));
    let rolled_back = |from| Event::RolledBack {
        from,
        reason: "it trapped".into(),
    };
    let table = [
        (
            with(2, trap.clone()),
            Fall::Runs,
            "in cycle 1 of its watch: the component trapped: unreachable (host b)",
        ),
        (with(1, rolled_back(2)), Fall::WentBack, "it trapped"),
        (
            record(3, 0.0),
            Fall::Others,
            "somebody changed it meanwhile: revision 3",
        ),
    ];
    for (record, fall, part) in table {
        let sight = watching().see(&record, PV);
        assert_eq!(fell(&sight).0, fall);
        assert!(fell(&sight).1.contains(part), "{}", fell(&sight).1);
    }
    // Faults before the change, of another revision, or of hosts that are only not ready.
    let not_ready = fault(
        "b",
        Fault::NotReady {
            host: "b".into(),
            reason: "the loop is not held here".into(),
        },
    );
    for record in [
        with(1, trap),
        with(2, not_ready),
        with(2, rolled_back(1)),
        with(2, Event::PolicyHeld),
    ] {
        assert_eq!(watching().see(&record, PV), Sight::GoesOn, "{:?}", record.events);
    }
    // The record of the way back was lost, but not the next one.
    let mut eye = watching();
    eye.see(&record(2, 0.0), PV);
    assert_eq!(
        fell(&eye.see(&record(1, 0.0), PV)),
        (Fall::WentBack, "it went back to revision 1 by itself")
    );
    let mut resumed = Eye::new(10, 1);
    resumed.changed(2, None, 2.0, 0.1, true);
    assert_eq!(fell(&resumed.see(&record(1, 0.0), PV)).0, Fall::WentBack);
}

#[test]
fn an_alarm_of_high_priority_fails_where_it_is_new() {
    let alarm = |name: &str, raised: Option<Priority>| AlarmChange {
        name: name.into(),
        raised: raised.map(|priority| (priority, "too high".into())),
    };
    let raise = |revision, alarm| Record {
        alarms: vec![alarm],
        ..record(revision, 0.0)
    };
    let mut eye = Eye::new(10, 1);
    eye.see(&raise(1, alarm("old", Some(Priority::High))), PV);
    eye.see(&raise(1, alarm("gone", Some(Priority::High))), PV);
    eye.see(&raise(1, alarm("gone", None)), PV);
    eye.changed(2, None, 2.0, 0.1, false);
    for (name, raised) in [
        ("old", Some(Priority::High)),
        ("new", Some(Priority::Medium)),
        ("new", None),
    ] {
        assert_eq!(eye.see(&raise(2, alarm(name, raised)), PV), Sight::GoesOn, "{name}");
    }
    let sight = eye.clone().see(&raise(2, alarm("gone", Some(Priority::High))), PV);
    assert_eq!(
        fell(&sight),
        (Fall::Runs, "it raised a new alarm of high priority: gone (too high)")
    );
    for n in 0..2 * ALARMS_MAX {
        eye.see(&raise(1, alarm(&n.to_string(), Some(Priority::High))), PV);
    }
    assert_eq!(eye.alarms.len(), ALARMS_MAX);
}
