//! Rollouts on loops that are written down: the cycles are a test's, so every order of things is.

use std::collections::BTreeMap;

use bumpless_core::{Event, LoopId};
use bumpless_deploy::{
    Change, Error,
    rollout::{OnFailure, RolloutDraft, RolloutView, Rule, Stage, State},
};

use crate::field::Script;
use crate::harness::{Cell, Host, PATIENCE, component, draft, id, until};

const LOOPS: [&str; 3] = ["a", "b", "c"];

/// A host that serves and runs three loops, with two components.
async fn three_loops(cell: &Cell) -> Host {
    let io = cell.io("io", true).await;
    for name in ["pid", "pidplus"] {
        io.deploy.upload(component(name), "t", "").await.unwrap();
    }
    for (number, name) in (1..).zip(LOOPS) {
        io.deploy.apply(draft(name, "pid", "io", number)).await.unwrap();
    }
    io
}

fn wanted(loops: &[&str]) -> RolloutDraft {
    RolloutDraft {
        component: "pidplus".to_owned(),
        parameters: BTreeMap::new(),
        loops: loops.iter().copied().map(id).collect(),
        all_of: None,
        rule: Rule {
            cycles: 5,
            ..Rule::default()
        },
    }
}

/// One cycle of each loop, under the revision that it runs.
fn cycle(io: &Host) {
    for name in LOOPS {
        if let Some(home) = io.field.home(name) {
            io.field.cycle(name, home.spec.revision, vec![], vec![]);
        }
    }
}

fn leg<'a>(view: &'a RolloutView, name: &str) -> &'a bumpless_deploy::rollout::LegView {
    view.loops.iter().find(|leg| leg.loop_id == id(name)).unwrap()
}

fn stages(view: &RolloutView) -> Vec<Stage> {
    view.loops.iter().map(|leg| leg.stage).collect()
}

