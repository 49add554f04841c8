//! The component `autotune`: glue between the SDK, the ISA block and the experiments (`law.rs`).
//!
//! ```text
//!   Idle ── `tune` goes to relay or step, in automatic ──► Under way ── finding, failure, `tune` off, a hand ──► Idle
//!            the PID runs                                  the PID follows; the experiment decides the output
//! ```
//! What was found stays in the state and shows at the outputs; with `apply` the PID uses it. Where an experiment ends, the PID
//! goes on from what the actuator holds. docs/laws.md has the ports, parameters and formulae. Never: arithmetic.

pub mod law;

use bumpless_isa::{
    Demand, Memory, Phase, Tuning,
    block::{self, Intake},
    table::{self, ACTION, N, OUT},
};
use bumpless_sdk::prelude::*;
use law::{Bounds, Course, Failure, Finding, Relay, Rule, Step, simc};
use serde::{Deserialize, Serialize};

/// The ports: those of the ISA block, and what was found.
pub const PORTS: &[PortSpec] = &joined::<_, { table::PORTS.len() + 7 }>(
    table::PORTS,
    &[
        PortSpec::analog_output("stage", "", "0: none yet, 1: under way, 2: found, 3: failed"),
        PortSpec::analog_output("found-k", "out/pv", "Gain that was found"),
        PortSpec::analog_output("found-ti", "s", "Integral time that was found"),
        PortSpec::analog_output("found-td", "s", "Derivative time that was found"),
        PortSpec::analog_output("found-gain", "", "Relay: ultimate gain; step: gain of the process"),
        PortSpec::analog_output("found-time", "s", "Relay: ultimate period; step: time constant"),
        PortSpec::analog_output("found-delay", "s", "Step: dead time"),
    ],
);
/// The parameters: those of the ISA block, then the experiment.
pub const PARAMETERS: &[ParameterSpec] = &joined::<_, { table::PARAMETERS.len() + 9 }>(
    table::PARAMETERS,
    &[
        ParameterSpec::choice(
            "tune",
            &["off", "relay", "step"],
            "Begins an experiment when it goes to one; off ends it",
        ),
        ParameterSpec::choice("apply", &["no", "yes"], "yes: the PID uses what was found"),
        ParameterSpec::number(
            "amplitude",
            "out",
            5.0,
            1e-6,
            1e9,
            "How far an experiment moves the output",
        ),
        ParameterSpec::number(
            "noise",
            "pv",
            0.1,
            0.0,
            1e9,
            "Half width of what the measurement does by itself",
        ),
        ParameterSpec::number(
            "pv-span",
            "pv",
            10.0,
            1e-9,
            1e9,
            "How far an experiment may move the measurement",
        ),
        ParameterSpec::number("time-max", "s", 1800.0, 1.0, 1e6, "Longest time of an experiment"),
        ParameterSpec::number(
            "quiet-time",
            "s",
            30.0,
            0.1,
            1e5,
            "Step: how long the measurement must stay within its noise; longer than the dead time",
        ),
        ParameterSpec::choice(
            "rule",
            &[
                "tyreus-luyben-pi",
                "tyreus-luyben-pid",
                "ziegler-nichols-pi",
                "ziegler-nichols-pid",
            ],
            "Relay: from swing to tuning",
        ),
        ParameterSpec::number(
            "tau-c",
            "",
            1.0,
            0.1,
            100.0,
            "Step: closed-loop time of SIMC, in dead times",
        ),
    ],
);
const fn row(name: &str) -> Parameter {
    Parameter::of(PARAMETERS, name)
}
const fn out(name: &str) -> Output {
    Output::of(PORTS, name)
}
/// Where the experiment is.
pub const STAGE: Output = out("stage");
/// Gain, integral and derivative time.
pub const FOUND: [Output; 3] = [out("found-k"), out("found-ti"), out("found-td")];
const FOUND_OF_PROCESS: [Output; 3] = [out("found-gain"), out("found-time"), out("found-delay")];
const TUNE: Parameter = row("tune");
const APPLY: Parameter = row("apply");
const AMPLITUDE: Parameter = row("amplitude");
const NOISE: Parameter = row("noise");
const PV_SPAN: Parameter = row("pv-span");
const TIME_MAX: Parameter = row("time-max");
const QUIET_TIME: Parameter = row("quiet-time");
const RULE: Parameter = row("rule");
const TAU_C: Parameter = row("tau-c");

