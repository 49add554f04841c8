//! Licences, sources, bans and advisories of the dependencies, by cargo-deny with `deny.toml`.
//!
//! Where cargo-deny is not installed it is built (`tool`).
//! Advisories need the advisory database from the internet; without it they are left out, and a line says so.

use crate::{
    Error,
    run::{output, program, run, say},
    tool::Tool,
};

/// In the version that `deny.toml` is written for.
const CARGO_DENY: Tool = Tool {
    name: "cargo-deny",
    version: "0.20.2",
    arguments: "",
};

/// Checks all dependencies.
pub(crate) fn check() -> Result<(), Error> {
    let tool = CARGO_DENY.path()?;
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
