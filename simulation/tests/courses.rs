//! Short courses of small cells: every rule holds under every kind of fault, each broken rule is noticed, and a seed gives the
//! same course again.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::collections::BTreeSet;

use bumpless_simulation::{Broken, FaultKind, Plan, RULES, World};

fn small(seed: u64) -> Plan {
    Plan {
        seed,
        hosts: 6,
        loops: 30,
        seconds: 30,
        calm_seconds: 25,
        faults_per_host_minute: 6.0,
        ..Plan::default()
    }
}

#[track_caller]
fn holds(plan: Plan) -> World {
    let mut world = World::new(plan).unwrap();
    world.run();
    if let Some(violation) = world.violation() {
        let again = Plan {
            trace: Some(violation.number),
            ..world.plan().clone()
        };
        let mut traced = World::new(again).unwrap();
        traced.run();
        let course: Vec<&str> = traced.trace().collect();
        let end = course.len().saturating_sub(40);
        panic!(
            "seed {}: {violation:?}\n{}",
            world.plan().seed,
            course[end..].join("\n")
        );
    }
    world
}

#[test]
fn every_rule_holds_under_every_kind_of_fault() {
    for kind in FaultKind::ALL {
        let world = holds(Plan {
            kinds: vec![kind],
            ..small(1)
        });
        let counts = world.counts();
        assert!(counts.harm[&Some(kind)].struck > 0, "{kind} never struck");
        assert!(counts.taken > 500, "{kind}: only {} cycles were taken", counts.taken);
        let without_cause = counts.harm.get(&None).map_or(0, |harm| harm.lost);
        assert_eq!(without_cause, 0, "{kind}: cycles were lost before any fault");
    }
}

#[test]
fn every_rule_holds_under_all_of_them_at_once() {
    let mut told = 0;
    for seed in 1..=6 {
        told += holds(small(seed)).counts().told;
    }
    assert!(told > 100, "only {told} commands were told done");
}

#[test]
fn a_calm_cell_loses_nothing() {
    let world = holds(Plan {
        kinds: Vec::new(),
        seconds: 20,
        calm_seconds: 1,
        ..small(1)
    });
    let counts = world.counts();
    assert_eq!((counts.lost(), counts.takeovers, counts.told_lost_to_two), (0, 0, 0));
    assert!(counts.told > 30 && counts.taken > 1000);
}

#[test]
fn one_that_errs_loses_its_vote_and_gets_it_back() {
    let world = holds(Plan {
        kinds: vec![FaultKind::Bits],
        ..small(3)
    });
    let counts = world.counts();
    assert!(
        counts.flipped > 10 && counts.dissents > 0 && counts.readmitted > 0,
        "{counts:?}"
    );
}

#[test]
fn each_broken_rule_is_noticed_and_each_rule_notices_one() {
    let mut noticed = BTreeSet::new();
    for broken in Broken::ALL {
        // What must be seen to be broken by it, in some of the seeds; and what else may be.
        let (must, may): (&[&str], &[&str]) = match broken {
            // The owner before may be the owner again: then it is its old cycle that shows.
            Broken::NoTerms => (&[RULES[0]], &[RULES[1]]),
            Broken::AnyBase => (&[RULES[2]], &[RULES[3]]),
            Broken::Unchained => (&[RULES[3]], &[]),
            Broken::OutputsApart | Broken::FirstAnswer => (&[RULES[2]], &[]),
            // A home that forgets its terms forgets its records with them.
            Broken::TermsAgain => (&[RULES[1]], &[RULES[4]]),
            Broken::ToldTooSoon => (&[RULES[4]], &[]),
            Broken::NoResume => (&[RULES[5]], &[]),
        };
        let mut missing: BTreeSet<&str> = must.iter().copied().collect();
        for seed in 1..=40 {
            if missing.is_empty() {
                break;
            }
            let mut world = World::new(Plan {
                broken: Some(broken),
                ..small(seed)
            })
            .unwrap();
            world.run();
            let Some(violation) = world.violation() else { continue };
            let rule = violation.rule;
            assert!(must.contains(&rule) || may.contains(&rule), "{broken:?}: {violation:?}");
            missing.remove(rule);
            noticed.insert(rule);
        }
        assert!(missing.is_empty(), "{broken:?}: nothing shows {missing:?}");
    }
    assert_eq!(noticed, RULES.into_iter().collect());
}

#[test]
fn a_seed_gives_the_same_course_again() {
    let run = |seed| {
        let mut world = World::new(Plan {
            trace: Some(0),
            ..small(seed)
        })
        .unwrap();
        world.run();
        let lines: Vec<String> = world.trace().map(str::to_owned).collect();
        (world.counts().clone(), lines)
    };
    assert_eq!(run(7), run(7));
    assert_ne!(run(7).0, run(8).0);
}
