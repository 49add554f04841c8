//! The component `mpc`: glue between the SDK, the law (`law.rs`) and its solver (`qp.rs`).
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;
pub mod qp;

use bumpless_isa::{Demand, block};
use bumpless_sdk::prelude::*;
use law::{HORIZON_MAX, MOVES_MAX, Memory, Sample, Tuning};

/// The ports.
pub const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "", "Measurement, in the unit of the setpoint").required(),
    PortSpec::analog_output("out", "", "To the actuator; its reading is what the actuator holds").required(),
    PortSpec::analog_input("track", "", "Value that the output follows while track-on is on"),
    PortSpec::digital_input("track-on", "Makes the output follow the track input"),
    PortSpec::analog_output("load", "", "What the measurement is more than the model, to be seen"),
];
/// The parameters.
pub const PARAMETERS: &[ParameterSpec] = &[
    ParameterSpec::number("gain", "pv/out", 1.0, -1e6, 1e6, "Gain of the process, with its sign"),
    ParameterSpec::number("lag", "s", 10.0, 0.0, 1e6, "Time constant of the process"),
    ParameterSpec::number("delay", "s", 2.0, 0.0, 1e5, "Dead time of the process"),
    ParameterSpec::number("interval", "s", 1.0, 1e-3, 1e5, "Time between two plans"),
    ParameterSpec::number(
        "horizon",
        "",
        30.0,
        2.0,
        HORIZON_MAX as f64,
        "How many intervals are predicted; they should reach beyond dead time and lag",
    ),
    ParameterSpec::number("moves", "", 5.0, 1.0, MOVES_MAX as f64, "How many moves are planned"),
    ParameterSpec::number(
        "move-weight",
        "",
        0.1,
        1e-6,
        1e6,
        "What a move costs; greater is calmer and more robust",
    ),
    ParameterSpec::number(
        "reference-time",
        "s",
        0.0,
        0.0,
        1e6,
        "Time constant with which the setpoint is to be approached",
    ),
    ParameterSpec::number(
        "load-filter",
        "s",
        0.0,
        0.0,
        1e5,
        "Time constant of the filter on what the model does not explain",
    ),
    ParameterSpec::number("out-low", "out", 0.0, -1e9, 1e9, "Least output"),
    ParameterSpec::number("out-high", "out", 100.0, -1e9, 1e9, "Greatest output"),
    ParameterSpec::number(
        "out-rate",
        "out/s",
        0.0,
        0.0,
        1e9,
        "Greatest change of the output per second; 0 for no limit",
    ),
    ParameterSpec::number(
        "pv-low",
        "pv",
        -1e9,
        -1e9,
        1e9,
        "Least measurement, kept as well as can be; -1e9 for none",
    ),
    ParameterSpec::number(
        "pv-high",
        "pv",
        1e9,
        -1e9,
        1e9,
        "Greatest measurement, kept as well as can be; 1e9 for none",
    ),
];
/// Measurement.
pub const PV: Input = Input::of(PORTS, "pv");
/// To the actuator.
pub const OUT: Output = Output::of(PORTS, "out");
/// What the output follows.
pub const TRACK: Input = Input::of(PORTS, "track");
/// Is the output to follow it?
pub const TRACK_ON: Input = Input::of(PORTS, "track-on");
/// What the model does not explain.
pub const LOAD: Output = Output::of(PORTS, "load");

const fn row(name: &str) -> Parameter {
    Parameter::of(PARAMETERS, name)
}
const GAIN: Parameter = row("gain");
const LAG: Parameter = row("lag");
const DELAY: Parameter = row("delay");
const INTERVAL: Parameter = row("interval");
const HORIZON: Parameter = row("horizon");
const MOVES: Parameter = row("moves");
const MOVE_WEIGHT: Parameter = row("move-weight");
const REFERENCE_TIME: Parameter = row("reference-time");
const LOAD_FILTER: Parameter = row("load-filter");
const OUT_LOW: Parameter = row("out-low");
const OUT_HIGH: Parameter = row("out-high");
const OUT_RATE: Parameter = row("out-rate");
const PV_LOW: Parameter = row("pv-low");
const PV_HIGH: Parameter = row("pv-high");

