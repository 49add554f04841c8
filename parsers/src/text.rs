//! What people write: configurations, point lists, loops, experiments; and the lines of an audit trail, which anybody may hand in.
//!
//! Never: opens a file that a text names.

#![allow(clippy::expect_used, reason = "a target shows a fault by a panic")]

use std::path::Path;

use bumpless_core::{Digest, HostId, audit};

fn text(bytes: &[u8]) -> Option<&str> {
    std::str::from_utf8(bytes).ok()
}

/// A point list. One that is taken is written, and read again as the same.
pub(crate) fn point_list(bytes: &[u8]) {
    let Some(points) = text(bytes).and_then(|text| bumpless_io::point_list::read(text).ok()) else {
        return;
    };
    let once = bumpless_io::point_list::write(&points).expect("what was read can be written");
    let again = bumpless_io::point_list::read(&once).expect("what was written can be read");
    assert_eq!(bumpless_io::point_list::write(&again).expect("and written"), once);
}

/// A configuration. What is wrong with it has words.
pub(crate) fn config(bytes: &[u8]) {
    let Some(text) = text(bytes) else { return };
    if let Err(error) = bumpless_app::Config::parse(text, Path::new("host.toml")) {
        assert!(!error.to_string().is_empty());
    }
}

/// A loop, as the API and as a file has it.
pub(crate) fn loop_file(bytes: &[u8]) {
    let _from_json = serde_json::from_slice::<bumpless_deploy::LoopDraft>(bytes);
    if let Some(text) = text(bytes) {
        let _from_file = bumpless_app::loop_file(text, Path::new("loop.toml"));
    }
}

/// An experiment.
pub(crate) fn experiment(bytes: &[u8]) {
    let Some(text) = text(bytes) else { return };
    let _experiment = bumpless_lab::Experiment::parse(text, "experiment.toml");
}

/// Lines of a trail; and the first of them as the text of an entry, which must then be one.
pub(crate) fn audit(bytes: &[u8]) {
    let Some(text) = text(bytes) else { return };
    let mut checker = audit::Checker::default();
    for line in text.lines() {
        let _misfit = checker.look(line);
    }
    let _closed = checker.closed();
    let host = HostId::new("a").expect("a good name");
    let said = text.lines().next().unwrap_or_default();
    if let Ok((line, link)) = audit::bind(&host, 1, Digest::of(b""), said) {
        assert_eq!(audit::read(&line).as_ref(), Ok(&link), "{line}");
    }
}
