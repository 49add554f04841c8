//! `cargo xtask simulate`: runs cells in simulated time, and says whether every rule held.
//!
//! Owns the command line. A rule that does not hold is printed with its seed and the course that led to it, and makes the exit
//! code 1; a plan that cannot be run makes it 2.

mod report;

use std::{path::PathBuf, process::ExitCode, time::Instant};

use bumpless_core::chatter;
use bumpless_simulation::{Broken, Error, FaultKind, Plan, RULES, Schedule, World};
use clap::Parser;

use crate::report::terminal::Report;

/// Lines of a course that are shown.
const COURSE_LINES: usize = 60;
/// Simulated time of one size of cell where messages are counted, in s.
const SIZE_SECONDS: u64 = 20;
/// By how much the messages of cycles, and of all that hosts tell and ask each other besides, may grow from the smallest cell to the largest: what a larger cell does differently is
/// that a loop's home is less often one of its replicas, so that a message more is sent.
const GROWTH_MAX: f64 = 1.2;

/// Runs whole cells in simulated time, from a seed.
#[derive(Parser)]
#[command(name = "cargo xtask simulate", version)]
struct Options {
    /// Hosts.
    #[arg(long, default_value_t = 100)]
    hosts: u32,
    /// Loops.
    #[arg(long, default_value_t = 5_000)]
    loops: u32,
    /// Kinds of faults: kill, pause, partition, loss, saturation, clock, disk, slow, bits; `none` for a calm cell.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "kill,pause,partition,loss,saturation,clock,disk,slow,bits"
    )]
    faults: Vec<String>,
    /// Faults per host and minute.
    #[arg(long, default_value_t = 1.0)]
    rate: f64,
    /// Simulated seconds during which faults strike.
    #[arg(long, default_value_t = 60)]
    seconds: u64,
    /// Simulated seconds after the last fault.
    #[arg(long, default_value_t = 30)]
    calm: u64,
    /// Everything random follows from it.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// So many seeds, one after the other.
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    /// A file of faults instead of drawn ones; see the head of simulation/src/plan.rs.
    #[arg(long)]
    schedule: Option<PathBuf>,
    /// Prints the faults of the plan as such a file, and runs nothing.
    #[arg(long)]
    print_schedule: bool,
    /// Shows the course of this loop at the end.
    #[arg(long)]
    trace: Option<u32>,
    /// Takes a rule away: no-terms, any-base, outputs-apart, terms-again, told-too-soon, first-answer, no-resume, unchained; or `all`, one
    /// after the other, each of which must be noticed.
    #[arg(long)]
    broken: Option<String>,
    /// Cells of which the messages are counted, in hosts, with as many loops per host; none to leave it out.
    #[arg(long, value_delimiter = ',')]
    sizes: Vec<u32>,
    /// One JSON line per figure on standard output.
    #[arg(long)]
    json: bool,
}

impl Options {
    fn plan(&self) -> Result<Plan, Error> {
        let words = self.faults.iter().filter(|word| !word.is_empty() && *word != "none");
        let schedule = match &self.schedule {
            Some(path) => {
                let text = std::fs::read_to_string(path).map_err(|source| Error::File {
                    path: path.clone(),
                    source,
                })?;
                Some(Schedule::parse(&text)?)
            }
            None => None,
        };
        let broken = self.broken.as_deref().filter(|word| *word != "all");
        Ok(Plan {
            seed: self.seed,
            hosts: self.hosts,
            loops: self.loops,
            seconds: self.seconds,
            calm_seconds: self.calm,
            kinds: words.map(|word| word.parse()).collect::<Result<_, _>>()?,
            faults_per_host_minute: self.rate,
            schedule,
            broken: broken.map(str::parse).transpose()?,
            trace: self.trace,
        })
    }
}

fn main() -> ExitCode {
    let options = Options::parse();
    let mut report = Report {
        json: options.json,
        holds: true,
    };
    match run(&options, &mut report) {
        Ok(()) if report.holds => ExitCode::SUCCESS,
        Ok(()) => ExitCode::FAILURE,
        Err(error) => {
            Report::failed(&error);
            ExitCode::from(2)
        }
    }
}

