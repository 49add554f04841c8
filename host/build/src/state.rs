//! What the bytes of a state mean, as their component says.
//!
//! ```text
//!   component ─ custom section "bumpless:state" ─► StateForm ─ with a state ─► names and values
//! ```
//! The section is text: a first line `postcard 1` (Rust, with the SDK) or `packed 1` (Structured Text), then `name: type` for each
//! value in its order. Types: `bool`, `i8` … `u64`, `f32`, `f64`, `hex8` … `hex64`, `time` (ns), `text`, `option<T>`, `seq<T>`, `N*T`,
//! `enum(A=0,B=1)`, `(T,T)`. Names that begin with `#` are the compiler's own. Never: believes a length or a number; a form or a state that does
//! not fit is said and not guessed at.

use std::fmt::Write as _;

use wasmparser::{Parser, Payload};

/// The section's name.
const SECTION: &str = "bumpless:state";
/// Values of one form: a form is shown to a person.
const VALUES_MAX: usize = 4_096;
/// Types within types.
const DEPTH_MAX: u32 = 8;
/// Elements of a sequence that are written out.
const SHOWN_MAX: u64 = 16;
/// What begins every state of the SDK's form.
const MARK: u8 = 0xB1;
/// What begins the part that the compiler for Structured Text writes.
const PACKED_MARK: &[u8] = b"BST1";

/// What a state consists of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StateForm {
    packed: bool,
    fields: Vec<(String, Type)>,
}

/// What stands in front of every state.
#[derive(Debug, Clone, PartialEq)]
pub struct Front {
    /// The component that wrote it.
    pub name: String,
    /// The version of its layout.
    pub layout: u32,
    /// The parameters that it ran with, in its descriptor's order.
    pub parameters: Vec<f64>,
    /// Where the law's own part begins, in bytes.
    pub end: usize,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Type {
    Bool,
    Whole { bits: u32, signed: bool },
    Hex { bits: u32 },
    Time,
    Real { bits: u32 },
    Text,
    Maybe(Box<Type>),
    Many(Box<Type>),
    Times(u64, Box<Type>),
    Choice(Vec<(String, i64)>),
    All(Vec<Type>),
}

impl Front {
    /// Reads it; none where the bytes are no state of this form.
    #[must_use]
    pub fn of(state: &[u8]) -> Option<Self> {
        let mut rest = Bytes { left: state };
        let [MARK, length] = *rest.take(2)? else { return None };
        let name = String::from_utf8_lossy(rest.take(usize::from(length))?).into_owned();
        let layout = u32::from_le_bytes(rest.take(4)?.try_into().ok()?);
        let count = usize::from(*rest.take(1)?.first()?);
        let values = rest.take(8 * count)?.chunks_exact(8);
        let parameters = values
            .map(|bytes| bytes.try_into().map_or(f64::NAN, f64::from_le_bytes))
            .collect();
        Some(Self {
            name,
            layout,
            parameters,
            end: state.len() - rest.left.len(),
        })
    }
}

impl StateForm {
    /// Finds the form in a component; none where it says nothing, or nothing that is understood.
    #[must_use]
    pub fn of_component(bytes: &[u8]) -> Option<Self> {
        let payloads = Parser::new(0).parse_all(bytes).map_while(Result::ok);
        let mut sections = payloads.filter_map(|payload| match payload {
            Payload::CustomSection(section) if section.name() == SECTION => Some(section.data()),
            _ => None,
        });
        std::str::from_utf8(sections.next()?).ok().and_then(Self::of_text)
    }

    fn of_text(text: &str) -> Option<Self> {
        let mut lines = text.lines();
        let packed = match lines.next()? {
            "packed 1" => true,
            "postcard 1" => false,
            _ => return None,
        };
        let fields = lines
            .filter(|line| !line.is_empty())
            .take(VALUES_MAX)
            .map(|line| {
                let (name, ty) = line.rsplit_once(": ")?;
                Some((name.to_owned(), Type::of(ty.trim(), 0)?))
            })
            .collect::<Option<Vec<_>>>()?;
        Some(Self { packed, fields })
    }

