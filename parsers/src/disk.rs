//! What a disk gave back: rows, chunks, history, terms; and bundles, which come as files.
//!
//! Never: a file; all of it is bytes.

#![allow(clippy::panic, reason = "a target shows a fault by a panic")]

use bumpless_store::parsers;

/// A bundle of components.
pub(crate) fn bundle(bytes: &[u8]) {
    let _whole = bumpless_deploy::parsers::bundle(bytes);
}

/// A row, as each type that rows are of.
pub(crate) fn row(bytes: &[u8]) {
    if let Err(name) = parsers::row(bytes) {
        panic!("a {name} is another one when it is written and read again");
    }
    let _term = parsers::terms(bytes);
}

/// A chunk as it is, and one whose check is good.
pub(crate) fn cycles(bytes: &[u8]) {
    let _as_it_is = parsers::cycles(bytes, false);
    let _sealed = parsers::cycles(bytes, true);
}

/// A file of the history.
pub(crate) fn history(bytes: &[u8]) {
    let _frames = parsers::history_file(bytes);
}

/// What is in the history's frames.
pub(crate) fn history_block(bytes: &[u8]) {
    let _block = parsers::history_block_of(bytes);
    let _entry = parsers::history_entry(bytes);
}
