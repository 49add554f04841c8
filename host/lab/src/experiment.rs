//! An experiment as the engineer writes it (TOML): plant, loops, network, cell, what happens when, and what is compared.
//!
//! Owns the form and every check that needs nothing but the text. Unknown fields are refused with their place.
//! Never: a default that hides a disturbance; without tables for network, cell and instruments everything is ideal.
//!
//! `docs/lab.md` explains each field with examples.

use std::{collections::BTreeMap, fs, path::Path};

use bumpless_core::{Mode, OutputLimit, Policy, Strategy};
use bumpless_io::sim::{FopdtSettings, LinearSettings, PlantSettings};
use serde::{Deserialize, Serialize};

use crate::{
    error::Error,
    limits::EXPERIMENT_BYTES_MAX,
    network::{Channel, Delay},
};

/// An experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Short name: letters, digits, dashes; the name of its report.
    pub name: String,
    /// What it is about, for people.
    #[serde(default)]
    pub text: String,
    /// Virtual time of each run, in s.
    pub duration_s: f64,
    /// How often each run is repeated with other noise and other losses: a number, or the seeds themselves.
    #[serde(default)]
    pub seeds: Seeds,
    /// The plant.
    pub plant: PlantPlan,
    /// The controller of every loop that names none of its own.
    #[serde(default)]
    pub controller: Option<ControllerPlan>,
    /// The loops, at least one.
    #[serde(rename = "loop")]
    pub loops: Vec<LoopPlan>,
    /// Between the plant's devices and the loops' home.
    #[serde(default)]
    pub network: NetworkPlan,
    /// The hosts that control.
    #[serde(default)]
    pub cell: CellPlan,
    /// What instruments do to what they measure, beyond what the plant's own do.
    #[serde(default, rename = "instrument")]
    pub instruments: Vec<InstrumentPlan>,
    /// What the world does to the plant.
    #[serde(default, rename = "disturbance")]
    pub disturbances: Vec<Disturbance>,
    /// What people and faults do to the loops.
    #[serde(default, rename = "event")]
    pub events: Vec<Event>,
    /// What is measured.
    #[serde(default)]
    pub measure: MeasurePlan,
    /// What is compared; one case without changes where none is given.
    #[serde(default, rename = "case")]
    pub cases: Vec<Case>,
    /// Fields that are varied, each with each.
    #[serde(default, rename = "sweep")]
    pub sweeps: Vec<Sweep>,
}

/// The seeds of the runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Seeds {
    /// So many: 1, 2, 3 …
    Count(u32),
    /// These.
    These(Vec<u64>),
}

impl Default for Seeds {
    fn default() -> Self {
        Self::Count(1)
    }
}

impl Seeds {
    /// Each seed.
    #[must_use]
    pub fn list(&self) -> Vec<u64> {
        match self {
            Self::Count(n) => (1..=u64::from(*n)).collect(),
            Self::These(seeds) => seeds.clone(),
        }
    }
}

/// Which plant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlantPlan {
    /// `pilot`, `fopdt`, `linear`, `recorded`, or `component:NAME` or `component:PATH`.
    pub model: String,
    /// Settings of `pilot`.
    #[serde(default)]
    pub pilot: Option<PlantSettings>,
    /// Settings of `fopdt`.
    #[serde(default)]
    pub fopdt: Option<FopdtSettings>,
    /// Settings of `linear`.
    #[serde(default)]
    pub linear: Option<LinearSettings>,
    /// Settings of `recorded`.
    #[serde(default)]
    pub recorded: Option<RecordedPlan>,
    /// Constants of a component, by name.
    #[serde(default)]
    pub constants: BTreeMap<String, f64>,
    /// What signals hold at the start, by name.
    #[serde(default)]
    pub initial: BTreeMap<String, f64>,
}

/// A window of a live loop as the plant: its measurements come as they were recorded, whatever the outputs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedPlan {
    /// File with the answer of `GET /v1/loops/{l}/cycles`; `bumpless lab record` writes one.
    pub file: String,
}

