//! Between the component model's calls and a [`Controller`]. The test bench takes the same way, so that a native test sees
//! what the sandbox will see.
//!
//! Never: arithmetic of a law.

use std::marker::PhantomData;

use crate::{
    Controller, Cycle, Direction, Fault, Io, Kind, Origin, Parameters, Track,
    bindings::exports::bumpless::control::control as wit,
    envelope::{self, Envelope},
    io::Host,
};

/// The bytes of a text as an array, while compiling.
#[must_use]
#[allow(
    clippy::indexing_slicing,
    reason = "both are looked at before; slices have no `get` while compiling"
)]
pub const fn bytes_of<const N: usize>(text: &str) -> [u8; N] {
    let (from, mut bytes, mut at) = (text.as_bytes(), [0; N], 0);
    while at < N && at < from.len() {
        bytes[at] = from[at];
        at += 1;
    }
    bytes
}

/// Gives a [`Controller`] the exports of the world.
#[derive(Debug)]
pub struct Glue<C>(PhantomData<C>);

#[cfg(target_arch = "wasm32")]
impl<C: Controller> wit::Guest for Glue<C> {
    fn describe() -> wit::Descriptor {
        describe::<C>()
    }

    fn start(parameters: Vec<f64>, track: Vec<f64>) -> Result<Vec<u8>, Fault> {
        start::<C>(&parameters, &track)
    }

    fn step(cycle: Cycle, state: Vec<u8>) -> Result<Vec<u8>, Fault> {
        step::<C>(&cycle, state, &mut crate::imports::Imports)
    }

    fn migrate(from: wit::Origin, state: Vec<u8>, parameters: Vec<f64>, track: Vec<f64>) -> Result<Vec<u8>, Fault> {
        let origin = Origin {
            name: &from.name,
            version: &from.version,
            state_layout: from.state_layout,
            bytes: &state,
        };
        migrate::<C>(&origin, &parameters, &track)
    }
}

/// The description in the form of the interface.
#[must_use]
pub fn describe<C: Controller>() -> wit::Descriptor {
    let d = &C::DESCRIPTION;
    wit::Descriptor {
        name: d.name.to_owned(),
        version: d.version.to_owned(),
        text: d.text.to_owned(),
        ports: d
            .ports
            .iter()
            .map(|p| wit::Port {
                name: p.name.to_owned(),
                direction: match p.direction {
                    Direction::Input => wit::Direction::Input,
                    Direction::Output => wit::Direction::Output,
                },
                kind: match p.kind {
                    Kind::Analog => wit::Kind::Analog,
                    Kind::Digital => wit::Kind::Digital,
                },
                unit: p.unit.to_owned(),
                required: p.required,
                text: p.text.to_owned(),
            })
            .collect(),
        parameters: d
            .parameters
            .iter()
            .map(|p| wit::Parameter {
                name: p.name.to_owned(),
                unit: p.unit.to_owned(),
                default: p.default,
                minimum: p.minimum,
                maximum: p.maximum,
                choices: p.choices.iter().map(|&c| c.to_owned()).collect(),
                text: p.text.to_owned(),
            })
            .collect(),
        state_layout: d.state_layout,
    }
}

/// The number of values and each range; what the law may rely on. The host has checked too, but a component that is run
/// elsewhere must stand on its own.
fn check<C: Controller>(parameters: &[f64], track: &[f64]) -> Result<(), Fault> {
    let d = &C::DESCRIPTION;
    if parameters.len() != d.parameters.len() {
        return Err(Fault::bad_parameter("one value per parameter is needed"));
    }
    for (spec, value) in d.parameters.iter().zip(parameters) {
        if !(spec.minimum..=spec.maximum).contains(value) {
            let mut text = String::from(spec.name);
            text.push_str(" is out of its range");
            return Err(Fault::BadParameter(text));
        }
    }
    if track.len() != d.output_count() || !track.iter().all(|v| v.is_finite()) {
        return Err(Fault::bad_parameter("track needs one finite value per output port"));
    }
    Ok(())
}

/// `start` of the world.
pub fn start<C: Controller>(parameters: &[f64], track: &[f64]) -> Result<Vec<u8>, Fault> {
    check::<C>(parameters, track)?;
    let front = envelope::front(&C::DESCRIPTION, parameters);
    let law = C::start(&Envelope::parse(&front)?.parameters, &Track::over(track))?;
    envelope::close(front, &law)
}

/// `step` of the world. The front of the state is kept in place; only the law's part is decoded and encoded.
pub fn step<C: Controller>(cycle: &Cycle, mut bytes: Vec<u8>, host: &mut Host) -> Result<Vec<u8>, Fault> {
    let (law_offset, law) = {
        let envelope = Envelope::parse(&bytes)?;
        if !envelope.is_of(&C::DESCRIPTION) {
            return Err(Fault::bad_state("the state belongs to another component or layout"));
        }
        let mut law: C::State = envelope.law()?;
        C::step(
            &mut law,
            &envelope.parameters,
            cycle,
            &mut Io::new(host, cycle.connected),
        )?;
        (envelope.law_offset(), law)
    };
    bytes.truncate(law_offset);
    envelope::close(bytes, &law)
}

/// `migrate` of the world: `retune` for a state of the same component and layout, else `adopt`.
pub fn migrate<C: Controller>(from: &Origin<'_>, parameters: &[f64], track: &[f64]) -> Result<Vec<u8>, Fault> {
    check::<C>(parameters, track)?;
    let track = Track::over(track);
    let front = envelope::front(&C::DESCRIPTION, parameters);
    let new: Parameters<'_> = Envelope::parse(&front)?.parameters;
    let law = match from.open() {
        Ok(old) if old.is_of(&C::DESCRIPTION) => {
            let mut law = old.law()?;
            C::retune(&mut law, &old.parameters, &new, &track)?;
            law
        }
        _ => {
            C::adopt(from, &new, &track)?.ok_or_else(|| Fault::bad_state("a state of this origin is not taken over"))?
        }
    };
    envelope::close(front, &law)
}
