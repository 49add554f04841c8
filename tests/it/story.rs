//! A loop's whole life: components come, the loop runs on three hosts, is operated, swapped, loses its owner, and ends.

use std::collections::BTreeSet;

use bumpless_tests::{Api, Cell, CellOptions, pressure_loop};
use serde_json::{Value, json};

use crate::{number, one_writer, settle, text, whole};

const LOOP: &str = "pressure";
const POINT: &str = "plant.p1";

#[test]
fn a_loop_lives_through_swaps_and_the_death_of_its_owner() {
    let mut cell = Cell::start(CellOptions::default()).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid", "pidplus", "on-off"]).unwrap();
    assert_eq!(api.components().unwrap().len(), 3);

    // In manual first, to fill the vessel.
    let mut draft = pressure_loop("pidplus", 100.0);
    draft["mode"] = json!("manual");
    let created = api.apply(&draft).unwrap();
    assert_eq!((&created["created"], &created["revision"]), (&json!(true), &json!(1)));
    let again = api.apply(&draft).unwrap();
    assert_eq!((&again["unchanged"], &again["revision"]), (&json!(true), &json!(1)));
    output_in_manual(&api);
    all_hosts_step(&api);
    automatic_without_a_bump(&api);
    settle(&api, LOOP, 0.02);

    setpoint_is_in_the_record_that_it_names(&api);
    settle(&api, LOOP, 0.02);

    swap(&api, "pid");
    swap(&api, "pidplus");
    let back = api.rollback(LOOP, None).unwrap();
    assert_eq!(back["revision"], 4, "a rollback is a revision of its own: {back}");
    assert!(text(&api.loop_view(LOOP).unwrap()["component"]).starts_with("pid@"));
    let by = &back["hand_over"]["by"];
    assert_eq!(by, "migrate", "{back}");

    let set = api.strategy(LOOP, "local").unwrap();
    assert_eq!(set["revision"], 5);
    let feed = api.live("?loops=pressure").unwrap();
    feed.record_where("a local step", |r| r["revision"] == 5 && r["stepped_by"] == r["owner"])
        .unwrap();
    api.strategy(LOOP, "round-robin").unwrap();

    owner_dies(&mut cell, &api);
    one_writer(&cell.journal().unwrap());

    let problem = api.delete("/v1/components/pid").unwrap_err();
    assert_eq!(problem.status(), 409, "{problem}");
    assert!(problem.to_string().contains(LOOP), "{problem}");
    api.delete("/v1/loops/pressure").unwrap();
    assert_eq!(api.loop_view(LOOP).unwrap_err().status(), 404);
    for name in ["pid", "pidplus", "on-off"] {
        api.delete(&format!("/v1/components/{name}")).unwrap();
    }
    // What one host knows, all come to know.
    for host in cell.hosts() {
        host.api()
            .wait_until("an empty library", |api| match api.components().unwrap() {
                rows if rows.is_empty() => Ok(()),
                rows => Err(rows.len()),
            })
            .unwrap();
    }
    one_writer(&cell.journal().unwrap());
}

fn output_in_manual(api: &Api) {
    let done = api
        .command(LOOP, "output", &json!({ "outputs": { "out": 6.0 } }))
        .unwrap();
    assert_eq!(done["mode"], "manual");
    api.wait_until("the pump to be told", |api| {
        let point = api.point(POINT).unwrap();
        if point["value"] == 6.0 && point["written_by"] == LOOP {
            Ok(())
        } else {
            Err(point)
        }
    })
    .unwrap();
}

fn all_hosts_step(api: &Api) {
    let feed = api.live("?loops=pressure").unwrap();
    let seen = std::cell::RefCell::new(BTreeSet::new());
    feed.record_where("a step of each host", |record| {
        seen.borrow_mut().insert(text(&record["stepped_by"]));
        seen.borrow().len() == 3
    })
    .unwrap();
    let wanted: BTreeSet<String> = ["a", "b", "c"].map(str::to_owned).into();
    assert_eq!(seen.into_inner(), wanted);
}

fn automatic_without_a_bump(api: &Api) {
    let done = api.mode(LOOP, "automatic").unwrap();
    let seq = whole(&done["seq"]);
    let record = record_at_or_after(api, seq);
    // The pump held 6 V. A good step later the output is still there, give or take one cycle's integral action.
    if whole(&record["seq"]) == seq {
        let out = number(&record["outputs"]["out"]);
        assert!(
            (out - 6.0).abs() < 0.3,
            "the transfer bumped the output to {out} V: {record}"
        );
    }
}

