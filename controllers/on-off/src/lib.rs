//! The component `on-off`: glue between the SDK and the law (`law.rs`).
//!
//! README.md has the ports, parameters and rules. Never: arithmetic.

pub mod law;

use bumpless_sdk::prelude::*;
use law::{Memory, Tuning};

/// The ports.
pub const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "", "Measurement, in the unit of the setpoint").required(),
    PortSpec::analog_output("out", "", "To the actuator").required(),
];

/// Measurement.
pub const PV: Input = Input::of(PORTS, "pv");
/// To the actuator.
pub const OUT: Output = Output::of(PORTS, "out");

/// The parameters.
pub const PARAMETERS: &[ParameterSpec] = &[
    ParameterSpec::number(
        "hysteresis",
        "pv",
        1.0,
        0.0,
        1e9,
        "Whole width of the band around the setpoint",
    ),
    ParameterSpec::number("on-value", "out", 100.0, -1e9, 1e9, "Output when on"),
    ParameterSpec::number("off-value", "out", 0.0, -1e9, 1e9, "Output when off"),
    ParameterSpec::choice(
        "action",
        &["reverse", "direct"],
        "reverse: a low measurement switches on; direct: a high one does",
    ),
    ParameterSpec::number("on-min", "s", 0.0, 0.0, 1e6, "Shortest time on"),
    ParameterSpec::number("off-min", "s", 0.0, 0.0, 1e6, "Shortest time off"),
];

const HYSTERESIS: Parameter = Parameter::of(PARAMETERS, "hysteresis");
const ON_VALUE: Parameter = Parameter::of(PARAMETERS, "on-value");
const OFF_VALUE: Parameter = Parameter::of(PARAMETERS, "off-value");
const ACTION: Parameter = Parameter::of(PARAMETERS, "action");
const ON_MIN: Parameter = Parameter::of(PARAMETERS, "on-min");
const OFF_MIN: Parameter = Parameter::of(PARAMETERS, "off-min");

/// The controller.
#[derive(Debug)]
pub struct OnOff;

fn tuning(p: &Parameters<'_>) -> Tuning {
    Tuning {
        hysteresis: p.of(HYSTERESIS),
        on_value: p.of(ON_VALUE),
        off_value: p.of(OFF_VALUE),
        direct: p.choice(ACTION) == 1,
        on_min_s: p.of(ON_MIN),
        off_min_s: p.of(OFF_MIN),
    }
}

impl Controller for OnOff {
    const DESCRIPTION: Description = Description {
        name: "on-off",
        version: env!("CARGO_PKG_VERSION"),
        text: "Two-position controller with hysteresis and minimum times",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = Memory;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Memory, Fault> {
        Ok(Memory::new(&tuning(parameters), track.of(OUT)))
    }

    fn step(memory: &mut Memory, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let t = tuning(parameters);
        if matches!(cycle.mode, Mode::Manual) {
            let held = Some(io.held(OUT))
                .filter(Reading::is_usable)
                .map_or(t.value(memory.on), |r| r.value);
            memory.follow(&t, held, cycle.dt_s());
            io.write(OUT, held);
            return Ok(());
        }
        let pv = io
            .read_usable(PV)
            .ok_or_else(|| Fault::bad_input("pv has no usable value"))?;
        io.write(OUT, memory.step(&t, pv.value, cycle.setpoint, cycle.dt_s()));
        Ok(())
    }
}

bumpless_sdk::export!(OnOff);
bumpless_sdk::state_form!("on: bool", "since-s: f64", "settled: bool");

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "tests")]

    use bumpless_sdk::bench::{Bench, bad};
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn runs_on_the_bench_in_both_modes() {
        let mut bench = Bench::<OnOff>::start(&[("hysteresis", 4.0)], &[0.0]).expect("starts");
        bench.set_setpoint(50.0);
        bench.set(PV, 40.0);
        assert_eq!(bench.step(1.0).expect("holds"), [0.0]);
        assert_eq!(bench.step(1.0).expect("switches"), [100.0]);
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 30.0);
        assert_eq!(bench.step(1.0).expect("follows"), [30.0]);
        bench.set_mode(Mode::Automatic);
        assert_eq!(bench.step(1.0).expect("nearer position"), [0.0]);
        bench.set_reading(PV, Some(bad(40.0)));
        assert!(matches!(bench.step(1.0), Err(Fault::BadInput(_))));
    }

    proptest! {
        #[test]
        fn the_output_is_one_of_two(
            pvs in prop::collection::vec(-1e6..1e6f64, 1..60),
            on_value in -100.0..100.0f64,
            off_value in -100.0..100.0f64,
            track in -200.0..200.0f64,
            on_min in 0.0..10.0f64,
        ) {
            let given = [("on-value", on_value), ("off-value", off_value), ("on-min", on_min)];
            let mut bench = Bench::<OnOff>::start(&given, &[track]).expect("starts");
            for pv in pvs {
                bench.set(PV, pv);
                let out = bench.step(0.7).expect("steps")[0];
                prop_assert!(out == on_value || out == off_value);
            }
        }
    }
}
