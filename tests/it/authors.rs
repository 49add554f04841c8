//! What an author of controllers does: a project, a check, builds that go into a running loop.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use bumpless_tests::{Binary, Cell, CellOptions, pressure_loop};
use serde_json::json;

use crate::text;

/// The program in a folder.
fn bumpless(folder: &Path, arguments: &[&str]) -> Output {
    let mut command: Command = Binary::find().unwrap().command();
    command.current_dir(folder).args(arguments).output().unwrap()
}

fn said(output: &Output) -> String {
    format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    )
}

/// A PI law for the vessel's pump, whose speed is set with 0 to 10 V.
const LAW: &str = "PROGRAM pressure_law {version := '1.0.0'}
VAR_INPUT pv : LREAL; {unit := 'bar'} END_VAR
VAR_OUTPUT out : LREAL; {unit := 'V', low := 0, high := 10} END_VAR
VAR CONSTANT
    k : LREAL := 4.0; {low := 0, high := 1000}
    ti : LREAL := 4.0; {low := 0.01, high := 1000}
END_VAR
VAR_EXTERNAL setpoint : LREAL; track : BOOL; dt : TIME; END_VAR
VAR RETAIN integral : LREAL; END_VAR
VAR e : LREAL; END_VAR
e := LIMIT(-100.0, setpoint - pv, 100.0);
IF track THEN integral := out - k * e;
ELSE integral := LIMIT(-k * e, integral + k * e * TIME_TO_LREAL(dt) / 1000.0 / ti, 10.0 - k * e); END_IF;
out := integral + k * e;
END_PROGRAM
";

#[test]
fn a_law_in_structured_text_runs_a_loop_and_is_swapped_with_pid_without_a_bump() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("law.st"), LAW).unwrap();
    let built = bumpless(folder.path(), &["build", "law.st"]);
    assert!(built.status.success(), "{}", said(&built));

    let mut cell = Cell::start(CellOptions::default()).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid"]).unwrap();
    let law = api.upload(&folder.path().join("law.wasm")).unwrap();
    assert_eq!(
        (text(&law["name"]), text(&law["admission"]["verdict"])),
        ("pressure-law".to_owned(), "passed".to_owned())
    );
    let mut draft = pressure_loop("pressure-law", 50.0);
    draft["parameters"] = json!({ "k": 4.0, "ti": 4.0 });
    api.apply(&draft).unwrap();
    let name = text(&draft["name"]);
    let runs = |what: &'static str, seq: u64| {
        api.wait_for_loop(&name, what, |view| view["seq"].as_u64().unwrap_or(0) > seq)
            .unwrap()
    };
    let seen = runs("the law to run", 20);
    let mut seq = seen["seq"].as_u64().unwrap_or(0);
    for component in ["pid", "pressure-law", "pid"] {
        let end = api.swap(&name, component).unwrap();
        let bump = end["hand_over"]["bump_percent"].as_f64().unwrap();
        assert!(bump < 1.0, "{component}: {end}");
        let seen = runs("the swapped law to run", seq + 10);
        seq = seen["seq"].as_u64().unwrap_or(0);
    }

    // A save goes into the loop; the second one takes over the state of the first.
    let dev = ["dev", "law.st", "--loop", &name, "--builds", "1", "--api", api.base()];
    let first = bumpless(folder.path(), &dev);
    assert!(
        first.status.success() && said(&first).contains("pressure-law@0.0.1 is in force"),
        "{}",
        said(&first)
    );
    fs::write(
        folder.path().join("law.st"),
        LAW.replace("VAR e : LREAL", "VAR e, unused : LREAL"),
    )
    .unwrap();
    let second = bumpless(folder.path(), &dev);
    assert!(
        second.status.success() && said(&second).contains("pressure-law@0.0.2 is in force"),
        "{}",
        said(&second)
    );
    let view = api.loop_view(&name).unwrap();
    assert!(view.to_string().contains("0.0.2"), "{view}");

    // Its cycles one by one, by the names of the text; and the same steps again with the text as it is here.
    let seq = view["seq"].as_u64().unwrap();
    runs("cycles of the build", seq + 10);
    let step = [
        "loop",
        "step",
        &name,
        "--last",
        "4",
        "--count",
        "2",
        "--api",
        api.base(),
    ];
    let told = bumpless(folder.path(), &step);
    for part in [
        "pressure-law@0.0.2",
        "PV  ",
        "INTEGRAL  ",
        "state before → after",
        "sent ",
    ] {
        let text = said(&told);
        assert!(text.to_uppercase().contains(&part.to_uppercase()), "{part}: {text}");
    }
    let again = bumpless(folder.path(), &[&step[..], &["--with", "law.st"]].concat());
    assert!(said(&again).contains("as recorded"), "{}", said(&again));
    fs::write(
        folder.path().join("endless.st"),
        LAW.replace(
            "out := integral + k * e;\n",
            "WHILE TRUE DO\n    out := 0.0;\nEND_WHILE;\n",
        ),
    )
    .unwrap();
    let endless = bumpless(folder.path(), &[&step[..], &["--with", "endless.st"]].concat());
    assert!(
        said(&endless).contains("it was in PRESSURE_LAW (endless.st:1"),
        "{}",
        said(&endless)
    );
}

