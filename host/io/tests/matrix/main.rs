//! Our client and our server against other people's: every function, exception and limit, and what is malformed.
//!
//! Makes one table; a dash is what cannot be, and each is in a list with its reason. Every other cell must be good.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "tests"
)]

mod client;
mod relay;
mod server;
mod tools;

use std::fmt::Write as _;

/// What came of one cell.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Verdict {
    Good,
    /// The peer does not have it.
    Missing,
    Bad(String),
}

/// A row: who talks to whom, and the cells by the names of their columns.
pub(crate) struct Row {
    name: String,
    cells: Vec<(String, Verdict)>,
}

impl Row {
    pub(crate) fn new(name: String) -> Self {
        Self {
            name,
            cells: Vec::new(),
        }
    }

    /// Adds a cell; several of one name are one cell, and one bad one makes it bad.
    pub(crate) fn add(&mut self, column: &str, verdict: Verdict) {
        match self.cells.iter_mut().find(|(name, _)| name == column) {
            Some((_, held)) if *held == Verdict::Good || matches!(verdict, Verdict::Bad(_)) => *held = verdict,
            Some(_) => {}
            None => self.cells.push((column.to_owned(), verdict)),
        }
    }
}

const COLUMNS: [&str; 15] = [
    "1",
    "2",
    "3",
    "4",
    "5",
    "6",
    "15",
    "16",
    "22",
    "23",
    "limits",
    "over",
    "exceptions",
    "unit",
    "malformed",
];

/// Cells that cannot be, and why. Every other cell must be good, and these must not: a peer that learns something is a
/// line less here.
const DASHES: [(&str, &[&str], &str); 6] = [
    ("mbpoll → ours", &["22", "23", "over"], "it has no such requests"),
    (
        "pymodbus, TLS → ours",
        &["over", "malformed"],
        "raw bytes do not pass through TLS; the plain row has them",
    ),
    (
        "ours → pymodbus",
        &["over"],
        "our client cuts its requests to the limits, see `limits`",
    ),
    (
        "ours → libmodbus",
        &["over", "unit"],
        "as above; its server answers for every unit",
    ),
    (
        "ours → modbus-serial",
        &["over", "22", "23"],
        "as above; its server has neither function: 22 is done by 3 and 6 instead, and 23 is said to be missing",
    ),
    (
        "ours → pymodbus, TLS",
        &[
            "1",
            "2",
            "4",
            "5",
            "15",
            "22",
            "23",
            "limits",
            "over",
            "unit",
            "malformed",
        ],
        "the plain row has them; here is what TLS could change",
    ),
];

fn dashed(row: &str, column: &str) -> bool {
    let row = DASHES.iter().find(|(name, _, _)| *name == row);
    row.is_some_and(|(_, columns, _)| columns.contains(&column))
}

/// The table, and what is wrong in it.
fn table(rows: &[Row]) -> (String, Vec<String>) {
    let mut bad = Vec::new();
    let mut text = format!("{:<26}", "client → server");
    for column in COLUMNS {
        let _infallible = write!(text, " {column:>6}");
    }
    for row in rows {
        let _infallible = write!(text, "\n{:<26}", row.name);
        for column in COLUMNS {
            let width = column.len().max(6);
            let found = row
                .cells
                .iter()
                .find(|(name, _)| name == column)
                .map(|(_, verdict)| verdict);
            let cell = match (found, dashed(&row.name, column)) {
                (Some(Verdict::Good), false) => "good",
                (Some(Verdict::Missing) | None, true) => "–",
                (found, _) => {
                    let problem = match found {
                        Some(Verdict::Bad(problem)) => problem,
                        Some(Verdict::Good) => "it is good, and the table of dashes says that it cannot be",
                        Some(Verdict::Missing) => "the peer does not have it, and the table of dashes does not say so",
                        None => "nobody tried it",
                    };
                    bad.push(format!("{}, {column}: {problem}", row.name));
                    "BAD"
                }
            };
            let _infallible = write!(text, " {cell:>width$}");
        }
    }
    for (row, columns, why) in DASHES {
        let _infallible = write!(text, "\n– {row}: {}: {why}", columns.join(", "));
    }
    (text, bad)
}

#[test]
fn a_cell_that_nobody_tried_is_bad_and_so_is_a_dash_that_nobody_expects() {
    let row = |name: &str, verdict: Verdict| {
        let mut row = Row::new(name.to_owned());
        for column in COLUMNS {
            let dash = dashed(name, column);
            row.add(column, if dash { Verdict::Missing } else { Verdict::Good });
        }
        row.cells[0].1 = verdict;
        row
    };
    assert_eq!(table(&[row("ours → libmodbus", Verdict::Good)]).1, Vec::<String>::new());
    assert!(table(&[row("ours → libmodbus", Verdict::Missing)]).1[0].contains("does not say so"));
    let mut untried = row("ours → libmodbus", Verdict::Good);
    untried.cells.remove(4);
    assert_eq!(table(&[untried]).1, ["ours → libmodbus, 5: nobody tried it"]);
    let mut learned = row("mbpoll → ours", Verdict::Good);
    learned.cells[8].1 = Verdict::Good;
    assert!(table(&[learned]).1[0].contains("says that it cannot be"));
}

#[test]
fn every_peer_every_function() {
    let tools = tools::all();
    let mut rows = Vec::new();
    for tool in &tools {
        rows.push(server::against(tool));
    }
    for tool in &tools {
        rows.push(client::against(tool));
    }
    if tools.iter().any(|tool| tool.name == "libmodbus") {
        rows.push(server::against_mbpoll());
    }
    if let Some(tool) = tools.iter().find(|tool| tool.name == "pymodbus") {
        rows.push(server::against_over_tls(tool));
        rows.push(client::against_over_tls(tool));
    }
    let (text, bad) = table(&rows);
    println!("{text}");
    // Where the test's own output is not shown, `cargo xtask test` shows this file.
    let file = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("modbus-matrix.txt");
    std::fs::write(&file, format!("{text}\n")).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    assert!(bad.is_empty(), "{text}\n{}", bad.join("\n"));
}
