//! What a cell knows of an uploaded component beside its bytes.
//!
//! Owns: the summary that travels and is kept under the component's digest, its labels, its history, and which of two
//! copies is the newer. Never: the bytes, and never trust in them: the descriptor was checked when the component was
//! admitted.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{
    admission::{Admission, AdmissionError},
    descriptor::{Descriptor, DescriptorError},
    digest::Digest,
    limits::{COMPONENT_BYTES_MAX, TEXT_CHARS_MAX},
};

/// Imports that an info lists at most. A component with more is no controller; the list is for people.
pub const IMPORTS_MAX: usize = 64;

/// Labels of one component: they are shown in every list.
pub const LABELS_MAX: usize = 16;

/// Characters of a label's key, and of its value.
pub const LABEL_CHARS_MAX: usize = 64;

/// Changes of a component's summary that are remembered, the newest last.
pub const HISTORY_MAX: usize = 16;

/// The world of a controller: what a loop runs.
pub const CONTROLLER_WORLD: &str = "bumpless:control/controller@0.1.0";

/// The world of a plant: what a simulated bus and an experiment run.
pub const PLANT_WORLD: &str = "bumpless:control/plant@0.1.0";

/// The world of a free-running program.
pub const PROGRAM_WORLD: &str = "bumpless:control/program@0.1.0";

/// One thing that happened to a component in the library.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ComponentEvent {
    /// When, in ms since 1970-01-01 UTC by the clock of the host that was asked.
    pub at_unix_ms: u64,
    /// Who.
    pub by: String,
    /// What, in words.
    pub what: String,
}

/// How new a copy of a summary is. Of two, the greater one counts; equal ones are the same copy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Edition {
    /// When the component was uploaded, in ms since 1970-01-01 UTC.
    pub uploaded_at_unix_ms: u64,
    /// Changes since then.
    pub changes: u64,
    /// Of what people wrote: decides, in the same way everywhere, where two hosts were told different things at once.
    pub mark: u64,
}

/// The summary of one uploaded component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ComponentInfo {
    /// SHA-256 of its bytes: its only name.
    pub digest: Digest,
    /// The algorithm's name, as its descriptor says it.
    pub name: String,
    /// The algorithm's semantic version, as its descriptor says it.
    pub version: String,
    /// Everything that it says of itself, checked.
    pub descriptor: Descriptor,
    /// The world that it was taken in for, for example [`CONTROLLER_WORLD`].
    pub world: String,
    /// The interfaces that it imports, in its own order; at most [`IMPORTS_MAX`].
    pub imports: Vec<String>,
    /// Its size in bytes.
    pub bytes: u64,
    /// When it was uploaded, in ms since 1970-01-01 UTC by the uploading host's clock.
    pub uploaded_at_unix_ms: u64,
    /// Who uploaded it.
    pub uploaded_by: String,
    /// What people wrote about it; may be empty.
    pub note: String,
    /// What people sort it by, at most [`LABELS_MAX`]; see [`check_label`].
    pub labels: BTreeMap<String, String>,
    /// Changes of note and labels since the upload.
    pub changes: u64,
    /// The last [`HISTORY_MAX`] things that happened to it, the newest last.
    pub history: Vec<ComponentEvent>,
    /// What its trial found, where it had one.
    pub admission: Option<Admission>,
}

/// What is wrong with a component's summary.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ComponentInfoError {
    /// The descriptor does not hold.
    #[error(transparent)]
    Descriptor(#[from] DescriptorError),
    /// Name or version differ from the descriptor's.
    #[error("the summary says {said:?}, the descriptor {described:?}: they must be the same")]
    Differs {
        /// "name version" of the summary.
        said: String,
        /// "name version" of the descriptor.
        described: String,
    },
    /// No bytes, or too many.
    #[error("a component of {0} bytes: 1 to {COMPONENT_BYTES_MAX} are possible")]
    Bytes(u64),
    /// Too many imports.
    #[error("{0} imports; at most {IMPORTS_MAX} are allowed")]
    Imports(usize),
    /// A text over the limit.
    #[error("{0} is longer than {TEXT_CHARS_MAX} characters")]
    TextTooLong(&'static str),
    /// A label that cannot be.
    #[error(transparent)]
    Label(#[from] LabelError),
    /// Too much history.
    #[error("{0} entries of history; at most {HISTORY_MAX} are kept")]
    History(usize),
    /// The report of its trial does not hold.
    #[error("its trial: {0}")]
    Admission(#[from] AdmissionError),
}

/// What is wrong with a label.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LabelError {
    /// The key.
    #[error(
        "label {0:?}: a key has 1 to {LABEL_CHARS_MAX} lower-case letters, digits, dots, dashes, underscores and slashes, \
         and begins and ends with a letter or digit"
    )]
    Key(String),
    /// The value.
    #[error("label {key:?}: a value has 1 to {LABEL_CHARS_MAX} characters, no commas and no control characters")]
    Value {
        /// Its key.
        key: String,
    },
    /// Too many.
    #[error("{0} labels; at most {LABELS_MAX} are possible")]
    TooMany(usize),
}

