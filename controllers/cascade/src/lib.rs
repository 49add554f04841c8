//! The component `cascade`: glue between the SDK and two blocks of the ISA standard form, one inside the other (`law.rs`).
//!
//! docs/laws.md has the ports, parameters and the picture. Never: arithmetic.

pub mod law;

use bumpless_isa::{Demand, Tuning, block};
use bumpless_sdk::prelude::*;

use crate::law::{Cascade, Cascade1, Lead, Sample};

const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "", "Measurement of the outer loop, in the unit of the setpoint").required(),
    PortSpec::analog_input("inner-pv", "", "Measurement of the inner loop").required(),
    PortSpec::analog_output("out", "", "To the actuator; its reading is what the actuator holds").required(),
    PortSpec::analog_input("track", "", "Value that the output follows while track-on is on"),
    PortSpec::digital_input("track-on", "Makes the output follow the track input"),
    PortSpec::digital_input("inner-on", "Opens the cascade: the inner loop runs on inner-sp"),
    PortSpec::analog_input(
        "inner-sp",
        "",
        "Setpoint of the inner loop while inner-on is on; without it the inner loop keeps its own",
    ),
    PortSpec::analog_output("inner-sp-out", "", "Setpoint of the inner loop, to be seen"),
];
/// Measurement of the outer loop.
pub const PV: Input = Input::of(PORTS, "pv");
/// Measurement of the inner loop.
pub const INNER_PV: Input = Input::of(PORTS, "inner-pv");
/// To the actuator.
pub const OUT: Output = Output::of(PORTS, "out");
/// What the output follows.
pub const TRACK: Input = Input::of(PORTS, "track");
/// Is the output to follow it?
pub const TRACK_ON: Input = Input::of(PORTS, "track-on");
/// Is the inner loop alone?
pub const INNER_ON: Input = Input::of(PORTS, "inner-on");
/// Its setpoint then.
pub const INNER_SP: Input = Input::of(PORTS, "inner-sp");
/// The setpoint of the inner loop.
pub const INNER_SP_OUT: Output = Output::of(PORTS, "inner-sp-out");

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
    // Since layout 2.
    ParameterSpec::number("td", "s", 0.0, 0.0, 1e5, "Derivative time of the outer loop"),
    ParameterSpec::number("inner-td", "s", 0.0, 0.0, 1e5, "Derivative time of the inner loop"),
    ParameterSpec::number(
        "n",
        "",
        10.0,
        1.0,
        100.0,
        "Derivative filter of both: its time is the derivative time / n",
    ),
    ParameterSpec::number(
        "beta",
        "",
        1.0,
        0.0,
        1.0,
        "Part of the setpoint in the outer proportional action",
    ),
    ParameterSpec::number(
        "inner-beta",
        "",
        1.0,
        0.0,
        1.0,
        "Part of the inner setpoint in the inner proportional action",
    ),
    ParameterSpec::number(
        "inner-rate",
        "inner/s",
        0.0,
        0.0,
        1e9,
        "Greatest change of the inner setpoint per second; 0 for no limit",
    ),
    ParameterSpec::number(
        "out-rate",
        "out/s",
        0.0,
        0.0,
        1e9,
        "Greatest change of the output per second; 0 for no limit",
    ),
    ParameterSpec::number("pv-filter", "s", 0.0, 0.0, 1e5, "Time constant of the filter on pv"),
    ParameterSpec::number(
        "inner-pv-filter",
        "s",
        0.0,
        0.0,
        1e5,
        "Time constant of the filter on inner-pv",
    ),
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
    TD = "td";
    INNER_TD = "inner-td";
    N = "n";
    BETA = "beta";
    INNER_BETA = "inner-beta";
    INNER_RATE = "inner-rate";
    OUT_RATE = "out-rate";
    PV_FILTER = "pv-filter";
    INNER_PV_FILTER = "inner-pv-filter";
}

/// How many parameters layout 1 had: the first ones of today's table.
const PARAMETERS_1: usize = 10;

