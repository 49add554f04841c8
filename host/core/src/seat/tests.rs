//! The owner's cycle without an owner: commands, attempts, policies and records, from plain values.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;
use crate::{
    Descriptor, Digest, Direction, LoopId, NoData, OutputLimit, Policy, PortKind, PortSpec, Strategy as Choice,
    record::{Command, test_record},
};

fn host(n: usize) -> HostId {
    HostId::new(format!("h{n}")).unwrap()
}

fn port(name: &str, direction: Direction) -> PortSpec {
    PortSpec {
        name: name.into(),
        direction,
        kind: PortKind::Analog,
        unit: String::new(),
        required: true,
        text: String::new(),
    }
}

fn setup() -> (LoopSpec, Wiring) {
    let descriptor = Descriptor {
        name: "law".into(),
        version: "1.0.0".into(),
        text: String::new(),
        ports: vec![port("pv", Direction::Input), port("out", Direction::Output)],
        parameters: vec![],
        state_layout: 1,
    };
    let limit = OutputLimit {
        low: 0.0,
        high: 100.0,
        rate_per_s: None,
        safe: 10.0,
    };
    let spec = LoopSpec {
        id: LoopId::new("l").unwrap(),
        revision: 1,
        digest: Digest::of(b"a"),
        period_ns: 100_000_000,
        ports: [("pv", "p.pv"), ("out", "p.out")]
            .into_iter()
            .map(|(port, point)| (port.to_owned(), crate::PointId::new(point).unwrap()))
            .collect(),
        parameters: BTreeMap::new(),
        setpoint: 1.0,
        setpoint_range: (0.0, 10.0),
        mode: Mode::Automatic,
        strategy: Choice::Local,
        replicas: 3,
        limits: [("out".to_owned(), limit)].into(),
        listens: vec![],
        fallback: None,
        fallback_parameters: BTreeMap::new(),
        prefer: vec![],
        policy: Policy::default(),
    };
    let wiring = Wiring::new(&spec, &descriptor).unwrap();
    (spec, wiring)
}

fn sample(commands: Vec<CommandBody>) -> Sample {
    Sample {
        loop_id: LoopId::new("l").unwrap(),
        term: 3,
        seq: 12,
        owner: host(0),
        home: host(9),
        at_ns: 1_000_000_000,
        left_ns: 50_000_000,
        revision: 1,
        readings: vec![Reading::good(4.0, 999_000_000), Reading::good(42.0, 999_000_000)],
        next_readings: None,
        members: vec![host(0), host(1)],
        commands: commands
            .into_iter()
            .enumerate()
            .map(|(n, body)| Command {
                id: CommandId(n as u128 + 1),
                body,
            })
            .collect(),
        messages: vec![],
        last: (3, 11),
        resume: None,
    }
}

fn before() -> Record {
    let mut record = test_record();
    (record.term, record.seq, record.at_ns) = (3, 11, 900_000_000);
    record.owner = host(0);
    (record.outputs, record.wanted, record.manual) = (vec![42.0], vec![42.0], vec![42.0]);
    record
}

fn conclude_with(step: Result<Stepped, Fault>, standing: Standing, base: &Record, spec: &LoopSpec) -> Record {
    let (_, wiring) = setup();
    let sample = sample(vec![]);
    conclude(Conclusion {
        owner: &host(0),
        readings: sample.readings.clone(),
        sample: &sample,
        base: Some(base),
        spec,
        wiring: &wiring,
        state: Arc::from([7]),
        standing,
        events: vec![],
        probation: None,
        redundancy: Redundancy::default(),
        step,
        cycle_ns: 5,
    })
}

fn stepped(value: f64) -> Result<Stepped, Fault> {
    Ok(Stepped {
        effects: Effects {
            state: vec![8],
            writes: vec![(1, value)],
            ..Effects::default()
        },
        by: host(1),
        step_ns: 3,
    })
}

#[test]
fn the_base_is_the_record_that_the_arbiter_names() {
    let (mut s, held) = (sample(vec![]), Arc::new(before()));
    assert_eq!(base(&s, [&held]), Base::On(Arc::clone(&held)));
    s.last = (3, 10);
    assert_eq!(base(&s, [&held]), Base::Unknown);
    s.last = (0, 0);
    assert_eq!(base(&s, [&held]), Base::First);
    (s.last, s.resume) = ((3, 11), Some(Arc::clone(&held)));
    assert_eq!(base(&s, []), Base::On(held));
}

