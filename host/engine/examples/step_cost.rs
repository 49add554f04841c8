//! What a component costs on this machine: compile, load, instantiate, step; memory and memory maps of an instance.
//!
//! Run by hand: `cargo run -p bumpless-engine --example step_cost -- COMPONENT.wasm [STEPS] [INSTANCES] [MEMORY_MIB]`.
//! Only a release build's figures mean anything; compare figures of one run, for machines are noisy.
#![allow(clippy::print_stdout, reason = "a program for people")]

use std::{path::Path, process::ExitCode, time::Instant};

use bumpless_core::{Cycle, Direction, Frame, Mode, Reading};
use bumpless_engine::{Config, Engine, Limits};

/// Longest call, in ns: this program measures and does not judge.
const LIMIT_NS: u64 = 1_000_000_000;

fn main() -> ExitCode {
    let mut args = std::env::args().skip(1);
    let Some(path) = args.next() else {
        println!("usage: step_cost COMPONENT.wasm [STEPS] [INSTANCES] [MEMORY_MIB]");
        return ExitCode::FAILURE;
    };
    let mut number = |default| args.next().and_then(|text| text.parse().ok()).unwrap_or(default);
    match measure(path.as_ref(), number(100_000), number(1000), number(16)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            println!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(path: &Path, steps: usize, instances: usize, memory_mib: usize) -> Result<(), Box<dyn std::error::Error>> {
    let bytes = std::fs::read(path)?;
    let instances_max = u32::try_from(instances)?.max(2);
    let engine = Engine::new(Config {
        instances_max,
        limits: Limits {
            memory_bytes_max: memory_mib * 1024 * 1024,
            ..Limits::default()
        },
        ..Config::default()
    })?;
    let found = engine.inspect(&bytes)?;
    let descriptor = &found.descriptor;
    println!(
        "{} {}, {} bytes, profile {}",
        descriptor.name,
        descriptor.version,
        found.bytes,
        engine.profile().name()
    );
    println!("compile          {:>12?}", found.compile_time.unwrap_or_default());
    let law = engine.prepare(&bytes)?;

    let readings = descriptor.ports.iter().map(|port| match port.direction {
        Direction::Input => Reading::good(0.0, 0),
        Direction::Output => Reading::good(50.0, 0),
    });
    let mut frame = Frame {
        cycle: Cycle {
            seq: 0,
            at_ns: 0,
            dt_ns: 1_000_000,
            mode: Mode::Automatic,
            setpoint: 50.0,
        },
        readings: readings.collect(),
        messages: vec![],
    };
    let parameters = descriptor.parameter_values([])?;
    let track = vec![50.0; descriptor.outputs().count()];

    let mut one = law.instantiate()?;
    let mut state = one.start(&parameters, &track, LIMIT_NS)?;
    let mut times = Vec::with_capacity(steps);
    for i in 0..steps {
        frame.cycle.seq += 1;
        frame.cycle.at_ns += frame.cycle.dt_ns;
        for reading in &mut frame.readings {
            *reading = Reading::good(50.0 + f64::from(u32::try_from(i % 100)?) / 100.0, frame.cycle.at_ns);
        }
        let started = Instant::now();
        let effects = one.step(&frame, &state, LIMIT_NS)?;
        times.push(started.elapsed().as_nanos());
        state = effects.state;
    }
    println!("first step       {:>9} ns", times.first().copied().unwrap_or_default());
    times.sort_unstable();
    let part = |permille: usize| times.get(times.len() * permille / 1000).copied().unwrap_or_default();
    println!("step, p50        {:>9} ns", part(500));
    println!("step, p99        {:>9} ns", part(990));
    println!("step, p99.9      {:>9} ns   (state {} bytes)", part(999), state.len());
    drop(one);

    let started = Instant::now();
    for _ in 0..1000 {
        drop(law.instantiate()?);
    }
    println!("make and drop    {:>9} ns", started.elapsed().as_nanos() / 1000);

    let (resident, maps) = (resident_bytes()?, maps()?);
    let mut all = Vec::with_capacity(instances);
    for _ in 0..instances {
        let mut one = law.instantiate()?;
        one.step(&frame, &state, LIMIT_NS)?;
        all.push(one);
    }
    let each = |now: usize, before: usize| now.saturating_sub(before) as f64 / instances as f64;
    println!(
        "memory           {:>9.0} bytes per instance ({instances} of them)",
        each(resident_bytes()?, resident)
    );
    println!(
        "memory maps      {:>9.2} per instance, {} in all",
        each(self::maps()?, maps),
        self::maps()?
    );
    let started = Instant::now();
    for one in &mut all {
        one.step(&frame, &state, LIMIT_NS)?;
    }
    println!(
        "step, each cold  {:>9} ns",
        started.elapsed().as_nanos() / instances as u128
    );
    Ok(())
}

fn resident_bytes() -> Result<usize, Box<dyn std::error::Error>> {
    let text = std::fs::read_to_string("/proc/self/statm")?;
    Ok(text
        .split(' ')
        .nth(1)
        .ok_or("statm has no second field")?
        .parse::<usize>()?
        * 4096)
}

fn maps() -> Result<usize, std::io::Error> {
    Ok(std::fs::read_to_string("/proc/self/maps")?.lines().count())
}
