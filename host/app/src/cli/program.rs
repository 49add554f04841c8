//! What can be typed about programs.
//!
//! Never: does the work; `commands::programs` does.

use std::path::PathBuf;

use clap::Subcommand;

/// What can be done with programs.
#[derive(Debug, Subcommand)]
pub(crate) enum ProgramCommand {
    /// Create a program from a file, or change one of the name; it runs then.
    Apply {
        /// The program as TOML: name, component, grants, publishes, listens, share_percent …
        file: PathBuf,
    },
    /// Run a program, from its last checkpoint.
    Start {
        /// The program.
        program: String,
    },
    /// End its run; its checkpoint stays.
    Stop {
        /// The program.
        program: String,
    },
    /// Let it stand where it is, at once.
    Pause {
        /// The program.
        program: String,
    },
    /// Let it go on.
    Resume {
        /// The program.
        program: String,
    },
    /// List the programs of all hosts.
    List,
    /// Show one: where it runs, what it uses, why it is in fault.
    Show {
        /// The program.
        program: String,
    },
    /// What its run printed.
    Log {
        /// The program.
        program: String,
        /// The newest so many lines, at most 500.
        #[arg(long, default_value_t = 50)]
        lines: u32,
    },
    /// Write what it saved last to a file.
    Checkpoint {
        /// The program.
        program: String,
        /// Where to; `NAME.checkpoint` where not given.
        #[arg(long, short, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// End it and forget it.
    Delete {
        /// The program.
        program: String,
    },
}
