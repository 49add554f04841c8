//! What a new component may do in its first cycles, and what sends the loop back.

use bumpless_core::{Event, OnBump, Outcome, Record};

use crate::bench::Bench;

fn reason(record: &Record) -> String {
    let reasons = record.events.iter().filter_map(|event| match event {
        Event::RolledBack { reason, .. } => Some(reason.as_str()),
        _ => None,
    });
    reasons.collect::<Vec<_>>().join("; ")
}

fn rolled_back(record: &Record) -> bool {
    record
        .events
        .iter()
        .any(|event| matches!(event, Event::RolledBack { .. }))
}

#[test]
fn a_step_far_from_what_the_component_before_would_send_goes_back_in_that_cycle() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let mut spec = bench.spec("guests/jumps", 2, &[("after", 5.0), ("by", 30.0)]);
    spec.policy.probation_deviation_percent = Some(10.0);
    assert_eq!(bench.revise(&spec).0, Outcome::Done);
    let back = bench.until("a way back", rolled_back);
    assert_eq!((back.revision, back.probation, back.faults_in_row), (1, None, 0));
    assert!(
        reason(&back).contains("% of its span away from what the component before sends"),
        "{}",
        reason(&back)
    );
    let before = bench.seen.iter().rev().nth(1).unwrap().outputs[0];
    assert!(
        (back.outputs[0] - before).abs() < 1.0,
        "the throw never reached the actuator: {before} to {}",
        back.outputs[0]
    );
}

#[test]
fn without_a_limit_a_component_may_differ() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let mut spec = bench.spec("guests/jumps", 2, &[("after", 5.0), ("by", 0.5)]);
    spec.policy.probation_cycles = 12;
    assert_eq!(bench.revise(&spec).0, Outcome::Done);
    let end = bench.until("the end of the probation", |r| r.revision == 2 && r.probation.is_none());
    assert_eq!(end.faults_in_row, 0);
    assert!(!bench.seen.iter().any(|record| rolled_back(record)));
}

#[test]
fn an_output_beyond_its_limits_goes_back_where_the_component_before_stays_within() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let spec = bench.spec("guests/jumps", 2, &[("after", 5.0), ("by", 500.0)]);
    assert_eq!(bench.revise(&spec).0, Outcome::Done);
    let back = bench.until("a way back", rolled_back);
    assert!(
        reason(&back).contains("outside its limits, 0 to 100"),
        "{}",
        reason(&back)
    );
    assert_eq!(bench.next().revision, 1);
}

#[test]
fn after_the_probation_nothing_leads_back() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let mut spec = bench.spec("guests/jumps", 2, &[("after", 20.0), ("by", 500.0)]);
    spec.policy.probation_cycles = 10;
    assert_eq!(bench.revise(&spec).0, Outcome::Done);
    let high = bench.until("the throw", |r| r.outputs[0] >= 100.0);
    assert_eq!((high.revision, high.outputs[0]), (2, 100.0), "the guard stays");
}

#[test]
fn a_bump_beyond_the_limit_may_alarm_instead() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let mut spec = bench.spec("guests/jumps", 2, &[("by", 30.0)]);
    (spec.policy.bump_limit_percent, spec.policy.on_bump) = (2.0, OnBump::Alarm);
    spec.policy.probation_cycles = 0;
    let (outcome, record) = bench.revise(&spec);
    assert_eq!((outcome, record.revision), (Outcome::Done, 2));
    let over = record.events.iter().find_map(|event| match event {
        Event::OverBump {
            bump_percent,
            limit_percent,
        } => Some((*bump_percent, *limit_percent)),
        _ => None,
    });
    assert!(
        over.is_some_and(|(bump, limit)| bump > 25.0 && limit == 2.0),
        "{:?}",
        record.events
    );
}

#[test]
fn a_step_that_spins_beyond_its_cycle_is_heard_of_in_a_later_one() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    // Allowed to take the whole period, so that no commit of such a cycle is ever in time.
    let mut spec = bench.spec("guests/spins", 2, &[("after", 5.0)]);
    spec.policy.step_limit_us = 20_000;
    assert_eq!(bench.revise(&spec).0, Outcome::Done);
    let back = bench.until("a way back", rolled_back);
    assert_eq!((back.revision, back.faults_in_row), (1, 0));
    assert!(reason(&back).contains("ran past its limit"), "{}", reason(&back));

    // Without a probation the loop's policy gets its say, and a better revision comes in.
    let mut spec = bench.spec("guests/spins", 3, &[("after", 5.0)]);
    (spec.policy.step_limit_us, spec.policy.probation_cycles) = (20_000, 0);
    assert_eq!(bench.revise(&spec).0, Outcome::Done);
    bench.until("faults are counted", |r| r.revision == 3 && r.faults_in_row == 3);
    let (outcome, record) = bench.revise(&bench.spec("pid", 4, &[("k", 2.0), ("ti", 0.5)]));
    assert_eq!((outcome, record.revision), (Outcome::Done, 4));
}
