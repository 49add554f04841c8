//! The component `override-selector`: glue between the SDK and two ISA blocks with one actuator (`law.rs`).
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{
    Memory, Sample, Tuning,
    block::{self, Intake},
    table::{self, N, OUT},
};
use bumpless_sdk::prelude::*;
use law::{Pair, Select};

/// The ports: those of the ISA block for the main loop, then the limit's.
pub const PORTS: &[PortSpec] = &joined::<_, { table::PORTS.len() + 2 }>(
    table::PORTS,
    &[
        PortSpec::analog_input("limit-pv", "", "Measurement that must keep to its limit").required(),
        PortSpec::digital_output("limited", "Is the limit's wish taken? To be seen"),
    ],
);
/// The parameters: those of the ISA block for the main loop, then the limit's.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, { table::PARAMETERS.len() + 6 }>(
    table::PARAMETERS,
    &[
        ParameterSpec::choice(
            "select",
            &["low", "high"],
            "Which wish counts: the lower or the higher one",
        ),
        ParameterSpec::number("limit-sp", "limit-pv", 100.0, -1e9, 1e9, "The limit"),
        ParameterSpec::number("limit-k", "out/limit-pv", 1.0, 0.0, 1e6, "Gain of the limit's block"),
        ParameterSpec::number("limit-ti", "s", 60.0, 0.0, 1e6, "Its integral time; 0 for none"),
        ParameterSpec::number("limit-td", "s", 0.0, 0.0, 1e5, "Its derivative time"),
        ParameterSpec::choice(
            "limit-action",
            &["reverse", "direct"],
            "reverse: a rising limit-pv lowers the output",
        ),
    ],
);
/// What must keep to its limit.
pub const LIMIT_PV: Input = Input::of(PORTS, "limit-pv");
/// Is its wish taken?
pub const LIMITED: Output = Output::of(PORTS, "limited");
const SELECT: Parameter = Parameter::of(PARAMETERS, "select");
const LIMIT_SP: Parameter = Parameter::of(PARAMETERS, "limit-sp");
const LIMIT_K: Parameter = Parameter::of(PARAMETERS, "limit-k");
const LIMIT_TI: Parameter = Parameter::of(PARAMETERS, "limit-ti");
const LIMIT_TD: Parameter = Parameter::of(PARAMETERS, "limit-td");
const LIMIT_ACTION: Parameter = Parameter::of(PARAMETERS, "limit-action");

/// The controller.
#[derive(Debug)]
pub struct OverrideSelector;

/// The limit's tuning: its own gains, the actuator's limits.
fn limit_tuning(p: &Parameters<'_>, main: &Tuning) -> Tuning {
    let (k, td_s) = (p.of(LIMIT_K), p.of(LIMIT_TD));
    Tuning {
        td_s,
        td_filter_s: td_s / p.of(N),
        out_rate_per_s: main.out_rate_per_s,
        bias: main.bias,
        balance_s: main.balance_s,
        ..Tuning::pi(
            if p.choice(LIMIT_ACTION) == 1 { -k } else { k },
            p.of(LIMIT_TI),
            main.out_low,
            main.out_high,
        )
    }
}

fn select(p: &Parameters<'_>) -> Select {
    if p.choice(SELECT) == 1 {
        Select::High
    } else {
        Select::Low
    }
}

