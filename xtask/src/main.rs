//! `cargo xtask <what>`: sets up, builds and checks. Owns the command line; the work is in the library.

use std::process::ExitCode;

use clap::Parser;

/// Sets up, builds and checks Bumpless.
#[derive(Parser)]
#[command(name = "cargo xtask", version)]
enum Command {
    /// Builds the controllers and the test guests into components under target/components.
    Components,
}

fn main() -> ExitCode {
    let done = match Command::parse() {
        Command::Components => xtask::components::run(),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => fail(&error),
    }
}

#[allow(clippy::print_stderr, reason = "a command-line tool speaks to its terminal")]
fn fail(error: &dyn std::error::Error) -> ExitCode {
    eprintln!("error: {error}");
    let mut cause = error.source();
    while let Some(next) = cause {
        eprintln!("  because: {next}");
        cause = next.source();
    }
    ExitCode::FAILURE
}
