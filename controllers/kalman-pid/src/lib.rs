//! The component `kalman-pid`: glue between the SDK, the filter (`law.rs`) and the ISA block behind it.
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{
    Memory, Tuning,
    block::{self, Intake},
    table::{self, OUT},
};
use bumpless_sdk::prelude::*;
use law::{Filter, Model};
use serde::{Deserialize, Serialize};

/// The ports: those of the ISA block, and what the filter knows.
pub const PORTS: &[PortSpec] = &joined::<_, { table::PORTS.len() + 2 }>(
    table::PORTS,
    &[
        PortSpec::analog_output("estimate", "", "The measurement without its noise, to be seen"),
        PortSpec::analog_output("load", "", "The load, as the measurement that it leads to, to be seen"),
    ],
);
/// The parameters: those of the ISA block, then the model.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, { table::PARAMETERS.len() + 6 }>(
    table::PARAMETERS,
    &[
        ParameterSpec::number(
            "model-gain",
            "pv/out",
            1.0,
            -1e6,
            1e6,
            "Gain of the process, with its sign",
        ),
        ParameterSpec::number("model-lag", "s", 10.0, 1e-3, 1e6, "Time constant of the process"),
        ParameterSpec::number("model-delay", "s", 0.0, 0.0, 1e5, "Dead time of the process"),
        ParameterSpec::number(
            "noise",
            "pv",
            1.0,
            1e-9,
            1e9,
            "Standard deviation of the measurement's noise",
        ),
        ParameterSpec::number(
            "unrest",
            "pv",
            0.01,
            0.0,
            1e9,
            "Standard deviation that the process gains by itself in 1 s",
        ),
        ParameterSpec::number(
            "drift",
            "pv",
            0.1,
            0.0,
            1e9,
            "Standard deviation that the load gains in 1 s",
        ),
    ],
);
/// The estimate.
pub const ESTIMATE: Output = Output::of(PORTS, "estimate");
/// The load.
pub const LOAD: Output = Output::of(PORTS, "load");
const MODEL_GAIN: Parameter = Parameter::of(PARAMETERS, "model-gain");
const MODEL_LAG: Parameter = Parameter::of(PARAMETERS, "model-lag");
const MODEL_DELAY: Parameter = Parameter::of(PARAMETERS, "model-delay");
const NOISE: Parameter = Parameter::of(PARAMETERS, "noise");
const UNREST: Parameter = Parameter::of(PARAMETERS, "unrest");
const DRIFT: Parameter = Parameter::of(PARAMETERS, "drift");

/// The controller.
#[derive(Debug)]
pub struct KalmanPid;

/// The state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    pid: Memory,
    filter: Filter,
}

fn model(p: &Parameters<'_>) -> Model {
    Model {
        gain: p.of(MODEL_GAIN),
        lag_s: p.of(MODEL_LAG),
        delay_s: p.of(MODEL_DELAY),
        noise: p.of(NOISE),
        unrest: p.of(UNREST),
        drift: p.of(DRIFT),
    }
}

impl Controller for KalmanPid {
    const DESCRIPTION: Description = Description {
        name: "kalman-pid",
        version: env!("CARGO_PKG_VERSION"),
        text: "PID on the estimate of a Kalman filter, for noisy measurements",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = State;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<State, Fault> {
        Ok(State {
            pid: block::start(parameters, track)?,
            filter: Filter::default(),
        })
    }

    fn step(state: &mut State, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = block::held(io, OUT);
        let actuator = held.unwrap_or(state.pid.output);
        let output = match block::take(&mut state.pid, parameters, cycle, io, held, block::always)? {
            Intake::Blind(value) => {
                state.filter.forget();
                value
            }
            Intake::Seen(mut sample, fresh) => {
                let (measured, m) = (sample.pv, model(parameters));
                let estimate = state.filter.step(&m, actuator, measured, fresh, cycle.dt_s());
                if !estimate.is_sound() {
                    return Err(Fault::failed(
                        "the estimate is not a finite number; check the model against the range of pv",
                    ));
                }
                sample.pv = estimate.x;
                io.write(ESTIMATE, estimate.x);
                io.write(LOAD, estimate.d);
                let tuning = Tuning::of(parameters);
                block::conclude(&mut state.pid, &tuning, parameters, &sample, measured, io)?
            }
        };
        io.write(OUT, output);
        Ok(())
    }

    fn retune(state: &mut State, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        block::retune(&mut state.pid, old, new)?;
        state.filter.retune(&model(old), &model(new));
        Ok(())
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<State>, Fault> {
        let adopted = block::adopt(from, parameters)?;
        Ok(adopted.map(|pid| State {
            pid,
            filter: Filter::default(),
        }))
    }
}

bumpless_sdk::export!(KalmanPid);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use bumpless_isa::table::PV;
    use bumpless_sdk::bench::Bench;

    use super::*;

    /// Total variation of the output on a noisy loop at rest, and where the process ends.
    fn variation(given: &[(&str, f64)]) -> (f64, f64) {
        let mut bench = Bench::<KalmanPid>::start(given, &[25.0]).unwrap();
        bench.set_setpoint(50.0);
        let (mut y, mut last, mut sum) = (50.0, 25.0, 0.0);
        for i in 0..2000u32 {
            let noise = 2.0 * (f64::from(i) * 0.618_033_988_749_895).fract() - 1.0;
            bench.set(PV, y + noise);
            let out = bench.step(0.1).unwrap()[0];
            sum += (out - last).abs();
            last = out;
            y += (2.0 * out - y) * (1.0 - (-0.1f64 / 10.0).exp());
        }
        (sum, y)
    }

    #[test]
    fn noise_hardly_reaches_the_actuator() {
        let given = |noise| {
            [
                ("k", 2.0),
                ("ti", 8.0),
                ("model-gain", 2.0),
                ("noise", noise),
                ("unrest", 0.02),
            ]
        };
        // A filter that is told of no noise believes each measurement: that is a plain PID.
        let (plain, _) = variation(&given(1e-6));
        let (filtered, y) = variation(&given(0.6));
        assert!(filtered < 0.1 * plain, "{filtered} and {plain}");
        assert!((y - 50.0).abs() < 0.5, "{y}");
    }

    #[test]
    fn it_starts_follows_and_retunes_without_a_bump() {
        let mut bench = Bench::<KalmanPid>::start(&[("k", 2.0)], &[40.0]).unwrap();
        bench.set_setpoint(55.0);
        bench.set(PV, 50.0);
        assert_eq!(bench.step(0.1).unwrap(), [40.0]);
        let before = (0..30).fold(0.0, |_, _| bench.step(0.1).unwrap()[0]);
        bench
            .retune(&[("k", 3.0), ("model-gain", 0.5), ("model-delay", 2.0)])
            .unwrap();
        let after = bench.step(1e-6).unwrap()[0];
        assert!((after - before).abs() < 1e-2, "{before} and {after}");
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 70.0);
        assert_eq!(bench.step(0.1).unwrap(), [70.0]);
        bench.set_mode(Mode::Automatic);
        assert_eq!(bench.step(0.1).unwrap(), [70.0]);
        assert!(bench.written(ESTIMATE).is_some());
    }
}
