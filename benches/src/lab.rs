//! `lab`: how fast virtual time passes. An hour of the pilot plant under `pid` with the lab's whole cycle, and the same
//! experiment written natively: the plant's model and the law as functions, and nothing else.
//!
//! Both run on one thread and in turns, so that a slow moment of the machine hits both.

use std::{path::Path, time::Instant};

use bumpless_engine::{Config, Engine};
use bumpless_io::sim::{PlantSettings, Stock, model::stock};
use bumpless_isa::{Memory, Sample};
use bumpless_lab::{Experiment, Lab, Library};

use crate::{Options, error::Error, law, report::Bound, report::Report, spread::median, stall::Watch};

/// Rounds of which the median is told.
const ROUNDS: usize = 5;
/// Period of the loop, in ms.
const PERIOD_MS: u64 = 100;
/// The lab may take this much longer than the bare functions: most of an hour is the plant's own equations.
const RATIO_MAX: f64 = 1.5;

fn experiment(duration_s: u64) -> String {
    format!(
        r#"
name = "bench"
duration_s = {duration_s}
plant = {{ model = "pilot" }}
controller = {{ component = "pid", parameters = {{ k = 1.6, ti = 4.5, out-high = 10.0 }} }}
[[loop]]
name = "pressure"
ports = {{ pv = "pit129", out = "p1" }}
period_ms = {PERIOD_MS}
setpoint = [{{ at_s = 0, to = 0.6 }}, {{ at_s = 20, to = 1.1 }}]
"#
    )
}

/// The same loop as plain functions; gives its IAE, so that nothing is optimised away.
fn native(duration_s: u64) -> Result<f64, Error> {
    let said = |what: String| Error::Said {
        who: "the plant's model".to_owned(),
        said: what,
        expected: "a plant",
    };
    let mut model = stock(&Stock::Pilot(PlantSettings::default()), 1).map_err(said)?;
    let number = |name: &str| model.signals().iter().position(|s| s.name == name).unwrap_or(0);
    let (pv, out) = (number("pit129"), number("p1"));
    let (mut memory, mut tuning) = (Memory::new(0.0), law::tuning());
    (tuning.gain, tuning.ti_s, tuning.out_high) = (1.6, 4.5, 10.0);
    let (mut iae, dt_s) = (0.0, PERIOD_MS as f64 * 1e-3);
    for k in 1..=duration_s * 1000 / PERIOD_MS {
        model
            .advance(k * PERIOD_MS * 1_000_000)
            .map_err(|halted| said(halted.to_string()))?;
        let setpoint = if k * PERIOD_MS < 20_000 { 0.6 } else { 1.1 };
        let shown = model.shown(pv);
        let output = memory.step(
            &tuning,
            &Sample::automatic(shown, setpoint, Some(model.truth(out)), dt_s),
        );
        iae += (setpoint - model.truth(pv)).abs() * dt_s;
        model.set(out, output);
    }
    Ok(iae)
}

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let watch = Watch::start();
    let duration_s = options.count(3600, 300);
    let engine = Engine::new(Config::default()).map_err(|source| Error::Engine {
        what: "its own configuration".to_owned(),
        source,
    })?;
    let folder = xtask::components::build().map_err(Error::Components)?;
    let lab = Lab::new(Library::new(engine, vec![folder]));
    let (experiment, _) = Experiment::parse(&experiment(duration_s), "bench")?;
    let (mut with, mut without) = (Vec::new(), Vec::new());
    let mut apart: f64 = 0.0;
    report.progress(&format!(
        "{ROUNDS} rounds of {duration_s} s of the pilot plant, in the lab and natively, in turns"
    ));
    for _ in 0..ROUNDS {
        let started = Instant::now();
        let run = lab.make(&experiment, 1, false, Path::new("."), &|| false)?;
        with.push(started.elapsed().as_secs_f64());
        let started = Instant::now();
        let iae = native(duration_s)?;
        without.push(started.elapsed().as_secs_f64());
        let ours = run
            .loops
            .first()
            .and_then(|l| l.figures.get("iae"))
            .copied()
            .unwrap_or(f64::NAN);
        apart = apart.max((ours / iae - 1.0).abs() * 100.0);
    }
    let hours = duration_s as f64 / 3600.0;
    let (with, without) = (median(&with), median(&without));
    report.told("lab.pilot_plant.hours_per_second_per_core", hours / with, "h/s");
    report.told(
        "lab.pilot_plant.native.hours_per_second_per_core",
        hours / without,
        "h/s",
    );
    report.figure(
        "lab.pilot_plant.times_native",
        with / without,
        "×",
        Bound::AtMost(RATIO_MAX),
    );
    let cycles = duration_s as f64 * 1000.0 / PERIOD_MS as f64;
    report.told("lab.pilot_plant.cost_of_a_cycle", (with - without) / cycles * 1e6, "µs");
    // The lab's first cycle is one period later and its looks are at the cycles, so the two need not agree to the last digit.
    report.figure("lab.pilot_plant.iae_apart", apart, "%", Bound::AtMost(1.0));
    watch.finish().tell(report, "lab");
    Ok(())
}
