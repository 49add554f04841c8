//! The component `cascade`: glue between the SDK and two blocks of the ISA standard form, one inside the other (`law.rs`).
//!
//! README.md has the ports, parameters and the picture. Never: arithmetic.

pub mod law;

use bumpless_isa::Tuning;
use bumpless_sdk::prelude::*;

use crate::law::{Cascade, Sample};

const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "", "Measurement of the outer loop, in the unit of the setpoint").required(),
    PortSpec::analog_input("inner-pv", "", "Measurement of the inner loop").required(),
    PortSpec::analog_output("out", "", "To the actuator; its reading is what the actuator holds").required(),
];
/// Measurement of the outer loop.
pub const PV: Input = Input::of(PORTS, "pv");
/// Measurement of the inner loop.
pub const INNER_PV: Input = Input::of(PORTS, "inner-pv");
/// To the actuator.
pub const OUT: Output = Output::of(PORTS, "out");

const PARAMETERS: &[ParameterSpec] = &[
    ParameterSpec::number("k", "inner/pv", 1.0, 0.0, 1e6, "Gain of the outer loop"),
    ParameterSpec::number("ti", "s", 60.0, 0.0, 1e6, "Integral time of the outer loop; 0 for none"),
    ParameterSpec::number("inner-low", "inner", 0.0, -1e9, 1e9, "Least setpoint of the inner loop"),
    ParameterSpec::number(
        "inner-high",
        "inner",
        100.0,
        -1e9,
        1e9,
        "Greatest setpoint of the inner loop",
    ),
    ParameterSpec::number("inner-k", "out/inner", 1.0, 0.0, 1e6, "Gain of the inner loop"),
    ParameterSpec::number(
        "inner-ti",
        "s",
        10.0,
        0.0,
        1e6,
        "Integral time of the inner loop; 0 for none",
    ),
    ParameterSpec::choice(
        "action",
        &["reverse", "direct"],
        "Outer loop: reverse lowers the inner setpoint when pv rises",
    ),
    ParameterSpec::choice(
        "inner-action",
        &["reverse", "direct"],
        "Inner loop: reverse lowers the output when inner-pv rises",
    ),
    ParameterSpec::number("out-low", "out", 0.0, -1e9, 1e9, "Least output"),
    ParameterSpec::number("out-high", "out", 100.0, -1e9, 1e9, "Greatest output"),
];

macro_rules! handles {
    ($($handle:ident = $name:literal;)*) => {
        $(const $handle: Parameter = Parameter::of(PARAMETERS, $name);)*
    };
}

handles! {
    K = "k";
    TI = "ti";
    INNER_LOW = "inner-low";
    INNER_HIGH = "inner-high";
    INNER_K = "inner-k";
    INNER_TI = "inner-ti";
    ACTION = "action";
    INNER_ACTION = "inner-action";
    OUT_LOW = "out-low";
    OUT_HIGH = "out-high";
}

/// The controller.
#[derive(Debug)]
pub struct TwoLoops;

/// A PI block between two limits.
fn block(gain: f64, direct: bool, ti_s: f64, out_low: f64, out_high: f64) -> Tuning {
    Tuning {
        gain: if direct { -gain } else { gain },
        ti_s,
        td_s: 0.0,
        td_filter_s: 0.0,
        beta: 1.0,
        gamma: 0.0,
        out_low,
        out_high,
        out_rate_per_s: 0.0,
        dead_band: 0.0,
        ff_gain: 0.0,
        bias: 0.0,
        balance_s: 60.0,
        pv_filter_s: 0.0,
    }
}

fn tunings(p: &Parameters<'_>) -> Result<(Tuning, Tuning), Fault> {
    let outer = block(
        p.of(K),
        p.choice(ACTION) == 1,
        p.of(TI),
        p.of(INNER_LOW),
        p.of(INNER_HIGH),
    );
    let inner = block(
        p.of(INNER_K),
        p.choice(INNER_ACTION) == 1,
        p.of(INNER_TI),
        p.of(OUT_LOW),
        p.of(OUT_HIGH),
    );
    if outer.out_low >= outer.out_high {
        return Err(Fault::bad_parameter("inner-low must be less than inner-high"));
    }
    inner.check()?;
    Ok((outer, inner))
}

impl Controller for TwoLoops {
    const DESCRIPTION: Description = Description {
        name: "cascade",
        version: env!("CARGO_PKG_VERSION"),
        text: "Cascade: an outer PI controller sets the setpoint of an inner one",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = Cascade;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Cascade, Fault> {
        tunings(parameters)?;
        Ok(Cascade::new(track.of(OUT)))
    }

    fn step(state: &mut Cascade, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = Some(io.held(OUT)).filter(Reading::is_usable).map(|r| r.value);
        let usable = |reading: Option<Reading>, fault| reading.map(|r| r.value).ok_or_else(|| Fault::bad_input(fault));
        let sample = Sample {
            pv: usable(io.read_usable(PV), "pv has no usable value")?,
            inner_pv: usable(io.read_usable(INNER_PV), "inner-pv has no usable value")?,
            setpoint: cycle.setpoint,
            held,
            manual: matches!(cycle.mode, Mode::Manual),
            dt_s: cycle.dt_s(),
        };
        let (outer, inner) = tunings(parameters)?;
        let output = state.step(&outer, &inner, &sample);
        if !output.is_finite() {
            return Err(Fault::failed(
                "the output is not a finite number; check the gains and the setpoint",
            ));
        }
        io.write(OUT, output);
        Ok(())
    }

    fn retune(state: &mut Cascade, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        state.retune(&tunings(old)?, &tunings(new)?);
        Ok(())
    }
}

bumpless_sdk::export!(TwoLoops);
