//! What a component must show before it comes in, and what is known of it afterwards.

use std::collections::BTreeMap;

use bumpless_core::{Migrated, Severity, Verdict};
use bumpless_deploy::{Error, Upload};

use crate::harness::{Cell, component, draft, forced, id};

#[tokio::test(flavor = "multi_thread")]
async fn stock_controllers_pass_and_their_report_is_kept() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    for name in ["pid", "pidplus", "on-off"] {
        let info = io.deploy.upload(component(name), "ann", "").await.unwrap();
        let report = info.admission.clone().expect("a report");
        assert!(
            report.verdict == Verdict::Passed || report.verdict == Verdict::Warned,
            "{name}: {report:#?}"
        );
        assert_eq!(report.of(Severity::Refusal).count(), 0, "{name}: {report:#?}");
        assert_eq!(report.check(), Ok(()), "{name}");
        assert_eq!(report.host, *io.deploy.here());
        assert!(report.cycles > 400 && report.steps > 300, "{name}: {report:#?}");
        assert!(
            report.step_p50_ns > 0 && report.start_ns > 0 && report.state_bytes > 0,
            "{name}"
        );
        assert!(report.memory_bytes >= 65_536, "{name}: {}", report.memory_bytes);
        assert_eq!(report.migrated, Migrated::Accepted, "{name}");
        assert_eq!(info.world, "bumpless:control/controller@0.1.0");
        assert_eq!(info.history.last().unwrap().what, "uploaded");
        assert_eq!(io.deploy.resolve(name).unwrap().admission, Some(report), "{name}");
    }
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_fails_its_trial_stays_outside_and_force_is_remembered() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let table = [
        ("traps", "the component trapped"),
        ("returns-nan", "wrote NaN to port \"out\""),
        ("spins", "ran past its limit"),
        ("bad-state", "a state of 65"),
        ("recurses", "the component trapped"),
        ("grows-memory", "of memory"),
        ("floods-messages", "messages in one step"),
        ("remembers", "it gave two answers: it wrote out = "),
        ("fails-start", "this guest never starts"),
        ("start-spins", "does not start with its default parameters"),
        ("jumps", "the component trapped"),
        (
            "migrate-traps",
            "when it was to take over a state of its own: the component trapped",
        ),
    ];
    for (guest, part) in table {
        let bytes = component(&format!("guests/{guest}"));
        let error = io.deploy.upload(bytes.clone(), "ann", "").await.expect_err(guest);
        let words = error.to_string();
        assert!(matches!(error, Error::Invalid(_)), "{guest}: {words}");
        assert!(
            words.starts_with(&format!("component {guest}@0.1.0 failed its trial: ")) && words.contains(part),
            "{guest}: {words}"
        );
        assert!(io.deploy.components().is_empty(), "{guest}");
        assert!(io.store.component_digests().unwrap().is_empty(), "{guest}");
        // A dry run says the same, and leaves nothing either.
        let info = io.deploy.try_out(bytes, &Upload::default()).await.unwrap();
        let report = info.admission.expect("a report");
        assert_eq!(report.verdict, Verdict::Refused, "{guest}");
        assert!(
            report.of(Severity::Refusal).any(|text| text.contains(part)),
            "{guest}: {report:#?}"
        );
        assert!(io.deploy.components().is_empty(), "{guest}");
    }
    let info = forced(&io, "guests/traps").await;
    let report = info.admission.expect("a report");
    assert_eq!(report.verdict, Verdict::Forced);
    assert_eq!(report.findings[0].text, "taken in by force by t");
    assert_eq!(info.history[0].what, "taken in by force");
    // It runs into the ordinary defences, as before.
    assert!(io.deploy.apply(draft("l", "traps", "io", 1)).await.is_ok());
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dry_run_reports_and_leaves_nothing() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let upload = Upload {
        labels: BTreeMap::from([("stage".to_owned(), "pilot".to_owned())]),
        ..Upload::default()
    };
    let info = io.deploy.try_out(component("pid"), &upload).await.unwrap();
    assert!(info.has_label("stage=pilot") && info.admission.is_some());
    assert!(io.deploy.components().is_empty() && io.store.component_digests().unwrap().is_empty());
    let error = io
        .deploy
        .try_out(component("guests/wrong-world"), &upload)
        .await
        .expect_err("no controller");
    assert!(matches!(error, Error::Invalid(_)), "{error}");
    // What is there already is shown as it is.
    let kept = io.deploy.upload(component("pid"), "ann", "first").await.unwrap();
    assert_eq!(io.deploy.try_out(component("pid"), &upload).await.unwrap(), kept);
    assert!(io.deploy.component_bytes(&kept.digest).await.is_ok());
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_step_that_is_too_slow_for_a_loop_is_refused_and_one_near_the_limit_is_told() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    let info = io.deploy.upload(component("pid"), "t", "").await.unwrap();
    let report = info.admission.expect("a report");
    let mut tight = draft("l", "pid", "io", 1);
    tight.period_ms = 10_000.0;
    // Below what the longest step took here, whatever that is; 99 of 100 may have stayed far below it.
    tight.policy.step_limit_us = (report.step_worst_ns - 1) / 1_000;
    if tight.policy.step_limit_us > 0 {
        let error = io.deploy.apply(tight.clone()).await.expect_err("too slow");
        assert!(
            matches!(&error, Error::Refused(w) if w.reason.contains("is too slow for loop l")),
            "{error:?}"
        );
        assert!(io.deploy.loops().is_empty());
    }
    tight.policy.step_limit_us = report.step_worst_ns * 3 / 2 / 1_000 + 1;
    let near = io.deploy.apply(tight.clone()).await.unwrap();
    assert!(
        near.created && near.warnings.len() == 1 && near.warnings[0].contains("in its trial on host io"),
        "{near:?}"
    );
    tight.policy.step_limit_us = report.step_worst_ns * 3 / 1_000 + 1;
    let far = io.deploy.apply(tight.clone()).await.unwrap();
    assert_eq!((far.revision, far.warnings.len()), (2, 0), "{far:?}");
    // What ran may always be gone back to.
    let back = io.deploy.rollback(&id("l"), None).await.unwrap();
    assert_eq!((back.revision, back.warnings.len()), (3, 1), "{back:?}");
    io.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_component_imports_is_compared_with_what_the_loop_grants() {
    let cell = Cell::new();
    let io = cell.io("io", true).await;
    io.deploy.upload(component("on-off"), "t", "").await.unwrap();
    let floods = forced(&io, "guests/floods-messages").await;
    assert!(
        floods.imports.iter().any(|import| import.contains("/net@")),
        "{:?}",
        floods.imports
    );
    let said = |warnings: &[String], part: &str| warnings.iter().any(|warning| warning.contains(part));

    let quiet = io.deploy.apply(draft("a", "on-off", "io", 1)).await.unwrap();
    assert_eq!(quiet.warnings, Vec::<String>::new());
    let mut listens = draft("a", "on-off", "io", 1);
    listens.listens = vec!["line/1".to_owned()];
    let deaf = io.deploy.apply(listens.clone()).await.unwrap();
    let part = "loop a listens to line/1, and on-off@0.1.0 does not import net";
    assert!(said(&deaf.warnings, part), "{:?}", deaf.warnings);

    let mute = io.deploy.apply(draft("b", "floods-messages", "io", 2)).await.unwrap();
    assert!(!said(&mute.warnings, "net"), "{:?}", mute.warnings);
    let mut granted = draft("b", "floods-messages", "io", 2);
    granted.listens = vec!["line/1".to_owned()];
    let end = io.deploy.apply(granted).await.unwrap();
    assert!(!said(&end.warnings, "net"), "{:?}", end.warnings);

    // And a step limit with which probation cannot lead back within a cycle.
    listens.listens.clear();
    (listens.policy.step_limit_us, listens.policy.takeover_part) = (9_000, 0.08);
    (listens.period_ms, listens.policy.hedge_part) = (100.0, 0.02);
    let late = io.deploy.apply(listens).await.unwrap();
    assert!(
        said(&late.warnings, "in a later cycle, not in its own"),
        "{:?}",
        late.warnings
    );
    io.stop().await;
}
