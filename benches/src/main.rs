//! `cargo xtask bench <name>`: what Bumpless promises, measured on this machine and judged.
//!
//! Owns the command line. Every bench prints its conditions, then one figure per line; a figure whose bound does not hold
//! makes the exit code 1, a bench that could not run makes it 2.
//! Never: a timing that a test depends on; benches are run by people and by the release's checklist.

mod actuator;
mod archive;
mod call;
mod chaos;
mod chaos_report;
mod conditions;
mod crash;
mod devices;
mod error;
mod failover;
mod faults;
mod history;
mod hostile;
mod io;
mod killer;
mod kills;
mod lab;
mod languages;
mod law;
mod local;
mod masters;
mod page;
mod peer;
mod programs;
mod redundancy;
mod report;
mod rest;
mod scripts;
mod select;
mod spread;
mod stall;
mod step;
mod stress;
mod swap;
mod switch;
mod upload;

use std::process::ExitCode;

use clap::{Args, Parser, Subcommand, ValueEnum};

use crate::{conditions::Conditions, error::Error, report::Report};

/// Measures what Bumpless promises.
#[derive(Parser)]
#[command(name = "cargo xtask bench", version)]
struct CommandLine {
    #[command(subcommand)]
    bench: Bench,
    #[command(flatten)]
    options: Options,
}

#[derive(Subcommand)]
enum Bench {
    /// Kills and pauses of replicas and owners: lost cycles, pauses, double writes, integral of the absolute error.
    Failover {
        /// Only this kind of fault.
        #[arg(long, value_enum)]
        only: Option<FaultKind>,
    },
    /// Faults of every kind on a cell of five hosts and twenty loops, by a seed, under a checker.
    Chaos(chaos::Wishes),
    /// Replicas off and on while a loop steps, as a picture, and its error against an undisturbed run.
    Redundancy {
        /// Where the picture goes.
        #[arg(long, default_value = "docs/figures/redundancy.svg")]
        svg: std::path::PathBuf,
    },
    /// A remote step over loopback TCP between processes, on the bus and through the REST API.
    Call,
    /// How soon strategies leave a replica that is loaded or far away, and come back.
    Select,
    /// 200 swaps on a running loop under load, with and without compiling: lost cycles and the step of the output.
    /// With --hz, --count or --kill: hundreds on one fast loop, also while its owner is killed, then components that go wrong
    /// on probation.
    Swap(switch::Switching),
    /// The operator's page with 50 loops: first paint, frames, processor, memory; and what 30 readers do to the cycles.
    Page(page::Watching),
    /// One device, two hosts that may write it: the one that does is killed or stopped. Double writes, and pauses.
    Masters,
    /// From an upload to the first cycle, what running loops feel of it, bombs, and many uploads at once.
    Upload,
    /// Every hostile component of the table beside fifty loops at 100 Hz: jitter with and without, and memory.
    Hostile,
    /// Virtual time: hours of the pilot plant per second and core, against the same experiment as plain functions.
    Lab,
    /// The long memory: cycles in, bytes on disk, a day on a thousand columns.
    History,
    /// The published experiments of 3C scripts: square wave, PID cycle, jitter; and 5,000 programs that sleep.
    Programs,
    /// The published level control by 3C scripts, on one board and on two, as pictures.
    Scripts {
        /// Where the pictures go.
        #[arg(long, default_value = "docs/figures")]
        folder: std::path::PathBuf,
    },
    /// A step native and in the sandbox, and the cycle of a loop whose owner, replica and I/O are one process.
    Step,
    /// The example law in every language: size, compile, instantiate, step, memory, and the ratio to native.
    Languages,
    /// 1,000 points on ten Modbus devices at 10 Hz: requests, staleness, processor time; and one device that is slow.
    Io,
    /// Stores whose writers end at any change, whose disks fill up, freeze, lose power and rot: what was acknowledged is there.
    Crash(crash::Wishes),
    /// The process of `crash` that writes.
    #[command(hide = true)]
    CrashLife(crash::LifeArgs),
    /// The process of `crash` that looks.
    #[command(hide = true)]
    CrashLook(crash::LookArgs),
    /// The other process of `io`.
    #[command(hide = true)]
    IoDevices {
        /// How many devices.
        count: u16,
    },
    /// The other process of `call`.
    #[command(hide = true)]
    CallPeer {
        /// The component to step.
        component: std::path::PathBuf,
    },
    /// The load of `select`.
    #[command(hide = true)]
    Burn {
        /// The core to load.
        core: usize,
    },
}

