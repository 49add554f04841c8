//! The lab and a live cell agree, and each can go on with what the other found.

use std::{fs, path::Path};

use bumpless_core::indices::{Indices, Rule, TotalVariation};
use bumpless_tests::{Api, Binary, Cell, CellOptions, components, first_order_loop};
use serde_json::{Value, json};

use crate::{number, text};

const LOOP: &str = "loop-0";
const PERIOD_MS: f64 = 100.0;

/// Runs `bumpless` with these words; gives what it wrote.
#[track_caller]
fn bumpless(api: Option<&Api>, words: &[&str]) -> String {
    let mut command = Binary::find().unwrap().command();
    if let Some(api) = api {
        command.env("BUMPLESS_API", api.base());
    }
    let output = command.args(words).output().unwrap();
    let wrote = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        output.status.success(),
        "{words:?}: {wrote}\n{}",
        String::from_utf8_lossy(&output.stderr)
    );
    wrote
}

/// The figures of the only variant's only loop.
fn lab_figures(folder: &Path, experiment: &str) -> Value {
    let file = folder.join("experiment.toml");
    fs::write(&file, experiment).unwrap();
    let stock = components().unwrap();
    let wrote = bumpless(
        None,
        &[
            "lab",
            "run",
            file.to_str().unwrap(),
            "--out",
            folder.join("out").to_str().unwrap(),
            "--components",
            stock.to_str().unwrap(),
            "--json",
        ],
    );
    let all: Value = serde_json::from_str(&wrote).unwrap();
    all["variants"][0]["loops"][LOOP].clone()
}

fn cycles_pass(api: &Api, count: u64) {
    let seen = api.loop_view(LOOP).unwrap()["seq"].as_u64().unwrap();
    api.wait_for_loop(LOOP, "further cycles", |view| {
        view["seq"].as_u64() >= Some(seen + count)
    })
    .unwrap();
}

