//! What can be typed to ask for the long history, and to have it as a file.
//!
//! Never: does the work; `commands::past` does.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

/// Which history, and how.
#[derive(Debug, Args)]
pub(crate) struct HistoryArgs {
    /// The loop; with --point a point.
    pub(crate) name: String,
    /// It is a point that the configuration of its host lists under [history].
    #[arg(long)]
    pub(crate) point: bool,
    /// From this time on: RFC 3339 (2026-11-22T08:00:00Z), or back from now (-90s, -15m, -8h, -7d).
    #[arg(long, default_value = "-1h", allow_hyphen_values = true, value_name = "TIME")]
    pub(crate) from: String,
    /// Up to this time.
    #[arg(long, default_value = "now", allow_hyphen_values = true, value_name = "TIME")]
    pub(crate) to: String,
    /// In about so many pieces, from the best that is kept; 24 for a table, 500 for a file.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=4_000))]
    pub(crate) buckets: Option<u32>,
    /// In pieces as they are kept instead.
    #[arg(long, value_enum, conflicts_with = "buckets")]
    pub(crate) step: Option<StepWord>,
    /// A file of this kind instead of a table.
    #[arg(long, value_enum)]
    pub(crate) format: Option<FormatWord>,
    /// Where the file goes; to the standard output where not given.
    #[arg(long, short = 'o', value_name = "FILE", requires = "format")]
    pub(crate) output: Option<PathBuf>,
}

/// Lengths of kept pieces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum StepWord {
    /// Single cycles.
    Cycles,
    /// A second.
    #[value(name = "1s")]
    Second,
    /// Ten seconds.
    #[value(name = "10s")]
    TenSeconds,
    /// A minute.
    #[value(name = "1m")]
    Minute,
    /// A quarter of an hour.
    #[value(name = "15m")]
    Quarter,
}

impl StepWord {
    /// As the API has it.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Cycles => "cycles",
            Self::Second => "1s",
            Self::TenSeconds => "10s",
            Self::Minute => "1m",
            Self::Quarter => "15m",
        }
    }
}

/// Kinds of files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum FormatWord {
    /// Comma-separated values.
    Csv,
    /// The API's JSON.
    Json,
    /// Apache Parquet.
    Parquet,
}

impl FormatWord {
    /// As the API has it.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Json => "json",
            Self::Parquet => "parquet",
        }
    }
}