/// Checks one label. Commas separate labels where several stand in one text, so a value has none.
///
/// # Errors
/// Which part cannot be, and what can.
pub fn check_label(key: &str, value: &str) -> Result<(), LabelError> {
    let edge = |byte: Option<u8>| byte.is_some_and(|b| b.is_ascii_lowercase() || b.is_ascii_digit());
    let inner = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b"._/-".contains(&b);
    let key_good = key.len() <= LABEL_CHARS_MAX
        && key.bytes().all(inner)
        && edge(key.bytes().next())
        && edge(key.bytes().next_back());
    if !key_good {
        return Err(LabelError::Key(key.chars().take(LABEL_CHARS_MAX).collect()));
    }
    let value_good =
        (1..=LABEL_CHARS_MAX).contains(&value.chars().count()) && !value.chars().any(|c| c.is_control() || c == ',');
    if value_good {
        Ok(())
    } else {
        Err(LabelError::Value { key: key.to_owned() })
    }
}

impl ComponentInfo {
    /// Checks a summary that came from another host.
    ///
    /// # Errors
    /// The first thing that does not hold.
    pub fn check(&self) -> Result<(), ComponentInfoError> {
        if self.is_program() {
            self.descriptor.check_program()?;
        } else if self.is_plant() {
            self.descriptor.check_plant()?;
        } else {
            self.descriptor.check()?;
        }
        if self.name != self.descriptor.name || self.version != self.descriptor.version {
            let cut = |name: &str, version: &str| format!("{name} {version}").chars().take(TEXT_CHARS_MAX).collect();
            return Err(ComponentInfoError::Differs {
                said: cut(&self.name, &self.version),
                described: cut(&self.descriptor.name, &self.descriptor.version),
            });
        }
        if self.bytes == 0 || self.bytes > COMPONENT_BYTES_MAX as u64 {
            return Err(ComponentInfoError::Bytes(self.bytes));
        }
        if self.imports.len() > IMPORTS_MAX {
            return Err(ComponentInfoError::Imports(self.imports.len()));
        }
        let long = |text: &str| text.chars().count() > TEXT_CHARS_MAX;
        if self.imports.iter().any(|i| long(i)) {
            return Err(ComponentInfoError::TextTooLong("an import"));
        }
        if long(&self.uploaded_by) {
            return Err(ComponentInfoError::TextTooLong("uploaded_by"));
        }
        if long(&self.note) {
            return Err(ComponentInfoError::TextTooLong("the note"));
        }
        if long(&self.world) {
            return Err(ComponentInfoError::TextTooLong("the world"));
        }
        check_labels(&self.labels)?;
        if self.history.len() > HISTORY_MAX {
            return Err(ComponentInfoError::History(self.history.len()));
        }
        if self.history.iter().any(|event| long(&event.by) || long(&event.what)) {
            return Err(ComponentInfoError::TextTooLong("an entry of its history"));
        }
        if let Some(admission) = &self.admission {
            admission.check()?;
        }
        Ok(())
    }

    /// Is it a plant, and no controller?
    #[must_use]
    pub fn is_plant(&self) -> bool {
        self.world == PLANT_WORLD
    }

    /// Is it a free-running program?
    #[must_use]
    pub fn is_program(&self) -> bool {
        self.world == PROGRAM_WORLD
    }

    /// How new this copy is.
    #[must_use]
    pub fn edition(&self) -> Edition {
        let mut text = format!("{}\n{}", self.note.len(), self.note);
        for (key, value) in &self.labels {
            text.push_str(&format!("\n{key}={value}"));
        }
        let digest = Digest::of(text.as_bytes());
        let first = digest.as_bytes().iter().take(8);
        Edition {
            uploaded_at_unix_ms: self.uploaded_at_unix_ms,
            changes: self.changes,
            mark: first.fold(0, |mark, byte| (mark << 8) | u64::from(*byte)),
        }
    }

    /// Notes that something happened to it; the oldest entry is forgotten. Texts are cut to their limit.
    pub fn remember(&mut self, at_unix_ms: u64, by: &str, what: &str) {
        let cut = |text: &str| text.chars().take(TEXT_CHARS_MAX).collect::<String>();
        let extra = (self.history.len() + 1).saturating_sub(HISTORY_MAX);
        self.history.drain(..extra);
        self.history.push(ComponentEvent {
            at_unix_ms,
            by: cut(by),
            what: cut(what),
        });
    }

    /// Does it have this label? `key=value`, or `key` for any value.
    #[must_use]
    pub fn has_label(&self, wanted: &str) -> bool {
        match wanted.split_once('=') {
            Some((key, value)) => self.labels.get(key).is_some_and(|has| has == value),
            None => self.labels.contains_key(wanted),
        }
    }
}

