//! Looking back and trying candidates, over real loops: replays are equal, candidates are judged, shadows follow.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{CommandBody, LoopId, Mode, Record};
use bumpless_deploy::{
    Change, Deploy, Error, Upload,
    report::{ShadowView, Trial, TrialReport, Verdict},
};
use bumpless_store::Window;

use crate::{
    harness::{Cell, component, draft, id, until},
    real::{Real, host},
};

fn trial(component: &str, parameters: &[(&str, f64)]) -> Trial {
    Trial {
        component: component.to_owned(),
        parameters: parameters
            .iter()
            .map(|(name, value)| ((*name).to_owned(), *value))
            .collect(),
    }
}

async fn running(cell: &Cell, dir: &std::path::Path) -> Real {
    let real = host(cell, dir).await;
    for name in ["pid", "pidplus", "on-off"] {
        real.deploy.upload(component(name), "t", "").await.unwrap();
    }
    // Its trial shows what it is; it is taken in nevertheless.
    let force = Upload {
        by: "t".to_owned(),
        force: true,
        ..Upload::default()
    };
    real.deploy.take_in(component("guests/traps"), &force).await.unwrap();
    let mut first = draft("l", "pid", "io", 0);
    first.period_ms = 10.0;
    first.parameters = BTreeMap::from([("ti".to_owned(), 5.0), ("k".to_owned(), 0.8)]);
    real.deploy.apply(first).await.unwrap();
    real
}

fn last(deploy: &Deploy, id: &LoopId) -> Option<Arc<Record>> {
    deploy.loop_view(id).unwrap().last
}

/// Waits until so many more cycles were taken.
async fn cycles_pass(deploy: &Deploy, id: &LoopId, count: u64) {
    let from = until("a cycle runs", || last(deploy, id)).await.seq;
    until("cycles pass", || last(deploy, id).filter(|r| r.seq >= from + count)).await;
}

async fn backtest(deploy: &Deploy, id: &LoopId, trial: Trial, window: Window) -> TrialReport {
    deploy.backtest(id, trial, window).await.unwrap()
}

