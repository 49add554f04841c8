//! What a loop did can be repeated to the bit, and what another component would do is known before it is swapped in.

use std::time::Duration;

use bumpless_tests::{Api, Cell, CellOptions, first_order_loop, wait_until};
use serde_json::{Value, json};

use crate::{number, one_writer, text, whole};

const LOOP: &str = "loop-0";

fn ask(api: &Api, what: &str, body: &Value) -> Value {
    api.post(&format!("/v1/loops/{LOOP}/{what}"), body).unwrap()
}

/// Waits for so many records more.
fn cycles_pass(api: &Api, count: u64) {
    // Before its first record it has none.
    let seen = api.loop_view(LOOP).unwrap()["seq"].as_u64().unwrap_or(0);
    api.wait_for_loop(LOOP, "further cycles", |view| {
        view["seq"].as_u64() >= Some(seen + count)
    })
    .unwrap();
}

fn shadow(api: &Api, id: u64) -> Value {
    api.get(&format!("/v1/loops/{LOOP}/shadows/{id}")).unwrap()
}

#[test]
fn replays_are_equal_candidates_are_judged_and_a_shadow_outlives_the_owner() {
    let fopdt = "{ count = 1, gain = 1.0, tau_s = 2.0, dead_time_s = 0.1, noise = 0.05 }";
    let mut cell = Cell::start(CellOptions::first_order(fopdt)).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid", "pidplus"]).unwrap();
    let mut draft = first_order_loop(0, "pid", 20.0);
    draft["parameters"] = json!({ "k": 0.8, "ti": 2.0 });
    api.apply(&draft).unwrap();
    api.wait_for_loop(LOOP, "a first cycle", |view| view["seq"].is_number())
        .unwrap();
    cycles_pass(&api, 50);
    api.setpoint(LOOP, 60.0).unwrap();
    cycles_pass(&api, 100);

    // Steps of three hosts, with an owner that changes while a shadow follows.
    let asked = json!({ "component": "pidplus", "cycles": 300 });
    let started = ask(&api, "shadows", &asked);
    let id = whole(&started["id"]);
    assert!(
        started["ended"].is_null() && started["cycles_wanted"] == 300,
        "{started}"
    );
    let owner = text(&api.loop_view(LOOP).unwrap()["owner"]);
    cell.host(&owner).unwrap().kill9();
    // The host that is asked may be the one that died.
    let api = cell.plant.api();
    let end = wait_until("the shadow's end", Duration::from_secs(60), || {
        let now = shadow(&api, id);
        if now["ended"].is_null() {
            Err(now["report"]["cycles"].clone())
        } else {
            Ok(now)
        }
    })
    .unwrap();
    assert_eq!(
        (&end["complete"], &end["report"]["cycles"]),
        (&json!(true), &json!(300)),
        "{}",
        end["ended"]
    );
    assert_eq!(
        (&end["report"]["faults"], &end["report"]["taken_over_by"]),
        (&json!(0), &json!("migrate")),
        "{}",
        end["report"]["first_fault"]
    );
    let after = api
        .wait_for_loop(LOOP, "another owner", |view| view["owner"] != json!(owner))
        .unwrap();
    assert_ne!(after["owner"], json!(owner));

    // All of it again, through any host: equal to the last bit, whoever owned and stepped.
    let other = cell
        .controllers
        .iter()
        .find(|host| host.name != owner)
        .expect("another host");
    let replay = ask(&other.api(), "replay", &json!({ "last": "100000" }));
    assert!(replay["first_difference"].is_null(), "{replay}");
    assert!(
        whole(&replay["compared"]) > 300 && replay["compared"] == replay["equal"],
        "{replay}"
    );

    candidates(&api);
    records(&api);
    shell(&cell);
    assert_eq!(
        api.loop_view(LOOP).unwrap()["revision"],
        1,
        "nothing of the loop has changed"
    );
    one_writer(&cell.journal().unwrap());
}