/// The controller.
#[derive(Debug)]
pub struct Autotune;

/// An experiment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
enum Experiment {
    Relay(Relay),
    Step(Step),
}

impl Experiment {
    fn step(&mut self, bounds: &Bounds, pv: f64, dt_s: f64) -> Course {
        match self {
            Self::Relay(relay) => relay.step(bounds, pv, dt_s),
            Self::Step(step) => step.step(bounds, pv, dt_s),
        }
    }
}

/// The state.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct State {
    pid: Memory,
    /// The value of `tune` that was seen last: an experiment begins when it changes.
    asked: u8,
    under_way: Option<Experiment>,
    last: Option<Result<Finding, Failure>>,
}

fn bounds(p: &Parameters<'_>) -> Bounds {
    Bounds {
        amplitude: p.of(AMPLITUDE),
        noise: p.of(NOISE),
        pv_span: p.of(PV_SPAN),
        time_max_s: p.of(TIME_MAX),
        quiet_s: p.of(QUIET_TIME),
        direct: p.choice(ACTION) == 1,
    }
}

/// Gain without its sign, integral and derivative time by what was found.
fn gains(p: &Parameters<'_>, finding: Finding) -> [f64; 3] {
    match finding {
        Finding::Ultimate { ku, tu_s } => {
            let rule = match p.choice(RULE) {
                1 => Rule::TyreusLuybenPid,
                2 => Rule::ZieglerNicholsPi,
                3 => Rule::ZieglerNicholsPid,
                _ => Rule::TyreusLuybenPi,
            };
            rule.gains(ku, tu_s)
        }
        // Less dead time than a hundredth of the lag is not there to be measured.
        Finding::Process { gain, lag_s, delay_s } => simc(gain, lag_s, delay_s.max(0.01 * lag_s), p.of(TAU_C)),
    }
}

const fn words(failure: Failure) -> &'static str {
    match failure {
        Failure::Time => "the experiment failed: it took longer than time-max",
        Failure::Span => "the experiment failed: the measurement went further than pv-span",
        Failure::Direction => "the experiment failed: the measurement went the wrong way; check action",
        Failure::Room => "the experiment failed: the output has no room for amplitude within its limits",
        Failure::Taken => "the experiment ended: the output was taken by hand, by tracking, or tune went off",
    }
}

impl State {
    const fn new(pid: Memory) -> Self {
        Self {
            pid,
            asked: 0,
            under_way: None,
            last: None,
        }
    }

    /// The tuning that counts.
    fn tuning(&self, p: &Parameters<'_>) -> Tuning {
        let table = Tuning::of(p);
        let Some(Ok(finding)) = self.last.filter(|_| p.choice(APPLY) == 1) else {
            return table;
        };
        let [k, ti_s, td_s] = gains(p, finding);
        Tuning {
            gain: if p.choice(ACTION) == 1 { -k } else { k },
            ti_s,
            td_s,
            td_filter_s: td_s / p.of(N),
            ..table
        }
    }

    fn end(&mut self, end: Result<Finding, Failure>, io: &mut Io<'_>) {
        self.under_way = None;
        self.last = Some(end);
        match end {
            Ok(_) => io.log(
                Level::Info,
                "the experiment is done: its tuning is at the outputs found-k, -ti and -td",
            ),
            Err(failure) => io.log(Level::Warning, words(failure)),
        }
    }

