//! Simulated buses: a pilot plant, or any number of first-order loops.
//!
//! `plant`, `fopdt` and `linear` are pure models without a clock; `driver` gives them the clock's time and point names.
//! `model` is what they have in common, for whoever drives them in another time or brings a model of its own.

pub mod fopdt;
pub mod linear;
pub mod model;
pub mod noise;
pub mod plant;

pub(crate) mod driver;
mod pace;

use std::{collections::BTreeMap, path::PathBuf};

use bumpless_core::BusId;
use serde::{Deserialize, Serialize};

use crate::{Error, config::OnStop};

pub use fopdt::{Fopdt, FopdtSettings};
pub use linear::{Linear, LinearSettings};
pub use model::{Halted, Model, ModelMaker, NoModels, Signal, SignalRole, Stock};
pub use plant::{Command, Instrument, Plant, PlantSettings};

/// Shortest and longest step of a model that is a component, in ms: its thread wakes that often.
const STEP_MS_RANGE: (u64, u64) = (1, 1000);

/// Which plant: a model by name, or the pilot plant with these settings.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum PlantChoice {
    /// `component:NAME`, or `component:` and the path of a component file.
    Model(String),
    /// The pilot plant.
    Pilot(PlantSettings),
}

impl<'de> Deserialize<'de> for PlantChoice {
    /// By hand, so that a wrong key of the settings is named; an untagged enum only says that nothing fits.
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> serde::de::Visitor<'de> for Either {
            type Value = PlantChoice;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a model's name or a table of the pilot plant's settings")
            }

            fn visit_str<E>(self, name: &str) -> Result<PlantChoice, E> {
                Ok(PlantChoice::Model(name.to_owned()))
            }

            fn visit_map<A: serde::de::MapAccess<'de>>(self, map: A) -> Result<PlantChoice, A::Error> {
                PlantSettings::deserialize(serde::de::value::MapAccessDeserializer::new(map)).map(PlantChoice::Pilot)
            }
        }
        deserializer.deserialize_any(Either)
    }
}

/// A simulated bus. With a `fopdt` table it is a row of first-order loops, else the pilot plant or the model that it names.
///
/// ```toml
/// [[bus]]
/// id = "plant"
/// driver = "sim"
/// seed = 7
/// on_stop = "safe"
/// journal = "writes.csv"
/// plant = { adc_bits = 12, water_l = 60.0 }
/// ```
///
/// ```toml
/// [[bus]]
/// id = "bench"
/// driver = "sim"
/// fopdt = { count = 5000, gain = 1.0, tau_s = 2.0, dead_time_s = 0.2, noise = 0.05 }
/// ```
///
/// ```toml
/// [[bus]]
/// id = "tanks"
/// driver = "sim"
/// plant = "component:quadruple-tank"
/// constants = { gamma1 = 0.43, gamma2 = 0.34 }
/// step_ms = 20
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimConfig {
    /// The bus's name; its points are named `<id>.<point>`.
    pub id: BusId,
    /// Start of all noise. Same seed, writes and times: same readings.
    #[serde(default)]
    pub seed: u64,
    /// What the outputs do when the host stops; safe is 0 for each of them.
    #[serde(default)]
    pub on_stop: OnStop,
    /// File for the actuators' own log; replaced at the start.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub journal: Option<PathBuf>,
    /// Settings of the pilot plant, or the name of a model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plant: Option<PlantChoice>,
    /// Constants of a model that is named, where they differ from their defaults.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub constants: BTreeMap<String, f64>,
    /// Time between two steps of a model that is named, in ms: 1 to 1,000; 10 where not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub step_ms: Option<u64>,
    /// Settings of the first-order loops, instead of the plant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fopdt: Option<FopdtSettings>,
}

impl SimConfig {
    /// A pilot plant with all defaults.
    #[must_use]
    pub const fn pilot_plant(id: BusId) -> Self {
        Self {
            id,
            seed: 0,
            on_stop: OnStop::Hold,
            journal: None,
            plant: None,
            constants: BTreeMap::new(),
            step_ms: None,
            fopdt: None,
        }
    }

    /// A row of first-order loops.
    #[must_use]
    pub const fn first_order(id: BusId, settings: FopdtSettings) -> Self {
        Self {
            id,
            seed: 0,
            on_stop: OnStop::Hold,
            journal: None,
            plant: None,
            constants: BTreeMap::new(),
            step_ms: None,
            fopdt: Some(settings),
        }
    }

    /// Checks the numbers.
    pub(crate) fn check(&self) -> Result<(), Error> {
        let place = || format!("bus {:?}", self.id);
        let wrong = |problem: &str| Err(Error::config(place(), problem));
        if self.plant.is_some() && self.fopdt.is_some() {
            return wrong("plant and fopdt exclude each other; keep one of them or make two buses");
        }
        let named = matches!(self.plant, Some(PlantChoice::Model(_)));
        if !named && (self.step_ms.is_some() || !self.constants.is_empty()) {
            return wrong(
                "constants and step_ms belong to a model; write plant = \"component:NAME\" or leave them out",
            );
        }
        let (least, most) = STEP_MS_RANGE;
        if self.step_ms.is_some_and(|ms| !(least..=most).contains(&ms)) {
            return wrong(&format!("step_ms must be {least} to {most}"));
        }
        if let Some(PlantChoice::Pilot(plant)) = &self.plant {
            plant.check().or_else(|problem| wrong(&problem))?;
        }
        if let Some(fopdt) = &self.fopdt {
            fopdt.check().or_else(|problem| wrong(&problem))?;
        }
        Ok(())
    }
}
