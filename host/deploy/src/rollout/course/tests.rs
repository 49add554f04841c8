//! The course by hand and against any order of answers: nothing before the canary, never too many at once, never forwards
//! after a failure.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use proptest::prelude::*;

use super::*;

fn course(loops: usize, at_once: u32, on_failure: OnFailure) -> Course {
    let rule = Rule {
        at_once,
        on_failure,
        ..Rule::default()
    };
    let leg = |n: usize| Leg::new(LoopId::new(format!("l{n}")).unwrap(), 1, 1, 20_000_000, 0.1);
    Course::new(rule, (0..loops).map(leg).collect())
}

fn stages(course: &Course) -> Vec<Stage> {
    course.legs.iter().map(|leg| leg.stage).collect()
}

/// Chooses and asks, as the journey does.
fn next(course: &mut Course) -> Vec<Action> {
    course.choose_back();
    course.choose(|_| true);
    course.actions(true)
}

#[test]
fn the_canary_is_alone_and_the_others_follow_a_few_at_a_time() {
    use Action::Change;
    let mut course = course(4, 2, OnFailure::Stop);
    assert_eq!(next(&mut course), [Change(0)]);
    assert_eq!(next(&mut course), []);
    course.changed(0, 2, true);
    assert_eq!(next(&mut course), []);
    course.passed(0);
    assert_eq!(next(&mut course), [Change(1), Change(2)]);
    course.changed(2, 2, true);
    course.passed(2);
    assert_eq!(next(&mut course), [Change(3)]);
    for n in [1, 3] {
        course.changed(n, 2, true);
        course.passed(n);
    }
    assert!(course.ended() && course.failure().is_none());
    assert_eq!(stages(&course), [Stage::Done; 4]);
}

#[test]
fn a_loop_that_is_not_ready_is_waited_for_and_not_overtaken() {
    let mut course = course(3, 2, OnFailure::Stop);
    assert!(!course.choose(|_| false));
    assert_eq!(next(&mut course), [Action::Change(0)]);
    course.changed(0, 2, true);
    course.passed(0);
    assert!(!course.choose(|n| n == 2), "1 is not ready, 2 waits for it");
    assert_eq!(course.due(), [1, 2]);
}

#[test]
fn what_was_not_kept_on_disk_is_not_asked_for() {
    let mut course = course(2, 1, OnFailure::Stop);
    assert!(course.choose(|_| true));
    assert_eq!(course.actions(false), []);
    course.stop();
    assert_eq!(stages(&course), [Stage::Waiting; 2]);
    assert!(course.ended() && course.stopped());
    assert_eq!(next(&mut course), []);
}

#[test]
fn a_failed_canary_goes_back_and_the_rest_is_left_alone() {
    let mut course = course(3, 1, OnFailure::Stop);
    next(&mut course);
    course.changed(0, 2, true);
    course.fell(0, Fall::Runs, "it trapped");
    assert!(!course.ended());
    assert_eq!(next(&mut course), [Action::Back(0)]);
    course.went_back(0, Ok(()));
    assert_eq!(stages(&course), [Stage::RolledBack, Stage::Waiting, Stage::Waiting]);
    assert_eq!((course.ended(), course.failure()), (true, Some("l0: it trapped")));
    assert_eq!(course.legs[0].reason, "it trapped");
}

#[test]
fn all_go_back_newest_first() {
    use Action::Back;
    let mut course = course(4, 1, OnFailure::Back);
    for n in 0..3 {
        next(&mut course);
        course.changed(n, 2, true);
        course.passed(n);
    }
    next(&mut course);
    course.changed(3, 2, true);
    course.fell(3, Fall::WentBack, "it trapped");
    assert_eq!(next(&mut course), [Back(2)]);
    course.went_back(2, Ok(()));
    assert_eq!(next(&mut course), [Back(1)]);
    course.went_back(1, Err("somebody changed it".into()));
    assert_eq!(next(&mut course), [Back(0)]);
    course.went_back(0, Ok(()));
    assert!(course.ended());
    assert_eq!(
        stages(&course),
        [Stage::RolledBack, Stage::Failed, Stage::RolledBack, Stage::RolledBack]
    );
    assert_eq!(
        course.legs[1].reason,
        "another loop failed; it was not rolled back: somebody changed it"
    );
}