    /// Begins, goes on or ends. Gives the output that the experiment wants, while it is under way.
    fn experiment(&mut self, p: &Parameters<'_>, demand: Demand, pv: f64, dt_s: f64, io: &mut Io<'_>) -> Option<f64> {
        let wanted = u8::try_from(p.choice(TUNE)).unwrap_or(0);
        let is_new = wanted != self.asked;
        let free = demand == Demand::Automatic;
        if self.under_way.is_some() && (is_new || !free) {
            self.end(Err(Failure::Taken), io);
        }
        // In manual a wish waits until the loop is automatic and the PID has taken over.
        if is_new && (wanted == 0 || (free && self.pid.phase == Phase::Running)) {
            self.asked = wanted;
            let (base, t) = (self.pid.output, Tuning::of(p));
            let amplitude = p.of(AMPLITUDE);
            self.under_way = match wanted {
                1 => Some(Experiment::Relay(Relay::new(base, pv))),
                2 => Some(Experiment::Step(Step::new(base, pv))),
                _ => None,
            };
            let below = if wanted == 1 { amplitude } else { 0.0 };
            if self.under_way.is_some() && (base + amplitude > t.out_high || base - below < t.out_low) {
                self.end(Err(Failure::Room), io);
            }
        }
        match self.under_way.as_mut()?.step(&bounds(p), pv, dt_s) {
            Course::Goes(output) => Some(output),
            Course::Ends(end) => {
                self.end(end, io);
                None
            }
        }
    }

    fn show(&self, p: &Parameters<'_>, io: &mut Io<'_>) {
        let stage = match (self.under_way, self.last) {
            (Some(_), _) => 1.0,
            (None, None) => 0.0,
            (None, Some(Ok(_))) => 2.0,
            (None, Some(Err(_))) => 3.0,
        };
        let (found, of_process) = match self.last {
            Some(Ok(finding)) => (
                gains(p, finding),
                match finding {
                    Finding::Ultimate { ku, tu_s } => [ku, tu_s, 0.0],
                    Finding::Process { gain, lag_s, delay_s } => [gain, lag_s, delay_s],
                },
            ),
            _ => ([0.0; 3], [0.0; 3]),
        };
        io.write(STAGE, stage);
        let all = FOUND.into_iter().zip(found);
        for (port, value) in all.chain(FOUND_OF_PROCESS.into_iter().zip(of_process)) {
            // Numbers at the edge of what a number can be are not shown; the state has them.
            io.write(port, if value.is_finite() { value } else { 0.0 });
        }
    }
}

impl Controller for Autotune {
    const DESCRIPTION: Description = Description {
        name: "autotune",
        version: env!("CARGO_PKG_VERSION"),
        text: "PID that finds its own tuning by a relay or a step",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: 1,
    };

    type State = State;

    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<State, Fault> {
        Ok(State::new(block::start(parameters, track)?))
    }

    fn step(state: &mut State, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = block::held(io, OUT);
        let output = match block::take(&mut state.pid, parameters, cycle, io, held, block::always)? {
            Intake::Blind(value) => {
                if state.under_way.is_some() {
                    state.end(Err(Failure::Taken), io);
                }
                value
            }
            Intake::Seen(mut sample, _) => {
                let wanted = state.experiment(parameters, sample.demand, sample.pv, sample.dt_s, io);
                if let Some(wanted) = wanted {
                    sample.demand = Demand::Follow(wanted);
                }
                let tuning = state.tuning(parameters);
                block::conclude(&mut state.pid, &tuning, parameters, &sample, sample.pv, io)?
            }
        };
        io.write(OUT, output);
        state.show(parameters, io);
        Ok(())
    }

    fn retune(state: &mut State, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        Tuning::of(new).check()?;
        let (before, now) = (state.tuning(old), state.tuning(new));
        state.pid.retune(&before, &now);
        Ok(())
    }

    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, _: &Track<'_>) -> Result<Option<State>, Fault> {
        Ok(block::adopt(from, parameters)?.map(State::new))
    }
}