    /// The values of a state by name, in their order.
    ///
    /// # Errors
    /// In words, where the bytes do not fit the form.
    pub fn values(&self, state: &[u8]) -> Result<Vec<(String, String)>, String> {
        let front = Front::of(state).ok_or("the bytes are no state of this form")?;
        let mut rest = Bytes {
            left: state.get(front.end..).unwrap_or_default(),
        };
        if self.packed {
            let entries = (rest.take(4) == Some(PACKED_MARK))
                .then(|| u32::from_le_bytes(rest.take(4)?.try_into().ok()?).try_into().ok())
                .flatten()
                .and_then(|count: usize| rest.take(count.checked_mul(8)?));
            entries.ok_or("the bytes are no state of Structured Text")?;
        }
        let mut values = Vec::new();
        for (name, ty) in &self.fields {
            let mut text = String::new();
            ty.read(&mut rest, self.packed, &mut text)
                .ok_or_else(|| format!("the state ends, or does not fit its form, at {name}"))?;
            if !name.starts_with('#') {
                values.push((name.clone(), text));
            }
        }
        if rest.left.is_empty() || self.fields.len() == VALUES_MAX {
            Ok(values)
        } else {
            Err(format!("{} bytes of the state are not in its form", rest.left.len()))
        }
    }
}

/// Bytes that are read from the front.
struct Bytes<'a> {
    left: &'a [u8],
}

impl<'a> Bytes<'a> {
    fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, left) = self.left.split_at_checked(count)?;
        self.left = left;
        Some(taken)
    }

    /// A number of fixed length, little endian.
    fn fixed(&mut self, bits: u32) -> Option<u64> {
        let bytes = self.take((bits / 8) as usize)?;
        Some(
            bytes
                .iter()
                .rev()
                .fold(0, |number, byte| (number << 8) | u64::from(*byte)),
        )
    }

    /// A number of postcard's varying length: seven bits a byte, the lowest first.
    fn varying(&mut self) -> Option<u64> {
        let mut number: u64 = 0;
        for place in 0..10 {
            let byte = *self.take(1)?.first()?;
            number |= u64::from(byte & 0x7f).checked_shl(7 * place)?;
            if byte & 0x80 == 0 {
                return Some(number);
            }
        }
        None
    }

    fn whole(&mut self, bits: u32, packed: bool) -> Option<u64> {
        if packed || bits == 8 {
            self.fixed(bits)
        } else {
            self.varying()
        }
    }
}

/// What commas part outside of all brackets.
fn parts_of(text: &str) -> impl Iterator<Item = &str> {
    let mut depth = 0_i32;
    text.split(move |c| {
        depth += match c {
            '(' | '<' => 1,
            ')' | '>' => -1,
            _ => 0,
        };
        c == ',' && depth == 0
    })
    .map(str::trim)
}

/// A number of so many bits as a signed one.
const fn extended(number: u64, bits: u32) -> i64 {
    let up = 64 - bits;
    ((number << up) as i64) >> up
}

impl Type {
    fn of(text: &str, depth: u32) -> Option<Self> {
        if depth > DEPTH_MAX {
            return None;
        }
        let inner = |start: &str, end: &str| text.strip_prefix(start)?.strip_suffix(end);
        let bits = |text: &str, least: u32| {
            text.parse()
                .ok()
                .filter(|bits: &u32| [8, 16, 32, 64].contains(bits) && *bits >= least)
        };
        if let Some(of) = inner("option<", ">") {
            return Some(Self::Maybe(Box::new(Self::of(of, depth + 1)?)));
        }
        if let Some(of) = inner("seq<", ">") {
            return Some(Self::Many(Box::new(Self::of(of, depth + 1)?)));
        }
        if let Some(words) = inner("enum(", ")") {
            let word = |(n, word): (usize, &str)| match word.split_once('=') {
                Some((word, value)) => Some((word.to_owned(), value.parse().ok()?)),
                None => Some((word.to_owned(), i64::try_from(n).ok()?)),
            };
            return words
                .split(',')
                .enumerate()
                .map(word)
                .collect::<Option<_>>()
                .map(Self::Choice);
        }
        if let Some(parts) = inner("(", ")") {
            return parts_of(parts)
                .map(|part| Self::of(part, depth + 1))
                .collect::<Option<_>>()
                .map(Self::All);
        }
        if let Some((count, of)) = text.split_once('*') {
            return Some(Self::Times(count.parse().ok()?, Box::new(Self::of(of, depth + 1)?)));
        }
        Some(match text {
            "bool" => Self::Bool,
            "time" => Self::Time,
            "text" => Self::Text,
            _ => {
                if let Some(digits) = text.strip_prefix("hex") {
                    Self::Hex { bits: bits(digits, 8)? }
                } else if let Some(digits) = text.strip_prefix('f') {
                    Self::Real {
                        bits: bits(digits, 32)?,
                    }
                } else if let Some(digits) = text.strip_prefix('u') {
                    Self::Whole {
                        bits: bits(digits, 8)?,
                        signed: false,
                    }
                } else {
                    Self::Whole {
                        bits: bits(text.strip_prefix('i')?, 8)?,
                        signed: true,
                    }
                }
            }
        })
    }

