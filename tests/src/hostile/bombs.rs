//! Components made to cost whoever compiles, reads or keeps them, by their measure.
//!
//! Never: larger than what is asked for; each takes a count.

use std::fmt::Write as _;

use serde::Deserialize;

use super::Guest;
use crate::Error;

/// How bytes are made.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Recipe {
    /// [`many_functions`].
    Functions {
        /// How many.
        count: u32,
    },
    /// [`huge_tables`].
    JumpTables {
        /// How many.
        count: u32,
        /// Targets of each.
        targets: u32,
    },
    /// [`deep_nesting`].
    Blocks {
        /// How deep.
        depth: usize,
    },
    /// [`long_lives`].
    Values {
        /// How many.
        count: u32,
    },
    /// [`much_data`].
    Data {
        /// MiB of it.
        mib: u32,
    },
    /// [`many_locals`].
    Locals {
        /// Functions with 50,000 locals each.
        functions: u32,
    },
    /// [`long_names`].
    Name {
        /// Characters of it.
        chars: usize,
    },
    /// [`nested_components`].
    Components {
        /// How deep.
        depth: u32,
    },
    /// [`deep_types`].
    Types {
        /// How deep.
        depth: u32,
    },
    /// [`doubling_types`].
    Doubling {
        /// How often.
        times: u32,
    },
    /// [`many_modules`].
    Modules {
        /// How many.
        count: u32,
    },
    /// The good law with a custom section, so that it has this size.
    Padded {
        /// Size of all, in bytes.
        bytes: usize,
    },
    /// The first half of the good law.
    Half,
    /// The good law with every seventh byte after its header turned over.
    Scrambled,
    /// What begins like machine code of the engine.
    MachineCode,
    /// Nothing at all.
    Empty,
}

impl Recipe {
    /// The bytes.
    ///
    /// # Errors
    /// [`Error::Guest`].
    pub fn bytes(self) -> Result<Vec<u8>, Error> {
        Ok(match self {
            Self::Functions { count } => many_functions(count),
            Self::JumpTables { count, targets } => huge_tables(count, targets),
            Self::Blocks { depth } => deep_nesting(depth),
            Self::Values { count } => long_lives(count),
            Self::Data { mib } => much_data(mib),
            Self::Locals { functions } => many_locals(functions),
            Self::Name { chars } => long_names(chars),
            Self::Components { depth } => nested_components(depth),
            Self::Types { depth } => deep_types(depth),
            Self::Doubling { times } => doubling_types(times),
            Self::Modules { count } => many_modules(count),
            Self::Padded { bytes } => padded(bytes)?,
            Self::Half => {
                let mut good = Guest::good().encoded()?;
                good.truncate(good.len() / 2);
                good
            }
            Self::Scrambled => {
                let mut good = Guest::good().encoded()?;
                good.iter_mut().skip(16).step_by(7).for_each(|byte| *byte = !*byte);
                good
            }
            Self::MachineCode => machine_code(),
            Self::Empty => Vec::new(),
        })
    }
}

fn with(extra: String) -> Vec<u8> {
    Guest { extra, ..Guest::good() }.build()
}

/// Functions by the ten thousand, none of which is ever called.
#[must_use]
pub fn many_functions(count: u32) -> Vec<u8> {
    let mut text = String::new();
    for n in 0..count {
        let _infallible = write!(
            text,
            "(func (param i64 i64) (result i64) (i64.add (i64.mul (local.get 0) (i64.const {n})) (local.get 1)))"
        );
    }
    with(text)
}

/// One function whose every block jumps to everywhere.
#[must_use]
pub fn huge_tables(tables: u32, targets: u32) -> Vec<u8> {
    let targets = (0..targets).map(|n| (n % 4).to_string()).collect::<Vec<_>>().join(" ");
    let mut text = "(func (param i32)".to_owned();
    for _ in 0..tables {
        let _infallible = write!(
            text,
            "(block (block (block (block (br_table {targets} 0 (local.get 0))))))"
        );
    }
    text.push(')');
    with(text)
}

/// Blocks in blocks.
#[must_use]
pub fn deep_nesting(depth: usize) -> Vec<u8> {
    // The text form is read recursively, so each level is written flat.
    let text = format!(
        "(func (param i32) (result i32) {} local.get 0 {})",
        "block (result i32) ".repeat(depth),
        "end ".repeat(depth)
    );
    with(text)
}

/// One function in which every value lives to its end.
#[must_use]
pub fn long_lives(values: u32) -> Vec<u8> {
    let mut text = "(func (param f64) (result f64) ".to_owned();
    for n in 0..values {
        let _infallible = write!(text, "(f64.mul (local.get 0) (f64.const {n})) ");
    }
    for _ in 1..values {
        text.push_str("f64.add ");
    }
    text.push(')');
    with(text)
}

/// Megabytes to copy into each instance.
#[must_use]
pub fn much_data(mib: u32) -> Vec<u8> {
    let bytes = "x".repeat(1024 * 1024);
    let mut text = String::new();
    for n in 0..mib {
        let _infallible = write!(text, "(data (i32.const {}) \"{bytes}\")", 131_072 + n * 1024 * 1024);
    }
    Guest {
        extra: text,
        pages: 2 + mib * 16,
        ..Guest::good()
    }
    .build()
}

