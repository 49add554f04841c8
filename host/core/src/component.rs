//! What a cell knows of an uploaded component beside its bytes.
//!
//! Owns: the summary that travels and is kept under the component's digest. Never: the bytes, and never trust in them:
//! the descriptor was checked when the component was admitted.

use serde::{Deserialize, Serialize};

use crate::{
    descriptor::{Descriptor, DescriptorError},
    digest::Digest,
    limits::{COMPONENT_BYTES_MAX, TEXT_CHARS_MAX},
};

/// Imports that an info lists at most. A component with more is no controller; the list is for people.
pub const IMPORTS_MAX: usize = 64;

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
    /// The interfaces that it imports, in its own order; at most [`IMPORTS_MAX`].
    pub imports: Vec<String>,
    /// Its size in bytes.
    pub bytes: u64,
    /// When it was uploaded, in ms since 1970-01-01 UTC by the uploading host's clock.
    pub uploaded_at_unix_ms: u64,
    /// Who uploaded it.
    pub uploaded_by: String,
    /// What the uploader wrote about it; may be empty.
    pub note: String,
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
}

impl ComponentInfo {
    /// Checks a summary that came from another host.
    ///
    /// # Errors
    /// The first thing that does not hold.
    pub fn check(&self) -> Result<(), ComponentInfoError> {
        self.descriptor.check()?;
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
        Ok(())
    }
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
            imports: vec!["bumpless:control/io@0.1.0".into()],
            bytes: 3,
            uploaded_at_unix_ms: 0,
            uploaded_by: "operator".into(),
            note: String::new(),
        }
    }

    #[test]
    fn a_good_summary_passes_and_each_bad_part_is_named() {
        assert_eq!(info().check(), Ok(()));
        type Spoil = fn(&mut ComponentInfo);
        let table: [(Spoil, &str); 8] = [
            (|i| i.descriptor.ports.clear(), "no output port"),
            (|i| i.name = "other".into(), "\"other 1.0.0\""),
            (|i| i.version = "2.0.0".into(), "\"pid 2.0.0\""),
            (|i| i.bytes = 0, "0 bytes"),
            (|i| i.bytes = COMPONENT_BYTES_MAX as u64 + 1, "33554433 bytes"),
            (|i| i.imports = vec![String::new(); IMPORTS_MAX + 1], "65 imports"),
            (|i| i.uploaded_by = "x".repeat(TEXT_CHARS_MAX + 1), "uploaded_by"),
            (|i| i.note = "x".repeat(TEXT_CHARS_MAX + 1), "the note"),
        ];
        for (spoil, part) in table {
            let mut bad = info();
            spoil(&mut bad);
            let error = bad.check().expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
    }
}
