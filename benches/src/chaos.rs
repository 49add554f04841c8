//! `chaos`: every kind of fault on a cell of real processes, in an order and for times that a seed decides.
//!
//! ```text
//! plant (home) and a, b, c, d, each in a network namespace · twenty loops, 10 to 100 Hz · setpoints up and down all the time
//! undisturbed ──► fault, until all is well again ──► quiet ──► fault … ──► the actuators' journal is judged
//! ```
//! Owns the course of a run; what came of it is `chaos_report`. Never: stops at the first breach; the whole run is judged.

use std::{sync::Arc, time::Duration};

use bumpless_tests::{
    Cell, CellOptions, Inflictor, Kind, Net, Observer, Operator, PLANT, Profile, Schedule, Window, unix_ns,
};
use clap::Args;
use serde_json::json;

use crate::{
    Options,
    chaos_report::{Course, tell},
    error::Error,
    report::Report,
    stall::Watch,
};

/// Controller hosts.
const CONTROLLERS: usize = 4;
/// Loops.
pub(crate) const LOOPS: usize = 20;
/// Periods of the loops, in ms, by turns: two loops at 100 Hz, four at 50, six at 20, eight at 10.
const PERIODS_MS: [u64; 10] = [10, 20, 20, 50, 50, 50, 100, 100, 100, 100];
/// Levels of the setpoints, in % of span, and the time on one.
pub(crate) const PROFILE: Profile = Profile {
    levels: [40.0, 60.0],
    half: Duration::from_secs(5),
};
/// Bytes of the small disks: a store, compiled components and some history.
const DISK_BYTES: u64 = 96 * 1024 * 1024;
/// How far the dates of the controller hosts are off from the beginning, in h.
const APART_H: [(&str, i64); CONTROLLERS] = [("a", -11), ("b", 7), ("c", -3), ("d", 23)];
/// Quiet between two faults, in ms, least and greatest.
const QUIET_MS: (u64, u64) = (500, 3_000);
/// Of the whole time, the part that is left undisturbed, to compare with.
const UNDISTURBED_PART: u32 = 6;

/// What can be wished of a run.
#[derive(Debug, Clone, Args)]
pub(crate) struct Wishes {
    /// How long faults are inflicted, in minutes.
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// What decides kinds, hosts and times.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Only this kind of fault; `owner-kill-5ms` is a bench of its own: owners of a loop at 200 Hz.
    #[arg(long, value_parser = only)]
    only: Option<Only>,
    /// On the loopback interface, also where network namespaces are permitted.
    #[arg(long)]
    loopback: bool,
}

/// A part of the bench.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Only {
    /// A kind of fault.
    Kind(Kind),
    /// Kills of the owner of one fast loop.
    OwnerKills,
}

fn only(text: &str) -> Result<Only, String> {
    if text == "owner-kill-5ms" {
        return Ok(Only::OwnerKills);
    }
    Kind::ALL
        .into_iter()
        .find(|kind| kind.name() == text)
        .map(Only::Kind)
        .ok_or_else(|| {
            let names: Vec<&str> = Kind::ALL.iter().map(|kind| kind.name()).collect();
            format!("use one of {}, owner-kill-5ms", names.join(", "))
        })
}

impl Wishes {
    /// Is it the bench of fast owners?
    pub(crate) fn owner_kills(&self) -> bool {
        self.only == Some(Only::OwnerKills)
    }

    fn kinds(&self) -> Vec<Kind> {
        match self.only {
            Some(Only::Kind(kind)) => vec![kind],
            _ => Kind::ALL.to_vec(),
        }
    }
}

/// A loop's name, actuator and period, by its number.
pub(crate) fn loop_of(number: usize) -> (String, String, u64) {
    let period_ms = PERIODS_MS.get(number % PERIODS_MS.len()).copied().unwrap_or(100);
    (
        format!("loop-{number}"),
        format!("plant.{number}.out"),
        period_ms * 1_000_000,
    )
}

/// Runs the bench.
pub(crate) fn run(options: Options, wishes: &Wishes, report: &mut Report) -> Result<(), Error> {
    let minutes = if options.quick {
        wishes.minutes.min(1.0)
    } else {
        wishes.minutes
    };
    if !(minutes > 0.0 && minutes <= 24.0 * 60.0 / 2.0) {
        return Err(Error::Wish(format!(
            "--minutes {minutes}: up to 720 minutes are possible"
        )));
    }
    let faults_for = Duration::from_secs_f64(minutes * 60.0);
    let mut cell = start(wishes, report)?;
    apply_loops(&mut cell)?;
    let names: Vec<String> = (0..LOOPS).map(|n| loop_of(n).0).collect();
    let mut inflictor = Inflictor { cell };
    inflictor.wait_well()?;
    let started_ns = unix_ns();
    let observer = Observer::follow(&inflictor.cell.plant.api(), &names, started_ns)?;
    let addresses: Vec<String> = inflictor.cell.hosts().map(|host| host.api.clone()).collect();
    let operator = Operator::start(&addresses, &names, PROFILE)?;
    let watch = Watch::start();

    // The plant settles first: its first seconds are no comparison for anything.
    std::thread::sleep(PROFILE.half * 2);
    let from_ns = unix_ns();
    let undisturbed = (faults_for / UNDISTURBED_PART).max(PROFILE.half * 4);
    report.progress(&format!("undisturbed: {} s", undisturbed.as_secs()));
    std::thread::sleep(undisturbed);
    let undisturbed = (from_ns, unix_ns());

    report.progress(&format!("faults for {minutes} min, seed {}", wishes.seed));
    let (windows, broken) = inflict(&mut inflictor, wishes, faults_for, report);
    let orders = operator.finish();
    // The journal reaches the disk within a quarter of a second, and so do the last records the feed.
    std::thread::sleep(Duration::from_secs(1));
    let ended_ns = unix_ns();
    let stalls = watch.finish();
    let lost_records = observer.lost();
    let mut journal = inflictor.cell.journal()?;
    journal.undo_dates(started_ns);
    let course = Course {
        undisturbed,
        ended_ns,
        windows,
        broken,
        orders,
        records: observer.finish(),
        lost_records,
        journal,
        stalls,
    };
    tell(&course, report);
    Ok(())
}

