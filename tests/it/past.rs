//! The long history: what one host lost others still have, what a kill costs, points, and files that pandas reads.

use std::{
    fs::{self, File},
    path::PathBuf,
    process::{Command, Stdio},
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use bumpless_tests::{Api, Binary, Cell, CellOptions, first_order_loop, repository, wait_until};
use serde_json::Value;

use crate::{names, whole};

const LOOP: &str = "loop-0";

/// Waits for so many records more.
fn cycles_pass(api: &Api, count: u64) -> Value {
    // Before its first record it has none.
    let seen = api.loop_view(LOOP).unwrap()["seq"].as_u64().unwrap_or(0);
    api.wait_for_loop(LOOP, "further cycles", |view| {
        view["seq"].as_u64() >= Some(seen + count)
    })
    .unwrap()
}

fn history(api: &Api, query: &str) -> Value {
    api.get(&format!("/v1/loops/{LOOP}/history?{query}")).unwrap()
}

/// Cycles of all pieces that begin before a time, in µs since 1970.
fn cycles_before(found: &Value, unix_us: u64) -> u64 {
    let at = found["at_unix_us"].as_array().unwrap();
    let cycles = found["cycles"].as_array().unwrap();
    let pieces = at.iter().zip(cycles).filter(|(at, _)| whole(at) < unix_us);
    pieces.map(|(_, cycles)| whole(cycles)).sum()
}

fn running_cell() -> (Cell, Api) {
    let mut options = CellOptions::first_order("{ count = 1, tau_s = 1.0 }");
    options.plant_tables = "[history]\npoints = [\"plant.0.out\"]\n".to_owned();
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    api.apply(&first_order_loop(0, "pid", 20.0)).unwrap();
    // All hosts must hold the loop before its history is theirs too.
    api.wait_for_loop(LOOP, "three members", |view| names(&view["members"]).len() == 3)
        .unwrap();
    cycles_pass(&api, 150);
    (cell, api)
}

#[test]
fn what_the_home_lost_other_hosts_still_have_and_what_nobody_saw_is_a_gap() {
    let (mut cell, _) = running_cell();
    let other = cell.controllers[0].api();
    let before = history(&other, "from=-60s&step=1s");
    let kept = cycles_before(&before, u64::MAX);
    assert!(kept > 100, "{before}");

    // The home dies, and with it all that it had of the past.
    cell.plant.kill9();
    let dead = history(&other, "from=-60s&step=1s");
    let died_us = whole(dead["at_unix_us"].as_array().unwrap().last().unwrap());
    assert!(cycles_before(&dead, u64::MAX) >= kept, "{dead}");
    let data = cell.plant.data();
    fs::remove_dir_all(data.join("history")).unwrap();
    fs::remove_file(data.join("cycles.redb")).unwrap();
    // What nobody saw must be longer than a piece.
    wait_until("a piece without a home", Duration::from_secs(30), || {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
        let since = now.saturating_sub(Duration::from_micros(died_us));
        (since > Duration::from_secs(4)).then_some(()).ok_or(since)
    })
    .unwrap();
    cell.restart("plant").unwrap();
    cell.wait_joined().unwrap();
    let home = cell.plant.api();
    home.wait_for_loop(LOOP, "a cycle of the new life", |view| {
        view["last_age_ms"].as_u64().is_some_and(|ms| ms < 1_000)
    })
    .unwrap();
    cycles_pass(&home, 100);

    let joined = history(&home, "from=-120s&step=1s");
    assert!(cycles_before(&joined, died_us + 1) >= kept, "{joined}");
    let sources = names(&joined["sources"]);
    assert!(
        sources.iter().any(|host| host == "plant") && sources.len() > 1,
        "{sources:?}"
    );
    let gaps = joined["gaps"].as_array().unwrap();
    // While the home was dead there were no cycles.
    assert!(
        gaps.iter().any(|gap| whole(&gap["from_unix_us"]) >= died_us),
        "{gaps:?}, died {died_us}"
    );
    // Single cycles are gone with the log; pieces of a second stand in their place.
    let fine = history(&home, "from=-120s&buckets=4000");
    assert!(cycles_before(&fine, died_us + 1) >= kept, "{}", fine["made_of"]);
}

#[test]
fn a_killed_host_keeps_its_history_to_the_last_second() {
    let (mut cell, api) = running_cell();
    // Alone: nobody can help it out.
    let last = cycles_pass(&api, 100);
    let seq = whole(&last["seq"]);
    for host in cell.hosts_mut() {
        host.kill9();
    }
    for host in &mut cell.controllers {
        fs::remove_dir_all(host.data().join("history")).unwrap();
    }
    cell.restart("plant").unwrap();
    let found = history(&cell.plant.api(), "from=-120s&step=1s");
    let kept = cycles_before(&found, u64::MAX);
    // A loop of 20 ms: a second is 50 cycles.
    assert!(kept + 50 >= seq, "{kept} of {seq}: {found}");
    let point = cell
        .plant
        .api()
        .get("/v1/points/plant.0.out/history?from=-120s&step=1s")
        .unwrap();
    assert!(
        cycles_before(&point, u64::MAX) >= 5 && point["point"] == "plant.0.out",
        "{point}"
    );
}

#[test]
fn files_are_what_pandas_reads() {
    let (mut cell, api) = running_cell();
    let folder = tempfile::tempdir().unwrap();
    let binary = Binary::find().unwrap();
    let run = |words: &[&str]| {
        let output = binary
            .command()
            .args(words)
            .args(["--api", api.base()])
            .current_dir(folder.path())
            .output();
        let output = output.unwrap();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{words:?}: {errors}");
        String::from_utf8(output.stdout).unwrap()
    };
    let table = run(&["history", LOOP, "--from", "-5m", "--buckets", "10"]);
    assert!(table.contains("MEASURED") && table.contains("from "), "{table}");
    for format in ["csv", "json", "parquet"] {
        let file = format!("{LOOP}.{format}");
        let told = run(&[
            "history", LOOP, "--from", "-5m", "--step", "1s", "--format", format, "-o", &file,
        ]);
        assert!(told.contains(&file), "{told}");
    }
    let text = fs::read_to_string(folder.path().join("loop-0.csv")).unwrap();
    assert!(
        text.lines().count() > 3 && text.starts_with("time,duration_s,cycles,"),
        "{text}"
    );
    let json: Value = serde_json::from_str(&fs::read_to_string(folder.path().join("loop-0.json")).unwrap()).unwrap();
    assert_eq!(json["loop"], LOOP);
    assert!(cell.plant.is_running());
    // The guide's own lines, on these files.
    let guide = fs::read_to_string(repository().join("docs/history.md")).unwrap();
    let code = guide
        .split("```python\n")
        .nth(1)
        .and_then(|rest| rest.split("```").next())
        .unwrap();
    let code = code.replace("pressure", LOOP);
    let output = Command::new(python())
        .arg("-c")
        .arg(code)
        .current_dir(folder.path())
        .output()
        .unwrap();
    let (out, errors) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    assert!(output.status.success(), "{out}{errors}");
    assert!(out.contains("equal"), "{out}");
}

/// Python with pandas and pyarrow, in a folder of its own under the target folder; made once.
fn python() -> PathBuf {
    const PACKAGES: &str = "pandas pyarrow";
    let components = bumpless_tests::components().unwrap();
    let folder = components.parent().unwrap().join("pandas-python");
    fs::create_dir_all(&folder).unwrap();
    // Two test processes must not build one environment.
    let lock = File::create(folder.join(".lock")).unwrap();
    lock.lock().unwrap();
    let python = folder.join("bin/python");
    let stamp = folder.join("installed.txt");
    if fs::read_to_string(&stamp).is_ok_and(|installed| installed == PACKAGES) {
        return python;
    }
    let step = |command: &mut Command| {
        let output = command.stdin(Stdio::null()).output().unwrap();
        assert!(
            output.status.success(),
            "{command:?} failed; install python3 with venv and pip (Debian: python3-venv):\n{}",
            String::from_utf8_lossy(&output.stderr)
        );
    };
    step(Command::new("python3").args(["-m", "venv"]).arg(&folder));
    let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
    step(Command::new(&python).args(pip).args(PACKAGES.split(' ')));
    fs::write(&stamp, PACKAGES).unwrap();
    python
}