#[test]
fn commands_take_effect_in_order_or_say_why_not() {
    let (spec, _) = setup();
    let s = sample(vec![
        CommandBody::Output(vec![1.0]),
        CommandBody::Setpoint(5.0),
        CommandBody::Setpoint(50.0),
        CommandBody::Mode(Mode::Manual),
        CommandBody::Output(vec![33.0]),
        CommandBody::Output(vec![33.0, 1.0]),
        CommandBody::Output(vec![f64::NAN]),
        CommandBody::Setpoint(f64::NAN),
        CommandBody::Revise(2),
        CommandBody::Revise(3),
    ]);
    let standing = settle(Some(&before()), &spec, &s, &[42.0]);
    assert_eq!(
        (standing.mode, standing.setpoint, &standing.manual),
        (Mode::Manual, 5.0, &vec![33.0])
    );
    let refused: Vec<(u128, &str)> = standing
        .applied
        .iter()
        .filter_map(|a| match &a.outcome {
            Outcome::Refused(why) => Some((a.id.0, why.as_str())),
            Outcome::Done => None,
        })
        .collect();
    let wanted = [
        (1, "put it in manual"),
        (3, "0 to 10"),
        (6, "2 output values"),
        (7, "not a finite"),
        (8, "0 to 10"),
    ];
    assert_eq!(refused.len(), wanted.len());
    for ((id, why), (wanted_id, part)) in refused.iter().zip(wanted) {
        assert!(*id == wanted_id && why.contains(part), "{id}: {why}");
    }
    assert_eq!(
        standing.revise,
        Some((CommandId(9), 2)),
        "one change of revision at a time"
    );
    assert!(!standing.applied.iter().any(|a| a.id.0 >= 9), "their outcome is open");
}

#[test]
fn manual_begins_with_what_the_actuator_holds() {
    let (spec, _) = setup();
    let standing = settle(
        Some(&before()),
        &spec,
        &sample(vec![CommandBody::Mode(Mode::Manual)]),
        &[42.0],
    );
    assert_eq!(standing.manual, vec![42.0]);
    let record = conclude_with(stepped(90.0), standing, &before(), &spec);
    assert_eq!(
        (record.outputs, record.wanted, record.mode),
        (vec![42.0], vec![90.0], Mode::Manual)
    );
}

#[test]
fn a_good_step_is_guarded_and_recorded() {
    let (spec, _) = setup();
    let standing = settle(Some(&before()), &spec, &sample(vec![]), &[42.0]);
    let record = conclude_with(stepped(140.0), standing, &before(), &spec);
    assert_eq!(
        (record.outputs.clone(), record.wanted.clone()),
        (vec![100.0], vec![140.0])
    );
    assert_eq!(record.events, vec![Event::Limited(1)]);
    assert_eq!(
        (record.position(), record.after, record.dt_ns),
        ((3, 12), (3, 11), 100_000_000)
    );
    assert_eq!(
        (&*record.state, record.stepped_by, record.faults_in_row),
        (&[8][..], host(1), 0)
    );
}

#[test]
fn faults_hold_then_the_policy_acts() {
    let (mut spec, _) = setup();
    spec.policy.faults_tolerated = 1;
    for (on_fault, outputs, mode) in [
        (OnFault::Hold, 42.0, Mode::Automatic),
        (OnFault::SafeValue, 10.0, Mode::Automatic),
        (OnFault::Manual, 42.0, Mode::Manual),
    ] {
        spec.policy.on_fault = on_fault;
        let fault = || Err(Fault::Overrun { limit_us: 5 });
        let standing = || settle(Some(&before()), &spec, &sample(vec![]), &[42.0]);
        let first = conclude_with(fault(), standing(), &before(), &spec);
        assert_eq!(
            (first.outputs.clone(), first.faults_in_row),
            (vec![42.0], 1),
            "the first one only holds"
        );
        assert_eq!(&*first.state, &[7], "the state stays");
        let mut base = before();
        base.faults_in_row = 1;
        let second = conclude_with(fault(), standing(), &base, &spec);
        assert_eq!(
            (second.outputs, second.mode, second.faults_in_row),
            (vec![outputs], mode, 2),
            "{on_fault:?}"
        );
    }
}

#[test]
fn a_bad_input_follows_its_own_policy_and_is_no_fault_of_the_component() {
    let (mut spec, wiring) = setup();
    spec.policy.on_bad_input = OnFault::SafeValue;
    let standing = settle(Some(&before()), &spec, &sample(vec![]), &[42.0]);
    let record = conclude_with(Err(Fault::BadInput("pv".into())), standing, &before(), &spec);
    assert_eq!((record.outputs, record.faults_in_row), (vec![10.0], 0));
    let readings = [Reading::missing(NoData::CommsLost, 4.0, 5), Reading::good(42.0, 5)];
    assert_eq!(wiring.bad_input(&readings), Some(0));
}

