//! The contract that a control law fulfils, and the values it is given.
//!
//! ```text
//!   start(parameters, track) ──► state ──► step ──► state' ──► step ──► …
//!                                  │ parameters change, same component and layout: retune
//!                                  │ another component, or an older layout:         adopt
//!                                  ▼
//!                                state of the new one; where it declines, the host calls start
//! ```
//! Never: keeps anything between calls outside the state.

use serde::{Serialize, de::DeserializeOwned};

use crate::{Cycle, Description, Fault, Io, Output, Parameter, envelope::Envelope};

/// A control law. The implementing type is only a name; everything that lasts is in [`Controller::State`].
pub trait Controller: 'static {
    /// What it says of itself.
    const DESCRIPTION: Description;

    /// What it remembers from one step to the next. Kept small: it travels with every record.
    type State: Serialize + DeserializeOwned;

    /// Makes a first state. `track` is what the actuators hold now: the first automatic output should equal it.
    ///
    /// The SDK has checked the number of values and each parameter's range; a rule between parameters is the law's to check
    /// ([`Fault::BadParameter`]).
    fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Self::State, Fault>;

    /// Computes one cycle. A step may run twice, anywhere; its writes count only when it returns `Ok`.
    fn step(state: &mut Self::State, parameters: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault>;

    /// Fits a state of this component and layout to new parameters, so that the output goes on without a bump.
    /// Keeps the state as it is where not written otherwise. An `Err` declines: the host then calls [`Controller::start`].
    fn retune(
        state: &mut Self::State,
        old: &Parameters<'_>,
        new: &Parameters<'_>,
        track: &Track<'_>,
    ) -> Result<(), Fault> {
        let _ = (state, old, new, track);
        Ok(())
    }

    /// Takes over a state of another component, or of another layout of this one. `Ok(None)` declines; so does an `Err`.
    /// Declines where not written otherwise.
    fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Option<Self::State>, Fault> {
        let _ = (from, parameters, track);
        Ok(None)
    }
}

/// The values of the parameters, read in place from the state bytes.
#[derive(Debug, Clone, Copy)]
pub struct Parameters<'a> {
    /// 8 bytes per value, little endian.
    bytes: &'a [u8],
}

impl<'a> Parameters<'a> {
    pub(crate) const fn over(bytes: &'a [u8]) -> Self {
        Self { bytes }
    }

    /// The value of a parameter, within its range. NaN for a handle from another, longer table.
    #[must_use]
    pub fn of(&self, parameter: Parameter) -> f64 {
        self.at(parameter.index).unwrap_or(f64::NAN)
    }

    /// The word's number where the parameter is a choice; a value between two words counts as the lower one.
    #[must_use]
    pub fn choice(&self, parameter: Parameter) -> usize {
        self.of(parameter) as usize
    }

    /// How many there are.
    #[must_use]
    pub const fn count(&self) -> usize {
        self.bytes.len() / 8
    }

    /// The value at a place of the table, or none beyond its end.
    #[must_use]
    pub fn at(&self, index: usize) -> Option<f64> {
        let from = index.checked_mul(8)?;
        let bytes = self.bytes.get(from..from.checked_add(8)?)?;
        bytes.try_into().ok().map(f64::from_le_bytes)
    }
}

/// What the actuators hold now, one value per output port.
#[derive(Debug, Clone, Copy)]
pub struct Track<'a> {
    values: &'a [f64],
}

impl<'a> Track<'a> {
    pub(crate) const fn over(values: &'a [f64]) -> Self {
        Self { values }
    }

    /// What the actuator of an output holds. The SDK has checked that there is one finite value per output;
    /// 0 for a handle from another, longer table.
    #[must_use]
    pub fn of(&self, output: Output) -> f64 {
        self.values.get(output.ordinal).copied().unwrap_or(0.0)
    }
}

/// A state that may be taken over, and who wrote it.
#[derive(Debug, Clone, Copy)]
pub struct Origin<'a> {
    /// Name of the component that wrote it.
    pub name: &'a str,
    /// Its version.
    pub version: &'a str,
    /// Its state layout.
    pub state_layout: u32,
    /// All of its bytes, as the component wrote them.
    pub bytes: &'a [u8],
}

impl<'a> Origin<'a> {
    /// The parameters and the law's state inside, where the writer used this SDK.
    ///
    /// Fails with [`Fault::BadState`] where it did not, or where the bytes and the origin's name and layout disagree.
    pub fn open(&self) -> Result<Envelope<'a>, Fault> {
        let envelope = Envelope::parse(self.bytes)?;
        if envelope.name == self.name.as_bytes() && envelope.layout == self.state_layout {
            Ok(envelope)
        } else {
            Err(Fault::bad_state(
                "the bytes name another component or layout than their origin does",
            ))
        }
    }

    /// The parameters and the typed state, where this component or another wrote them in the given layout; none where the
    /// origin is something else. One call per layout that is still out there makes an `adopt` that knows its past:
    ///
    /// ```
    /// # use bumpless_sdk::prelude::*;
    /// # use serde::{Deserialize, Serialize};
    /// #[derive(Deserialize)]
    /// struct Layout1 { sum: f64, cycles: u32 }
    /// #[derive(Serialize, Deserialize)]
    /// struct Layout2 { sum: f64, filtered: Option<f64> }
    ///
    /// fn adopt(from: &Origin<'_>) -> Result<Option<Layout2>, Fault> {
    ///     // `cycles` was dropped, `filtered` is new: it starts with the next measurement.
    ///     let known = from.state_of::<Layout1>("level", 1)?;
    ///     Ok(known.map(|(_, old)| Layout2 { sum: old.sum, filtered: None }))
    /// }
    /// ```
    ///
    /// Fails with [`Fault::BadState`] where the bytes are not what the origin says.
    pub fn state_of<T: DeserializeOwned>(&self, name: &str, layout: u32) -> Result<Option<(Parameters<'a>, T)>, Fault> {
        if self.name != name || self.state_layout != layout {
            return Ok(None);
        }
        let envelope = self.open()?;
        Ok(Some((envelope.parameters, envelope.law()?)))
    }
}
