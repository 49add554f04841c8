//! The entry: reads the command line, runs it, turns an error into words and an exit code.

use std::process::ExitCode;

use clap::Parser as _;

#[allow(clippy::print_stderr, reason = "a command-line tool speaks to its terminal")]
fn main() -> ExitCode {
    let cli = bumpless_app::Cli::parse();
    let json = cli.wants_json();
    match bumpless_app::run(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{}", if json { error.json() } else { error.report() });
            ExitCode::from(error.exit_code())
        }
    }
}