#[test]
fn a_bad_input_may_shed_the_target_to_manual() {
    let (mut spec, _) = setup();
    spec.policy.on_bad_input = OnFault::Manual;
    let standing = settle(Some(&before()), &spec, &sample(vec![]), &[42.0]);
    let record = conclude_with(Err(Fault::BadInput("pv".into())), standing, &before(), &spec);
    assert_eq!(
        (record.mode, record.outputs, record.manual),
        (Mode::Manual, vec![42.0], vec![42.0])
    );
    // It stays there when the input is good again: a person puts it back.
    let standing = settle(Some(&before()), &spec, &sample(vec![]), &[42.0]);
    assert_eq!(standing.mode, Mode::Automatic, "without the fault");
    let mut shed = before();
    (shed.mode, shed.manual) = (Mode::Manual, vec![42.0]);
    assert_eq!(settle(Some(&shed), &spec, &sample(vec![]), &[42.0]).mode, Mode::Manual);
}

#[test]
fn the_way_back_from_a_bad_input_begins_at_the_actuator() {
    for (policy, outputs, keeps) in [
        (OnFault::Hold, 42.0, true),
        (OnFault::SafeValue, 10.0, false),
        (OnFault::Manual, 42.0, true),
    ] {
        let (mut spec, _) = setup();
        spec.policy.on_bad_input = policy;
        let standing = settle(Some(&before()), &spec, &sample(vec![]), &[42.0]);
        let record = conclude_with(Err(Fault::BadInput("pv".into())), standing, &before(), &spec);
        assert_eq!(
            (record.outputs[0], !record.state.is_empty()),
            (outputs, keeps),
            "{policy:?}"
        );
        // A cycle without sight is bridged; after more the process is elsewhere.
        let mut blind = before();
        blind.events = vec![Event::PolicyHeld];
        let standing = settle(Some(&blind), &spec, &sample(vec![]), &[42.0]);
        let record = conclude_with(Err(Fault::BadInput("pv".into())), standing, &blind, &spec);
        assert!(record.state.is_empty(), "{policy:?}");
    }
}

#[test]
fn forces_are_told_when_they_begin_and_end_and_an_unknown_actuator_holds_what_was_committed() {
    let (spec, wiring) = setup();
    let mut base = before();
    base.revision = spec.revision;
    let forced = |value| Reading {
        quality: Quality::Forced,
        ..Reading::good(value, 5)
    };
    let mut events = vec![];
    tell_forces(&[forced(4.0), Reading::good(42.0, 5)], Some(&base), &spec, &mut events);
    assert_eq!(events, [Event::Forced(0)]);
    base.readings = vec![forced(4.0), forced(42.0)];
    events.clear();
    tell_forces(&[forced(4.0), Reading::good(42.0, 5)], Some(&base), &spec, &mut events);
    assert_eq!(events, [Event::Unforced(1)]);
    let unread = [Reading::good(4.0, 5), Reading::missing(NoData::NeverRead, 0.0, 0)];
    assert!(wiring.held(&unread)[0].is_nan());
    base.outputs = vec![33.0];
    assert_eq!(wiring.held_since(&unread, Some(&base), spec.revision), [33.0]);
    assert!(
        wiring.held_since(&unread, Some(&base), spec.revision + 1)[0].is_nan(),
        "another revision, perhaps another point"
    );
}

#[test]
fn remembered_outcomes_are_bounded() {
    let (spec, _) = setup();
    let mut standing = settle(Some(&before()), &spec, &sample(vec![]), &[42.0]);
    for n in 0..100 {
        standing.remember(CommandId(n), Outcome::Done);
    }
    assert_eq!(standing.applied.len(), OUTCOMES_REMEMBERED_MAX);
    assert_eq!(standing.applied.last().unwrap().id, CommandId(99));
}

