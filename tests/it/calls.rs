//! The cell as a control service: one step per request, the state going back and forth, as an orchestrator uses it.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use bumpless_isa::table::PV;
use bumpless_pid::Pid;
use bumpless_sdk::bench::Bench;
use bumpless_tests::{Api, Cell, CellOptions};
use serde_json::{Value, json};

use crate::{names, number, text};

/// Calls with each strategy.
const CALLS: u64 = 12;

fn request(seq: u64, strategy: &str) -> Value {
    json!({
        "inputs": { "pv": 42.0 },
        "setpoint": 50.0,
        "dt_ms": 100.0,
        "seq": seq,
        "strategy": strategy,
        "parameters": { "k": 2.5, "ti": 7.0, "td": 0.3 },
        "track": { "out": 33.0 },
    })
}

fn ready_everywhere(api: &Api) {
    api.wait_until("the component on all controllers", |api| {
        let ready = names(&api.get("/v1/components/pid").unwrap()["ready_on"]);
        if ["a", "b", "c"].iter().all(|host| ready.iter().any(|r| r == host)) {
            Ok(())
        } else {
            Err(ready)
        }
    })
    .unwrap();
}

#[test]
fn calls_give_the_numbers_of_the_law() {
    let mut cell = Cell::start(CellOptions::default()).unwrap();
    let api = cell.api_of("a").unwrap();
    api.upload_stock(&["pid"]).unwrap();
    ready_everywhere(&api);

    let mut native = Bench::<Pid>::start(&[("k", 2.5), ("ti", 7.0), ("td", 0.3)], &[33.0]).unwrap();
    native.set_setpoint(50.0);
    let mut call = request(1, "round-robin");
    for (seq, pv) in [(1, 42.0), (2, 43.5), (3, 44.0), (4, 47.25), (5, 51.0)] {
        call["seq"] = json!(seq);
        call["inputs"]["pv"] = json!(pv);
        let answer = api.call("pid", &call).unwrap();
        native.set(PV, pv);
        let wanted = native.step(0.1).unwrap()[0];
        let given = number(&answer["outputs"]["out"]);
        assert!(
            (given - wanted).abs() < 1e-12,
            "call {seq}: {given}, the law gives {wanted}"
        );
        assert!(
            STANDARD.decode(text(&answer["state"])).unwrap() == native.state(),
            "call {seq}: the state is the law's, byte for byte"
        );
        call["state"] = answer["state"].clone();
        call["track"]["out"] = answer["outputs"]["out"].clone();
    }

    strategies_are_honoured(&api);
    bad_calls_are_refused(&api);
    let again = api.call("pid", &request(1, "local")).unwrap();
    assert_eq!(again["host"], "a", "a bad call harms nobody");
}

fn strategies_are_honoured(api: &Api) {
    let hosts = |strategy: &str| -> Vec<String> {
        (0..CALLS)
            .map(|seq| text(&api.call("pid", &request(seq, strategy)).unwrap()["host"]))
            .collect()
    };
    let times = |turns: &[String], host: &str| turns.iter().filter(|turn| *turn == host).count();
    let turns = hosts("round-robin");
    assert!(
        ["a", "b", "c"].iter().all(|host| times(&turns, host) >= 2),
        "each has its turns: {turns:?}"
    );
    assert_eq!(hosts("local"), ["a"; CALLS as usize]);
    let sharded = hosts("shard");
    assert_eq!(
        times(&sharded, &sharded[0]),
        sharded.len(),
        "always the same: {sharded:?}"
    );
    let all = ["a", "b", "c", "plant"];
    for strategy in ["random", "cpu", "latency", "p2c"] {
        let given = hosts(strategy);
        assert!(
            given.iter().all(|host| all.contains(&host.as_str())),
            "{strategy}: {given:?}"
        );
    }
}

fn bad_calls_are_refused(api: &Api) {
    type Change = fn(&mut Value);
    let table: [(&str, Change, u16, &str); 11] = [
        ("pid", |c| c["state"] = json!("AAAA"), 409, "state"),
        ("pid", |c| c["state"] = json!("?"), 422, "no base64"),
        ("pid", |c| c["state"] = json!("A".repeat(88_000)), 422, "bytes"),
        ("nobody", |_| (), 404, "no component \"nobody\""),
        ("pid", |c| c["inputs"]["speed"] = json!(1), 422, "no input \"speed\""),
        ("pid", |c| c["track"]["speed"] = json!(1), 422, "no output \"speed\""),
        ("pid", |c| c["parameters"]["k"] = json!(-1), 422, "\"k\""),
        ("pid", |c| c["parameters"]["speed"] = json!(1), 422, "\"speed\""),
        ("pid", |c| c["dt_ms"] = json!(0), 422, "greater than 0"),
        (
            "pid",
            |c| c["strategy"] = json!("best"),
            422,
            "strategy \"best\" is unknown",
        ),
        ("pid", |c| c["speed"] = json!(1), 422, "unknown field `speed`"),
    ];
    for (component, change, status, part) in table {
        let mut call = request(1, "round-robin");
        change(&mut call);
        let error = api.call(component, &call).unwrap_err();
        assert_eq!(error.status(), status, "{error}");
        let body = error.to_string().replace("\\\"", "\"");
        assert!(body.contains(part), "{part:?} is missing in: {body}");
    }
}