#[test]
fn a_law_in_rust_that_traps_names_its_line() {
    let folder = tempfile::tempdir().unwrap();
    let made = bumpless(folder.path(), &["new", "rust", "speed"]);
    assert!(made.status.success(), "{}", said(&made));
    let law = folder.path().join("speed/src/lib.rs");
    let source = fs::read_to_string(&law).unwrap();
    let wrong = source.replace(
        "        let error = cycle.setpoint",
        "        assert!(cycle.dt_s() < 0.0, \"time goes on\");\n        let error = cycle.setpoint",
    );
    let line = wrong.lines().position(|line| line.contains("time goes on")).unwrap() + 1;
    fs::write(&law, wrong).unwrap();
    let refused = bumpless(folder.path(), &["check", "speed"]);
    assert_eq!(refused.status.code(), Some(3), "{}", said(&refused));
    let place = format!("src/lib.rs:{line})");
    assert!(said(&refused).contains(&place), "{place}: {}", said(&refused));
}

#[test]
fn a_project_is_checked_without_a_cell_and_told_where_it_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let made = bumpless(folder.path(), &["new", "st", "level"]);
    assert!(made.status.success(), "{}", said(&made));
    let checked = bumpless(folder.path(), &["check", "level"]);
    assert!(checked.status.success(), "{}", said(&checked));
    for part in ["level@1.0.0", "trial     passed", "state is taken over", "parameter, 5"] {
        assert!(said(&checked).contains(part), "{part}: {}", said(&checked));
    }
    let text_file = folder.path().join("level/level.st");
    let wrong = fs::read_to_string(&text_file)
        .unwrap()
        .replace("e := setpoint - pv;", "e := setpoint - pw;");
    fs::write(&text_file, wrong).unwrap();
    let refused = bumpless(folder.path(), &["check", "level"]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(said(&refused).contains("level.st:"), "{}", said(&refused));
    assert!(said(&refused).contains("there is no variable PW"), "{}", said(&refused));
}

/// clang is there: the example in C is built before the tests are.
#[test]
fn a_project_in_c_is_built_by_its_script_and_passes_its_trial() {
    xtask::languages::named("c-pid").unwrap().build().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let made = bumpless(folder.path(), &["new", "c", "level"]);
    assert!(made.status.success(), "{}", said(&made));
    let checked = bumpless(folder.path(), &["check", "level"]);
    assert!(checked.status.success(), "{}", said(&checked));
    for part in ["level@0.1.0", "trial     passed", "state is taken over"] {
        assert!(said(&checked).contains(part), "{part}: {}", said(&checked));
    }
    let built = bumpless(folder.path(), &["build", "level"]);
    assert!(built.status.success(), "{}", said(&built));
    let tried = bumpless(&folder.path().join("level"), &["lab", "run", "experiment.toml"]);
    assert!(tried.status.success(), "{}", said(&tried));
    let law = folder.path().join("level/law.c");
    let wrong = fs::read_to_string(&law)
        .unwrap()
        .replace("setpoint - pv;", "setpoint - pw;");
    fs::write(&law, wrong).unwrap();
    let refused = bumpless(folder.path(), &["build", "level"]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(
        said(&refused).contains("law.c:") && said(&refused).contains("'pw'"),
        "{}",
        said(&refused)
    );
}
