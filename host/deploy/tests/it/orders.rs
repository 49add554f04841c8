//! Commands, deletion, moves, calls and points, asked at the home and at a host that is not.

use std::collections::BTreeMap;

use bumpless_core::{CommandBody, CommandId, Mode, Strategy};
use bumpless_deploy::{Call, Error};

use crate::{
    field::Script,
    harness::{Cell, component, draft, id, until},
};

#[tokio::test(flavor = "multi_thread")]
async fn commands_reach_the_home_from_anywhere_and_happen_once() {
    let cell = Cell::new();
    let (io, a) = (cell.io("io", false).await, cell.control("a").await);
    io.sees(&["a"]).await;
    a.sees(&["io"]).await;
    a.deploy.upload(component("pid"), "t", "").await.unwrap();
    // Applied at a host without points, of a component that the home may not have heard of.
    let end = a.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    assert!(end.created);
    assert_eq!(a.field.held("l"), [1]);
    assert!(io.field.held("l").is_empty(), "the home runs no controllers");
    until("the intent is known at a", || a.deploy.loop_view(&id("l")).ok()).await;
    let key = Some(CommandId(7));
    let first = a
        .deploy
        .command(&id("l"), key, CommandBody::Setpoint(60.0))
        .await
        .unwrap();
    let again = io
        .deploy
        .command(&id("l"), key, CommandBody::Setpoint(60.0))
        .await
        .unwrap();
    assert_eq!((first.applied.id, first.position), (CommandId(7), again.position));
    io.field.script(Script::Refuse("the setpoint is outside its range"));
    let error = a
        .deploy
        .command(&id("l"), None, CommandBody::Setpoint(1e9))
        .await
        .expect_err("refused");
    assert!(
        matches!(&error, Error::Refused(w) if w.reason.contains("outside its range")),
        "{error:?}"
    );
    io.field.script(Script::Full);
    let error = a
        .deploy
        .command(&id("l"), None, CommandBody::Mode(Mode::Manual))
        .await
        .expect_err("full");
    assert!(
        matches!(&error, Error::Busy(w) if w.reason.contains("too many commands")),
        "{error:?}"
    );
    let error = a
        .deploy
        .command(&id("l"), None, CommandBody::Revise(1))
        .await
        .expect_err("no operator's command");
    assert!(matches!(error, Error::Invalid(_)), "{error:?}");
    io.field.script(Script::Ignore);
    let error = a
        .deploy
        .command(&id("l"), key.map(|_| CommandId(8)), CommandBody::Setpoint(1.0))
        .await
        .expect_err("no cycle");
    assert!(
        matches!(&error, Error::Timeout(w) if w.cure.contains("taken back")),
        "{error:?}"
    );
    // Without its home a loop cannot be commanded, and the words say which host is missing.
    io.stop().await;
    until("io is seen to be gone", || {
        a.deploy
            .hosts()
            .iter()
            .any(|h| h.id.as_str() == "io" && !h.alive)
            .then_some(())
    })
    .await;
    let error = a
        .deploy
        .command(&id("l"), None, CommandBody::Setpoint(1.0))
        .await
        .expect_err("no home");
    assert!(
        matches!(&error, Error::Unreachable(w) if w.reason.contains("io")),
        "{error:?}"
    );
    a.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deleted_loop_is_gone_everywhere_and_its_name_starts_anew() {
    let cell = Cell::new();
    let (io, a) = (cell.io("io", true).await, cell.control("a").await);
    io.sees(&["a"]).await;
    a.sees(&["io"]).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    until("a holds it", || (a.field.held("l") == [1]).then_some(())).await;
    let old = io.store.intent(&id("l")).unwrap().unwrap();
    a.deploy.delete(&id("l")).await.unwrap();
    assert!(io.field.home("l").is_none());
    until("a has forgotten it", || {
        (a.deploy.loops().is_empty() && a.field.held("l").is_empty() && io.field.held("l").is_empty()).then_some(())
    })
    .await;
    for host in [&io, &a] {
        assert_eq!(host.store.intent(&id("l")).unwrap(), None);
        host.store.put_intent(&old).expect_err("an old copy cannot come back");
    }
    let error = a.deploy.delete(&id("l")).await.expect_err("twice");
    assert!(matches!(error, Error::NotFound(_)), "{error:?}");
    let end = io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    assert_eq!((end.created, end.revision), (true, 2));
    io.stop().await;
    a.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_move_needs_a_member_that_is_ready() {
    let cell = Cell::new();
    let (io, a) = (cell.io("io", true).await, cell.control("a").await);
    io.sees(&["a"]).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    let both = || {
        io.field
            .home("l")
            .is_some_and(|home| home.members.len() == 2)
            .then_some(())
    };
    until("both are members", both).await;
    let to = a.deploy.here().clone();
    io.deploy.move_owner(&id("l"), &to).await.unwrap();
    assert_eq!(io.field.moves(), [(id("l"), to)]);
    let nobody = bumpless_core::HostId::new("nobody").unwrap();
    let error = io.deploy.move_owner(&id("l"), &nobody).await.expect_err("no member");
    assert!(
        matches!(&error, Error::Refused(w) if w.cure.contains("these are: ")),
        "{error:?}"
    );
    io.stop().await;
    a.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn calls_step_a_component_and_points_say_who_writes_them() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    let mut call = Call {
        component: "pid".into(),
        strategy: Strategy::Local,
        parameters: BTreeMap::from([("k".into(), 2.0), ("ti".into(), 10.0)]),
        state: None,
        track: BTreeMap::from([("out".into(), 40.0)]),
        inputs: BTreeMap::from([("pv".into(), 50.0)]),
        setpoint: 50.0,
        mode: Mode::Automatic,
        dt_ns: 100_000_000,
        seq: 1,
    };
    let first = io.deploy.call(call.clone()).await.unwrap();
    assert!(
        (first.outputs["out"] - 40.0).abs() < 1e-6,
        "no error, no move: {first:?}"
    );
    call.state = Some(first.state);
    call.inputs.insert("pv".into(), 45.0);
    let second = io.deploy.call(call.clone()).await.unwrap();
    assert!(second.outputs["out"] > 45.0, "k times the error, and more: {second:?}");
    call.parameters.insert("k".into(), f64::NAN);
    let error = io.deploy.call(call).await.expect_err("no parameter");
    assert!(
        matches!(&error, Error::Invalid(w) if w.reason.contains("\"k\" = NaN")),
        "{error:?}"
    );

    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    let points = io.deploy.points().await.unwrap();
    assert_eq!(points.len(), 30);
    let out = points.iter().find(|p| p.id.as_str() == "io.1.out").unwrap();
    assert_eq!(
        (
            out.written_by.as_ref().map(bumpless_core::LoopId::as_str),
            out.writable,
            out.unit.as_str()
        ),
        (Some("l"), true, "%")
    );
    assert!(points.windows(2).all(|pair| pair[0].id < pair[1].id), "by name");
    io.stop().await;
}