/// Functions with as many locals as a function may have.
#[must_use]
pub fn many_locals(functions: u32) -> Vec<u8> {
    let locals = "i64 ".repeat(49_990);
    let mut text = String::new();
    for _ in 0..functions {
        let _infallible = write!(text, "(func (result i64) (local {locals}) (local.get 49000))");
    }
    with(text)
}

/// A step that traps in a function with a very long name, which the fault would tell.
#[must_use]
pub fn long_names(chars: usize) -> Vec<u8> {
    let name = "n".repeat(chars);
    Guest {
        extra: format!("(func ${name} (result i32) (unreachable))"),
        ..Guest::step(&format!("(call ${name})"))
    }
    .build()
}

/// A length or index as LEB128.
fn leb(mut value: u64, bytes: &mut Vec<u8>) {
    while value >= 0x80 {
        bytes.push(u8::try_from(value & 0x7f).unwrap_or_default() | 0x80);
        value >>= 7;
    }
    bytes.push(u8::try_from(value).unwrap_or_default());
}

/// Preamble of a component: magic, version 13, layer 1. Source: the component model's binary format.
const PREAMBLE: [u8; 8] = *b"\0asm\x0d\0\x01\0";

/// A section: its number, its length, its content.
fn section(id: u8, content: &[u8], bytes: &mut Vec<u8>) {
    bytes.push(id);
    leb(content.len() as u64, bytes);
    bytes.extend_from_slice(content);
}

/// Components in components (section 4).
#[must_use]
pub fn nested_components(depth: u32) -> Vec<u8> {
    let mut inner = PREAMBLE.to_vec();
    for _ in 0..depth {
        let mut outer = PREAMBLE.to_vec();
        section(4, &inner, &mut outer);
        inner = outer;
    }
    inner
}

/// Lists of lists of lists (section 7, `0x70`), each of the type before.
#[must_use]
pub fn deep_types(depth: u32) -> Vec<u8> {
    types(depth, |n, bytes| {
        bytes.push(0x70);
        of_before(n, bytes);
    })
}

/// Pairs of pairs of pairs (`0x6f`, a tuple): the last has two to the power of `times` fields.
#[must_use]
pub fn doubling_types(times: u32) -> Vec<u8> {
    types(times, |n, bytes| {
        bytes.extend([0x6f, 2]);
        of_before(n, bytes);
        of_before(n, bytes);
    })
}

/// The type before as a value type; a byte (`0x7d`) for the first.
fn of_before(n: u32, bytes: &mut Vec<u8>) {
    match n.checked_sub(1) {
        None => bytes.push(0x7d),
        // A signed number: the sixth bit of the last byte must be clear, or it would be negative.
        Some(before) => {
            leb(u64::from(before), bytes);
            if let Some(last) = bytes.last_mut().filter(|last| **last & 0x40 != 0) {
                *last |= 0x80;
                bytes.push(0);
            }
        }
    }
}

fn types(count: u32, one: impl Fn(u32, &mut Vec<u8>)) -> Vec<u8> {
    let mut content = Vec::new();
    leb(u64::from(count), &mut content);
    for n in 0..count {
        one(n, &mut content);
    }
    let mut bytes = PREAMBLE.to_vec();
    section(7, &content, &mut bytes);
    bytes
}

/// Core modules (section 1) that nobody instantiates.
#[must_use]
pub fn many_modules(count: u32) -> Vec<u8> {
    let mut bytes = PREAMBLE.to_vec();
    for _ in 0..count {
        section(1, b"\0asm\x01\0\0\0", &mut bytes);
    }
    bytes
}

/// The good law with a custom section (section 0) named `x` behind it.
fn padded(size: usize) -> Result<Vec<u8>, Error> {
    let mut bytes = Guest::good().encoded()?;
    // Section number, length in five bytes, a name of one character.
    let rest = size.saturating_sub(bytes.len() + 8);
    bytes.push(0);
    let length = rest as u64 + 2;
    for n in 0..5 {
        let low = u8::try_from(length >> (7 * n) & 0x7f).unwrap_or_default();
        bytes.push(if n < 4 { low | 0x80 } else { low });
    }
    bytes.extend(b"\x01x");
    bytes.resize(bytes.len() + rest, 0);
    Ok(bytes)
}

/// An ELF header as the engine writes it: 64 bits, little endian, its own number of a system, and the mark of a component.
/// Source: the ELF specification's file header; wasmtime's `ELFOSABI_WASMTIME` (200) and `EF_WASMTIME_COMPONENT` (2).
fn machine_code() -> Vec<u8> {
    let mut header = vec![0_u8; 64];
    for (at, bytes) in [
        (0, &b"\x7fELF\x02\x01\x01\xc8"[..]),
        (16, &[1, 0, 62, 0, 1][..]),
        (48, &[2, 0, 0, 0, 64, 0][..]),
        (58, &[64, 0][..]),
    ] {
        for (to, from) in header.iter_mut().skip(at).zip(bytes) {
            *to = *from;
        }
    }
    header
}
