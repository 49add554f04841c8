//! What is refused: components, loops, changes, requests, configurations and command lines, each with words that help; and
//! after all of it the cell is as it was.

mod components;
mod loops;
mod requests;
mod shell;

use bumpless_tests::{Api, Cell, CellOptions, Error, first_order_loop};
use serde_json::{Value, json};

/// A second bus with points, on the controller host.
const OTHER_BUS: &str = "[roles]\ncontrol = true\n\n[[bus]]\nid = \"other\"\ndriver = \"sim\"\nfopdt = { count = 1 }\n";

#[test]
fn what_is_refused_leaves_nothing_behind() {
    let mut options = CellOptions::first_order("{ count = 2 }").controllers(1);
    options.controller_tables = OTHER_BUS.to_owned();
    let mut cell = Cell::start(options).unwrap();
    let api = cell.api().unwrap();
    api.upload_stock(&["pid", "on-off"]).unwrap();
    let mut draft = first_order_loop(0, "pid", 50.0);
    // One that stands still: in manual, so that what is refused can be told from what the loop does by itself.
    draft["mode"] = json!("manual");
    api.apply(&draft).unwrap();
    api.command("loop-0", "output", &json!({ "outputs": { "out": 40.0 } }))
        .unwrap();
    let before = snapshot(&api);

    components::refused(&api);
    assert_eq!(snapshot(&api), before, "after bad components");
    loops::bad_drafts(&api);
    assert_eq!(snapshot(&api), before, "after bad drafts");
    loops::bad_changes(&api);
    assert_eq!(snapshot(&api), before, "after bad changes");
    requests::refused(&api);
    assert_eq!(snapshot(&api), before, "after bad requests");
    shell::refused_by_the_cell(&api, cell.folder());
    assert_eq!(snapshot(&api), before, "after bad commands");

    let journal = cell.journal().unwrap();
    assert!(journal.of("plant.1.out").next().is_none(), "no refused loop ever wrote");
    loops::misdeeds(&api);
    let journal = cell.journal().unwrap();
    assert!(
        journal
            .of("plant.0.out")
            .all(|w| w.value.to_bits() == 40f64.to_bits() || w.value == 0.0),
        "the loop in manual held what the operator set"
    );
    crate::one_writer(&journal);
}

/// What must stay as it was.
fn snapshot(api: &Api) -> Value {
    let pick = |rows: Vec<Value>, keys: &[&str]| -> Vec<Value> {
        rows.iter()
            .map(|row| keys.iter().map(|key| ((*key).to_owned(), row[key].clone())).collect())
            .collect()
    };
    let loops = [
        "name",
        "revision",
        "pending_revision",
        "past_revisions",
        "spec",
        "mode",
        "setpoint",
        "outputs",
    ];
    json!({
        "components": pick(api.components().unwrap(), &["name", "version", "digest", "used_by"]),
        "loops": pick(api.loops().unwrap(), &loops),
        "points": pick(api.points().unwrap(), &["name", "host", "written_by"]),
        "hosts": pick(api.hosts().unwrap(), &["name", "alive", "draining"]),
    })
}

/// The problem of a request that must fail: status, and a part of its words.
#[track_caller]
fn problem(case: &str, done: Result<Value, Error>, status: u16, part: &str) {
    let error = match done {
        Ok(answer) => panic!("{case}: taken: {answer}"),
        Err(error) => error,
    };
    let Error::Refused { body, .. } = &error else {
        panic!("{case}: {error}");
    };
    let problem: Value = serde_json::from_str(body).unwrap_or_else(|_| panic!("{case}: no problem+json: {error}"));
    let words = format!("{} {}", problem["detail"], problem["cure"]).replace("\\\"", "\"");
    assert_eq!(error.status(), status, "{case}: {words}");
    assert!(words.contains(part), "{case}: {part:?} is missing in: {words}");
    assert!(
        problem["type"]
            .as_str()
            .is_some_and(|t| t.starts_with("urn:bumpless:problem:")),
        "{case}: {body}"
    );
}