fn finite(report: &TrialReport) {
    assert!(report.points.len() <= bumpless_deploy::report::POINTS_MAX);
    let values = report.points.iter().flat_map(|p| p.recorded.iter().chain(&p.candidate));
    assert!(
        values
            .chain(report.points.iter().map(|p| &p.measurement))
            .all(|v| v.is_finite())
    );
    assert!(report.points.windows(2).all(|pair| pair[0].at_ns < pair[1].at_ns));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_recorded_can_be_repeated_to_the_bit() {
    let (cell, disk) = (Cell::new(), tempfile::tempdir().unwrap());
    let dir = disk.path().join("io");
    let real = running(&cell, &dir).await;
    let (deploy, l) = (&real.deploy, id("l"));
    cycles_pass(deploy, &l, 20).await;
    // Everything that a cycle may meet: a setpoint, manual and back, other parameters, another component.
    deploy.command(&l, None, CommandBody::Setpoint(60.0)).await.unwrap();
    deploy.command(&l, None, CommandBody::Mode(Mode::Manual)).await.unwrap();
    deploy.command(&l, None, CommandBody::Output(vec![40.0])).await.unwrap();
    cycles_pass(deploy, &l, 5).await;
    deploy
        .command(&l, None, CommandBody::Mode(Mode::Automatic))
        .await
        .unwrap();
    let change = Change {
        parameters: BTreeMap::from([("k".to_owned(), 0.5)]),
        strategy: None,
    };
    deploy.set(&l, change).await.unwrap();
    cycles_pass(deploy, &l, 20).await;
    deploy.swap(&l, "pidplus").await.unwrap();
    cycles_pass(deploy, &l, 20).await;

    let all = Window::Last(100_000);
    let report = deploy.replay(&l, all).await.unwrap();
    assert_eq!(report.first_difference, None, "{report:?}");
    assert!(report.compared > 60 && report.equal == report.compared, "{report:?}");
    let switches = report
        .skipped
        .iter()
        .find(|s| s.reason.contains("switch"))
        .expect("two switches");
    assert_eq!(switches.cycles, 2, "{report:?}");
    assert_eq!(report.skipped.len(), 1, "{report:?}");

    let records = deploy.cycles(&l, all, 1_000).await.unwrap();
    assert!(!records.more && records.unread == 0);
    assert_eq!(
        records.records.first().unwrap().after,
        (0, 0),
        "the very first cycle is there"
    );
    assert!(
        records
            .records
            .windows(2)
            .all(|pair| pair[1].after == pair[0].position())
    );
    let few = deploy.cycles(&l, all, 3).await.unwrap();
    assert_eq!((few.records.len(), few.more), (3, true));
    assert_eq!(few.records[..], records.records[..3]);

    // The same after a restart of the host, with what was written before it.
    let until_now = last(deploy, &l).unwrap();
    real.stop().await;
    let real = host(&cell, &dir).await;
    let deploy = &real.deploy;
    until("it goes on", || {
        last(deploy, &l).filter(|r| r.position() > until_now.position())
    })
    .await;
    let again = deploy.replay(&l, all).await.unwrap();
    assert!(
        again.first_difference.is_none() && again.compared > report.compared,
        "{again:?}"
    );
    assert_eq!(again.equal, again.compared);

    deploy.delete(&l).await.unwrap();
    assert_eq!(real.cycles.loops().unwrap(), [], "a deleted loop leaves nothing behind");
    assert!(matches!(deploy.replay(&l, all).await, Err(Error::NotFound(_))));
    real.stop().await;
}

/// Puts other records in the place of those that were recorded.
fn rewrite(real: &Real, l: &LoopId, records: &[Record]) {
    real.cycles.forget(l).unwrap();
    records
        .iter()
        .for_each(|record| real.cycles.offer(Arc::new(record.clone())));
    real.cycles.flush().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_tampered_with_is_found_and_gaps_are_gone_over() {
    let (cell, disk) = (Cell::new(), tempfile::tempdir().unwrap());
    let real = running(&cell, &disk.path().join("io")).await;
    let (deploy, l) = (&real.deploy, id("l"));
    cycles_pass(deploy, &l, 30).await;
    // From here on the loop has its next cycle in an hour, at a time of the hour that its name decides.
    let mut slow = draft("l", "pid", "io", 0);
    slow.period_ms = 3_600_000.0;
    slow.parameters = BTreeMap::from([("ti".to_owned(), 5.0), ("k".to_owned(), 0.8)]);
    deploy.apply(slow).await.unwrap();
    let all = Window::Last(100_000);
    let good = deploy.cycles(&l, all, 1_000).await.unwrap().records;
    assert!(good.len() > 20, "{}", good.len());
    let whole = deploy.replay(&l, all).await.unwrap();
    assert!(whole.first_difference.is_none() && whole.compared > 15, "{whole:?}");

    type Tamper = fn(&mut Record);
    let table: [(Tamper, &str, u64); 6] = [
        (|r| r.wanted[0] += 1e-12, "output out was", 1),
        // The step after it goes on from there, and comes out otherwise as well.
        (
            |r| {
                let mut bytes = r.state.to_vec();
                bytes[20] ^= 1;
                r.state = Arc::from(bytes);
            },
            "the state after it differs from byte 20 on",
            2,
        ),
        (
            |r| r.state = Arc::from(&r.state[..r.state.len() - 1]),
            "bytes, and has",
            2,
        ),
        (|r| r.setpoint += 1.0, "output out was", 1),
        (
            |r| {
                r.messages.push(bumpless_core::Message {
                    topic: "t".into(),
                    data: vec![1],
                });
            },
            "its messages differ",
            1,
        ),
        (
            |r| {
                r.log.push(bumpless_core::LogLine {
                    level: bumpless_core::LogLevel::Info,
                    text: "x".into(),
                });
            },
            "its log lines differ",
            1,
        ),
    ];
    for (tamper, part, differ) in table {
        let mut bad = good.clone();
        tamper(&mut bad[10]);
        rewrite(&real, &l, &bad);
        let report = deploy.replay(&l, all).await.unwrap();
        let found = report.first_difference.expect(part);
        assert_eq!(found.position, good[10].position(), "{part}");
        assert!(found.text.contains(part), "{part}: {}", found.text);
        assert_eq!(report.compared - report.equal, differ, "{part}");
        assert_eq!(report.compared, whole.compared);
    }

    // Three cycles are missing: one more is only gone on from.
    let mut holed = good.clone();
    holed.drain(8..11);
    rewrite(&real, &l, &holed);
    let report = deploy.replay(&l, all).await.unwrap();
    assert_eq!(
        (report.compared, report.equal),
        (whole.compared - 4, whole.compared - 4)
    );
    let gaps = report
        .skipped
        .iter()
        .find(|s| s.reason == "the record before it is missing");
    assert_eq!(gaps.map(|s| s.cycles), Some(1), "{report:?}");
    let plus = backtest(deploy, &l, trial("pidplus", &[]), all).await;
    assert_eq!((plus.anchored_anew, plus.faults), (1, 0), "{plus:?}");
    assert_eq!(
        plus.cycles as usize,
        holed.len() - 2,
        "the first, and the first after the gap, are only gone on from"
    );
    assert!(
        matches!(plus.verdict, Some(Verdict::Same | Verdict::Close)),
        "{}",
        plus.reason
    );
    real.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn candidates_are_judged_on_recorded_cycles() {
    let (cell, disk) = (Cell::new(), tempfile::tempdir().unwrap());
    let real = running(&cell, &disk.path().join("io")).await;
    let (deploy, l) = (&real.deploy, id("l"));
    cycles_pass(deploy, &l, 10).await;
    deploy.command(&l, None, CommandBody::Setpoint(65.0)).await.unwrap();
    cycles_pass(deploy, &l, 60).await;
    let spec = deploy.loop_view(&l).unwrap().spec;
    let window = Window::Last(1_000);

    let same = backtest(deploy, &l, trial("pid", &[]), window).await;
    assert_eq!(
        (same.verdict, same.taken_over_by.as_deref()),
        (Some(Verdict::Same), Some("same")),
        "{same:?}"
    );
    assert!(same.cycles > 30 && same.cycles < 1_000, "{}", same.cycles);
    assert_eq!((same.compared, same.equal), (same.cycles, same.cycles));
    assert_eq!((same.bump_percent, same.outputs[0].max_percent), (Some(0.0), 0.0));
    assert_eq!(same.outputs[0].recorded_travel, same.outputs[0].candidate_travel);
    assert!(
        same.indices.iae > 0.0 && same.indices.duration_s > 0.5,
        "{:?}",
        same.indices
    );
    assert!(
        same.steps.p50_us > 0.0 && same.steps.p50_us <= same.steps.p99_us && same.steps.p99_us <= same.steps.worst_us
    );
    assert_eq!(same.points.len() as u64, same.cycles);
    finite(&same);

    let plus = backtest(deploy, &l, trial("pidplus", &[]), window).await;
    assert!(matches!(plus.verdict, Some(Verdict::Same | Verdict::Close)), "{plus:?}");
    assert_eq!(plus.taken_over_by.as_deref(), Some("migrate"));
    assert!(plus.bump_percent.is_some_and(|bump| bump < 1.0), "{plus:?}");

    let keen = backtest(deploy, &l, trial("pid", &[("k", 8.0)]), window).await;
    assert_eq!(keen.verdict, Some(Verdict::Differs), "{keen:?}");
    assert!(keen.outputs[0].max_percent > keen.bump_limit_percent && keen.outputs[0].rms_percent > 0.0);
    assert!(keen.outputs[0].mean_percent <= keen.outputs[0].rms_percent);
    assert!(keen.reason.starts_with("out is up to"), "{}", keen.reason);
    finite(&keen);

    let traps = backtest(deploy, &l, trial("traps", &[]), window).await;
    assert_eq!(traps.verdict, Some(Verdict::Fails), "{traps:?}");
    assert!(traps.faults > 0 && traps.reason.contains("trapped"), "{}", traps.reason);

    let words = |error: Error| error.to_string();
    let bad = deploy
        .backtest(&l, trial("pid", &[("gain", 1.0)]), window)
        .await
        .map_err(words);
    assert!(
        bad.as_ref().is_err_and(|text| text.contains("no parameter \"gain\"")),
        "{bad:?}"
    );
    let bad = deploy.backtest(&l, trial("nothing", &[]), window).await;
    assert!(matches!(bad, Err(Error::NotFound(_))), "{bad:?}");
    let bad = deploy.backtest(&l, trial("pid", &[]), Window::Last(0)).await;
    assert!(matches!(bad, Err(Error::Invalid(_))), "{bad:?}");
    assert_eq!(deploy.loop_view(&l).unwrap().spec, spec, "nothing of the loop changed");
    real.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_shadow_follows_until_its_end() {
    let (cell, disk) = (Cell::new(), tempfile::tempdir().unwrap());
    let real = running(&cell, &disk.path().join("io")).await;
    let (deploy, l) = (&real.deploy, id("l"));
    cycles_pass(deploy, &l, 5).await;
    let started = deploy.start_shadow(&l, trial("pid", &[]), 30).await.unwrap();
    assert_eq!((started.id, started.cycles_wanted, started.ended), (1, 30, None));
    let done = ended(deploy, &l, 1).await;
    assert!(done.complete && done.missed == 0, "{done:?}");
    assert_eq!(
        (done.report.cycles, done.report.verdict),
        (30, Some(Verdict::Same)),
        "{done:?}"
    );
    assert_eq!(done.report.points.len(), 30);
    let listed = deploy.shadows(&l).await.unwrap();
    assert!(listed.len() == 1 && listed[0].report.points.is_empty() && listed[0].complete);

    // Others: one is stopped, one ends with the component that it followed.
    let stopped = deploy
        .start_shadow(&l, trial("pidplus", &[]), 1_000_000)
        .await
        .unwrap()
        .id;
    let swapped = deploy
        .start_shadow(&l, trial("pidplus", &[]), 1_000_000)
        .await
        .unwrap()
        .id;
    for _ in 0..2 {
        deploy.start_shadow(&l, trial("pidplus", &[]), 1_000_000).await.unwrap();
    }
    let error = deploy
        .start_shadow(&l, trial("pidplus", &[]), 5)
        .await
        .expect_err("too many");
    assert!(
        matches!(&error, Error::Busy(w) if w.reason.contains("4 shadows")),
        "{error:?}"
    );
    let view = deploy.stop_shadow(&l, stopped).await.unwrap();
    assert_eq!((view.ended.as_deref(), view.complete), (Some("it was stopped"), false));
    deploy.swap(&l, "pidplus").await.unwrap();
    let view = ended(deploy, &l, swapped).await;
    assert_eq!(view.ended.as_deref(), Some("its loop went on with another component"));
    // What has ended is forgotten when it is stopped again.
    deploy.stop_shadow(&l, stopped).await.unwrap();
    assert!(matches!(deploy.show_shadow(&l, stopped).await, Err(Error::NotFound(_))));
    for cycles in [0, 1_000_001] {
        let error = deploy
            .start_shadow(&l, trial("pid", &[]), cycles)
            .await
            .expect_err("out of range");
        assert!(matches!(error, Error::Invalid(_)), "{error:?}");
    }
    deploy.delete(&l).await.unwrap();
    real.stop().await;
}

async fn ended(deploy: &Deploy, l: &LoopId, shadow: u64) -> ShadowView {
    loop {
        let view = deploy.show_shadow(l, shadow).await.unwrap();
        if view.ended.is_some() {
            return view;
        }
        cycles_pass(deploy, l, 1).await;
    }
}