fn start(wishes: &Wishes, report: &Report) -> Result<Cell, Error> {
    let net = if wishes.loopback {
        report.progress("no network namespaces, as wished: all hosts on the loopback interface");
        None
    } else {
        match Net::new(1 + CONTROLLERS) {
            Ok(net) => {
                report.progress(&format!("hosts are cut off by {}", net.means()));
                Some(Arc::new(net))
            }
            Err(error) => {
                report.progress(&format!(
                    "no network namespaces here ({error}): all hosts on the loopback interface, and only the relayed link is cut"
                ));
                None
            }
        }
    };
    report.progress(&format!(
        "{LOOPS} loops on a plant and {CONTROLLERS} controllers, in {} processes",
        1 + CONTROLLERS
    ));
    let options = |disks: Vec<(String, u64)>| CellOptions {
        controllers: CONTROLLERS,
        plant_tables: "[history]\nbytes_max_mib = 16\n".to_owned(),
        net: net.clone(),
        relayed: Some("a".to_owned()),
        disks,
        dates: true,
        heads: APART_H
            .iter()
            .map(|(host, hours)| ((*host).to_owned(), format!("clock_offset_s = {}\n", hours * 3_600)))
            .collect(),
        ..CellOptions::first_order(&format!(
            "{{ count = {LOOPS}, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.002 }}"
        ))
    };
    let disks = vec![(PLANT.to_owned(), DISK_BYTES), ("b".to_owned(), DISK_BYTES)];
    match Cell::start(options(disks)) {
        Err(bumpless_tests::Error::Program { program, source }) if program == "mount" => {
            report.progress(&format!("no small disks here ({source}): no disk is filled"));
            Ok(Cell::start(options(Vec::new()))?)
        }
        cell => Ok(cell?),
    }
}

fn apply_loops(cell: &mut Cell) -> Result<(), Error> {
    let api = cell.api()?;
    api.upload_stock(&["pid"])?;
    for number in 0..LOOPS {
        let (name, out, period_ns) = loop_of(number);
        api.apply(&json!({
            "name": name,
            "component": "pid",
            "period_ms": period_ns as f64 / 1e6,
            "ports": { "pv": format!("plant.{number}.pv"), "out": out },
            "parameters": { "k": 1.5, "ti": 1.0 },
            "setpoint": PROFILE.levels[0],
            "strategy": if number % 2 == 0 { "round-robin" } else { "local" },
            // Some want to run at one host, so that returns are part of the run.
            "prefer": if number % 4 == 3 { vec!["b"] } else { vec![] },
        }))?;
    }
    Ok(())
}

/// Inflicts until the time is up, or until the cell does not recover; then the reason is given.
fn inflict(
    inflictor: &mut Inflictor,
    wishes: &Wishes,
    faults_for: Duration,
    report: &Report,
) -> (Vec<Window>, Option<String>) {
    let (possible, impossible): (Vec<Kind>, Vec<Kind>) = wishes
        .kinds()
        .into_iter()
        .partition(|kind| inflictor.possible(*kind).is_ok());
    for kind in impossible {
        if let Err(missing) = inflictor.possible(kind) {
            report.progress(&format!("{} is left out: {missing}", kind.name()));
        }
    }
    let longest_ms = u64::try_from(faults_for.as_millis() / 5).unwrap_or(u64::MAX);
    let started = std::time::Instant::now();
    let mut windows = Vec::new();
    for fault in Schedule::new(wishes.seed, &possible, longest_ms, QUIET_MS) {
        std::thread::sleep(Duration::from_millis(fault.quiet_ms));
        if started.elapsed() >= faults_for {
            break;
        }
        match inflictor.inflict(&fault) {
            Ok(window) => {
                let took_s = (window.to_ns - window.from_ns) as f64 / 1e9;
                report.progress(&format!(
                    "{}: {}; well again after {took_s:.1} s",
                    window.kind.name(),
                    window.words
                ));
                windows.push(window);
            }
            Err(error) => {
                report.progress(&format!("{}: {error}", fault.kind.name()));
                return (windows, Some(error.to_string()));
            }
        }
    }
    (windows, None)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_chosen_by_name() {
        assert_eq!(only("cut-one-way"), Ok(Only::Kind(Kind::CutOneWay)));
        assert_eq!(only("owner-kill-5ms"), Ok(Only::OwnerKills));
        assert!(only("flood").is_err_and(|words| words.contains("home-kill, home-pause")));
    }

    #[test]
    fn loops_run_at_ten_to_a_hundred_hertz() {
        let periods: Vec<u64> = (0..LOOPS).map(|n| loop_of(n).2 / 1_000_000).collect();
        for (period, count) in [(10, 2), (20, 4), (50, 6), (100, 8)] {
            assert_eq!(periods.iter().filter(|p| **p == period).count(), count, "{period} ms");
        }
    }
}