fn run(options: &Options, report: &mut Report) -> Result<(), Error> {
    let plan = options.plan()?;
    plan.check()?;
    if options.print_schedule {
        let schedule = Schedule { fault: plan.faults() };
        report.say(&toml::to_string(&schedule).map_err(|error| Error::Schedule(error.to_string()))?);
        return Ok(());
    }
    if options.broken.as_deref() == Some("all") {
        return broken_rules(&plan, options.seeds.max(20), report);
    }
    for seed in options.seed..options.seed.saturating_add(options.seeds.max(1)) {
        one(Plan { seed, ..plan.clone() }, report)?;
    }
    if !options.sizes.is_empty() {
        sizes(&plan, &options.sizes, report)?;
    }
    Ok(())
}

/// One simulation, with its figures.
fn one(plan: Plan, report: &mut Report) -> Result<(), Error> {
    report.say(&format!(
        "seed {}: {} hosts, {} loops, {} s with faults ({}) and {} s of calm",
        plan.seed,
        plan.hosts,
        plan.loops,
        plan.seconds,
        plan.kinds.iter().map(|kind| kind.name()).collect::<Vec<_>>().join(", "),
        plan.calm_seconds
    ));
    let began = Instant::now();
    let mut world = World::new(plan)?;
    world.run();
    let took_s = began.elapsed().as_secs_f64();
    let violated = world.violation().map(|v| v.rule);
    for rule in RULES {
        let broken = if violated == Some(rule) { 1.0 } else { 0.0 };
        report.at_most(&format!("violations: {rule}"), broken, "", 0.0);
    }
    if let Some(violation) = world.violation().cloned() {
        show(world.plan(), violation.number, report)?;
        report.say(&format!(
            "loop {} at {:.6} s: {}: {}",
            violation.number,
            violation.at_ns as f64 * 1e-9,
            violation.rule,
            violation.seen
        ));
        report.say(&format!(
            "the same course again: {}",
            again(world.plan(), violation.number)
        ));
        return Ok(());
    }
    let counts = world.counts();
    report.told("cycles taken", counts.taken as f64, "");
    report.told("cycles lost", counts.lost() as f64, "");
    for (kind, harm) in &counts.harm {
        let name = kind.map_or("no fault", FaultKind::name);
        if kind.is_none() {
            report.at_most("no fault: cycles lost", harm.lost as f64, "", 0.0);
        } else {
            report.told(&format!("{name}: struck"), harm.struck as f64, "");
            report.told(&format!("{name}: cycles lost"), harm.lost as f64, "");
            report.told(&format!("{name}: loops whose home was away"), harm.homes as f64, "");
        }
        report.told(
            &format!("{name}: cycles late (second half of the period)"),
            harm.late as f64,
            "",
        );
    }
    report.told("takeovers", counts.takeovers as f64, "");
    report.told("commands told done", counts.told as f64, "");
    report.told(
        "loops that lost a told command to two failures at once",
        counts.told_lost_to_two as f64,
        "",
    );
    report.told("steps that came out wrong", counts.flipped as f64, "");
    report.told("replicas that lost their vote", counts.dissents as f64, "");
    report.told("replicas that got it back", counts.readmitted as f64, "");
    report.told("cycles without a majority", counts.no_majority as f64, "");
    report.told("messages that never arrived", counts.undelivered as f64, "");
    report.told("events", counts.events as f64, "");
    report.told("time on this machine", took_s, "s");
    if world.plan().trace.is_some() {
        for line in world.trace() {
            report.say(line);
        }
    }
    Ok(())
}

/// Takes the course again, and shows the end of it for one loop.
fn show(plan: &Plan, number: u32, report: &Report) -> Result<(), Error> {
    let mut world = World::new(Plan {
        trace: Some(number),
        ..plan.clone()
    })?;
    world.run();
    let lines: Vec<&str> = world.trace().collect();
    for line in lines.iter().skip(lines.len().saturating_sub(COURSE_LINES)) {
        report.say(line);
    }
    Ok(())
}

/// The command that takes the same course.
fn again(plan: &Plan, number: u32) -> String {
    let kinds = plan.kinds.iter().map(|kind| kind.name()).collect::<Vec<_>>().join(",");
    let broken = plan
        .broken
        .map_or_else(String::new, |broken| format!(" --broken {}", broken.name()));
    let schedule = if plan.schedule.is_some() {
        " --schedule FILE"
    } else {
        ""
    };
    format!(
        "cargo xtask simulate --hosts {} --loops {} --seconds {} --calm {} --rate {} --faults {kinds} --seed {}{broken}{schedule} \
         --trace {number}",
        plan.hosts, plan.loops, plan.seconds, plan.calm_seconds, plan.faults_per_host_minute, plan.seed
    )
}

