//! What can be typed to put components into the library, and to work with it.
//!
//! Never: does the work; `commands::components` and `commands::library` do.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::pair;

/// An upload.
#[derive(Debug, Args)]
pub(crate) struct UploadArgs {
    /// The component, or a script: a file that ends in .lua, which is named after it.
    pub(crate) file: PathBuf,
    /// A line about it, for people.
    #[arg(long, default_value = "")]
    pub(crate) note: String,
    /// What it is sorted by; may be given several times.
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = pair)]
    pub(crate) labels: Vec<(String, String)>,
    /// Only report what its trial finds. Nothing stays.
    #[arg(long, conflicts_with_all = ["force", "wait"])]
    pub(crate) dry_run: bool,
    /// Take it in even where its trial refuses it. The report says who did so.
    #[arg(long)]
    pub(crate) force: bool,
    /// Wait until every host has it ready.
    #[arg(long)]
    pub(crate) wait: bool,
}

/// The library.
#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct ComponentsArgs {
    #[command(flatten)]
    pub(crate) filter: FilterArgs,
    #[command(subcommand)]
    pub(crate) what: Option<ComponentsCommand>,
}

/// Which components are listed; all of what is given must hold.
#[derive(Debug, Default, Args)]
pub(crate) struct FilterArgs {
    /// A label, or a key for any value; may be given several times.
    #[arg(long = "label", value_name = "KEY[=VALUE]")]
    pub(crate) labels: Vec<String>,
    /// The algorithm's name.
    #[arg(long)]
    pub(crate) name: Option<String>,
    /// A part of name, description, note, labels or uploader.
    #[arg(long)]
    pub(crate) text: Option<String>,
}

/// What can be done with the library.
#[derive(Debug, Subcommand)]
pub(crate) enum ComponentsCommand {
    /// List it.
    List(FilterArgs),
    /// Show one: ports, parameters, its trial, how far each host is with it.
    Show {
        /// `name`, `name@version`, or a digest or its first 8 digits.
        component: String,
    },
    /// Set and remove labels: `stage=pilot line-`.
    Label {
        /// `name`, `name@version`, or a digest or its first 8 digits.
        component: String,
        /// `key=value` sets a label, `key-` removes it.
        #[arg(required = true, value_name = "KEY=VALUE|KEY-", value_parser = label)]
        labels: Vec<(String, Option<String>)>,
    },
    /// Write another note; an empty one removes it.
    Note {
        /// `name`, `name@version`, or a digest or its first 8 digits.
        component: String,
        /// The note, one line.
        note: String,
    },
    /// Download one.
    Download {
        /// `name`, `name@version`, or a digest or its first 8 digits.
        component: String,
        /// Where to; `name-version.wasm` where not given.
        #[arg(long, short, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Write the script of one to a file, byte by byte as it was uploaded.
    Script {
        /// `name`, `name@version`, or a digest or its first 8 digits.
        component: String,
        /// Where to; standard output where not given.
        #[arg(long, short, value_name = "FILE")]
        output: Option<PathBuf>,
    },
    /// Export some into one file, for a cell without a network: an OCI image layout in a tar.
    Export {
        /// `name`, `name@version`, or a digest or its first 8 digits; the whole library where none is named.
        components: Vec<String>,
        /// Where to.
        #[arg(long, short, value_name = "FILE")]
        output: PathBuf,
    },
    /// Import what was exported elsewhere. Each component is tried as an upload is.
    Import {
        /// The file.
        file: PathBuf,
        /// Take in also what fails its trial. Its report says who did so.
        #[arg(long)]
        force: bool,
    },
    /// Delete one that no loop uses.
    Delete {
        /// `name`, `name@version`, or a digest or its first 8 digits.
        component: String,
    },
}

/// `key=value`, or `key-` to remove it.
fn label(text: &str) -> Result<(String, Option<String>), String> {
    if let Ok((key, value)) = pair(text) {
        return Ok((key, Some(value)));
    }
    match text.strip_suffix('-') {
        Some(key) if !key.is_empty() && !key.contains('=') => Ok((key.to_owned(), None)),
        _ => Err("write it as KEY=VALUE to set it, or KEY- to remove it".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn labels_are_set_and_removed() {
        assert_eq!(
            label("stage=pilot-").unwrap(),
            ("stage".to_owned(), Some("pilot-".to_owned()))
        );
        assert_eq!(label("stage-").unwrap(), ("stage".to_owned(), None));
        for bad in ["", "-", "stage", "=x", "stage="] {
            assert!(label(bad).is_err(), "{bad}");
        }
    }
}
