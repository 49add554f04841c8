//! Points by hand, forces and jobs, on a simulated plant and on a Modbus device; and the command line for them.

use std::{process::Output, time::Duration};

use bumpless_tests::{Api, Binary, Cell, CellOptions, Event, FieldDevice, PLANT, pressure_loop, wait_until};
use serde_json::{Value, json};

use crate::{number, text};

/// A bus on the device with an input, an output and two jobs.
fn device_bus(device: &FieldDevice) -> String {
    format!(
        r#"
[[bus]]
id = "line"
driver = "modbus-tcp"
address = "{}"
period_ms = 50
timeout_ms = 5000

[[bus.job]]
name = "set-range"
text = "0 to 150"
step = [
    {{ write = {{ table = "holding", address = 100, values = [0, 1500] }} }},
    {{ expect = {{ table = "holding", address = 101, values = [1500], within_ms = 5000 }} }},
    {{ read = {{ table = "holding", address = 100, count = 2 }} }},
]

[[bus.job]]
name = "never"
timeout_ms = 1000
step = [{{ expect = {{ table = "holding", address = 200, values = [7], within_ms = 200 }} }}]

[[bus.point]]
id = "line.level"
table = "input"
address = 0
unit = "%"
low = 0.0
high = 10000.0

[[bus.point]]
id = "line.valve"
table = "holding"
address = 10
unit = "%"
low = 0.0
high = 100.0
writable = true
"#,
        device.address(0)
    )
}

pub(crate) fn device_cell(device: &FieldDevice) -> Cell {
    let mut cell = Cell::start(CellOptions {
        controllers: 1,
        bus: device_bus(device),
        ..CellOptions::default()
    })
    .unwrap();
    cell.api()
        .unwrap()
        .wait_until("the device answers", |api| {
            let point = api.get("/v1/points/line.valve").unwrap();
            if point["quality"] == "good" { Ok(()) } else { Err(point) }
        })
        .unwrap();
    cell
}

fn status(api: &Api, method: &str, path: &str, body: &Value) -> (u16, Value) {
    let answer = api
        .send(
            method,
            path,
            &[("content-type", "application/json")],
            body.to_string().as_bytes(),
        )
        .unwrap();
    (answer.status, answer.json())
}

fn ended(api: &Api, id: &str) -> Value {
    api.wait_until("the job's end", |api| {
        let job = api.get(&format!("/v1/jobs/{id}")).unwrap();
        if matches!(text(&job["state"]).as_str(), "queued" | "running") {
            Err(job)
        } else {
            Ok(job)
        }
    })
    .unwrap()
}

