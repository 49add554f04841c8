//! The commands that ask the API once and print its answer.
//!
//! Never: decide; what the cell refuses is an error with the cell's own words.

pub(crate) mod access;
pub(crate) mod alarms;
pub(crate) mod audit;
pub(crate) mod author;
pub(crate) mod backup;
pub(crate) mod ca;
pub(crate) mod components;
pub(crate) mod curves;
pub(crate) mod history;
pub(crate) mod hosts;
pub(crate) mod io;
pub(crate) mod jobs;
pub(crate) mod lab;
pub(crate) mod library;
pub(crate) mod loops;
pub(crate) mod past;
pub(crate) mod point_lists;
pub(crate) mod programs;
pub(crate) mod rollouts;
pub(crate) mod signing;
pub(crate) mod step;

/// Reads a loop file's text. `path` is for messages.
///
/// # Errors
/// [`crate::Error::Config`] with the place in the text.
pub fn loop_file(text: &str, path: &std::path::Path) -> Result<bumpless_api::types::LoopDraft, crate::Error> {
    loops::parse(text, path)
}
