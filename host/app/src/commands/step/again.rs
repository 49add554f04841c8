//! A recorded cycle stepped again with a build of one's own, in this process: what it would have done, and where it fails.
//!
//! Each cycle begins with the recorded state, taken over as a swap would. What a record does not hold is not seen: messages that the
//! step heard, and times finer than a microsecond; `loop replay` repeats cycles to the last bit. Never: keeps a state.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
};

use bumpless_api::types::{Reading as Told, Record};
use bumpless_build::{Front, StateForm};
use bumpless_core::{Cycle, Direction, Effects, Fault, Frame, NoData, Reading};
use bumpless_engine::{Config, Either, Engine, Instance, Origin, Prepared};
use serde_json::{Value, json};

use super::{Known, rows, state_of, unit};
use crate::{commands::author, error::Error, show};

/// Longest time of one call, in ns: far beyond a loop's own limit, short for somebody who waits.
const CALL_LIMIT_NS: u64 = 500_000_000;

/// What steps again.
pub(super) struct Again {
    title: String,
    prepared: Arc<Prepared>,
    instance: Instance,
    form: Option<StateForm>,
    /// Where the core of a trapped instance goes.
    core: Option<PathBuf>,
}

/// What came out.
struct Outcome {
    /// "same", "migrate" or "start".
    by: &'static str,
    end: Result<Effects, Failed>,
}

/// Why nothing did.
struct Failed {
    fault: Fault,
    /// Where it was stopped.
    place: Option<String>,
}

impl Again {
    /// Builds a source with lines, or reads a component, and makes an instance of it.
    pub(super) fn new(source: &Path, core: Option<PathBuf>) -> Result<Self, Error> {
        let bytes = if source.extension().is_some_and(|end| end == "wasm") {
            fs::read(source).map_err(|error| Error::File {
                path: source.to_owned(),
                action: "read",
                source: error,
            })?
        } else {
            bumpless_build::build_with_lines(source)
                .map_err(author::failed)?
                .component
        };
        let failed = |error: bumpless_engine::Error| Error::Failed {
            what: "the component that shall step again",
            source: error.into(),
        };
        let config = Config {
            instances_max: 8,
            lines: true,
            ..Config::default()
        };
        let engine = Engine::new(config).map_err(|error| Error::start("the sandbox", error))?;
        let Either::Controller(_, prepared) = engine.open_either(&bytes).map_err(failed)? else {
            return Err(Error::Usage(format!(
                "{} is a plant; only controllers step",
                source.display()
            )));
        };
        let instance = prepared.instantiate().map_err(failed)?;
        let descriptor = prepared.descriptor();
        Ok(Self {
            title: format!("{}@{} here", descriptor.name, descriptor.version),
            form: StateForm::of_component(&bytes),
            instance,
            prepared,
            core,
        })
    }

    fn outcome(&mut self, before: Option<&Record>, record: &Record, known: Option<&Known>) -> Outcome {
        let descriptor = self.prepared.descriptor();
        let told: BTreeMap<&str, &Told> = record.readings.iter().map(|told| (told.port.as_str(), told)).collect();
        let at_ns = record.at_unix_us.saturating_mul(1_000);
        let readings: Vec<Reading> = descriptor
            .ports
            .iter()
            .map(|port| {
                told.get(port.name.as_str())
                    .map_or(Reading::unconnected(), |told| reading(told, at_ns))
            })
            .collect();
        let held = |port: &str| {
            let sent = before.and_then(|before| before.outputs.get(port).copied().flatten());
            told.get(port).and_then(|told| told.value).or(sent).unwrap_or(0.0)
        };
        let outputs = descriptor
            .ports
            .iter()
            .filter(|port| port.direction == Direction::Output);
        let track: Vec<f64> = outputs.map(|port| held(&port.name)).collect();
        let state = before.map(state_of).unwrap_or_default();
        let front = Front::of(&state);
        let ran_with = ran_with(front.as_ref().or(Front::of(&state_of(record)).as_ref()), known);
        let parameters: Vec<f64> = descriptor
            .parameters
            .iter()
            .map(|one| ran_with.get(&one.name).copied().unwrap_or(one.default))
            .collect();
        let same = front.as_ref().is_some_and(|front| {
            (front.name.as_str(), front.layout, front.parameters.as_slice())
                == (descriptor.name.as_str(), descriptor.state_layout, parameters.as_slice())
        });
        let origin = front.map(|front| Origin {
            version: known.map_or_else(|| "0.0.0".to_owned(), |known| known.component.version.clone()),
            state_layout: front.layout,
            name: front.name,
        });
        let frame = Frame {
            cycle: Cycle {
                seq: record.seq,
                at_ns,
                dt_ns: ((record.dt_ms * 1e6).round() as u64).max(1),
                mode: record.mode.into(),
                setpoint: record.setpoint.unwrap_or(f64::NAN),
            },
            readings,
            messages: Vec::new(),
        };
        let taken = origin.filter(|_| !same).and_then(|origin| {
            self.instance
                .migrate(&origin, &state, &parameters, &track, CALL_LIMIT_NS)
                .ok()
        });
        let (by, state) = match taken {
            _ if same => ("same", Ok(state)),
            Some(state) => ("migrate", Ok(state)),
            None => ("start", self.instance.start(&parameters, &track, CALL_LIMIT_NS)),
        };
        let end = state.and_then(|state| self.instance.step(&frame, &state, CALL_LIMIT_NS));
        let end = end.map_err(|fault| Failed {
            place: matches!(fault, Fault::Overrun { .. })
                .then(|| self.instance.stopped_in().map(str::to_owned))
                .flatten(),
            fault,
        });
        Outcome { by, end }
    }

