//! A real Modbus device behind the cell: an independent server (pymodbus), the example's own configuration and loop.

use std::{
    fs::{self, File},
    io::{BufRead as _, BufReader, Read as _},
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, Stdio},
};

use bumpless_tests::{Api, Cell, CellOptions, PLANT, Watchdog, repository};
use serde_json::Value;

use crate::{number, settle, text, whole};

const LOOP: &str = "temperature";

/// What the heater's register counts, per %.
const COUNTS: f64 = 100.0;

/// Python with the example's packages.
fn python() -> PathBuf {
    python_with("modbus-python", &example("requirements.txt"))
}

/// Python with some packages, in a folder of its own under the target folder; made once.
pub(crate) fn python_with(name: &str, requirements: &Path) -> PathBuf {
    let components = bumpless_tests::components().unwrap();
    let folder = components.parent().unwrap().join(name);
    fs::create_dir_all(&folder).unwrap();
    // Two test processes must not build one environment.
    let lock = File::create(folder.join(".lock")).unwrap();
    lock.lock().unwrap();
    let wanted = fs::read_to_string(requirements).unwrap();
    let python = folder.join("bin/python");
    let stamp = folder.join("installed.txt");
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) {
        return python;
    }
    let step = |what: &str, command: &mut Command| {
        let output = command.stdin(Stdio::null()).output().unwrap_or_else(|error| {
            panic!("{what}: {error}; install python3 with venv and pip (Debian: python3-venv)")
        });
        assert!(
            output.status.success(),
            "{what} failed; install python3 with venv and pip (Debian: python3-venv):\n{}{}",
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
    };
    step(
        "python3 -m venv",
        Command::new("python3").args(["-m", "venv"]).arg(&folder),
    );
    step(
        "pip install",
        Command::new(&python)
            .args([
                "-m",
                "pip",
                "install",
                "--quiet",
                "--disable-pip-version-check",
                "--requirement",
            ])
            .arg(requirements),
    );
    fs::write(&stamp, wanted).unwrap();
    python
}

fn example(file: &str) -> PathBuf {
    repository().join("examples/modbus-plant").join(file)
}

/// A Python program of ours; it ends with the test.
struct Peer {
    child: Child,
    stdout: BufReader<ChildStdout>,
    watchdog: Option<Watchdog>,
}

impl Peer {
    /// Its error output goes to a file beside the interpreter: a Modbus server has much to say about hosts that get killed.
    fn start(python: &Path, script: &Path, arguments: &[&str]) -> Self {
        let errors = python.parent().unwrap().join("peers.log");
        let errors = File::options().create(true).append(true).open(errors).unwrap();
        let mut child = Command::new(python)
            .arg(script)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(errors)
            .spawn()
            .unwrap();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        let watchdog = Some(Watchdog::over(&child).unwrap());
        Self {
            child,
            stdout,
            watchdog,
        }
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.stdout.read_line(&mut line).unwrap();
        line.trim().to_owned()
    }

    fn kill(&mut self) {
        self.watchdog.take();
        let _gone = self.child.kill().and_then(|()| self.child.wait());
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.kill();
    }
}

/// A quicker oven than the example's, so that a test need not wait for minutes.
fn oven(python: &Path, port: u16) -> (Peer, u16) {
    let port_text = port.to_string();
    let arguments = ["--port", &port_text, "--tau", "2", "--dead-time", "0.2"];
    let mut peer = Peer::start(python, &example("server.py"), &arguments);
    let line = peer.line();
    let port = line.rsplit_once(':').and_then(|(_, port)| port.parse().ok());
    (
        peer,
        port.unwrap_or_else(|| panic!("the oven says {line:?}; target/modbus-python/bin/peers.log may say why")),
    )
}

/// Watches the heater's register at the device itself.
struct Watch(Peer);

impl Watch {
    fn start(python: &Path, port: u16) -> (Self, f64) {
        let script = repository().join("tests/peers/register.py");
        let mut peer = Peer::start(python, &script, &[&port.to_string(), "0"]);
        let first = peer.line().parse::<f64>().unwrap() / COUNTS;
        (Self(peer), first)
    }

    /// The least and the greatest value since the start, in %.
    fn range(mut self) -> (f64, f64) {
        drop(self.0.child.stdin.take());
        let mut rest = String::new();
        self.0.stdout.read_to_string(&mut rest).unwrap();
        let mut values = rest
            .split_whitespace()
            .map(|word| word.parse::<f64>().unwrap() / COUNTS);
        (values.next().unwrap(), values.next().unwrap())
    }
}

