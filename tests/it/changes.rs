//! What may change while a loop runs, what brings it back, and owners that die in the middle of it.

use std::collections::BTreeMap;

use bumpless_tests::{Api, Cell, CellOptions, Feed, Journal, first_order_loop};
use serde_json::{Value, json};

use crate::{number, one_writer, text, whole};

const LOOP: &str = "loop-0";
const POINT: &str = "plant.0.out";

/// A plant with slow processes and three controllers, with stock laws; the loop is on its way to rest.
fn running(count: usize, period_ms: f64) -> (Cell, Api, Feed) {
    let options = CellOptions::first_order(&format!("{{ count = {count}, tau_s = 1.0 }}"));
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid", "pidplus", "cascade"]).unwrap();
    api.apply(&first_order_loop(0, "pid", period_ms)).unwrap();
    let feed = api.live(&format!("?loops={LOOP}")).unwrap();
    feed.record_where("the loop at rest", settled).unwrap();
    (cell, api, feed)
}

fn settled(record: &Value) -> bool {
    (number(&record["measurement"]) - number(&record["setpoint"])).abs() < 0.2
}

fn event<'a>(record: &'a Value, kind: &str) -> Option<&'a Value> {
    record["events"]
        .as_array()
        .into_iter()
        .flatten()
        .find(|event| event["kind"] == kind)
}

/// How much farther the actuator stepped in the cycle of a switch, and in the three after it, than in the twenty before it.
fn kick(journal: &Journal, seq: u64) -> f64 {
    let greatest = |from: u64, to: u64| {
        let around: Vec<_> = journal.of(POINT).filter(|w| (from..=to).contains(&w.seq)).collect();
        assert!(around.len() > 3, "there is something to judge from {from} to {to}");
        let steps = around.windows(2).map(|pair| (pair[1].value - pair[0].value).abs());
        steps.fold(0.0, f64::max)
    };
    greatest(seq - 1, seq + 3) - greatest(seq - 21, seq - 1)
}

#[test]
fn structure_changes_while_the_loop_runs_each_as_one_revision_without_a_bump() {
    let (cell, api, feed) = running(2, 50.0);
    let revision = || whole(&api.loop_view(LOOP).unwrap()["revision"]);
    let mut expected = revision();
    let cascade = |period_ms: f64| {
        let mut draft = first_order_loop(0, "cascade", period_ms);
        // Other ports and parameters: the inner loop reads the other process, which stands still.
        draft["ports"]["inner-pv"] = json!("plant.1.pv");
        draft["parameters"] = json!({ "k": 0.01, "ti": 60.0, "inner-k": 0.01, "inner-ti": 60.0 });
        draft
    };
    let retuned = {
        let mut draft = cascade(50.0);
        draft["parameters"]["inner-ti"] = json!(30.0);
        draft
    };
    let rebound = {
        let mut draft = cascade(20.0);
        draft["ports"]["inner-pv"] = json!("plant.0.pv");
        draft["parameters"]["inner-ti"] = json!(30.0);
        draft
    };
    let steps = [
        ("another law with other ports and parameters", cascade(50.0)),
        ("another tuning", retuned.clone()),
        ("another period", {
            let mut draft = retuned;
            draft["period_ms"] = json!(20.0);
            draft
        }),
        // The other level is tens of per cent away: what the law remembers is of no use, and the output goes on all the same.
        ("another point at an input", rebound),
        ("back to one loop", first_order_loop(0, "pid", 50.0)),
    ];
    let mut switched = Vec::new();
    for (what, draft) in steps {
        let end = api.apply(&draft).unwrap_or_else(|error| panic!("{what}: {error}"));
        expected += 1;
        assert_eq!(
            (whole(&end["revision"]), revision()),
            (expected, expected),
            "{what}: {end}"
        );
        assert!(number(&end["hand_over"]["bump_percent"]) < 0.1, "{what}: {end}");
        let view = api.loop_view(LOOP).unwrap();
        assert_eq!(view["spec"]["ports"], draft["ports"], "{what}");
        assert_eq!(
            number(&view["spec"]["period_ms"]),
            number(&draft["period_ms"]),
            "{what}"
        );
        let record = feed.record_where(what, |r| whole(&r["revision"]) == expected).unwrap();
        assert!(event(&record, "revised").is_some(), "{what}: {record}");
        switched.push((what, whole(&record["seq"])));
        feed.record_where("some cycles more", |r| whole(&r["seq"]) > whole(&record["seq"]) + 25)
            .unwrap();
    }
    let period = api.loop_view(LOOP).unwrap();
    assert_eq!(period["past_revisions"].as_array().map(Vec::len), Some(5));
    let journal = cell.journal().unwrap();
    for (what, seq) in switched {
        let kick = kick(&journal, seq);
        assert!(kick < 0.1, "{what}: a step of {kick} % of span more than before");
    }

    // Another actuator, and its own measurement: it goes on from what that one holds, and the old one stays where it is.
    let mut elsewhere = first_order_loop(1, "pid", 50.0);
    elsewhere["name"] = json!(LOOP);
    let before = number(&api.point(POINT).unwrap()["value"]);
    let held = number(&api.point("plant.1.out").unwrap()["value"]);
    assert!((before - held).abs() > 10.0, "{before} and {held} are far apart");
    let end = api.apply(&elsewhere).unwrap();
    assert!(number(&end["hand_over"]["bump_percent"]) < 0.1, "{end}");
    let record = feed
        .record_where("the other actuator", |r| whole(&r["revision"]) == expected + 1)
        .unwrap();
    let first = number(&record["outputs"]["out"]);
    assert!((first - held).abs() < 0.1, "{first} where {held} was held");
    let left = number(&api.point(POINT).unwrap()["value"]);
    assert!(
        (left - before).abs() < 0.5,
        "the old actuator went from {before} to {left}"
    );
    one_writer(&cell.journal().unwrap());
}

