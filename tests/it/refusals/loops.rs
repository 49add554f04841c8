//! Loops and changes that cannot be right, and components that go wrong in service.

use bumpless_tests::{Api, first_order_loop};
use serde_json::{Value, json};

use super::problem;
use crate::{number, settle, text, whole};

type Change = fn(&mut Value);

pub(super) fn bad_drafts(api: &Api) {
    let table: [(&str, Change, u16, &str); 25] = [
        ("unknown key", |d| d["speed"] = json!(1), 422, "unknown field `speed`"),
        (
            "missing key",
            |d| drop(d.as_object_mut().unwrap().remove("period_ms")),
            422,
            "period_ms",
        ),
        ("wrong kind", |d| d["period_ms"] = json!("fast"), 422, "fast"),
        (
            "unknown component",
            |d| d["component"] = json!("nobody"),
            404,
            "no component \"nobody\"",
        ),
        (
            "unknown version",
            |d| d["component"] = json!("pid@9.9.9"),
            404,
            "pid@9.9.9",
        ),
        (
            "unknown point",
            |d| d["ports"]["pv"] = json!("plant.9.pv"),
            404,
            "plant.9.pv",
        ),
        (
            "output taken",
            |d| d["ports"]["out"] = json!("plant.0.out"),
            409,
            "loop-0 writes point plant.0.out already",
        ),
        (
            "output is an input",
            |d| d["ports"]["out"] = json!("plant.1.pv"),
            422,
            "plant.1.pv is an input",
        ),
        (
            "points on two hosts",
            |d| d["ports"]["pv"] = json!("other.0.pv"),
            422,
            "different hosts",
        ),
        ("no ports", |d| d["ports"] = json!({}), 422, "no port is connected"),
        (
            "required port missing",
            |d| d["ports"] = json!({ "out": "plant.1.out" }),
            422,
            "port \"pv\"",
        ),
        (
            "unknown port",
            |d| d["ports"]["speed"] = json!("plant.1.pv"),
            422,
            "no port \"speed\"",
        ),
        (
            "bad point name",
            |d| d["ports"]["pv"] = json!("Plant 1"),
            422,
            "lower-case",
        ),
        ("period too short", |d| d["period_ms"] = json!(0.5), 422, "1 ms to 1 h"),
        (
            "period too long",
            |d| d["period_ms"] = json!(3_600_001),
            422,
            "1 ms to 1 h",
        ),
        (
            "parameter out of range",
            |d| d["parameters"]["k"] = json!(-1),
            422,
            "outside 0 to 1000000",
        ),
        (
            "unknown parameter",
            |d| d["parameters"]["speed"] = json!(1),
            422,
            "no parameter \"speed\"",
        ),
        (
            "setpoint out of range",
            |d| d["setpoint"] = json!(500),
            422,
            "the range must hold it",
        ),
        ("no replicas", |d| d["replicas"] = json!(0), 422, "1 to 16"),
        ("too many replicas", |d| d["replicas"] = json!(17), 422, "1 to 16"),
        (
            "unknown strategy",
            |d| d["strategy"] = json!("best"),
            422,
            "strategy \"best\" is unknown",
        ),
        (
            "takeover before hedge",
            |d| d["policy"] = json!({ "takeover_part": 0.1 }),
            422,
            "takeover_part",
        ),
        (
            "limits beyond the point",
            |d| d["limits"] = json!({ "out": { "low": -5, "high": 100, "safe": 0 } }),
            422,
            "beyond the range of point plant.1.out",
        ),
        (
            "limits out of order",
            |d| d["limits"] = json!({ "out": { "low": 50, "high": 20, "safe": 30 } }),
            422,
            "low <= safe <= high",
        ),
        (
            "the host's own name",
            |d| d["name"] = json!("call"),
            422,
            "\"call\" cannot be the name",
        ),
    ];
    for (case, change, status, part) in table {
        let mut draft = first_order_loop(1, "pid", 50.0);
        change(&mut draft);
        problem(case, api.apply(&draft), status, part);
    }
    let draft = first_order_loop(1, "pid", 50.0);
    problem(
        "two names",
        api.put("/v1/loops/loop-2", &draft),
        422,
        "use the same name in both",
    );
    problem("a bad name", api.put("/v1/loops/Loop", &draft), 422, "lower-case");
    // A change of a loop that runs is as strict, and the old revision stays.
    let mut running = first_order_loop(0, "pid", 50.0);
    running["parameters"]["k"] = json!(-1);
    problem("bad change by apply", api.apply(&running), 422, "outside 0 to 1000000");
}