/// The controller.
#[derive(Debug)]
pub struct Mpc;

fn tuning(p: &Parameters<'_>) -> Tuning {
    Tuning {
        gain: p.of(GAIN),
        lag_s: p.of(LAG),
        delay_s: p.of(DELAY),
        interval_s: p.of(INTERVAL),
        horizon: p.choice(HORIZON),
        moves: p.choice(MOVES),
        move_weight: p.of(MOVE_WEIGHT),
        reference_s: p.of(REFERENCE_TIME),
        filter_s: p.of(LOAD_FILTER),
        out_low: p.of(OUT_LOW),
        out_high: p.of(OUT_HIGH),
        out_rate_per_s: p.of(OUT_RATE),
        pv_low: p.of(PV_LOW),
        pv_high: p.of(PV_HIGH),
    }
}

fn check(t: &Tuning) -> Result<(), Fault> {
    if t.gain == 0.0 {
        return Err(Fault::bad_parameter("gain must not be 0: no move would do anything"));
    }
    if t.out_low >= t.out_high {
        return Err(Fault::bad_parameter("out-low must be less than out-high"));
    }
    if t.pv_low >= t.pv_high {
        return Err(Fault::bad_parameter("pv-low must be less than pv-high"));
    }
    if t.delay_s >= t.horizon as f64 * t.interval_s {
        return Err(Fault::bad_parameter(
            "horizon · interval must be longer than delay: no move would be seen",
        ));
    }
    Ok(())
}

impl Controller for Mpc {
    const DESCRIPTION: Description = Description {
        name: "mpc",
        version: env!("CARGO_PKG_VERSION"),
        text: "Linear model predictive control with constraints",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = Memory;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Memory, Fault> {
        let t = tuning(parameters);
        check(&t)?;
        Ok(Memory::new(&t, track.of(OUT)))
    }

    fn step(memory: &mut Memory, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = block::held(io, OUT);
        let demand = block::demand(memory.output, cycle, io, held, (TRACK, TRACK_ON));
        let Some(pv) = io.read_usable(PV) else {
            let Demand::Follow(value) = demand else {
                return Err(Fault::bad_input("pv has no usable value"));
            };
            memory.follow_blind(value);
            io.write(OUT, value);
            return Ok(());
        };
        if !cycle.setpoint.is_finite() {
            return Err(Fault::bad_input("the setpoint is not a finite number"));
        }
        let sample = Sample {
            pv: pv.value,
            setpoint: cycle.setpoint,
            held: held.unwrap_or(memory.output),
            demand,
            dt_s: cycle.dt_s(),
        };
        let output = memory.step(&tuning(parameters), &sample);
        let Some(output) = output.filter(|output| output.is_finite() && memory.is_sound()) else {
            return Err(Fault::failed(
                "the plan has no finite solution; check the model and the limits against the ranges of pv and out",
            ));
        };
        io.write(OUT, output);
        io.write(LOAD, memory.load);
        Ok(())
    }

    fn retune(memory: &mut Memory, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        let (old, new) = (tuning(old), tuning(new));
        check(&new)?;
        memory.retune(&old, &new);
        Ok(())
    }
}

bumpless_sdk::export!(Mpc);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use std::collections::VecDeque;

    use bumpless_sdk::bench::Bench;

    use super::*;

    const DT_S: f64 = 0.2;

    /// A lag of 10 s behind a dead time of 2 s; gain 1; a load at its input.
    struct Process {
        y: f64,
        under_way: VecDeque<f64>,
    }

    impl Process {
        fn resting(value: f64) -> Self {
            Self {
                y: value,
                under_way: vec![value; 10].into(),
            }
        }

        fn advance(&mut self, input: f64, load: f64) {
            self.under_way.push_back(input);
            let u = self.under_way.pop_front().unwrap();
            self.y += (u + load - self.y) * (1.0 - (-DT_S / 10.0f64).exp());
        }
    }