#[test]
fn a_force_outlives_the_owner_and_the_host_and_the_loop_comes_back_without_a_bump() {
    let mut cell = Cell::start(CellOptions::default().controllers(2)).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let draft = pressure_loop("pid", 50.0);
    let output = text(&draft["ports"]["out"]);
    let name = text(&draft["name"]);
    api.apply(&draft).unwrap();
    api.wait_for_loop(&name, "some cycles", |view| view["seq"].as_u64() > Some(10))
        .unwrap();

    let refused = status(
        &api,
        "POST",
        &format!("/v1/points/{output}/write"),
        &json!({"value": 1.0, "by": "test"}),
    );
    assert_eq!(refused.0, 409, "a loop writes it: {}", refused.1);
    let force = json!({"value": 3.25, "seconds": 600, "by": "test", "why": "stroke test"});
    let forced = api.post(&format!("/v1/points/{output}/force"), &force).unwrap();
    assert_eq!(
        (&forced["quality"], number(&forced["value"])),
        (&json!("forced"), 3.25),
        "{forced}"
    );

    let owner = text(&api.loop_view(&name).unwrap()["owner"]);
    if owner == PLANT {
        cell.host("a").unwrap().kill9();
    } else {
        cell.host(&owner).unwrap().kill9();
    }
    let held = |api: &Api, what: &str| {
        api.wait_until(what, |api| {
            let point = api.get(&format!("/v1/points/{output}")).unwrap();
            let forced = point["quality"] == "forced" && point["value"] == 3.25 && point["force"]["by"] == "test";
            if forced { Ok(point) } else { Err(point) }
        })
        .unwrap()
    };
    held(&api, "forced while another host owns the loop");
    // A cold restart of the I/O host: the force is in place before a loop writes.
    cell.host(PLANT).unwrap().kill9();
    cell.restart(PLANT).unwrap();
    cell.wait_joined().unwrap();
    let api = cell.api().unwrap();
    let again = held(&api, "forced after a restart");
    assert_eq!(again["force"]["why"], "stroke test");
    let seq = api.loop_view(&name).unwrap()["seq"].as_u64();
    api.wait_for_loop(&name, "cycles under force", |view| {
        view["seq"].as_u64() > seq.map(|seq| seq + 20)
    })
    .unwrap();
    held(&api, "forced while the loop runs");

    let feed = api.live(&format!("?loops={name}")).unwrap();
    api.post(&format!("/v1/points/{output}/unforce"), &json!({"by": "test"}))
        .unwrap();
    let free = feed
        .record_where("the end of the force", |record| {
            let events = record["events"].as_array().unwrap();
            events.iter().any(|event| event["kind"] == "unforced")
        })
        .unwrap();
    // It starts from what the actuator holds: what it sends next is that, not where it was before the force.
    let sent = number(&free["outputs"]["out"]);
    assert!((sent - 3.25).abs() < 0.01, "{sent} V after 3.25 V were held");
    // And whoever repeats the recorded steps begins anew in the same cycle, to the last bit.
    let after = feed
        .record_where("cycles after the force", |record| {
            record["seq"].as_u64() > free["seq"].as_u64().map(|seq| seq + 10)
        })
        .unwrap();
    assert!((number(&after["outputs"]["out"]) - sent).abs() < 2.0, "{after}");
    let replayed = api
        .wait_until("a replay past the end of the force", |api| {
            let replay = api
                .post(&format!("/v1/loops/{name}/replay"), &json!({ "last": "60" }))
                .unwrap();
            if replay["compared"].as_u64() >= Some(40) {
                Ok(replay)
            } else {
                Err(replay)
            }
        })
        .unwrap();
    assert!(replayed["first_difference"].is_null(), "{replayed}");
    assert_eq!(replayed["compared"], replayed["equal"], "{replayed}");
    let journal = std::fs::read_to_string(cell.folder().join(PLANT).join("writes.csv")).unwrap();
    assert!(
        journal.lines().any(|line| line.starts_with("#forced,")),
        "the actuators' log tells of forced commits"
    );
    let (code, problem) = status(
        &api,
        "POST",
        &format!("/v1/points/{output}/unforce"),
        &json!({"by": "test"}),
    );
    assert_eq!(code, 409, "{problem}");
}

#[test]
fn a_forced_input_is_what_the_loop_sees_and_ends_by_itself() {
    let mut cell = Cell::start(CellOptions::default().controllers(1)).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let draft = pressure_loop("pid", 50.0);
    let input = text(&draft["ports"]["pv"]);
    api.apply(&draft).unwrap();
    let feed = api.live("").unwrap();
    let force = json!({"value": 1.75, "seconds": 2, "by": "test", "why": "a broken wire"});
    let news = api.live("").unwrap();
    api.post(&format!("/v1/points/{input}/force"), &force).unwrap();
    let told = |kind: &str| {
        let is = |event: &Event| event.name == "field" && event.data[kind]["point"] == input.as_str();
        news.event_where(kind, is).unwrap().data[kind].clone()
    };
    let forced = told("forced");
    assert_eq!(
        (
            number(&forced["force"]["value"]),
            &forced["force"]["why"],
            &forced["host"]
        ),
        (1.75, &json!("a broken wire"), &json!(PLANT)),
        "{forced}"
    );
    feed.record_where("the forced measurement", |record| {
        let readings = record["readings"].as_array().unwrap();
        let pv = readings.iter().find(|reading| reading["port"] == "pv").unwrap();
        pv["quality"] == "forced" && pv["value"] == 1.75
    })
    .unwrap();
    feed.record_where("the end by itself", |record| {
        let events = record["events"].as_array().unwrap();
        events.iter().any(|event| event["kind"] == "unforced")
    })
    .unwrap();
    assert_eq!(told("unforced")["by"], "its time was over");
    let bad = json!({"value": 1.75, "seconds": 90_000, "by": "test", "why": "too long"});
    let (code, problem) = status(&api, "POST", &format!("/v1/points/{input}/force"), &bad);
    assert_eq!(code, 422, "{problem}");
    assert!(text(&problem["detail"]).contains("1 s to 24 h"), "{problem}");
}

