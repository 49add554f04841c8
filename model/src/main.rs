//! `cargo xtask model`: takes every course of small cells, and says how many states there were, what held, and how each broken
//! rule shows.
//!
//! Owns the command line. A rule that does not hold makes the exit code 1.

use std::{process::ExitCode, time::Instant};

use bumpless_model::{Bounds, CELLS, Cell, DEEP, REMOVALS, RULES, signs};
use clap::Parser;
use serde::Serialize;
use stateright::{Checker, HasDiscoveries, Model};

/// Takes every course of small cells.
#[derive(Parser)]
#[command(name = "cargo xtask model", version)]
struct Options {
    /// Larger cells as well: minutes and gigabytes.
    #[arg(long)]
    deep: bool,
    /// Threads that look.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=64))]
    threads: u8,
    /// One JSON line per figure on standard output.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Figure {
    figure: String,
    value: f64,
    unit: &'static str,
    bound: Option<&'static str>,
    holds: bool,
}

impl Options {
    #[allow(
        clippy::print_stdout,
        clippy::print_stderr,
        reason = "a command-line tool speaks to its terminal"
    )]
    fn say(&self, line: &str) {
        if self.json {
            eprintln!("{line}");
        } else {
            println!("{line}");
        }
    }

    #[allow(clippy::print_stdout, reason = "a command-line tool speaks to its terminal")]
    fn figure(&self, figure: &Figure) {
        if self.json {
            // A struct of plain fields always has a JSON form.
            println!("{}", serde_json::to_string(figure).unwrap_or_default());
        }
    }
}

fn main() -> ExitCode {
    let options = Options::parse();
    let deep = if options.deep { DEEP.as_slice() } else { &[] };
    let mut holds = true;
    options.say("every course of a cell of a home and two hosts, with what may happen in it:");
    for (what, bounds) in CELLS.iter().chain(deep) {
        holds &= every_course(&options, what, *bounds);
    }
    options.say("\nrules taken away, and the shortest course that shows it:");
    for removal in REMOVALS {
        holds &= shown(&options, &removal);
    }
    options.say(if holds {
        "\nevery rule holds"
    } else {
        "\nA RULE DOES NOT HOLD"
    });
    if holds { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Takes every course; says whether every rule holds in each state.
fn every_course(options: &Options, what: &str, bounds: Bounds) -> bool {
    let began = Instant::now();
    let checker = Cell::new(bounds, None)
        .checker()
        .threads(usize::from(options.threads))
        .spawn_bfs()
        .join();
    let (states, depth) = (checker.unique_state_count(), checker.max_depth());
    let seconds = began.elapsed().as_secs_f64();
    options.say(&format!(
        "  {what:<58} {states:>9} states, {depth:>3} steps deep, {seconds:>6.1} s"
    ));
    let mut broken = Vec::new();
    for rule in RULES {
        if let Some(path) = checker.discovery(rule) {
            options.say(&format!("    DOES NOT HOLD: {rule}"));
            course(options, path.into_actions());
            broken.push(rule);
        }
    }
    let unseen: Vec<&str> = signs(&bounds)
        .filter(|sign| checker.discovery(sign).is_none())
        .collect();
    for sign in &unseen {
        options.say(&format!("    NEVER SEEN: {sign}"));
    }
    let figure = |figure: String, value: f64, unit, bound, holds| Figure {
        figure,
        value,
        unit,
        bound,
        holds,
    };
    options.figure(&figure(format!("model, {what}: states"), states as f64, "", None, true));
    options.figure(&figure(format!("model, {what}: time"), seconds, "s", None, true));
    let good = broken.is_empty() && checker.is_done();
    let rules = format!("model, {what}: rules of {} that do not hold", RULES.len());
    options.figure(&figure(rules, broken.len() as f64, "", Some("<= 0"), good));
    let of_signs = format!("model, {what}: what must be seen and never was");
    let seen = unseen.is_empty();
    options.figure(&figure(of_signs, unseen.len() as f64, "", Some("<= 0"), seen));
    good && seen
}

/// Looks for a course that shows the absence of a rule.
fn shown(options: &Options, removal: &bumpless_model::Removal) -> bool {
    let checker = Cell::new(removal.bounds, Some(removal.broken))
        .checker()
        .finish_when(HasDiscoveries::AllOf([removal.shows].into()))
        .threads(usize::from(options.threads))
        .spawn_bfs()
        .join();
    let path = checker.discovery(removal.shows);
    let holds = path.is_some();
    match path {
        Some(path) => {
            options.say(&format!("  {}: {:?} does not hold after", removal.what, removal.shows));
            course(options, path.into_actions());
        }
        None => options.say(&format!("  {}: {:?} HOLDS ALL THE SAME", removal.what, removal.shows)),
    }
    options.figure(&Figure {
        figure: format!("model, {}: not noticed", removal.what),
        value: if holds { 0.0 } else { 1.0 },
        unit: "",
        bound: Some("<= 0"),
        holds,
    });
    holds
}

fn course(options: &Options, actions: Vec<bumpless_model::Action>) {
    let words: Vec<String> = actions.into_iter().map(|action| format!("{action:?}")).collect();
    options.say(&format!("    {}", words.join(", ")));
}
