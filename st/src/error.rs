//! Why there is no component. Never: a place in a text without its line and column.

use std::{borrow::Cow, fmt::Write as _};

use crate::Diagnostic;

/// Why there is no component.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The text is wrong in these places, in their order; at most [`DIAGNOSTICS_MAX`](crate::DIAGNOSTICS_MAX).
    #[error("{}", list(.0))]
    Source(Vec<Diagnostic>),
    /// The text is larger than a compiler takes.
    #[error("the text has {bytes} bytes; at most {max} are taken: split the plant into several controllers")]
    TooLong {
        /// Its length.
        bytes: usize,
        /// The limit.
        max: usize,
    },
    /// The state does not fit into a record.
    #[error("the variables of the program take {bytes} bytes of state; at most {max} are kept: make arrays smaller")]
    State {
        /// What they take.
        bytes: usize,
        /// The limit.
        max: usize,
    },
    /// What was written is no component; a mistake of this compiler.
    #[error("the compiler wrote no component: {0}; please report it with the text")]
    Encode(Cow<'static, str>),
}

fn list(diagnostics: &[Diagnostic]) -> String {
    let mut text = String::new();
    for diagnostic in diagnostics {
        if !text.is_empty() {
            text.push('\n');
        }
        let _infallible = write!(text, "{diagnostic}");
    }
    text
}