fn setpoint_is_in_the_record_that_it_names(api: &Api) {
    let feed = api.live("?loops=pressure").unwrap();
    let first = whole(&feed.record().unwrap()["seq"]);
    let key = "0123456789abcdef0123456789abcdef";
    let ask = || {
        let body = json!({ "setpoint": 0.6 }).to_string();
        let headers = [("content-type", "application/json"), ("idempotency-key", key)];
        api.send("POST", "/v1/loops/pressure/setpoint", &headers, body.as_bytes())
            .unwrap()
    };
    let done = ask();
    assert_eq!(done.status, 200, "{}", done.text());
    let done = done.json();
    assert_eq!((&done["command_id"], &done["setpoint"]), (&json!(key), &json!(0.6)));
    let record = feed
        .record_where("the record that the command names", |r| r["seq"] == done["seq"])
        .unwrap();
    assert!(whole(&record["seq"]) > first);
    assert_eq!((&record["setpoint"], &record["term"]), (&json!(0.6), &done["term"]));
    let applied = record["applied"].as_array().unwrap();
    assert!(
        applied.iter().any(|a| a["command_id"] == key && a["refused"].is_null()),
        "{record}"
    );
    // Asked twice with one key, done once: the second answer names the first record.
    assert_eq!(ask().json()["seq"], done["seq"]);
}

fn swap(api: &Api, component: &str) {
    let feed = api.live("?loops=pressure").unwrap();
    let done = api.swap(LOOP, component).unwrap();
    assert_eq!(done["hand_over"]["by"], "migrate", "{done}");
    let bump = number(&done["hand_over"]["bump_percent"]);
    assert!(bump.abs() < 0.5, "{done}");
    let before = std::cell::RefCell::new(Value::Null);
    let record = feed
        .record_where("the record of the swap", |record| {
            let is = record["revision"] == done["revision"];
            if !is {
                before.replace(record.clone());
            }
            is
        })
        .unwrap();
    let event = record["events"]
        .as_array()
        .unwrap()
        .iter()
        .find(|e| e["kind"] == "revised");
    assert_eq!(event.map(|e| &e["by"]), Some(&json!("migrate")), "{record}");
    // Seen from the outside: less than 5 % of the pump's span between two records in steady state.
    let before = before.into_inner();
    if before["outputs"]["out"].is_number() {
        let step = number(&record["outputs"]["out"]) - number(&before["outputs"]["out"]);
        assert!(step.abs() < 0.5, "{step} V from {before} to {record}");
    }
    let view = api.loop_view(LOOP).unwrap();
    assert!(text(&view["component"]).starts_with(&format!("{component}@")), "{view}");
}

fn owner_dies(cell: &mut Cell, api: &Api) {
    let before = api
        .wait_for_loop(LOOP, "an owner", |view| view["owner"].is_string())
        .unwrap();
    let owner = text(&before["owner"]);
    cell.host(&owner).unwrap().kill9();
    let after = api
        .wait_for_loop(LOOP, "another owner", |view| {
            view["owner"] != before["owner"] && view["seq"].as_u64() > before["seq"].as_u64()
        })
        .unwrap();
    assert!(whole(&after["term"]) > whole(&before["term"]), "{after}");
    assert_eq!(after["setpoint"], 0.6, "an acknowledged command is never lost");
    cell.restart(&owner).unwrap();
    cell.wait_joined().unwrap();
    api.wait_for_loop(LOOP, "the old owner among the members", |view| {
        view["members"].as_array().is_some_and(|m| m.len() == 3)
    })
    .unwrap();
    let feed = api.live("?loops=pressure").unwrap();
    feed.record_where("a step of the host that came back", |r| {
        r["stepped_by"] == owner.as_str()
    })
    .unwrap();
}

fn record_at_or_after(api: &Api, seq: u64) -> Value {
    let feed = api.live("?loops=pressure").unwrap();
    let last = api.loop_view(LOOP).unwrap()["last"].clone();
    if whole(&last["seq"]) >= seq {
        return last;
    }
    feed.record_where("the record of the command", |r| r["seq"].as_u64() >= Some(seq))
        .unwrap()
}
