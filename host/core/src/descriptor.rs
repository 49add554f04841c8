//! What a component says of itself, and the checks that make it trustworthy.
//!
//! Never: believes a guest; `Descriptor::check` bounds and names everything that is wrong.

use serde::{Deserialize, Serialize};

use crate::limits::{PARAMETERS_MAX, PORTS_MAX, TEXT_CHARS_MAX};

/// Which way a port's values flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Direction {
    /// From the process to the controller.
    Input,
    /// From the controller to the process.
    Output,
}

/// What kind of number a port carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PortKind {
    /// A quantity in the port's unit.
    Analog,
    /// 0 is off, anything else is on.
    Digital,
}

/// One named value that a component reads or writes; its position is its number.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PortSpec {
    /// Short name.
    pub name: String,
    /// Which way.
    pub direction: Direction,
    /// What its numbers mean.
    pub kind: PortKind,
    /// Unit as text; empty for none.
    pub unit: String,
    /// Must a loop connect it?
    pub required: bool,
    /// One line for people.
    pub text: String,
}

/// One named number that tunes a component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterSpec {
    /// Short name.
    pub name: String,
    /// Unit as text; empty for none.
    pub unit: String,
    /// Value where the loop sets none.
    pub default: f64,
    /// Least value allowed.
    pub minimum: f64,
    /// Greatest value allowed.
    pub maximum: f64,
    /// Words of a choice; empty for a plain number.
    pub choices: Vec<String>,
    /// One line for people.
    pub text: String,
}

/// Everything a host needs to know before it runs a component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Descriptor {
    /// Name of the algorithm.
    pub name: String,
    /// Semantic version of the algorithm.
    pub version: String,
    /// One line for people.
    pub text: String,
    /// Ports, by number.
    pub ports: Vec<PortSpec>,
    /// Parameters, in the order in which values are given.
    pub parameters: Vec<ParameterSpec>,
    /// Version of the layout of the state bytes.
    pub state_layout: u32,
}

/// What is wrong with a descriptor, or with values given for it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DescriptorError {
    /// A name that is empty, too long, or has other characters.
    #[error("{what} {name:?}: use 1 to 32 lower-case letters, digits and dashes")]
    Name {
        /// "component name", "port" or "parameter".
        what: &'static str,
        /// The text, cut to 64 characters.
        name: String,
    },
    /// Not `major.minor.patch`.
    #[error("version {0:?}: use three numbers, for example \"1.0.0\"")]
    Version(String),
    /// Two ports or two parameters share a name.
    #[error("{what} {name:?} is described twice")]
    Twice {
        /// "port" or "parameter".
        what: &'static str,
        /// The name.
        name: String,
    },
    /// More than the limit.
    #[error("{count} {what}s are described; at most {max} are allowed")]
    TooMany {
        /// "port" or "parameter".
        what: &'static str,
        /// How many.
        count: usize,
        /// How many are allowed.
        max: usize,
    },
    /// A text over the limit.
    #[error("the text of {0} is longer than {TEXT_CHARS_MAX} characters")]
    TextTooLong(String),
    /// A controller that moves nothing.
    #[error("no output port is described; a controller needs at least one")]
    NoOutput,
    /// A range that holds no value, or a default outside it.
    #[error(
        "parameter {name:?}: {minimum} <= default {default} <= {maximum} does not hold, or one of them is not finite"
    )]
    Range {
        /// The parameter.
        name: String,
        /// Its least value.
        minimum: f64,
        /// Its default.
        default: f64,
        /// Its greatest value.
        maximum: f64,
    },
    /// A value was given for a parameter that does not exist.
    #[error("{component} has no parameter {name:?}; it has {known}")]
    UnknownParameter {
        /// The component's name.
        component: String,
        /// The name given.
        name: String,
        /// The names that exist.
        known: String,
    },
    /// A value outside the parameter's range.
    #[error("parameter {name:?} = {value} {unit} is outside {minimum} to {maximum}")]
    OutOfRange {
        /// The parameter.
        name: String,
        /// The value given.
        value: f64,
        /// The parameter's unit.
        unit: String,
        /// Its least value.
        minimum: f64,
        /// Its greatest value.
        maximum: f64,
    },
}

/// 1 to 32 lower-case letters, digits and dashes.
fn short_name(what: &'static str, name: &str) -> Result<(), DescriptorError> {
    let ok = (1..=32).contains(&name.len())
        && name
            .bytes()
            .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
    if ok {
        Ok(())
    } else {
        Err(DescriptorError::Name {
            what,
            name: name.chars().take(64).collect(),
        })
    }
}

fn unique<'a>(what: &'static str, names: impl Iterator<Item = &'a str>, dots: bool) -> Result<(), DescriptorError> {
    let mut seen = std::collections::HashSet::new();
    for name in names {
        if dots {
            short_name(what, &name.replace('.', "-"))?;
        } else {
            short_name(what, name)?;
        }
        if !seen.insert(name) {
            return Err(DescriptorError::Twice {
                what,
                name: name.to_owned(),
            });
        }
    }
    Ok(())
}

