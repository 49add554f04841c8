//! What a plant is to whoever drives it: named signals, a time that goes on, values that are read and set.
//!
//! The simulated bus drives one in the host's time, the lab in a time of its own. Models of this crate are made by [`stock`];
//! a model that lives elsewhere (a component in the sandbox) comes through a [`ModelMaker`].
//!
//! Never: reads a clock. Same settings, seed, writes and times: same values, bit for bit.

use std::collections::BTreeMap;

use super::{Command, Fopdt, FopdtSettings, Instrument, Linear, LinearSettings, Plant, PlantSettings};
use crate::limits::PLANT_CATCH_UP_MS_MAX;

/// Which way a signal goes, seen from the plant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignalRole {
    /// An instrument shows it.
    Measures,
    /// A controller sets it.
    Sets,
    /// The world sets it: a load, a hand valve, a broken wire.
    Disturbs,
}

/// One named value of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Name, unique in the model: 1 to 32 lower-case letters, digits, dots and dashes.
    pub name: String,
    /// Which way it goes.
    pub role: SignalRole,
    /// Unit as text; empty for none.
    pub unit: String,
    /// Least value.
    pub low: f64,
    /// Greatest value.
    pub high: f64,
    /// Is it on or off?
    pub digital: bool,
    /// One line for people.
    pub text: String,
}

/// Why a model cannot go on, in words.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the plant's model stopped: {0}")]
pub struct Halted(pub String);

/// A plant in a time of its own, which begins at 0.
pub trait Model: Send + std::fmt::Debug {
    /// Its signals; a signal's position is its number.
    fn signals(&self) -> &[Signal];

    /// Brings the model to `to_ns` after its start. A time that has been is no error and changes nothing.
    ///
    /// # Errors
    /// [`Halted`] where the model fails for good.
    fn advance(&mut self, to_ns: u64) -> Result<(), Halted>;

    /// What a signal is, without noise; NaN for a number that does not exist.
    fn truth(&self, signal: usize) -> f64;

    /// What its instrument shows, in the signal's unit; NaN where it shows nothing. What was set, for all that are set.
    fn shown(&self, signal: usize) -> f64 {
        self.truth(signal)
    }

    /// Sets a signal; it acts from the present time on. A measurement cannot be set: that changes nothing.
    fn set(&mut self, signal: usize, value: f64);
}

/// Makes models that this crate does not have.
pub trait ModelMaker: Send + Sync {
    /// A model by what the engineer wrote, for example `component:cstr`, with constants that differ from their defaults.
    ///
    /// # Errors
    /// In words: what is wrong and what to do.
    fn make(&self, model: &str, constants: &BTreeMap<String, f64>, seed: u64) -> Result<Box<dyn Model>, String>;
}

/// For hosts that have no models besides those of this crate.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoModels;

impl ModelMaker for NoModels {
    fn make(&self, model: &str, _: &BTreeMap<String, f64>, _: u64) -> Result<Box<dyn Model>, String> {
        Err(format!("no model {model:?} can be made here"))
    }
}

/// A model of this crate, with its settings.
#[derive(Debug, Clone, PartialEq)]
pub enum Stock {
    /// The pilot plant.
    Pilot(PlantSettings),
    /// One first-order process with dead time, in % of span.
    Fopdt(FopdtSettings),
    /// A linear process.
    Linear(LinearSettings),
}

/// Makes a model of this crate.
///
/// # Errors
/// In words, where a setting makes no sense.
pub fn stock(stock: &Stock, seed: u64) -> Result<Box<dyn Model>, String> {
    Ok(match stock {
        Stock::Pilot(settings) => {
            settings.check()?;
            Box::new(PilotModel::new(*settings, seed))
        }
        Stock::Fopdt(settings) => {
            settings.check()?;
            Box::new(FopdtModel::new(settings, seed))
        }
        Stock::Linear(settings) => Box::new(Linear::new(settings)?),
    })
}

pub(crate) fn signal(name: &str, role: SignalRole, unit: &str, (low, high): (f64, f64), text: &str) -> Signal {
    Signal {
        name: name.to_owned(),
        role,
        unit: unit.to_owned(),
        low,
        high,
        digital: unit.is_empty() && low == 0.0 && high == 1.0,
        text: text.to_owned(),
    }
}

/// One first-order process: signals `pv`, `out`, `load`.
#[derive(Debug)]
struct FopdtModel {
    signals: Vec<Signal>,
    process: Fopdt,
    now_ns: u64,
    truth: f64,
    shown: f64,
}

impl FopdtModel {
    fn new(settings: &FopdtSettings, seed: u64) -> Self {
        let percent = (0.0, 100.0);
        Self {
            signals: vec![
                signal("pv", SignalRole::Measures, "%", percent, "measurement"),
                signal("out", SignalRole::Sets, "%", percent, "output"),
                signal(
                    "load",
                    SignalRole::Disturbs,
                    "%",
                    (-100.0, 100.0),
                    "load at the measurement's end",
                ),
            ],
            process: Fopdt::new(settings, seed, 0, 0),
            now_ns: 0,
            truth: 0.0,
            shown: 0.0,
        }
    }
}

impl Model for FopdtModel {
    fn signals(&self) -> &[Signal] {
        &self.signals
    }

    fn advance(&mut self, to_ns: u64) -> Result<(), Halted> {
        self.now_ns = self.now_ns.max(to_ns);
        self.shown = self.process.measured(self.now_ns);
        self.truth = self.process.value_at(self.now_ns);
        Ok(())
    }

