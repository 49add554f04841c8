//! The worst of the hostile components on real hosts, beside a loop that must not notice: no cycle of it is lost, each leaves a clear
//! event, and the host goes on.

use bumpless_tests::{
    Cell, CellOptions, components, first_order_loop,
    hostile::{End, Tells, table},
};
use serde_json::json;

use crate::{one_writer, text};

/// By name in the table: those that hold a thread, a processor or memory for as long as they can.
const WORST: [&str; 8] = [
    "spins",
    "spins-by-tail-calls",
    "spins-in-host-calls",
    "recurses-by-two",
    "grows-at-once",
    "giant-state",
    "floods-alarms",
    "huge-list",
];

#[test]
fn the_worst_leave_an_event_and_cost_their_neighbour_no_cycle() {
    let cell = Cell::start(CellOptions {
        plant_tables: "[roles]\ncontrol = true\n".to_owned(),
        ..CellOptions::first_order("{ count = 2 }").controllers(0)
    })
    .unwrap();
    let api = cell.plant.api();
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&first_order_loop(0, "pid", 100.0)).unwrap();
    let good = api.live("?loops=loop-0").unwrap();
    good.record().unwrap();
    let all = table().unwrap();
    let folder = components().unwrap();
    for name in WORST {
        let guest = all.iter().find(|guest| guest.name == name).unwrap();
        assert_eq!((guest.end, guest.event), (End::Faulted, Tells::Faulted), "{name}");
        let bytes = guest.bytes(&folder).unwrap();
        let refusal = api.upload_bytes(&bytes).unwrap_err();
        assert!(
            refusal.status() == 422 && guest.is_kept_out_by(&refusal.to_string()),
            "{name}: {refusal}"
        );
        let path = "/v1/components?force=true";
        let forced = api
            .send("POST", path, &[("content-type", "application/wasm")], &bytes)
            .unwrap();
        let digest = text(&forced.json()["digest"]);
        let (input, output) = guest.ports();
        let hostile = format!("hostile-{name}");
        api.apply(&json!({
            "name": hostile, "component": digest, "period_ms": 100.0, "setpoint": 40.0,
            "ports": { input: "plant.1.pv", output: "plant.1.out" },
        }))
        .unwrap();
        // Its cycles are faulty for as long as it is there, so nothing is missed.
        let bad = api.live(&format!("?loops={hostile}")).unwrap();
        let record = bad
            .record_where("its fault", |record| {
                let events = record["events"].as_array().unwrap();
                events
                    .iter()
                    .any(|event| event["kind"] == "faulted" && guest.is_told_by(&text(&event["fault"])))
            })
            .unwrap();
        let held = record["events"]
            .as_array()
            .unwrap()
            .iter()
            .any(|event| event["kind"] == "policy-held");
        assert!(held, "{name}: its loop is in its policy: {record}");
        api.delete(&format!("/v1/loops/{hostile}")).unwrap();
        api.delete(&format!("/v1/components/{digest}")).unwrap();
        good.record().unwrap();
    }
    let journal = cell.journal().unwrap();
    assert_eq!(journal.cycles_missing("plant.0.out"), 0);
    one_writer(&journal);
}
