//! What other hosts say: cycles' messages, deployment's, and the bus's keys.
//!
//! Never: a session.

#![allow(clippy::panic, clippy::expect_used, reason = "a target shows a fault by a panic")]

use bumpless_cell::{
    Vitals,
    keys::Keys,
    wire::{self, Letter, Token},
};
use bumpless_core::{
    CellName, Record,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};

/// A letter that was read stands on its own: it is written, and read again as the same.
fn letter<L: Letter>(bytes: &[u8]) {
    let Ok(letter) = wire::decode::<L>(bytes) else { return };
    let once = wire::encode(&letter).expect("what was read can be written");
    let again = wire::decode::<L>(&once).expect("what was written can be read");
    assert_eq!(
        wire::encode(&again).expect("and written"),
        once,
        "a {} changed",
        L::NAME
    );
}

/// Bytes as each kind of message that cycles send.
pub(crate) fn letters(bytes: &[u8]) {
    letter::<Sample>(bytes);
    letter::<Answer>(bytes);
    letter::<Record>(bytes);
    letter::<StepRequest>(bytes);
    letter::<StepAnswer>(bytes);
    letter::<Vitals>(bytes);
    letter::<Token>(bytes);
}

/// A key of the bus. One that is taken is built again as it was.
pub(crate) fn keys(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let keys = Keys::new(CellName::new("demo").expect("a good name"));
    if let Ok(key) = keys.parse(text) {
        assert_eq!(keys.build(&key), text);
    }
}

/// Bytes as each kind of message that deployment sends.
pub(crate) fn messages(bytes: &[u8]) {
    if let Err(what) = bumpless_deploy::parsers::message(bytes) {
        panic!("a {what} is another one when it is written and read again");
    }
}
