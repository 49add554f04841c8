//! The envelope of every message: one byte of version, then the message in postcard's encoding.
//!
//! Owns: versions, size limits, and the checks that bytes from outside pass before anyone sees them as a message.
//! Never: panics on any bytes; knows of Zenoh.
//!
//! ```text
//! byte 0      version, now 3; the message's kind is in its key
//! byte 1..    postcard (variable-length integers, no field names)
//! ```
//!
//! A change of any message's shape is a new version. A host reads only its own version: hosts of a cell are updated
//! together, and an old one says so instead of misreading.

use bumpless_core::{
    Record,
    limits::{PORTS_MAX, REPLICAS_MAX, STATE_BYTES_MAX},
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};
use serde::{Serialize, de::DeserializeOwned};

use crate::{
    error::Error,
    limits::{CYCLE_BYTES_MAX, PING_BYTES_MAX, VITALS_BYTES_MAX},
    vitals::Vitals,
};

/// The version that this host writes and reads.
pub const VERSION: u8 = 3;

/// What can be sent. The bound and the checks of each message stand beside its name.
pub trait Letter: Serialize + DeserializeOwned {
    /// For people.
    const NAME: &'static str;
    /// Largest size with its version, in bytes.
    const BYTES_MAX: usize;

    /// What the encoding cannot say: the first bound of the core that the message passes.
    ///
    /// # Errors
    /// The bound, in words.
    fn check(&self) -> Result<(), String> {
        Ok(())
    }
}

impl Letter for Sample {
    const NAME: &'static str = "sample";
    const BYTES_MAX: usize = CYCLE_BYTES_MAX;
    fn check(&self) -> Result<(), String> {
        at_most("readings", self.readings.len(), PORTS_MAX)?;
        at_most(
            "next readings",
            self.next_readings.as_ref().map_or(0, |(_, next)| next.len()),
            PORTS_MAX,
        )?;
        self.resume.as_deref().map_or(Ok(()), Letter::check)
    }
}

impl Letter for Answer {
    const NAME: &'static str = "answer";
    const BYTES_MAX: usize = CYCLE_BYTES_MAX;
    fn check(&self) -> Result<(), String> {
        match self {
            Self::Commit(record) => record.check(),
            Self::NeedRecord { .. } | Self::Decline { .. } | Self::Held { .. } => Ok(()),
        }
    }
}

impl Letter for Record {
    const NAME: &'static str = "record";
    const BYTES_MAX: usize = CYCLE_BYTES_MAX;
    fn check(&self) -> Result<(), String> {
        at_most("readings", self.readings.len(), PORTS_MAX)?;
        at_most("outputs", self.outputs.len(), PORTS_MAX)?;
        at_most("wanted outputs", self.wanted.len(), PORTS_MAX)?;
        at_most("manual outputs", self.manual.len(), PORTS_MAX)?;
        let aside = self.redundancy.vote.as_ref().map_or(0, |vote| vote.aside.len());
        at_most("replicas without a vote", aside, REPLICAS_MAX)?;
        at_most("bytes of state", self.state.len(), STATE_BYTES_MAX)
    }
}

impl Letter for StepRequest {
    const NAME: &'static str = "step request";
    const BYTES_MAX: usize = CYCLE_BYTES_MAX;
    fn check(&self) -> Result<(), String> {
        at_most("readings", self.frame.readings.len(), PORTS_MAX)?;
        at_most("bytes of state", self.state.len(), STATE_BYTES_MAX)
    }
}

impl Letter for StepAnswer {
    const NAME: &'static str = "step answer";
    const BYTES_MAX: usize = CYCLE_BYTES_MAX;
    fn check(&self) -> Result<(), String> {
        let Ok(effects) = &self.result else { return Ok(()) };
        at_most("writes", effects.writes.len(), PORTS_MAX)?;
        at_most("bytes of state", effects.state.len(), STATE_BYTES_MAX)
    }
}

impl Letter for Vitals {
    const NAME: &'static str = "vitals message";
    const BYTES_MAX: usize = VITALS_BYTES_MAX;
}

/// The number of a ping, and of its pong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, serde::Deserialize)]
pub struct Token(pub u64);

impl Letter for Token {
    const NAME: &'static str = "ping or pong";
    const BYTES_MAX: usize = PING_BYTES_MAX;
}

fn at_most(what: &str, found: usize, limit: usize) -> Result<(), String> {
    if found > limit {
        Err(format!("it has {found} {what}, at most {limit} are allowed"))
    } else {
        Ok(())
    }
}

/// Puts a message in its envelope.
///
/// # Errors
/// [`Error::Unencodable`] where it passes a bound of the core, [`Error::TooLarge`] where the lane does not carry it.
pub fn encode<L: Letter>(letter: &L) -> Result<Vec<u8>, Error> {
    let unencodable = |reason: String| Error::Unencodable { what: L::NAME, reason };
    letter.check().map_err(unencodable)?;
    // Most messages are a few hundred bytes: one allocation serves them.
    let mut bytes = Vec::with_capacity(512);
    bytes.push(VERSION);
    let bytes = postcard::to_extend(letter, bytes).map_err(|error| unencodable(error.to_string()))?;
    fits::<L>(bytes.len())?;
    Ok(bytes)
}

/// The message's size is looked at before its bytes are.
///
/// # Errors
/// [`Error::TooLarge`].
pub fn fits<L: Letter>(bytes: usize) -> Result<(), Error> {
    if bytes > L::BYTES_MAX {
        Err(Error::TooLarge {
            what: L::NAME,
            bytes,
            limit: L::BYTES_MAX,
        })
    } else {
        Ok(())
    }
}

/// Takes a message out of its envelope.
///
/// # Errors
/// [`Error::TooLarge`], [`Error::Version`], or [`Error::Undecodable`] for anything that is not exactly one good message.
pub fn decode<L: Letter>(bytes: &[u8]) -> Result<L, Error> {
    fits::<L>(bytes.len())?;
    let undecodable = |reason: String| Error::Undecodable {
        what: L::NAME,
        bytes: bytes.len(),
        reason,
    };
    let (&found, body) = bytes
        .split_first()
        .ok_or_else(|| undecodable("it is empty".to_owned()))?;
    if found != VERSION {
        return Err(Error::Version {
            what: L::NAME,
            found,
            spoken: VERSION,
        });
    }
    let (letter, rest) = postcard::take_from_bytes::<L>(body).map_err(|error| undecodable(error.to_string()))?;
    if !rest.is_empty() {
        return Err(undecodable(format!("{} bytes are left over", rest.len())));
    }
    letter.check().map_err(undecodable)?;
    Ok(letter)
}

#[cfg(test)]
mod tests;