/// The example's loop, tuned for the quicker oven (lambda = 1 s, as the file has it for 20 s).
fn draft() -> Value {
    let text = fs::read_to_string(example("loop.toml")).unwrap();
    let mut draft: Value = toml::from_str(&text).unwrap();
    draft["parameters"]["k"] = 1.1.into();
    draft["parameters"]["ti"] = 2.0.into();
    draft
}

fn running_cell(port: u16) -> Cell {
    let bus = fs::read_to_string(example("host.toml")).unwrap();
    assert!(bus.contains("127.0.0.1:5020"), "the example's address");
    let options = CellOptions {
        controllers: 2,
        bus: bus.replace("127.0.0.1:5020", &format!("127.0.0.1:{port}")),
        ..CellOptions::default()
    };
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    api.wait_until("the oven's temperature", |api| {
        let point = api.point("oven.temperature").unwrap();
        if point["quality"] == "good" { Ok(()) } else { Err(point) }
    })
    .unwrap();
    api.apply(&draft()).unwrap();
    cell
}

fn measured(record: &Value) -> &Value {
    let readings = record["readings"].as_array().unwrap();
    readings.iter().find(|reading| reading["port"] == "pv").unwrap()
}

#[test]
fn a_modbus_device_is_controlled_lost_and_found() {
    let python = python();
    let (mut device, port) = oven(&python, 0);
    let mut cell = running_cell(port);
    let api = cell.api().unwrap();
    settle(&api, LOOP, 1.0);
    let (watch, at_device) = Watch::start(&python, port);
    // 80 °C = 20 °C + 1.5 °C/% · 40 %.
    assert!((at_device - 40.0).abs() < 4.0, "the device itself has {at_device} %");
    watch.range();

    device.kill();
    lost(&api);
    let (_device, again) = oven(&python, port);
    assert_eq!(again, port);
    let feed = api.live(&format!("?loops={LOOP}")).unwrap();
    feed.record_where("a good measurement again", |r| measured(r)["quality"] == "good")
        .unwrap();
    // The new oven is cold: it is heated up again.
    settle(&api, LOOP, 1.0);
}

/// The device is gone: the reading says so, and the output holds.
fn lost(api: &Api) {
    let feed = api.live(&format!("?loops={LOOP}")).unwrap();
    let first = feed
        .record_where("a bad measurement", |record| measured(record)["quality"] == "bad")
        .unwrap();
    let reading = measured(&first);
    assert!(reading["reason"].is_string() && reading["fresh"] == false, "{reading}");
    let events = first["events"].as_array().unwrap();
    assert!(events.iter().any(|e| e["kind"] == "bad-input"), "{events:?}");
    let held = number(&first["outputs"]["out"]);
    for _ in 0..10 {
        let record = feed.record().unwrap();
        let out = number(&record["outputs"]["out"]);
        assert_eq!(out.to_bits(), held.to_bits(), "the policy holds the output: {record}");
    }
    let point = api.point("oven.temperature").unwrap();
    assert_eq!(point["quality"], "bad");
    assert!(!text(&point["reason"]).is_empty(), "{point}");
}

#[test]
fn an_actuator_that_keeps_its_value_feels_nothing_of_a_cold_restart() {
    let python = python();
    let (_device, port) = oven(&python, 0);
    let mut cell = running_cell(port);
    let api = cell.api().unwrap();
    // Another setpoint than the file's, so that what was commanded is seen to last.
    api.setpoint(LOOP, 95.0).unwrap();
    settle(&api, LOOP, 0.5);
    let before = api.loop_view(LOOP).unwrap();
    let (watch, first) = Watch::start(&python, port);
    for host in cell.hosts_mut() {
        host.kill9();
    }
    for name in [PLANT, "a", "b"] {
        cell.restart(name).unwrap();
    }
    cell.wait_joined().unwrap();
    let after = api
        .wait_for_loop(LOOP, "twenty cycles more", |view| {
            view["seq"].as_u64() > before["seq"].as_u64().map(|seq| seq + 20)
        })
        .unwrap();
    assert!(whole(&after["term"]) > whole(&before["term"]));
    assert_eq!(after["setpoint"], 95.0);
    let (low, high) = watch.range();
    // 50 % by 95 °C. Noise moves the output by a fraction of a percent; a controller that begins anew would move it by tens.
    assert!(
        first - low < 3.0 && high - first < 3.0,
        "the device had {first} % and then saw {low} to {high} %"
    );
}
