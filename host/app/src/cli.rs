//! The command line: what can be typed, and which command it runs.
//!
//! Never: does the work; `commands`, `watch`, `host` and `demo` do.

use std::path::PathBuf;

use clap::{CommandFactory as _, Parser, Subcommand, ValueEnum};
use clap_complete::Shell;

mod access;
mod alarm;
mod audit;
mod author;
mod cell;
mod history;
pub(crate) mod io;
mod lab;
mod library;
mod past;
mod program;
mod rollout;
mod signing;

pub(crate) use access::{CaCommand, LoginArgs, LoopsArgs, RoleArg, TokenCommand, UserCommand};
pub(crate) use alarm::{AlarmCommand, Of as AlarmOf};
pub(crate) use audit::{AuditCommand, Format as AuditFormat, ListArgs as AuditListArgs, Noted};
pub(crate) use author::{BuildArgs, CheckArgs, DevArgs, LanguageWord, NewArgs};
pub(crate) use cell::HostsCommand;
pub(crate) use history::HistoryCommand;
pub(crate) use lab::{LabArgs, LabCommand, LabRunArgs};
pub(crate) use library::{ComponentsArgs, ComponentsCommand, FilterArgs, UploadArgs};
pub(crate) use past::{FormatWord, HistoryArgs};
pub(crate) use program::ProgramCommand;
pub(crate) use rollout::{RolloutArgs, RolloutCommand};
pub(crate) use signing::{KeysCommand, PassphraseArgs, PolicyWord, RoleWord, RootArgs, SignArgs, VerifyArgs};

use crate::{client::Client, commands, demo, error::Error, host, proof::Proof, watch};

/// Where the API is expected.
const API_DEFAULT: &str = "http://127.0.0.1:8480";

/// A WebAssembly-sandboxed controller host: swap controllers, lose hosts, and the actuator does not feel it.
///
/// Exit codes: 0 done, 1 failed, 2 wrong command line, 3 refused by the cell (nothing changed) or a rollout that failed, 4 API
/// not reachable.
#[derive(Debug, Parser)]
#[command(name = "bumpless", version, propagate_version = true, max_term_width = 110)]
pub struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,
    #[command(flatten)]
    pub(crate) to: To,
}

impl Cli {
    /// Shall answers, and errors too, be JSON?
    #[must_use]
    pub const fn wants_json(&self) -> bool {
        self.to.json
    }
}

/// Where a command goes, and how its answer is printed.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct To {
    /// Address of any host's API.
    #[arg(long, global = true, env = "BUMPLESS_API", default_value = API_DEFAULT, value_name = "URL")]
    pub(crate) api: String,
    /// Print the API's JSON instead of text for people.
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// A file with a token that only you may read (0600). BUMPLESS_TOKEN may hold the token itself; an argument never does.
    #[arg(long, global = true, env = "BUMPLESS_TOKEN_FILE", value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
    /// The authority that signed the host's certificate (PEM); the public ones where not given.
    #[arg(long, global = true, env = "BUMPLESS_CA", value_name = "FILE")]
    pub(crate) ca: Option<PathBuf>,
}

