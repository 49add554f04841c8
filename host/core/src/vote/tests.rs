//! Votes by table, and under any order of answers.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use proptest::prelude::*;

use super::*;

fn host(n: usize) -> HostId {
    HostId::new(format!("h{n}")).unwrap()
}

fn hosts(n: usize) -> Vec<HostId> {
    (0..n).map(host).collect()
}

fn answer(value: f64) -> Cast {
    Cast::Effects(Effects {
        state: vec![7],
        writes: vec![(1, value)],
        ..Effects::default()
    })
}

fn trap(text: &str) -> Cast {
    Cast::Fault(Fault::Trap(text.to_owned()))
}

#[test]
fn equal_means_equal_to_the_last_bit() {
    assert!(answer(1.0).same(&answer(1.0)));
    assert!(!answer(1.0).same(&answer(1.0 + f64::EPSILON)));
    assert!(!answer(0.0).same(&answer(-0.0)), "equal numbers, other bits");
    assert!(trap("at 0x10").same(&trap("at 0x20")));
    assert!(!trap("").same(&Cast::Fault(Fault::Failed(String::new()))));
    assert!(!trap("").same(&answer(1.0)));
    assert_eq!(Cast::of(Err(Fault::Overrun { limit_us: 1 })), Cast::Nothing);
    assert!(!Cast::Nothing.same(&Cast::Nothing));
}

#[test]
fn the_majority_by_table() {
    use OnFewer::{Fault as Stop, GoOn};
    use Verdict::{Agreed, Open, Split};
    let (a, b, none) = (|| answer(1.0), || answer(2.0), || Cast::Nothing);
    let first = Agreed { answer: 0 };
    type Row = (u8, usize, OnFewer, Vec<Cast>, Verdict);
    let table: Vec<Row> = vec![
        (3, 3, GoOn, vec![a()], Open),
        (3, 3, GoOn, vec![a(), a()], first),
        (3, 3, GoOn, vec![a(), b()], Open),
        (3, 3, GoOn, vec![a(), b(), a()], first),
        (3, 3, GoOn, vec![b(), a(), a()], Agreed { answer: 1 }),
        (3, 3, GoOn, vec![a(), b(), answer(3.0)], Split),
        (3, 3, GoOn, vec![a(), none(), none()], Split),
        (3, 3, GoOn, vec![a(), none()], Open),
        (3, 3, GoOn, vec![trap("x"), trap("y")], first),
        // Fewer than n.
        (3, 2, GoOn, vec![a()], Open),
        (3, 2, GoOn, vec![a(), b()], Split),
        (3, 2, GoOn, vec![a(), a()], first),
        (3, 1, GoOn, vec![a()], first),
        (3, 2, Stop, vec![a(), a()], first),
        (3, 1, Stop, vec![a()], Split),
        (3, 0, GoOn, vec![], Split),
        (5, 5, GoOn, vec![a(), a(), b(), b()], Open),
        (5, 4, GoOn, vec![a(), a(), b(), b()], Split),
        (5, 4, GoOn, vec![a(), a(), b(), a()], first),
    ];
    for (n, able, on_fewer, casts, verdict) in table {
        let mut ballot = Ballot::new(n, hosts(able), &[], on_fewer);
        for (i, cast) in casts.iter().enumerate() {
            ballot.cast(&host(i), cast.clone());
        }
        assert_eq!(
            ballot.verdict(),
            verdict,
            "vote({n}) of {able}, {on_fewer:?}: {casts:?}"
        );
    }
}

#[test]
fn only_those_who_were_asked_are_heard_and_once() {
    let mut ballot = Ballot::new(3, hosts(5), &[], OnFewer::GoOn);
    assert_eq!(ballot.asked().count(), 3);
    ballot.cast(&host(0), answer(1.0));
    ballot.cast(&host(0), answer(1.0));
    ballot.cast(&host(4), answer(1.0));
    assert_eq!(ballot.verdict(), Verdict::Open);
    assert_eq!(ballot.silent_voters(), [host(1), host(2)]);
}

