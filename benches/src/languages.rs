//! `languages`: the example law of each language: its component's size, how long it takes to compile, to instantiate and to step,
//! what an instance takes of memory, and all of it against the same law as a native function.
//!
//! ```text
//!   examples/NAME ─ build ─► component ─ compile ─► prepared ─ instantiate ─► steps, in rounds that take turns
//!                                                                    └─► outputs against the native law: bound 1e-12
//! ```

use std::{hint::black_box, time::Instant};

use bumpless_core::Frame;
use bumpless_engine::{Config, Engine, Instance, Limits, Prepared};
use rust_pid::law::{Memory, Tuning};

use crate::{
    Options,
    error::Error,
    law,
    report::{Bound, Report},
    spread::{Spread, median},
    stall::Watch,
};

/// Longest call, in ns: this bench measures and does not judge.
const LIMIT_NS: u64 = 1_000_000_000;
/// Linear memory that an instance may have here, in bytes; a host gives 16 MiB unless its configuration says more.
const MEMORY_BYTES_MAX: usize = 128 * 1024 * 1024;
/// Rounds of which the median is told.
const ROUNDS: usize = 9;
/// Instances of which the mean is told.
const INSTANCES: usize = 16;
/// How far an output may be from the native law's, in units of the output.
const APART_MAX: f64 = 1e-12;
/// What every law holds at its start, in units of the output.
const HELD: f64 = 50.0;

/// The default parameters of the example law.
const TUNING: Tuning = Tuning {
    gain: 1.0,
    ti_s: 10.0,
    td_s: 0.0,
    td_filter_s: 1.0,
    out_low: 0.0,
    out_high: 100.0,
};

type Law = fn(&mut Memory, &Tuning, f64, f64, f64, f64) -> f64;

/// What the native law needs of a frame.
#[derive(Debug, Clone, Copy)]
struct Sample {
    pv: f64,
    setpoint: f64,
    held: f64,
    dt_s: f64,
}

fn sample(frame: &Frame) -> Sample {
    let value = |port: usize| frame.readings.get(port).map_or(0.0, |reading| reading.last_good);
    Sample {
        pv: value(0),
        setpoint: frame.cycle.setpoint,
        held: value(1),
        dt_s: frame.cycle.dt_ns as f64 * 1e-9,
    }
}

/// One language's component, from its own state to the next.
struct Sandboxed {
    name: &'static str,
    instance: Instance,
    /// Linear memory after its first steps, in bytes.
    linear: usize,
    frames: Vec<Frame>,
    state: Vec<u8>,
    rounds_ns: Vec<f64>,
    spread: Spread,
}

impl Sandboxed {
    /// Reads, compiles and instantiates, and tells what that costs.
    fn new(engine: &Engine, name: &'static str, bytes: &[u8], report: &mut Report) -> Result<Self, Error> {
        let failed = |source| Error::Engine {
            what: name.to_owned(),
            source,
        };
        let started = Instant::now();
        let prepared = engine.prepare(bytes).map_err(failed)?;
        let compile_s = started.elapsed().as_secs_f64();
        report.told(&format!("languages.{name}.component"), bytes.len() as f64, "bytes");
        report.told(&format!("languages.{name}.compile"), compile_s * 1e3, "ms");
        resident(&prepared, name, report)?;
        let mut instance = prepared.instantiate().map_err(failed)?;
        let state = law::first_state(&mut instance, LIMIT_NS)?;
        let started = Instant::now();
        let made = Self {
            name,
            state: instance.step(&first(&prepared), &state, LIMIT_NS)?.state,
            linear: instance.memory_bytes(),
            frames: law::frames(&prepared),
            instance,
            rounds_ns: Vec::new(),
            spread: Spread::new(),
        };
        let first_ns = started.elapsed().as_nanos() as f64;
        report.told(&format!("languages.{name}.first_step"), first_ns, "ns");
        Ok(made)
    }

    /// Largest distance from the native law over all samples, from a fresh state.
    fn apart(&mut self) -> Result<f64, Error> {
        let mut state = law::first_state(&mut self.instance, LIMIT_NS)?;
        let (mut native, mut apart) = (Memory::new(HELD), 0.0_f64);
        for frame in &self.frames {
            let effects = self.instance.step(frame, &state, LIMIT_NS)?;
            let s = sample(frame);
            let wanted = native.step(&TUNING, s.pv, s.setpoint, s.held, s.dt_s);
            // A law that writes nothing is as far from it as can be.
            let given = effects.writes.first().map_or(f64::INFINITY, |(_, value)| *value);
            apart = apart.max((given - wanted).abs());
            state = effects.state;
        }
        Ok(apart)
    }

    fn round(&mut self, steps: u64) -> Result<(), Error> {
        let steps = usize::try_from(steps).unwrap_or(usize::MAX);
        let started = Instant::now();
        for frame in self.frames.iter().cycle().take(steps) {
            self.state = self.instance.step(black_box(frame), &self.state, LIMIT_NS)?.state;
        }
        self.rounds_ns.push(started.elapsed().as_nanos() as f64 / steps as f64);
        Ok(())
    }