bumpless_sdk::export!(Autotune);

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

    use std::collections::VecDeque;

    use bumpless_isa::table::PV;
    use bumpless_sdk::bench::Bench;

    use super::*;

    const DT_S: f64 = 0.1;

    /// A lag of 10 s behind a dead time of 3 s; gain 1.
    struct Process {
        y: f64,
        under_way: VecDeque<f64>,
    }

    impl Process {
        fn advance(&mut self, input: f64) {
            self.under_way.push_back(input);
            let u = self.under_way.pop_front().unwrap();
            self.y += (u - self.y) * (1.0 - (-DT_S / 10.0f64).exp());
        }
    }

    fn start(given: &[(&str, f64)]) -> (Bench<Autotune>, Process) {
        let mut bench = Bench::<Autotune>::start(given, &[50.0]).unwrap();
        bench.set_setpoint(50.0);
        let process = Process {
            y: 50.0,
            under_way: vec![50.0; 30].into(),
        };
        (bench, process)
    }

    /// Runs until the experiment has ended; gives all outputs.
    fn run(bench: &mut Bench<Autotune>, process: &mut Process, cycles: u32) -> Vec<f64> {
        let mut outputs = Vec::new();
        for _ in 0..cycles {
            bench.set(PV, process.y);
            let out = bench.step(DT_S).unwrap()[0];
            outputs.push(out);
            process.advance(out);
        }
        outputs
    }

    #[test]
    fn experiments_find_a_tuning_that_is_applied_without_a_bump() {
        for tune in [1.0, 2.0] {
            let base = [("k", 0.2), ("ti", 30.0), ("noise", 0.02), ("rule", 0.0)];
            let (mut bench, mut process) = start(&base);
            run(&mut bench, &mut process, 20);
            let wish: Vec<_> = base.iter().chain(&[("tune", tune)]).copied().collect();
            bench.retune(&wish).unwrap();
            let outputs = run(&mut bench, &mut process, 3000);
            assert!(
                outputs.iter().all(|out| (out - 50.0).abs() < 6.0),
                "limits of the experiment"
            );
            assert_eq!(bench.written(STAGE), Some(2.0));
            let found = FOUND.map(|port| bench.written(port).unwrap());
            assert!(
                (0.5..3.0).contains(&found[0]) && (5.0..40.0).contains(&found[1]),
                "{found:?}"
            );
            let before = *outputs.last().unwrap();
            let wish: Vec<_> = wish.iter().chain(&[("apply", 1.0)]).copied().collect();
            bench.retune(&wish).unwrap();
            let after = run(&mut bench, &mut process, 1)[0];
            assert!((after - before).abs() < 0.2, "{before} and {after}");
            bench.set_setpoint(60.0);
            run(&mut bench, &mut process, 1500);
            assert!((process.y - 60.0).abs() < 0.1, "{}", process.y);
        }
    }

    #[test]
    fn a_hand_ends_it_and_without_room_it_does_not_begin() {
        let wish = [("tune", 1.0)];
        let (mut bench, mut process) = start(&wish);
        run(&mut bench, &mut process, 10);
        assert_eq!(bench.written(STAGE), Some(1.0));
        bench.set_mode(Mode::Manual);
        bench.hold(OUT, 52.0);
        run(&mut bench, &mut process, 1);
        assert_eq!(bench.written(STAGE), Some(3.0));
        bench.set_mode(Mode::Automatic);
        assert_eq!(run(&mut bench, &mut process, 1), [52.0]);
        assert_eq!(bench.written(STAGE), Some(3.0), "it does not begin by itself again");
        let (mut bench, mut process) = start(&[("tune", 1.0), ("out-high", 53.0)]);
        let outputs = run(&mut bench, &mut process, 10);
        assert_eq!(bench.written(STAGE), Some(3.0));
        assert!(outputs.iter().all(|out| (out - 50.0).abs() < 1e-9));
        assert!(bench.desk().log.is_empty(), "said once, not in every cycle");
    }
}
