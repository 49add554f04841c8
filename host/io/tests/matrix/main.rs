//! Our client and our server against other people's: every function, exception and limit, and what is malformed.
//!
//! Prints one table; a dash is a function that the peer itself does not have. Every other cell must be good.

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

const COLUMNS: [&str; 14] = [
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
    "exceptions",
    "unit",
    "malformed",
];

fn print(rows: &[Row]) -> Vec<String> {
    let mut bad = Vec::new();
    let mut text = format!("{:<34}", "client → server");
    for column in COLUMNS {
        let _infallible = write!(text, " {column:>6}");
    }
    for row in rows {
        let _infallible = write!(text, "\n{:<34}", row.name);
        for column in COLUMNS {
            let width = column.len().max(6);
            let found = row
                .cells
                .iter()
                .find(|(name, _)| name == column)
                .map(|(_, verdict)| verdict);
            let cell = match found {
                Some(Verdict::Good) => "good",
                Some(Verdict::Bad(problem)) => {
                    bad.push(format!("{}, {column}: {problem}", row.name));
                    "BAD"
                }
                Some(Verdict::Missing) | None => "–",
            };
            let _infallible = write!(text, " {cell:>width$}");
        }
    }
    println!("{text}");
    bad
}

#[test]
fn every_peer_every_function() {
    let tools = tools::all();
    let mut rows = Vec::new();
    for tool in &tools {
        rows.push(server::against(tool));
    }
    if tools.iter().any(|tool| tool.name == "libmodbus") {
        rows.push(server::against_mbpoll());
    }
    for tool in &tools {
        rows.push(client::against(tool));
    }
    let bad = print(&rows);
    assert!(bad.is_empty(), "{}", bad.join("\n"));
}
