//! One controller through its versions: fields of the state and parameters that come, go and change their names. Each version
//! takes over what the one before wrote, and the output goes on.

#![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

use bumpless_sdk::{bench::Bench, prelude::*};
use serde::{Deserialize, Serialize};

const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "m", "Level").required(),
    PortSpec::analog_output("out", "%", "Valve").required(),
];
const PV: Input = Input::of(PORTS, "pv");
const OUT: Output = Output::of(PORTS, "out");

const GAIN_ONLY: &[ParameterSpec] = &[ParameterSpec::number("gain", "%/m/s", 1.0, 0.0, 10.0, "Integral gain")];
/// The gain got another name, and there is a filter.
const RATE_AND_FILTER: &[ParameterSpec] = &[
    ParameterSpec::number("filter", "s", 0.0, 0.0, 100.0, "Filter of the level"),
    ParameterSpec::number("rate", "%/m/s", 1.0, 0.0, 10.0, "Integral rate"),
];
const GAIN: Parameter = Parameter::of(GAIN_ONLY, "gain");
const RATE: Parameter = Parameter::of(RATE_AND_FILTER, "rate");
const FILTER: Parameter = Parameter::of(RATE_AND_FILTER, "filter");

const fn level(version: &'static str, parameters: &'static [ParameterSpec], state_layout: u32) -> Description {
    Description {
        name: "level",
        version,
        text: "Integral control of a level",
        ports: PORTS,
        parameters,
        state_layout,
    }
}

/// The first: a sum, and a count of cycles that nobody needed.
struct First;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Layout1 {
    sum: f64,
    cycles: u32,
}

impl Controller for First {
    const DESCRIPTION: Description = level("1.0.0", GAIN_ONLY, 1);
    type State = Layout1;

    fn start(_: &Parameters<'_>, track: &Track<'_>) -> Result<Layout1, Fault> {
        Ok(Layout1 {
            sum: track.of(OUT),
            cycles: 0,
        })
    }

    fn step(state: &mut Layout1, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        state.cycles += 1;
        state.sum += parameters.of(GAIN) * (cycle.setpoint - io.read(PV).value) * cycle.dt_s();
        io.write(OUT, state.sum);
        Ok(())
    }
}

/// The second adds a field.
struct Second;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Layout2 {
    sum: f64,
    cycles: u32,
    filtered: Option<f64>,
}

impl Controller for Second {
    const DESCRIPTION: Description = level("2.0.0", RATE_AND_FILTER, 2);
    type State = Layout2;

    fn start(_: &Parameters<'_>, track: &Track<'_>) -> Result<Layout2, Fault> {
        Ok(Layout2 {
            sum: track.of(OUT),
            cycles: 0,
            filtered: None,
        })
    }

    fn step(state: &mut Layout2, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let pv = filtered(state.filtered, io.read(PV).value, parameters.of(FILTER), cycle.dt_s());
        state.filtered = Some(pv);
        state.cycles += 1;
        state.sum += parameters.of(RATE) * (cycle.setpoint - pv) * cycle.dt_s();
        io.write(OUT, state.sum);
        Ok(())
    }

    fn adopt(from: &Origin<'_>, _: &Parameters<'_>, _: &Track<'_>) -> Result<Option<Layout2>, Fault> {
        let first = from.state_of::<Layout1>("level", 1)?;
        Ok(first.map(|(_, Layout1 { sum, cycles })| Layout2 {
            sum,
            cycles,
            filtered: None,
        }))
    }
}

/// The third drops a field and renames another, and still knows both layouts before it.
struct Third;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Layout3 {
    filtered: Option<f64>,
    reset: f64,
}

impl Controller for Third {
    const DESCRIPTION: Description = level("3.0.0", RATE_AND_FILTER, 3);
    type State = Layout3;

    fn start(_: &Parameters<'_>, track: &Track<'_>) -> Result<Layout3, Fault> {
        Ok(Layout3 {
            filtered: None,
            reset: track.of(OUT),
        })
    }

    fn step(state: &mut Layout3, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let pv = filtered(state.filtered, io.read(PV).value, parameters.of(FILTER), cycle.dt_s());
        state.filtered = Some(pv);
        state.reset += parameters.of(RATE) * (cycle.setpoint - pv) * cycle.dt_s();
        io.write(OUT, state.reset);
        Ok(())
    }

    fn adopt(from: &Origin<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<Option<Layout3>, Fault> {
        if let Some((_, old)) = from.state_of::<Layout2>("level", 2)? {
            return Ok(Some(Layout3 {
                filtered: old.filtered,
                reset: old.sum,
            }));
        }
        let Some((parameters, old)) = from.state_of::<Layout1>("level", 1)? else {
            return Ok(None);
        };
        // Another tuning is no reason to decline an integral; a law that it matters to would look here.
        debug_assert!(parameters.of(GAIN).is_finite() && new.of(RATE).is_finite());
        Ok(Some(Layout3 {
            filtered: None,
            reset: old.sum,
        }))
    }
}

fn filtered(before: Option<f64>, pv: f64, filter_s: f64, dt_s: f64) -> f64 {
    before.map_or(pv, |before| before + (pv - before) * dt_s / (filter_s + dt_s))
}

fn started() -> Bench<First> {
    let mut bench = Bench::<First>::start(&[("gain", 2.0)], &[40.0]).unwrap();
    bench.set(PV, 3.0);
    bench.set_setpoint(3.5);
    bench.step(1.0).unwrap();
    bench
}

#[test]
fn a_field_and_a_parameter_that_came_start_from_nothing_and_the_output_goes_on() {
    let (mut second, taken) = started().swap::<Second>(&[("rate", 2.0), ("filter", 0.0)]).unwrap();
    assert!(taken);
    assert_eq!(second.step(1.0).unwrap(), [42.0], "41 and one more step of 1");
}

#[test]
fn fields_that_went_or_changed_their_names_are_found_in_every_older_layout() {
    let tuning = [("rate", 2.0), ("filter", 0.0)];
    let (second, _) = started().swap::<Second>(&tuning).unwrap();
    let (mut from_second, taken) = second.swap::<Third>(&tuning).unwrap();
    assert!(taken);
    let (mut from_first, taken) = started().swap::<Third>(&tuning).unwrap();
    assert!(taken);
    assert_eq!(from_second.step(1.0).unwrap(), [42.0]);
    assert_eq!(from_first.step(1.0).unwrap(), [42.0]);
}

#[test]
fn a_newer_layout_is_declined_and_the_older_version_starts_from_the_actuator() {
    let (third, _) = started().swap::<Third>(&[("rate", 2.0)]).unwrap();
    let (mut first, taken) = third.swap::<First>(&[("gain", 2.0)]).unwrap();
    assert!(!taken);
    assert_eq!(first.step(1.0).unwrap(), [42.0], "without a bump all the same");
}

#[test]
fn bytes_that_are_not_what_the_origin_says_are_refused() {
    let mut bench = started();
    let cut = bench.state()[..bench.state().len() - 1].to_vec();
    bench.set_state(cut);
    let (_, taken) = bench.swap::<Third>(&[("rate", 2.0)]).unwrap();
    assert!(!taken);
}
