//! `step`: what the sandbox costs. A law as a native function against the same law as a component, in rounds that take
//! turns, so that a slow moment of the machine hits all of them; then the cycle of loops that live in one process.

use std::{hint::black_box, time::Instant};

use bumpless_engine::{Config, Engine, Instance};
use bumpless_isa::{Memory, Sample, Tuning};

use crate::{
    Options,
    error::Error,
    law, local,
    report::Report,
    spread::{Spread, median},
    stall::Watch,
};

/// Longest call, in ns: this bench measures and does not judge.
const LIMIT_NS: u64 = 1_000_000_000;
/// Rounds of which the median is told.
const ROUNDS: usize = 9;
/// Components against which the native law is held: all stock laws. The first is the same law.
const COMPONENTS: [&str; 15] = [
    "pid",
    "pidplus",
    "on-off",
    "cascade",
    "ratio",
    "split-range",
    "feedforward",
    "lead-lag",
    "override-selector",
    "gain-schedule",
    "smith",
    "fuzzy",
    "kalman-pid",
    "mpc",
    "autotune",
];

type Law = fn(&mut Memory, &Tuning, &Sample) -> f64;

/// Steps of one component, from its own state to the next.
struct Sandboxed {
    name: &'static str,
    instance: Instance,
    frames: Vec<bumpless_core::Frame>,
    state: Vec<u8>,
    rounds_ns: Vec<f64>,
    spread: Spread,
}

impl Sandboxed {
    fn new(engine: &Engine, name: &'static str) -> Result<Self, Error> {
        let prepared = law::prepare(engine, name)?;
        let mut instance = prepared.instantiate().map_err(|source| Error::Engine {
            what: name.to_owned(),
            source,
        })?;
        Ok(Self {
            name,
            state: law::first_state(&mut instance, LIMIT_NS)?,
            frames: law::frames(&prepared),
            instance,
            rounds_ns: Vec::new(),
            spread: Spread::new(),
        })
    }

    fn round(&mut self, steps: u64) -> Result<(), Error> {
        let started = Instant::now();
        for frame in self
            .frames
            .iter()
            .cycle()
            .take(usize::try_from(steps).unwrap_or(usize::MAX))
        {
            self.state = self.instance.step(black_box(frame), &self.state, LIMIT_NS)?.state;
        }
        self.rounds_ns.push(started.elapsed().as_nanos() as f64 / steps as f64);
        Ok(())
    }

    /// Each step by itself; the clock's own time is part of it.
    fn one_by_one(&mut self, steps: u64) -> Result<(), Error> {
        for frame in self
            .frames
            .iter()
            .cycle()
            .take(usize::try_from(steps).unwrap_or(usize::MAX))
        {
            let started = Instant::now();
            self.state = self.instance.step(black_box(frame), &self.state, LIMIT_NS)?.state;
            self.spread
                .add(u64::try_from(started.elapsed().as_nanos()).unwrap_or(u64::MAX));
        }
        Ok(())
    }
}

/// Nanoseconds per step of the native law, through a pointer that the compiler cannot see through.
fn native_round(memory: &mut Memory, samples: &[Sample], steps: u64) -> f64 {
    let law: Law = black_box(Memory::step);
    let tuning = law::tuning();
    let started = Instant::now();
    for sample in samples
        .iter()
        .cycle()
        .take(usize::try_from(steps).unwrap_or(usize::MAX))
    {
        black_box(law(memory, &tuning, black_box(sample)));
    }
    started.elapsed().as_nanos() as f64 / steps as f64
}

/// Nanoseconds of an empty function through a pointer: what calling costs at all.
fn empty_round(steps: u64) -> f64 {
    fn empty(sample: u64) -> u64 {
        sample
    }
    let call: fn(u64) -> u64 = black_box(empty);
    let started = Instant::now();
    for number in 0..steps {
        black_box(call(number));
    }
    started.elapsed().as_nanos() as f64 / steps as f64
}

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let watch = Watch::start();
    let steps = options.count(200_000, 20_000);
    let engine = Engine::new(Config::default()).map_err(|source| Error::Engine {
        what: "its own configuration".to_owned(),
        source,
    })?;
    let mut sandboxed = COMPONENTS
        .iter()
        .map(|name| Sandboxed::new(&engine, name))
        .collect::<Result<Vec<_>, _>>()?;
    let (mut empty, mut native) = (Vec::new(), Vec::new());
    let (mut memory, samples) = (law::memory(), law::samples());
    report.progress(&format!("{ROUNDS} rounds of {steps} steps of each kind, in turns"));
    for _ in 0..ROUNDS {
        empty.push(empty_round(steps));
        native.push(native_round(&mut memory, &samples, steps));
        for component in &mut sandboxed {
            component.round(steps)?;
        }
    }
    for component in &mut sandboxed {
        component.one_by_one(steps)?;
    }
    let native = median(&native);
    report.told("step.empty_function", median(&empty), "ns");
    report.told("step.native_pid", native, "ns");
    for component in &sandboxed {
        let each = median(&component.rounds_ns);
        report.told(&format!("step.component.{}", component.name), each, "ns");
        report.told(
            &format!("step.component.{}.times_native_pid", component.name),
            each / native,
            "×",
        );
        for (part, text) in [(0.99, "p99"), (0.999, "p99_9")] {
            report.told(
                &format!("step.component.{}.{text}", component.name),
                component.spread.us(part) * 1000.0,
                "ns",
            );
        }
    }
    drop(sandboxed);
    local::run(options, report, &engine)?;
    watch.finish().tell(report, "step");
    Ok(())
}
