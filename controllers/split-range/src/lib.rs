//! The component `split-range`: glue between the SDK, the ISA block and the two curves behind it (`law.rs`).
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{
    Demand, Memory, Tuning,
    block::{self, Intake},
    table::{self, BALANCE_TIME, OUT},
};
use bumpless_sdk::prelude::*;
use law::{Actuators, Curves};
use serde::{Deserialize, Serialize};

/// The ports: those of the ISA block, whose `out` is actuator A, and actuator B.
pub const PORTS: &[PortSpec] = &joined::<_, { table::PORTS.len() + 1 }>(
    table::PORTS,
    &[PortSpec::analog_output("out-b", "", "To actuator B; its reading is what B holds").required()],
);
/// The parameters: those of the ISA block, whose output is u in %, then the curves.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, { table::PARAMETERS.len() + 6 }>(
    table::PARAMETERS,
    &[
        ParameterSpec::number("split", "%", 50.0, 1.0, 99.0, "Where A ends and B begins"),
        ParameterSpec::number(
            "gap",
            "%",
            0.0,
            -90.0,
            90.0,
            "Where neither moves; negative: where both do",
        ),
        ParameterSpec::number("a-low", "out", 100.0, -1e9, 1e9, "A at 0 %"),
        ParameterSpec::number("a-split", "out", 0.0, -1e9, 1e9, "A at the split and above"),
        ParameterSpec::number("b-split", "out-b", 0.0, -1e9, 1e9, "B at the split and below"),
        ParameterSpec::number("b-high", "out-b", 100.0, -1e9, 1e9, "B at 100 %"),
    ],
);
/// Actuator B.
pub const OUT_B: Output = Output::of(PORTS, "out-b");
const SPLIT: Parameter = Parameter::of(PARAMETERS, "split");
const GAP: Parameter = Parameter::of(PARAMETERS, "gap");
const A_LOW: Parameter = Parameter::of(PARAMETERS, "a-low");
const A_SPLIT: Parameter = Parameter::of(PARAMETERS, "a-split");
const B_SPLIT: Parameter = Parameter::of(PARAMETERS, "b-split");
const B_HIGH: Parameter = Parameter::of(PARAMETERS, "b-high");

/// The controller.
#[derive(Debug)]
pub struct SplitRange;

/// The state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    pid: Memory,
    actuators: Actuators,
}

fn curves(p: &Parameters<'_>) -> Curves {
    Curves {
        split: p.of(SPLIT),
        gap: p.of(GAP),
        a: (p.of(A_LOW), p.of(A_SPLIT)),
        b: (p.of(B_SPLIT), p.of(B_HIGH)),
    }
}

impl Controller for SplitRange {
    const DESCRIPTION: Description = Description {
        name: "split-range",
        version: env!("CARGO_PKG_VERSION"),
        text: "PID whose output moves two actuators, one after the other",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = State;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<State, Fault> {
        Tuning::of(parameters).check()?;
        let curves = curves(parameters);
        curves.check()?;
        let both = [track.of(OUT), track.of(OUT_B)];
        Ok(State {
            pid: Memory::new(curves.back(both, curves.split)),
            actuators: Actuators::new(both),
        })
    }

    fn step(state: &mut State, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let curves = curves(parameters);
        let held = state.actuators.held([block::held(io, OUT), block::held(io, OUT_B)]);
        let u_held = curves.back(state.actuators.meant(held), state.pid.output);
        let (u, demand) = match block::take(&mut state.pid, parameters, cycle, io, Some(u_held), block::always)? {
            Intake::Blind(u) => (u, Demand::Follow(u)),
            Intake::Seen(sample, _) => {
                let tuning = Tuning::of(parameters);
                let u = block::conclude(&mut state.pid, &tuning, parameters, &sample, sample.pv, io)?;
                (u, sample.demand)
            }
        };
        // In manual each actuator has a value of its own; while tracking, both follow the curves.
        let [a, b] = match (cycle.mode, demand) {
            (Mode::Manual, _) => state.actuators.follow(&curves, u, held),
            _ => {
                let balance_s = parameters.of(BALANCE_TIME);
                state.actuators.send(&curves, u, held, balance_s, cycle.dt_s())
            }
        };
        io.write(OUT, a);
        io.write(OUT_B, b);
        Ok(())
    }

    fn retune(state: &mut State, old: &Parameters<'_>, new: &Parameters<'_>, track: &Track<'_>) -> Result<(), Fault> {
        let now = curves(new);
        now.check()?;
        block::retune(&mut state.pid, old, new)?;
        if curves(old) != now {
            // Other curves mean another u by the same actuators; both start from what they hold.
            let both = [track.of(OUT), track.of(OUT_B)];
            let moved = now.back(both, state.pid.output) - state.pid.output;
            state.pid.output += moved;
            state.pid.integral += moved;
            state.actuators = Actuators::new(both);
        }
        Ok(())
    }
}

bumpless_sdk::export!(SplitRange);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use bumpless_isa::table::PV;
    use bumpless_sdk::bench::Bench;