/// A kind of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum FaultKind {
    /// `kill -9` of a replica.
    Replica,
    /// SIGSTOP of a replica, for 5 s.
    Pause,
    /// `kill -9` of the owner.
    Owner,
}

/// How a bench is run.
#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct Options {
    /// One JSON line per figure on standard output; the conditions go to standard error.
    #[arg(long, global = true)]
    json: bool,
    /// Smaller counts, the same checks.
    #[arg(long, global = true)]
    quick: bool,
}

impl Options {
    /// `full`, or `quick` where less is asked for.
    const fn count(self, full: u64, quick: u64) -> u64 {
        if self.quick { quick } else { full }
    }
}

fn main() -> ExitCode {
    let CommandLine { bench, options } = CommandLine::parse();
    match run(&bench, options) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            report::failed(&error);
            ExitCode::from(2)
        }
    }
}

/// Says whether every bound holds.
fn run(bench: &Bench, options: Options) -> Result<bool, Error> {
    let name = match bench {
        Bench::Call => "call",
        Bench::Chaos(_) => "chaos",
        Bench::Redundancy { .. } => "redundancy",
        Bench::Failover { .. } => "failover",
        Bench::Masters => "masters",
        Bench::Select => "select",
        Bench::Swap(_) => "swap",
        Bench::History => "history",
        Bench::Hostile => "hostile",
        Bench::Lab => "lab",
        Bench::Programs => "programs",
        Bench::Scripts { .. } => "scripts",
        Bench::Step => "step",
        Bench::Languages => "languages",
        Bench::Upload => "upload",
        Bench::Page(_) => "page",
        Bench::Io => "io",
        Bench::Crash(_) => "crash",
        Bench::CrashLife(args) => return crash::live(args).map(|()| true),
        Bench::CrashLook(args) => return crash::look(args).map(|()| true),
        Bench::IoDevices { count } => return devices::run(*count).map(|()| true),
        Bench::Burn { core } => return stress::burn(*core).map(|()| true),
        Bench::CallPeer { component } => return peer::run(component).map(|()| true),
    };
    let conditions = Conditions::now(name, options.quick);
    let mut report = Report::begin(&conditions, options.json);
    match bench {
        Bench::Call => call::run(options, &mut report)?,
        Bench::Chaos(wishes) if wishes.owner_kills() => kills::run(options, &mut report)?,
        Bench::Chaos(wishes) => chaos::run(options, wishes, &mut report)?,
        Bench::Redundancy { svg } => redundancy::run(options, svg, &mut report)?,
        Bench::Failover { only } => failover::run(options, *only, &mut report)?,
        Bench::Masters => masters::run(options, &mut report)?,
        Bench::Select => select::run(options, &mut report)?,
        Bench::Swap(switching) if switching.is_wanted() => switch::run(options, *switching, &mut report)?,
        Bench::Swap(_) => swap::run(options, &mut report)?,
        Bench::History => archive::run(options, &mut report)?,
        Bench::Hostile => hostile::run(options, &mut report)?,
        Bench::Lab => lab::run(options, &mut report)?,
        Bench::Programs => programs::run(options, &mut report)?,
        Bench::Scripts { folder } => scripts::run(folder, &mut report)?,
        Bench::Languages => languages::run(options, &mut report)?,
        Bench::Step => step::run(options, &mut report)?,
        Bench::Upload => upload::run(options, &mut report)?,
        Bench::Page(watching) => page::run(options, *watching, &mut report)?,
        Bench::Io => io::run(options, &mut report)?,
        Bench::Crash(wishes) => crash::run(options, *wishes, &mut report)?,
        Bench::CrashLife(_) | Bench::CrashLook(_) => {}
        Bench::CallPeer { .. } | Bench::Burn { .. } | Bench::IoDevices { .. } => {}
    }
    Ok(report.end())
}
