//! The audit trail over real processes: every way in leaves its entry, the chain survives kill -9, and tampering is found.

use std::{fs, io::Write as _};

use bumpless_tests::{Api, Cell, CellOptions, first_order_loop};
use serde_json::{Value, json};

use crate::text;

const LOOP: &str = "loop-0";

/// Entries that a query finds, newest first.
fn entries(api: &Api, query: &str) -> Vec<Value> {
    let list = api.get(&format!("/v1/audit?limit=1000{query}")).unwrap();
    list["entries"].as_array().cloned().unwrap_or_default()
}

fn cell() -> Cell {
    let cell = Cell::start(CellOptions::first_order("{ count = 3, tau_s = 0.5 }")).unwrap();
    let api = cell.plant.api();
    api.upload_stock(&["pid", "pidplus", "on-off"]).unwrap();
    api.apply(&first_order_loop(0, "pid", 50.0)).unwrap();
    // Before its first cycle nothing can be told of before.
    api.wait_for_loop(LOOP, "a cycle", |view| view["seq"].is_u64()).unwrap();
    cell
}

#[test]
fn every_kind_of_change_leaves_its_entry() {
    let cell = cell();
    let api = cell.plant.api();
    let loop_path = format!("/v1/loops/{LOOP}");
    let alarm = format!("{loop_path}/alarms/high");
    let point = text(
        &api.get("/v1/points").unwrap()["points"]
            .as_array()
            .unwrap()
            .iter()
            .find(|p| p["written_by"].is_null() && p["writable"] == true)
            .unwrap()["name"],
    );
    let member = text(&api.loop_view(LOOP).unwrap()["members"][0]);
    // Method, path, body, what the entry says, and whether it is done.
    let table: Vec<(&str, String, Value, &str, bool)> = vec![
        (
            "POST",
            format!("{loop_path}/setpoint"),
            json!({ "setpoint": 42.0 }),
            "loop.setpoint",
            true,
        ),
        (
            "POST",
            format!("{loop_path}/setpoint"),
            json!({ "setpoint": 1e9 }),
            "loop.setpoint",
            false,
        ),
        (
            "POST",
            format!("{loop_path}/mode"),
            json!({ "mode": "manual" }),
            "loop.mode",
            true,
        ),
        (
            "POST",
            format!("{loop_path}/output"),
            json!({ "outputs": { "out": 11.0 } }),
            "loop.output",
            true,
        ),
        (
            "POST",
            format!("{loop_path}/mode"),
            json!({ "mode": "automatic" }),
            "loop.mode",
            true,
        ),
        (
            "POST",
            format!("{loop_path}/set"),
            json!({ "parameters": { "ti": 9.5 } }),
            "loop.set",
            true,
        ),
        (
            "POST",
            format!("{loop_path}/set"),
            json!({ "parameters": { "nonsense": 1 } }),
            "loop.set",
            false,
        ),
        (
            "POST",
            format!("{loop_path}/swap"),
            json!({ "component": "pidplus" }),
            "loop.swap",
            true,
        ),
        (
            "POST",
            format!("{loop_path}/rollback"),
            json!({}),
            "loop.rollback",
            true,
        ),
        (
            "POST",
            format!("{loop_path}/move"),
            json!({ "host": "nobody" }),
            "loop.move",
            false,
        ),
        (
            "POST",
            format!("{loop_path}/move"),
            json!({ "host": member }),
            "loop.move",
            true,
        ),
        (
            "PUT",
            alarm.clone(),
            json!({ "kind": "hi", "limit": 1e6 }),
            "alarm.define",
            true,
        ),
        (
            "POST",
            alarm.clone(),
            json!({ "act": "shelve", "seconds": 60, "reason": "x", "by": "bob" }),
            "alarm.shelve",
            true,
        ),
        (
            "POST",
            alarm.clone(),
            json!({ "act": "unshelve" }),
            "alarm.unshelve",
            true,
        ),
        (
            "POST",
            alarm.clone(),
            json!({ "act": "take-out", "reason": "x" }),
            "alarm.take-out",
            true,
        ),
        (
            "POST",
            alarm.clone(),
            json!({ "act": "put-back" }),
            "alarm.put-back",
            true,
        ),
        (
            "POST",
            alarm.clone(),
            json!({ "act": "acknowledge" }),
            "alarm.acknowledge",
            false,
        ),
        ("POST", alarm.clone(), json!({ "act": "reset" }), "alarm.reset", false),
        ("DELETE", alarm, Value::Null, "alarm.remove", true),
        (
            "POST",
            format!("/v1/points/{point}/write"),
            json!({ "value": 1.0, "by": "bob" }),
            "point.write",
            true,
        ),
        (
            "POST",
            format!("/v1/points/{point}/force"),
            json!({ "value": 2.0, "seconds": 60, "by": "bob", "why": "x" }),
            "point.force",
            true,
        ),
        (
            "POST",
            format!("/v1/points/{point}/unforce"),
            json!({ "by": "bob" }),
            "point.unforce",
            true,
        ),
        (
            "POST",
            "/v1/jobs".to_owned(),
            json!({ "bus": "nothing", "name": "x", "by": "bob" }),
            "job.start",
            false,
        ),
        (
            "POST",
            "/v1/jobs/plant.1/cancel".to_owned(),
            json!({ "by": "bob" }),
            "job.cancel",
            false,
        ),
        (
            "PATCH",
            "/v1/components/on-off".to_owned(),
            json!({ "labels": { "stage": "pilot" } }),
            "component.relabel",
            true,
        ),
        (
            "DELETE",
            "/v1/components/pid".to_owned(),
            Value::Null,
            "component.remove",
            false,
        ),
        (
            "DELETE",
            "/v1/components/on-off".to_owned(),
            Value::Null,
            "component.remove",
            true,
        ),
        (
            "POST",
            "/v1/rollouts".to_owned(),
            json!({ "component": "nothing", "loops": [LOOP] }),
            "rollout.start",
            false,
        ),
        (
            "POST",
            "/v1/rollouts/plant.9/stop".to_owned(),
            json!({}),
            "rollout.stop",
            false,
        ),
        ("POST", "/v1/hosts/a/drain".to_owned(), json!({}), "host.drain", true),
        (
            "POST",
            "/v1/hosts/a/undrain".to_owned(),
            json!({}),
            "host.undrain",
            true,
        ),
        ("PUT", loop_path.clone(), json!({}), "", false),
        ("DELETE", loop_path, Value::Null, "loop.delete", true),
    ];
    for (method, path, body, what, done) in table {
        let bytes = if body.is_null() {
            String::new()
        } else {
            body.to_string()
        };
        let headers = [("content-type", "application/json"), ("x-by", "ann")];
        let answer = api.send(method, &path, &headers, bytes.as_bytes()).unwrap();
        assert_eq!(answer.ok(), done, "{method} {path}: {}", answer.text());
        if what.is_empty() {
            // What is no request at all never was a change.
            continue;
        }
        let newest = entries(&api, &format!("&what={what}")).into_iter().next();
        let entry = newest.unwrap_or_else(|| panic!("{method} {path} has no entry"));
        assert_eq!(
            (entry["outcome"] == "done", &entry["via"]),
            (done, &json!("api")),
            "{entry}"
        );
        let by = if body["by"] == "bob" { "bob" } else { "ann" };
        assert_eq!(entry["by"], by, "{entry}");
        assert!(text(&entry["from"]).starts_with("127.0.0.1:"), "{entry}");
        assert_eq!(text(&entry["reason"]).is_empty(), done, "{entry}");
    }
    for (what, field, before, after) in [
        ("loop.setpoint", "setpoint", json!(40.0), json!(42.0)),
        ("loop.set", "parameters.ti", Value::Null, json!(9.5)),
        ("loop.mode", "mode", json!("manual"), json!("automatic")),
        ("loop.swap", "component", json!("pid@"), json!("pidplus@")),
        ("component.relabel", "labels.stage", Value::Null, json!("pilot")),
        ("host.undrain", "draining", json!(true), json!(false)),
    ] {
        let entry = entries(&api, &format!("&what={what}&outcome=done")).remove(0);
        let changes = entry["changes"].as_array().cloned().unwrap_or_default();
        let change = changes.iter().find(|change| change["field"] == field);
        let change = change.unwrap_or_else(|| panic!("{what} does not tell of {field}: {entry}"));
        let like = |is: &Value, wanted: &Value| match wanted.as_str() {
            Some(part) => is.as_str().is_some_and(|is| is.starts_with(part)),
            None => is == wanted || wanted.is_null(),
        };
        assert!(
            like(&change["before"], &before) && like(&change["after"], &after),
            "{what}: {change}"
        );
    }
    let names: Vec<String> = entries(&api, "").iter().map(|entry| text(&entry["what"])).collect();
    assert!(
        names.iter().any(|name| name == "loop.apply") && names.iter().any(|name| name == "component.upload"),
        "{names:?}"
    );
    let verdict = api.get("/v1/audit/verify").unwrap();
    assert_eq!(verdict["good"], true, "{verdict}");
    assert_eq!(verdict["chains"].as_array().map(Vec::len), Some(4), "{verdict}");
}