fn candidates(api: &Api) {
    let backtest = |component: &str, parameters: Value| {
        let body = json!({ "component": component, "parameters": parameters, "last": "100000" });
        ask(api, "backtest", &body)
    };
    let same = backtest("pid", json!({}));
    assert_eq!(
        (&same["verdict"], &same["equal"]),
        (&json!("same"), &same["compared"]),
        "{}",
        same["reason"]
    );
    let plus = backtest("pidplus", json!({}));
    let verdict = text(&plus["verdict"]);
    assert!(verdict == "same" || verdict == "close", "{verdict}: {}", plus["reason"]);
    let keen = backtest("pid", json!({ "k": 8.0 }));
    assert_eq!(keen["verdict"], "differs", "{}", keen["reason"]);
    let output = &keen["outputs"][0];
    assert!(
        number(&output["max_percent"]) > number(&keen["bump_limit_percent"]),
        "{output}"
    );
    assert!(
        number(&output["candidate_travel"]) > number(&output["recorded_travel"]),
        "{output}"
    );
    assert!(number(&keen["indices"]["iae"]) > 0.0 && number(&keen["steps"]["p50_us"]) > 0.0);
    assert!(keen["points"].as_array().is_some_and(|points| points.len() > 300));
    let problem = api
        .post(
            &format!("/v1/loops/{LOOP}/backtest"),
            &json!({ "component": "pid", "parameters": { "gain": 1 } }),
        )
        .unwrap_err();
    assert_eq!(problem.status(), 422, "{problem}");
}

fn records(api: &Api) {
    let found = api.get(&format!("/v1/loops/{LOOP}/cycles?last=50&state=true")).unwrap();
    let records = found["records"].as_array().unwrap();
    assert_eq!(
        (records.len(), &found["more"], &found["unread"]),
        (50, &json!(false), &json!(0))
    );
    assert!(
        records
            .windows(2)
            .all(|pair| pair[0]["seq"].as_u64() < pair[1]["seq"].as_u64())
    );
    assert!(
        records
            .iter()
            .all(|record| record["state"].is_string() && record["outputs"]["out"].is_number())
    );
}

fn shell(cell: &Cell) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("curves.svg");
    let path = file.display().to_string();
    let binary = bumpless_tests::Binary::find().unwrap();
    let run = |words: &[&str]| {
        let output = binary
            .command()
            .args(words)
            .args(["--api", cell.plant.api().base()])
            .output()
            .unwrap();
        assert!(
            output.status.success(),
            "{words:?}: {}",
            String::from_utf8_lossy(&output.stderr)
        );
        String::from_utf8(output.stdout).unwrap()
    };
    let replay = run(&["loop", "replay", LOOP, "--last", "2s"]);
    assert!(replay.contains("came out equal to the last bit"), "{replay}");
    let backtest = run(&[
        "loop",
        "backtest",
        LOOP,
        "pid",
        "-p",
        "k=8",
        "-p",
        "action=reverse",
        "--last",
        "200",
        "--plot",
        &path,
    ]);
    assert!(
        backtest.contains("pid@") && backtest.contains("IAE") && backtest.contains("curves.svg"),
        "{backtest}"
    );
    assert!(std::fs::read_to_string(&file).unwrap().contains("candidate"));
    let shadow = run(&["loop", "shadow", LOOP, "pid", "--cycles", "20", "--wait"]);
    assert!(
        shadow.contains("20 of 20 cycles") && shadow.contains(": same:"),
        "{shadow}"
    );
    let shadows = run(&["loop", "shadows", LOOP]);
    assert!(
        shadows.contains("pidplus@") && shadows.contains("it saw all its cycles"),
        "{shadows}"
    );
    let cycles = run(&["loop", "cycles", LOOP, "--last", "5"]);
    assert_eq!(cycles.lines().count(), 6, "{cycles}");
}
