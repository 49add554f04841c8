//! Components that mean harm: the table `tests/hostile/table.toml`, and the bytes of each.
//!
//! ```text
//! table.toml ─► Hostile ─┬─ rust  a crate of tests/guests
//!                        ├─ wat   a base law with one function replaced
//!                        ├─ text  a whole component as text
//!                        └─ made  bytes by a recipe of `bombs`
//! ```
//! Each has one expected end; the engine's tests, the end-to-end tests and `bench hostile` read the same table.
//! Never: runs one; whoever has an engine or a host does.

pub mod bombs;
mod guest;

use std::path::Path;

pub use guest::{Guest, componentize};
use serde::Deserialize;

use crate::Error;

/// How it must end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum End {
    /// The engine does not take it.
    Refused,
    /// It is taken, and its call ends in a fault.
    Faulted,
    /// It is taken, and what it does stays within bounds.
    Bounded,
    /// What its compilation may cost decides: refused for that, or as [`End::Bounded`].
    Either,
}

/// Which call of it misbehaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Call {
    /// Its first state.
    Start,
    /// A step.
    #[default]
    Step,
    /// Taking over a state.
    Migrate,
}

/// What a person is told of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Tells {
    /// The answer to its upload.
    Answer,
    /// The event `faulted` of a loop that runs it nevertheless.
    Faulted,
    /// A line of the log that counts what was dropped.
    Log,
    /// Nothing: it got nothing, and did no harm.
    Nothing,
}

/// Functions of the base law that are replaced.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Parts {
    describe: Option<String>,
    start: Option<String>,
    step: Option<String>,
    migrate: Option<String>,
    post: Option<String>,
    realloc: Option<String>,
    extra: Option<String>,
    start_section: Option<String>,
    out_name: Option<String>,
    pages: Option<u32>,
}

/// One that means harm.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Hostile {
    /// What it is called in this table.
    pub name: String,
    /// What it does, in a few words.
    pub does: String,
    rust: Option<String>,
    wat: Option<Parts>,
    text: Option<String>,
    made: Option<bombs::Recipe>,
    /// Its end in an engine.
    pub end: End,
    /// The call that misbehaves, where it is taken.
    #[serde(default)]
    pub call: Call,
    /// Calls until it has misbehaved, at most.
    #[serde(default = "one")]
    pub calls: u32,
    /// What the refusal or the fault says; `|` parts alternatives.
    #[serde(default)]
    words: String,
    /// What the refusal of its upload says, where that is something else.
    upload: Option<String>,
    /// Is its upload taken?
    #[serde(default)]
    pub comes_in: bool,
    /// What a person is told of it.
    pub event: Tells,
}

const fn one() -> u32 {
    1
}

#[derive(Deserialize)]
struct Table {
    guest: Vec<Hostile>,
}

/// The whole table, in its order.
///
/// # Errors
/// [`Error::Guest`] for a row that cannot be read, or that says nothing or too much about where it comes from.
pub fn table() -> Result<Vec<Hostile>, Error> {
    let table: Table = toml::from_str(include_str!("../hostile/table.toml"))
        .map_err(|error| Error::Guest(format!("tests/hostile/table.toml: {error}")))?;
    for guest in &table.guest {
        let sources = [
            guest.rust.is_some(),
            guest.wat.is_some(),
            guest.text.is_some(),
            guest.made.is_some(),
        ];
        if sources.iter().filter(|is| **is).count() != 1 {
            return Err(Error::Guest(format!(
                "tests/hostile/table.toml: {} needs one of rust, wat, text, made",
                guest.name
            )));
        }
    }
    Ok(table.guest)
}

impl Hostile {
    /// Its bytes. `components` is the folder that [`crate::components`] gives.
    ///
    /// # Errors
    /// [`Error::Guest`], [`Error::File`].
    pub fn bytes(&self, components: &Path) -> Result<Vec<u8>, Error> {
        let named = |error: Error| Error::Guest(format!("{}: {error}", self.name));
        if let Some(name) = &self.rust {
            let path = components.join(format!("guests/{name}.wasm"));
            return std::fs::read(&path).map_err(|source| Error::File {
                path,
                action: "read",
                source,
            });
        }
        if let Some(parts) = &self.wat {
            return self.guest(parts).encoded().map_err(named);
        }
        if let Some(text) = &self.text {
            return wat::parse_str(text).map_err(|error| Error::Guest(format!("{}: {error}", self.name)));
        }
        let recipe = self.made.ok_or_else(|| Error::Guest(self.name.clone()))?;
        recipe.bytes().map_err(named)
    }

    /// Does a refusal or a fault of an engine say what it must?
    #[must_use]
    pub fn is_told_by(&self, text: &str) -> bool {
        self.words.split('|').any(|words| text.contains(words))
    }

    /// Does the refusal of its upload say what it must?
    #[must_use]
    pub fn is_kept_out_by(&self, text: &str) -> bool {
        let words = self.upload.as_ref().unwrap_or(&self.words);
        words.split('|').any(|words| text.contains(words))
    }

    /// Is it made to cost its compiler, so that it takes seconds?
    #[must_use]
    pub const fn is_bomb(&self) -> bool {
        matches!(self.end, End::Either)
    }

    /// The names of its two ports.
    #[must_use]
    pub const fn ports(&self) -> (&'static str, &'static str) {
        if self.rust.is_some() {
            ("pv", "out")
        } else {
            ("in", "out")
        }
    }

    fn guest(&self, parts: &Parts) -> Guest {
        let good = Guest::good();
        let or = |part: &Option<String>, good: String| part.clone().unwrap_or(good);
        Guest {
            name: self.name.clone(),
            out_name: or(&parts.out_name, good.out_name),
            pages: parts.pages.unwrap_or(good.pages),
            start_section: or(&parts.start_section, good.start_section),
            describe: or(&parts.describe, good.describe),
            start: or(&parts.start, good.start),
            step: or(&parts.step, good.step),
            migrate: or(&parts.migrate, good.migrate),
            extra: or(&parts.extra, good.extra),
            post: or(&parts.post, good.post),
            realloc: or(&parts.realloc, good.realloc),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_row_has_a_name_of_its_own_and_says_what_must_happen() {
        let table = table().unwrap();
        assert!(table.len() >= 60, "{} rows", table.len());
        let names: BTreeSet<&str> = table.iter().map(|guest| guest.name.as_str()).collect();
        assert_eq!(names.len(), table.len());
        for guest in &table {
            let name = &guest.name;
            assert!(!guest.does.is_empty(), "{name}");
            assert_eq!(guest.end == End::Bounded, guest.words.is_empty(), "{name}");
            match guest.end {
                End::Refused | End::Either => assert!(!guest.comes_in && guest.event == Tells::Answer, "{name}"),
                End::Faulted => assert_eq!(guest.event, Tells::Faulted, "{name}"),
                End::Bounded => assert!(guest.comes_in || guest.upload.is_some(), "{name}"),
            }
        }
    }

    #[test]
    fn rows_become_components() {
        let nowhere = Path::new("nowhere");
        for guest in table().unwrap().iter().filter(|guest| guest.rust.is_none()) {
            assert!(
                guest.bytes(nowhere).is_ok(),
                "{}: {:?}",
                guest.name,
                guest.bytes(nowhere).err()
            );
        }
    }
}