#[test]
fn a_live_loop_has_the_figures_of_the_lab_and_takes_its_winner_as_a_shadow() {
    let fopdt = "{ count = 1, gain = 1.0, tau_s = 1.5, dead_time_s = 0.3, noise = 0.0 }";
    let mut cell = Cell::start(CellOptions::first_order(fopdt).controllers(2)).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let mut draft = first_order_loop(0, "pid", PERIOD_MS);
    draft["parameters"] = json!({ "k": 1.2, "ti": 1.2 });
    draft["setpoint"] = json!(20.0);
    api.apply(&draft).unwrap();
    api.wait_for_loop(LOOP, "a first cycle", |view| view["seq"].is_number())
        .unwrap();
    cycles_pass(&api, 80);
    api.setpoint(LOOP, 40.0).unwrap();
    cycles_pass(&api, 50);
    api.setpoint(LOOP, 30.0).unwrap();
    cycles_pass(&api, 40);

    // What was recorded, from the first cycle under the new setpoint on.
    let recorded = api.get(&format!("/v1/loops/{LOOP}/cycles?last=1000")).unwrap();
    let records = recorded["records"].as_array().unwrap();
    let first = |setpoint: f64| records.iter().position(|r| number(&r["setpoint"]) == setpoint).unwrap();
    let (up, down) = (first(40.0), first(30.0));
    let t_s = |r: &Value| r["at_unix_us"].as_u64().unwrap() as f64 * 1e-6;
    let (mut indices, mut travel) = (Indices::new(Rule::Rectangle), TotalVariation::default());
    travel.add(number(&records[up - 1]["outputs"]["out"]));
    for r in &records[up..] {
        indices
            .add(t_s(r), number(&r["setpoint"]), number(&r["measurement"]))
            .unwrap();
        travel.add(number(&r["outputs"]["out"]));
    }

    // The same in virtual time.
    let period_s = PERIOD_MS * 1e-3;
    let (up_s, seconds) = (9.0, (records.len() - 1 - up) as f64 * period_s);
    let down_s = up_s + (down - up) as f64 * period_s;
    let folder = tempfile::tempdir().unwrap();
    let experiment = format!(
        r#"
name = "live"
duration_s = {end}
plant = {{ model = "fopdt", fopdt = {{ gain = 1.0, tau_s = 1.5, dead_time_s = 0.3 }} }}
controller = {{ component = "pid", parameters = {{ k = 1.2, ti = 1.2 }} }}
measure = {{ from_s = {up_s} }}
[[loop]]
name = "{LOOP}"
ports = {{ pv = "pv", out = "out" }}
period_ms = {PERIOD_MS}
setpoint = [{{ at_s = 0, to = 20 }}, {{ at_s = {up_s}, to = 40 }}, {{ at_s = {down_s}, to = 30 }}]
"#,
        end = up_s + seconds,
    );
    let lab = lab_figures(folder.path(), &experiment);
    for (key, live) in [
        ("iae", indices.iae()),
        ("ise", indices.ise()),
        ("itae", indices.itae()),
        ("tv", travel.value()),
    ] {
        let virtual_time = number(&lab[key]["mean"]);
        assert!(
            (live / virtual_time - 1.0).abs() < 0.01,
            "{key}: {live} live, {virtual_time} in the lab"
        );
    }

    // From the plant to the lab: the window as a file, and the process behind it.
    let window = folder.path().join("window.json");
    let window_text = window.to_str().unwrap();
    bumpless(
        Some(&api),
        &["lab", "record", LOOP, "--last", "1000", "-o", window_text],
    );
    let fit: Value = serde_json::from_str(&bumpless(None, &["lab", "fit", window_text, "--json"])).unwrap();
    assert!((number(&fit["gain"]) - 1.0).abs() < 0.05, "{fit}");
    assert!((number(&fit["tau"]) - 1.5).abs() < 0.15, "{fit}");
    let recorded = experiment
        .replace(
            "plant = { model = \"fopdt\", fopdt = { gain = 1.0, tau_s = 1.5, dead_time_s = 0.3 } }",
            "plant = { model = \"recorded\", recorded = { file = \"window.json\" } }",
        )
        .replace("name = \"live\"", "name = \"window\"");
    assert!(number(&lab_figures(folder.path(), &recorded)["cycles"]["mean"]) > 100.0);

    // And back: the better of two tunings follows the live loop.
    let contest = experiment.replace("name = \"live\"", "name = \"contest\"")
        + "[[case]]\nname = \"slow\"\nset = { \"controller.parameters.ti\" = 9.0 }\n[[case]]\nname = \"plus\"\n\
           set = { \"controller.component\" = \"pidplus\" }\n";
    let file = folder.path().join("contest.toml");
    fs::write(&file, contest).unwrap();
    let (stock, out) = (components().unwrap(), folder.path().join("out"));
    let words = [
        "lab",
        "promote",
        file.to_str().unwrap(),
        LOOP,
        "--cycles",
        "20",
        "--wait",
        "--json",
        "--out",
        out.to_str().unwrap(),
        "--components",
        stock.to_str().unwrap(),
    ];
    let shadow: Value = serde_json::from_str(&bumpless(Some(&api), &words)).unwrap();
    assert!(text(&shadow["report"]["component"]).starts_with("pidplus@"), "{shadow}");
    assert_eq!(shadow["complete"], true, "{shadow}");
    assert_eq!(number(&shadow["report"]["parameters"]["ti"]), 1.2);
}

#[test]
fn a_plant_that_is_a_component_is_a_bus_of_a_live_host() {
    let options = CellOptions {
        bus: "[[bus]]\nid = \"tanks\"\ndriver = \"sim\"\nplant = \"component:quadruple-tank\"\nconstants = { noise = 0.01 }\n\
              step_ms = 5\n"
            .to_owned(),
        ..CellOptions::default()
    };
    components().unwrap();
    let mut cell = Cell::start(options.controllers(1)).unwrap();
    let api = cell.api().unwrap();
    let level = number(&api.point("tanks.h3").unwrap()["value"]);
    assert!((1.0..3.0).contains(&level), "{level}");
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&json!({
        "name": "h3",
        "component": "pid",
        "period_ms": 100.0,
        "ports": { "pv": "tanks.h3", "out": "tanks.v2" },
        "parameters": { "k": 20.0, "ti": 5.0, "out-high": 10.0 },
        "setpoint": 2.4,
    }))
    .unwrap();
    api.wait_for_loop("h3", "the level", |view| {
        view["measurement"].as_f64().is_some_and(|level| level > 2.2)
    })
    .unwrap();
    let bus = cell.plant.api().point("tanks.v2").unwrap();
    assert!(number(&bus["value"]) > 3.0, "{bus}");
}
