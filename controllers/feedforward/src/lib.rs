//! The component `feedforward`: glue between the SDK, the ISA block and the way of the disturbance (`law.rs`).
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{
    Memory, Tuning,
    block::{self, Intake},
    table::{self, FF, OUT},
};
use bumpless_sdk::prelude::*;
use law::{Dynamics, Path};
use serde::{Deserialize, Serialize};

/// The parameters: those of the ISA block, then the way of the disturbance.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, { table::PARAMETERS.len() + 3 }>(
    table::PARAMETERS,
    &[
        ParameterSpec::number(
            "ff-lead",
            "s",
            0.0,
            0.0,
            1e6,
            "Time constant of the lead of the feedforward",
        ),
        ParameterSpec::number(
            "ff-lag",
            "s",
            0.0,
            0.0,
            1e6,
            "Time constant of the lag of the feedforward",
        ),
        ParameterSpec::number("ff-delay", "s", 0.0, 0.0, 1e5, "Dead time of the feedforward"),
    ],
);
const FF_LEAD: Parameter = Parameter::of(PARAMETERS, "ff-lead");
const FF_LAG: Parameter = Parameter::of(PARAMETERS, "ff-lag");
const FF_DELAY: Parameter = Parameter::of(PARAMETERS, "ff-delay");

/// The controller.
#[derive(Debug)]
pub struct Feedforward;

/// The state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    pid: Memory,
    path: Path,
}

fn dynamics(p: &Parameters<'_>) -> Dynamics {
    Dynamics {
        lead_s: p.of(FF_LEAD),
        lag_s: p.of(FF_LAG),
        delay_s: p.of(FF_DELAY),
    }
}

fn check(p: &Parameters<'_>) -> Result<(), Fault> {
    if p.of(FF_LEAD) > 0.0 && p.of(FF_LAG) <= 0.0 {
        return Err(Fault::bad_parameter(
            "ff-lag must be greater than 0 where ff-lead is: a lead alone is an impulse",
        ));
    }
    Ok(())
}

impl Controller for Feedforward {
    const DESCRIPTION: Description = Description {
        name: "feedforward",
        version: env!("CARGO_PKG_VERSION"),
        text: "PID with a dynamic feedforward of a measured disturbance",
        ports: table::PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = State;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<State, Fault> {
        check(parameters)?;
        Ok(State {
            pid: block::start(parameters, track)?,
            path: Path::default(),
        })
    }

    fn step(state: &mut State, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let disturbance = io.read_usable(FF).map(|r| r.value);
        let added = state.path.step(&dynamics(parameters), disturbance, cycle.dt_s());
        let held = block::held(io, OUT);
        let output = match block::take(&mut state.pid, parameters, cycle, io, held, block::always)? {
            Intake::Blind(value) => value,
            Intake::Seen(mut sample, _) => {
                sample.feedforward = added;
                let tuning = Tuning::of(parameters);
                block::conclude(&mut state.pid, &tuning, parameters, &sample, sample.pv, io)?
            }
        };
        io.write(OUT, output);
        Ok(())
    }

    fn retune(state: &mut State, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        check(new)?;
        // What the new way would have added is what the last step is told to have had: the integral takes the difference.
        block::retune(&mut state.pid, old, new)?;
        let now = dynamics(new);
        state.path.retune(&now);
        let (before, after) = (state.pid.feedforward, state.path.output(&now));
        state.pid.feedforward = after;
        state.pid.integral += Tuning::of(new).ff_gain * (before - after);
        Ok(())
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<State>, Fault> {
        check(parameters)?;
        let adopted = block::adopt(from, parameters)?;
        Ok(adopted.map(|pid| State {
            pid,
            path: Path::default(),
        }))
    }
}

bumpless_sdk::export!(Feedforward);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use bumpless_isa::table::PV;
    use bumpless_sdk::bench::{Bench, bad};

    use super::*;

    fn start(given: &[(&str, f64)]) -> Bench<Feedforward> {
        let mut bench = Bench::start(given, &[40.0]).unwrap();
        bench.set_setpoint(50.0);
        bench.set(PV, 50.0);
        bench.set(FF, 10.0);
        assert_eq!(bench.step(0.1).unwrap(), [40.0]);
        bench
    }

    #[test]
    fn an_ideal_feedforward_takes_a_disturbance_away() {
        // Process e^-2s/(5s+1), disturbance 0.5·e^-3s/(2s+1): gain −0.5, lead 5, lag 2, delay 1.
        let given = [
            ("k", 1.0),
            ("ti", 5.0),
            ("ff-gain", -0.5),
            ("ff-lead", 5.0),
            ("ff-lag", 2.0),
            ("ff-delay", 1.0),
            ("out-low", -1000.0),
        ];
        let mut bench = start(&given);
        let (mut y, mut yd) = (0.0, 0.0);
        let mut worst: f64 = 0.0;
        let mut inputs = vec![40.0; 20];
        let mut loads = vec![10.0; 30];
        for i in 0..600 {
            let load = if i < 5 { 10.0 } else { 30.0 };
            bench.set(FF, load);
            bench.set(PV, 50.0 + y + yd);
            inputs.push(bench.step(0.1).unwrap()[0]);
            loads.push(load);
            y += (inputs[i] - 40.0 - y) * (1.0 - (-0.1f64 / 5.0).exp());
            yd += (0.5 * (loads[i] - 10.0) - yd) * (1.0 - (-0.1f64 / 2.0).exp());
            worst = worst.max((y + yd).abs());
        }
        // What is left is the actuator's hold between two steps, of which there are twenty in the shorter lag.
        assert!(worst < 0.1, "without it the error would be 10: {worst}");
    }

    #[test]
    fn a_change_of_its_dynamics_and_a_failing_disturbance_do_not_bump() {
        let mut bench = start(&[("ff-lead", 5.0), ("ff-lag", 2.0)]);
        bench.set(FF, 20.0);
        let before = bench.step(0.1).unwrap()[0];
        assert!((before - 65.0).abs() < 1e-9);
        bench
            .retune(&[("ff-gain", -3.0), ("ff-lag", 9.0), ("ff-delay", 4.0)])
            .unwrap();
        let after = bench.step(1e-6).unwrap()[0];
        assert!((after - before).abs() < 1e-3, "{before} and {after}");
        bench.set_reading(FF, Some(bad(0.0)));
        let next = bench.step(1e-6).unwrap()[0];
        assert!((next - before).abs() < 1e-3);
        let refused = Bench::<Feedforward>::start(&[("ff-lead", 1.0)], &[0.0]).unwrap_err();
        assert!(matches!(refused, Fault::BadParameter(text) if text.contains("ff-lag")));
    }
}
