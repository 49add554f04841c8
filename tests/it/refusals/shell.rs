//! The program's own refusals: configurations that cannot be, command lines that cannot be meant, cells that say no. Each
//! with its exit code, and words on the error output.

use std::{
    path::Path,
    process::{Output, Stdio},
};

use bumpless_tests::{Api, Binary};

const LEAST: &str = "host = \"a\"\n[cell]\nname = \"demo\"\n";
const BUS: &str = "[[bus]]\nid = \"plant\"\ndriver = \"sim\"\n";

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
fn fails(arguments: &[&str], folder: &Path, code: i32, parts: &[&str]) {
    let output = bumpless(arguments, folder);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
    for part in parts {
        assert!(said.contains(part), "{arguments:?}: {part:?} is missing in: {said}");
    }
    assert!(!said.contains("panicked"), "{arguments:?}: {said}");
}

#[test]
fn bad_configurations_are_named_with_file_key_and_cure() {
    let folder = tempfile::tempdir().unwrap();
    let table: [(String, &[&str]); 12] = [
        (String::new(), &["missing field `host`"]),
        (
            "host = \"A\"\n[cell]\nname = \"demo\"".into(),
            &["key host", "lower-case"],
        ),
        (format!("{LEAST}speed = 5"), &["line 4", "unknown field `speed`"]),
        (format!("{LEAST}lease_ms = 5"), &["lease_ms", "100"]),
        (
            format!("{LEAST}listen = [\"quic/x:1\"]"),
            &["use tcp, unixsock-stream or tls"],
        ),
        (
            format!("{LEAST}[api]\nlisten = \"somewhere\""),
            &["key listen", "invalid socket address"],
        ),
        (format!("{LEAST}{BUS}{BUS}"), &["two buses are named plant"]),
        (format!("{LEAST}[roles]\nio = true"), &["roles.io"]),
        (
            format!("{LEAST}[[bus]]\nid = \"x\"\ndriver = \"opc\""),
            &["unknown variant `opc`"],
        ),
        (format!("{LEAST}{BUS}speed = 5"), &["unknown field `speed`"]),
        (
            format!("{LEAST}[engine]\ninstances_max = 0"),
            &["engine.instances_max", "1 to 100000"],
        ),
        (format!("{LEAST}[loops]\nworkers = 65"), &["loops.workers", "1 to 64"]),
    ];
    for (text, parts) in table {
        std::fs::write(folder.path().join("host.toml"), &text).unwrap();
        let parts = [parts, &["host.toml"]].concat();
        fails(&["host", "--config", "host.toml", "--check"], folder.path(), 1, &parts);
    }
    // The numbers of a bus are looked at when it is opened, before the host says that it is ready.
    for (key, part) in [
        ("plant = { adc_bits = 2 }", "adc_bits must be 8 to 24"),
        ("fopdt = { count = 0 }", "fopdt.count must be 1"),
    ] {
        std::fs::write(folder.path().join("host.toml"), format!("{LEAST}{BUS}{key}\n")).unwrap();
        fails(
            &["host", "--config", "host.toml"],
            folder.path(),
            1,
            &[part, "bus \"plant\""],
        );
        std::fs::remove_dir_all(folder.path().join("data")).unwrap();
    }
    fails(
        &["host", "--config", "missing.toml"],
        folder.path(),
        1,
        &["missing.toml"],
    );
    std::fs::write(folder.path().join("host.toml"), LEAST).unwrap();
    let good = bumpless(&["host", "--config", "host.toml", "--check"], folder.path());
    assert!(good.status.success(), "{good:?}");
    // A check opens nothing.
    assert!(!folder.path().join("data").exists());
}

#[test]
fn bad_command_lines_end_with_2_and_absent_cells_with_4() {
    let folder = tempfile::tempdir().unwrap();
    for (arguments, part) in [
        (&["lop"][..], "'loop'"),
        (&[], "Usage"),
        (&["host"], "--config"),
        (&["loop", "set", "pressure", "k"], "KEY=VALUE"),
        (&["loop", "mode", "pressure", "fast"], "possible values"),
        (&["call", "pid", "--strategy", "best"], "round-robin"),
        (&["hosts", "--api", "ftp://x"], "http://"),
    ] {
        fails(arguments, folder.path(), 2, &[part]);
    }
    // The reserved port 1 of this machine: nobody listens.
    fails(
        &["hosts", "--api", "http://127.0.0.1:1"],
        folder.path(),
        4,
        &["http://127.0.0.1:1", "bumpless demo"],
    );
    fails(&["upload", "missing.wasm"], folder.path(), 1, &["missing.wasm"]);
    std::fs::write(folder.path().join("loop.toml"), "name = \"x\"\nspeed = 1\n").unwrap();
    fails(
        &["loop", "apply", "loop.toml"],
        folder.path(),
        1,
        &["loop.toml", "line 2", "`speed`"],
    );
}

pub(super) fn refused_by_the_cell(api: &Api, folder: &Path) {
    std::fs::write(folder.join("text.wasm"), "(component)").unwrap();
    let to = ["--api", api.base()];
    let with = |arguments: &[&'static str]| -> Vec<&str> { [arguments, &to[..]].concat() };
    for (arguments, part) in [
        (&["loop", "setpoint", "loop-0", "500"][..], "outside the loop's range"),
        (&["loop", "setpoint", "loop-9", "5"], "no loop"),
        (&["loop", "swap", "loop-0", "nobody"], "no component"),
        (&["components", "delete", "pid"], "loop-0"),
        (&["upload", "text.wasm"], "no WebAssembly component"),
    ] {
        fails(&with(arguments), folder, 3, &[part]);
    }
    let listed = bumpless(&with(&["--json", "loop", "list"]), folder);
    assert!(listed.status.success(), "{listed:?}");
    let rows: serde_json::Value = serde_json::from_slice(&listed.stdout).unwrap();
    assert!(rows.to_string().contains("loop-0"), "{rows}");
}
