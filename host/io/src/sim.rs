//! Simulated buses: a pilot plant, or any number of first-order loops.
//!
//! `plant` and `fopdt` are pure models without a clock; `driver` gives them the clock's time and point names.

pub mod fopdt;
pub mod noise;
pub mod plant;

pub(crate) mod driver;

use std::path::PathBuf;

use bumpless_core::BusId;
use serde::{Deserialize, Serialize};

use crate::{
    Error,
    config::OnStop,
    limits::{DEAD_TIME_S_MAX, FOPDT_COUNT_MAX},
};

pub use fopdt::{Fopdt, FopdtSettings};
pub use plant::{Command, Instrument, Plant, PlantSettings};

/// A simulated bus. With a `fopdt` table it is a row of first-order loops, else the pilot plant.
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
    /// Settings of the pilot plant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plant: Option<PlantSettings>,
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
        if let Some(plant) = &self.plant {
            if !(8..=24).contains(&plant.adc_bits) {
                return wrong("plant.adc_bits must be 8 to 24");
            }
            if !(20.0..=80.0).contains(&plant.water_l) {
                return wrong("plant.water_l must be 20 to 80 litres: the tank below holds 83");
            }
            if !(0.0..=10.0).contains(&plant.noise) {
                return wrong("plant.noise must be 0 to 10; 1 is the noise of real instruments");
            }
        }
        if let Some(fopdt) = &self.fopdt {
            if !(1..=FOPDT_COUNT_MAX).contains(&fopdt.count) {
                return wrong(&format!("fopdt.count must be 1 to {FOPDT_COUNT_MAX}"));
            }
            if !(fopdt.gain.is_finite() && fopdt.gain != 0.0) {
                return wrong("fopdt.gain must be a number other than 0");
            }
            if !(fopdt.tau_s.is_finite() && fopdt.tau_s > 0.0) {
                return wrong("fopdt.tau_s must be greater than 0 seconds");
            }
            if !(0.0..=DEAD_TIME_S_MAX).contains(&fopdt.dead_time_s) {
                return wrong(&format!("fopdt.dead_time_s must be 0 to {DEAD_TIME_S_MAX} seconds"));
            }
            if !(fopdt.noise.is_finite() && fopdt.noise >= 0.0) {
                return wrong("fopdt.noise must be 0 or more");
            }
        }
        Ok(())
    }
}