    fn truth(&self, signal: usize) -> f64 {
        match signal {
            0 => self.truth,
            1 => self.process.output(),
            2 => self.process.load(),
            _ => f64::NAN,
        }
    }

    fn shown(&self, signal: usize) -> f64 {
        if signal == 0 { self.shown } else { self.truth(signal) }
    }

    fn set(&mut self, signal: usize, value: f64) {
        match signal {
            1 => self.process.set_output(value, self.now_ns),
            2 => self.process.set_load(value, self.now_ns),
            _ => {}
        }
    }
}

/// The pilot plant under the names that its bus gives.
#[derive(Debug)]
struct PilotModel {
    signals: Vec<Signal>,
    plant: Plant,
}

impl PilotModel {
    fn new(settings: PlantSettings, seed: u64) -> Self {
        let signals = super::driver::PLANT_POINTS
            .iter()
            .map(|(name, role, unit, low, high, text)| {
                let role = match role {
                    super::driver::Role::Measures(_) | super::driver::Role::LowLevel => SignalRole::Measures,
                    super::driver::Role::Sets(_) if *unit == "V" => SignalRole::Sets,
                    super::driver::Role::Sets(_) | super::driver::Role::Breaks(_) => SignalRole::Disturbs,
                };
                signal(name, role, unit, (*low, *high), text)
            })
            .collect();
        Self {
            signals,
            plant: Plant::new(settings, seed),
        }
    }

    fn role(signal: usize) -> Option<super::driver::Role> {
        super::driver::PLANT_POINTS.get(signal).map(|row| row.1)
    }

    fn set_value(&self, command: Command) -> f64 {
        self.plant.command(command)
    }
}

impl Model for PilotModel {
    fn signals(&self) -> &[Signal] {
        &self.signals
    }

    fn advance(&mut self, to_ns: u64) -> Result<(), Halted> {
        let due = to_ns / super::plant::STEP_NS;
        while self.plant.steps() < due {
            self.plant.step();
        }
        Ok(())
    }

    fn truth(&self, signal: usize) -> f64 {
        match Self::role(signal) {
            Some(super::driver::Role::Measures(instrument)) => self.plant.true_value(instrument),
            Some(super::driver::Role::LowLevel) => f64::from(u8::from(self.plant.tripped())),
            Some(super::driver::Role::Sets(command)) => self.set_value(command),
            Some(super::driver::Role::Breaks(instrument)) => f64::from(u8::from(self.plant.is_broken(instrument))),
            None => f64::NAN,
        }
    }

    fn shown(&self, signal: usize) -> f64 {
        match Self::role(signal) {
            Some(super::driver::Role::Measures(instrument)) => shown(&self.plant, instrument),
            _ => self.truth(signal),
        }
    }

    fn set(&mut self, signal: usize, value: f64) {
        match Self::role(signal) {
            Some(super::driver::Role::Sets(command)) => self.plant.set_command(command, value),
            Some(super::driver::Role::Breaks(instrument)) => self.plant.set_broken(instrument, value > 0.5),
            _ => {}
        }
    }
}

/// An instrument's value as the bus would give it; NaN where its current says that it failed.
fn shown(plant: &Plant, instrument: Instrument) -> f64 {
    let (low, high) = instrument.range();
    super::driver::measured(plant, instrument, low, high, 0)
        .value
        .unwrap_or(f64::NAN)
}

/// Longest stretch that a model in the host's time catches up after a pause, in ns.
pub(crate) const CATCH_UP_NS_MAX: u64 = PLANT_CATCH_UP_MS_MAX * 1_000_000;

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn stock_models_have_their_signals_and_move() {
        let mut pilot = stock(&Stock::Pilot(PlantSettings::default()), 1).unwrap();
        let number = |model: &dyn Model, name: &str| model.signals().iter().position(|s| s.name == name).unwrap();
        let (level, pump) = (number(&*pilot, "lit125"), number(&*pilot, "p2"));
        let before = pilot.truth(level);
        pilot.set(pump, 10.0);
        pilot.advance(60_000_000_000).unwrap();
        assert!(
            pilot.truth(level) > before + 1.0,
            "{} after {before}",
            pilot.truth(level)
        );
        assert_eq!(pilot.truth(pump), 10.0);
        assert!(pilot.truth(99).is_nan());

        let mut first = stock(&Stock::Fopdt(FopdtSettings::default()), 1).unwrap();
        first.set(1, 50.0);
        // A measurement cannot be set.
        first.set(0, 99.0);
        first.advance(20_000_000_000).unwrap();
        assert!((first.truth(0) - 50.0).abs() < 1e-6);
        assert_eq!(first.shown(1), 50.0);
    }

    #[test]
    fn a_broken_wire_shows_nothing() {
        let mut pilot = stock(&Stock::Pilot(PlantSettings::default()), 1).unwrap();
        let number = |name: &str| pilot.signals().iter().position(|s| s.name == name).unwrap();
        let (wire, level) = (number("lit125.break"), number("lit125"));
        assert!(pilot.shown(level).is_finite());
        pilot.set(wire, 1.0);
        assert!(pilot.shown(level).is_nan() && pilot.truth(level).is_finite());
    }

    #[test]
    fn settings_out_of_range_are_refused_in_words() {
        let bad = FopdtSettings {
            tau_s: 0.0,
            ..FopdtSettings::default()
        };
        assert_eq!(
            stock(&Stock::Fopdt(bad), 0).unwrap_err(),
            "fopdt.tau_s must be greater than 0 seconds"
        );
        let refused = NoModels.make("component:x", &BTreeMap::new(), 0).unwrap_err();
        assert!(refused.contains("component:x"), "{refused}");
    }
}
