//! What is wrong with a text, and where: spans, lines, columns, messages.
//!
//! Owns: the list of diagnostics of one compilation and its bounds. Never: decides what is wrong.

use std::fmt;

/// Diagnostics that one compilation reports. After so many the reader mends some first.
pub const DIAGNOSTICS_MAX: usize = 50;

/// A piece of the text, in bytes from its begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Span {
    pub(crate) start: u32,
    pub(crate) end: u32,
}

impl Span {
    /// From the begin of this one to the end of another.
    pub(crate) const fn to(self, end: Self) -> Self {
        Self {
            start: self.start,
            end: end.end,
        }
    }
}

/// One thing that is wrong with a text.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Diagnostic {
    /// Line, from 1.
    pub line: u32,
    /// Column in characters, from 1.
    pub column: u32,
    /// What is wrong, and what to do.
    pub message: String,
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}: {}", self.line, self.column, self.message)
    }
}

/// Line and column of a place, both from 1; columns count characters.
pub(crate) fn position(source: &str, at: u32) -> (u32, u32) {
    let mut at = (at as usize).min(source.len());
    while !source.is_char_boundary(at) {
        at -= 1;
    }
    let before = source.get(..at).unwrap_or_default();
    let line = before.bytes().filter(|&b| b == b'\n').count() + 1;
    let begin = before.rfind('\n').map_or(0, |n| n + 1);
    let column = before.get(begin..).unwrap_or_default().chars().count() + 1;
    (line as u32, column as u32)
}

/// The diagnostics of one compilation.
#[derive(Debug, Default)]
pub(crate) struct Sink {
    found: Vec<(Span, String)>,
}

impl Sink {
    /// Notes one. Of the same place only the first counts: the others follow from it.
    pub(crate) fn error(&mut self, span: Span, message: impl Into<String>) {
        if self.found.len() < DIAGNOSTICS_MAX && !self.found.iter().any(|(other, _)| other.start == span.start) {
            self.found.push((span, message.into()));
        }
    }

    pub(crate) const fn is_empty(&self) -> bool {
        self.found.is_empty()
    }

    /// In the order of the text.
    pub(crate) fn finish(mut self, source: &str) -> Vec<Diagnostic> {
        self.found.sort_by_key(|(span, _)| span.start);
        self.found
            .into_iter()
            .map(|(span, message)| {
                let (line, column) = position(source, span.start);
                Diagnostic { line, column, message }
            })
            .collect()
    }
}