    /// Each step by itself; the clock's own time is part of it.
    fn one_by_one(&mut self, steps: u64) -> Result<(), Error> {
        let steps = usize::try_from(steps).unwrap_or(usize::MAX);
        for frame in self.frames.iter().cycle().take(steps) {
            let started = Instant::now();
            self.state = self.instance.step(black_box(frame), &self.state, LIMIT_NS)?.state;
            self.spread
                .add(u64::try_from(started.elapsed().as_nanos()).unwrap_or(u64::MAX));
        }
        Ok(())
    }
}

fn first(prepared: &Prepared) -> Frame {
    law::frames(prepared).swap_remove(0)
}

/// Time to make an instance, its linear memory, and what it really takes, as means of some.
fn resident(prepared: &std::sync::Arc<Prepared>, name: &str, report: &mut Report) -> Result<(), Error> {
    let failed = |source| Error::Engine {
        what: name.to_owned(),
        source,
    };
    let (before, started) = (resident_bytes(), Instant::now());
    let mut instances = (0..INSTANCES)
        .map(|_| prepared.instantiate().map_err(failed))
        .collect::<Result<Vec<_>, _>>()?;
    let made_ns = started.elapsed().as_nanos() as f64 / INSTANCES as f64;
    let frame = first(prepared);
    let mut linear = 0;
    for instance in &mut instances {
        let state = law::first_state(instance, LIMIT_NS)?;
        instance.step(&frame, &state, LIMIT_NS)?;
        linear = linear.max(instance.memory_bytes());
    }
    let taken = (resident_bytes() - before).max(0.0) / INSTANCES as f64;
    report.told(&format!("languages.{name}.instantiate"), made_ns / 1e3, "µs");
    report.told(&format!("languages.{name}.memory.linear"), linear as f64, "bytes");
    report.told(&format!("languages.{name}.memory.resident"), taken, "bytes");
    Ok(())
}

/// Resident memory of this process, in bytes; 0 where the system does not tell. Source: proc(5), `VmRSS` of
/// `/proc/[pid]/status`, in KiB.
fn resident_bytes() -> f64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line
        .and_then(|rest| rest.split_whitespace().next())
        .and_then(|word| word.parse::<f64>().ok());
    kib.unwrap_or(0.0) * 1024.0
}

/// Nanoseconds per step of the native law, through a pointer that the compiler cannot see through.
fn native_round(memory: &mut Memory, samples: &[Sample], steps: u64) -> f64 {
    let law: Law = black_box(Memory::step);
    let started = Instant::now();
    for s in samples
        .iter()
        .cycle()
        .take(usize::try_from(steps).unwrap_or(usize::MAX))
    {
        let s = black_box(s);
        black_box(law(memory, &TUNING, s.pv, s.setpoint, s.held, s.dt_s));
    }
    started.elapsed().as_nanos() as f64 / steps as f64
}

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let watch = Watch::start();
    let steps = options.count(20_000, 2_000);
    // Room for interpreters that give less back than they take: how much that is, is told.
    let limits = Limits {
        memory_bytes_max: MEMORY_BYTES_MAX,
        ..Limits::default()
    };
    let config = Config {
        limits,
        ..Config::default()
    };
    let engine = Engine::new(config).map_err(|source| Error::Engine {
        what: "its own configuration".to_owned(),
        source,
    })?;
    let mut sources = vec![("rust-pid", law::component_path("examples/rust-pid")?)];
    for example in xtask::languages::EXAMPLES {
        report.progress(&format!("building examples/{}", example.name));
        sources.push((example.name, example.build().map_err(Error::Example)?));
    }
    let mut sandboxed = Vec::new();
    for (name, path) in sources {
        report.progress(&format!("compiling {name}"));
        let bytes = std::fs::read(&path).map_err(Error::io(format!("{} cannot be read", path.display())))?;
        sandboxed.push(Sandboxed::new(&engine, name, &bytes, report)?);
    }
    for component in &mut sandboxed {
        let apart = component.apart()?;
        let figure = format!("languages.{}.outputs_apart", component.name);
        report.figure(&figure, apart, "%", Bound::AtMost(APART_MAX));
    }
    report.progress(&format!("{ROUNDS} rounds of {steps} steps of each language, in turns"));
    let samples: Vec<Sample> = sandboxed
        .first()
        .map(|one| one.frames.iter().map(sample).collect())
        .unwrap_or_default();
    let (mut native, mut memory) = (Vec::new(), Memory::new(HELD));
    for _ in 0..ROUNDS {
        native.push(native_round(&mut memory, &samples, steps));
        for component in &mut sandboxed {
            component.round(steps)?;
        }
    }
    let native = median(&native);
    report.told("languages.native", native, "ns");
    for component in &mut sandboxed {
        component.one_by_one(steps)?;
        let name = component.name;
        let each = median(&component.rounds_ns);
        report.told(&format!("languages.{name}.step"), each, "ns");
        for (part, text) in [(0.5, "p50"), (0.99, "p99")] {
            let ns = component.spread.us(part) * 1000.0;
            report.told(&format!("languages.{name}.step.{text}"), ns, "ns");
        }
        report.told(&format!("languages.{name}.times_native"), each / native, "×");
        let stepped = (ROUNDS as u64 + 1) * steps;
        let grown = component.instance.memory_bytes().saturating_sub(component.linear);
        let per_step = grown as f64 / stepped as f64;
        report.told(&format!("languages.{name}.memory.grown"), per_step, "bytes per step");
    }
    watch.finish().tell(report, "languages");
    Ok(())
}
