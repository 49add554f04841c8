//! The example law's tables and what it does with a frame, for both components that are made of it.
//!
//! It takes over the state of the same law in every other language, and they take over its own: all of them write the form of
//! `bumpless_sdk::envelope` with the same parameters and the same six values. Never: arithmetic.

use bumpless_sdk::prelude::*;

use crate::law::{Memory, Tuning};

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
    ParameterSpec::number("gain", "out/pv", 1.0, -1e6, 1e6, "Gain; below 0 for direct action"),
    ParameterSpec::number("ti", "s", 10.0, 0.0, 1e6, "Integral time; 0 for none"),
    ParameterSpec::number("td", "s", 0.0, 0.0, 1e6, "Derivative time; 0 for none"),
    ParameterSpec::number("td-filter", "s", 1.0, 0.0, 1e6, "Filter time of the derivative"),
    ParameterSpec::number("out-low", "out", 0.0, -1e9, 1e9, "Least output"),
    ParameterSpec::number("out-high", "out", 100.0, -1e9, 1e9, "Greatest output"),
];

const GAIN: Parameter = Parameter::of(PARAMETERS, "gain");
const TI: Parameter = Parameter::of(PARAMETERS, "ti");
const TD: Parameter = Parameter::of(PARAMETERS, "td");
const TD_FILTER: Parameter = Parameter::of(PARAMETERS, "td-filter");
const OUT_LOW: Parameter = Parameter::of(PARAMETERS, "out-low");
const OUT_HIGH: Parameter = Parameter::of(PARAMETERS, "out-high");

/// No plant measures more than this, nor wants it; the law's numbers stay finite for as long.
const LARGEST: f64 = 1e12;

fn is_sane(value: f64) -> bool {
    value.abs() <= LARGEST
}

/// The same law in other languages: their states are taken over.
const FAMILY: [&str; 6] = ["rust-pid", "rust-wasip2-pid", "c-pid", "js-pid", "ts-pid", "python-pid"];

fn tuning(p: &Parameters<'_>) -> Tuning {
    Tuning {
        gain: p.of(GAIN),
        ti_s: p.of(TI),
        td_s: p.of(TD),
        td_filter_s: p.of(TD_FILTER),
        out_low: p.of(OUT_LOW),
        out_high: p.of(OUT_HIGH),
    }
}

/// What a component of this law says of itself.
#[must_use]
pub const fn description(name: &'static str, version: &'static str, text: &'static str) -> Description {
    Description {
        name,
        version,
        text,
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    }
}

/// One cycle.
///
/// # Errors
/// [`Fault::BadInput`] where the measurement cannot be used and the law is to decide.
pub fn step(memory: &mut Memory, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
    let held = Some(io.held(OUT))
        .filter(|reading| reading.is_usable() && is_sane(reading.value))
        .map_or(memory.output, |reading| reading.value);
    if matches!(cycle.mode, Mode::Manual) {
        memory.follow(held);
        io.write(OUT, held);
        return Ok(());
    }
    let pv = io
        .read_usable(PV)
        .filter(|reading| is_sane(reading.value))
        .ok_or_else(|| Fault::bad_input("pv has no usable value"))?;
    if !is_sane(cycle.setpoint) {
        return Err(Fault::bad_input("the setpoint is beyond 1e12"));
    }
    let t = tuning(parameters);
    io.write(OUT, memory.step(&t, pv.value, cycle.setpoint, held, cycle.dt_s()));
    Ok(())
}

/// Other parameters.
pub fn retune(memory: &mut Memory, old: &Parameters<'_>, new: &Parameters<'_>) {
    memory.retune(&tuning(old), &tuning(new));
}

/// The state of the same law in another language; none where it is something else's.
///
/// # Errors
/// [`Fault::BadState`] where the bytes are not what their origin says.
pub fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>) -> Result<Option<Memory>, Fault> {
    for name in FAMILY {
        if let Some((old, mut memory)) = from.state_of::<Memory>(name, 1)? {
            retune(&mut memory, &old, parameters);
            return Ok(Some(memory));
        }
    }
    Ok(None)
}
