//! The component `lead-lag`: glue between the SDK, the station and the law (`law.rs`).
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{
    Demand,
    station::{self, Handles, Station},
};
use bumpless_sdk::prelude::*;
use law::{Memory, Tuning};
use serde::{Deserialize, Serialize};

/// The ports.
pub const PORTS: &[PortSpec] = &joined::<_, 4>(
    &[PortSpec::analog_input("in", "", "The signal").required()],
    station::PORTS,
);
/// The parameters.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, 8>(
    &[
        ParameterSpec::number("gain", "out/in", 1.0, -1e6, 1e6, "Output units per unit of the input"),
        ParameterSpec::number("bias", "out", 0.0, -1e9, 1e9, "Added to the output"),
        ParameterSpec::number("lead", "s", 0.0, 0.0, 1e6, "Time constant of the lead"),
        ParameterSpec::number("lag", "s", 0.0, 0.0, 1e6, "Time constant of the lag; 0 for none"),
    ],
    station::PARAMETERS,
);
/// The signal.
pub const IN: Input = Input::of(PORTS, "in");
/// The shared rows.
pub const STATION: Handles = Handles::of(PORTS, PARAMETERS);
const GAIN: Parameter = Parameter::of(PARAMETERS, "gain");
const BIAS: Parameter = Parameter::of(PARAMETERS, "bias");
const LEAD: Parameter = Parameter::of(PARAMETERS, "lead");
const LAG: Parameter = Parameter::of(PARAMETERS, "lag");

/// The controller.
#[derive(Debug)]
pub struct LeadLagBlock;

/// The state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    law: Memory,
    station: Station,
}

fn tuning(p: &Parameters<'_>) -> Tuning {
    Tuning {
        gain: p.of(GAIN),
        bias: p.of(BIAS),
        lead_s: p.of(LEAD),
        lag_s: p.of(LAG),
    }
}

fn check(p: &Parameters<'_>) -> Result<(), Fault> {
    STATION.limits(p).check()?;
    if p.of(LEAD) > 0.0 && p.of(LAG) <= 0.0 {
        return Err(Fault::bad_parameter(
            "lag must be greater than 0 where lead is: a lead alone is an impulse",
        ));
    }
    Ok(())
}

impl Controller for LeadLagBlock {
    const DESCRIPTION: Description = Description {
        name: "lead-lag",
        version: env!("CARGO_PKG_VERSION"),
        text: "Lead-lag of a signal, with gain and bias",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = State;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<State, Fault> {
        check(parameters)?;
        Ok(State {
            law: Memory::default(),
            station: Station::new(track.of(STATION.out)),
        })
    }

    fn step(state: &mut State, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let (held, demand) = STATION.demand(state.station.output, cycle, io);
        let output = match (io.read_usable(IN), demand) {
            (Some(input), demand) => {
                let natural = state.law.step(&tuning(parameters), input.value, cycle.dt_s());
                if !natural.is_finite() {
                    return Err(Fault::failed(
                        "the output is not a finite number; check the gain against the range of in",
                    ));
                }
                let limits = STATION.limits(parameters);
                state.station.step(natural, &limits, demand, held, cycle.dt_s())
            }
            (None, Demand::Follow(value)) => {
                state.law.forget();
                state.station.follow_blind(value);
                value
            }
            (None, Demand::Automatic) => return Err(Fault::bad_input("in has no usable value")),
        };
        io.write(STATION.out, output);
        Ok(())
    }

    fn retune(state: &mut State, _: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        check(new)?;
        if let Some(natural) = state.law.output(&tuning(new)) {
            state.station.retune(natural);
        }
        Ok(())
    }
}

bumpless_sdk::export!(LeadLagBlock);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use bumpless_sdk::bench::{Bench, bad};

    use super::*;

    fn at(bench: &mut Bench<LeadLagBlock>, input: f64) -> f64 {
        bench.set(IN, input);
        bench.step(0.1).unwrap()[0]
    }

    #[test]
    fn it_starts_follows_retunes_and_lets_go_without_a_bump() {
        let given = [("gain", 2.0), ("lead", 3.0), ("lag", 6.0), ("balance-time", 2.0)];
        let mut bench = Bench::<LeadLagBlock>::start(&given, &[70.0]).unwrap();
        assert_eq!(at(&mut bench, 10.0), 70.0, "what the actuator holds");
        let end = (0..400).fold(0.0, |_, _| at(&mut bench, 10.0));
        assert!((end - 20.0).abs() < 1e-6, "then the law's own: {end}");
        let before = at(&mut bench, 10.0);
        bench
            .retune(&[("gain", 5.0), ("bias", 1.0), ("lag", 1.0), ("balance-time", 2.0)])
            .unwrap();
        let after = at(&mut bench, 10.0);
        assert!((after - before).abs() < 31.0 * 0.1 / 2.0 + 1e-9, "{before} and {after}");
        bench.set_mode(Mode::Manual);
        bench.hold(STATION.out, 33.0);
        assert_eq!(at(&mut bench, 12.0), 33.0);
        bench.set_reading(IN, Some(bad(0.0)));
        assert_eq!(bench.step(0.1).unwrap(), [33.0], "in manual no input is no fault");
        bench.set_mode(Mode::Automatic);
        assert!(matches!(bench.step(0.1), Err(Fault::BadInput(_))));
        assert_eq!(at(&mut bench, 12.0), 33.0);
    }

    #[test]
    fn parameters_that_cannot_be_are_refused() {
        for (given, part) in [
            (vec![("lead", 1.0)], "lag must be"),
            (vec![("out-low", 5.0), ("out-high", 5.0)], "out-low must be"),
        ] {
            let error = Bench::<LeadLagBlock>::start(&given, &[0.0]).unwrap_err();
            assert!(format!("{error:?}").contains(part), "{error:?}");
        }
    }
}
