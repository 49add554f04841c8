//! Loops of several hosts in one process, joined by a switchboard instead of a network: owners and replicas that die or
//! fall silent, commands, swaps and rollbacks. Everything is checked on the records that the arbiter took.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod acknowledged;
mod bench;
mod degraded;
mod patience;
mod probation;
mod rebound;
mod votes;

use std::{collections::HashSet, sync::Arc};

use bench::{Bench, PATIENCE, host};
use bumpless_core::{CommandBody, Digest, Event, HostId, Mode, Outcome, Strategy};

#[test]
fn one_host_alone_controls_its_plant() {
    let mut bench = Bench::new(&["plant"], |_| {});
    bench.settled();
    let record = bench.next();
    assert_eq!((record.owner.as_str(), record.stepped_by.as_str()), ("plant", "plant"));
}

#[test]
fn replicas_take_turns_and_a_silent_one_costs_no_cycle() {
    let mut bench = Bench::new(&["a", "b", "c"], |_| {});
    bench.settled();
    let by: HashSet<HostId> = (0..6).map(|_| bench.next().stepped_by.clone()).collect();
    assert_eq!(by.len(), 3, "round-robin");
    let owner = bench.next().owner.clone();
    let silent = bench.holders.iter().find(|h| **h != owner).unwrap().clone();
    bench.board.cut.lock().unwrap().insert(silent.clone());
    let hedged = bench.until("a silent replica is passed over", |r| {
        r.events.contains(&Event::Hedged {
            replica: silent.clone(),
        })
    });
    assert_ne!(hedged.stepped_by, silent);
    for _ in 0..20 {
        assert_ne!(bench.next().stepped_by, silent);
    }
    bench.board.cut.lock().unwrap().clear();
    bench.until("it comes back by probes", |r| r.stepped_by == silent);
}

#[test]
fn a_silent_owner_is_replaced_and_fenced_and_a_dead_one_too() {
    let mut bench = Bench::new(&["a", "b", "c"], |_| {});
    bench.settled();
    let first = bench.next();
    // Silent: alive for all that is known, but nothing comes from it.
    bench.board.cut.lock().unwrap().insert(first.owner.clone());
    let second = bench.until("a takeover", |r| r.owner != first.owner);
    assert!(second.term > first.term);
    assert!(second.events.contains(&Event::TookOver {
        from: Some(first.owner.clone())
    }));
    // It comes back; nothing that it sends counts, and it learns of its successor.
    bench.board.cut.lock().unwrap().clear();
    for _ in 0..20 {
        assert_ne!(bench.next().owner, first.owner);
    }
    // Dead: the bus says so.
    let owner = bench.next().owner.clone();
    bench.board.cut.lock().unwrap().insert(owner.clone());
    for name in bench.holders.iter().chain([&bench.home]).filter(|h| **h != owner) {
        bench.at(name).host_gone(&owner);
    }
    let third = bench.until("another takeover", |r| r.owner != owner);
    assert!(third.term > second.term);
    let settled = bench.seen.iter().rev().take(20).map(|r| r.outputs[0]);
    let (low, high) = settled.fold((f64::MAX, f64::MIN), |(l, h), o| (l.min(o), h.max(o)));
    assert!(high - low < 5.0, "the output does not feel it: {low} to {high}");
}

#[test]
fn commands_take_effect_with_a_record() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let (outcome, record) = bench.command(CommandBody::Setpoint(55.0));
    assert_eq!((outcome, record.setpoint), (Outcome::Done, 55.0));
    let (outcome, _) = bench.command(CommandBody::Setpoint(500.0));
    assert!(matches!(outcome, Outcome::Refused(why) if why.contains("0 to 100")));
    let (_, record) = bench.command(CommandBody::Mode(Mode::Manual));
    assert_eq!(record.mode, Mode::Manual);
    let (outcome, record) = bench.command(CommandBody::Output(vec![33.0]));
    assert_eq!((outcome, &record.outputs), (Outcome::Done, &vec![33.0]));
    let held = bench.until("the actuator holds it", |r| {
        r.outputs[0] == 33.0 && (r.readings[4].value_or_last() - 33.0).abs() < 0.01
    });
    let (_, record) = bench.command(CommandBody::Mode(Mode::Automatic));
    assert!(
        (record.outputs[0] - held.outputs[0]).abs() < 0.01,
        "back to automatic without a bump: {}",
        record.outputs[0]
    );
}