/// What can be done.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Run one host of a cell.
    Host(HostArgs),
    /// Start a whole cell on this machine: a simulated plant, three controller hosts, one running loop.
    Demo(DemoArgs),
    /// Begin a controller: a project with a law, a test on a simulated plant, and a README.
    New(NewArgs),
    /// Build a controller from Structured Text or Rust.
    Build(BuildArgs),
    /// Say of a controller what a cell would: world, imports, description, statelessness, step times.
    Check(CheckArgs),
    /// Build at each save, swap into a running loop, show its cycles.
    Dev(DevArgs),
    /// Upload a component (a .wasm file) or a script (.lua) to the cell's library.
    Upload(UploadArgs),
    /// The library: list, show, label, download, export, import, delete.
    Components(ComponentsArgs),
    /// Keys that sign components: new, list, trust, revoke, policy.
    Keys {
        #[command(subcommand)]
        what: KeysCommand,
    },
    /// Sign a component; the signature lies beside it, and goes with its upload.
    Sign(SignArgs),
    /// Check who signed a component, and whether the cell would take it.
    Verify(VerifyArgs),
    /// Loops: apply, list, show, command, swap, roll back.
    Loop {
        #[command(subcommand)]
        what: LoopCommand,
    },
    /// Free-running programs and scripts: apply, start, stop, pause, resume, list, show, log, checkpoint.
    Program {
        #[command(subcommand)]
        what: ProgramCommand,
    },
    /// One component for many loops: one loop first, then the rest by rule.
    Rollout {
        #[command(subcommand)]
        what: RolloutCommand,
    },
    /// Alarms: what stands, what happened, acknowledge, shelve, define.
    Alarm {
        #[command(subcommand)]
        what: Option<AlarmCommand>,
    },
    /// The audit trail, who changed what: list, verify, export.
    Audit {
        #[command(subcommand)]
        what: Option<AuditCommand>,
    },
    /// What a loop or a point did, for years: a table, or a CSV, JSON or Parquet file.
    History(HistoryArgs),
    /// Control experiments in virtual time: run, compare, sweep, report; from a recorded loop, and to a live one.
    Lab(LabArgs),
    /// Points and devices: scan, read, write, watch, force, jobs, point lists.
    Io {
        #[command(subcommand)]
        what: io::IoCommand,
    },
    /// Run one step of a component somewhere in the cell.
    Call(CallArgs),
    /// The hosts of the cell: list, drain, undrain.
    Hosts {
        #[command(subcommand)]
        what: Option<HostsCommand>,
    },
    /// Write what people made in the cell (components, loops, alarms) into one file.
    Backup {
        /// Where it goes.
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// Bring a backup into a cell that has no loops. A backup that is not whole changes nothing.
    Restore(RestoreArgs),
    /// List the points with their values.
    Points,
    /// Follow a loop: trend, who stepped, control indices.
    Watch(WatchArgs),
    /// Accounts: list, make the first one, add, change, remove.
    User {
        #[command(subcommand)]
        what: UserCommand,
    },
    /// Tokens for programs: list, make, revoke.
    Token {
        #[command(subcommand)]
        what: TokenCommand,
    },
    /// Sign in for the command line: a token of your own, in a file.
    Login(LoginArgs),
    /// Who you are to the host, and what you may do.
    Whoami,
    /// Certificates for a cell: an authority of its own, and its hosts.
    Ca {
        #[command(subcommand)]
        what: CaCommand,
    },
    /// Print a completion script for a shell.
    Completions {
        /// Which shell.
        shell: Shell,
    },
    /// What a host runs to compile a component apart from itself.
    #[command(hide = true)]
    CompileChild {
        /// The component.
        input: PathBuf,
        /// Where the compiled code goes.
        output: PathBuf,
    },
}

/// How a host is run.
#[derive(Debug, clap::Args)]
pub(crate) struct HostArgs {
    /// The configuration file.
    #[arg(long, value_name = "FILE")]
    pub(crate) config: PathBuf,
    /// Folder for data, instead of the one in the file.
    #[arg(long, value_name = "DIR")]
    pub(crate) data: Option<PathBuf>,
    /// Check the configuration and stop.
    #[arg(long)]
    pub(crate) check: bool,
    /// Check everything that a start needs and that touches neither a device nor the cell, and stop.
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// How log lines look on the error output. BUMPLESS_LOG filters them, for example `info,bumpless_loops=debug`.
    #[arg(long, value_enum, default_value_t = LogFormat::Text)]
    pub(crate) log_format: LogFormat,
    /// Stop when the standard input closes: for a parent that holds the other end.
    #[arg(long, hide = true)]
    pub(crate) until_stdin_closes: bool,
    /// Pass faults that are asked for over the API on to the parent, as lines on the standard output: for the demonstration.
    #[arg(long, hide = true)]
    pub(crate) faults_on_stdout: bool,
}

/// What is restored, and how.
#[derive(Debug, clap::Args)]
pub(crate) struct RestoreArgs {
    /// The backup.
    pub(crate) file: PathBuf,
    /// Only look whether it is whole; asks no cell.
    #[arg(long)]
    pub(crate) check: bool,
    /// Start every loop in manual: its outputs stay where they are until somebody says otherwise.
    #[arg(long)]
    pub(crate) manual: bool,
}

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// For people.
    Text,
    /// One JSON object per line.
    Json,
}

