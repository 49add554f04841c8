//! What can be typed to experiment in virtual time.
//!
//! Never: does the work; `commands::lab` does.

use std::path::PathBuf;

use clap::{Args, Subcommand};

/// The lab.
#[derive(Debug, Args)]
pub(crate) struct LabArgs {
    #[command(subcommand)]
    pub(crate) what: LabCommand,
}

/// How experiments are run and where their reports go.
#[derive(Debug, Clone, Args)]
pub(crate) struct LabRunArgs {
    /// Folder for reports, and for results that are kept so that only what changed runs again.
    #[arg(long, default_value = "lab-out", value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Runs side by side; as many as the machine has cores where not given.
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    pub(crate) jobs: usize,
    /// Seeds 1 to this, instead of the experiment's.
    #[arg(long, value_name = "COUNT")]
    pub(crate) seeds: Option<u32>,
    /// Make every run anew, and keep none.
    #[arg(long)]
    pub(crate) fresh: bool,
    /// Folder with the stock components; found beside the program where not given.
    #[arg(long, value_name = "DIR")]
    pub(crate) components: Option<PathBuf>,
}

/// What can be done in the lab.
#[derive(Debug, Subcommand)]
pub(crate) enum LabCommand {
    /// Run experiments and write their reports.
    Run {
        /// The experiments (TOML).
        #[arg(required = true, value_name = "FILE")]
        files: Vec<PathBuf>,
        #[command(flatten)]
        how: LabRunArgs,
    },
    /// Run one experiment under several controllers instead of its own cases.
    Compare {
        /// The experiment.
        file: PathBuf,
        /// `pidplus` with the experiment's parameters, or `pidplus:k=2,ti=3` with its own.
        #[arg(required = true, value_name = "CONTROLLER[:NAME=VALUE,…]")]
        controllers: Vec<String>,
        #[command(flatten)]
        how: LabRunArgs,
    },
    /// Run one experiment with a field varied, beside its own sweeps.
    Sweep {
        /// The experiment.
        file: PathBuf,
        /// A field by its path, and its values: `loop.flow.period_ms=500,1000,2000`.
        #[arg(required = true, value_name = "FIELD=VALUE,…", value_parser = super::pair)]
        fields: Vec<(String, String)>,
        #[command(flatten)]
        how: LabRunArgs,
    },
    /// Write the report again, from kept results as far as there are any.
    Report {
        /// The experiment.
        file: PathBuf,
        #[command(flatten)]
        how: LabRunArgs,
    },
    /// Write a recorded window of a live loop to a file: the input of an experiment with `plant.model = "recorded"`.
    Record {
        /// The loop.
        name: String,
        /// How far back: a number of cycles, or a time such as 30s or 10m.
        #[arg(long, default_value = "1000", value_name = "CYCLES|TIME")]
        last: String,
        /// The file.
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// Fit a first-order process with dead time to a recorded window, to close a loop around.
    Fit {
        /// The file that `record` wrote.
        file: PathBuf,
    },
    /// Bring an experiment's best controller to a live loop: upload it and let it follow as a shadow. Nothing of the loop changes.
    Promote {
        /// The experiment.
        file: PathBuf,
        /// The live loop.
        name: String,
        /// This case, instead of the best.
        #[arg(long)]
        case: Option<String>,
        /// The figure whose least mean is the best.
        #[arg(long, default_value = "iae", value_name = "FIGURE")]
        by: String,
        /// Follow for so many cycles.
        #[arg(long, default_value_t = 200)]
        cycles: u64,
        /// Wait for the shadow's end and print what it found.
        #[arg(long)]
        wait: bool,
        #[command(flatten)]
        how: LabRunArgs,
    },
}
