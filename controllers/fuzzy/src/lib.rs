//! The component `fuzzy`: glue between the SDK and the law (`law.rs`).
//!
//! docs/laws.md has the ports, parameters, rules and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{Demand, block};
use bumpless_sdk::prelude::*;
use law::{Memory, Sample, Tuning};

/// The ports.
pub const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "", "Measurement, in the unit of the setpoint").required(),
    PortSpec::analog_output("out", "", "To the actuator; its reading is what the actuator holds").required(),
    PortSpec::analog_input("track", "", "Value that the output follows while track-on is on"),
    PortSpec::digital_input("track-on", "Makes the output follow the track input"),
];
/// The parameters.
pub const PARAMETERS: &[ParameterSpec] = &[
    ParameterSpec::number("error-span", "pv", 20.0, 1e-9, 1e9, "Error that counts as big"),
    ParameterSpec::number(
        "rate-span",
        "pv/s",
        5.0,
        1e-9,
        1e9,
        "Rate of the error that counts as big",
    ),
    ParameterSpec::number(
        "out-span",
        "out",
        20.0,
        0.0,
        1e9,
        "What the rules add to the output at most",
    ),
    ParameterSpec::number("ti", "s", 60.0, 0.0, 1e6, "Integral time; 0 for no integral action"),
    ParameterSpec::number(
        "rate-filter",
        "s",
        1.0,
        0.0,
        1e5,
        "Time constant of the filter on the rate",
    ),
    ParameterSpec::choice(
        "action",
        &["reverse", "direct"],
        "reverse: a rising measurement lowers the output; direct: raises it",
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
];
/// Measurement.
pub const PV: Input = Input::of(PORTS, "pv");
/// To the actuator.
pub const OUT: Output = Output::of(PORTS, "out");
/// What the output follows.
pub const TRACK: Input = Input::of(PORTS, "track");
/// Is the output to follow it?
pub const TRACK_ON: Input = Input::of(PORTS, "track-on");

const fn row(name: &str) -> Parameter {
    Parameter::of(PARAMETERS, name)
}
const ERROR_SPAN: Parameter = row("error-span");
const RATE_SPAN: Parameter = row("rate-span");
const OUT_SPAN: Parameter = row("out-span");
const TI: Parameter = row("ti");
const RATE_FILTER: Parameter = row("rate-filter");
const ACTION: Parameter = row("action");
const OUT_LOW: Parameter = row("out-low");
const OUT_HIGH: Parameter = row("out-high");
const OUT_RATE: Parameter = row("out-rate");

/// The controller.
#[derive(Debug)]
pub struct Fuzzy;

fn tuning(p: &Parameters<'_>) -> Tuning {
    let sign = if p.choice(ACTION) == 1 { -1.0 } else { 1.0 };
    Tuning {
        error_span: sign * p.of(ERROR_SPAN),
        rate_span: p.of(RATE_SPAN),
        out_span: p.of(OUT_SPAN),
        ti_s: p.of(TI),
        rate_filter_s: p.of(RATE_FILTER),
        out_low: p.of(OUT_LOW),
        out_high: p.of(OUT_HIGH),
        out_rate_per_s: p.of(OUT_RATE),
    }
}

fn check(p: &Parameters<'_>) -> Result<(), Fault> {
    if p.of(OUT_LOW) < p.of(OUT_HIGH) {
        Ok(())
    } else {
        Err(Fault::bad_parameter("out-low must be less than out-high"))
    }
}

impl Controller for Fuzzy {
    const DESCRIPTION: Description = Description {
        name: "fuzzy",
        version: env!("CARGO_PKG_VERSION"),
        text: "Fuzzy PD with an integral, Mamdani rules",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = Memory;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Memory, Fault> {
        check(parameters)?;
        Ok(Memory::new(track.of(OUT)))
    }

    fn step(memory: &mut Memory, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = block::held(io, OUT);
        let demand = block::demand(memory.output, cycle, io, held, (TRACK, TRACK_ON));
        let Some(pv) = io.read_usable(PV) else {
            let Demand::Follow(value) = demand else {
                return Err(Fault::bad_input("pv has no usable value"));
            };
            *memory = Memory::new(value);
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
        if !(output.is_finite() && memory.is_sound()) {
            return Err(Fault::failed(
                "the output is not a finite number; check the spans against the range of pv",
            ));
        }
        io.write(OUT, output);
        Ok(())
    }

    fn retune(memory: &mut Memory, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        check(new)?;
        memory.retune(&tuning(old), &tuning(new));
        Ok(())
    }
}

bumpless_sdk::export!(Fuzzy);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use bumpless_sdk::bench::{Bench, bad};

    use super::*;

    fn run(bench: &mut Bench<Fuzzy>, y: &mut f64, setpoint: f64, seconds: u32) -> f64 {
        bench.set_setpoint(setpoint);
        let mut out = 0.0;
        for _ in 0..seconds * 10 {
            bench.set(PV, *y);
            out = bench.step(0.1).unwrap()[0];
            *y += (out - *y) * 0.1 / 10.0;
        }
        out
    }

    const TUNING: [(&str, f64); 4] = [
        ("ti", 10.0),
        ("error-span", 10.0),
        ("rate-span", 4.0),
        ("out-span", 20.0),
    ];

    #[test]
    fn it_starts_settles_and_does_not_wind_up() {
        let mut bench = Bench::<Fuzzy>::start(&TUNING, &[40.0]).unwrap();
        let mut y = 40.0;
        bench.set(PV, y);
        bench.set_setpoint(50.0);
        assert_eq!(bench.step(0.1).unwrap(), [40.0]);
        run(&mut bench, &mut y, 60.0, 150);
        assert!((y - 60.0).abs() < 0.01, "{y}");
        assert_eq!(run(&mut bench, &mut y, 130.0, 600), 100.0);
        assert!(run(&mut bench, &mut y, 60.0, 2) < 90.0, "back at once");
    }

    #[test]
    fn hands_new_spans_and_bad_inputs_do_not_bump() {
        let mut bench = Bench::<Fuzzy>::start(&TUNING, &[40.0]).unwrap();
        let mut y = 40.0;
        run(&mut bench, &mut y, 47.0, 5);
        let before = bench.wanted()[0];
        bench
            .retune(&[("out-span", 90.0), ("error-span", 3.0), ("ti", 5.0)])
            .unwrap();
        let after = bench.step(1e-9).unwrap()[0];
        assert!((after - before).abs() < 1e-3, "{before} and {after}");
        bench.set_reading(PV, Some(bad(1.0)));
        assert!(matches!(bench.step(0.1), Err(Fault::BadInput(_))));
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 5.0);
        assert_eq!(bench.step(0.1).unwrap(), [5.0]);
        bench.set_mode(Mode::Automatic);
        bench.set(PV, 20.0);
        assert_eq!(bench.step(0.1).unwrap(), [5.0]);
        bench.set(TRACK, 77.0);
        bench.set(TRACK_ON, 1.0);
        assert_eq!(bench.step(0.1).unwrap(), [77.0]);
        let error = Bench::<Fuzzy>::start(&[("out-low", 100.0)], &[0.0]).unwrap_err();
        assert!(matches!(error, Fault::BadParameter(text) if text.contains("out-low")));
    }
}
