//! Changes of a running loop: they come into force whole, or leave the old revision as it was.

use std::collections::BTreeMap;

use bumpless_core::{Event, Strategy};
use bumpless_deploy::{Change, Error};

use crate::{
    field::Script,
    harness::{Cell, Host, component, draft, forced, id, until},
};

/// What the disk says: revision in force, pending, past.
fn on_disk(host: &Host, name: &str) -> (u64, Option<u64>, Vec<u64>) {
    let intent = host.store.intent(&id(name)).unwrap().expect("an intent");
    let past = intent.past.iter().map(|spec| spec.revision).collect();
    (intent.current.revision, intent.pending.map(|spec| spec.revision), past)
}

fn set(name: &str, value: f64) -> Change {
    Change {
        parameters: BTreeMap::from([(name.to_owned(), value)]),
        strategy: None,
    }
}

async fn running() -> (Cell, Host) {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.upload(component("on-off"), "t", "").await.unwrap();
    let mut first = draft("l", "pid", "io", 1);
    first.parameters.insert("k".into(), 2.0);
    first.ports.insert("ff".into(), "io.2.pv".into());
    io.deploy.apply(first).await.unwrap();
    (cell, io)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_change_comes_into_force_with_a_record() {
    let (_cell, io) = running().await;
    let end = io.deploy.set(&id("l"), set("k", 3.0)).await.unwrap();
    assert_eq!((end.revision, end.created, end.unchanged), (2, false, false));
    let hand_over = end.hand_over.expect("a hand-over");
    assert_eq!((hand_over.by.as_str(), hand_over.bump_percent), ("migrate", 0.5));
    assert_eq!(on_disk(&io, "l"), (2, None, vec![1]));
    let view = io.deploy.loop_view(&id("l")).unwrap();
    assert_eq!(view.spec.parameters.get("k"), Some(&3.0));
    assert_eq!(view.last.expect("a record").revision, 2);
    assert!(io.field.home("l").unwrap().known.contains(&2));
    // Both can be stepped: the one in force, and the one that a probation leads back to.
    assert_eq!(io.field.held("l"), [1, 2]);
    let change = Change {
        strategy: Some(Strategy::Cpu),
        ..Change::default()
    };
    assert_eq!(io.deploy.set(&id("l"), change).await.unwrap().revision, 3);
    // Back: under a new number, as it was before the last change.
    let back = io.deploy.rollback(&id("l"), None).await.unwrap();
    assert_eq!(back.revision, 4);
    assert_eq!(
        io.deploy.loop_view(&id("l")).unwrap().spec.strategy,
        Strategy::RoundRobin
    );
    let first = io.deploy.rollback(&id("l"), Some(1)).await.unwrap();
    assert_eq!(first.revision, 5);
    assert_eq!(
        io.deploy.loop_view(&id("l")).unwrap().spec.parameters.get("k"),
        Some(&2.0)
    );
    let error = io
        .deploy
        .rollback(&id("l"), Some(99))
        .await
        .expect_err("no such revision");
    assert!(
        matches!(&error, Error::NotFound(w) if w.cure == "it has 4, 3, 2, 1"),
        "{error:?}"
    );
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_the_loop_refuses_leaves_the_old_revision() {
    let (_cell, io) = running().await;
    io.field
        .script(Script::Refuse("a bump of 9 % is over the limit of 5 %"));
    let error = io.deploy.swap(&id("l"), "on-off").await.expect_err("refused");
    assert!(
        matches!(&error, Error::Refused(w) if w.reason.contains("a bump of 9 %") && w.cure.contains("stays in force")),
        "{error:?}"
    );
    assert_eq!(on_disk(&io, "l"), (1, None, vec![]));
    io.field.script(Script::Full);
    let error = io.deploy.set(&id("l"), set("k", 3.0)).await.expect_err("full");
    assert!(matches!(&error, Error::Busy(_)), "{error:?}");
    assert_eq!(on_disk(&io, "l"), (1, None, vec![]));
    // What was withdrawn is let go again, and its number is not given twice.
    until("the withdrawn revisions are let go", || {
        (io.field.held("l") == [1]).then_some(())
    })
    .await;
    io.field.script(Script::Take);
    assert_eq!(io.deploy.set(&id("l"), set("k", 3.0)).await.unwrap().revision, 4);
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_no_cycle_takes_is_taken_back() {
    let (_cell, io) = running().await;
    io.field.script(Script::Ignore);
    let error = io.deploy.set(&id("l"), set("k", 3.0)).await.expect_err("no cycle");
    assert!(
        matches!(&error, Error::Timeout(w) if w.reason.contains("no cycle of loop l took the change")),
        "{error:?}"
    );
    assert_eq!(on_disk(&io, "l"), (1, None, vec![]));
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_swap_keeps_what_fits_and_names_what_does_not() {
    let (_cell, io) = running().await;
    let end = io.deploy.swap(&id("l"), "on-off").await.unwrap();
    assert_eq!(
        (end.dropped_parameters, end.dropped_ports),
        (vec!["k".to_owned()], vec!["ff".to_owned()])
    );
    let view = io.deploy.loop_view(&id("l")).unwrap();
    assert!(view.component.starts_with("on-off@"), "{}", view.component);
    assert_eq!(view.spec.ports.len(), 2);
    // A component that cannot start is noticed before the loop hears of it.
    forced(&io, "guests/fails-start").await;
    let before = on_disk(&io, "l");
    let error = io
        .deploy
        .swap(&id("l"), "fails-start")
        .await
        .expect_err("does not start");
    assert!(matches!(error, Error::Refused(_) | Error::Invalid(_)), "{error:?}");
    assert_eq!((on_disk(&io, "l").0, on_disk(&io, "l").1), (before.0, None));
    let error = io
        .deploy
        .set(&id("nothing"), Change::default())
        .await
        .expect_err("no loop");
    assert!(
        matches!(&error, Error::NotFound(w) if w.reason.contains("no loop \"nothing\"")),
        "{error:?}"
    );
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_rollback_in_probation_becomes_the_intent() {
    let (_cell, io) = running().await;
    io.deploy.set(&id("l"), set("k", 3.0)).await.unwrap();
    io.field.cycle(
        "l",
        1,
        vec![],
        vec![Event::RolledBack {
            from: 2,
            reason: "trap".into(),
        }],
    );
    until("revision 1 is in force on disk", || {
        (on_disk(&io, "l") == (1, None, vec![2])).then_some(())
    })
    .await;
    // And the next change goes on from there.
    let end = io.deploy.set(&id("l"), set("ti", 30.0)).await.unwrap();
    assert_eq!(end.revision, 3);
    assert_eq!(
        io.deploy.loop_view(&id("l")).unwrap().spec.parameters.get("k"),
        Some(&2.0)
    );
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn two_changes_at_once_come_one_after_the_other() {
    let (_cell, io) = running().await;
    let loop_id = id("l");
    let (a, b) = tokio::join!(
        io.deploy.set(&loop_id, set("k", 3.0)),
        io.deploy.set(&loop_id, set("ti", 30.0))
    );
    let mut numbers = [a.unwrap().revision, b.unwrap().revision];
    numbers.sort_unstable();
    assert_eq!(numbers, [2, 3]);
    let spec = io.deploy.loop_view(&loop_id).unwrap().spec;
    assert_eq!(
        (spec.parameters.get("k"), spec.parameters.get("ti")),
        (Some(&3.0), Some(&30.0))
    );
    io.stop().await;
}
