//! What can be typed to bring one component to many loops.
//!
//! Never: does the work; `commands::rollouts` does.

use clap::{Args, Subcommand, ValueEnum};

/// What can be done with rollouts.
#[derive(Debug, Subcommand)]
pub(crate) enum RolloutCommand {
    /// Change the first loop, watch it, then the others by rule.
    Start(RolloutArgs),
    /// List the rollouts of all hosts.
    List,
    /// Show a rollout with each of its loops.
    Show {
        /// Its name, as `plant.3`.
        id: String,
    },
    /// Stop a rollout: nothing further is changed.
    Stop {
        /// Its name, as `plant.3`.
        id: String,
    },
}

/// A rollout to begin.
#[derive(Debug, Args)]
pub(crate) struct RolloutArgs {
    /// `name`, `name@version`, or a digest or its first 8 digits.
    pub(crate) component: String,
    /// The loops in their order; the first is the canary.
    #[arg(value_name = "LOOP", required_unless_present = "all_of")]
    pub(crate) loops: Vec<String>,
    /// And after them, by name, all others that run this component now.
    #[arg(long, value_name = "COMPONENT")]
    pub(crate) all_of: Option<String>,
    /// Parameters that differ from those that a swap takes over.
    #[arg(long = "parameter", short = 'p', value_name = "NAME=VALUE", value_parser = super::pair)]
    pub(crate) parameters: Vec<(String, String)>,
    /// Watch each loop for so many cycles, and look at as many before.
    #[arg(long, default_value_t = 200)]
    pub(crate) cycles: u32,
    /// Greatest mean absolute error while a loop is watched, in times that before.
    #[arg(long, default_value_t = 2.0)]
    pub(crate) factor: f64,
    /// Loops under change or watch at a time, once the first passed.
    #[arg(long, default_value_t = 1)]
    pub(crate) at_once: u32,
    /// What happens to the loops that were changed already when one fails.
    #[arg(long, value_enum, default_value_t = FailureWord::Stop)]
    pub(crate) on_failure: FailureWord,
    /// Wait for its end and show how far it is; exit code 3 where it failed.
    #[arg(long)]
    pub(crate) wait: bool,
}

/// What happens after a failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum FailureWord {
    /// They stay as they are.
    Stop,
    /// They go back too, newest first.
    Back,
}

impl From<FailureWord> for bumpless_api::types::OnFailure {
    fn from(word: FailureWord) -> Self {
        match word {
            FailureWord::Stop => Self::Stop,
            FailureWord::Back => Self::Back,
        }
    }
}
