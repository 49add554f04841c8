//! A host whose steps come out wrong: under a vote nothing of it reaches the actuator, and the cell says who it is.

use std::ops::RangeBounds;

use bumpless_tests::{Binary, Cell, CellOptions, Journal, first_order_loop};
use serde_json::{Value, json};

use crate::{number, one_writer, settle};

const LOOP: &str = "loop-0";
const POINT: &str = "plant.0.out";

/// Every so-manieth step of one host is wrong: the first one when the output is far from nothing, and never so seldom that the
/// host gets its vote back.
const WRONG_EVERY: u64 = 20;
/// Outputs below this are not judged: a bit that is turned over in a small number is a small step.
const JUDGED_FROM: f64 = 10.0;
/// A turned bit moves a value by a quarter at least; the loop itself by some hundredths.
const STEP_MAX: f64 = 0.2;

/// The greatest step of the output from one write to the next, as a part of it, in these cycles.
fn greatest_step(journal: &Journal, seqs: impl RangeBounds<u64>) -> f64 {
    let writes: Vec<_> = journal.of(POINT).filter(|w| seqs.contains(&w.seq)).collect();
    let judged = writes.windows(2).filter(|pair| pair[0].value.abs() >= JUDGED_FROM);
    let steps = judged.map(|pair| (pair[1].value - pair[0].value).abs() / pair[0].value.abs());
    steps.fold(0.0, f64::max)
}

fn has_event(record: &Value, kind: &str) -> bool {
    let events = record["events"].as_array();
    events.is_some_and(|events| events.iter().any(|event| event["kind"] == kind))
}

#[test]
fn a_host_that_errs_is_outvoted_named_and_kept_from_the_actuator() {
    let mut options = CellOptions::first_order("{ count = 1, tau_s = 0.5 }");
    options.host_tables = vec![("b".to_owned(), format!("[testing]\nflip_bits_every = {WRONG_EVERY}\n"))];
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
    let output = number(&dissent["outputs"]["out"]);
    assert!(output > JUDGED_FROM, "the first wrong step is judged as well: {output}");
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

    // Every cycle is judged, that of the first dissent too, when the one that errs still had its vote.
    let from = settled["seq"].as_u64().unwrap();
    let to = feed
        .record_where("some cycles later", |record| record["seq"].as_u64() > Some(from + 40))
        .unwrap();
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    let to = to["seq"].as_u64().unwrap();
    let step = greatest_step(&journal, ..=to);
    assert!(step < STEP_MAX, "the output stepped by {step} of itself");
    let first = dissent["seq"].as_u64().unwrap();
    assert!(
        journal.of(POINT).any(|w| w.seq == first),
        "the first dissent's cycle was written"
    );

    // The same host without a vote over it: now it shows, so the check above could have failed.
    api.strategy(LOOP, "round-robin").unwrap();
    api.wait_until("a wrong value at the actuator", |_| {
        let step = greatest_step(&cell.journal().unwrap(), to..);
        if step > STEP_MAX { Ok(()) } else { Err(step) }
    })
    .unwrap();
    api.strategy(LOOP, "vote(3)").unwrap();
    let found = api
        .wait_for_loop(LOOP, "it is found out again", |view| {
            view["redundancy"]["vote"]["aside"][0]["host"] == "b"
        })
        .unwrap();

    // One of the two others dies: no majority of three is left, and the output holds rather than follow one machine alone.
    let owner = found["owner"].as_str().unwrap().to_owned();
    let dies = if owner == "c" { "a" } else { "c" };
    cell.host(dies).unwrap().kill9();
    let held = feed
        .record_where("a cycle without a majority", |record| {
            has_event(record, "no-majority") && has_event(record, "policy-held")
        })
        .unwrap();
    api.wait_for_loop(LOOP, "the loss in the loop's status", |view| {
        let redundancy = &view["redundancy"];
        redundancy["have"] == 1 && redundancy["want"] == 3
    })
    .unwrap();
    // And it goes on by itself when the third is back.
    cell.restart(dies).unwrap();
    feed.record_where("a majority again", |record| {
        record["seq"].as_u64() > held["seq"].as_u64() && record["redundancy"]["vote"]["agreed"] == 2
    })
    .unwrap();
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    let step = greatest_step(&journal, found["seq"].as_u64().unwrap()..);
    assert!(step < STEP_MAX, "the output stepped by {step} of itself");
}
