//! Strangers read the document, the metrics and the traces: Schemathesis, a generated client, Prometheus' parser, OpenTelemetry's
//! messages. None of them knows our code, so what they understand is what we say.

use std::{
    fs::{self, File},
    io::{BufRead as _, BufReader},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Duration,
};

use bumpless_tests::{Api, Cell, CellOptions, Watchdog, first_order_loop, repository, wait_until};
use serde_json::json;

/// Requests that Schemathesis makes up for one operation, at most. A run by hand may ask for more: `SCHEMATHESIS_EXAMPLES`.
const EXAMPLES: u32 = 6;

/// The same requests every time.
const SEED: u32 = 20_260_117;

/// Python with the strangers, in a folder of its own under the target folder; made once.
fn python() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("api-python");
    fs::create_dir_all(&folder).unwrap();
    // Two test processes must not build one environment.
    let lock = File::create(folder.join(".lock")).unwrap();
    lock.lock().unwrap();
    let requirements = repository().join("tests/peers/api-requirements.txt");
    let wanted = fs::read_to_string(&requirements).unwrap();
    let (python, stamp) = (folder.join("bin/python"), folder.join("installed.txt"));
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) {
        return python;
    }
    run(Command::new("python3").args(["-m", "venv"]).arg(&folder));
    let arguments = [
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--requirement",
    ];
    run(Command::new(&python).args(arguments).arg(&requirements));
    fs::write(&stamp, wanted).unwrap();
    python
}

/// Runs a command to its good end, and gives what it wrote.
#[track_caller]
fn run(command: &mut Command) -> String {
    let output = command
        .env("NO_PROXY", "*")
        .stdin(Stdio::null())
        .output()
        .unwrap_or_else(|error| {
            panic!("{command:?}: {error}; install python3 with venv and pip (Debian: python3-venv)")
        });
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}\n{said}{errors}");
    said
}

/// A cell of one host with two first-order loops' points, and one loop that runs.
fn one_host() -> (Cell, Api) {
    let options = CellOptions {
        plant_tables: "[roles]\ncontrol = true\n".to_owned(),
        ..CellOptions::first_order("{ count = 2 }")
    };
    let mut cell = Cell::start(options.controllers(0)).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid", "pidplus"]).unwrap();
    api.apply(&first_order_loop(0, "pid", 50.0)).unwrap();
    (cell, api)
}

#[test]
fn every_answer_is_one_that_the_document_promises() {
    let python = python();
    let (mut cell, api) = one_host();
    let folder = tempfile::tempdir().unwrap();
    // Names that are there, so that more than refusals is met.
    let known = "\
        [[operations]]\ninclude-operation-id = \"remove_loop\"\nparameters = { \"path.name\" = \"loop-9\" }\n\
        [[operations]]\ninclude-path-regex = \"^/v1/loops/\"\nparameters = { \"path.name\" = \"loop-0\", \"path.alarm\" = \"fault\" }\n\
        [[operations]]\ninclude-path-regex = \"^/v1/hosts/\"\nparameters = { \"path.name\" = \"plant\" }\n\
        [[operations]]\ninclude-path-regex = \"^/v1/points/\"\nparameters = { \"path.name\" = \"plant.1.out\" }\n\
        [[operations]]\ninclude-path-regex = \"^/v1/(jobs|rollouts)/\"\nparameters = { \"path.id\" = \"plant.1\" }\n\
        [[operations]]\ninclude-path-regex = \"^/v1/components/\"\nparameters = { \"path.reference\" = \"pid\" }\n";
    fs::write(folder.path().join("schemathesis.toml"), known).unwrap();
    let examples = std::env::var("SCHEMATHESIS_EXAMPLES").unwrap_or_else(|_| EXAMPLES.to_string());
    let said = run(Command::new(python.with_file_name("st"))
        .current_dir(folder.path())
        .args(["--no-color", "run"])
        .arg(format!("{}/openapi.json", api.base()))
        .args([
            "--seed",
            &SEED.to_string(),
            "--max-examples",
            &examples,
            "--phases",
            "examples,fuzzing",
        ])
        .args([
            "--no-shrink",
            "--continue-on-failure",
            "--suppress-health-check",
            "all",
            "--request-timeout",
            "60",
        ])
        .args([
            "--checks",
            "not_a_server_error,status_code_conformance,content_type_conformance,response_headers_conformance,\
             response_schema_conformance,negative_data_rejection,unsupported_method,allow_header_conformance",
        ])
        // A feed has no end; a drained host takes no loops; both have tests of their own.
        .args([
            "--exclude-operation-id",
            "follow_records",
            "--exclude-operation-id",
            "drain_host",
        ])
        // The tool makes no components and no bundles; they have tests of their own.
        .args([
            "--exclude-operation-id",
            "upload_component",
            "--exclude-operation-id",
            "import_bundle",
        ]));
    assert!(said.contains(" passed"), "{said}");
    // And the loop, whatever it was told, still runs on a host that is well.
    assert_eq!(
        api.get("/readyz").unwrap()["ready"],
        true,
        "{}",
        cell.plant.stderr_tail()
    );
    assert!(cell.plant.is_running());
}