#[test]
fn jobs_are_acknowledged_at_once_however_slow_the_device_is() {
    let device = FieldDevice::start(1, 900).unwrap();
    let mut cell = device_cell(&device);
    // Asked at another host than the device's: the job goes there.
    let api = cell.api_of("a").unwrap();
    let job = api
        .post(
            "/v1/jobs",
            &json!({"bus": "line", "name": "set-range", "by": "test", "key": "k1"}),
        )
        .unwrap();
    let done = ended(&api, &text(&job["id"]));
    assert_eq!(
        (&done["state"], &done["result"][0]["values"]),
        (&json!("done"), &json!([0, 1500])),
        "{done}"
    );
    assert_eq!((device.word(100), device.word(101)), (0, 1500));

    let failed = api
        .post("/v1/jobs", &json!({"bus": "line", "name": "never", "by": "test"}))
        .unwrap();
    let failed = ended(&api, &text(&failed["id"]));
    assert_eq!(failed["state"], "failed");
    assert!(
        text(&failed["reason"]).contains("step 1: unit 1, holding registers 200 to 200: [7] did not come"),
        "{failed}"
    );

    // Four seconds for every answer: the acknowledgement and all that is answered from memory come before the device's.
    device.set_delay(Duration::from_secs(4));
    let read = json!({"bus": "line", "by": "test", "read_block": {"table": "holding", "address": 100, "count": 2}});
    let slow = api.post("/v1/jobs", &read).unwrap();
    assert!(matches!(text(&slow["state"]).as_str(), "queued" | "running"), "{slow}");
    let again = json!({"bus": "line", "name": "set-range", "by": "test", "key": "k1"});
    assert_eq!(
        api.post("/v1/jobs", &again).unwrap()["id"],
        job["id"],
        "the key names the same job"
    );
    assert_eq!(api.get("/v1/points/line.valve").unwrap()["name"], "line.valve");
    assert!(api.get("/v1/buses").unwrap()["buses"].is_array());
    let pending = api.get(&format!("/v1/jobs/{}", text(&slow["id"]))).unwrap();
    assert!(
        matches!(text(&pending["state"]).as_str(), "queued" | "running"),
        "what is answered from memory came first: {pending}"
    );
    let waiting: Vec<Value> = (0..16).map_while(|_| api.post("/v1/jobs", &read).ok()).collect();
    let (code, problem) = status(&api, "POST", "/v1/jobs", &read);
    assert_eq!(code, 503, "the queue is full: {problem}");
    let last = text(&waiting.last().unwrap()["id"]);
    let cancelled = api
        .post(&format!("/v1/jobs/{last}/cancel"), &json!({"by": "test"}))
        .unwrap();
    assert_eq!(cancelled["state"], "cancelled");
    let running = text(&slow["id"]);
    device.set_delay(Duration::ZERO);
    assert_eq!(ended(&api, &running)["state"], "done");
}

#[test]
fn a_job_stays_out_of_a_loops_way() {
    let device = FieldDevice::start(1, 900).unwrap();
    let mut cell = device_cell(&device);
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let written = api
        .post("/v1/points/line.valve/write", &json!({"value": 12.0, "by": "test"}))
        .unwrap();
    assert_eq!(written["name"], "line.valve");
    wait_until("the device has it", Duration::from_secs(10), || match device.word(10) {
        12 => Ok(()),
        other => Err(other),
    })
    .unwrap();
    api.apply(&json!({
        "name": "level", "component": "pid", "period_ms": 100.0, "setpoint": 5000.0, "setpoint_range": [0.0, 10000.0],
        "ports": {"pv": "line.level", "out": "line.valve"}, "parameters": {"k": 0.01, "ti": 10.0}
    }))
    .unwrap();
    let write =
        json!({"bus": "line", "by": "test", "write_block": {"table": "holding", "address": 9, "values": [1, 2]}});
    let (code, problem) = status(&api, "POST", "/v1/jobs", &write);
    assert_eq!(code, 409, "{problem}");
    assert!(
        text(&problem["detail"]).contains("point line.valve, which loop level writes"),
        "{problem}"
    );
    let beside =
        json!({"bus": "line", "by": "test", "write_block": {"table": "holding", "address": 11, "values": [1, 2]}});
    let job = api.post("/v1/jobs", &beside).unwrap();
    assert_eq!(ended(&api, &text(&job["id"]))["state"], "done");
    assert_eq!((device.word(11), device.word(12)), (1, 2));
}

