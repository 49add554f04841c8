//! From text to tokens: identifiers without case, numbers of all bases, times, texts, pragmas.
//!
//! Never: knows keywords; the parser asks for them by name.

use crate::diagnostic::{Sink, Span};

/// What a token is.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Kind {
    /// An identifier or keyword, in upper case.
    Ident(String),
    /// `NAME#` before a literal or an enumerated value, in upper case.
    Prefix(String),
    Int(i128),
    Real(f64),
    /// A duration, in ns.
    Time(i64),
    Text(String),
    /// What stands between braces.
    Pragma(Span),
    Symbol(&'static str),
    End,
}

/// A token and where it stands.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Token {
    pub(crate) kind: Kind,
    pub(crate) span: Span,
}

/// Longer ones first.
const SYMBOLS: [&str; 25] = [
    ":=", "=>", "<=", ">=", "<>", "**", "..", "(", ")", "[", "]", ",", ";", ":", ".", "+", "-", "*", "/", "&", "=",
    "<", ">", "^", "#",
];

/// Units of durations, longer ones first, in ns.
const UNITS: [(&str, i128); 7] = [
    ("MS", 1_000_000),
    ("US", 1_000),
    ("NS", 1),
    ("D", 86_400_000_000_000),
    ("H", 3_600_000_000_000),
    ("M", 60_000_000_000),
    ("S", 1_000_000_000),
];

struct Lexer<'a> {
    source: &'a str,
    bytes: &'a [u8],
    at: usize,
    sink: &'a mut Sink,
    tokens: Vec<Token>,
}

/// The tokens of a text, or of the part of it that `span` names; the last one is [`Kind::End`].
pub(crate) fn tokens(source: &str, span: Span, sink: &mut Sink) -> Vec<Token> {
    let end = (span.end as usize).min(source.len());
    let source = source.get(..end).unwrap_or_default();
    let mut lexer = Lexer {
        source,
        bytes: source.as_bytes(),
        at: span.start as usize,
        sink,
        tokens: Vec::new(),
    };
    while lexer.next() {}
    let end = lexer.span(lexer.bytes.len());
    lexer.tokens.push(Token {
        kind: Kind::End,
        span: end,
    });
    lexer.tokens
}

const fn is_word(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_'
}