#[test]
fn a_silent_voter_is_stood_in_for_and_loses_its_vote_for_the_cycle() {
    let mut ballot = Ballot::new(3, hosts(4), &[], OnFewer::GoOn);
    ballot.cast(&host(0), answer(1.0));
    ballot.cast(&host(1), answer(2.0));
    assert_eq!(ballot.stand_in(&host(1)), None, "it answered");
    assert_eq!(ballot.stand_in(&host(2)), Some(host(3)));
    assert_eq!(ballot.stand_in(&host(3)), None, "nobody is left");
    ballot.cast(&host(2), answer(2.0));
    assert_eq!(ballot.verdict(), Verdict::Open, "what it says late does not count");
    ballot.cast(&host(3), answer(1.0));
    assert_eq!(ballot.verdict(), Verdict::Agreed { answer: 0 });
    let closed = ballot.close(Some(0));
    assert_eq!((closed.answers, closed.agreed, closed.needed), (3, 2, 2));
    let against: Vec<_> = closed
        .judged
        .iter()
        .filter(|(_, agreed)| !agreed)
        .map(|(h, _)| h.clone())
        .collect();
    assert_eq!(against, [host(1), host(2)], "it is judged all the same");
}

#[test]
fn a_dissenter_steps_along_and_gets_its_vote_back_after_clean_steps() {
    let members = hosts(3);
    let judge = |before: Option<&Standing>, agreed: bool| {
        standing(before, &[(host(0), true), (host(1), true), (host(2), agreed)], &members)
    };
    let (mut now, events) = judge(None, false);
    assert_eq!(events, [Event::Dissent { replica: host(2) }]);
    // It has no vote: the two that are left must agree, and its answer counts for nothing.
    let mut ballot = Ballot::new(3, members.clone(), &now.aside, OnFewer::GoOn);
    assert_eq!((ballot.have(), ballot.asked().count()), (2, 3));
    ballot.cast(&host(2), answer(9.0));
    ballot.cast(&host(0), answer(9.0));
    assert_eq!(ballot.verdict(), Verdict::Open);
    ballot.cast(&host(1), answer(9.0));
    assert!(matches!(ballot.verdict(), Verdict::Agreed { .. }));
    // Almost clean, then not: it begins anew.
    for _ in 1..CLEAN_STEPS {
        let (next, events) = judge(Some(&now), true);
        assert!(events.is_empty());
        now = next;
    }
    let (next, events) = judge(Some(&now), false);
    assert!(events.is_empty(), "it is aside already");
    now = next;
    assert_eq!((now.aside[0].clean, now.aside[0].dissents, now.dissents), (0, 2, 2));
    for step in 1..=CLEAN_STEPS {
        let (next, events) = judge(Some(&now), true);
        now = next;
        let readmitted = events == [Event::Readmitted { replica: host(2) }];
        assert_eq!(readmitted, step == CLEAN_STEPS);
    }
    assert!(now.aside.is_empty());
    assert_eq!(now.dissents, 2, "what was counted stays");
}

#[test]
fn those_aside_are_bounded_and_members_are_remembered_first() {
    let judged: Vec<Judged> = (0..40).map(|n| (host(n), false)).collect();
    let (now, _) = standing(None, &judged, &[host(3)]);
    assert_eq!(now.aside.len(), REPLICAS_MAX);
    assert!(now.aside.iter().any(|a| a.host == host(3)));
}

proptest! {
    /// As long as fewer than a majority are wrong, whatever they say and in whatever order: what is decided is right.
    #[test]
    fn a_minority_never_decides(
        n in 2u8..9,
        wrong in prop::collection::vec(0u8..3, 0..9),
        order in Just((0..9usize).collect::<Vec<_>>()).prop_shuffle(),
        silent in prop::collection::vec(any::<bool>(), 9),
    ) {
        let able = usize::from(n);
        let wrong = &wrong[..wrong.len().min(able - majority(able))];
        let mut ballot = Ballot::new(n, hosts(able), &[], OnFewer::Fault);
        for i in order.into_iter().filter(|i| *i < able && !silent[*i]) {
            let value = wrong.get(i).map_or(1.0, |w| 2.0 + f64::from(*w));
            ballot.cast(&host(i), answer(value));
            if let Verdict::Agreed { answer: chosen } = ballot.verdict() {
                let closed = ballot.clone().close(Some(chosen));
                prop_assert_eq!(&closed.decided, &answer(1.0));
                prop_assert!(usize::from(closed.agreed) >= majority(able));
            }
        }
    }
}
