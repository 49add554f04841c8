//! A host in other people's hands: tried before it is started, watched by systemd, stopped with its outputs where they belong, copied and
//! brought back.

use std::{
    fs,
    net::TcpListener,
    os::unix::net::UnixDatagram,
    path::Path,
    process::{Output, Stdio},
    time::Duration,
};

use bumpless_tests::{Binary, Cell, CellOptions, FieldDevice, HostOptions, HostProcess, first_order_loop};
use serde_json::{Value, json};

fn bumpless(arguments: &[&str], folder: &Path) -> Output {
    Binary::find()
        .unwrap()
        .command()
        .args(arguments)
        .current_dir(folder)
        .env_remove("BUMPLESS_API")
        .stdin(Stdio::null())
        .output()
        .unwrap()
}

#[track_caller]
fn said(arguments: &[&str], folder: &Path, code: i32) -> String {
    let output = bumpless(arguments, folder);
    let said = [output.stdout, output.stderr].concat();
    let said = String::from_utf8_lossy(&said).into_owned();
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
    assert!(!said.contains("panicked"), "{said}");
    said
}

/// What people made, as far as a backup holds it.
fn made(cell: &mut Cell) -> Value {
    let api = cell.api().unwrap();
    let components: Vec<Value> = api
        .components()
        .unwrap()
        .iter()
        .map(|c| json!([c["digest"], c["note"], c["labels"]]))
        .collect();
    let loops: Vec<Value> = api
        .loops()
        .unwrap()
        .iter()
        .map(|l| {
            let mut spec = l["spec"].clone();
            // Written as a digest by the backup, and as a name where the library knows it.
            spec["component"] = l["digest"].clone();
            json!([spec, l["setpoint"], l["mode"]])
        })
        .collect();
    let alarms = api.get("/v1/alarms?all=true&quiet=true").unwrap();
    let alarms: Vec<Value> = alarms["alarms"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|alarm| alarm["loop"].as_str().is_some_and(|name| name.starts_with("loop-")))
        .map(|alarm| json!([alarm["loop"], alarm["name"], alarm["definition"]]))
        .collect();
    json!({"components": components, "loops": loops, "alarms": alarms})
}

#[test]
fn a_cell_is_brought_back_from_one_file_and_half_a_file_changes_nothing() {
    let options = || CellOptions::first_order("{ count = 2, tau_s = 1.0 }");
    let folder = tempfile::tempdir().unwrap();
    let before = {
        let mut cell = Cell::start(options()).unwrap();
        let api = cell.api().unwrap();
        api.upload_stock(&["pid", "pidplus"]).unwrap();
        for n in 0..2 {
            api.apply(&first_order_loop(n, "pid", 100.0)).unwrap();
        }
        api.setpoint("loop-0", 33.0).unwrap();
        api.mode("loop-1", "manual").unwrap();
        api.put(
            "/v1/loops/loop-0/alarms/high",
            &json!({"kind": "hi", "limit": 80.0, "priority": "high"}),
        )
        .unwrap();
        let address = api.base().to_owned();
        let told = said(&["backup", "-o", "cell.tar", "--api", &address], folder.path(), 0);
        assert!(told.contains("2 components, 2 loops"), "{told}");
        // A cell that has loops is no place for a restore.
        let told = said(&["restore", "cell.tar", "--api", &address], folder.path(), 3);
        assert!(told.contains("nothing was changed"), "{told}");
        made(&mut cell)
    };
    assert!(said(&["restore", "cell.tar", "--check"], folder.path(), 0).contains("whole: 2 components"));

    let mut cell = Cell::start(options()).unwrap();
    let address = cell.api().unwrap().base().to_owned();
    let bytes = fs::read(folder.path().join("cell.tar")).unwrap();
    fs::write(folder.path().join("half.tar"), &bytes[..bytes.len() / 2]).unwrap();
    let told = said(&["restore", "half.tar", "--api", &address], folder.path(), 3);
    assert!(told.contains("take another copy"), "{told}");
    assert_eq!(made(&mut cell), json!({"components": [], "loops": [], "alarms": []}));

    said(&["restore", "cell.tar", "--api", &address], folder.path(), 0);
    let api = cell.api().unwrap();
    for name in ["loop-0", "loop-1"] {
        api.wait_for_loop(name, "its first cycle", |view| view["seq"].as_u64() > Some(0))
            .unwrap();
    }
    let after = made(&mut cell);
    assert_eq!(after["components"], before["components"]);
    assert_eq!(after["alarms"], before["alarms"]);
    for (after, before) in after["loops"]
        .as_array()
        .unwrap()
        .iter()
        .zip(before["loops"].as_array().unwrap())
    {
        assert_eq!((&after[1], &after[2]), (&before[1], &before[2]), "{after}");
        for key in [
            "name",
            "component",
            "ports",
            "parameters",
            "limits",
            "policy",
            "period_ms",
        ] {
            assert_eq!(after[0][key], before[0][key], "{key}");
        }
    }
}