impl Controller for OverrideSelector {
    const DESCRIPTION: Description = Description {
        name: "override-selector",
        version: env!("CARGO_PKG_VERSION"),
        text: "Two PID blocks for one actuator: the lower or the higher output is taken",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = Pair;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Pair, Fault> {
        Tuning::of(parameters).check()?;
        Ok(Pair::new(track.of(OUT)))
    }

    fn step(pair: &mut Pair, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = block::held(io, OUT);
        let limit_pv = io.read_usable(LIMIT_PV).map(|r| r.value);
        let output = match (
            block::take(&mut pair.main, parameters, cycle, io, held, block::always)?,
            limit_pv,
        ) {
            (Intake::Blind(value), _) => {
                pair.limit.follow_blind(value);
                value
            }
            (Intake::Seen(sample, _), Some(limit_pv)) => {
                let main = Tuning::of(parameters);
                let wish = block::conclude(&mut pair.main, &main, parameters, &sample, sample.pv, io)?;
                let limit_sample = Sample {
                    demand: sample.demand,
                    ..Sample::automatic(limit_pv, parameters.of(LIMIT_SP), held, sample.dt_s)
                };
                let other = pair.limit.step(&limit_tuning(parameters, &main), &limit_sample);
                if !(other.is_finite() && pair.limit.is_sound()) {
                    return Err(Fault::failed(
                        "the limit's output is not a finite number; check limit-k against the range of limit-pv",
                    ));
                }
                pair.take(select(parameters), wish, other)
            }
            (Intake::Seen(sample, _), None) => {
                let bumpless_isa::Demand::Follow(value) = sample.demand else {
                    return Err(Fault::bad_input("limit-pv has no usable value"));
                };
                pair.main.follow_blind(value);
                pair.limit.follow_blind(value);
                value
            }
        };
        io.write(OUT, output);
        io.write(LIMITED, f64::from(u8::from(pair.limited)));
        Ok(())
    }

    fn retune(pair: &mut Pair, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        block::retune(&mut pair.main, old, new)?;
        let of = |p: &Parameters<'_>| limit_tuning(p, &Tuning::of(p));
        pair.limit.retune(&of(old), &of(new));
        Ok(())
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Option<Pair>, Fault> {
        let adopted = block::adopt(from, parameters)?;
        Ok(adopted.map(|main| Pair {
            main,
            limit: Memory::new(track.of(OUT)),
            limited: false,
        }))
    }
}

bumpless_sdk::export!(OverrideSelector);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use bumpless_isa::table::PV;
    use bumpless_sdk::bench::{Bench, bad};

    use super::*;

    const TUNING: [(&str, f64); 5] = [
        ("k", 2.0),
        ("ti", 10.0),
        ("limit-k", 0.5),
        ("limit-ti", 2.0),
        ("limit-sp", 100.0),
    ];

    #[test]
    fn it_starts_and_changes_hands_without_a_bump() {
        let mut bench = Bench::<OverrideSelector>::start(&TUNING, &[20.0]).unwrap();
        let (mut y, mut x, mut last, mut step, mut limited) = (20.0, 40.0, 20.0, 0.0_f64, false);
        bench.set_setpoint(20.0);
        for i in 0..6000 {
            if i == 10 {
                bench.set_setpoint(60.0);
            }
            bench.set(PV, y);
            bench.set(LIMIT_PV, x);
            let out: f64 = bench.step(0.1).unwrap()[0];
            if i > 11 {
                step = step.max((out - last).abs());
            } else if i < 10 {
                assert!((out - 20.0).abs() < 1e-9);
            }
            last = out;
            limited |= bench.written(LIMITED) == Some(1.0);
            y += (out - y) * 0.1 / 10.0;
            x += (2.0 * out - x) * 0.1 / 2.0;
        }
        assert!(limited && (y - 50.0).abs() < 0.1, "{y}");
        assert!(step < 3.0, "no step at the change of hands: {step}");
    }

    #[test]
    fn a_missing_limit_is_a_fault_in_automatic_only() {
        let mut bench = Bench::<OverrideSelector>::start(&TUNING, &[20.0]).unwrap();
        bench.set(PV, 20.0);
        bench.set(LIMIT_PV, 40.0);
        assert_eq!(bench.step(0.1).unwrap(), [20.0]);
        bench.set_reading(LIMIT_PV, Some(bad(40.0)));
        assert!(matches!(bench.step(0.1), Err(Fault::BadInput(text)) if text.contains("limit-pv")));
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 33.0);
        assert_eq!(bench.step(0.1).unwrap(), [33.0]);
        bench.set_mode(Mode::Automatic);
        bench.set(LIMIT_PV, 40.0);
        assert_eq!(bench.step(0.1).unwrap(), [33.0]);
    }
}
