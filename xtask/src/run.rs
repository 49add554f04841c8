//! Programs that the tool runs in the workspace's root, with their output on this terminal.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use crate::{Error, components};

/// A program in the workspace's root.
pub(crate) fn program(name: impl AsRef<std::ffi::OsStr>) -> Command {
    let mut command = Command::new(name);
    command.current_dir(components::workspace_root()).stdin(Stdio::null());
    command
}

/// Cargo with arguments that stand apart by spaces.
pub(crate) fn cargo(arguments: &str) -> Command {
    let mut command = program("cargo");
    command.args(arguments.split_whitespace());
    command
}

/// Runs it; its output goes to this terminal.
pub(crate) fn run(command: &mut Command) -> Result<(), Error> {
    let status = command.status().map_err(|source| not_there(command, source))?;
    if status.success() {
        return Ok(());
    }
    Err(Error::Failed {
        command: words(command),
        status: status.to_string(),
    })
}

/// Runs it unseen; gives what it wrote to its output where it ended well.
pub(crate) fn output(command: &mut Command) -> Option<String> {
    let output = command.stderr(Stdio::null()).output().ok()?;
    output
        .status
        .success()
        .then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

/// The command line as typed.
pub(crate) fn words(command: &Command) -> String {
    let mut words = vec![command.get_program().to_string_lossy().into_owned()];
    words.extend(command.get_args().map(|word| word.to_string_lossy().into_owned()));
    words.join(" ")
}

fn not_there(command: &Command, source: std::io::Error) -> Error {
    Error::Program {
        program: command.get_program().to_string_lossy().into_owned(),
        source,
    }
}

/// Cargo's target folder.
pub(crate) fn target_folder() -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(
        || components::workspace_root().join("target"),
        |folder| components::workspace_root().join(Path::new(&folder)),
    )
}

/// A line for people.
#[allow(clippy::print_stdout, reason = "a command-line tool speaks to its terminal")]
pub(crate) fn say(line: &str) {
    println!("{line}");
}