#[test]
fn a_swap_goes_without_a_bump_and_the_takeover_after_it_knows() {
    let mut bench = Bench::new(&["a", "b", "c"], |_| {});
    bench.settled();
    let tuning = [("k", 2.0), ("ti", 0.5)];
    let (outcome, record) = bench.revise(&bench.spec("pidplus", 2, &tuning));
    assert_eq!((outcome, record.revision), (Outcome::Done, 2));
    let Some(Event::Revised { bump_percent, .. }) = record.events.iter().find(|e| matches!(e, Event::Revised { .. }))
    else {
        panic!("{:?}", record.events)
    };
    assert!(*bump_percent < 0.1, "{bump_percent}");
    assert_eq!(record.probation, Some((1, 30)));
    bench.board.cut.lock().unwrap().insert(record.owner.clone());
    // By term, for records from before the swap are still to be read.
    let after = bench.until("a takeover", |r| r.term > record.term);
    assert_ne!(after.owner, record.owner);
    assert_eq!((after.revision, after.digest), (2, bench.digest("pidplus")));
    bench.until("the probation ends", |r| r.probation.is_none());
}

#[test]
fn a_swap_that_bumps_or_fails_at_once_is_refused() {
    let mut bench = Bench::new(&["a", "b"], |spec| spec.policy.bump_limit_percent = 2.0);
    bench.settled();
    for (component, parameters, part) in [
        ("guests/traps", vec![], "first step failed"),
        ("guests/returns-nan", vec![], "first step failed"),
        ("guests/spins", vec![], "limit"),
        (
            "guests/jumps",
            vec![("by", 30.0)],
            "beyond what the old controller does",
        ),
    ] {
        let mut spec = bench.spec(component, 2, &parameters);
        spec.policy.bump_limit_percent = 2.0;
        let (outcome, record) = bench.revise(&spec);
        assert!(
            matches!(&outcome, Outcome::Refused(why) if why.contains(part)),
            "{component}: {outcome:?}"
        );
        assert_eq!(
            (record.revision, record.faults_in_row),
            (1, 0),
            "{component}: the old one has the cycle"
        );
    }
}

#[test]
fn a_fault_on_probation_rolls_back_in_the_same_cycle() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    for (revision, component) in [(2, "guests/traps"), (3, "guests/spins"), (4, "guests/returns-nan")] {
        let (outcome, _) = bench.revise(&bench.spec(component, revision, &[("after", 5.0)]));
        assert_eq!(outcome, Outcome::Done, "{component}");
        let back = bench.until("a rollback", |r| {
            r.events.iter().any(|e| matches!(e, Event::RolledBack { .. }))
        });
        assert_eq!(
            (back.revision, back.probation, back.faults_in_row),
            (1, None, 0),
            "{component}"
        );
        assert!(
            !back.events.contains(&Event::PolicyHeld),
            "{component}: the old one has this very cycle"
        );
        assert_eq!(bench.next().revision, 1);
    }
}

#[test]
fn calls_are_stepped_where_the_strategy_says_and_only_where_the_component_is_ready() {
    let bench = Bench::new(&["a", "b", "c"], |_| {});
    let digest = bench.digest("pid");
    let prepared = bench.engine.prepared(&digest).unwrap();
    let defaults: Vec<f64> = prepared.descriptor().parameters.iter().map(|p| p.default).collect();
    let state: Arc<[u8]> = prepared
        .instantiate()
        .unwrap()
        .start(&defaults, &[20.0], 10_000_000)
        .unwrap()
        .into();
    let ports = prepared.descriptor().ports.len();
    let call = |digest, seq| {
        let readings = (0..ports).map(|_| bumpless_core::Reading::good(20.0, 1)).collect();
        let cycle = bumpless_core::Cycle {
            seq,
            at_ns: 2,
            dt_ns: 100_000_000,
            mode: Mode::Automatic,
            setpoint: 20.0,
        };
        let (sender, reply) = crossbeam_channel::bounded(1);
        let frame = bumpless_core::Frame {
            cycle,
            readings,
            messages: vec![],
        };
        let done = Box::new(move |reply| drop(sender.send(reply)));
        bench
            .at(&host("a"))
            .call(
                digest,
                Strategy::RoundRobin,
                frame,
                Arc::clone(&state),
                10_000_000,
                done,
            )
            .unwrap();
        reply.recv_timeout(PATIENCE).unwrap()
    };
    let by: HashSet<HostId> = (0..3).map(|seq| call(digest, seq).unwrap().answer.from).collect();
    assert_eq!(by.len(), 3);
    assert!(
        call(Digest::of(b"nothing"), 0)
            .unwrap_err()
            .to_string()
            .contains("not compiled here")
    );
}
