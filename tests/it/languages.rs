//! The example law in every language: the same numbers, and swaps between all of them without a bump.
//!
//! Each component is built by its example's own script (`cargo xtask languages`), with tools that are set up once.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use bumpless_sdk::bench::Bench;
use bumpless_tests::{Api, Cell, CellOptions, components, first_order_loop};
use rust_pid::{RustPid, block::PV};
use serde_json::{Value, json};

use crate::{number, one_writer, text, whole};

/// How far outputs of two languages may be apart. They are not apart at all: the law is made of `+ − × ÷`.
const APART_MAX: f64 = 1e-12;
/// Of the slowest language, in ms: a cycle must have room for its step on a busy machine.
const PERIOD_MS: f64 = 50.0;

/// Hosts compile at the lowest priority, beside other tests, and by a compiler that is hardly optimised here; a request may take 160 s.
const PATIENT: &str = "[engine]\ncompile_s_max = 150\n";

/// Uploads the example in Rust and those named.
fn upload(api: &Api, names: &[&str]) {
    let rust = components().unwrap().join("examples/rust-pid.wasm");
    api.upload(&rust).unwrap();
    for name in names {
        let path = xtask::languages::named(name).unwrap().build().unwrap();
        let taken = api.upload(&path).unwrap();
        assert_eq!(taken["name"], *name, "{taken}");
    }
    for name in names.iter().chain(&["rust-pid"]) {
        let shown = api.get(&format!("/v1/components/{name}")).unwrap();
        let report = &shown["admission"];
        let findings = report["findings"].as_array().unwrap();
        let grave: Vec<&Value> = findings
            .iter()
            .filter(|finding| finding["severity"] != "info")
            .collect();
        assert!(grave.is_empty(), "{name}: {grave:?}");
        assert_eq!(
            (&report["verdict"], &report["migrated"]),
            (&json!("passed"), &json!("accepted")),
            "{name}"
        );
    }
}

/// Steps a component by calls and compares with the law, natively: outputs, and the state behind the writer's name.
fn gives_the_numbers_of_the_law(api: &Api, name: &str) {
    let tuning = [
        ("gain", 2.5),
        ("ti", 7.0),
        ("td", 0.7),
        ("td-filter", 0.1),
        ("out-high", 60.0),
    ];
    let mut native = Bench::<RustPid>::start(&tuning, &[33.0]).unwrap();
    native.set_setpoint(50.0);
    let parameters: serde_json::Map<String, Value> = tuning
        .map(|(key, value)| (key.to_owned(), json!(value)))
        .into_iter()
        .collect();
    let mut call = json!({
        "inputs": {}, "setpoint": 50.0, "dt_ms": 100.0, "parameters": parameters, "track": { "out": 33.0 },
    });
    // Into the upper limit and out of it again.
    for (seq, pv) in (1..).zip([42.0, 43.5, 44.1, 40.3, 31.0, 30.0, 30.7, 47.25, 51.3, 52.9, 50.1]) {
        call["seq"] = json!(seq);
        call["inputs"]["pv"] = json!(pv);
        let answer = api.call(name, &call).unwrap();
        native.set(PV, pv);
        let wanted = native.step(0.1).unwrap()[0];
        native.hold(rust_pid::block::OUT, wanted);
        let given = number(&answer["outputs"]["out"]);
        assert!(
            (given - wanted).abs() <= APART_MAX,
            "{name}, call {seq}: {given}, the law gives {wanted}"
        );
        let state = STANDARD.decode(text(&answer["state"])).unwrap();
        let behind = |state: &[u8], name: &str| state[2 + name.len()..].to_vec();
        assert_eq!(
            behind(&state, name),
            behind(native.state(), "rust-pid"),
            "{name}, call {seq}: the state is the law's, byte for byte, behind the name"
        );
        call["state"] = answer["state"].clone();
        call["track"]["out"] = answer["outputs"]["out"].clone();
    }
}

/// Swaps the running loop to each in turn.
fn swap_through(api: &Api, name: &str, turns: &[&str]) {
    for to in turns {
        let done = api.swap(name, to).unwrap();
        assert_eq!(done["hand_over"]["by"], "migrate", "to {to}: {done}");
        let bump = number(&done["hand_over"]["bump_percent"]);
        assert!(bump.abs() <= APART_MAX, "to {to}: {done}");
        let view = api.loop_view(name).unwrap();
        assert!(text(&view["component"]).starts_with(&format!("{to}@")), "{view}");
    }
}

fn draft(period_ms: f64) -> Value {
    let mut draft = first_order_loop(0, "rust-pid", period_ms);
    draft["parameters"] = json!({ "gain": 0.4, "ti": 2.0, "td": 0.1, "td-filter": 0.1 });
    draft
}

#[test]
fn the_law_in_every_small_language_is_one_law_and_swaps_without_a_bump() {
    let names = ["c-pid", "js-pid", "ts-pid", "rust-wasip2-pid"];
    let mut options = CellOptions::first_order("{ count = 1 }").controllers(2);
    options.plant_tables = PATIENT.to_owned();
    options.controller_tables = PATIENT.to_owned();
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    upload(&api, &names);
    for name in names {
        gives_the_numbers_of_the_law(&api, name);
    }
    api.apply(&draft(PERIOD_MS)).unwrap();
    let turns = [
        "c-pid",
        "rust-pid",
        "js-pid",
        "rust-pid",
        "rust-wasip2-pid",
        "ts-pid",
        "c-pid",
        "js-pid",
    ];
    swap_through(&api, "loop-0", &turns);

    // The owner dies while an interpreter runs: the state is bytes, so another host's fresh interpreter goes on from it.
    let before = api
        .wait_for_loop("loop-0", "an owner", |view| view["owner"].is_string())
        .unwrap();
    cell.host(&text(&before["owner"])).unwrap().kill9();
    let after = api
        .wait_for_loop("loop-0", "another owner", |view| {
            view["owner"] != before["owner"] && view["seq"].as_u64() > before["seq"].as_u64()
        })
        .unwrap();
    assert!(whole(&after["term"]) > whole(&before["term"]), "{after}");
    swap_through(&api, "loop-0", &["rust-pid"]);
    one_writer(&cell.journal().unwrap());
}

/// CPython compiles for a minute where the compiler itself is not optimised, so it has a cell of one host.
#[test]
fn the_law_in_python_is_the_same_law_and_swaps_without_a_bump() {
    let mut options = CellOptions::first_order("{ count = 1 }").controllers(0);
    options.plant_tables = format!("{PATIENT}[roles]\ncontrol = true\n");
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    upload(&api, &["python-pid"]);
    gives_the_numbers_of_the_law(&api, "python-pid");
    api.apply(&draft(PERIOD_MS)).unwrap();
    swap_through(&api, "loop-0", &["python-pid", "rust-pid", "python-pid"]);

    let before = api.loop_view("loop-0").unwrap();
    cell.plant.kill9();
    cell.restart("plant").unwrap();
    let api = cell.api().unwrap();
    api.wait_for_loop("loop-0", "to go on after its host died", |view| {
        view["seq"].as_u64() > before["seq"].as_u64() && text(&view["component"]).starts_with("python-pid@")
    })
    .unwrap();
    swap_through(&api, "loop-0", &["rust-pid"]);
    one_writer(&cell.journal().unwrap());
}