/// How the demonstration is run.
#[derive(Debug, clap::Args)]
pub(crate) struct DemoArgs {
    /// Folder with pid.wasm, pidplus.wasm and on-off.wasm; found beside the program where not given.
    #[arg(long, value_name = "DIR")]
    pub(crate) components: Option<PathBuf>,
    /// Folder for the hosts' configuration, data and logs; a new one under the system's temporary folder where not given.
    #[arg(long, value_name = "DIR")]
    pub(crate) dir: Option<PathBuf>,
    /// Stop after so many seconds.
    #[arg(long = "for", value_name = "SECONDS")]
    pub(crate) for_s: Option<u64>,
    /// Start a host that died again.
    #[arg(long)]
    pub(crate) restart: bool,
    /// Simulated tanks with a level loop each, beside the vessel.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(0..=200))]
    pub(crate) tanks: u32,
}

/// What can be done with loops.
#[derive(Debug, Subcommand)]
pub(crate) enum LoopCommand {
    /// Create or change a loop from a file (TOML). Returns when it is in force.
    Apply {
        /// The loop file.
        file: PathBuf,
    },
    /// List the loops.
    List,
    /// Show one loop.
    Show {
        /// The loop.
        name: String,
    },
    /// Set the setpoint, parameters or the strategy: `setpoint=1.5 k=2 action=direct strategy=p2c`.
    Set {
        /// The loop.
        name: String,
        /// What to set.
        #[arg(required = true, value_name = "KEY=VALUE", value_parser = pair)]
        values: Vec<(String, String)>,
    },
    /// Set the setpoint.
    Setpoint {
        /// The loop.
        name: String,
        /// In the unit of the measurement.
        #[arg(allow_negative_numbers = true)]
        value: f64,
    },
    /// Put the loop in manual or automatic.
    Mode {
        /// The loop.
        name: String,
        /// Who decides the output.
        mode: ModeWord,
    },
    /// Set outputs in manual: `40`, or `valve=40 pump=2` where there are several.
    Output {
        /// The loop.
        name: String,
        /// Values, by port or in the order of the output ports.
        #[arg(required = true, value_name = "[PORT=]VALUE", allow_negative_numbers = true)]
        values: Vec<String>,
    },
    /// Go on with another component, without a bump.
    Swap {
        /// The loop.
        name: String,
        /// `name`, `name@version`, or a digest or its first 8 digits.
        component: String,
    },
    /// Go back to an earlier revision.
    Rollback {
        /// The loop.
        name: String,
        /// Which revision; the one before where not given.
        #[arg(long, value_name = "REVISION")]
        to: Option<u64>,
    },
    /// End a loop; its outputs stay as they are.
    Delete {
        /// The loop.
        name: String,
    },
    /// Give the ownership to another host, between two cycles.
    Move {
        /// The loop.
        name: String,
        /// The host.
        host: String,
    },
    #[command(flatten)]
    History(HistoryCommand),
}

/// Who decides the output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ModeWord {
    /// The operator.
    Manual,
    /// The controller.
    #[value(alias = "automatic")]
    Auto,
}

impl From<ModeWord> for bumpless_api::types::Mode {
    fn from(word: ModeWord) -> Self {
        match word {
            ModeWord::Manual => Self::Manual,
            ModeWord::Auto => Self::Automatic,
        }
    }
}

/// One step from outside.
#[derive(Debug, clap::Args)]
pub(crate) struct CallArgs {
    /// `name`, `name@version`, or a digest or its first 8 digits.
    pub(crate) component: String,
    /// Input values by port.
    #[arg(long = "input", value_name = "PORT=VALUE", value_parser = number_pair)]
    pub(crate) inputs: Vec<(String, f64)>,
    /// Wanted value.
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true)]
    pub(crate) setpoint: f64,
    /// Time since the call before, in ms.
    #[arg(long, default_value_t = 100.0)]
    pub(crate) dt_ms: f64,
    /// Who decides the output.
    #[arg(long, value_enum, default_value_t = ModeWord::Auto)]
    pub(crate) mode: ModeWord,
    /// How the replica is chosen: round-robin, random, cpu, latency, p2c, local or shard.
    #[arg(long, default_value = "round-robin")]
    pub(crate) strategy: bumpless_core::Strategy,
    /// Parameters that differ from their defaults.
    #[arg(long = "parameter", value_name = "NAME=VALUE", value_parser = number_pair)]
    pub(crate) parameters: Vec<(String, f64)>,
    /// What the outputs hold, by port.
    #[arg(long = "track", value_name = "PORT=VALUE", value_parser = number_pair)]
    pub(crate) track: Vec<(String, f64)>,
    /// State from the call before, in base64.
    #[arg(long)]
    pub(crate) state: Option<String>,
    /// Number of the call; chooses the turn in round-robin.
    #[arg(long, default_value_t = 0)]
    pub(crate) seq: u64,
}

