//! What is killed comes back and goes on: the whole cell, or the I/O host alone.

use bumpless_tests::{Cell, CellOptions, Journal, PLANT, first_order_loop};
use serde_json::{Value, json};

use crate::{one_writer, settle, text, whole};

const LOOP: &str = "loop-0";
const POINT: &str = "plant.0.out";

/// Furthest that the first output after a restart may be from what the actuator holds, in % of its span. The simulated
/// actuator starts anew at 0; the loop follows it, and adds the proportional part (0.1 · 40 %) and a little integral action.
/// That an actuator which keeps its value is taken over where it is, is tested with a real device, in `modbus`.
const STEP_MAX: f64 = 10.0;

fn running_cell() -> Cell {
    let mut cell = Cell::start(CellOptions::first_order("{ count = 1, tau_s = 1.0 }")).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid", "pidplus"]).unwrap();
    let mut draft = first_order_loop(0, "pid", 100.0);
    draft["setpoint"] = json!(20.0);
    api.apply(&draft).unwrap();
    // A command, so that what was commanded can be told from what was written into the loop's file.
    api.setpoint(LOOP, 40.0).unwrap();
    settle(&api, LOOP, 2.0);
    cell
}

/// Looks at the last write before a restart and the first after it. `before` is the log until the restart; fewer than
/// `repeats_max` cycles may be run again, under their new ownership.
#[track_caller]
fn check_first_write(cell: &Cell, before: &Journal, repeats_max: u64) {
    let after = cell.journal().unwrap();
    let first = after.of(POINT).nth(before.of(POINT).count()).unwrap();
    let last = before.of(POINT).last().unwrap();
    assert!(
        first.term > last.term,
        "the first ownership after the restart is new: {last:?}, {first:?}"
    );
    assert!(
        first.seq + repeats_max > last.seq,
        "cycle numbers go on: {last:?}, {first:?}"
    );
    assert!(first.value.abs() < STEP_MAX, "the actuator held 0: {first:?}");
}

fn library(api: &bumpless_tests::Api) -> Vec<Value> {
    let rows = api.components().unwrap();
    rows.iter()
        .map(|c| json!([c["name"], c["version"], c["digest"]]))
        .collect()
}

#[test]
fn a_cell_that_was_killed_whole_goes_on_where_it_was() {
    let mut cell = running_cell();
    let api = cell.api().unwrap();
    let (library_before, loop_before) = (library(&api), api.loop_view(LOOP).unwrap());
    for host in cell.hosts_mut() {
        host.kill9();
    }
    let before = cell.journal().unwrap();
    for name in [PLANT, "a", "b", "c"] {
        cell.restart(name).unwrap();
    }
    cell.wait_joined().unwrap();
    let after = api
        .wait_for_loop(LOOP, "the loop to go on", |view| {
            view["term"].as_u64() > loop_before["term"].as_u64()
        })
        .unwrap();
    assert_eq!(library(&api), library_before);
    for key in ["revision", "spec", "digest", "setpoint", "mode"] {
        assert_eq!(after[key], loop_before[key], "{key}");
    }
    // Records reach the disk within 100 ms, when the machine keeps up: a few cycles of 100 ms.
    check_first_write(&cell, &before, 20);
    settle(&api, LOOP, 2.0);
    let journal = cell.journal().unwrap();
    one_writer(&journal);
    // It can still be changed and deleted: intents are not only read, they go on.
    assert_eq!(api.swap(LOOP, "pidplus").unwrap()["revision"], 2);
    api.delete(&format!("/v1/loops/{LOOP}")).unwrap();
}

#[test]
fn an_io_host_that_restarts_takes_no_write_of_an_old_ownership() {
    let mut cell = running_cell();
    let loop_before = cell.api().unwrap().loop_view(LOOP).unwrap();
    cell.plant.kill9();
    let before = cell.journal().unwrap();
    // The others see it go; nobody can write while it is away.
    cell.wait_joined().unwrap();
    let elsewhere = cell.api_of("a").unwrap();
    let problem = elsewhere.setpoint(LOOP, 50.0).unwrap_err();
    assert!([503, 504].contains(&problem.status()), "{problem}");
    cell.restart(PLANT).unwrap();
    cell.wait_joined().unwrap();
    let api = cell.api().unwrap();
    let after = api
        .wait_for_loop(LOOP, "the loop to go on", |view| {
            view["term"].as_u64() > loop_before["term"].as_u64()
                && view["seq"].as_u64() > loop_before["seq"].as_u64().map(|seq| seq + 10)
        })
        .unwrap();
    assert_eq!(after["setpoint"], 40.0, "what was refused is not done later");
    // The other hosts have all records but the one that was on its way.
    check_first_write(&cell, &before, 2);
    settle(&api, LOOP, 2.0);
    one_writer(&cell.journal().unwrap());
    assert!(
        whole(&after["seq"]) > whole(&loop_before["seq"]),
        "{}",
        text(&after["name"])
    );
}
