//! Votes over several hosts, some of which err.

use bumpless_core::{Event, HostId, OnFewer, Outcome, Record, Strategy, vote::CLEAN_STEPS};

use crate::bench::{Bench, host};

fn aside(record: &Record, name: &str) -> bool {
    let vote = record.redundancy.vote.as_ref();
    vote.is_some_and(|vote| vote.aside.iter().any(|a| a.host == host(name)))
}

fn dissent(record: &Record, name: &str) -> bool {
    record.events.contains(&Event::Dissent { replica: host(name) })
}

fn no_majority(record: &Record) -> bool {
    record.events.iter().any(|e| matches!(e, Event::NoMajority { .. }))
}

#[test]
fn the_majority_is_taken_and_the_one_that_errs_loses_its_vote() {
    let mut bench = Bench::with_errors(&["a", "b", "c"], &[("b", 4)], |spec| spec.strategy = Strategy::Vote(3));
    let set_aside = bench.until("dissent", |r| dissent(r, "b"));
    assert!(aside(&set_aside, "b"));
    bench.until("it counts as lost", |r| {
        r.events.contains(&Event::RedundancyLost { have: 2, want: 3 })
    });
    bench.settled();
    for _ in 0..60 {
        let record = bench.next();
        let vote = record.redundancy.vote.clone().unwrap();
        assert!(
            aside(&record, "b"),
            "every fourth step is wrong, so it is never clean for long"
        );
        assert!(record.redundancy.have <= 2 && record.redundancy.want == 3);
        // On a crowded machine an answer may come too late for its cycle; then no step counts at all.
        assert!(record.faults_in_row > 0 || vote.agreed >= vote.needed, "{vote:?}");
    }
    let dissents = bench.next().redundancy.vote.clone().unwrap().dissents;
    assert!(dissents > 10, "they are counted: {dissents}");
    // A turned bit moves an output by a quarter at least; around its setpoint the loop moves it by far less.
    let outputs: Vec<f64> = bench.seen.iter().rev().take(60).map(|r| r.outputs[0]).collect();
    let jump = outputs
        .windows(2)
        .map(|pair| (pair[0] - pair[1]).abs())
        .fold(0.0, f64::max);
    assert!(jump < 2.0, "an output jumped by {jump}");
}

/// Judges every output in turn, from the first cycle in which a turned bit would show.
#[track_caller]
fn no_jump(bench: &Bench, name: &str) {
    let rows = || bench.seen.iter().skip(JUDGED_FROM_CYCLE);
    let greatest = rows()
        .zip(rows().skip(1))
        .map(|(before, after)| ((after.outputs[0] - before.outputs[0]) / before.outputs[0].max(10.0)).abs())
        .fold(0.0, f64::max);
    // A turned bit moves an output by a quarter at least.
    assert!(greatest < 0.2, "an output jumped by {greatest} of itself");
    let wrong = rows().filter(|r| dissent(r, name) || aside(r, name)).count();
    assert!(
        wrong > 0 && rows().all(|r| r.outputs[0] > 10.0),
        "there was something to judge"
    );
}

/// The loop's own first cycles, from nothing to its setpoint, are as steep as an error.
const JUDGED_FROM_CYCLE: usize = 60;

#[test]
fn not_even_the_first_wrong_step_reaches_the_actuator() {
    // Steps of a replica, and of the owner itself.
    for errs in ["a", "b", "c"] {
        let mut bench = Bench::with_errors(&["a", "b", "c"], &[(errs, 100)], |spec| {
            spec.strategy = Strategy::Vote(3);
        });
        let first = bench.until("its first wrong step", |r| dissent(r, errs));
        assert!(first.faults_in_row == 0 && first.seq > JUDGED_FROM_CYCLE as u64);
        for _ in 0..10 {
            bench.next();
        }
        no_jump(&bench, errs);
    }
}

#[test]
fn one_that_errs_is_never_alone_with_the_actuator() {
    // Every step of b is wrong, and one of the others is gone.
    let mut bench = Bench::with_errors(&["a", "b", "c"], &[("b", 1)], |spec| spec.strategy = Strategy::Vote(3));
    bench.until("dissent", |r| dissent(r, "b"));
    bench.settled();
    let owner = bench.next().owner.clone();
    let other = if owner == host("c") { host("a") } else { host("c") };
    bench.board.cut.lock().unwrap().insert(other);
    let held = bench.until("no majority", no_majority);
    for _ in 0..30 {
        let record = bench.next();
        assert!(no_majority(&record) && record.faults_in_row > 0, "{:?}", record.events);
        assert_eq!(record.outputs, held.outputs, "the output holds");
    }
    bench.board.cut.lock().unwrap().clear();
    bench.until("it goes on by itself", |r| r.faults_in_row == 0);
}

#[test]
fn a_change_is_voted_on_too() {
    // Every step of the owner is wrong, that of the new component as well.
    let mut bench = Bench::with_errors(&["a", "b", "c"], &[("a", 1)], |spec| spec.strategy = Strategy::Vote(3));
    bench.until("its own vote is taken from it", |r| aside(r, "a"));
    bench.settled();
    let errs = host("a");
    if bench.next().owner != errs {
        let home = bench.at(&bench.home);
        home.move_to(&crate::bench::loop_id(), errs.clone()).unwrap();
        bench.until("the one that errs owns the loop", |r| r.owner == errs);
    }
    for (revision, component) in [(2, "pid"), (3, "pidplus")] {
        let mut next = bench.spec(component, revision, &[("k", 2.1), ("ti", 0.5)]);
        next.strategy = Strategy::Vote(3);
        let (outcome, record) = bench.revise(&next);
        assert_eq!(
            (&outcome, record.revision),
            (&Outcome::Done, revision),
            "{:?}",
            record.events
        );
        let vote = record.redundancy.vote.clone().unwrap();
        assert!(vote.agreed >= 2 && vote.needed == 2, "{vote:?}");
        for _ in 0..10 {
            bench.next();
        }
    }
    no_jump(&bench, "a");
}