    /// Reads one value and writes it out; none where the bytes do not fit.
    fn read(&self, from: &mut Bytes<'_>, packed: bool, to: &mut String) -> Option<()> {
        match self {
            Self::Bool => match from.fixed(8)? {
                0 => to.push_str("false"),
                1 => to.push_str("true"),
                _ if packed => to.push_str("true"),
                _ => return None,
            },
            Self::Whole { bits, signed } => {
                let number = from.whole(*bits, packed)?;
                let text = match (signed, packed || *bits == 8) {
                    (false, _) => number.to_string(),
                    (true, true) => extended(number, *bits).to_string(),
                    // Postcard's zigzag: 0, -1, 1, -2, …
                    (true, false) => (((number >> 1) as i64) ^ -((number & 1) as i64)).to_string(),
                };
                to.push_str(&text);
            }
            Self::Hex { bits } => {
                let number = from.whole(*bits, packed)?;
                write!(to, "16#{number:0width$X}", width = (*bits / 4) as usize).ok()?;
            }
            Self::Time => {
                let ns = if packed {
                    extended(from.fixed(64)?, 64)
                } else {
                    let number = from.varying()?;
                    ((number >> 1) as i64) ^ -((number & 1) as i64)
                };
                write!(to, "{} ms", ns as f64 / 1e6).ok()?;
            }
            Self::Real { bits: 32 } => write!(to, "{}", f32::from_bits(from.fixed(32)? as u32)).ok()?,
            Self::Real { .. } => write!(to, "{}", f64::from_bits(from.fixed(64)?)).ok()?,
            Self::Text => {
                let length = usize::try_from(from.varying()?).ok()?;
                write!(to, "{:?}", std::str::from_utf8(from.take(length)?).ok()?).ok()?;
            }
            Self::Maybe(of) => match from.fixed(8)? {
                0 => to.push_str("none"),
                1 => of.read(from, packed, to)?,
                _ => return None,
            },
            Self::Many(of) => {
                let count = from.varying()?;
                Self::read_all(of, count, from, packed, to)?;
            }
            Self::Times(count, of) => Self::read_all(of, *count, from, packed, to)?,
            Self::All(types) => Self::read_each(types, from, packed, to)?,
            Self::Choice(words) => {
                let value = if packed {
                    extended(from.fixed(32)?, 32)
                } else {
                    i64::try_from(from.varying()?).ok()?
                };
                match words.iter().find(|(_, known)| *known == value) {
                    Some((word, _)) => to.push_str(word),
                    None => write!(to, "{value}").ok()?,
                }
            }
        }
        Some(())
    }

    fn read_each(types: &[Self], from: &mut Bytes<'_>, packed: bool, to: &mut String) -> Option<()> {
        to.push('(');
        for (n, ty) in types.iter().enumerate() {
            to.push_str(if n == 0 { "" } else { ", " });
            ty.read(from, packed, to)?;
        }
        to.push(')');
        Some(())
    }