#[test]
fn what_the_rollout_did_not_bring_is_not_taken_away() {
    let mut course = course(2, 1, OnFailure::Back);
    next(&mut course);
    course.changed(0, 1, false);
    course.passed(0);
    next(&mut course);
    course.changed(1, 1, false);
    course.fell(1, Fall::Runs, "it trapped");
    assert_eq!(next(&mut course), []);
    assert!(course.ended());
    assert_eq!(stages(&course), [Stage::Done, Stage::Failed]);
}

#[test]
fn a_failure_beside_others_lets_those_finish_or_takes_them_along() {
    for (on_failure, wanted) in [
        (OnFailure::Stop, vec![]),
        (OnFailure::Back, vec![Action::Back(2), Action::Back(0)]),
    ] {
        let mut course = course(4, 2, on_failure);
        next(&mut course);
        course.changed(0, 2, true);
        course.passed(0);
        next(&mut course);
        course.changed(1, 2, true);
        course.changed(2, 2, true);
        course.fell(1, Fall::Others, "somebody changed it");
        assert_eq!(next(&mut course), wanted);
        assert!(!course.ended());
        course.passed(2);
        course.went_back(2, Ok(()));
        course.went_back(0, Ok(()));
        assert!(course.ended());
        assert_eq!(course.legs[3].stage, Stage::Waiting);
    }
}

#[test]
fn a_restart_asks_again_and_after_a_stop_only_finds_out() {
    let mut asked = course(2, 1, OnFailure::Stop);
    next(&mut asked);
    assert_eq!(next(&mut asked.as_kept()), [Action::Change(0)]);
    asked.stop();
    let mut again = asked.as_kept();
    assert_eq!(next(&mut again), [Action::Find(0)]);
    assert!(!again.ended());
    again.spared(0);
    assert!(again.ended());
    let mut failed = course(1, 1, OnFailure::Stop);
    next(&mut failed);
    failed.changed(0, 2, true);
    failed.fell(0, Fall::Runs, "it trapped");
    assert_eq!(next(&mut failed.as_kept()), [Action::Back(0)]);
}

#[test]
fn it_comes_back_from_the_disk_as_it_went_and_fits_into_a_row() {
    let mut course = course(256, 16, OnFailure::Back);
    let long = "ü".repeat(2_000);
    next(&mut course);
    course.refused(0, &long);
    for leg in &mut course.legs {
        leg.reason = long.chars().take(REASON_CHARS_MAX).collect();
        leg.error = Some(1.0);
    }
    let bytes = postcard::to_stdvec(&course).unwrap();
    assert!(bytes.len() < 512 * 1024, "{}", bytes.len());
    assert_eq!(postcard::from_bytes::<Course>(&bytes).unwrap(), course.as_kept());
    assert!(course.failure().unwrap().chars().count() <= REASON_CHARS_MAX);
}

/// One thing that may happen next.
#[derive(Debug, Clone)]
enum Event {
    Answer(usize, u8),
    Sight(usize, u8),
    Stop,
    Restart,
    Ready(usize),
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        8 => (0..8_usize, 0..8_u8).prop_map(|(leg, how)| Event::Answer(leg, how)),
        8 => (0..8_usize, 0..16_u8).prop_map(|(leg, how)| Event::Sight(leg, how)),
        4 => (0..8_usize).prop_map(Event::Ready),
        1 => Just(Event::Stop),
        1 => Just(Event::Restart),
    ]
}