/// Takes each rule away in turn: some seed must show it.
fn broken_rules(plan: &Plan, seeds: u64, report: &mut Report) -> Result<(), Error> {
    for broken in Broken::ALL {
        let mut shown = None;
        for seed in plan.seed..plan.seed.saturating_add(seeds) {
            let mut world = World::new(Plan {
                seed,
                broken: Some(broken),
                ..plan.clone()
            })?;
            world.run();
            if let Some(violation) = world.violation() {
                shown = Some((seed, violation.clone()));
                break;
            }
        }
        let missed = if shown.is_some() { 0.0 } else { 1.0 };
        report.at_most(&format!("without {}: not noticed", broken.name()), missed, "", 0.0);
        if let Some((seed, violation)) = shown {
            let at_s = violation.at_ns as f64 * 1e-9;
            report.say(&format!(
                "  seed {seed}, {at_s:.3} s: {}: {}",
                violation.rule, violation.seen
            ));
        }
    }
    Ok(())
}

/// Counts the messages of calm cells of several sizes with as many loops per host.
fn sizes(plan: &Plan, sizes: &[u32], report: &mut Report) -> Result<(), Error> {
    let per_host = (plan.loops / plan.hosts.max(1)).max(1);
    let (mut of_cycles, mut of_all) = (Vec::new(), Vec::new());
    for hosts in sizes {
        let mut world = World::new(Plan {
            hosts: *hosts,
            loops: hosts.saturating_mul(per_host),
            kinds: Vec::new(),
            schedule: None,
            broken: None,
            trace: None,
            seconds: SIZE_SECONDS,
            calm_seconds: 1,
            ..plan.clone()
        })?;
        world.run();
        let counts = world.counts();
        let chatter_per_s = chatter::received_per_s(*hosts as usize);
        let rate = |n: u64| n as f64 / f64::from(*hosts) / (SIZE_SECONDS + 1) as f64;
        let name = |what: &str| format!("{hosts} hosts, {per_host} loops each: {what} per host and second");
        let cycles_per_s = rate(counts.messages.all());
        of_cycles.push(cycles_per_s);
        of_all.push(cycles_per_s + chatter_per_s);
        report.told(&name("messages of cycles"), rate(counts.messages.all()), "1/s");
        report.told(&name("samples"), rate(counts.messages.samples), "1/s");
        report.told(&name("answers"), rate(counts.messages.answers), "1/s");
        report.told(&name("steps and their answers"), rate(counts.messages.steps), "1/s");
        report.told(&name("records to holders"), rate(counts.messages.records), "1/s");
        report.told(
            &name("copies of records for the live feed"),
            rate(counts.feed_copies),
            "1/s",
        );
        report.told(&name("vitals, standings and probes"), chatter_per_s, "1/s");
    }
    for (what, rates) in [
        ("messages of cycles", of_cycles),
        ("messages of cycles, vitals, standings and probes", of_all),
    ] {
        if let (Some(first), Some(last)) = (rates.first(), rates.last()) {
            report.at_most(
                &format!("{what} per host, largest cell over smallest"),
                last / first,
                "",
                GROWTH_MAX,
            );
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "tests")]

    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_holds_together() {
        Options::command().debug_assert();
        let parse = |line: &str| Options::try_parse_from(line.split(' ')).expect("good").plan();
        let plan = parse("simulate --hosts 7 --faults kill,loss --seed 9 --broken no-terms").expect("good");
        assert_eq!((plan.hosts, plan.seed, plan.kinds.len()), (7, 9, 2));
        assert_eq!(plan.broken, Some(Broken::NoTerms));
        assert!(parse("simulate --faults none").expect("good").kinds.is_empty());
        for (line, part) in [
            ("simulate --faults flood", "use kill, pause"),
            ("simulate --broken it", "use no-terms"),
            ("simulate --schedule /nowhere", "name a file of faults"),
        ] {
            let error = parse(line).expect_err(line).to_string();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn the_command_that_is_printed_takes_the_same_course() {
        let plan = Plan {
            seed: 77,
            broken: Some(Broken::AnyBase),
            ..Plan::default()
        };
        let line = again(&plan, 5);
        let words = line.strip_prefix("cargo xtask ").expect("our own");
        let options = Options::try_parse_from(words.split_whitespace()).expect("good");
        let traced = Plan { trace: Some(5), ..plan };
        assert_eq!(options.plan().expect("good"), traced);
    }
}
