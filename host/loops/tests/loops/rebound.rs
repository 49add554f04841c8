//! A port that is connected to another point while the loop runs: what the old actuator held says nothing about the new one.

use bumpless_core::{CommandBody, Event, LoopSpec, Mode, Outcome, PointId, Record};

use crate::bench::Bench;

/// The output at the second process's actuator, which nobody has moved from 0.
fn elsewhere(mut spec: LoopSpec) -> LoopSpec {
    let out = PointId::new("plant.1.out").unwrap();
    spec.ports.insert("out".to_owned(), out);
    spec.policy.bump_limit_percent = 0.1;
    spec
}

fn pid(bench: &Bench, revision: u64) -> LoopSpec {
    bench.spec("pid", revision, &[("k", 2.0), ("ti", 0.5)])
}

fn bump(record: &Record) -> f64 {
    let mut bumps = record.events.iter().filter_map(|event| match event {
        Event::Revised { bump_percent, .. } => Some(*bump_percent),
        _ => None,
    });
    bumps.next().unwrap()
}

#[test]
fn in_automatic_the_bump_is_told_against_what_the_new_actuator_holds() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    assert!(
        bench.next().outputs[0] > 30.0,
        "the old actuator is far from the new one's 0"
    );
    let (outcome, record) = bench.revise(&elsewhere(pid(&bench, 2)));
    assert_eq!(outcome, Outcome::Done);
    assert!(bump(&record) < 0.1 && record.outputs[0].abs() < 0.1, "{record:?}");
    // And a component that would throw the new actuator is refused, however near it is to what the old one holds.
    let mut throw = bench.spec("guests/jumps", 3, &[("by", 40.0)]);
    throw.policy.bump_limit_percent = 2.0;
    let before = bench.next().outputs[0];
    match bench.revise(&elsewhere(throw)).0 {
        Outcome::Refused(reason) => assert!(reason.contains("policy.bump_limit_percent"), "{reason}"),
        Outcome::Done => panic!("a throw of 40 % came through at {before}"),
    }
}

#[test]
fn in_manual_an_operators_value_stays_with_its_actuator() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    assert_eq!(bench.command(CommandBody::Mode(Mode::Manual)).0, Outcome::Done);
    assert_eq!(bench.command(CommandBody::Output(vec![35.0])).0, Outcome::Done);
    bench.until("the operator's value", |r| r.outputs == [35.0]);

    let (outcome, record) = bench.revise(&elsewhere(pid(&bench, 2)));
    assert_eq!(outcome, Outcome::Done);
    assert_eq!((record.outputs[0], record.manual[0], bump(&record)), (0.0, 0.0, 0.0));
    assert_eq!(bench.command(CommandBody::Output(vec![5.0])).0, Outcome::Done);

    // Back to the first actuator: it still holds what it held.
    let (outcome, record) = bench.revise(&pid(&bench, 3));
    assert_eq!(outcome, Outcome::Done);
    assert_eq!((record.outputs[0], record.manual[0], bump(&record)), (35.0, 35.0, 0.0));
}

#[test]
fn a_rollback_takes_no_operators_value_along_to_the_old_actuator() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    assert_eq!(bench.command(CommandBody::Mode(Mode::Manual)).0, Outcome::Done);
    assert_eq!(bench.command(CommandBody::Output(vec![35.0])).0, Outcome::Done);
    bench.until("the operator's value", |r| r.outputs == [35.0]);
    let traps = bench.spec("guests/traps", 2, &[("after", 20.0)]);
    assert_eq!(bench.revise(&elsewhere(traps)).0, Outcome::Done);
    assert_eq!(bench.command(CommandBody::Output(vec![5.0])).0, Outcome::Done);
    let back = bench.until("a way back", |r| r.revision == 1);
    assert_eq!((back.outputs[0], back.manual[0]), (35.0, 35.0), "{back:?}");
    assert_eq!(bench.next().outputs, [35.0]);
}
