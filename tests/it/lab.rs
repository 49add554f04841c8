//! The lab and a live cell agree, and each can go on with what the other found.

use std::{fs, path::Path};

use bumpless_core::indices::{Indices, Rule, StepResponse, TotalVariation};
use bumpless_tests::{Api, Binary, Cell, CellOptions, HostOptions, HostProcess, components, first_order_loop};
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

/// Recorded cycles of a loop, oldest first.
fn recorded(api: &Api, name: &str) -> Vec<Value> {
    let answer = api.get(&format!("/v1/loops/{name}/cycles?last=1000")).unwrap();
    answer["records"].as_array().unwrap().clone()
}

/// Holds the figures of recorded cycles, from the first under the setpoint `up` to the last, against those of the lab.
#[track_caller]
fn agree(records: &[Value], up: f64, band_percent: f64, lab: &Value) {
    let first = records.iter().position(|r| number(&r["setpoint"]) == up).unwrap();
    let t_s = |r: &Value| r["at_unix_us"].as_u64().unwrap() as f64 * 1e-6;
    let start_s = t_s(&records[first]);
    let (mut indices, mut travel) = (Indices::new(Rule::Rectangle), TotalVariation::default());
    travel.add(number(&records[first - 1]["outputs"]["out"]));
    let (mut before, mut step) = (number(&records[first - 1]["setpoint"]), None::<StepResponse>);
    let (mut overshoot, mut settlings) = (0.0_f64, Vec::new());
    for r in &records[first..] {
        let (t, setpoint, measurement) = (t_s(r) - start_s, number(&r["setpoint"]), number(&r["measurement"]));
        indices.add(t, setpoint, measurement).unwrap();
        travel.add(number(&r["outputs"]["out"]));
        if setpoint != before {
            let ended = step.replace(StepResponse::new(t, before, setpoint, band_percent).unwrap());
            overshoot = ended
                .iter()
                .map(StepResponse::overshoot_percent)
                .fold(overshoot, f64::max);
            settlings.extend(ended.and_then(|s| s.settling_time_s()));
            before = setpoint;
        }
        step.as_mut().unwrap().add(t, measurement).unwrap();
    }
    let last = step.unwrap();
    overshoot = overshoot.max(last.overshoot_percent());
    settlings.extend(last.settling_time_s());
    let settling = settlings.iter().sum::<f64>() / settlings.len() as f64;
    let of = |key: &str| number(&lab[key]["mean"]);
    for (key, live) in [
        ("iae", indices.iae()),
        ("ise", indices.ise()),
        ("itae", indices.itae()),
        ("itse", indices.itse()),
        ("id", indices.id_percent().unwrap()),
        ("tv", travel.value()),
    ] {
        assert!(
            (live / of(key) - 1.0).abs() < 0.01,
            "{key}: {live} live, {} in the lab",
            of(key)
        );
    }
    // In % of the step, and to a cycle: more a sampled response does not say.
    assert!(
        (overshoot - of("overshoot")).abs() < 0.5,
        "overshoot: {overshoot} live, {} in the lab",
        of("overshoot")
    );
    let period_s = PERIOD_MS * 1e-3;
    assert!(
        (settling - of("settling")).abs() < period_s * 1.01 + 0.01 * settling,
        "settling: {settling} live, {} in the lab",
        of("settling")
    );
}

fn cycles_pass(api: &Api, count: u64) {
    cycles_pass_of(api, LOOP, count);
}

