//! What can be typed about people, tokens and certificates.
//!
//! Never: takes a password or a token as an argument: those lie open in the list of processes.

use std::path::PathBuf;

use clap::{Subcommand, ValueEnum};

/// A role.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RoleArg {
    /// Looks.
    Viewer,
    /// Runs the plant: setpoints, modes, outputs, alarms.
    Operator,
    /// Changes what runs.
    Engineer,
    /// Says who may do what.
    Admin,
}

/// Loops that somebody may change.
#[derive(Debug, Clone, Default, clap::Args)]
pub(crate) struct LoopsArgs {
    /// Only these loops may be changed, by name or beginning with a `*`; repeat it for more. All where not given.
    #[arg(long = "loop", value_name = "LOOP")]
    pub(crate) loops: Vec<String>,
}

/// What can be done with accounts. Passwords are asked for, or read from the standard input: one line.
#[derive(Debug, Subcommand)]
pub(crate) enum UserCommand {
    /// List the accounts.
    List,
    /// Make the first administrator of a cell, with the token in the host's data folder; and a token for the command line.
    First {
        /// The account's name.
        name: String,
        /// The file `first-token` in the host's data folder.
        #[arg(long, value_name = "FILE")]
        first_token: PathBuf,
        /// Where the token for the command line goes (0600); the file that --token-file names where not given.
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Add an account.
    Add {
        /// The account's name.
        name: String,
        /// What it may do.
        #[arg(long, value_enum)]
        role: RoleArg,
        #[command(flatten)]
        loops: LoopsArgs,
        /// It has tokens only, and does not sign in.
        #[arg(long)]
        no_password: bool,
        /// For people.
        #[arg(long, default_value = "")]
        note: String,
    },
    /// Change an account; what is not given stays.
    Set {
        /// The account's name.
        name: String,
        /// What it may do.
        #[arg(long, value_enum)]
        role: Option<RoleArg>,
        #[command(flatten)]
        loops: LoopsArgs,
        /// Ask for another password.
        #[arg(long)]
        password: bool,
        /// Put it out of force, with its tokens, or in force again.
        #[arg(long, value_name = "BOOL")]
        disabled: Option<bool>,
        /// For people.
        #[arg(long)]
        note: Option<String>,
    },
    /// Remove an account with its sessions and tokens.
    Remove {
        /// The account's name.
        name: String,
    },
}

/// What can be done with tokens.
#[derive(Debug, Subcommand)]
pub(crate) enum TokenCommand {
    /// List the tokens.
    List,
    /// Make a token for an account; its text goes to a file (0600) or, without one, to the standard output, once.
    New {
        /// The account.
        user: String,
        /// It may do this at most.
        #[arg(long, value_enum)]
        role: Option<RoleArg>,
        #[command(flatten)]
        loops: LoopsArgs,
        /// It ends after so many days.
        #[arg(long, default_value_t = 90)]
        days: u32,
        /// What it is for.
        #[arg(long, default_value = "")]
        note: String,
        /// Where it goes.
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Revoke a token, for ever and on all hosts.
    Revoke {
        /// Its id, as the list has it.
        id: String,
    },
}

/// How somebody signs in for the command line.
#[derive(Debug, clap::Args)]
pub(crate) struct LoginArgs {
    /// The account's name. Its password is asked for, or read from the standard input.
    pub(crate) name: String,
    /// The token ends after so many days, 1 to 90.
    #[arg(long, default_value_t = 1)]
    pub(crate) days: u32,
    /// Where the token goes (0600); the file that --token-file names where not given.
    #[arg(short, long, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
}

/// What can be done with certificates. No host is asked.
#[derive(Debug, Subcommand)]
pub(crate) enum CaCommand {
    /// Make an authority for a cell: ca.pem, which every host and browser gets, and ca.key, which stays in a safe place.
    Init {
        /// The cell.
        #[arg(long)]
        cell: String,
        /// Folder for both files.
        #[arg(long, value_name = "DIR", default_value = ".")]
        dir: PathBuf,
    },
    /// Make certificate and key of a host, for its API and its place on the bus: NAME.pem and NAME.key.
    Issue {
        /// The host's name.
        host: String,
        /// The cell.
        #[arg(long)]
        cell: String,
        /// An address or name by which others reach it; repeat it for more. This machine's own are always in it.
        #[arg(long = "address", value_name = "ADDRESS")]
        addresses: Vec<String>,
        /// It ends after so many days.
        #[arg(long, default_value_t = 397, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
        /// Folder with ca.pem and ca.key.
        #[arg(long, value_name = "DIR", default_value = ".")]
        dir: PathBuf,
        /// Folder for both files; that of the authority where not given.
        #[arg(long, value_name = "DIR")]
        out: Option<PathBuf>,
    },
}
