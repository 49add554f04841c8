//! The trial of a plant: some minutes of its own time with its inputs at rest and at both ends, done twice.
//!
//! Owns: the run, and what it noticed. Never: decides whether the plant comes in; keeps an instance.
//!
//! ```text
//! begin ─► at rest ─► inputs high ─► inputs low ─► long steps ── a trap, an overrun, no number, another course the second
//!                                                                time ──► refused
//! ```

use std::{sync::Arc, time::Instant};

use bumpless_core::{
    Descriptor, Direction, Finding, Migrated, PortKind, PortSpec, Severity, admission::FINDINGS_MAX,
    limits::TEXT_CHARS_MAX,
};
use bumpless_engine::{PlantInfo, PlantRole, PlantView, PreparedPlant};

use super::trial::{Trial, measured};
use crate::{
    error::chain,
    limits::{TRIAL_STEP_LIMIT_NS, TRIAL_TIME_MAX},
};

/// The seed of a trial; any will do, and the same one both times.
const SEED: u64 = 7;

/// Stretches: where the inputs stand, how many steps, and of what length in ns. A live bus takes steps of milliseconds, an
/// experiment of seconds.
const STRETCHES: [(Inputs, u32, u64); 5] = [
    (Inputs::Initial, 100, 10_000_000),
    (Inputs::High, 100, 10_000_000),
    (Inputs::Low, 100, 10_000_000),
    (Inputs::High, 20, 10_000_000_000),
    (Inputs::Initial, 20, 1_000_000_000),
];

#[derive(Debug, Clone, Copy)]
enum Inputs {
    Initial,
    High,
    Low,
}

/// What a plant says of itself as the library keeps it: signals are ports, seen from a controller.
pub(crate) fn plant_descriptor(info: &PlantInfo) -> Descriptor {
    let port = |signal: &bumpless_engine::PlantSignal| {
        let what = match signal.role {
            PlantRole::Disturbs => "disturbance, ",
            PlantRole::Measures | PlantRole::Sets => "",
        };
        let text = format!("{what}{} to {}: {}", signal.low, signal.high, signal.text);
        PortSpec {
            name: signal.name.clone(),
            direction: match signal.role {
                PlantRole::Measures => Direction::Input,
                PlantRole::Sets | PlantRole::Disturbs => Direction::Output,
            },
            kind: PortKind::Analog,
            unit: signal.unit.clone(),
            required: false,
            text: text.chars().take(TEXT_CHARS_MAX).collect(),
        }
    };
    Descriptor {
        name: info.name.clone(),
        version: info.version.clone(),
        text: info.text.clone(),
        ports: info.signals.iter().map(port).collect(),
        parameters: info.constants.clone(),
        state_layout: 0,
    }
}

/// A run that goes on.
struct Run<'a> {
    prepared: &'a Arc<PreparedPlant>,
    started: Instant,
    trial: Trial,
}

/// Tries a plant. Blocks for as long as [`TRIAL_TIME_MAX`] twice; the thread needs 1 MiB of stack.
pub(crate) fn run(prepared: &Arc<PreparedPlant>) -> Trial {
    let mut run = Run {
        prepared,
        started: Instant::now(),
        trial: Trial {
            cycles: 0,
            steps_ns: Vec::new(),
            start_ns: 0,
            migrated: Migrated::Untried,
            migrate_ns: 0,
            state_bytes: 0,
            memory_bytes: 0,
            findings: Vec::new(),
        },
    };
    match run.course() {
        Ok(first) => match run.course() {
            // As many as both did: a busy host may have ended one of them early.
            Ok(second) if first.iter().zip(&second).all(|(first, second)| same(first, second)) => {}
            Ok(_) => run.find(
                Severity::Refusal,
                "run twice with the same constants, seed and inputs it took two different courses: an experiment with it could \
                 not be repeated",
            ),
            Err(reason) => run.find(Severity::Refusal, &reason),
        },
        Err(reason) => run.find(Severity::Refusal, &reason),
    }
    let mut trial = run.trial;
    trial.steps_ns.sort_unstable();
    trial.findings.truncate(FINDINGS_MAX);
    trial
}

/// Equal to the last bit, so that no numbers are too.
fn same(first: &PlantView, second: &PlantView) -> bool {
    let alike = |a: &[f64], b: &[f64]| a.iter().map(|v| v.to_bits()).eq(b.iter().map(|v| v.to_bits()));
    alike(&first.truth, &second.truth) && alike(&first.shown, &second.shown)
}

impl Run<'_> {
    fn find(&mut self, severity: Severity, text: &str) {
        let text = text.chars().take(TEXT_CHARS_MAX).collect();
        self.trial.findings.push(Finding { severity, text });
    }

    /// What it showed in each step; or why it must not come in.
    fn course(&mut self) -> Result<Vec<PlantView>, String> {
        let info = self.prepared.info();
        let constants: Vec<f64> = info.constants.iter().map(|constant| constant.default).collect();
        let mut plant = self
            .prepared
            .instantiate()
            .map_err(|error| format!("no instance of it can be made: {}", chain(&error)))?;
        let (begun, ns) = measured(|| plant.begin(&constants, SEED, TRIAL_STEP_LIMIT_NS));
        self.trial.start_ns = ns;
        let begun = begun.map_err(|fault| format!("it does not begin with its default constants: {fault}"))?;
        let mut views = vec![self.checked(begun, "at its start")?];
        for (inputs, steps, dt_ns) in STRETCHES {
            let values: Vec<f64> = info
                .signals
                .iter()
                .map(|signal| match inputs {
                    Inputs::Initial => signal.initial,
                    Inputs::High => signal.high,
                    Inputs::Low => signal.low,
                })
                .collect();
            for _ in 0..steps {
                if self.started.elapsed() > TRIAL_TIME_MAX {
                    let text = format!(
                        "the trial ended after {} steps: they are slow, or this host is busy",
                        self.trial.cycles
                    );
                    self.find(Severity::Warning, &text);
                    return Ok(views);
                }
                self.trial.cycles += 1;
                let (view, ns) = measured(|| plant.advance(dt_ns, &values, TRIAL_STEP_LIMIT_NS));
                let place = format!("with its inputs {inputs:?} and a step of {} ms", dt_ns / 1_000_000).to_lowercase();
                let view = view.map_err(|fault| format!("{place}: {fault}"))?;
                self.trial.steps_ns.push(ns);
                views.push(self.checked(view, &place)?);
            }
        }
        Ok(views)
    }

    /// An instrument may show nothing; what is true is a number.
    fn checked(&self, view: PlantView, place: &str) -> Result<PlantView, String> {
        let signals = self.prepared.info().signals.iter().zip(&view.truth);
        let wrong = signals
            .filter(|(signal, _)| signal.role == PlantRole::Measures)
            .find(|(_, value)| !value.is_finite());
        match wrong {
            Some((signal, value)) => Err(format!("{place}: {} is {value}", signal.name)),
            None => Ok(view),
        }
    }
}