fn cycles_pass_of(api: &Api, name: &str, count: u64) {
    let seen = api.loop_view(name).unwrap()["seq"].as_u64().unwrap();
    api.wait_for_loop(name, "further cycles", |view| {
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
    let records = recorded(&api, LOOP);
    let first = |setpoint: f64| records.iter().position(|r| number(&r["setpoint"]) == setpoint).unwrap();
    let (up, down) = (first(40.0), first(30.0));

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
    agree(&records, 40.0, 5.0, &lab);

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
fn a_live_pilot_plant_has_the_figures_of_the_lab() {
    let pilot = "{ noise = 0.0, adc_bits = 16 }";
    let bus = format!("[[bus]]\nid = \"plant\"\ndriver = \"sim\"\nseed = 7\nplant = {pilot}\n");
    let mut cell = Cell::start(
        CellOptions {
            bus,
            ..CellOptions::default()
        }
        .controllers(2),
    )
    .unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&json!({
        "name": "vessel",
        "component": "pid",
        "period_ms": PERIOD_MS,
        "ports": { "pv": "plant.pit129", "out": "plant.p1" },
        "parameters": { "k": 20.0, "ti": 6.0, "out-high": 10.0 },
        "setpoint": 0.4,
        "strategy": "round-robin",
    }))
    .unwrap();
    api.wait_for_loop("vessel", "a first cycle", |view| view["seq"].is_number())
        .unwrap();
    cycles_pass_of(&api, "vessel", 40);
    api.setpoint("vessel", 0.7).unwrap();
    // It has settled after about 12 s.
    cycles_pass_of(&api, "vessel", 150);
    let records = recorded(&api, "vessel");
    let up = records.iter().position(|r| number(&r["setpoint"]) == 0.7).unwrap();
    // The plant stands until the first output, so both begin with the first cycle: the lab's is one period after its start.
    let period_s = PERIOD_MS * 1e-3;
    let up_s = (up + 1) as f64 * period_s;
    let folder = tempfile::tempdir().unwrap();
    let experiment = format!(
        r#"
name = "pilot"
duration_s = {end}
plant = {{ model = "pilot", pilot = {pilot} }}
controller = {{ component = "pid", parameters = {{ k = 20.0, ti = 6.0, out-high = 10.0 }} }}
measure = {{ from_s = {up_s}, of = "measured" }}
[[loop]]
name = "{LOOP}"
ports = {{ pv = "pit129", out = "p1" }}
period_ms = {PERIOD_MS}
setpoint = [{{ at_s = 0, to = 0.4 }}, {{ at_s = {up_s}, to = 0.7 }}]
"#,
        end = up_s + (records.len() - 1 - up) as f64 * period_s,
    );
    agree(&records, 0.7, 5.0, &lab_figures(folder.path(), &experiment));
}

#[test]
fn two_processes_write_the_same_bytes_and_a_report_can_be_written_again() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("twice.toml");
    let text = r#"
name = "twice"
duration_s = 60
seeds = 3
plant = { model = "component:fopdt", constants = { gain = 1.0, tau = 2.0, dead-time = 0.6, noise = 0.1 } }
controller = { component = "pid", parameters = { k = 0.6, ti = 2.2 } }
[[loop]]
name = "l"
ports = { pv = "pv", out = "out" }
period_ms = 500
strategy = "random"
setpoint = [{ at_s = 0, to = 20 }, { at_s = 10, to = 40 }]
[network]
reads = { loss = { kind = "random", probability = 0.2 } }
[cell]
link = { delay = { kind = "uniform", least_ms = 0.1, most_ms = 5.0 } }
[[cell.host]]
name = "a"
[[cell.host]]
name = "b"
[[case]]
name = "pid"
[[case]]
name = "pidplus"
set = { "controller.component" = "pidplus" }
"#;
    fs::write(&file, text).unwrap();
    let stock = components().unwrap();
    let lab = |what: &str, out: &Path, more: &[&str]| {
        let mut words = vec!["lab", what, file.to_str().unwrap(), "--out", out.to_str().unwrap()];
        words.extend(["--components", stock.to_str().unwrap()]);
        words.extend(more);
        bumpless(None, &words)
    };
    let names = ["twice.html", "twice.csv", "twice-curves.csv", "twice.json"];
    let files = |out: &Path| names.map(|name| fs::read(out.join(name)).unwrap());
    let (one, other) = (folder.path().join("one"), folder.path().join("other"));
    // Processes of their own, one run after another and two at a time.
    lab("run", &one, &["--jobs", "1"]);
    lab("run", &other, &["--jobs", "2", "--fresh"]);
    let first = files(&one);
    assert!(first == files(&other), "the same file and seeds give the same bytes");
    assert!(first.iter().all(|bytes| bytes.len() > 500));
    // Written again from what was kept: the same bytes, and nothing was made anew.
    let kept = || {
        let mut kept: Vec<_> = fs::read_dir(one.join("kept"))
            .unwrap()
            .map(|entry| entry.unwrap())
            .map(|entry| (entry.file_name(), entry.metadata().unwrap().modified().unwrap()))
            .collect();
        kept.sort();
        kept
    };
    let before = kept();
    assert_eq!(before.len(), 6);
    fs::remove_file(one.join("twice.html")).unwrap();
    let said = lab("report", &one, &[]);
    assert!(said.contains("report: "), "{said}");
    assert!(first == files(&one) && before == kept());
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

#[test]
fn a_plant_is_uploaded_and_run_by_a_host_that_never_saw_its_file() {
    const BUS: &str = "[roles]\nio = true\ncontrol = false\n[[bus]]\nid = \"tank\"\ndriver = \"sim\"\n\
                       plant = \"library:integrating\"\nconstants = { start = 5.0 }\n";
    let mut cell = Cell::start(CellOptions::default().controllers(1)).unwrap();
    let api = cell.api_of("a").unwrap();
    let file = components().unwrap().join("plants/integrating.wasm");
    let info = api.upload(&file).unwrap();
    assert_eq!(
        (&info["name"], &info["world"], &info["admission"]["verdict"]),
        (
            &json!("integrating"),
            &json!("bumpless:control/plant@0.1.0"),
            &json!("passed")
        ),
        "{info}"
    );
    // A loop says that it cannot run it.
    let refused = api.apply(&json!({
        "name": "x", "component": "integrating", "period_ms": 100.0, "setpoint": 1.0,
        "ports": {"pv": "plant.pit129", "out": "plant.p1"},
    }));
    let said = refused.expect_err("a plant is no law").to_string();
    assert!(said.contains("is a plant, and no controller"), "{said}");

    let folder = tempfile::tempdir().unwrap();
    let other = cell.host("a").unwrap();
    let (name, connect) = (other.cell_name().to_owned(), other.cell.clone());
    let options = |tables: &str| HostOptions {
        name: "tanks".to_owned(),
        cell: name.clone(),
        connect: connect.clone(),
        tables: tables.to_owned(),
        ..HostOptions::default()
    };
    // The library is not on this disk yet, and the host says what to do.
    let said = HostProcess::start(options(BUS), folder.path())
        .expect_err("nothing is on its disk")
        .to_string();
    assert!(
        said.contains("upload it at any host of the cell while this one runs"),
        "{said}"
    );
    {
        let host = HostProcess::start(options("[roles]\nio = false\ncontrol = true\n"), folder.path()).unwrap();
        host.api()
            .wait_until("the copy of the library", |api| {
                let all = api.components().unwrap();
                if all.iter().any(|one| one["name"] == "integrating") {
                    Ok(())
                } else {
                    Err(all)
                }
            })
            .unwrap();
    }
    let host = HostProcess::start(options(BUS), folder.path()).unwrap();
    let own = host.api();
    assert!((number(&own.point("tank.pv").unwrap()["value"]) - 5.0).abs() < 0.5);
    own.post("/v1/points/tank.out/write", &json!({"value": 10.0, "by": "test"}))
        .unwrap();
    own.wait_until("the level rises", |api| {
        let level = api.point("tank.pv").unwrap();
        if number(&level["value"]) > 6.0 {
            Ok(())
        } else {
            Err(level)
        }
    })
    .unwrap();
}
