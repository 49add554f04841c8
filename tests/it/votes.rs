//! A host whose steps come out wrong: under a vote nothing of it reaches the actuator, and the cell says who it is.

use bumpless_tests::{Binary, Cell, CellOptions, Journal, first_order_loop};
use serde_json::{Value, json};

use crate::{one_writer, settle};

const LOOP: &str = "loop-0";
const POINT: &str = "plant.0.out";

/// The greatest step of the output from one write to the next, since this one.
fn greatest_step(journal: &Journal, from_seq: u64) -> f64 {
    let writes: Vec<_> = journal.of(POINT).filter(|w| w.seq >= from_seq).collect();
    let steps = writes.windows(2).map(|pair| (pair[1].value - pair[0].value).abs());
    steps.fold(0.0, f64::max)
}

fn has_event(record: &Value, kind: &str) -> bool {
    let events = record["events"].as_array();
    events.is_some_and(|events| events.iter().any(|event| event["kind"] == kind))
}

#[test]
fn a_host_that_errs_is_outvoted_named_and_kept_from_the_actuator() {
    let mut options = CellOptions::first_order("{ count = 1, tau_s = 0.5 }");
    options.host_tables = vec![("b".to_owned(), "[testing]\nflip_bits_every = 4\n".to_owned())];
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let mut draft = first_order_loop(0, "pid", 50.0);
    (draft["strategy"], draft["replicas"]) = (json!("vote(3)"), json!(3));
    let feed = api.live(&format!("?loops={LOOP}")).unwrap();
    api.apply(&draft).unwrap();

    let dissent = feed
        .record_where("dissent", |record| has_event(record, "dissent"))
        .unwrap();
    let event = dissent["events"]
        .as_array()
        .unwrap()
        .iter()
        .find(|e| e["kind"] == "dissent");
    assert_eq!(event.unwrap()["replica"], "b");
    let settled = settle(&api, LOOP, 1.0);
    let view = api
        .wait_for_loop(LOOP, "two votes that are left", |view| view["redundancy"]["have"] == 2)
        .unwrap();
    assert_eq!(view["spec"]["strategy"], "vote(3)");
    assert_eq!(
        view["redundancy"]["vote"]["aside"][0]["host"], "b",
        "{}",
        view["redundancy"]
    );
    let shown = std::process::Command::new(Binary::find().unwrap().path())
        .args(["loop", "show", LOOP, "--api", api.base()])
        .output()
        .unwrap();
    let shown = String::from_utf8(shown.stdout).unwrap();
    assert!(
        shown.contains("2 of 3 can step") && shown.contains("without a vote"),
        "{shown}"
    );

    // While it settles the output moves by some units a second; a turned bit would be a quarter of it at once.
    let from = settled["seq"].as_u64().unwrap();
    feed.record_where("some cycles later", |record| record["seq"].as_u64() > Some(from + 40))
        .unwrap();
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    let step = greatest_step(&journal, from);
    assert!(step < 2.0, "the output stepped by {step}");

    // The same host without a vote over it: now it shows, so the check above could have failed.
    api.strategy(LOOP, "round-robin").unwrap();
    api.wait_until("a wrong value at the actuator", |_| {
        let step = greatest_step(&cell.journal().unwrap(), from);
        if step > 5.0 { Ok(()) } else { Err(step) }
    })
    .unwrap();
    api.strategy(LOOP, "vote(3)").unwrap();
    api.wait_for_loop(LOOP, "it is found out again", |view| {
        view["redundancy"]["vote"]["aside"][0]["host"] == "b"
    })
    .unwrap();

    // One of the two others dies: the last one goes on, and the loop says how few are left.
    let owner = api.loop_view(LOOP).unwrap()["owner"].as_str().unwrap().to_owned();
    let dies = if owner == "c" { "a" } else { "c" };
    cell.host(dies).unwrap().kill9();
    api.wait_for_loop(LOOP, "the loss in the loop's status", |view| {
        let redundancy = &view["redundancy"];
        redundancy["have"] == 1 && redundancy["want"] == 3
    })
    .unwrap();
    one_writer(&cell.journal().unwrap());
}
