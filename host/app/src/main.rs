//! The entry: reads the command line, runs it, turns an error into words and an exit code.

use std::process::ExitCode;

use clap::Parser as _;

#[allow(clippy::print_stderr, reason = "a command-line tool speaks to its terminal")]
fn main() -> ExitCode {
    match bumpless_app::run(bumpless_app::Cli::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{}", error.report());
            ExitCode::from(error.exit_code())
        }
    }
}