pub(super) fn bad_changes(api: &Api) {
    let table: [(&str, &str, Value, u16, &str); 14] = [
        ("loop-9", "setpoint", json!({ "setpoint": 1 }), 404, "no loop"),
        (
            "loop-0",
            "setpoint",
            json!({ "setpoint": 500 }),
            409,
            "outside the loop's range 0 to 100",
        ),
        ("loop-0", "setpoint", json!({ "setpoint": "high" }), 422, "high"),
        ("loop-0", "setpoint", json!({}), 422, "setpoint"),
        (
            "loop-0",
            "mode",
            json!({ "mode": "fast" }),
            422,
            "unknown variant `fast`",
        ),
        ("loop-0", "output", json!({ "outputs": {} }), 422, "no output is named"),
        (
            "loop-0",
            "output",
            json!({ "outputs": { "speed": 1 } }),
            422,
            "no output port \"speed\"",
        ),
        (
            "loop-0",
            "swap",
            json!({ "component": "nobody" }),
            404,
            "no component \"nobody\"",
        ),
        (
            "loop-0",
            "set",
            json!({ "parameters": { "k": -1 } }),
            422,
            "outside 0 to 1000000",
        ),
        (
            "loop-0",
            "set",
            json!({ "parameters": { "speed": 1 } }),
            422,
            "no parameter \"speed\"",
        ),
        ("loop-0", "rollback", json!({ "revision": 99 }), 404, "no such revision"),
        ("loop-0", "rollback", json!({}), 404, "revision"),
        ("loop-0", "move", json!({ "host": "nobody" }), 409, "nobody"),
        ("loop-0", "move", json!({ "host": "No Body" }), 422, "lower-case"),
    ];
    for (name, what, body, status, part) in table {
        let case = format!("{name} {what} {body}");
        problem(&case, api.command(name, what, &body), status, part);
    }
    problem("delete nobody", api.delete("/v1/loops/loop-9"), 404, "no loop");
    problem(
        "delete a component in use",
        api.delete("/v1/components/pid"),
        409,
        "loop-0",
    );
    problem(
        "delete no component",
        api.delete("/v1/components/nobody"),
        404,
        "nobody",
    );
}

/// Components that are fine until they run: the loop stays with, or goes back to, the one that works, and the output of a
/// settled loop stays where it is.
pub(super) fn misdeeds(api: &Api) {
    const LOOP: &str = "loop-1";
    let mut draft = first_order_loop(1, "pid", 50.0);
    api.apply(&draft).unwrap();
    settle(api, LOOP, 1.0);
    let guests = [
        "traps",
        "returns-nan",
        "spins",
        "fails-start",
        "bad-state",
        "recurses",
        "grows-memory",
    ];
    for guest in guests {
        // Their trial would refuse them; what is told here is what happens if somebody insists.
        let taken = api.upload_guest(guest).unwrap();
        assert_eq!(taken["admission"]["verdict"], "forced", "{guest}");
        let before = api.loop_view(LOOP).unwrap();
        let done = api.swap(LOOP, guest);
        let then = with_pid_again(api, LOOP, guest);
        if let Err(error) = &done {
            assert_eq!(error.status(), 409, "{guest}: {error}");
            assert_eq!(then["revision"], before["revision"], "{guest}");
        }
    }
    // One that is good for a while, so that it comes into force, and traps in its probation.
    api.upload_guest("jumps").unwrap();
    let feed = api.live("?loops=loop-1").unwrap();
    draft["component"] = json!("jumps");
    draft["parameters"] = json!({ "after": 5 });
    let done = api.apply(&draft).unwrap();
    assert_eq!(done["hand_over"]["by"], "start", "{done}");
    let record = feed
        .record_where("the way back", |record| {
            let events = record["events"].as_array().unwrap();
            events.iter().any(|event| event["kind"] == "rolled-back")
        })
        .unwrap();
    assert!(record.to_string().contains("trap"), "it says why: {record}");
    with_pid_again(api, LOOP, "jumps");
    api.delete("/v1/loops/loop-1").unwrap();
}

fn with_pid_again(api: &Api, name: &str, guest: &str) -> Value {
    let then = api
        .wait_for_loop(name, &format!("pid after {guest}"), |view| {
            text(&view["component"]).starts_with("pid@") && view["pending_revision"].is_null()
        })
        .unwrap();
    let seq = whole(&then["seq"]);
    let later = api
        .wait_for_loop(name, &format!("cycles after {guest}"), |view| {
            view["seq"].as_u64() > Some(seq + 5)
        })
        .unwrap();
    let out = number(&later["outputs"]["out"]);
    assert!((out - 40.0).abs() < 4.0, "{guest} moved the output to {out}");
    then
}