#[track_caller]
fn said(output: &Output, code: i32) -> String {
    let text = format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    assert_eq!(output.status.code(), Some(code), "{text}");
    text
}

#[test]
fn point_lists_go_round_and_the_command_line_asks_the_device() {
    let device = FieldDevice::start(1, 900).unwrap();
    let mut cell = device_cell(&device);
    let config = cell.host(PLANT).unwrap().config_path();
    let config = config.to_str().unwrap();
    let api = cell.api().unwrap().base().to_owned();
    let folder = tempfile::tempdir().unwrap();
    let list = folder.path().join("points.csv");
    let list = list.to_str().unwrap();
    let binary = Binary::find().unwrap();
    let run = |words: &[&str]| {
        binary
            .command()
            .arg("io")
            .args(words)
            .args(["--api", &api])
            .output()
            .unwrap()
    };

    said(&run(&["export", "--config", config, "--bus", "line", "-o", list]), 0);
    let csv = std::fs::read_to_string(list).unwrap();
    assert!(csv.contains("line.valve,holding,10"), "{csv}");
    // As a spreadsheet of another country writes it, with one point more.
    let more = csv.trim_end().replace(',', ";") + "\r\nline.spare;holding;20;;;;;;0,5;;;;;;;0;10;FALSE;;\r\n";
    std::fs::write(list, more).unwrap();
    let copy = folder.path().join("host.toml");
    std::fs::copy(config, &copy).unwrap();
    let copy = copy.to_str().unwrap();
    let shown = said(&run(&["import", list, "--config", copy, "--bus", "line"]), 0);
    assert!(
        shown.contains("[[bus.point]]") && shown.contains("id = \"line.spare\""),
        "{shown}"
    );
    said(&run(&["import", list, "--config", copy, "--bus", "line", "--write"]), 0);
    let map = said(&run(&["map", "--config", copy]), 0);
    assert!(
        map.contains("line.spare") && map.contains("3 holding registers"),
        "{map}"
    );
    std::fs::write(list, "id,table,address\nx,holding,70000\n").unwrap();
    let wrong = said(&run(&["import", list, "--config", copy, "--bus", "line"]), 1);
    assert!(wrong.contains("line 2, column 3 (address)"), "{wrong}");

    let found = said(
        &run(&[
            "scan",
            &device.address(0),
            "--units",
            "1",
            "--table",
            "holding",
            "--last",
            "1200",
        ]),
        0,
    );
    assert!(found.contains("0 to 999"), "{found}");
    let read = said(&run(&["read", "line.valve"]), 0);
    assert!(read.contains("line.valve = "), "{read}");
    said(&run(&["write", "line.valve", "7", "--by", "test"]), 0);
    said(
        &run(&[
            "force",
            "line.valve",
            "9",
            "--for",
            "10m",
            "--why",
            "test",
            "--by",
            "test",
        ]),
        0,
    );
    let forced = said(&run(&["forced"]), 0);
    assert!(forced.contains("line.valve"), "{forced}");
    said(&run(&["write", "line.valve", "7", "--by", "test"]), 3);
    said(&run(&["unforce", "line.valve", "--by", "test"]), 0);
    let job = said(
        &run(&[
            "job",
            "start",
            "line",
            "read-block",
            "--table",
            "holding",
            "--address",
            "10",
            "--count",
            "1",
            "--wait",
        ]),
        0,
    );
    assert!(job.contains("done") && job.contains("10: 9"), "{job}");
    let buses = said(&run(&["buses"]), 0);
    assert!(buses.contains("set-range"), "{buses}");
}