const LEAST: &str = "host = \"a\"\n[cell]\nname = \"demo\"\n";

#[test]
fn a_dry_run_says_what_a_start_would_and_touches_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let write = |text: &str| fs::write(folder.path().join("host.toml"), text).unwrap();
    let run = |code| said(&["host", "--config", "host.toml", "--dry-run"], folder.path(), code);
    let device = FieldDevice::start(1, 0).unwrap();
    let bus = format!(
        "[[bus]]\nid = \"plant\"\ndriver = \"modbus-tcp\"\naddress = \"{}\"\n[[bus.point]]\nid = \"plant.in\"\ntable = \"input\"\naddress = 0\nlow = 0\nhigh = 10\n",
        device.address(0)
    );
    write(&format!("{LEAST}[api]\nlisten = \"127.0.0.1:0\"\n{bus}"));
    let told = run(0);
    for part in [
        "store",
        "sandbox",
        "1 planned, 1 points",
        "no device was asked",
        "good: host a of cell demo",
    ] {
        assert!(told.contains(part), "{part:?} is missing in {told}");
    }
    // The same again: it let go of everything.
    run(0);
    assert_eq!(device.obeyed(), []);

    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    write(&format!("{LEAST}[api]\nlisten = \"{address}\"\n"));
    let told = run(1);
    assert!(
        told.contains(&address.to_string()) && told.contains("choose another address"),
        "{told}"
    );

    write(&format!(
        "{LEAST}[api]\nlisten = \"127.0.0.1:0\"\n{bus}{}",
        bus.replace("id = \"plant\"", "id = \"other\"")
    ));
    let told = run(1);
    assert!(told.contains("another point has this name"), "{told}");
}

fn host(folder: &Path, tables: &str, environment: Vec<(String, String)>) -> HostProcess {
    let options = HostOptions {
        name: "a".into(),
        cell: "test-operations".into(),
        tables: tables.into(),
        environment,
        ..HostOptions::default()
    };
    HostProcess::start(options, folder).unwrap()
}

#[test]
fn systemd_hears_that_the_host_is_ready_alive_and_stopping() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let heard = || {
        let mut bytes = [0; 512];
        let length = socket.recv(&mut bytes).unwrap();
        String::from_utf8_lossy(&bytes[..length]).into_owned()
    };
    let environment = vec![
        ("NOTIFY_SOCKET".to_owned(), path.display().to_string()),
        ("WATCHDOG_USEC".to_owned(), "900000".to_owned()),
    ];
    let mut host = host(&folder.path().join("a"), "", environment);
    let first = heard();
    assert!(first.contains("READY=1") && first.contains("STATUS=running"), "{first}");
    for _ in 0..3 {
        assert_eq!(heard().trim(), "WATCHDOG=1");
    }
    host.terminate().unwrap();
    let mut last = heard();
    while last.trim() == "WATCHDOG=1" {
        last = heard();
    }
    assert!(last.contains("STOPPING=1"), "{last}");
}

#[test]
fn a_stop_says_of_each_device_whether_its_outputs_are_safe() {
    let folder = tempfile::tempdir().unwrap();
    let device = FieldDevice::start(1, 0).unwrap();
    let bus = format!(
        "[[bus]]\nid = \"plant\"\ndriver = \"modbus-tcp\"\naddress = \"{}\"\non_stop = \"safe\"\ntimeout_ms = 200\n\
         [[bus.point]]\nid = \"plant.out\"\ntable = \"holding\"\naddress = 7\nlow = 0\nhigh = 100\nwritable = true\nsafe = 42\n",
        device.address(0)
    );
    let mut process = host(&folder.path().join("a"), &bus, vec![]);
    let connected = |process: &HostProcess| {
        process
            .api()
            .wait_until("the device to answer", |api| {
                let point = api.point("plant.out").map_err(|error| error.to_string())?;
                if point["quality"] == "good" {
                    Ok(())
                } else {
                    Err(point.to_string())
                }
            })
            .unwrap();
    };
    connected(&process);
    process.terminate().unwrap();
    assert_eq!(device.word(7), 42);
    let log = process.stderr();
    assert!(
        log.contains("every output is at its safe value, and the device confirmed it"),
        "{log}"
    );

    device.set_words(7, &[5]);
    process.restart().unwrap();
    connected(&process);
    device.cut(Some(0));
    process.terminate().unwrap();
    assert_eq!(device.word(7), 5);
    let log = process.stderr();
    assert!(log.contains("NOT confirmed at their safe values"), "{log}");
    assert_eq!(log.matches("look at the plant").count(), 1, "{log}");
}