/// Lets the loops run until the rollout is as wanted.
async fn until_it(io: &Host, rollout: &str, what: &str, is: impl Fn(&RolloutView) -> bool) -> RolloutView {
    let started = std::time::Instant::now();
    loop {
        cycle(io);
        let view = io.deploy.rollout(rollout).await.unwrap();
        if is(&view) {
            return view;
        }
        assert!(started.elapsed() < PATIENCE, "{what}: {view:?}");
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
}

/// Lets the loops run until one of them was changed, and no further: its watch has just begun.
async fn until_watched(io: &Host, rollout: &str, name: &str) -> RolloutView {
    let before = io.field.home(name).unwrap().spec.revision;
    until(&format!("{name} is changed"), || {
        let changed = io.field.home(name).unwrap().spec.revision > before;
        if !changed {
            cycle(io);
        }
        changed.then_some(())
    })
    .await;
    let started = std::time::Instant::now();
    loop {
        let view = io.deploy.rollout(rollout).await.unwrap();
        if leg(&view, name).stage == Stage::Watched {
            return view;
        }
        assert!(started.elapsed() < PATIENCE, "{name} is watched: {view:?}");
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
}

fn runs(io: &Host, name: &str) -> String {
    io.deploy.loop_view(&id(name)).unwrap().component
}

#[tokio::test(flavor = "multi_thread")]
async fn it_goes_from_loop_to_loop_and_is_known_at_every_host() {
    let cell = Cell::new();
    let io = three_loops(&cell).await;
    let other = cell.control("other").await;
    io.sees(&["other"]).await;
    other.sees(&["io"]).await;
    let mut asked = wanted(&["b"]);
    asked.all_of = Some("pid".to_owned());
    asked.parameters.insert("k".to_owned(), 3.0);
    let begun = io.deploy.start_rollout(asked).await.unwrap();
    let names: Vec<&str> = begun.loops.iter().map(|leg| leg.loop_id.as_str()).collect();
    assert_eq!((begun.state, names), (State::Running, vec!["b", "a", "c"]));
    // Nothing happens before the canary was seen.
    assert_eq!(stages(&begun), [Stage::Waiting; 3]);
    let canary = until_watched(&io, &begun.id, "b").await;
    assert_eq!(stages(&canary), [Stage::Watched, Stage::Waiting, Stage::Waiting]);
    assert!(runs(&io, "a").starts_with("pid@") && runs(&io, "b").starts_with("pidplus@"));
    let end = until_it(&io, &begun.id, "its end", |view| view.state != State::Running).await;
    assert_eq!(
        (end.state, end.done, end.failure.clone()),
        (State::Done, 3, None),
        "{end:?}"
    );
    for name in LOOPS {
        let view = io.deploy.loop_view(&id(name)).unwrap();
        assert_eq!((view.spec.revision, view.spec.parameters["k"]), (2, 3.0));
    }
    let ended = until_it(&io, &begun.id, "its end is kept", |view| {
        view.ended_at_unix_ms.is_some()
    })
    .await;
    assert!(ended.ended_at_unix_ms.unwrap() >= ended.started_at_unix_ms);
    // Another host asks this one.
    assert_eq!(other.deploy.rollout(&begun.id).await.unwrap(), ended);
    let list = other.deploy.rollouts().await;
    assert_eq!((list.rollouts.len(), list.silent.len()), (1, 0));
    assert!(list.rollouts[0].loops.is_empty() && list.rollouts[0].done == 3);
    assert_eq!(
        other.deploy.stop_rollout(&begun.id).await.unwrap(),
        ended,
        "what has ended stays so"
    );
    for bad in ["io.7", "other.1", "nonsense"] {
        let error = io.deploy.rollout(bad).await.expect_err(bad);
        assert!(matches!(error, Error::NotFound(_)), "{error:?}");
    }
    other.stop().await;
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fault_brings_the_canary_back_and_the_others_never_see_it() {
    let cell = Cell::new();
    let io = three_loops(&cell).await;
    let begun = io.deploy.start_rollout(wanted(&LOOPS)).await.unwrap();
    until_watched(&io, &begun.id, "a").await;
    let fault = Event::Faulted {
        replica: io.deploy.here().clone(),
        fault: "the component trapped: unreachable".to_owned(),
    };
    io.field.cycle("a", 2, vec![], vec![fault]);
    let end = until_it(&io, &begun.id, "its end", |view| view.state != State::Running).await;
    assert_eq!(
        (end.state, stages(&end)),
        (State::Failed, vec![Stage::RolledBack, Stage::Waiting, Stage::Waiting])
    );
    assert!(end.failure.clone().unwrap().starts_with("a: in cycle "), "{end:?}");
    assert!(leg(&end, "a").reason.contains("trapped"), "{end:?}");
    for (name, revision) in [("a", 3), ("b", 1), ("c", 1)] {
        assert_eq!(
            io.deploy.loop_view(&id(name)).unwrap().spec.revision,
            revision,
            "{name}"
        );
        assert!(runs(&io, name).starts_with("pid@"), "{name}");
    }
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_others_change_meanwhile_is_a_failure_and_all_go_back_where_that_was_asked() {
    let cell = Cell::new();
    let io = three_loops(&cell).await;
    let mut asked = wanted(&LOOPS);
    asked.rule.on_failure = OnFailure::Back;
    let begun = io.deploy.start_rollout(asked).await.unwrap();
    // The second is watched only after the first passed, and the third waits for it.
    until_watched(&io, &begun.id, "b").await;
    let change = Change {
        parameters: BTreeMap::from([("k".to_owned(), 4.0)]),
        strategy: None,
    };
    io.deploy.set(&id("c"), change.clone()).await.unwrap();
    let end = until_it(&io, &begun.id, "its end", |view| view.state != State::Running).await;
    assert_eq!(
        stages(&end),
        [Stage::RolledBack, Stage::RolledBack, Stage::Refused],
        "{end:?}"
    );
    let why = &leg(&end, "c").reason;
    assert!(why.contains("revision 2 is in force, not 1"), "{why}");
    assert_eq!(leg(&end, "a").reason, "another loop failed");
    let revision = |name: &str| io.deploy.loop_view(&id(name)).unwrap().spec.revision;
    assert_eq!((revision("a"), revision("b"), revision("c")), (3, 3, 2));

    // A watched loop that somebody changes is theirs: it is not taken back.
    let begun = io.deploy.start_rollout(wanted(&LOOPS)).await.unwrap();
    until_watched(&io, &begun.id, "a").await;
    io.deploy.set(&id("a"), change).await.unwrap();
    let end = until_it(&io, &begun.id, "its end", |view| view.state != State::Running).await;
    assert_eq!(stages(&end), [Stage::Failed, Stage::Waiting, Stage::Waiting], "{end:?}");
    assert!(
        leg(&end, "a").reason.contains("somebody changed it meanwhile"),
        "{end:?}"
    );
    assert!(runs(&io, "a").starts_with("pidplus@"));
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn it_goes_on_after_a_restart_of_its_host_and_stays_stopped() {
    let cell = Cell::new();
    let io = three_loops(&cell).await;
    let begun = io.deploy.start_rollout(wanted(&["a", "b"])).await.unwrap();
    until_watched(&io, &begun.id, "a").await;
    io.stop().await;
    let io = cell.io("io", true).await;
    let again = io.deploy.rollout(&begun.id).await.unwrap();
    assert_eq!(
        (again.state, again.loops[0].stage, again.loops[0].cycles),
        (State::Running, Stage::Watched, 0)
    );
    until("the homes are open", || {
        LOOPS.iter().all(|name| io.field.home(name).is_some()).then_some(())
    })
    .await;
    let end = until_it(&io, &begun.id, "its end", |view| view.ended_at_unix_ms.is_some()).await;
    assert_eq!(stages(&end), [Stage::Done; 2], "{end:?}");
    assert_eq!(
        io.deploy.loop_view(&id("a")).unwrap().spec.revision,
        2,
        "it was changed once"
    );

    let second = io.deploy.start_rollout(wanted(&["c"])).await.unwrap();
    assert_ne!(second.id, begun.id);
    let stopped = io.deploy.stop_rollout(&second.id).await.unwrap();
    assert_eq!(
        (stopped.state, stages(&stopped)),
        (State::Stopped, vec![Stage::Waiting])
    );
    io.stop().await;
    let io = cell.io("io", true).await;
    assert_eq!(io.deploy.rollout(&second.id).await.unwrap().state, State::Stopped);
    until("the homes are open", || {
        LOOPS.iter().all(|name| io.field.home(name).is_some()).then_some(())
    })
    .await;
    for _ in 0..20 {
        cycle(&io);
    }
    let shown = until_it(&io, &second.id, "its end is kept", |view| {
        view.ended_at_unix_ms.is_some()
    })
    .await;
    assert_eq!(shown.state, State::Stopped);
    assert!(runs(&io, "c").starts_with("pid@"));
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_change_that_a_restart_cuts_off_is_asked_for_again_and_after_a_stop_it_is_not() {
    for stop in [false, true] {
        let cell = Cell::new();
        let io = three_loops(&cell).await;
        io.field.script(Script::Ignore);
        let begun = io.deploy.start_rollout(wanted(&["a", "b"])).await.unwrap();
        until("the change is under way", || {
            cycle(&io);
            io.deploy.loop_view(&id("a")).unwrap().pending
        })
        .await;
        if stop {
            let told = io.deploy.stop_rollout(&begun.id).await.unwrap();
            assert_eq!(told.state, State::Running, "what was asked for is not known yet");
        }
        io.stop().await;
        let io = cell.io("io", true).await;
        until("the homes are open", || {
            LOOPS.iter().all(|name| io.field.home(name).is_some()).then_some(())
        })
        .await;
        let end = until_it(&io, &begun.id, "its end", |view| view.ended_at_unix_ms.is_some()).await;
        let (state, stage, component) = if stop {
            (State::Stopped, Stage::Waiting, "pid@")
        } else {
            (State::Done, Stage::Done, "pidplus@")
        };
        assert_eq!((end.state, stages(&end)), (state, vec![stage; 2]), "{end:?}");
        for name in ["a", "b"] {
            assert!(runs(&io, name).starts_with(component), "{name}: {}", runs(&io, name));
        }
        io.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_begun_is_refused_in_words() {
    let cell = Cell::new();
    let io = three_loops(&cell).await;
    let with = |change: &dyn Fn(&mut RolloutDraft)| {
        let mut draft = wanted(&["a"]);
        change(&mut draft);
        draft
    };
    let many = |draft: &mut RolloutDraft| {
        draft.loops = (0..257).map(|n| LoopId::new(format!("l{n}")).unwrap()).collect();
    };
    let table = [
        (with(&|d| d.component = "nothing".into()), "nothing"),
        (with(&|d| d.loops.clear()), "a rollout for 0 loops; name 1 to 256"),
        (with(&many), "a rollout for 257 loops"),
        (with(&|d| d.loops.push(id("a"))), "loop a is named twice"),
        (with(&|d| d.loops.push(id("z"))), "there is no loop \"z\""),
        (with(&|d| _ = d.parameters.insert("gain".into(), 1.0)), "\"gain\""),
        (with(&|d| d.rule.cycles = 0), "cycles = 0"),
        (
            with(&|d| (d.loops, d.all_of) = (vec![], Some("pidplus".into()))),
            "no loop runs pidplus",
        ),
    ];
    for (draft, part) in table {
        let error = io.deploy.start_rollout(draft).await.expect_err(part).to_string();
        assert!(error.contains(part), "{part}: {error}");
    }
    assert!(io.deploy.rollouts().await.rollouts.is_empty());
    // Each loop is in one rollout, and only so many are under way.
    let first = io.deploy.start_rollout(wanted(&["a"])).await.unwrap();
    let error = io
        .deploy
        .start_rollout(wanted(&["b", "a"]))
        .await
        .expect_err("taken")
        .to_string();
    assert!(
        error.contains(&format!("loop a is part of rollout {}", first.id)),
        "{error}"
    );
    for (number, name) in (4..).zip(["d", "e", "f"]) {
        io.deploy.apply(draft(name, "pid", "io", number)).await.unwrap();
        io.deploy.start_rollout(wanted(&[name])).await.unwrap();
    }
    let error = io.deploy.start_rollout(wanted(&["b"])).await.expect_err("full");
    assert!(
        matches!(&error, Error::Busy(words) if words.reason.contains("4 rollouts are under way")),
        "{error:?}"
    );
    // Those that ended are kept for a while, the oldest goes first.
    for rollout in io.deploy.rollouts().await.rollouts {
        io.deploy.stop_rollout(&rollout.id).await.unwrap();
    }
    for _ in 0..16 {
        let begun = io.deploy.start_rollout(wanted(&["a"])).await.unwrap();
        io.deploy.stop_rollout(&begun.id).await.unwrap();
        until_it(&io, &begun.id, "its end is kept", |view| {
            view.ended_at_unix_ms.is_some()
        })
        .await;
    }
    let kept = io.deploy.rollouts().await.rollouts;
    assert_eq!(kept.len(), 16);
    assert!(!kept.iter().any(|rollout| rollout.id == first.id));
    io.stop().await;
}