proptest! {
    #[test]
    fn nothing_before_the_canary_nothing_too_many_nothing_forwards_after_a_failure(
        loops in 1..8_usize,
        at_once in 1..4_u32,
        back in any::<bool>(),
        events in proptest::collection::vec(event(), 0..200),
    ) {
        let on_failure = if back { OnFailure::Back } else { OnFailure::Stop };
        let mut course = course(loops, at_once, on_failure);
        let mut ready = [false; 8];
        // What is under way outside, and what was changed, in order.
        let mut changing = std::collections::BTreeSet::new();
        let mut going_back = std::collections::BTreeSet::new();
        // A stop leaves these under way: after a restart they are asked for again.
        let mut sent_back = std::collections::BTreeSet::new();
        let mut canary_passed = false;
        for event in events.into_iter().chain((0..8).map(Event::Ready)) {
            match event {
                Event::Ready(n) => ready[n] = true,
                Event::Stop => course.stop(),
                Event::Restart => {
                    course = course.as_kept();
                    changing.clear();
                    going_back.clear();
                }
                Event::Answer(n, how) if changing.remove(&n) => match how {
                    0 => course.refused(n, "refused"),
                    1 => course.unknown(n, "silent"),
                    2 => course.changed(n, 1, false),
                    3 if course.halted() => course.spared(n),
                    _ => course.changed(n, 2, true),
                },
                Event::Answer(n, how) if going_back.remove(&n) => {
                    course.went_back(n, if how == 0 { Err("busy".into()) } else { Ok(()) });
                }
                Event::Answer(..) => {}
                Event::Sight(n, how) => match how {
                    0 => course.fell(n, Fall::Runs, "fault"),
                    1 => course.fell(n, Fall::WentBack, "probation"),
                    2 => course.fell(n, Fall::Others, "others"),
                    3 if course.due().contains(&n) => course.refused(n, "never ready"),
                    _ => course.passed(n),
                },
            }
            canary_passed |= course.legs[0].stage == Stage::Done;
            let halted = course.halted();
            let ended = course.ended();
            let before = course.legs.iter().filter_map(|leg| leg.changed.filter(|_| matches!(leg.stage, Stage::Watched | Stage::Done))).max();
            course.choose_back();
            course.choose(|n| ready[n]);
            let actions = course.actions(true);
            prop_assert!(!ended || actions.is_empty(), "{actions:?} after its end");
            let mut newest = None;
            for action in actions {
                match action {
                    Action::Change(n) => {
                        prop_assert!(!halted, "{n} is changed forwards after a failure or a stop");
                        prop_assert!(n == 0 || canary_passed, "{n} is changed before the canary passed");
                        prop_assert!(changing.insert(n), "{n} is asked for twice");
                    }
                    Action::Find(n) => {
                        prop_assert!(halted);
                        prop_assert!(changing.insert(n), "{n} is asked for twice");
                    }
                    Action::Back(n) => {
                        prop_assert!(course.legs[n].changed.is_some(), "{n} was not changed by the rollout");
                        prop_assert!(course.failure().is_some());
                        prop_assert!(going_back.insert(n), "{n} is brought back twice");
                        let again = !sent_back.insert(n);
                        if course.legs[n].reason == "another loop failed" {
                            prop_assert!(back && (!course.stopped() || again));
                            newest = newest.max(course.legs[n].changed);
                        }
                    }
                }
            }
            // After a restart, those that were under way go first; else it is the newest of those that stand.
            if let Some(newest) = newest
                && course.legs.iter().filter(|leg| leg.stage == Stage::GoingBack).count() == 1
            {
                prop_assert!(Some(newest) >= before, "the newest goes back first");
            }
            let busy = course.count(&[Stage::Changing, Stage::Watched]);
            prop_assert!(busy <= at_once as usize, "{busy} under change or watch");
            if !canary_passed {
                prop_assert!(course.legs.iter().skip(1).all(|leg| leg.changed.is_none() && leg.stage == Stage::Waiting));
            }
        }
        // Whatever happened, it ends when all that is under way is answered well.
        for _ in 0..100 {
            for n in std::mem::take(&mut changing) {
                course.changed(n, 2, true);
            }
            for n in std::mem::take(&mut going_back) {
                course.went_back(n, Ok(()));
            }
            for n in 0..loops {
                course.passed(n);
            }
            for action in next(&mut course) {
                match action {
                    Action::Change(n) | Action::Find(n) => _ = changing.insert(n),
                    Action::Back(n) => _ = going_back.insert(n),
                }
            }
        }
        prop_assert!(course.ended(), "{course:?}");
        let done = stages(&course).iter().all(|stage| *stage == Stage::Done);
        prop_assert!(done || course.halted());
        if on_failure == OnFailure::Back && course.failure().is_some() && !course.stopped() {
            prop_assert!(
                !course.legs.iter().any(|leg| leg.stage == Stage::Done && leg.changed.is_some()),
                "a changed loop was left behind"
            );
        }
    }
}