    fn read_all(of: &Self, count: u64, from: &mut Bytes<'_>, packed: bool, to: &mut String) -> Option<()> {
        // Each takes a byte at least, so no number of a liar's costs more than the state's bytes.
        if count > from.left.len() as u64 {
            return None;
        }
        to.push('[');
        let mut rest = String::new();
        for n in 0..count {
            if n < SHOWN_MAX {
                to.push_str(if n == 0 { "" } else { ", " });
                of.read(from, packed, to)?;
            } else {
                rest.clear();
                of.read(from, packed, &mut rest)?;
            }
        }
        if count > SHOWN_MAX {
            write!(to, ", … {} more", count - SHOWN_MAX).ok()?;
        }
        to.push(']');
        Some(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    fn front() -> Vec<u8> {
        let mut state = vec![MARK, 3];
        state.extend_from_slice(b"law");
        state.extend_from_slice(&7_u32.to_le_bytes());
        state.push(2);
        state.extend_from_slice(&1.5_f64.to_le_bytes());
        state.extend_from_slice(&4.0_f64.to_le_bytes());
        state
    }

    fn shown(text: &str, own: &[u8]) -> Result<String, String> {
        let form = StateForm::of_text(text).expect("a form");
        let mut state = front();
        state.extend_from_slice(own);
        let values = form.values(&state)?;
        let lines: Vec<String> = values.iter().map(|(name, value)| format!("{name}={value}")).collect();
        Ok(lines.join(" "))
    }

    #[test]
    fn the_front_tells_of_the_component_and_its_parameters() {
        let front_bytes = front();
        let front = Front::of(&front_bytes).unwrap();
        assert_eq!(
            (front.name.as_str(), front.layout, front.end),
            ("law", 7, front_bytes.len())
        );
        assert_eq!(front.parameters, [1.5, 4.0]);
        for bad in [
            &[][..],
            &[MARK],
            &[0, 1, 2],
            front_bytes.get(..front_bytes.len() - 1).unwrap(),
        ] {
            assert_eq!(Front::of(bad), None);
        }
    }

    #[test]
    fn what_postcard_writes_is_read() {
        let own = [
            &[1][..],
            &(-2.5_f64).to_le_bytes(),
            // u32 300, i16 -3, option none, seq of 2, enum 1, text, some pair
            &[
                0xac, 0x02, 0x05, 0x00, 0x02, 0x01, 0x02, 0x01, 0x02, b'h', b'i', 0x01, 0x07, 0x09,
            ],
        ]
        .concat();
        let form = "postcard 1\nlast: option<f64>\ncount: u32\nback: i16\nnone: option<u8>\nring: seq<u8>\nway: enum(up,down)\nname: text\npair: option<(u8, hex8)>";
        assert_eq!(
            shown(form, &own).unwrap(),
            "last=-2.5 count=300 back=-3 none=none ring=[1, 2] way=down name=\"hi\" pair=(7, 16#09)"
        );
        for cut in 0..own.len() {
            assert!(shown(form, own.get(..cut).unwrap()).is_err(), "{cut}");
        }
        assert_eq!(
            shown("postcard 1\na: u8", &[1, 2]).unwrap_err(),
            "1 bytes of the state are not in its form"
        );
        // A length beyond the state, and a number without an end.
        assert!(shown("postcard 1\na: seq<u8>", &[0xff, 0xff, 0xff, 0xff, 0x0f]).is_err());
        assert!(shown("postcard 1\na: u64", &[0xff; 12]).is_err());
    }

    #[test]
    fn forms_that_are_not_understood_are_none() {
        for bad in [
            "",
            "json 1\na: u8",
            "postcard 1\na u8",
            "postcard 1\na: u7",
            "postcard 1\na: f16",
            "packed 1\na: option<",
            "packed 1\na: x*u8",
        ] {
            assert_eq!(StateForm::of_text(bad), None, "{bad:?}");
        }
        let deep = format!("postcard 1\na: {}u8{}", "option<".repeat(40), ">".repeat(40));
        assert_eq!(StateForm::of_text(&deep), None);
        assert_eq!(StateForm::of_component(b"no component"), None);
        let many = format!("postcard 1\na: {}*u8", u64::MAX);
        assert!(shown(&many, &[1]).is_err());
    }

    #[test]
    fn a_program_in_structured_text_says_what_its_state_is() {
        let compiled = bumpless_st::compile(
            "TYPE way : (up, down := 5); END_TYPE
             PROGRAM p
             VAR_OUTPUT r : LREAL := 2.5; END_VAR
             VAR n : INT := -3; b : BOOL := TRUE; w : WORD := 16#AB; t : TON; a : ARRAY[1..3] OF INT := [1, 2, 3]; d : way := down; END_VAR
             t(IN := b, PT := T#1s); END_PROGRAM",
        )
        .unwrap();
        let form = StateForm::of_component(&compiled.component).expect("a form in the component");
        let names: Vec<&str> = form.fields.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(
            names.iter().filter(|name| name.starts_with('#')).count(),
            2,
            "{names:?}"
        );
        for name in ["R", "N", "B", "W", "A", "D", "T.PT"] {
            assert!(
                names.iter().any(|known| known.eq_ignore_ascii_case(name)),
                "{name}: {names:?}"
            );
        }
    }
}
