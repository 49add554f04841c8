//! What can be typed about the audit trail.
//!
//! Never: does the work; `commands::audit` does.

use std::path::PathBuf;

use bumpless_core::{Digest, HostId};
use clap::{Subcommand, ValueEnum};

/// What can be done with the trail.
#[derive(Debug, Subcommand)]
pub(crate) enum AuditCommand {
    /// List entries of all hosts, newest first.
    List(ListArgs),
    /// Check that no entry was changed, taken out, put in or moved: every host's chain, or an exported file.
    ///
    /// Exit code 3 where something does not fit; it names the first entry that does not.
    Verify {
        /// An exported file (JSON lines); no host is asked then.
        file: Option<PathBuf>,
        /// Also check that a chain holds an entry that was noted elsewhere: HOST:NUMBER:HASH, as `verify` prints it.
        #[arg(long = "holds", value_name = "HOST:NUMBER:HASH", value_parser = noted, requires = "file")]
        holds: Vec<Noted>,
    },
    /// Export the chains: JSON lines for `audit verify FILE`, or a table.
    Export {
        /// JSON lines with seals, or a table for spreadsheets.
        #[arg(long, value_enum, default_value_t = Format::Jsonl)]
        format: Format,
        /// Only the chain of this host.
        #[arg(long)]
        host: Option<String>,
        /// From then on: 2026-03-01T06:00:00Z, or -1h for an hour ago.
        #[arg(long, allow_hyphen_values = true)]
        from: Option<String>,
        /// Up to then.
        #[arg(long, allow_hyphen_values = true)]
        to: Option<String>,
        /// Where to; the standard output where not given.
        #[arg(short, long, value_name = "FILE")]
        output: Option<PathBuf>,
    },
}

/// Which entries.
#[derive(Debug, Default, clap::Args)]
pub(crate) struct ListArgs {
    /// From then on: 2026-03-01T06:00:00Z, or -1h for an hour ago.
    #[arg(long, allow_hyphen_values = true)]
    pub(crate) from: Option<String>,
    /// Up to then.
    #[arg(long, allow_hyphen_values = true)]
    pub(crate) to: Option<String>,
    /// Only those about this loop.
    #[arg(long = "loop", value_name = "LOOP")]
    pub(crate) loop_name: Option<String>,
    /// Only those by somebody whose name or address has this in it.
    #[arg(long)]
    pub(crate) by: Option<String>,
    /// Only those of this kind (loop.setpoint), or of all that begin with it (loop).
    #[arg(long)]
    pub(crate) what: Option<String>,
    /// Only those with this outcome: done, refused, invalid, not-found, busy, unreachable, timeout, store, internal, unknown.
    #[arg(long)]
    pub(crate) outcome: Option<String>,
    /// At most so many, 1 to 1,000.
    #[arg(long)]
    pub(crate) limit: Option<u32>,
    /// What the list before called next.
    #[arg(long)]
    pub(crate) after: Option<String>,
}

/// How the trail is exported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// One entry a line.
    Jsonl,
    /// A table.
    Csv,
}

/// An entry that was noted elsewhere.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Noted {
    pub(crate) host: HostId,
    pub(crate) number: u64,
    pub(crate) hash: Digest,
}

fn noted(text: &str) -> Result<Noted, String> {
    let mut parts = text.splitn(3, ':');
    let mut part = || parts.next().unwrap_or_default();
    let (host, number, hash) = (part(), part(), part());
    match (HostId::new(host), number.parse(), hash.parse()) {
        (Ok(host), Ok(number), Ok(hash)) => Ok(Noted { host, number, hash }),
        _ => Err("write it as HOST:NUMBER:HASH with the 64 digits of the hash".to_owned()),
    }
}