impl Lexer<'_> {
    fn peek(&self, ahead: usize) -> u8 {
        self.bytes.get(self.at + ahead).copied().unwrap_or(0)
    }

    fn span(&self, start: usize) -> Span {
        Span {
            start: start as u32,
            end: self.at as u32,
        }
    }

    fn push(&mut self, start: usize, kind: Kind) {
        let span = self.span(start);
        self.tokens.push(Token { kind, span });
    }

    /// The text of a word that begins here.
    fn word(&mut self) -> String {
        let start = self.at;
        while is_word(self.peek(0)) {
            self.at += 1;
        }
        self.source.get(start..self.at).unwrap_or_default().to_ascii_uppercase()
    }

    /// Goes on behind `close`; where there is none, says so and goes to the end.
    fn skip_to(&mut self, start: usize, close: &str, what: &str) {
        match self.source.get(self.at..).unwrap_or_default().find(close) {
            Some(n) => self.at += n + close.len(),
            None => {
                self.at = self.bytes.len();
                let span = self.span(start);
                self.sink
                    .error(span, format!("this {what} has no end: close it with `{close}`"));
            }
        }
    }

    /// `(* … *)`, which may hold others.
    fn nested_comment(&mut self) {
        let start = self.at;
        let mut depth = 0_u32;
        loop {
            match (self.peek(0), self.peek(1)) {
                (b'(', b'*') => {
                    depth += 1;
                    self.at += 2;
                }
                (b'*', b')') => {
                    depth -= 1;
                    self.at += 2;
                    if depth == 0 {
                        return;
                    }
                }
                _ if self.at >= self.bytes.len() => {
                    let span = self.span(start);
                    self.sink.error(span, "this comment has no end: close it with `*)`");
                    return;
                }
                _ => self.at += 1,
            }
        }
    }

    /// One token; false at the end.
    fn next(&mut self) -> bool {
        let start = self.at;
        let Some(&byte) = self.bytes.get(self.at) else {
            return false;
        };
        match byte {
            _ if byte.is_ascii_whitespace() => self.at += 1,
            b'(' if self.peek(1) == b'*' => self.nested_comment(),
            b'/' if self.peek(1) == b'*' => {
                self.at += 2;
                self.skip_to(start, "*/", "comment");
            }
            b'/' if self.peek(1) == b'/' => {
                let rest = self.source.get(self.at..).unwrap_or_default();
                self.at += rest.find('\n').unwrap_or(rest.len());
            }
            b'{' => {
                self.at += 1;
                self.skip_to(start, "}", "pragma");
                let inner = Span {
                    start: start as u32 + 1,
                    end: (self.at.max(start + 2) - 1) as u32,
                };
                self.push(start, Kind::Pragma(inner));
            }
            b'\'' | b'"' => self.text(byte),
            _ if byte.is_ascii_alphabetic() || byte == b'_' => {
                let word = self.word();
                if self.peek(0) == b'#' {
                    self.at += 1;
                    if matches!(word.as_str(), "T" | "TIME" | "LT" | "LTIME") {
                        self.duration(start);
                    } else {
                        self.push(start, Kind::Prefix(word));
                    }
                } else {
                    self.push(start, Kind::Ident(word));
                }
            }
            _ if byte.is_ascii_digit() => self.number(),
            _ => {
                let rest = self.source.get(self.at..).unwrap_or_default();
                match SYMBOLS.iter().find(|symbol| rest.starts_with(**symbol)) {
                    Some(symbol) => {
                        self.at += symbol.len();
                        self.push(start, Kind::Symbol(symbol));
                    }
                    None => {
                        let c = rest.chars().next().unwrap_or(' ');
                        self.at += c.len_utf8().max(1);
                        let span = self.span(start);
                        self.sink
                            .error(span, format!("the character {c:?} has no meaning in Structured Text"));
                    }
                }
            }
        }
        true
    }

    /// `'…'` or `"…"` with `$` before what is special.
    fn text(&mut self, quote: u8) {
        let start = self.at;
        self.at += 1;
        let mut text = String::new();
        loop {
            let rest = self.source.get(self.at..).unwrap_or_default();
            let mut chars = rest.chars();
            match chars.next() {
                Some('$') => {
                    let escaped = chars.next().unwrap_or('$');
                    self.at += 1 + escaped.len_utf8().min(rest.len().saturating_sub(1));
                    text.push(match escaped {
                        'n' | 'N' | 'l' | 'L' => '\n',
                        't' | 'T' => '\t',
                        other => other,
                    });
                }
                Some(c) if c as u32 == u32::from(quote) => {
                    self.at += 1;
                    break;
                }
                Some(c) if c != '\n' => {
                    self.at += c.len_utf8();
                    text.push(c);
                }
                _ => {
                    let span = self.span(start);
                    self.sink.error(
                        span,
                        "this text has no end: close it with the quote that it begins with",
                    );
                    break;
                }
            }
        }
        self.push(start, Kind::Text(text));
    }

    /// Digits of a base, with single underscores between them; none where there is no digit or it is too large.
    fn digits(&mut self, base: u32) -> Option<i128> {
        let mut value: i128 = 0;
        let mut any = false;
        let mut fits = true;
        loop {
            let byte = self.peek(0);
            if byte == b'_' && any {
                self.at += 1;
                continue;
            }
            let Some(digit) = char::from(byte).to_digit(base) else {
                break;
            };
            any = true;
            self.at += 1;
            value = value.saturating_mul(i128::from(base)).saturating_add(i128::from(digit));
            fits &= value <= i128::from(u64::MAX);
        }
        (any && fits).then_some(value)
    }

    fn number(&mut self) {
        let start = self.at;
        let first = self.digits(10);
        if self.peek(0) == b'#' {
            self.at += 1;
            let base = match first {
                Some(base @ (2 | 8 | 16)) => base as u32,
                _ => {
                    let span = self.span(start);
                    self.sink.error(span, "the base of a number is 2, 8 or 16");
                    16
                }
            };
            let value = self.digits(base);
            return self.integer(start, value);
        }
        let fraction = self.peek(0) == b'.' && self.peek(1).is_ascii_digit();
        let exponent = |at: u8, next: u8, third: u8| {
            matches!(at, b'e' | b'E')
                && (next.is_ascii_digit() || (matches!(next, b'+' | b'-') && third.is_ascii_digit()))
        };
        if !fraction && !exponent(self.peek(0), self.peek(1), self.peek(2)) {
            return self.integer(start, first);
        }
        if fraction {
            self.at += 1;
            while self.peek(0).is_ascii_digit() || self.peek(0) == b'_' {
                self.at += 1;
            }
        }
        if exponent(self.peek(0), self.peek(1), self.peek(2)) {
            self.at += 2;
            while self.peek(0).is_ascii_digit() {
                self.at += 1;
            }
        }
        let text = self.source.get(start..self.at).unwrap_or_default().replace('_', "");
        match text.parse::<f64>() {
            Ok(value) if value.is_finite() => self.push(start, Kind::Real(value)),
            _ => {
                let span = self.span(start);
                self.sink.error(span, "this number is too large for an LREAL");
                self.push(start, Kind::Real(0.0));
            }
        }
    }

    fn integer(&mut self, start: usize, value: Option<i128>) {
        if value.is_none() || is_word(self.peek(0)) {
            while is_word(self.peek(0)) {
                self.at += 1;
            }
            let span = self.span(start);
            self.sink.error(
                span,
                "this is no number: digits of its base, at most 64 bits, are expected",
            );
        }
        self.push(start, Kind::Int(value.unwrap_or(0)));
    }

    /// `1d2h3m4.5s` behind its prefix.
    fn duration(&mut self, start: usize) {
        let negative = self.peek(0) == b'-';
        if negative {
            self.at += 1;
        }
        let mut total: i128 = 0;
        let mut last = i128::MAX;
        let mut good = true;
        let mut any = false;
        while self.peek(0).is_ascii_digit() {
            let whole = self.digits(10);
            let (mut fraction, mut scale) = (0_i128, 1_i128);
            if self.peek(0) == b'.' && self.peek(1).is_ascii_digit() {
                self.at += 1;
                while self.peek(0).is_ascii_digit() {
                    if scale < 1_000_000_000_000_000 {
                        fraction = fraction * 10 + i128::from(self.peek(0) - b'0');
                        scale *= 10;
                    }
                    self.at += 1;
                }
            }
            let rest = self.source.get(self.at..).unwrap_or_default().as_bytes();
            let unit = UNITS.iter().find(|(unit, _)| {
                rest.get(..unit.len())
                    .is_some_and(|r| r.eq_ignore_ascii_case(unit.as_bytes()))
            });
            let (Some(whole), Some((unit, ns))) = (whole, unit) else {
                good = false;
                break;
            };
            self.at += unit.len();
            // From the largest to the smallest, each once, as the standard has it.
            good &= *ns < last;
            last = *ns;
            total = total
                .saturating_add(whole.saturating_mul(*ns))
                .saturating_add(fraction * ns / scale);
            any = true;
            if self.peek(0) == b'_' {
                self.at += 1;
            }
        }
        if is_word(self.peek(0)) {
            good = false;
            self.word();
        }
        let total = if negative { -total } else { total };
        let value = i64::try_from(total);
        if !good || !any || value.is_err() {
            let span = self.span(start);
            self.sink.error(
                span,
                "this is no duration: write it like T#1h30m or T#1.5s, units d, h, m, s, ms, us, ns from large to small, at most 292 \
                 years",
            );
        }
        self.push(start, Kind::Time(value.unwrap_or(0)));
    }
}