#[test]
fn a_client_that_was_made_from_the_document_drives_a_cell() {
    let python = python();
    let (_cell, api) = one_host();
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("config.yml");
    // It knows no types of bytes but its own, and says so; the operations with JSON are what is looked at.
    let words = "\
        post_hooks: []\npackage_name_override: bumpless_client\ncontent_type_overrides:\n  \
        application/wasm: application/octet-stream\n  application/x-tar: application/octet-stream\n  \
        application/openmetrics-text: text/plain\n";
    fs::write(&config, words).unwrap();
    run(Command::new(&python)
        .current_dir(folder.path())
        .args([
            "-m",
            "openapi_python_client",
            "generate",
            "--meta",
            "none",
            "--fail-on-warning",
            "--overwrite",
        ])
        .args(["--output-path", "bumpless_client", "--config", "config.yml", "--path"])
        .arg(repository().join("docs/openapi.json")));
    let said = run(Command::new(&python)
        .arg(repository().join("tests/peers/api_client.py"))
        .arg(folder.path())
        .arg(api.base()));
    assert!(said.ends_with("ok\n"), "{said}");
}

#[test]
fn prometheus_reads_the_metrics() {
    let python = python();
    let (_cell, api) = one_host();
    wait_until("some cycles", Duration::from_secs(20), || {
        let text = api.metrics().map_err(|error| error.to_string())?;
        let line = text
            .lines()
            .find(|line| line.starts_with("bumpless_loop_jitter_seconds_count"));
        let count = line.and_then(|line| line.rsplit(' ').next()?.parse::<u64>().ok());
        count.filter(|count| *count >= 5).ok_or_else(|| format!("{line:?}"))
    })
    .unwrap();
    let said = run(Command::new(python)
        .arg(repository().join("tests/peers/metrics.py"))
        .arg(api.base()));
    assert!(said.ends_with("ok\n"), "{said}");
}

#[test]
fn a_collector_gets_metrics_and_the_spans_of_changes() {
    let mut collector = Command::new(python())
        .arg(repository().join("tests/peers/collector.py"))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let watchdog = Watchdog::over(&collector).unwrap();
    let mut said = BufReader::new(collector.stdout.take().unwrap()).lines();
    let address = said.next().unwrap().unwrap();
    let options = CellOptions {
        plant_tables: format!(
            "[roles]\ncontrol = true\n[otlp]\nendpoint = \"{address}\"\nevery_s = 5\nheaders = {{ api-key = \"secret\" }}\n"
        ),
        ..CellOptions::first_order("{ count = 1 }")
    };
    let mut cell = Cell::start(options.controllers(0)).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&first_order_loop(0, "pid", 50.0)).unwrap();
    api.post("/v1/loops/loop-0/set", &json!({ "parameters": { "k": 0.11 } }))
        .unwrap();
    let (tell, told) = std::sync::mpsc::channel();
    std::thread::spawn(move || tell.send(said.next()));
    let heard = told.recv_timeout(Duration::from_secs(30));
    let good = matches!(&heard, Ok(Some(Ok(line))) if line == "ok");
    assert!(good, "{heard:?}\n{}", cell.plant.stderr_tail());
    assert!(
        !cell.plant.stderr().contains("were not sent"),
        "{}",
        cell.plant.stderr_tail()
    );
    drop(watchdog);
    collector.kill().unwrap();
    collector.wait().unwrap();
}
