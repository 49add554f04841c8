//! The component `ratio`: glue between the SDK, the station and the law (`law.rs`). The loop's setpoint is the ratio.
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
pub const PORTS: &[PortSpec] = &joined::<_, 6>(
    &joined::<_, 5>(
        &[
            PortSpec::analog_input("wild", "", "The flow that leads").required(),
            PortSpec::analog_input("controlled", "", "The flow that follows, for the actual ratio"),
        ],
        station::PORTS,
    ),
    &[PortSpec::analog_output("actual", "", "The actual ratio, to be seen")],
);
/// The parameters.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, 8>(
    &[
        ParameterSpec::number("ratio-low", "out/wild", 0.0, -1e6, 1e6, "Least ratio"),
        ParameterSpec::number("ratio-high", "out/wild", 1e6, -1e6, 1e6, "Greatest ratio"),
        ParameterSpec::number("bias", "out", 0.0, -1e9, 1e9, "Added to the output"),
        ParameterSpec::number(
            "wild-filter",
            "s",
            0.0,
            0.0,
            1e5,
            "Time constant of the filter on the wild flow",
        ),
    ],
    station::PARAMETERS,
);
/// The flow that leads.
pub const WILD: Input = Input::of(PORTS, "wild");
/// The flow that follows.
pub const CONTROLLED: Input = Input::of(PORTS, "controlled");
/// The actual ratio.
pub const ACTUAL: Output = Output::of(PORTS, "actual");
/// The shared rows.
pub const STATION: Handles = Handles::of(PORTS, PARAMETERS);
const RATIO_LOW: Parameter = Parameter::of(PARAMETERS, "ratio-low");
const RATIO_HIGH: Parameter = Parameter::of(PARAMETERS, "ratio-high");
const BIAS: Parameter = Parameter::of(PARAMETERS, "bias");
const WILD_FILTER: Parameter = Parameter::of(PARAMETERS, "wild-filter");

/// The controller.
#[derive(Debug)]
pub struct Ratio;

/// The state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    law: Memory,
    station: Station,
}

fn tuning(p: &Parameters<'_>) -> Tuning {
    Tuning {
        low: p.of(RATIO_LOW),
        high: p.of(RATIO_HIGH),
        bias: p.of(BIAS),
        filter_s: p.of(WILD_FILTER),
    }
}

fn check(p: &Parameters<'_>) -> Result<(), Fault> {
    STATION.limits(p).check()?;
    if p.of(RATIO_LOW) >= p.of(RATIO_HIGH) {
        return Err(Fault::bad_parameter("ratio-low must be less than ratio-high"));
    }
    Ok(())
}

impl Controller for Ratio {
    const DESCRIPTION: Description = Description {
        name: "ratio",
        version: env!("CARGO_PKG_VERSION"),
        text: "Ratio station: one flow in proportion to another; the setpoint is the ratio",
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
        let t = tuning(parameters);
        let output = match (io.read_usable(WILD), demand) {
            (Some(wild), demand) => {
                if !cycle.setpoint.is_finite() {
                    return Err(Fault::bad_input("the setpoint is not a finite number"));
                }
                let natural = state.law.step(&t, cycle.setpoint, wild.value, cycle.dt_s());
                if !natural.is_finite() {
                    return Err(Fault::failed(
                        "the output is not a finite number; check ratio-high against the range of wild",
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
            (None, Demand::Automatic) => return Err(Fault::bad_input("wild has no usable value")),
        };
        io.write(STATION.out, output);
        let controlled = io.read_usable(CONTROLLED).map(|r| r.value);
        let actual = controlled.and_then(|flow| state.law.actual(&t, flow));
        io.write(ACTUAL, actual.unwrap_or(0.0));
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

bumpless_sdk::export!(Ratio);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use bumpless_sdk::bench::{Bench, bad};

    use super::*;

    #[test]
    fn the_second_flow_follows_the_first_from_where_it_was() {
        let given = [("balance-time", 1.0)];
        let mut bench = Bench::<Ratio>::start(&given, &[55.0]).unwrap();
        let at = |bench: &mut Bench<Ratio>, wild: f64, ratio: f64| {
            bench.set(WILD, wild);
            bench.set(CONTROLLED, 30.0);
            bench.set_setpoint(ratio);
            bench.step(0.1).unwrap()[0]
        };
        assert_eq!(at(&mut bench, 20.0, 1.5), 55.0);
        let end = (0..300).fold(0.0, |_, _| at(&mut bench, 20.0, 1.5));
        assert!((end - 30.0).abs() < 1e-9);
        assert_eq!(bench.written(ACTUAL), Some(1.5));
        assert!(
            (at(&mut bench, 40.0, 1.5) - 60.0).abs() < 1e-9,
            "at once, without a filter"
        );
        bench.set_mode(Mode::Manual);
        bench.hold(STATION.out, 10.0);
        assert_eq!(at(&mut bench, 40.0, 1.5), 10.0);
        bench.set_mode(Mode::Automatic);
        assert_eq!(at(&mut bench, 40.0, 2.0), 10.0);
        bench.set_reading(WILD, Some(bad(1.0)));
        assert!(matches!(bench.step(0.1), Err(Fault::BadInput(_))));
        let error = Bench::<Ratio>::start(&[("ratio-low", 2.0), ("ratio-high", 1.0)], &[0.0]).unwrap_err();
        assert!(matches!(error, Fault::BadParameter(text) if text.contains("ratio-low")));
    }
}