/// How a loop is followed.
#[derive(Debug, clap::Args)]
pub(crate) struct WatchArgs {
    /// The loop.
    #[arg(value_name = "LOOP")]
    pub(crate) name: String,
    /// Print one line per cycle instead of drawing; so it is too where the output is no terminal.
    #[arg(long)]
    pub(crate) plain: bool,
    /// Stop after so many cycles.
    #[arg(long, value_name = "CYCLES")]
    pub(crate) cycles: Option<u64>,
}

/// `key=value`.
fn pair(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.is_empty() && !value.is_empty() => Ok((key.to_owned(), value.to_owned())),
        _ => Err("write it as KEY=VALUE".to_owned()),
    }
}

/// `key=number`.
fn number_pair(text: &str) -> Result<(String, f64), String> {
    let (key, value) = pair(text)?;
    value
        .parse()
        .map(|number| (key, number))
        .map_err(|_| format!("{value:?} is no number"))
}

/// Runs what was typed.
///
/// # Errors
/// What failed; its exit code says of which sort.
pub fn run(cli: Cli) -> Result<(), Error> {
    let to = &cli.to;
    let client = || Client::with(&to.api, Proof::of(to)?);
    let json = to.json;
    match cli.command {
        Command::Host(args) => host::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::New(args) => commands::author::new(&args),
        Command::Build(args) => commands::author::build(&args),
        Command::Check(args) => commands::author::check(json, &args),
        Command::Dev(args) => watch::dev(&client()?, &args),
        Command::Upload(args) => commands::components::upload(&client()?, json, &args),
        Command::Components(ComponentsArgs { filter, what }) => {
            commands::components::run(&client()?, json, what.unwrap_or(ComponentsCommand::List(filter)))
        }
        Command::Keys { what } => commands::signing::keys(client, json, what),
        Command::Sign(args) => commands::signing::sign(client, json, &args),
        Command::Verify(args) => commands::signing::verify(&client()?, json, &args),
        Command::Loop { what } => commands::loops::run(&client()?, json, what),
        Command::Program { what } => commands::programs::run(&client()?, json, what),
        Command::Rollout { what } => commands::rollouts::run(&client()?, json, what),
        Command::Alarm { what } => commands::alarms::run(&client()?, json, what.unwrap_or(AlarmCommand::standing())),
        Command::Audit { what } => commands::audit::run(
            client,
            json,
            what.unwrap_or_else(|| AuditCommand::List(AuditListArgs::default())),
        ),
        Command::History(args) => commands::past::run(&client()?, json, &args),
        Command::Lab(LabArgs { what }) => commands::lab::run(client, json, what),
        Command::Io { what } => commands::io::run(client, json, what),
        Command::Call(args) => commands::components::call(&client()?, json, args),
        Command::Hosts { what } => commands::hosts::run(&client()?, json, what.unwrap_or(HostsCommand::List)),
        Command::Backup { output } => commands::backup::backup(&client()?, json, &output),
        Command::Restore(args) => commands::backup::restore(client, json, &args),
        Command::Points => commands::hosts::points(&client()?, json),
        Command::Watch(args) => watch::run(&client()?, json, &args),
        Command::User { what } => commands::access::users(&client()?, to, what),
        Command::Token { what } => commands::access::tokens(&client()?, to, what),
        Command::Login(args) => commands::access::login(&client()?, to, args),
        Command::Whoami => commands::access::whoami(&client()?, to),
        Command::Ca { what } => commands::ca::run(what),
        Command::Completions { shell } => {
            clap_complete::generate(shell, &mut Cli::command(), "bumpless", &mut std::io::stdout());
            Ok(())
        }
        Command::CompileChild { input, output } => {
            if !crate::realtime::yield_to_all() {
                // It has the lowest nice value at least.
                tracing::debug!("the compiler process stays in the usual class");
            }
            bumpless_engine::compile_child::run(&input, &output).map_err(|source| Error::Failed {
                what: "the compilation",
                source: source.into(),
            })
        }
    }
}

#[cfg(test)]
mod tests;
