//! Who holds a loop: frozen owners come back too late to harm, late hosts catch up, and leaving hosts hand over.

use std::time::Duration;

use bumpless_tests::{Cell, CellOptions, first_order_loop, pause};
use serde_json::json;

use crate::{names, one_writer, text, whole};

const LOOP: &str = "loop-0";
const POINT: &str = "plant.0.out";

fn running_cell(controllers: usize, period_ms: f64) -> Cell {
    let options = CellOptions::first_order("{ count = 1, tau_s = 1.0 }").controllers(controllers);
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let mut draft = first_order_loop(0, "pid", period_ms);
    draft["replicas"] = json!(controllers.min(3));
    api.apply(&draft).unwrap();
    api.wait_for_loop(LOOP, "all members and a first cycle", |view| {
        names(&view["members"]).len() == controllers.min(3) && view["owner"].is_string()
    })
    .unwrap();
    cell
}

#[test]
fn an_owner_that_froze_and_thaws_writes_nothing_twice() {
    let mut cell = running_cell(3, 50.0);
    let api = cell.api().unwrap();
    let mut frozen = Vec::new();
    for _ in 0..2 {
        let before = api.loop_view(LOOP).unwrap();
        let owner = text(&before["owner"]);
        cell.host(&owner).unwrap().pause().unwrap();
        let after = api
            .wait_for_loop(LOOP, "another owner", |view| view["owner"] != before["owner"])
            .unwrap();
        assert!(whole(&after["term"]) > whole(&before["term"]));
        // Long enough that everyone believes it dead, and that its own view is seconds old.
        pause(Duration::from_secs(3));
        let then = api.loop_view(LOOP).unwrap();
        assert!(
            whole(&then["seq"]) > whole(&after["seq"]),
            "the loop goes on without it"
        );
        assert_ne!(then["owner"], before["owner"]);
        cell.host(&owner).unwrap().resume().unwrap();
        api.wait_for_loop(LOOP, "all members again", |view| names(&view["members"]).len() == 3)
            .unwrap();
        let feed = api.live(&format!("?loops={LOOP}")).unwrap();
        feed.record_where("a step of the host that thawed", |r| r["stepped_by"] == owner.as_str())
            .unwrap();
        frozen.push(owner);
    }
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    assert!(journal.of(POINT).count() > 60, "{frozen:?}");
}

#[test]
fn a_late_host_gets_the_component_and_takes_a_place_that_is_left() {
    let mut cell = running_cell(3, 500.0);
    let api = cell.api().unwrap();
    cell.add_controller("d").unwrap();
    let digest = text(&api.loop_view(LOOP).unwrap()["digest"]);
    let view = api.loop_view(LOOP).unwrap();
    assert_eq!(
        names(&view["members"]).len(),
        3,
        "three replicas, however many hosts: {view}"
    );

    // Whoever is a member now and is not "d" leaves in order; "d" must then be one.
    for leaves in ["a", "b", "c"] {
        let view = api.loop_view(LOOP).unwrap();
        if names(&view["members"]).contains(&"d".to_owned()) {
            break;
        }
        cell.host(leaves).unwrap().terminate().unwrap();
    }
    api.wait_for_loop(LOOP, "the late host among the members", |view| {
        names(&view["members"]).contains(&"d".to_owned())
    })
    .unwrap();
    let here = cell.api_of("d").unwrap();
    here.wait_until("the late host to say that it is ready", |api| {
        let component = api.get(&format!("/v1/components/{digest}")).unwrap();
        let ready = names(&component["ready_on"]);
        if ready.contains(&"d".to_owned()) {
            Ok(())
        } else {
            Err(ready)
        }
    })
    .unwrap();
    let bytes = here
        .send("GET", &format!("/v1/components/{digest}/bytes"), &[], &[])
        .unwrap();
    let stock = std::fs::read(bumpless_tests::components().unwrap().join("pid.wasm")).unwrap();
    assert!(bytes.body == stock, "the late host has the component byte for byte");
    let feed = api.live(&format!("?loops={LOOP}")).unwrap();
    feed.record_where("a step of the late host", |r| r["stepped_by"] == "d")
        .unwrap();
    one_writer(&cell.journal().unwrap());
}

#[test]
fn a_leaving_owner_hands_over_without_losing_a_cycle() {
    let mut cell = running_cell(3, 500.0);
    let api = cell.api().unwrap();
    let before = api.loop_view(LOOP).unwrap();
    let owner = text(&before["owner"]);
    cell.host(&owner).unwrap().terminate().unwrap();
    let after = api
        .wait_for_loop(LOOP, "cycles of another owner", |view| {
            view["owner"] != before["owner"] && view["seq"].as_u64() > before["seq"].as_u64().map(|seq| seq + 6)
        })
        .unwrap();
    assert!(whole(&after["term"]) > whole(&before["term"]));
    assert_eq!(
        after["tally"]["lost"], before["tally"]["lost"],
        "no cycle was lost: {}",
        after["tally"]
    );
    assert_eq!(
        after["tally"]["takeovers"], before["tally"]["takeovers"],
        "it was handed over, not taken over"
    );
    let journal = cell.journal().unwrap();
    assert_eq!(journal.cycles_missing(POINT), 0);
    one_writer(&journal);

    // By hand, too: to a host by name, between two cycles.
    let members = names(&after["members"]);
    let to = members.iter().find(|m| after["owner"] != m.as_str()).unwrap();
    api.move_owner(LOOP, to).unwrap();
    api.wait_for_loop(LOOP, "the host that was named", |view| view["owner"] == to.as_str())
        .unwrap();
    assert_eq!(cell.journal().unwrap().cycles_missing(POINT), 0);
}