/// A controller with its parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControllerPlan {
    /// Name of a stock component, or the path of a `.wasm` file.
    pub component: String,
    /// Parameters that differ from their defaults: numbers, or words of a choice.
    #[serde(default)]
    pub parameters: BTreeMap<String, Value>,
}

/// A parameter's value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Value {
    /// A number.
    Number(f64),
    /// A word of a choice.
    Word(String),
}

/// One loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LoopPlan {
    /// Its name.
    pub name: String,
    /// Signal of each port, by port name.
    pub ports: BTreeMap<String, String>,
    /// Time between cycles, in ms.
    pub period_ms: f64,
    /// How long after the device was read the cycle begins, in ms.
    #[serde(default)]
    pub phase_ms: f64,
    /// Its controller, instead of the experiment's.
    #[serde(default)]
    pub controller: Option<ControllerPlan>,
    /// Setpoint over time; the first must be at 0 s.
    pub setpoint: Vec<SetpointMove>,
    /// Who decides the output at first.
    #[serde(default = "automatic")]
    pub mode: Mode,
    /// Bounds of outputs, by port; the signal's range where not given.
    #[serde(default)]
    pub limits: BTreeMap<String, OutputLimit>,
    /// Bounds within which a host runs it.
    #[serde(default)]
    pub policy: Policy,
    /// How the replica that steps is chosen, by its name: `round-robin`, `vote(3)`.
    #[serde(default = "local", with = "strategy_name")]
    pub strategy: Strategy,
    /// Topics whose messages its controller receives from other loops.
    #[serde(default)]
    pub listens: Vec<String>,
    /// The input port that the indices are made of; `pv`, or the only required input.
    #[serde(default)]
    pub measured: Option<String>,
}

const fn automatic() -> Mode {
    Mode::Automatic
}

const fn local() -> Strategy {
    Strategy::Local
}

/// One move of a setpoint.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SetpointMove {
    /// When, in s.
    pub at_s: f64,
    /// Where to.
    pub to: f64,
    /// How long the way there takes, in s; 0 for a step.
    #[serde(default)]
    pub over_s: f64,
}

/// Between the devices and the home.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetworkPlan {
    /// Readings on their way to the home.
    pub reads: Channel,
    /// Writes on their way to the actuators.
    pub writes: Channel,
    /// What both suffer at the same time: one radio, one cable. Its losses and delays come on top.
    pub both: Channel,
    /// Time between two readings of the devices, in ms; each loop's period where not given.
    pub poll_ms: Option<f64>,
    /// A reading older than this is bad, in ms; never where not given: the last one stays, and is not fresh.
    pub bad_after_ms: Option<f64>,
    /// What the home knows of an actuator.
    pub readback: Readback,
    /// What a reading is that did not arrive.
    pub missing: Missing,
}

/// What a reading is that did not arrive. It is never fresh.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Missing {
    /// The last one that did.
    #[default]
    Held,
    /// 0, as from a gateway that fills its table with it.
    Zero,
}

/// What the home knows of an actuator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Readback {
    /// What the actuator holds: writes are confirmed.
    #[default]
    Actuator,
    /// What was sent last: a write that is lost is not noticed.
    Sent,
}

/// The hosts that control.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CellPlan {
    /// Hosts besides the home; where there are none the home steps by itself.
    #[serde(rename = "host")]
    pub hosts: Vec<HostPlan>,
    /// Between any two hosts, one way.
    pub link: Channel,
    /// Time from a host's death to the news of it, in ms.
    pub notice_ms: f64,
    /// How late cycles begin: uniform between 0 and this, in ms.
    pub jitter_ms: f64,
}

impl Default for CellPlan {
    fn default() -> Self {
        Self {
            hosts: Vec::new(),
            link: Channel::default(),
            // What a liveliness token takes on a quiet network.
            notice_ms: 2.0,
            jitter_ms: 0.0,
        }
    }
}

/// One host that controls.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostPlan {
    /// Its name.
    pub name: String,
    /// Time of a step there, beyond the network.
    #[serde(default)]
    pub step: Delay,
    /// Load of its cores, 0 to 1.
    #[serde(default)]
    pub cpu: f32,
    /// Is it off at first?
    #[serde(default)]
    pub off: bool,
}

