//! `cargo xtask test`: everything that has to hold, in the order in which a fault shows soonest.
//!
//! ```text
//!   tools ─► format ─► dependencies ─► components ─► languages ─► page ─► clippy ─► build ─► tests ─► page in a browser ─► documentation
//! ```
//! Owns the list of steps and what each needs set up. One step after the other: they share one target folder and two
//! cores. The first that fails ends the run. Never: changes a source file.

use std::time::{Duration, Instant};

use crate::{
    Error, components, deny, languages, page,
    run::{cargo, output, program, run, say, target_folder},
};

/// A step: name, whether the quick run has it, and what it does.
type Step = (&'static str, bool, fn(fast: bool) -> Result<(), Error>);

const STEPS: [Step; 11] = [
    ("tools", true, |_| tools()),
    ("format", true, |_| run(&mut cargo("fmt --all --check"))),
    ("dependencies", false, |_| deny::check()),
    ("components", true, |_| components::run().map_err(Error::from)),
    // Their tools are fetched here, so that no test waits for a download.
    ("languages", false, |_| languages::run(&[])),
    ("page", true, |_| page::build()),
    ("clippy", true, |_| {
        run(&mut cargo(
            "clippy --workspace --all-targets --quiet -- --deny warnings",
        ))
    }),
    // With `--all-targets` the features are those of the tests, so nothing is compiled a second time for them.
    ("build", true, |_| {
        run(&mut cargo("build --workspace --all-targets --quiet"))
    }),
    ("tests", true, tests),
    ("page in a browser", false, |_| page::test()),
    ("documentation", false, |_| {
        run(cargo("doc --workspace --no-deps --quiet").env("RUSTDOCFLAGS", "--deny warnings"))
    }),
];

/// Runs the steps. The quick run leaves out what needs minutes: dependencies, end-to-end tests, documentation.
///
/// # Errors
/// The first step that fails.
pub fn test(fast: bool) -> Result<(), Error> {
    let mut times: Vec<(&str, Duration)> = Vec::new();
    for (name, in_fast, work) in STEPS {
        if fast && !in_fast {
            continue;
        }
        say(&format!("==> {name}"));
        let start = Instant::now();
        let done = work(fast);
        times.push((name, start.elapsed()));
        if let Err(error) = done {
            summary(&times, false);
            return Err(Error::Step {
                step: name,
                source: Box::new(error),
            });
        }
    }
    summary(&times, true);
    Ok(())
}

fn summary(times: &[(&str, Duration)], good: bool) {
    say("");
    for (n, (name, time)) in times.iter().enumerate() {
        let failed = !good && n + 1 == times.len();
        let word = if failed { "FAILED" } else { "ok" };
        say(&format!("{name:<16} {:>8.1} s  {word}", time.as_secs_f64()));
    }
    let total: Duration = times.iter().map(|(_, time)| *time).sum();
    let word = if good { "all good" } else { "NOT good" };
    say(&format!("{:<16} {:>8.1} s  {word}", "together", total.as_secs_f64()));
}

/// What the other steps need: rustfmt, clippy, the components' target, Python for the independent Modbus device, Node
/// for the page.
fn tools() -> Result<(), Error> {
    for (tool, component) in [("fmt", "rustfmt"), ("clippy", "clippy")] {
        if output(cargo(tool).arg("--version")).is_none() {
            run(program("rustup").args(["component", "add", component]))?;
        }
    }
    components::ensure_target()?;
    for (name, argument) in [
        ("rustc", "--version"),
        ("cargo", "--version"),
        ("python3", "--version"),
        ("node", "--version"),
    ] {
        let version = output(program(name).arg(argument)).ok_or_else(|| Error::Program {
            program: name.to_owned(),
            source: std::io::Error::from(std::io::ErrorKind::NotFound),
        })?;
        say(&version);
    }
    Ok(())
}

fn tests(fast: bool) -> Result<(), Error> {
    if fast {
        return run(&mut cargo("test --workspace --lib --bins --quiet"));
    }
    let done = run(&mut cargo("test --workspace --no-fail-fast"));
    // A good test shows nothing; this one's table is for people.
    let matrix = target_folder().join("tmp/modbus-matrix.txt");
    match std::fs::read_to_string(&matrix) {
        Ok(table) => say(&format!("\n{table}")),
        Err(error) => say(&format!("no table of Modbus peers at {} ({error})", matrix.display())),
    }
    done
}
