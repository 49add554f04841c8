//! Licences, sources, bans and advisories of the dependencies, by cargo-deny with `deny.toml`.
//!
//! Where cargo-deny is not installed it is built into `target/tools`, without optimisation: it runs for two seconds.
//! Advisories need the advisory database from the internet; without it they are left out, and a line says so.

use std::{path::PathBuf, time::Instant};

use crate::{
    Error,
    run::{cargo, output, program, run, say, target_folder},
};

/// The version that `deny.toml` is written for.
const VERSION: &str = "0.20.2";

/// Checks all dependencies.
pub(crate) fn check() -> Result<(), Error> {
    let tool = tool()?;
    run(program(&tool).args([
        "--all-features",
        "--log-level",
        "error",
        "check",
        "bans",
        "licenses",
        "sources",
    ]))?;
    if output(program(&tool).args(["--all-features", "fetch", "db"])).is_some() {
        return run(program(&tool).args([
            "--all-features",
            "--log-level",
            "error",
            "check",
            "--disable-fetch",
            "advisories",
        ]));
    }
    say("advisories: NOT checked, the advisory database (github.com/rustsec/advisory-db) cannot be fetched from here");
    Ok(())
}

/// An installed cargo-deny, or one that is built now.
fn tool() -> Result<PathBuf, Error> {
    let own = target_folder().join("tools");
    for path in [PathBuf::from("cargo-deny"), own.join("bin/cargo-deny")] {
        if output(program(&path).arg("--version")).is_some_and(|text| text.ends_with(VERSION)) {
            return Ok(path);
        }
    }
    say(&format!(
        "cargo-deny {VERSION} is not installed: building it into {}",
        own.display()
    ));
    let start = Instant::now();
    // A target folder of its own, kept small: the tool shares no build with the project.
    let build = own.join("build");
    run(cargo("install cargo-deny --locked --debug --quiet --version")
        .arg(VERSION)
        .arg("--root")
        .arg(&own)
        .arg("--target-dir")
        .arg(&build)
        .env("CARGO_PROFILE_DEV_DEBUG", "0"))?;
    let removed = std::fs::remove_dir_all(&build);
    if let Err(source) = removed {
        return Err(Error::File { path: build, source });
    }
    say(&format!("built in {:.0} s", start.elapsed().as_secs_f64()));
    Ok(own.join("bin/cargo-deny"))
}
