//! What can be typed to look back at a loop, and to try components on it.
//!
//! Never: does the work; `commands::history` does.

use std::path::PathBuf;

use clap::{Args, Subcommand};

/// What can be done with a loop's past, and with candidates.
#[derive(Debug, Subcommand)]
pub(crate) enum HistoryCommand {
    /// List recorded cycles.
    Cycles {
        /// The loop.
        name: String,
        /// How far back: a number of cycles, or a time such as 30s or 10m.
        #[arg(long, default_value = "20", value_name = "CYCLES|TIME")]
        last: String,
    },
    /// Step through recorded cycles one by one: what went in, the state, what came out.
    Step {
        /// The loop.
        name: String,
        /// How far back: a number of cycles, or a time such as 30s or 10m.
        #[arg(long, default_value = "100", value_name = "CYCLES|TIME")]
        last: String,
        /// Begin at the cycle of this number.
        #[arg(long, value_name = "CYCLE")]
        from: Option<u64>,
        /// Print so many cycles instead of showing one at a time; all of them where the output is no terminal.
        #[arg(long, value_name = "N")]
        count: Option<usize>,
        /// Step each cycle again with what is built from this source, or with this component (.wasm), here and from the recorded state.
        #[arg(long, value_name = "SOURCE")]
        with: Option<PathBuf>,
        /// Where such a step traps, leave its frames, globals and memories in this file, for a debugger of WebAssembly's core dumps.
        #[arg(long, value_name = "FILE", requires = "with")]
        core: Option<PathBuf>,
    },
    /// Make recorded steps again and compare them to the last bit.
    Replay {
        /// The loop.
        name: String,
        /// How far back: a number of cycles, or a time such as 30s or 10m.
        #[arg(long, default_value = "1000", value_name = "CYCLES|TIME")]
        last: String,
    },
    /// Try a component on recorded cycles, before it is swapped in.
    Backtest {
        /// The loop.
        name: String,
        #[command(flatten)]
        candidate: CandidateArgs,
        /// How far back: a number of cycles, or a time such as 30s or 10m.
        #[arg(long, default_value = "1000", value_name = "CYCLES|TIME")]
        last: String,
    },
    /// Let a component follow the running loop and compare what it would do. Nothing of the loop changes.
    Shadow {
        /// The loop.
        name: String,
        #[command(flatten)]
        candidate: CandidateArgs,
        /// For so many cycles.
        #[arg(long, default_value_t = 200)]
        cycles: u64,
        /// Wait for its end and print what it found.
        #[arg(long)]
        wait: bool,
    },
    /// List a loop's shadows, or show or stop one.
    Shadows {
        /// The loop.
        name: String,
        /// One of them.
        id: Option<u64>,
        /// Stop it; one that has ended is forgotten.
        #[arg(long, requires = "id")]
        stop: bool,
        /// Write the curves to a file (SVG).
        #[arg(long, value_name = "FILE", requires = "id")]
        plot: Option<PathBuf>,
    },
}

/// A component that shall be tried.
#[derive(Debug, Args)]
pub(crate) struct CandidateArgs {
    /// `name`, `name@version`, or a digest or its first 8 digits.
    pub(crate) component: String,
    /// Parameters that differ from those that a swap would take over.
    #[arg(long = "parameter", short = 'p', value_name = "NAME=VALUE", value_parser = super::pair)]
    pub(crate) parameters: Vec<(String, String)>,
    /// Write the curves to a file (SVG).
    #[arg(long, value_name = "FILE")]
    pub(crate) plot: Option<PathBuf>,
}
