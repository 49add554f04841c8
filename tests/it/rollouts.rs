//! One component for many loops: a good one reaches all of them, a bad one stops at the first.

use std::{process::Output, time::Duration};

use bumpless_tests::{Api, Binary, Cell, CellOptions, first_order_loop, wait_until};
use serde_json::{Value, json};

use crate::{number, one_writer, text, whole};

const LOOPS: [&str; 6] = ["loop-0", "loop-1", "loop-2", "loop-3", "loop-4", "loop-5"];

fn rollout(api: &Api, id: &str) -> Result<Value, bumpless_tests::Error> {
    api.get(&format!("/v1/rollouts/{id}"))
}

fn begin(api: &Api, body: &Value) -> String {
    text(&api.post("/v1/rollouts", body).unwrap()["id"])
}

/// How far each loop is.
fn stages(rollout: &Value) -> Vec<String> {
    rollout["loops"]
        .as_array()
        .unwrap()
        .iter()
        .map(|one| text(&one["stage"]))
        .collect()
}

/// Waits until the rollout is as wanted.
fn until(api: &Api, id: &str, what: &str, is: impl Fn(&Value) -> bool) -> Value {
    wait_until(what, Duration::from_secs(90), || match rollout(api, id) {
        Ok(now) if is(&now) => Ok(now),
        Ok(now) => Err(format!("{} {:?}", now["failure"], stages(&now))),
        Err(error) => Err(error.to_string()),
    })
    .unwrap()
}

fn ended(rollout: &Value) -> bool {
    rollout["ended_at_unix_ms"].is_number()
}

fn run(api: &Api, words: &[&str]) -> Output {
    let binary = Binary::find().unwrap();
    binary
        .command()
        .args(words)
        .args(["--api", api.base()])
        .output()
        .unwrap()
}

fn components(api: &Api) -> Vec<String> {
    LOOPS
        .map(|name| text(&api.loop_view(name).unwrap()["component"]))
        .to_vec()
}

/// The revision in force and the past ones, of each loop.
fn revisions(api: &Api) -> Vec<(Value, Value)> {
    let of = |name: &&str| {
        let view = api.loop_view(name).unwrap();
        (view["revision"].clone(), view["past_revisions"].clone())
    };
    LOOPS.iter().map(of).collect()
}

#[test]
fn a_good_component_reaches_all_loops_and_a_bad_one_stops_at_the_first() {
    let fopdt = "{ count = 6, tau_s = 1.0, dead_time_s = 0.05, noise = 0.2 }";
    let mut cell = Cell::start(CellOptions::first_order(fopdt).controllers(2)).unwrap();
    let api = cell.plant.api();
    api.upload_stock(&["pid", "pidplus"]).unwrap();
    api.upload_guest("jumps").unwrap();
    for n in 0..LOOPS.len() {
        api.apply(&first_order_loop(n, "pid", 20.0)).unwrap();
    }
    for name in LOOPS {
        api.wait_for_loop(name, "rest", |view| {
            let error = view["measurement"].as_f64().zip(view["setpoint"].as_f64());
            error.is_some_and(|(measurement, setpoint)| (measurement - setpoint).abs() < 2.0)
        })
        .unwrap();
    }
    reaches_all(&mut cell, &api);
    stops_at_the_first(&api);
    goes_back(&api);
    one_writer(&cell.journal().unwrap());
}

/// Asked of a host that dies on the way: it goes on when it is back, and any host tells of it.
fn reaches_all(cell: &mut Cell, api: &Api) {
    let asked = json!({ "component": "pidplus", "loops": ["loop-3"], "all_of": "pid", "cycles": 40, "factor": 5, "at_once": 2 });
    let id = begin(&cell.api_of("a").unwrap(), &asked);
    assert!(id.starts_with("a."), "{id}");
    until(api, &id, "the canary", |now| whole(&now["done"]) > 0);
    cell.host("a").unwrap().kill9();
    cell.restart("a").unwrap();
    cell.wait_joined().unwrap();
    let end = until(api, &id, "its end", ended);
    assert_eq!(
        (&end["state"], &end["failure"]),
        (&json!("done"), &Value::Null),
        "{end}"
    );
    assert_eq!(
        (&end["loops"][0]["loop"], &end["loops"][1]["loop"], &end["total"]),
        (&json!("loop-3"), &json!("loop-0"), &json!(6))
    );
    for one in end["loops"].as_array().unwrap() {
        // A change that met the dying host may have been taken back and asked for again, under a number of its own.
        assert!(one["stage"] == "done" && whole(&one["revision"]) >= 2, "{one}");
        assert!(number(&one["error_before"]) > 0.0, "{one}");
    }
    assert!(
        components(api)
            .iter()
            .all(|component| component.starts_with("pidplus@"))
    );
}

/// It traps after ten good steps, in the probation; another one after it.
fn stops_at_the_first(api: &Api) {
    let before = revisions(api);
    for (after, fault) in [("10", "trapped"), ("40", "trapped")] {
        let mut words = vec!["rollout", "start", "jumps"];
        words.extend(LOOPS);
        let parameter = format!("after={after}");
        words.extend(["-p", &parameter, "--cycles", "60", "--factor", "5", "--wait"]);
        let output = run(api, &words);
        let (told, error) = (
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr),
        );
        assert_eq!(output.status.code(), Some(3), "{told}{error}");
        assert!(error.contains("loop-0: ") && error.contains(fault), "{error}");
        assert!(
            told.contains("rolled back") && told.contains("0 of 6 loops done"),
            "{told}"
        );
        assert!(
            components(api)
                .iter()
                .all(|component| component.starts_with("pidplus@"))
        );
    }
    assert_eq!(&revisions(api)[1..], &before[1..], "five loops never saw it");
    let list = String::from_utf8(run(api, &["rollout", "list"]).stdout).unwrap();
    assert_eq!(list.matches("failed").count(), 2, "{list}");
    assert!(list.contains("a.1") && list.contains("plant.2"), "{list}");
}

/// A loop that somebody changes meanwhile is a failure, and here one that brings all others back.
fn goes_back(api: &Api) {
    let loops = ["loop-1", "loop-2", "loop-5"];
    let asked = json!({ "component": "pid", "loops": loops, "cycles": 40, "factor": 5, "on_failure": "back" });
    let id = begin(api, &asked);
    let taken = api.post("/v1/rollouts", &asked).unwrap_err();
    assert_eq!(taken.status(), 409, "{taken}");
    // Before its turn: the canary was not even seen for as long as it must be.
    api.strategy("loop-5", "p2c").unwrap();
    let end = until(api, &id, "its end", ended);
    assert_eq!(
        (&end["state"], stages(&end)),
        (
            &json!("failed"),
            ["rolled-back", "rolled-back", "refused"].map(str::to_owned).to_vec()
        ),
        "{end}"
    );
    assert!(
        text(&end["failure"]).starts_with("loop-5: ") && text(&end["failure"]).contains("meanwhile: revision"),
        "{end}"
    );
    assert!(
        components(api)
            .iter()
            .all(|component| component.starts_with("pidplus@"))
    );

    let second = begin(
        api,
        &json!({ "component": "pid", "loops": ["loop-4"], "cycles": 10000 }),
    );
    let output = run(api, &["rollout", "stop", &second]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let shown: Value = serde_json::from_slice(&run(api, &["rollout", "show", &second, "--json"]).stdout).unwrap();
    assert_eq!(
        (&shown["state"], stages(&shown)),
        (&json!("stopped"), vec!["waiting".to_owned()]),
        "{shown}"
    );
}