/// The controller.
#[derive(Debug)]
pub struct TwoLoops;

/// A block between two limits.
fn block_of(gain: f64, direct: bool, ti_s: f64, out_low: f64, out_high: f64) -> Tuning {
    Tuning::pi(if direct { -gain } else { gain }, ti_s, out_low, out_high)
}

/// The outer and the inner tuning, of a state in any layout.
fn tunings(p: &Parameters<'_>) -> Result<(Tuning, Tuning), Fault> {
    let mut outer = block_of(
        p.of(K),
        p.choice(ACTION) == 1,
        p.of(TI),
        p.of(INNER_LOW),
        p.of(INNER_HIGH),
    );
    let mut inner = block_of(
        p.of(INNER_K),
        p.choice(INNER_ACTION) == 1,
        p.of(INNER_TI),
        p.of(OUT_LOW),
        p.of(OUT_HIGH),
    );
    if p.count() == PARAMETERS.len() {
        let n = p.of(N);
        (outer.td_s, outer.td_filter_s) = (p.of(TD), p.of(TD) / n);
        (inner.td_s, inner.td_filter_s) = (p.of(INNER_TD), p.of(INNER_TD) / n);
        (outer.beta, inner.beta) = (p.of(BETA), p.of(INNER_BETA));
        (outer.out_rate_per_s, inner.out_rate_per_s) = (p.of(INNER_RATE), p.of(OUT_RATE));
        (outer.pv_filter_s, inner.pv_filter_s) = (p.of(PV_FILTER), p.of(INNER_PV_FILTER));
    }
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
        state_layout: 2,
    };

    type State = Cascade;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Cascade, Fault> {
        tunings(parameters)?;
        Ok(Cascade::new(track.of(OUT)))
    }

    fn step(state: &mut Cascade, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = block::held(io, OUT);
        let lead = match block::demand(state.inner.output, cycle, io, held, (TRACK, TRACK_ON)) {
            Demand::Follow(value) => Lead::Hand(value),
            Demand::Automatic if block::is_on(io, INNER_ON) => Lead::Inner(io.read_usable(INNER_SP).map(|r| r.value)),
            Demand::Automatic => Lead::Both,
        };
        let (pv, inner_pv) = match (io.read_usable(PV), io.read_usable(INNER_PV), lead) {
            (Some(pv), Some(inner_pv), _) => (pv.value, inner_pv.value),
            (_, _, Lead::Hand(value)) => {
                state.follow_blind(value);
                io.write(OUT, value);
                return Ok(());
            }
            (_, None, _) => return Err(Fault::bad_input("inner-pv has no usable value")),
            (None, ..) => return Err(Fault::bad_input("pv has no usable value")),
        };
        if !cycle.setpoint.is_finite() {
            return Err(Fault::bad_input("the setpoint is not a finite number"));
        }
        let sample = Sample {
            pv,
            inner_pv,
            setpoint: cycle.setpoint,
            held,
            lead,
            dt_s: cycle.dt_s(),
        };
        let (outer, inner) = tunings(parameters)?;
        let output = state.step(&outer, &inner, &sample);
        if !(output.is_finite() && state.outer.is_sound() && state.inner.is_sound()) {
            return Err(Fault::failed(
                "the output is not a finite number; check the gains and the setpoint",
            ));
        }
        io.write(OUT, output);
        io.write(INNER_SP_OUT, state.inner.setpoint);
        Ok(())
    }

    fn retune(state: &mut Cascade, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        state.retune(&tunings(old)?, &tunings(new)?);
        Ok(())
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<Cascade>, Fault> {
        let Some((old, state)) = from.state_of::<Cascade1>("cascade", 1)? else {
            return Ok(None);
        };
        if old.count() != PARAMETERS_1 {
            return Ok(None);
        }
        let mut state = Cascade::from(state);
        state.retune(&tunings(&old)?, &tunings(parameters)?);
        Ok(Some(state))
    }
}

bumpless_sdk::export!(TwoLoops);
