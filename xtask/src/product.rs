//! `cargo xtask demo`, `bench`, `model`, `simulate` and `openapi`: builds what is needed, then runs the product.

use std::process::Stdio;

use crate::{
    Error, components, page,
    run::{cargo, program, run, say, target_folder},
};

/// Builds components and binary, and starts a cell on this machine; arguments go to `bumpless demo`.
///
/// # Errors
/// What does not build, or how the demonstration ended.
pub fn demo(arguments: &[String]) -> Result<(), Error> {
    say("building the components and the host…");
    let folder = components::build()?;
    page::build_if_possible()?;
    run(&mut cargo("build --package bumpless-app"))?;
    let binary = target_folder().join("debug/bumpless");
    run(program(binary)
        .args(["demo", "--components"])
        .arg(folder)
        .args(arguments)
        .stdin(Stdio::inherit()))
}

/// Builds everything with optimisation and runs a bench; arguments go to it.
///
/// # Errors
/// What does not build, or a bound that does not hold.
pub fn bench(arguments: &[String]) -> Result<(), Error> {
    components::build()?;
    page::build_if_possible()?;
    // In one command, so that one set of features and one build of the dependencies serve both.
    run(&mut cargo(
        "build --release --package bumpless-app --package bumpless-bench",
    ))?;
    run(program(target_folder().join("release/bumpless-bench")).args(arguments))
}

/// Builds a program of the workspace, named as its package, with optimisation, and runs it; arguments go to it. It needs no
/// component and no host.
///
/// # Errors
/// What does not build, or what the program found.
pub fn tool(name: &str, arguments: &[String]) -> Result<(), Error> {
    run(&mut cargo(&format!("build --release --package {name}")))?;
    run(program(target_folder().join("release").join(name)).args(arguments))
}

/// Writes `docs/openapi.json` from the code.
///
/// # Errors
/// What does not build.
pub fn openapi() -> Result<(), Error> {
    // The examples are compiled into the document, so they come first.
    for test in [
        "every_operation_has_an_example_that_the_api_gives",
        "the_checked_in_document_is_the_code",
    ] {
        run(cargo(&format!("test --package bumpless-api --lib --quiet {test}")).env("UPDATE_EXPECT", "1"))?;
    }
    say("docs/openapi.json is what the code says");
    Ok(())
}