impl Descriptor {
    /// Checks everything that a guest may have got wrong or lied about: names, numbers, ranges, lengths.
    pub fn check(&self) -> Result<(), DescriptorError> {
        self.check_parts(false)?;
        if self.outputs().next().is_none() {
            return Err(DescriptorError::NoOutput);
        }
        Ok(())
    }

    /// As [`Descriptor::check`], for a plant: its ports are its signals, seen from a controller. Their names may have dots,
    /// and none of them need be one that a controller sets.
    ///
    /// # Errors
    /// As [`Descriptor::check`].
    pub fn check_plant(&self) -> Result<(), DescriptorError> {
        self.check_parts(true)
    }

    /// As [`Descriptor::check`], for a free-running program, which has neither ports nor parameters.
    ///
    /// # Errors
    /// As [`Descriptor::check`].
    pub fn check_program(&self) -> Result<(), DescriptorError> {
        self.check_parts(false)
    }

    fn check_parts(&self, dots: bool) -> Result<(), DescriptorError> {
        short_name("component name", &self.name)?;
        let version_parts: Vec<&str> = self.version.split('.').collect();
        let number = |p: &&str| (1..=6).contains(&p.len()) && p.bytes().all(|b| b.is_ascii_digit());
        if version_parts.len() != 3 || !version_parts.iter().all(number) {
            return Err(DescriptorError::Version(self.version.chars().take(64).collect()));
        }
        let too_many = |what, count, max| {
            if count > max {
                Err(DescriptorError::TooMany { what, count, max })
            } else {
                Ok(())
            }
        };
        too_many("port", self.ports.len(), PORTS_MAX)?;
        too_many("parameter", self.parameters.len(), PARAMETERS_MAX)?;
        unique("port", self.ports.iter().map(|p| p.name.as_str()), dots)?;
        unique("parameter", self.parameters.iter().map(|p| p.name.as_str()), false)?;
        let texts = std::iter::once((&self.name, &self.text))
            .chain(self.ports.iter().flat_map(|p| [(&p.name, &p.text), (&p.name, &p.unit)]))
            .chain(
                self.parameters
                    .iter()
                    .flat_map(|p| [(&p.name, &p.text), (&p.name, &p.unit)]),
            )
            .chain(
                self.parameters
                    .iter()
                    .flat_map(|p| p.choices.iter().map(move |c| (&p.name, c))),
            );
        for (owner, text) in texts {
            if text.chars().count() > TEXT_CHARS_MAX {
                return Err(DescriptorError::TextTooLong(owner.clone()));
            }
        }
        for p in &self.parameters {
            too_many("choice", p.choices.len(), PARAMETERS_MAX)?;
            let finite = p.minimum.is_finite() && p.default.is_finite() && p.maximum.is_finite();
            if !(finite && p.minimum <= p.default && p.default <= p.maximum) {
                return Err(DescriptorError::Range {
                    name: p.name.clone(),
                    minimum: p.minimum,
                    default: p.default,
                    maximum: p.maximum,
                });
            }
        }
        Ok(())
    }

    /// The output ports with their numbers, in order.
    pub fn outputs(&self) -> impl Iterator<Item = (usize, &PortSpec)> {
        self.ports
            .iter()
            .enumerate()
            .filter(|(_, p)| p.direction == Direction::Output)
    }

    /// The number of a port.
    #[must_use]
    pub fn port(&self, name: &str) -> Option<usize> {
        self.ports.iter().position(|p| p.name == name)
    }

    /// One value per parameter in the descriptor's order: those given by name, defaults for the rest.
    pub fn parameter_values<'a>(
        &self,
        given: impl IntoIterator<Item = (&'a str, f64)>,
    ) -> Result<Vec<f64>, DescriptorError> {
        let mut values: Vec<f64> = self.parameters.iter().map(|p| p.default).collect();
        for (name, value) in given {
            let Some(index) = self.parameters.iter().position(|p| p.name == name) else {
                return Err(DescriptorError::UnknownParameter {
                    component: self.name.clone(),
                    name: name.chars().take(64).collect(),
                    known: self
                        .parameters
                        .iter()
                        .map(|p| p.name.as_str())
                        .collect::<Vec<_>>()
                        .join(", "),
                });
            };
            let p = &self.parameters[index];
            if !(p.minimum..=p.maximum).contains(&value) {
                return Err(DescriptorError::OutOfRange {
                    name: p.name.clone(),
                    value,
                    unit: p.unit.clone(),
                    minimum: p.minimum,
                    maximum: p.maximum,
                });
            }
            values[index] = value;
        }
        Ok(values)
    }
}