    /// Runs; gives the outputs and the greatest measurement.
    fn run(bench: &mut Bench<Mpc>, process: &mut Process, setpoint: f64, load: f64, seconds: u32) -> (Vec<f64>, f64) {
        let (mut outputs, mut peak) = (Vec::new(), f64::MIN);
        bench.set_setpoint(setpoint);
        for _ in 0..seconds * 5 {
            bench.set(PV, process.y);
            let out = bench.step(DT_S).unwrap()[0];
            outputs.push(out);
            process.advance(out, load);
            peak = peak.max(process.y);
        }
        (outputs, peak)
    }

    #[test]
    fn it_starts_from_the_actuator_and_settles_without_an_error() {
        let mut bench = Bench::<Mpc>::start(&[], &[20.0]).unwrap();
        let mut process = Process::resting(20.0);
        bench.set(PV, 20.0);
        bench.set_setpoint(50.0);
        assert_eq!(bench.step(DT_S).unwrap(), [20.0]);
        let (_, peak) = run(&mut bench, &mut process, 50.0, 0.0, 60);
        assert!((process.y - 50.0).abs() < 1e-3 && peak < 51.0, "{} {peak}", process.y);
        run(&mut bench, &mut process, 50.0, 10.0, 120);
        assert!((process.y - 50.0).abs() < 0.01, "a load is found: {}", process.y);
        let (outputs, _) = run(&mut bench, &mut process, 500.0, 10.0, 300);
        assert!(outputs.last().is_some_and(|out| (out - 100.0).abs() < 1e-6));
        let (outputs, _) = run(&mut bench, &mut process, 60.0, 10.0, 2);
        assert!(outputs.last().is_some_and(|out| *out < 60.0), "no windup: {outputs:?}");
    }

    #[test]
    fn rates_and_limits_of_the_measurement_are_kept() {
        let given = [("out-rate", 3.0), ("pv-high", 50.5), ("move-weight", 0.001)];
        let mut bench = Bench::<Mpc>::start(&given, &[20.0]).unwrap();
        let mut process = Process::resting(20.0);
        run(&mut bench, &mut process, 20.0, 0.0, 1);
        let (outputs, _) = run(&mut bench, &mut process, 50.0, 0.0, 60);
        let steps = outputs.windows(2).map(|pair| (pair[1] - pair[0]).abs());
        assert!(steps.fold(0.0, f64::max) < 3.0 + 1e-6, "3 per second and plan");
        let (_, peak) = run(&mut bench, &mut process, 70.0, 0.0, 120);
        assert!(peak < 50.6 && process.y > 50.3, "the soft limit holds: {peak}");
    }

    #[test]
    fn hands_and_other_models_do_not_bump() {
        let mut bench = Bench::<Mpc>::start(&[], &[20.0]).unwrap();
        let mut process = Process::resting(20.0);
        let (outputs, _) = run(&mut bench, &mut process, 40.0, 0.0, 4);
        let before = *outputs.last().unwrap();
        bench.retune(&[("gain", 2.0), ("lag", 5.0), ("delay", 4.0)]).unwrap();
        let after = bench.step(1e-3).unwrap()[0];
        assert_eq!(after, before, "until the next plan");
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 66.0);
        assert_eq!(bench.step(DT_S).unwrap(), [66.0]);
        bench.set_mode(Mode::Automatic);
        assert_eq!(bench.step(DT_S).unwrap(), [66.0]);
        for (given, part) in [
            (vec![("gain", 0.0)], "gain"),
            (vec![("delay", 30.0)], "horizon"),
            (vec![("pv-low", 5.0), ("pv-high", 5.0)], "pv-low"),
            (vec![("out-low", 100.0)], "out-low"),
        ] {
            let error = Bench::<Mpc>::start(&given, &[0.0]).unwrap_err();
            assert!(
                matches!(&error, Fault::BadParameter(text) if text.contains(part)),
                "{error:?}"
            );
        }
    }
}