/// What an instrument does to its signal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InstrumentPlan {
    /// The signal.
    pub signal: String,
    /// Standard deviation of its noise, in the signal's unit.
    #[serde(default)]
    pub noise: f64,
    /// Steps of its converter over its range: 2 to the power of this. None for a smooth one.
    #[serde(default)]
    pub bits: Option<u32>,
    /// Its range: it shows nothing beyond. The signal's own where not given.
    #[serde(default)]
    pub range: Option<(f64, f64)>,
}

/// What the world does to the plant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Disturbance {
    /// When, in s.
    pub at_s: f64,
    /// The signal.
    pub signal: String,
    /// Where to.
    pub to: f64,
}

/// What people and faults do to the loops.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Event {
    /// Another component, or the same with other parameters, goes on with a loop.
    Swap {
        /// When, in s.
        at_s: f64,
        /// The loop; all of them where not given.
        #[serde(default, rename = "loop")]
        loop_name: Option<String>,
        /// The component.
        component: String,
        /// Parameters that differ from their defaults.
        #[serde(default)]
        parameters: BTreeMap<String, Value>,
    },
    /// A host dies without a word. `owner` is the host that owns the first loop then.
    Kill {
        /// When, in s.
        at_s: f64,
        /// The host.
        host: String,
        /// It comes back after this, in s.
        #[serde(default)]
        back_after_s: Option<f64>,
    },
    /// A host stops in order.
    Off {
        /// When, in s.
        at_s: f64,
        /// The host.
        host: String,
    },
    /// A host comes, or comes back.
    On {
        /// When, in s.
        at_s: f64,
        /// The host.
        host: String,
    },
    /// A host stands still.
    Pause {
        /// When, in s.
        at_s: f64,
        /// The host, or `owner`.
        host: String,
        /// How long, in s.
        for_s: f64,
    },
    /// A host's steps go wrong: their first output is off.
    Wrong {
        /// When, in s.
        at_s: f64,
        /// The host, or `owner`.
        host: String,
        /// By how much, in the output's unit.
        by: f64,
        /// How long, in s.
        for_s: f64,
    },
    /// The load of a host's cores changes.
    Load {
        /// When, in s.
        at_s: f64,
        /// The host.
        host: String,
        /// 0 to 1.
        cpu: f32,
        /// Time of a step there from now on.
        #[serde(default)]
        step: Option<Delay>,
    },
    /// Manual or automatic.
    Mode {
        /// When, in s.
        at_s: f64,
        /// The loop; all of them where not given.
        #[serde(default, rename = "loop")]
        loop_name: Option<String>,
        /// Who decides.
        mode: Mode,
    },
    /// The outputs in manual, in the order of the output ports.
    Output {
        /// When, in s.
        at_s: f64,
        /// The loop; all of them where not given.
        #[serde(default, rename = "loop")]
        loop_name: Option<String>,
        /// The values.
        values: Vec<f64>,
    },
}

impl Event {
    /// When it happens, in s.
    #[must_use]
    pub const fn at_s(&self) -> f64 {
        match self {
            Self::Swap { at_s, .. }
            | Self::Kill { at_s, .. }
            | Self::Off { at_s, .. }
            | Self::On { at_s, .. }
            | Self::Pause { at_s, .. }
            | Self::Wrong { at_s, .. }
            | Self::Load { at_s, .. }
            | Self::Mode { at_s, .. }
            | Self::Output { at_s, .. } => *at_s,
        }
    }

    const fn host(&self) -> Option<&String> {
        match self {
            Self::Kill { host, .. }
            | Self::Off { host, .. }
            | Self::On { host, .. }
            | Self::Pause { host, .. }
            | Self::Wrong { host, .. }
            | Self::Load { host, .. } => Some(host),
            _ => None,
        }
    }

    const fn loop_name(&self) -> Option<&String> {
        match self {
            Self::Swap { loop_name, .. } | Self::Mode { loop_name, .. } | Self::Output { loop_name, .. } => {
                loop_name.as_ref()
            }
            _ => None,
        }
    }
}

