//! The component `gain-schedule`: glue between the SDK, the curve of gains (`law.rs`) and the ISA block.
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{
    Tuning,
    block::{self, Intake},
    table::{self, K, OUT, TD, TI},
};
use bumpless_sdk::prelude::*;
use law::{Schedule, Scheduled};

/// The ports: those of the ISA block, and what the gains follow.
pub const PORTS: &[PortSpec] = &joined::<_, { table::PORTS.len() + 1 }>(
    table::PORTS,
    &[PortSpec::analog_input(
        "schedule",
        "",
        "Value that the gains follow, where `by` is schedule; while it is bad, the last one counts",
    )],
);
/// The parameters: those of the ISA block, whose k, ti and td are the first point, then the others.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, { table::PARAMETERS.len() + 15 }>(
    table::PARAMETERS,
    &[
        ParameterSpec::choice(
            "by",
            &["schedule", "measurement", "setpoint", "output"],
            "What the gains follow",
        ),
        ParameterSpec::number("points", "", 2.0, 1.0, 4.0, "How many points count"),
        ParameterSpec::number("x1", "by", 0.0, -1e9, 1e9, "Value of the first point: k, ti, td"),
        ParameterSpec::number("x2", "by", 100.0, -1e9, 1e9, "Value of the second point"),
        ParameterSpec::number("k2", "out/pv", 1.0, 0.0, 1e6, "Gain there"),
        ParameterSpec::number("ti2", "s", 60.0, 0.0, 1e6, "Integral time there"),
        ParameterSpec::number("td2", "s", 0.0, 0.0, 1e5, "Derivative time there"),
        ParameterSpec::number("x3", "by", 200.0, -1e9, 1e9, "Value of the third point"),
        ParameterSpec::number("k3", "out/pv", 1.0, 0.0, 1e6, "Gain there"),
        ParameterSpec::number("ti3", "s", 60.0, 0.0, 1e6, "Integral time there"),
        ParameterSpec::number("td3", "s", 0.0, 0.0, 1e5, "Derivative time there"),
        ParameterSpec::number("x4", "by", 300.0, -1e9, 1e9, "Value of the fourth point"),
        ParameterSpec::number("k4", "out/pv", 1.0, 0.0, 1e6, "Gain there"),
        ParameterSpec::number("ti4", "s", 60.0, 0.0, 1e6, "Integral time there"),
        ParameterSpec::number("td4", "s", 0.0, 0.0, 1e5, "Derivative time there"),
    ],
);

const fn row(name: &str) -> Parameter {
    Parameter::of(PARAMETERS, name)
}
/// What the gains follow.
pub const SCHEDULE: Input = Input::of(PORTS, "schedule");
const BY: Parameter = row("by");
const POINTS: Parameter = row("points");
const X: [Parameter; 4] = [row("x1"), row("x2"), row("x3"), row("x4")];
const GAINS: [[Parameter; 3]; 4] = [
    [K, TI, TD],
    [row("k2"), row("ti2"), row("td2")],
    [row("k3"), row("ti3"), row("td3")],
    [row("k4"), row("ti4"), row("td4")],
];

/// The controller.
#[derive(Debug)]
pub struct GainSchedule;

fn schedule(p: &Parameters<'_>) -> Schedule {
    Schedule {
        at: X.map(|x| p.of(x)),
        gains: GAINS.map(|point| point.map(|gain| p.of(gain))),
        count: p.choice(POINTS),
    }
}

/// The block's tuning at a value.
fn tuning(p: &Parameters<'_>, value: f64) -> Tuning {
    Tuning::with_gains(p, schedule(p).gains(value))
}

fn check(p: &Parameters<'_>) -> Result<(), Fault> {
    let schedule = schedule(p);
    schedule.check()?;
    for at in schedule.at.iter().take(schedule.count) {
        tuning(p, *at).check()?;
    }
    Ok(())
}

