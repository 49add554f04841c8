//! What an author of controllers can type: new, build, check, dev.
//!
//! Never: does the work; `commands::author` and `watch::dev` do.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

/// A new project.
#[derive(Debug, Args)]
pub(crate) struct NewArgs {
    /// What it is written in.
    #[arg(value_enum)]
    pub(crate) language: LanguageWord,
    /// Its name, and the component's: lower-case letters, digits and dashes.
    pub(crate) name: String,
    /// The folder guest-sdk of Bumpless, for Rust; found above here or above the program where not given.
    #[arg(long, value_name = "DIR", env = "BUMPLESS_SDK")]
    pub(crate) sdk: Option<PathBuf>,
}

/// What a controller is written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LanguageWord {
    /// Rust.
    Rust,
    /// Structured Text (IEC 61131-3).
    St,
    /// C, by clang.
    C,
    /// JavaScript.
    Js,
    /// TypeScript.
    Ts,
    /// Python.
    Python,
}

/// A build.
#[derive(Debug, Args)]
pub(crate) struct BuildArgs {
    /// A text (.st), a folder with one, a folder with a Cargo.toml, or one with a build.sh.
    pub(crate) source: PathBuf,
    /// The component's file; beside the source where not given.
    #[arg(long, short, value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
}

/// A check.
#[derive(Debug, Args)]
pub(crate) struct CheckArgs {
    /// What `build` takes, or a component (.wasm).
    pub(crate) source: PathBuf,
}

/// Development in a running cell.
#[derive(Debug, Args)]
pub(crate) struct DevArgs {
    /// What `build` takes.
    pub(crate) source: PathBuf,
    /// The loop that runs it.
    #[arg(long = "loop", value_name = "LOOP")]
    pub(crate) name: String,
    /// Stop after so many builds; failed where the last one did not come into force.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) builds: Option<u32>,
    /// Print lines instead of drawing; so it is too where the output is no terminal.
    #[arg(long)]
    pub(crate) plain: bool,
}