/// What is measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MeasurePlan {
    /// Indices count from here, in s.
    pub from_s: f64,
    /// And to here, in s; the end where not given.
    pub to_s: Option<f64>,
    /// Time between two samples, in ms; each loop's period where not given.
    pub every_ms: Option<f64>,
    /// How integrals are made.
    pub rule: RuleWord,
    /// What the indices are made of.
    pub of: Of,
    /// Half of the band of the settling time, in % of the step.
    pub band_percent: f64,
}

impl Default for MeasurePlan {
    fn default() -> Self {
        Self {
            from_s: 0.0,
            to_s: None,
            every_ms: None,
            rule: RuleWord::Rectangle,
            of: Of::Truth,
            band_percent: 5.0,
        }
    }
}

/// How an integral is made from samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RuleWord {
    /// Each sample holds until the next.
    Rectangle,
    /// Straight from sample to sample.
    Trapezoid,
}

/// What the indices are made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Of {
    /// What the plant does, whatever reaches the controller.
    Truth,
    /// What the controller was told.
    Measured,
}

/// One thing that is compared: fields of the experiment that differ.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Case {
    /// Its name.
    pub name: String,
    /// Fields by their path, for example `"controller.component" = "pidplus"` or `"loop.flow.period_ms" = 500`.
    #[serde(default)]
    pub set: toml::Table,
}

/// One field that is varied.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sweep {
    /// Its path, as in a case.
    pub field: String,
    /// The values that it takes.
    pub values: Vec<toml::Value>,
    /// How it is called in reports; the path where not given.
    #[serde(default)]
    pub title: Option<String>,
    /// How the values are called, one for each; as they are written where not given.
    #[serde(default)]
    pub labels: Option<Vec<String>>,
}

/// 1 to 64 letters, digits and dashes.
pub(crate) fn is_name(name: &str) -> bool {
    (1..=64).contains(&name.len()) && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.+".contains(&b))
}

impl Experiment {
    /// Reads an experiment and the text it was made from.
    ///
    /// # Errors
    /// [`Error::File`], and [`Error::Experiment`] with file, line and field.
    pub fn read(path: &Path) -> Result<(Self, toml::Table), Error> {
        let size = fs::metadata(path).map_err(Error::file("reading", path))?.len();
        if size > EXPERIMENT_BYTES_MAX {
            let problem = format!("the file has {size} bytes; at most {EXPERIMENT_BYTES_MAX} are read");
            return Err(Error::at(path.display().to_string(), problem));
        }
        let text = fs::read_to_string(path).map_err(Error::file("reading", path))?;
        Self::parse(&text, &path.display().to_string())
    }

    /// As [`Experiment::read`], from a text; `place` names it.
    ///
    /// # Errors
    /// [`Error::Experiment`] with line and field.
    pub fn parse(text: &str, place: &str) -> Result<(Self, toml::Table), Error> {
        let wrong = |error: toml::de::Error| Error::at(place, error.to_string().trim_end());
        let experiment: Self = toml::from_str(text).map_err(wrong)?;
        experiment.check(place)?;
        let table = toml::from_str(text).map_err(wrong)?;
        Ok((experiment, table))
    }

    /// From a document in which fields were set, by a case, a sweep or a command.
    ///
    /// # Errors
    /// [`Error::Experiment`] with the field.
    pub fn from_table(table: toml::Table, place: &str) -> Result<Self, Error> {
        let experiment: Self = toml::Value::Table(table)
            .try_into()
            .map_err(|error: toml::de::Error| Error::at(place, error.to_string().trim_end()))?;
        experiment.check(place)?;
        Ok(experiment)
    }

    /// The controller of a loop.
    pub(crate) fn controller_of<'a>(&'a self, plan: &'a LoopPlan) -> Option<&'a ControllerPlan> {
        plan.controller.as_ref().or(self.controller.as_ref())
    }
}

mod check;
mod strategy_name;

#[cfg(test)]
mod tests;