    use super::*;

    #[test]
    fn heating_and_cooling_take_turns_and_nothing_winds_up() {
        let given = [("k", 4.0), ("ti", 10.0)];
        let mut bench = Bench::<SplitRange>::start(&given, &[0.0, 30.0]).unwrap();
        // 20 °C outside; B heats by 0.6 °C/%, A cools by 0.4 °C/%; a lag of 20 s.
        let mut y = 38.0;
        let run = |bench: &mut Bench<SplitRange>, y: &mut f64, setpoint: f64, seconds: u32| {
            bench.set_setpoint(setpoint);
            let mut outputs = [0.0; 2];
            for _ in 0..seconds * 10 {
                bench.set(PV, *y);
                outputs.copy_from_slice(&bench.step(0.1).unwrap());
                *y += (20.0 + 0.6 * outputs[1] - 0.4 * outputs[0] - *y) * 0.1 / 20.0;
            }
            outputs
        };
        bench.set(PV, y);
        bench.set_setpoint(38.0);
        assert_eq!(
            bench.step(0.1).unwrap(),
            [0.0, 30.0],
            "the first outputs are what is held"
        );
        let [a, b] = run(&mut bench, &mut y, 50.0, 300);
        assert!(
            (y - 50.0).abs() < 1e-3 && a == 0.0 && (b - 50.0).abs() < 1e-2,
            "{y} {a} {b}"
        );
        let [a, b] = run(&mut bench, &mut y, 8.0, 300);
        assert!(
            (y - 8.0).abs() < 1e-3 && (a - 30.0).abs() < 1e-2 && b == 0.0,
            "{y} {a} {b}"
        );
        // Out of reach for a long time, then back at once.
        run(&mut bench, &mut y, 300.0, 600);
        let [_, b] = run(&mut bench, &mut y, 60.0, 2);
        assert!(b < 60.0, "{b}");
    }

    #[test]
    fn both_start_from_what_they_hold_even_off_the_curves() {
        let mut bench = Bench::<SplitRange>::start(&[("balance-time", 2.0)], &[40.0, 40.0]).unwrap();
        bench.set(PV, 50.0);
        bench.set_setpoint(50.0);
        assert_eq!(bench.step(0.1).unwrap(), [40.0, 40.0]);
        let end = (0..400).fold(vec![], |_, _| bench.step(0.1).unwrap());
        assert!(end[0].abs() < 1e-6 && (end[1] - 40.0).abs() < 1e-6, "{end:?}");
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 80.0);
        bench.hold(OUT_B, 0.0);
        assert_eq!(bench.step(0.1).unwrap(), [80.0, 0.0]);
        bench.set_mode(Mode::Automatic);
        assert_eq!(bench.step(0.1).unwrap(), [80.0, 0.0]);
        let end = (0..20).fold(vec![], |_, _| bench.step(0.1).unwrap());
        assert!((end[0] - 80.0).abs() < 1e-6, "u is where the actuators say: {end:?}");
        bench.retune(&[("gap", 10.0), ("k", 2.0)]).unwrap();
        let next = bench.step(0.1).unwrap();
        assert!((next[0] - 80.0).abs() < 1e-6 && next[1].abs() < 1e-6, "{next:?}");
    }
}