#[test]
fn a_component_that_keeps_failing_gives_way_to_the_loops_fallback() {
    let (cell, api, feed) = running(1, 50.0);
    api.upload_guest("traps").unwrap();
    let mut draft = first_order_loop(0, "traps", 50.0);
    // Sound for as long as the probation lasts, and for a second after it.
    draft["parameters"] = json!({ "after": 40.0 });
    draft["policy"] = json!({ "probation_cycles": 20, "faults_tolerated": 3 });
    let mut wrong = draft.clone();
    wrong["fallback"] = json!("nobody");
    assert!(
        api.apply(&wrong)
            .unwrap_err()
            .to_string()
            .contains("there is no component")
    );
    wrong["fallback"] = json!("cascade");
    let refusal = api.apply(&wrong).unwrap_err().to_string();
    assert!(
        refusal.contains("cannot be the fallback") && refusal.contains("inner-pv"),
        "{refusal}"
    );
    wrong["fallback"] = json!("pid");
    wrong["fallback_parameters"] = json!({ "gain": 0.7 });
    let refusal = api.apply(&wrong).unwrap_err().to_string();
    assert!(
        refusal.contains("cannot be the fallback") && refusal.contains("gain"),
        "{refusal}"
    );
    draft["fallback"] = json!("pid");
    draft["fallback_parameters"] = json!({ "k": 0.7 });
    let failing = whole(&api.apply(&draft).unwrap()["revision"]);
    let held = feed
        .record_where("faults", |r| {
            whole(&r["revision"]) == failing && event(r, "policy-held").is_some()
        })
        .unwrap();
    let fallback = feed
        .record_where("the fallback", |r| whole(&r["revision"]) > failing)
        .unwrap();
    assert!(
        whole(&fallback["seq"]) > whole(&held["seq"]) + 3,
        "after more faults than the loop tolerates"
    );
    // The record is first; the loop's intent follows it.
    api.wait_for_loop(LOOP, "the fallback in force", |view| {
        text(&view["component"]).starts_with("pid@")
    })
    .unwrap();
    assert_eq!(api.loop_view(LOOP).unwrap()["spec"]["parameters"]["k"], 0.7);
    feed.record_where("good cycles again", |r| {
        whole(&r["revision"]) > failing && event(r, "faulted").is_none() && event(r, "revised").is_none()
    })
    .unwrap();
    assert!(
        api.delete("/v1/components/pid")
            .unwrap_err()
            .to_string()
            .contains("is used by")
    );
    // A person decides when the failed one comes back.
    let back = api.rollback(LOOP, None).unwrap();
    assert!(
        text(&api.loop_view(LOOP).unwrap()["component"]).starts_with("traps@"),
        "{back}"
    );
    one_writer(&cell.journal().unwrap());
}

