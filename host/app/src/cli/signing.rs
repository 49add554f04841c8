//! What can be typed about keys and signatures.
//!
//! Never: does the work; `commands::signing` does. A passphrase is never an argument: it would stand in the list of processes.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

/// What a key may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RoleWord {
    /// Sign documents of trust.
    Root,
    /// Sign what one made.
    Author,
    /// Sign what somebody else made.
    Approver,
}

/// How strict the cell is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum PolicyWord {
    /// Nobody is asked for a signature.
    Off,
    /// What lacks one comes in, with a warning.
    Warn,
    /// What lacks one does not come in, and is not started.
    Required,
}

/// Where a passphrase comes from: BUMPLESS_PASSPHRASE, a file, or the terminal.
#[derive(Debug, Clone, Args)]
pub(crate) struct PassphraseArgs {
    /// File whose first line is the passphrase; asked for on the terminal where neither it nor BUMPLESS_PASSPHRASE is given.
    #[arg(long, value_name = "FILE")]
    pub(crate) passphrase_file: Option<PathBuf>,
}

/// The root key that signs a change of what is trusted.
#[derive(Debug, Clone, Args)]
pub(crate) struct RootArgs {
    /// Key file of a root key.
    #[arg(long, value_name = "FILE")]
    pub(crate) root: PathBuf,
    #[command(flatten)]
    pub(crate) passphrase: PassphraseArgs,
}

/// What can be done with keys.
#[derive(Debug, Subcommand)]
pub(crate) enum KeysCommand {
    /// Draw a new key into a file that only you may read, under a passphrase. No host is asked.
    New {
        /// What people call it.
        name: String,
        /// Where to; NAME.key where not given.
        #[arg(long, short, value_name = "FILE")]
        output: Option<PathBuf>,
        #[command(flatten)]
        passphrase: PassphraseArgs,
    },
    /// Show the public half of a key file. No host is asked.
    Show {
        /// The key file.
        file: PathBuf,
    },
    /// List the keys that the cell trusts, its policy, and components that run unsigned.
    List,
    /// Let a key count. The first use makes the root key the cell's own.
    Trust {
        /// A key file, or the 64 digits of a public key.
        key: String,
        /// What it may do; may be given several times.
        #[arg(long = "role", value_enum, required = true)]
        roles: Vec<RoleWord>,
        /// What people call it; the name in the key file where not given.
        #[arg(long)]
        name: Option<String>,
        /// It counts for so many days.
        #[arg(long, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(1..=36_500))]
        expires_days: Option<u32>,
        #[command(flatten)]
        root: RootArgs,
    },
    /// Let a key count no more.
    Revoke {
        /// Its name, or the first digits of the public key.
        key: String,
        /// Why, for people.
        #[arg(long)]
        reason: String,
        #[command(flatten)]
        root: RootArgs,
    },
    /// How strict the cell is.
    Policy {
        /// The policy.
        #[arg(value_enum)]
        policy: PolicyWord,
        /// Roles of which each component needs a signature, each by another key.
        #[arg(long, value_enum, value_delimiter = ',')]
        needs: Vec<RoleWord>,
        #[command(flatten)]
        root: RootArgs,
    },
}

/// A signature.
#[derive(Debug, Args)]
pub(crate) struct SignArgs {
    /// The component.
    pub(crate) file: PathBuf,
    /// Key file.
    #[arg(long, value_name = "FILE")]
    pub(crate) key: PathBuf,
    /// In which role.
    #[arg(long, value_enum, default_value_t = RoleWord::Author)]
    pub(crate) role: RoleWord,
    /// It holds for so many days.
    #[arg(long, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(1..=36_500))]
    pub(crate) expires_days: Option<u32>,
    /// Also send it to the cell: for a component that is in the library already.
    #[arg(long)]
    pub(crate) send: bool,
    #[command(flatten)]
    pub(crate) passphrase: PassphraseArgs,
}

/// A look at signatures.
#[derive(Debug, Args)]
pub(crate) struct VerifyArgs {
    /// The component; its signatures are beside it, and those that the cell has count too.
    pub(crate) file: PathBuf,
}
