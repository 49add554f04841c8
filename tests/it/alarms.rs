//! Alarms over real processes: defined, raised by the process, seen by a person, kept through the death of the home.

use bumpless_tests::{Api, Cell, CellOptions, Feed, first_order_loop};
use serde_json::{Value, json};

use crate::{number, text};

const LOOP: &str = "loop-0";

fn alarm(api: &Api, name: &str, state: &str) -> Value {
    api.wait_until(&format!("{name} {state}"), |api| -> Result<Value, String> {
        let list = api.get("/v1/alarms?all=true").map_err(|error| error.to_string())?;
        let found = list["alarms"]
            .as_array()
            .into_iter()
            .flatten()
            .find(|alarm| alarm["name"] == name);
        match found {
            Some(alarm) if alarm["state"] == state => Ok(alarm.clone()),
            other => Err(format!("{other:?}")),
        }
    })
    .unwrap()
}

fn settled(feed: &Feed, setpoint: f64) {
    feed.record_where("the process at its setpoint", |record| {
        (number(&record["measurement"]) - setpoint).abs() < 0.5
    })
    .unwrap();
}

#[test]
fn an_alarm_lives_by_the_process_and_by_people_and_outlives_its_host() {
    let mut cell = Cell::start(CellOptions::first_order("{ count = 1, tau_s = 0.5 }")).unwrap();
    let api = cell.plant.api();
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&first_order_loop(0, "pid", 50.0)).unwrap();
    api.setpoint(LOOP, 40.0).unwrap();
    let feed = api.live(&format!("?loops={LOOP}")).unwrap();
    settled(&feed, 40.0);

    let path = format!("/v1/loops/{LOOP}/alarms/high");
    let refusal = api.put(&path, &json!({ "kind": "hi" })).unwrap_err().to_string();
    assert!(refusal.contains("have a limit"), "{refusal}");
    let refusal = api
        .put(&path, &json!({ "kind": "hi", "limit": 50, "port": "level" }))
        .unwrap_err()
        .to_string();
    assert!(refusal.contains("no port") && refusal.contains("pv"), "{refusal}");
    let defined = json!({ "kind": "hi", "limit": 50.0, "dead_band": 2.0, "priority": "high", "latching": true,
        "response": "close the valve" });
    assert_eq!(api.put(&path, &defined).unwrap()["state"], "normal");

    api.setpoint(LOOP, 60.0).unwrap();
    let high = alarm(&api, "high", "active");
    assert!(number(&high["value"]) > 50.0, "{high}");
    let shelved = json!({ "act": "shelve", "by": "ann", "seconds": 3600, "reason": "the tank is being filled" });
    assert_eq!(api.post(&path, &shelved).unwrap()["quiet"], true);
    let standing = api.get("/v1/alarms").unwrap();
    let mut names = standing["alarms"]
        .as_array()
        .into_iter()
        .flatten()
        .map(|alarm| text(&alarm["name"]));
    assert!(!names.any(|name| name == "high"), "{standing}");
    let seen = json!({ "act": "acknowledge", "by": "ann", "note": "known" });
    assert_eq!(api.post(&path, &seen).unwrap()["state"], "acknowledged");
    let again = api.post(&path, &seen).unwrap_err().to_string();
    assert!(again.contains("does not wait"), "{again}");

    cell.plant.kill9();
    cell.restart("plant").unwrap();
    let api = cell.plant.api();
    let kept = alarm(&api, "high", "acknowledged");
    assert_eq!(
        (&kept["shelf"]["by"], &kept["note"], &kept["comings"]),
        (&json!("ann"), &json!("known"), &json!(1))
    );

    // The home opens once it has asked the others for newer records.
    api.wait_until("the home is open", |api| api.setpoint(LOOP, 40.0))
        .unwrap();
    alarm(&api, "high", "latched");
    let reset = api.post(&path, &json!({ "act": "reset", "by": "ann" })).unwrap();
    assert_eq!(reset["state"], "normal");
    let past = api.get(&format!("/v1/alarms/history?loop={LOOP}")).unwrap();
    let what: Vec<String> = past["changes"]
        .as_array()
        .into_iter()
        .flatten()
        .filter(|change| change["alarm"] == "high")
        .map(|change| text(&change["what"]))
        .collect();
    assert_eq!(what, ["reset", "went", "acknowledged", "shelved", "came", "defined"]);
    api.delete(&path).unwrap();
    assert!(api.delete(&path).is_err());
}

fn whole(api: &Api) -> bool {
    api.loop_view(LOOP).is_ok_and(|view| {
        let redundancy = &view["redundancy"];
        redundancy["have"]
            .as_u64()
            .is_some_and(|have| have > 0 && redundancy["want"] == have)
    })
}

#[test]
fn a_loop_that_loses_a_replica_says_so() {
    let mut cell = Cell::start(CellOptions::first_order("{ count = 1, tau_s = 0.5 }")).unwrap();
    let api = cell.plant.api();
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&first_order_loop(0, "pid", 50.0)).unwrap();
    // A slow machine may have taken so long over the component that the alarm came; seen by a person, it is over.
    api.wait_until("all replicas at hand", |api| -> Result<(), String> {
        let list = api.get("/v1/alarms?all=true").map_err(|error| error.to_string())?;
        let lost = list["alarms"]
            .as_array()
            .into_iter()
            .flatten()
            .find(|alarm| alarm["name"] == "redundancy-lost");
        match lost.and_then(|alarm| alarm["state"].as_str()) {
            Some("normal") if whole(api) => Ok(()),
            Some("returned") => {
                let seen = json!({ "act": "acknowledge", "by": "ann" });
                let path = format!("/v1/loops/{LOOP}/alarms/redundancy-lost");
                let after = api.post(&path, &seen).map_err(|error| error.to_string())?;
                Err(after.to_string())
            }
            other => Err(format!("{other:?}")),
        }
    })
    .unwrap();
    cell.host("c").unwrap().kill9();
    alarm(&api, "redundancy-lost", "active");
    cell.restart("c").unwrap();
    alarm(&api, "redundancy-lost", "returned");
}
