//! The component `smith`: glue between the SDK, the ISA block and the predictor before it (`law.rs`).
//!
//! docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{
    Memory, Tuning,
    block::{self, Intake},
    table::{self, OUT},
};
use bumpless_sdk::prelude::*;
use law::{Model, Predictor};
use serde::{Deserialize, Serialize};

/// The parameters: those of the ISA block, then the model.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, { table::PARAMETERS.len() + 3 }>(
    table::PARAMETERS,
    &[
        ParameterSpec::number(
            "model-gain",
            "pv/out",
            1.0,
            -1e6,
            1e6,
            "Gain of the process, with its sign",
        ),
        ParameterSpec::number("model-lag", "s", 10.0, 0.0, 1e6, "Time constant of the process"),
        ParameterSpec::number("model-delay", "s", 5.0, 0.0, 1e5, "Dead time of the process"),
    ],
);
const MODEL_GAIN: Parameter = Parameter::of(PARAMETERS, "model-gain");
const MODEL_LAG: Parameter = Parameter::of(PARAMETERS, "model-lag");
const MODEL_DELAY: Parameter = Parameter::of(PARAMETERS, "model-delay");

/// The controller.
#[derive(Debug)]
pub struct Smith;

/// The state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    pid: Memory,
    predictor: Predictor,
}

fn model(p: &Parameters<'_>) -> Model {
    Model {
        gain: p.of(MODEL_GAIN),
        lag_s: p.of(MODEL_LAG),
        delay_s: p.of(MODEL_DELAY),
    }
}

fn check(p: &Parameters<'_>) -> Result<(), Fault> {
    if p.of(MODEL_GAIN) == 0.0 {
        return Err(Fault::bad_parameter(
            "model-gain must not be 0: nothing could be predicted",
        ));
    }
    Ok(())
}

impl Controller for Smith {
    const DESCRIPTION: Description = Description {
        name: "smith",
        version: env!("CARGO_PKG_VERSION"),
        text: "PID with a Smith predictor for processes with dead time",
        ports: table::PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = State;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<State, Fault> {
        check(parameters)?;
        Ok(State {
            pid: block::start(parameters, track)?,
            predictor: Predictor::default(),
        })
    }

    fn step(state: &mut State, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = block::held(io, OUT);
        // The model sees the actuator in manual and without a measurement too, so it is always up to date.
        let actuator = held.unwrap_or(state.pid.output);
        let ahead = state.predictor.step(&model(parameters), actuator, cycle.dt_s());
        let output = match block::take(&mut state.pid, parameters, cycle, io, held, block::always)? {
            Intake::Blind(value) => value,
            Intake::Seen(mut sample, _) => {
                let measured = sample.pv;
                sample.pv += ahead;
                let tuning = Tuning::of(parameters);
                block::conclude(&mut state.pid, &tuning, parameters, &sample, measured, io)?
            }
        };
        io.write(OUT, output);
        Ok(())
    }

    fn retune(state: &mut State, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        check(new)?;
        block::retune(&mut state.pid, old, new)?;
        let (model_old, model_new) = (model(old), model(new));
        if model_old != model_new {
            let before = state.predictor.ahead();
            state.predictor.retune(&model_old, &model_new);
            // The measurement that the PID saw last moves with the prediction; its output does not.
            let moved = state.predictor.ahead() - before;
            state.pid.pv += moved;
            state.pid.integral += Tuning::of(new).gain * moved;
        }
        Ok(())
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<State>, Fault> {
        check(parameters)?;
        let adopted = block::adopt(from, parameters)?;
        Ok(adopted.map(|pid| State {
            pid,
            predictor: Predictor::default(),
        }))
    }
}

bumpless_sdk::export!(Smith);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use std::collections::VecDeque;

    use bumpless_isa::table::PV;
    use bumpless_sdk::bench::Bench;

    use super::*;

    const DT_S: f64 = 0.1;

    /// A lag of 10 s behind a dead time of 8 s; gain 1.
    struct Process {
        y: f64,
        under_way: VecDeque<f64>,
    }

    impl Process {
        fn resting(value: f64) -> Self {
            Self {
                y: value,
                under_way: vec![value; 80].into(),
            }
        }

        fn advance(&mut self, input: f64) {
            self.under_way.push_back(input);
            let u = self.under_way.pop_front().unwrap();
            self.y += (u - self.y) * (1.0 - (-DT_S / 10.0f64).exp());
        }
    }

    /// IAE and overshoot of a step from 20 to 30.
    fn respond<C: Controller>(given: &[(&str, f64)]) -> (f64, f64) {
        let mut bench = Bench::<C>::start(given, &[20.0]).unwrap();
        let mut process = Process::resting(20.0);
        let (mut iae, mut peak) = (0.0, 0.0_f64);
        for i in 0..1500 {
            bench.set_setpoint(if i < 2 { 20.0 } else { 30.0 });
            bench.set(PV, process.y);
            process.advance(bench.step(DT_S).unwrap()[0]);
            iae += (30.0 - process.y).abs() * DT_S;
            peak = peak.max(process.y);
        }
        (iae, peak)
    }

    #[test]
    fn with_a_true_model_it_is_as_fast_as_without_dead_time() {
        let model = [("model-gain", 1.0), ("model-lag", 10.0), ("model-delay", 8.0)];
        let tight = [("k", 4.0), ("ti", 10.0), ("out-high", 1000.0), ("out-low", -1000.0)];
        let smith: Vec<_> = tight.iter().chain(&model).copied().collect();
        let (iae, peak) = respond::<Smith>(&smith);
        // Closed loop of k = 4 on one lag: 10/4 s, plus the dead time.
        assert!((iae - 10.0 * (8.0 + 2.5)).abs() < 3.0, "{iae}");
        assert!(peak < 30.01, "no overshoot: {peak}");
    }

    #[test]
    fn it_takes_over_and_changes_its_model_without_a_bump() {
        let mut bench = Bench::<Smith>::start(&[("k", 2.0)], &[40.0]).unwrap();
        bench.set_setpoint(55.0);
        bench.set(PV, 50.0);
        assert_eq!(bench.step(DT_S).unwrap(), [40.0]);
        for _ in 0..60 {
            bench.step(DT_S).unwrap();
        }
        let before = bench.wanted()[0];
        bench
            .retune(&[
                ("k", 2.0),
                ("model-gain", 3.0),
                ("model-lag", 4.0),
                ("model-delay", 9.0),
            ])
            .unwrap();
        let after = bench.step(1e-6).unwrap()[0];
        assert!((after - before).abs() < 1e-3, "{before} and {after}");
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 70.0);
        assert_eq!(bench.step(DT_S).unwrap(), [70.0]);
        bench.set_mode(Mode::Automatic);
        assert_eq!(bench.step(DT_S).unwrap(), [70.0]);
        let error = Bench::<Smith>::start(&[("model-gain", 0.0)], &[0.0]).unwrap_err();
        assert!(matches!(error, Fault::BadParameter(text) if text.contains("model-gain")));
    }
}
