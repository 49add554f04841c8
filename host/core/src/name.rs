//! Names of hosts, loops, points, buses and cells: short, lower case, safe in key expressions, labels and file names.
//!
//! Never: invents a name.

use std::{borrow::Borrow, fmt, sync::Arc};

use serde::{Deserialize, Serialize};

use crate::limits::NAME_CHARS_MAX;

/// Why a text is no name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NameError {
    /// Nothing there.
    #[error("a {0} name must have at least one character")]
    Empty(&'static str),
    /// Too long.
    #[error("the {what} name {name:?} has {chars} characters; at most {NAME_CHARS_MAX} are allowed")]
    TooLong {
        /// What was to be named.
        what: &'static str,
        /// The text, cut.
        name: String,
        /// Its length.
        chars: usize,
    },
    /// A character that is not allowed.
    #[error("the {what} name {name:?} contains {found:?}; use lower-case letters, digits, '-', '_' and '.'")]
    Character {
        /// What was to be named.
        what: &'static str,
        /// The text.
        name: String,
        /// The first character that is not allowed.
        found: char,
    },
}

fn check(what: &'static str, text: &str) -> Result<(), NameError> {
    if text.is_empty() {
        return Err(NameError::Empty(what));
    }
    let chars = text.chars().count();
    if chars > NAME_CHARS_MAX {
        return Err(NameError::TooLong {
            what,
            name: text.chars().take(NAME_CHARS_MAX).collect(),
            chars,
        });
    }
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '-' | '_' | '.');
    match text.chars().find(|&c| !allowed(c)) {
        Some(found) => Err(NameError::Character {
            what,
            name: text.to_owned(),
            found,
        }),
        // A leading dot would hide a file, and `..` would leave a folder.
        None if text.starts_with('.') => Err(NameError::Character {
            what,
            name: text.to_owned(),
            found: '.',
        }),
        None => Ok(()),
    }
}

macro_rules! name_type {
    ($(#[$doc:meta])* $type:ident, $what:literal) => {
        $(#[$doc])*
        #[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        pub struct $type(Arc<str>);

        impl $type {
            /// Checks and takes a name: 1 to 64 lower-case letters, digits, `-`, `_`, `.`.
            pub fn new(text: impl AsRef<str>) -> Result<Self, NameError> {
                check($what, text.as_ref()).map(|()| Self(Arc::from(text.as_ref())))
            }

            /// The name as text.
            #[must_use]
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl TryFrom<String> for $type {
            type Error = NameError;
            fn try_from(text: String) -> Result<Self, NameError> {
                Self::new(text)
            }
        }

        impl std::str::FromStr for $type {
            type Err = NameError;
            fn from_str(text: &str) -> Result<Self, NameError> {
                Self::new(text)
            }
        }

        impl From<$type> for String {
            fn from(name: $type) -> String {
                name.0.as_ref().to_owned()
            }
        }

        impl Borrow<str> for $type {
            fn borrow(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(&self.0)
            }
        }

        impl fmt::Debug for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Debug::fmt(&self.0, f)
            }
        }
    };
}

name_type!(
    /// One process of the cell.
    HostId,
    "host"
);
name_type!(
    /// A controller bound to ports.
    LoopId,
    "loop"
);
name_type!(
    /// A free-running program.
    ProgramId,
    "program"
);
name_type!(
    /// One named I/O value. Unique in the cell.
    PointId,
    "point"
);
name_type!(
    /// A driver instance that owns points. Unique on its host.
    BusId,
    "bus"
);
name_type!(
    /// The hosts that find each other.
    CellName,
    "cell"
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_checked_and_say_why() {
        assert!(LoopId::new("pressure-1").is_ok());
        for (bad, part) in [
            ("", "at least one"),
            ("Loop", "'L'"),
            ("a/b", "'/'"),
            ("../x", "'.'"),
            ("a b", "' '"),
        ] {
            let error = LoopId::new(bad).expect_err(bad).to_string();
            assert!(error.contains(part), "{bad:?}: {error}");
        }
        assert!(
            LoopId::new("x".repeat(65))
                .expect_err("too long")
                .to_string()
                .contains("65 characters")
        );
    }
}
