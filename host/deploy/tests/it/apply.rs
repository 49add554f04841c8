//! What can be applied, and what is refused in which words. A refusal leaves nothing behind.

use bumpless_core::OutputLimit;
use bumpless_deploy::{Change, Error, LoopDraft};

use crate::harness::{Cell, component, draft, forced, id};

#[tokio::test(flavor = "multi_thread")]
async fn bad_drafts_are_refused_in_words_and_leave_nothing() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let pid = io.deploy.upload(component("pid"), "t", "").await.unwrap();
    forced(&io, "guests/fails-start").await;
    io.deploy.apply(draft("taken", "pid", "io", 9)).await.unwrap();
    let before = io.store.intents().unwrap();
    type Edit = fn(&mut LoopDraft);
    type Kind = fn(&Error) -> bool;
    let invalid: Kind = |e| matches!(e, Error::Invalid(_));
    let not_found: Kind = |e| matches!(e, Error::NotFound(_));
    let refused: Kind = |e| matches!(e, Error::Refused(_));
    let limit = |low, high, safe| OutputLimit {
        low,
        high,
        rate_per_s: None,
        safe,
    };
    let narrow = limit(10.0, 20.0, 30.0);
    let wide = limit(-5.0, 100.0, 0.0);
    type Row = (Box<dyn Fn(&mut LoopDraft)>, Kind, &'static str);
    let table: Vec<Row> = vec![
        (edit(|d| d.name = "Bad Name".into()), invalid, "lower-case"),
        (edit(|d| d.name = "call".into()), invalid, "cannot be the name"),
        (
            edit(|d| d.component = "nothing".into()),
            not_found,
            "there is no component \"nothing\"; the library has",
        ),
        (
            edit(|d| d.component = "pid@9.9.9".into()),
            not_found,
            "the library has pid@",
        ),
        (edit(|d| d.period_ms = 0.5), invalid, "1 ms to 1 h"),
        (edit(|d| d.period_ms = f64::NAN), invalid, "1 ms to 1 h"),
        (edit(|d| d.replicas = 0), invalid, "replicas"),
        (edit(|d| d.ports.clear()), invalid, "no port is connected"),
        (
            edit(|d| d.ports.retain(|port, _| port != "out")),
            invalid,
            "port \"out\" of the component must be connected",
        ),
        (
            edit(|d| d.ports.extend([("x".into(), "io.1.load".into())])),
            invalid,
            "no port \"x\"",
        ),
        (
            edit(|d| d.ports.extend([("pv".into(), "io.77.pv".into())])),
            not_found,
            "no host serves io.77.pv",
        ),
        (
            edit(|d| d.ports.extend([("pv".into(), "NO".into())])),
            invalid,
            "port \"pv\"",
        ),
        (
            edit(|d| d.ports.extend([("out".into(), "io.1.pv".into())])),
            invalid,
            "is an output, and point io.1.pv is an input",
        ),
        (
            edit(|d| d.ports.extend([("out".into(), "io.9.out".into())])),
            refused,
            "loop taken writes point io.9.out already",
        ),
        (
            edit(|d| d.parameters.extend([("gain".into(), 1.0)])),
            invalid,
            "no parameter \"gain\"",
        ),
        (
            edit(|d| d.parameters.extend([("ti".into(), -1.0)])),
            invalid,
            "\"ti\" = -1",
        ),
        (edit(|d| d.setpoint = 200.0), invalid, "setpoint 200"),
        (
            edit(|d| d.setpoint_range = Some((60.0, 70.0))),
            invalid,
            "range 60 to 70",
        ),
        (
            Box::new(move |d| d.limits.extend([("out".into(), narrow)])),
            invalid,
            "low <= safe <= high",
        ),
        (
            Box::new(move |d| d.limits.extend([("out".into(), wide)])),
            invalid,
            "beyond the range of point io.1.out",
        ),
        (
            Box::new(move |d| d.limits.extend([("pv".into(), narrow)])),
            invalid,
            "the port is an input",
        ),
        (
            Box::new(move |d| d.limits.extend([("ff".into(), narrow)])),
            invalid,
            "the port is an input",
        ),
        (edit(|d| d.policy.takeover_part = 0.1), invalid, "takeover_part"),
        (
            edit(|d| d.component = "fails-start".into()),
            refused,
            "this guest never starts",
        ),
    ];
    fn edit(edit: Edit) -> Box<dyn Fn(&mut LoopDraft)> {
        Box::new(edit)
    }
    for (edit, kind, part) in table {
        let mut bad = draft("new", "pid", "io", 1);
        edit(&mut bad);
        let error = io.deploy.apply(bad).await.expect_err(part);
        assert!(kind(&error) && error.to_string().contains(part), "{part}: {error:?}");
        assert_eq!(io.store.intents().unwrap(), before, "{part}");
        assert!(
            io.field.home("new").is_none() && io.field.held("new").is_empty(),
            "{part}"
        );
    }
    // By every form of reference the good one is taken, and what it left out is filled in.
    let end = io
        .deploy
        .apply(draft("new", &pid.digest.to_string()[..10], "io", 1))
        .await
        .unwrap();
    assert!(end.created && end.revision == 1, "{end:?}");
    let spec = io.deploy.loop_view(&id("new")).unwrap().spec;
    assert_eq!(spec.setpoint_range, (0.0, 100.0));
    assert_eq!(spec.limits.get("out"), Some(&limit(0.0, 100.0, 0.0)));
    assert_eq!(io.field.held("new"), [1]);
    assert_eq!(io.field.home("new").unwrap().members.len(), 1);
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_same_again_is_unchanged_and_a_host_without_controllers_says_so() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    let again = io.deploy.apply(draft("l", "pid", "io", 1)).await.unwrap();
    assert!(again.unchanged && !again.created && again.revision == 1, "{again:?}");
    let same = io.deploy.set(&id("l"), Change::default()).await.unwrap();
    assert!(same.unchanged);
    io.stop().await;

    let cell = Cell::new();
    let io = cell.io("io", false).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    let error = io
        .deploy
        .apply(draft("l", "pid", "io", 1))
        .await
        .expect_err("nobody runs it");
    assert!(
        matches!(&error, Error::Unreachable(w) if w.reason.contains("no host that runs controllers")),
        "{error:?}"
    );
    assert!(io.store.intents().unwrap().is_empty());
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn points_of_two_hosts_are_no_loop() {
    let cell = Cell::new();
    let (io, far) = (cell.io("io", true).await, cell.io("far", false).await);
    io.sees(&["far"]).await;
    io.deploy.upload(component("pid"), "t", "").await.unwrap();
    let mut split = draft("l", "pid", "io", 1);
    split.ports.insert("out".into(), "far.1.out".into());
    let error = io.deploy.apply(split).await.expect_err("two homes").to_string();
    assert!(
        error.contains("out = far.1.out at far, pv = io.1.pv at io; all points of a loop"),
        "{error}"
    );
    io.stop().await;
    far.stop().await;
}