#[test]
fn a_change_that_replicas_cannot_repeat_is_refused_and_the_cycle_holds() {
    let mut bench = Bench::new(&["a", "b", "c"], |spec| spec.strategy = Strategy::Vote(3));
    bench.settled();
    let owner = cut_all_but_the_owner(&mut bench);
    let next = bench.spec("pid", 2, &[("k", 2.1), ("ti", 0.5)]);
    let (outcome, record) = bench.revise(&next);
    let Outcome::Refused(words) = outcome else {
        panic!("{outcome:?}")
    };
    assert!(words.contains("did not agree on its first step"), "{words}");
    assert_eq!((record.revision, &record.owner), (1, &owner));
    assert!(no_majority(&record) && record.faults_in_row > 0, "{:?}", record.events);
    bench.board.cut.lock().unwrap().clear();
    let again = bench.until("it goes on by itself", |r| r.faults_in_row == 0);
    assert_eq!(again.revision, 1, "under the old revision");
}

#[test]
fn one_that_erred_once_votes_again_after_clean_steps() {
    let every = u64::from(CLEAN_STEPS) * 3;
    let mut bench = Bench::with_errors(&["a", "b", "c"], &[("b", every)], |spec| {
        spec.strategy = Strategy::Vote(3);
    });
    let lost = bench.until("dissent", |r| dissent(r, "b"));
    let back = bench.until("it votes again", |r| {
        r.events.contains(&Event::Readmitted { replica: host("b") })
    });
    assert!(back.seq >= lost.seq + u64::from(CLEAN_STEPS));
    assert!(!aside(&back, "b"));
    bench.until("the loop is whole again", |r| r.redundancy.whole());
}

#[test]
fn an_owner_that_errs_is_outvoted_by_the_others() {
    let mut bench = Bench::with_errors(&["a", "b", "c"], &[("a", 3)], |spec| spec.strategy = Strategy::Vote(3));
    let first = bench.next();
    let errs = host("a");
    if first.owner != errs {
        bench
            .at(&bench.home)
            .move_to(&crate::bench::loop_id(), errs.clone())
            .unwrap();
    }
    bench.until("the one that errs owns the loop", |r| r.owner == errs);
    bench.until("its own vote is taken from it", |r| aside(r, "a"));
    bench.settled();
    let outputs: Vec<f64> = (0..40).map(|_| bench.next().outputs[0]).collect();
    let jump = outputs
        .windows(2)
        .map(|pair| (pair[0] - pair[1]).abs())
        .fold(0.0, f64::max);
    assert!(jump < 2.0, "an output jumped by {jump}");
}

#[test]
fn without_a_majority_the_policy_decides_and_says_so() {
    let mut bench = Bench::with_errors(&["a", "b"], &[("b", 1)], |spec| {
        (spec.strategy, spec.replicas) = (Strategy::Vote(2), 2);
    });
    let first = bench.until("no majority", no_majority);
    assert!(first.events.contains(&Event::PolicyHeld) && first.faults_in_row > 0);
    for _ in 0..10 {
        let record = bench.next();
        assert!(no_majority(&record), "{:?}", record.events);
        assert_eq!(record.outputs, first.outputs, "the output holds");
        assert!(
            record.redundancy.vote.as_ref().unwrap().aside.is_empty(),
            "nobody is to blame"
        );
    }
}

/// Cuts all but the owner off; gives the owner.
fn cut_all_but_the_owner(bench: &mut Bench) -> HostId {
    let owner = bench.next().owner.clone();
    let others = bench.holders.iter().filter(|h| **h != owner).cloned();
    bench.board.cut.lock().unwrap().extend(others);
    owner
}

#[test]
fn with_fewer_than_asked_for_a_vote_goes_on_where_the_policy_lets_it() {
    let mut bench = Bench::new(&["a", "b", "c"], |spec| {
        spec.strategy = Strategy::Vote(3);
        spec.policy.on_fewer = OnFewer::GoOn;
    });
    bench.until("all vote", |r| r.redundancy.whole());
    let owner = cut_all_but_the_owner(&mut bench);
    let alone = bench.until("it goes on alone", |r| r.redundancy.have == 1 && r.faults_in_row == 0);
    assert_eq!(alone.owner, owner);
    let lost = bench.seen.iter().any(|r| {
        let events = r.events.iter();
        events
            .clone()
            .any(|e| matches!(e, Event::RedundancyLost { want: 3, .. }))
    });
    assert!(lost, "the loss is told");
    bench.board.cut.lock().unwrap().clear();
    bench.until("all vote again", |r| {
        r.events.contains(&Event::RedundancyRestored { want: 3 })
    });
}

#[test]
fn with_fewer_than_a_majority_a_vote_stops_unless_the_policy_says_otherwise() {
    let mut bench = Bench::new(&["a", "b", "c"], |spec| spec.strategy = Strategy::Vote(3));
    bench.until("all vote", |r| r.redundancy.whole());
    cut_all_but_the_owner(&mut bench);
    let stopped = bench.until("one alone is no majority", |r| r.redundancy.have == 1 && no_majority(r));
    assert!(stopped.events.contains(&Event::PolicyHeld) && stopped.faults_in_row > 0);
    bench.board.cut.lock().unwrap().clear();
    bench.until("it goes on by itself", |r| r.faults_in_row == 0 && r.redundancy.whole());
}