impl Controller for GainSchedule {
    const DESCRIPTION: Description = Description {
        name: "gain-schedule",
        version: env!("CARGO_PKG_VERSION"),
        text: "PID whose gains follow another value",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = Scheduled;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Scheduled, Fault> {
        check(parameters)?;
        Ok(Scheduled {
            pid: block::start(parameters, track)?,
            value: None,
        })
    }

    fn step(state: &mut Scheduled, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = block::held(io, OUT);
        let output = match block::take(&mut state.pid, parameters, cycle, io, held, block::always)? {
            Intake::Blind(value) => value,
            Intake::Seen(sample, _) => {
                let value = match parameters.choice(BY) {
                    1 => Some(sample.pv),
                    2 => Some(sample.setpoint),
                    3 => Some(held.unwrap_or(state.pid.output)),
                    _ => io.read_usable(SCHEDULE).map(|r| r.value),
                };
                let value = value.or(state.value).unwrap_or(0.0);
                // The gains of the state are those of the value before; without one, of the first point.
                let before = match state.value {
                    Some(before) => tuning(parameters, before),
                    None => Tuning::of(parameters),
                };
                let now = tuning(parameters, value);
                state.follow(value, &before, &now);
                block::conclude(&mut state.pid, &now, parameters, &sample, sample.pv, io)?
            }
        };
        io.write(OUT, output);
        Ok(())
    }

    fn retune(state: &mut Scheduled, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        check(new)?;
        let at = |p: &Parameters<'_>| state.value.map_or_else(|| Tuning::of(p), |value| tuning(p, value));
        let (before, now) = (at(old), at(new));
        state.pid.retune(&before, &now);
        Ok(())
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<Scheduled>, Fault> {
        check(parameters)?;
        let adopted = block::adopt(from, parameters)?;
        Ok(adopted.map(|pid| Scheduled { pid, value: None }))
    }
}

bumpless_sdk::export!(GainSchedule);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use bumpless_isa::table::PV;
    use bumpless_sdk::bench::{Bench, bad};

    use super::*;

    const TABLE: [(&str, f64); 6] = [
        ("k", 1.0),
        ("ti", 20.0),
        ("x2", 10.0),
        ("k2", 5.0),
        ("ti2", 4.0),
        ("td2", 1.0),
    ];

    fn start() -> Bench<GainSchedule> {
        let mut bench = Bench::start(&TABLE, &[40.0]).unwrap();
        bench.set_setpoint(50.0);
        bench.set(PV, 48.0);
        bench.set(SCHEDULE, 0.0);
        assert_eq!(bench.step(0.1).unwrap(), [40.0]);
        bench
    }

    #[test]
    fn another_gain_does_not_move_the_output_but_what_follows() {
        let mut bench = start();
        let before = bench.step(0.1).unwrap()[0];
        bench.set(SCHEDULE, 10.0);
        let after = bench.step(1e-9).unwrap()[0];
        assert!((after - before).abs() < 1e-6, "{before} and {after}");
        bench.set(PV, 49.0);
        let moved = bench.step(1e-9).unwrap()[0] - after;
        assert!(moved < -5.0, "the new gain, and its derivative: {moved}");
        bench.set_reading(SCHEDULE, Some(bad(0.0)));
        bench.set(PV, 49.0);
        assert!(bench.step(0.1).is_ok(), "a failing schedule stays where it was");
    }

    #[test]
    fn with_one_point_it_is_a_pid_bit_by_bit() {
        let given = [("k", 3.0), ("ti", 8.0), ("td", 1.5)];
        let mut pid =
            Bench::<GainSchedule>::start(&[("points", 1.0), ("by", 1.0), given[0], given[1], given[2]], &[40.0])
                .unwrap();
        let mut memory = bumpless_isa::Memory::new(40.0);
        let tuning = Tuning {
            td_s: 1.5,
            td_filter_s: 0.15,
            ff_gain: 1.0,
            bias: 50.0,
            ..Tuning::pi(3.0, 8.0, 0.0, 100.0)
        };
        let mut held = 40.0;
        for i in 0..500 {
            let pv = 50.0 + (f64::from(i) * 0.37).sin();
            pid.set(PV, pv);
            pid.set_setpoint(50.5);
            let sample = bumpless_isa::Sample::automatic(pv, 50.5, Some(held), 0.1);
            held = memory.step(&tuning, &sample);
            assert_eq!(pid.step(0.1).unwrap(), [held], "{i}");
        }
    }

    #[test]
    fn it_takes_over_manual_and_new_tables_without_a_bump() {
        let mut bench = start();
        bench.set(SCHEDULE, 7.0);
        let before = (0..20).fold(0.0, |_, _| bench.step(0.1).unwrap()[0]);
        bench
            .retune(&[("k", 9.0), ("ti", 3.0), ("x2", 8.0), ("k2", 0.5), ("ti2", 50.0)])
            .unwrap();
        let after = bench.step(1e-9).unwrap()[0];
        assert!((after - before).abs() < 1e-6);
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 12.0);
        assert_eq!(bench.step(0.1).unwrap(), [12.0]);
        bench.set_mode(Mode::Automatic);
        bench.set(SCHEDULE, 0.0);
        assert_eq!(bench.step(0.1).unwrap(), [12.0]);
        let error = Bench::<GainSchedule>::start(&[("x2", 0.0)], &[0.0]).unwrap_err();
        assert!(matches!(error, Fault::BadParameter(text) if text.contains("x1 < x2")));
    }
}