#[test]
fn a_trail_outlives_its_host_and_what_is_touched_is_named() {
    let mut cell = cell();
    let api = cell.plant.api();
    for setpoint in [41.0, 42.0, 43.0] {
        api.setpoint(LOOP, setpoint).unwrap();
    }
    cell.plant.kill9();
    let path = cell.plant.data().join("audit/000000000001.jsonl");
    // As a power cut leaves it.
    fs::OpenOptions::new()
        .append(true)
        .open(&path)
        .unwrap()
        .write_all(b"{\"host\":\"pla")
        .unwrap();
    cell.restart("plant").unwrap();
    let api = cell.plant.api();
    let opened = api.wait_until("the trail is opened", |api| -> Result<Value, String> {
        let found = entries(api, "&what=trail.opened");
        found
            .into_iter()
            .find(|entry| entry["host"] == "plant" && entry["asked"]["cut_bytes"] != 0)
            .ok_or_else(|| "not yet".to_owned())
    });
    assert_eq!(opened.unwrap()["asked"]["cut_bytes"], 12);
    assert_eq!(entries(&api, "&what=loop.setpoint&outcome=done").len(), 3);
    assert_eq!(api.get("/v1/audit/verify").unwrap()["good"], true);

    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replacen("\"setpoint\":42.0", "\"setpoint\":40.0", 1)).unwrap();
    let verdict = api.get("/v1/audit/verify").unwrap();
    let plant = verdict["chains"]
        .as_array()
        .unwrap()
        .iter()
        .find(|chain| chain["host"] == "plant")
        .unwrap();
    assert_eq!((&verdict["good"], &plant["good"]), (&json!(false), &json!(false)));
    assert!(
        plant["flaw"]["reason"].as_str().unwrap().contains("was changed"),
        "{plant}"
    );
    let line = text
        .lines()
        .position(|line| line.contains("\"setpoint\":42.0"))
        .unwrap() as u64
        + 1;
    assert_eq!(plant["flaw"]["line"], line);
}