#[test]
fn an_owner_may_die_in_any_phase_of_a_change() {
    let (mut cell, api, feed) = running(1, 20.0);
    for name in ["jumps", "traps"] {
        api.upload_guest(name).unwrap();
    }
    let owner = |api: &Api| text(&api.loop_view(LOOP).unwrap()["owner"]).to_owned();
    let mut killed = BTreeMap::new();
    let mut kill = |cell: &mut Cell, phase: &str, name: &str| {
        cell.host(name).unwrap().kill9();
        *killed.entry(phase.to_owned()).or_insert(0) += 1;
    };
    let revive = |cell: &mut Cell, name: &str| {
        cell.restart(name).unwrap();
        cell.wait_joined().unwrap();
        api.wait_for_loop(LOOP, "three members again", |view| {
            crate::names(&view["members"]).len() == 3
        })
        .unwrap();
    };

    // While a change is prepared and switched: the answer says one thing or the other, and the loop is what it says.
    for (number, component) in ["pidplus", "pid", "pidplus"].into_iter().enumerate() {
        let victim = owner(&api);
        let (there, asked) = (cell.plant.api(), component.to_owned());
        let change = std::thread::spawn(move || there.swap(LOOP, &asked));
        if number > 0 {
            // Later in its way: some cycles pass while it is prepared.
            for _ in 0..number {
                feed.record().unwrap();
            }
        }
        kill(&mut cell, "switch", &victim);
        let end = change.join().unwrap();
        let view = api
            .wait_for_loop(LOOP, "another owner", |view| {
                view["owner"] != victim.as_str() && view["owner"].is_string()
            })
            .unwrap();
        let runs = text(&view["component"]).starts_with(&format!("{component}@"));
        match end {
            Ok(_) => assert!(runs, "told to be in force: {view}"),
            // A refusal before the command, or one that was taken back, left nothing behind.
            Err(error) => assert!(!runs && view["pending_revision"].is_null(), "{error}: {view}"),
        }
        revive(&mut cell, &victim);
        api.swap(LOOP, component).unwrap();
    }

    // On probation: the next owner goes on with it, and its rollback is as good as the first one's.
    let mut draft = first_order_loop(0, "jumps", 20.0);
    draft["parameters"] = json!({ "after": 150.0, "by": 60.0 });
    draft["policy"] = json!({ "probation_cycles": 400, "probation_deviation_percent": 10.0 });
    let revision = whole(&api.apply(&draft).unwrap()["revision"]);
    let first = feed
        .record_where("the probation", |r| whole(&r["revision"]) == revision)
        .unwrap();
    let victim = text(&first["owner"]).to_owned();
    kill(&mut cell, "probation", &victim);
    feed.record_where("another owner on probation", |r| {
        r["owner"] != victim.as_str() && whole(&r["revision"]) == revision
    })
    .unwrap();
    let back = feed
        .record_where("the rollback", |r| event(r, "rolled-back").is_some())
        .unwrap();
    assert_ne!(text(&back["owner"]), victim);
    assert!(
        whole(&back["revision"]) < revision && event(&back, "policy-held").is_none(),
        "in that same cycle: {back}"
    );

    // Right after the rollback: the loop stays where it went back to.
    let victim_too = text(&back["owner"]).to_owned();
    kill(&mut cell, "rollback", &victim_too);
    let after = feed
        .record_where("yet another owner", |r| {
            r["owner"] != victim_too.as_str() && whole(&r["seq"]) > whole(&back["seq"])
        })
        .unwrap();
    assert_eq!(after["revision"], back["revision"]);
    for name in [victim, victim_too] {
        cell.restart(&name).unwrap();
    }
    cell.wait_joined().unwrap();
    assert_eq!(killed.values().sum::<i32>(), 5, "{killed:?}");
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    let highest = journal.of(POINT).map(|write| write.value).fold(f64::MIN, f64::max);
    assert!(
        highest < 60.0,
        "the throw of the misbehaving one never came through: {highest}"
    );
}