proptest! {
    #[test]
    fn everyone_is_asked_once_and_this_host_in_time(
        order in prop::collection::vec(0usize..5, 0..6),
        hedge in 1u64..100,
        here_at in 0u64..300,
        waits in prop::collection::vec(0u64..120, 20),
    ) {
        let mut unique = order.clone();
        unique.sort_unstable();
        unique.dedup();
        let order: Vec<HostId> = unique.into_iter().map(host).collect();
        let mut attempts = Attempts::new(order.clone(), host(0), hedge, here_at);
        let (mut now, mut asked, mut here_at_last) = (0, vec![], None);
        for wait in waits {
            match attempts.next(now) {
                Ask::Remote(h, until) => {
                    prop_assert!(h != host(0) && !asked.contains(&h));
                    prop_assert!(now < here_at || here_at_last.is_some(), "time is up: this host is next");
                    prop_assert!(until >= now && until <= now + hedge);
                    asked.push(h);
                    now = until.max(now) + wait;
                }
                Ask::Here => { prop_assert!(here_at_last.is_none()); here_at_last = Some(now); }
                Ask::Nobody => break,
            }
        }
        prop_assert!(here_at_last.is_some(), "this host always steps in the end");
    }

    #[test]
    fn no_step_makes_an_output_leave_its_limits(value in prop::num::f64::ANY, manual in prop::num::f64::ANY, auto: bool) {
        let (spec, _) = setup();
        let standing = Standing {
            mode: if auto { Mode::Automatic } else { Mode::Manual },
            setpoint: 1.0,
            manual: vec![manual],
            applied: vec![],
            revise: None,
        };
        let record = conclude_with(stepped(value), standing, &before(), &spec);
        prop_assert!((0.0..=100.0).contains(&record.outputs[0]));
        prop_assert!(record.wanted[0].is_finite() && record.manual[0].is_finite());
    }
}

#[test]
fn an_outage_or_a_date_that_was_set_is_no_time_to_control() {
    let (spec, _) = setup();
    let base = before();
    let mut sample = sample(vec![]);
    let day_ns = 86_400_000_000_000;
    for (at_ns, dt) in [
        (base.at_ns + spec.period_ns, spec.period_ns),
        (base.at_ns + 5 * spec.period_ns, 5 * spec.period_ns),
        (base.at_ns + 300 * day_ns, DT_PERIODS_MAX * spec.period_ns),
        (5, 1),
    ] {
        sample.at_ns = at_ns;
        assert_eq!(dt_ns(Some(&base), &spec, &sample), dt, "at {at_ns}");
    }
    // A period that was just made shorter: the last one was longer, and did last.
    let mut faster = spec.clone();
    faster.period_ns = spec.period_ns / 100;
    sample.at_ns = base.at_ns + spec.period_ns;
    let slow = Record {
        dt_ns: spec.period_ns,
        ..base
    };
    assert_eq!(dt_ns(Some(&slow), &faster, &sample), spec.period_ns);
}

#[test]
fn an_output_that_a_person_let_go_of_starts_the_law_from_the_actuator() {
    let (spec, wiring) = setup();
    let as_read = |pv: Quality, out: Quality| -> Vec<Reading> {
        let read = |value: f64, quality| Reading {
            quality,
            ..Reading::good(value, 5)
        };
        vec![read(4.0, pv), read(42.0, out)]
    };
    let (good, forced) = (Quality::Good, Quality::Forced);
    let record = |readings: Vec<Reading>| Record {
        state: Arc::from([7]),
        readings,
        ..before()
    };
    let carries = |base: &Record, now: &[Reading]| carried(Some(base), &spec, &wiring, now).is_some();
    let free = as_read(good, good);
    for (before, now, goes_on) in [
        (free.clone(), free.clone(), true),
        (free.clone(), as_read(good, forced), true),
        (as_read(good, forced), as_read(good, forced), true),
        (as_read(good, forced), free.clone(), false),
        (as_read(good, forced), as_read(good, Quality::Bad), false),
        // An input that is let go of is a measurement that changed.
        (as_read(forced, good), free.clone(), true),
    ] {
        assert_eq!(
            carries(&record(before.clone()), &now),
            goes_on,
            "{before:?} then {now:?}"
        );
    }
    // The first record after it is free again, and its state is the one that started there.
    let next = record(free.clone());
    assert!(carries(&next, &free));
    let strange = Record {
        digest: Digest::of(b"other"),
        ..next.clone()
    };
    let empty = Record {
        state: Arc::from([]),
        ..next
    };
    assert!(!carries(&strange, &free) && !carries(&empty, &free));
    assert!(carried(None, &spec, &wiring, &free).is_none());
}

#[test]
fn what_another_revision_wanted_says_nothing_about_an_output_that_is_not_written() {
    let (mut spec, _) = setup();
    let base = Record {
        wanted: vec![77.0],
        ..before()
    };
    let silent = || {
        Ok(Stepped {
            effects: Effects::default(),
            by: host(1),
            step_ns: 3,
        })
    };
    let standing = || settle(Some(&base), &setup().0, &sample(vec![]), &[42.0]);
    assert_eq!(conclude_with(silent(), standing(), &base, &spec).wanted, [77.0]);
    spec.revision = 2;
    assert_eq!(
        conclude_with(silent(), standing(), &base, &spec).wanted,
        [42.0],
        "what is held"
    );
}