/// Checks all labels of a component.
///
/// # Errors
/// The first that cannot be, or that there are too many.
pub fn check_labels(labels: &BTreeMap<String, String>) -> Result<(), LabelError> {
    if labels.len() > LABELS_MAX {
        return Err(LabelError::TooMany(labels.len()));
    }
    labels.iter().try_for_each(|(key, value)| check_label(key, value))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used, reason = "tests")]

    use super::*;
    use crate::{Direction, PortKind, PortSpec};

    fn info() -> ComponentInfo {
        let output = PortSpec {
            name: "output".into(),
            direction: Direction::Output,
            kind: PortKind::Analog,
            unit: "%".into(),
            required: true,
            text: String::new(),
        };
        ComponentInfo {
            digest: Digest::of(b"pid"),
            name: "pid".into(),
            version: "1.0.0".into(),
            descriptor: Descriptor {
                name: "pid".into(),
                version: "1.0.0".into(),
                text: String::new(),
                ports: vec![output],
                parameters: Vec::new(),
                state_layout: 1,
            },
            world: CONTROLLER_WORLD.into(),
            imports: vec!["bumpless:control/io@0.1.0".into()],
            bytes: 3,
            uploaded_at_unix_ms: 0,
            uploaded_by: "operator".into(),
            note: String::new(),
            labels: BTreeMap::from([("stage".into(), "pilot".into())]),
            changes: 0,
            history: Vec::new(),
            admission: None,
        }
    }

    #[test]
    fn a_good_summary_passes_and_each_bad_part_is_named() {
        assert_eq!(info().check(), Ok(()));
        type Spoil = fn(&mut ComponentInfo);
        let table: [(Spoil, &str); 13] = [
            (|i| i.descriptor.ports.clear(), "no output port"),
            (|i| i.name = "other".into(), "\"other 1.0.0\""),
            (|i| i.version = "2.0.0".into(), "\"pid 2.0.0\""),
            (|i| i.bytes = 0, "0 bytes"),
            (|i| i.bytes = COMPONENT_BYTES_MAX as u64 + 1, "33554433 bytes"),
            (|i| i.imports = vec![String::new(); IMPORTS_MAX + 1], "65 imports"),
            (|i| i.uploaded_by = "x".repeat(TEXT_CHARS_MAX + 1), "uploaded_by"),
            (|i| i.note = "x".repeat(TEXT_CHARS_MAX + 1), "the note"),
            (|i| i.world = "x".repeat(TEXT_CHARS_MAX + 1), "the world"),
            (|i| drop(i.labels.insert("Stage".into(), "x".into())), "label \"Stage\""),
            (
                |i| drop(i.labels.insert("line".into(), String::new())),
                "label \"line\": a value",
            ),
            (
                |i| i.labels = (0..17).map(|n| (format!("l{n}"), "x".into())).collect(),
                "17 labels",
            ),
            (
                |i| {
                    i.history = vec![
                        ComponentEvent {
                            at_unix_ms: 0,
                            by: String::new(),
                            what: String::new()
                        };
                        HISTORY_MAX + 1
                    ];
                },
                "17 entries",
            ),
        ];
        for (spoil, part) in table {
            let mut bad = info();
            spoil(&mut bad);
            let error = bad.check().expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
    }

    #[test]
    fn labels_are_short_and_can_be_told_apart_from_what_stands_around_them() {
        for key in ["stage", "a", "plant.line-2/unit_3", &"x".repeat(LABEL_CHARS_MAX)] {
            assert_eq!(check_label(key, "pilot plant = 2"), Ok(()), "{key}");
        }
        for key in [
            "",
            "-a",
            "a-",
            "Stage",
            "a b",
            "a=b",
            "ä",
            &"x".repeat(LABEL_CHARS_MAX + 1),
        ] {
            assert!(matches!(check_label(key, "x"), Err(LabelError::Key(_))), "{key}");
        }
        for value in ["", "a,b", "a\nb", &"x".repeat(LABEL_CHARS_MAX + 1)] {
            assert!(
                matches!(check_label("a", value), Err(LabelError::Value { .. })),
                "{value}"
            );
        }
        let info = info();
        assert!(info.has_label("stage") && info.has_label("stage=pilot"));
        assert!(!info.has_label("stage=test") && !info.has_label("line") && !info.has_label(""));
    }

    #[test]
    fn the_newer_copy_wins_and_two_changes_at_once_are_decided_alike_everywhere() {
        let first = info();
        let mut changed = first.clone();
        changed.changes += 1;
        changed.note = "for the pilot".into();
        assert!(changed.edition() > first.edition());
        let mut other = first.clone();
        other.changes += 1;
        other.labels.clear();
        assert_ne!(other.edition(), changed.edition());
        let mut again = first.clone();
        again.uploaded_at_unix_ms += 1;
        assert!(
            again.edition() > changed.edition(),
            "an upload after a removal counts more"
        );
        assert_eq!(first.edition(), info().edition());
    }

    #[test]
    fn history_keeps_the_newest() {
        let mut info = info();
        for n in 0..HISTORY_MAX as u64 + 3 {
            info.remember(n, "ann", &"x".repeat(TEXT_CHARS_MAX + 9));
        }
        let times: Vec<u64> = info.history.iter().map(|event| event.at_unix_ms).collect();
        assert_eq!(
            (times.len(), times.first(), times.last()),
            (HISTORY_MAX, Some(&3), Some(&18))
        );
        assert_eq!(info.check(), Ok(()));
    }
}
