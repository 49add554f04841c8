//! What other hosts and people's files say, read as this room reads it, without a host: for fuzzers.
//!
//! Owns: nothing; each function hands bytes to the reader that deployment itself uses. Never: acts on what it read. None of it
//! panics, whatever the bytes are; that is what it is here to show.

use serde::{Serialize, de::DeserializeOwned};

use crate::{
    bundle,
    wire::{self, Ask, Notice},
};

fn round_trip<T: Serialize + DeserializeOwned>(what: &'static str, bytes: &[u8]) -> Result<bool, &'static str> {
    let Ok(value) = wire::decode::<T>(what, bytes) else {
        return Ok(false);
    };
    let once = wire::encode(&value).map_err(|_| what)?;
    let again = wire::decode::<T>(what, &once).map_err(|_| what)?;
    if wire::encode(&again).map_err(|_| what)? == once {
        Ok(true)
    } else {
        Err(what)
    }
}

/// A message between hosts: a question, a notice or a reply. Is it one?
///
/// # Errors
/// What was read, but is something else once it is written again.
pub fn message(bytes: &[u8]) -> Result<bool, &'static str> {
    let question = round_trip::<Ask>("question", bytes)?;
    let notice = round_trip::<Notice>("notice", bytes)?;
    Ok(question || notice || wire::decode_reply(bytes.to_vec()).is_ok())
}

/// A bundle of components. Gives how many whole ones are in it; none where it is no bundle.
#[must_use]
pub fn bundle(bytes: &[u8]) -> Option<usize> {
    let entries = bundle::unpack(bytes).ok()?;
    Some(entries.iter().filter(|(_, parcel)| parcel.is_ok()).count())
}