    /// What it wants, by port.
    fn writes(&self, effects: &Effects) -> BTreeMap<String, f64> {
        let ports = &self.prepared.descriptor().ports;
        let named = |(port, value): &(u8, f64)| Some((ports.get(usize::from(*port))?.name.clone(), *value));
        effects.writes.iter().filter_map(named).collect()
    }

    /// Writes the core of what trapped, where that is wanted and there is one; says where it is, or why it is not there.
    fn leave_core(&mut self) -> Option<String> {
        let path = self.core.as_ref()?;
        let bytes = self.instance.take_core()?;
        Some(match fs::write(path, &bytes) {
            Ok(()) => format!("{} bytes in {}", bytes.len(), path.display()),
            Err(error) => format!("cannot be written to {}: {error}", path.display()),
        })
    }

    /// In words.
    pub(super) fn lines(&mut self, before: Option<&Record>, record: &Record, known: Option<&Known>) -> Vec<String> {
        let Outcome { by, end } = self.outcome(before, record, known);
        let title = format!("{}: state by {by}", self.title);
        let effects = match end {
            Ok(effects) => effects,
            Err(failed) => {
                let mut told = vec![("fault".to_owned(), failed.told())];
                told.extend(self.leave_core().map(|words| ("core".to_owned(), words)));
                return rows(&title, told);
            }
        };
        let row = |(port, value): (String, f64)| {
            let recorded = record.wanted.get(&port).copied().flatten();
            let text = show::with_unit(Some(value), unit(known, &port));
            let text = match recorded {
                Some(recorded) if recorded.to_bits() == value.to_bits() => format!("{text}  as recorded"),
                Some(recorded) => format!(
                    "{text}  recorded {}, {} apart",
                    show::number(recorded),
                    show::number(value - recorded)
                ),
                None => text,
            };
            (port, text)
        };
        let mut lines = rows(&title, self.writes(&effects).into_iter().map(row).collect());
        if let Some(Ok(values)) = self.form.as_ref().map(|form| form.values(&effects.state)) {
            lines.extend(rows("state after it", values));
        }
        lines.extend(effects.log.iter().map(|line| format!("  log: {}", line.text)));
        lines
    }

    /// For programs.
    pub(super) fn json(&mut self, before: Option<&Record>, record: &Record, known: Option<&Known>) -> Value {
        let Outcome { by, end } = self.outcome(before, record, known);
        match end {
            Ok(effects) => {
                let values = self.form.as_ref().and_then(|form| form.values(&effects.state).ok());
                let state: Option<BTreeMap<String, String>> = values.map(|values| values.into_iter().collect());
                json!({ "state_by": by, "wanted": self.writes(&effects), "state_after": state, "fault": null })
            }
            Err(failed) => {
                let core = self.leave_core();
                json!({ "state_by": by, "wanted": null, "state_after": null, "fault": failed.told(), "core": core })
            }
        }
    }
}

impl Failed {
    fn told(&self) -> String {
        match &self.place {
            Some(place) => format!("{}; it was in {place}", self.fault),
            None => self.fault.to_string(),
        }
    }
}

/// The parameters by name that the recorded state was made with.
fn ran_with(front: Option<&Front>, known: Option<&Known>) -> BTreeMap<String, f64> {
    let (Some(front), Some(known)) = (front, known) else {
        return BTreeMap::new();
    };
    let parameters = &known.component.parameters;
    // A state of another component has other parameters.
    if front.name != known.component.name || front.parameters.len() != parameters.len() {
        return BTreeMap::new();
    }
    parameters
        .iter()
        .map(|one| one.name.clone())
        .zip(front.parameters.iter().copied())
        .collect()
}

fn reading(told: &Told, at_ns: u64) -> Reading {
    let age_ns = told.age_ms.map_or(0, |ms| (ms * 1e6).max(0.0) as u64);
    Reading {
        value: match (&told.reason, told.value) {
            (None, Some(value)) => Ok(value),
            (Some(reason), _) if *reason == NoData::NotConnected.to_string() => Err(NoData::NotConnected),
            (None, None) => Err(NoData::NeverRead),
            (Some(_), _) => Err(NoData::CommsLost),
        },
        last_good: told.value.unwrap_or(0.0),
        quality: told.quality.into(),
        at_ns: at_ns.saturating_sub(age_ns),
        fresh: told.fresh,
    }
}
