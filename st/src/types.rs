//! Types and how their values lie in memory: packed, little endian, without gaps.
//!
//! Owns: what widens into what by itself. Never: a value or a name that is not a type's.

use std::rc::Rc;

/// An elementary type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Scalar {
    Bool,
    Sint,
    Int,
    Dint,
    Lint,
    Usint,
    Uint,
    Udint,
    Ulint,
    Byte,
    Word,
    Dword,
    Lword,
    Real,
    Lreal,
    /// ns.
    Time,
}

/// All of them by the names of the standard.
pub(crate) const SCALARS: [(&str, Scalar); 17] = [
    ("BOOL", Scalar::Bool),
    ("SINT", Scalar::Sint),
    ("INT", Scalar::Int),
    ("DINT", Scalar::Dint),
    ("LINT", Scalar::Lint),
    ("USINT", Scalar::Usint),
    ("UINT", Scalar::Uint),
    ("UDINT", Scalar::Udint),
    ("ULINT", Scalar::Ulint),
    ("BYTE", Scalar::Byte),
    ("WORD", Scalar::Word),
    ("DWORD", Scalar::Dword),
    ("LWORD", Scalar::Lword),
    ("REAL", Scalar::Real),
    ("LREAL", Scalar::Lreal),
    ("TIME", Scalar::Time),
    ("LTIME", Scalar::Time),
];

impl Scalar {
    pub(crate) fn named(upper: &str) -> Option<Self> {
        SCALARS
            .iter()
            .find(|(name, _)| *name == upper)
            .map(|(_, scalar)| *scalar)
    }

    pub(crate) fn name(self) -> &'static str {
        SCALARS
            .iter()
            .find(|(_, scalar)| *scalar == self)
            .map_or("?", |(name, _)| name)
    }

    /// In memory, in bits.
    pub(crate) const fn bits(self) -> u32 {
        match self {
            Self::Bool | Self::Sint | Self::Usint | Self::Byte => 8,
            Self::Int | Self::Uint | Self::Word => 16,
            Self::Dint | Self::Udint | Self::Dword | Self::Real => 32,
            Self::Lint | Self::Ulint | Self::Lword | Self::Lreal | Self::Time => 64,
        }
    }

    pub(crate) const fn signed(self) -> bool {
        matches!(self, Self::Sint | Self::Int | Self::Dint | Self::Lint | Self::Time)
    }

    /// SINT … ULINT.
    pub(crate) const fn is_int(self) -> bool {
        matches!(
            self,
            Self::Sint | Self::Int | Self::Dint | Self::Lint | Self::Usint | Self::Uint | Self::Udint | Self::Ulint
        )
    }

    /// BYTE … LWORD.
    pub(crate) const fn is_bits(self) -> bool {
        matches!(self, Self::Byte | Self::Word | Self::Dword | Self::Lword)
    }

    pub(crate) const fn is_real(self) -> bool {
        matches!(self, Self::Real | Self::Lreal)
    }

    pub(crate) const fn is_number(self) -> bool {
        self.is_int() || self.is_real()
    }

    /// Everything that is held as whole numbers: integers, bits, BOOL, TIME.
    pub(crate) const fn is_whole(self) -> bool {
        !self.is_real()
    }

    /// Least and greatest value of a whole type.
    pub(crate) const fn range(self) -> (i128, i128) {
        match self {
            Self::Bool => (0, 1),
            _ if self.signed() => (-(1_i128 << (self.bits() - 1)), (1_i128 << (self.bits() - 1)) - 1),
            _ => (0, (1_i128 << self.bits()) - 1),
        }
    }

    /// May a value of this type stand where `to` is wanted, without a word?
    pub(crate) fn widens_to(self, to: Self) -> bool {
        if self == to {
            return true;
        }
        if self.is_int() && to.is_int() {
            let (from, into) = (self.range(), to.range());
            return into.0 <= from.0 && from.1 <= into.1;
        }
        match to {
            Self::Real => self.is_int() && self.bits() <= 16,
            Self::Lreal => self == Self::Real || (self.is_int() && self.bits() <= 32),
            _ => self.is_bits() && to.is_bits() && self.bits() < to.bits(),
        }
    }
}

/// A type.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Ty {
    Scalar(Scalar),
    /// Number of the enumeration; held as DINT.
    Enum(usize),
    Struct(usize),
    Array(Rc<Array>),
    Block(usize),
    /// What is wrong and was said.
    Wrong,
}

/// One range of indices after the other, the last one fastest.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Array {
    /// Low index and number of elements.
    pub(crate) ranges: Vec<(i64, u32)>,
    pub(crate) of: Ty,
    /// Of one element, in bytes.
    pub(crate) stride: u32,
    /// Of all, in bytes.
    pub(crate) size: u32,
}

/// What may be done with a field from outside of its block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Access {
    /// Fields of structures, inputs of blocks.
    Free,
    /// Outputs of blocks.
    Read,
    /// Variables of blocks.
    None,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Field {
    pub(crate) name: String,
    pub(crate) ty: Ty,
    /// In bytes from the begin of what holds it.
    pub(crate) offset: u32,
    pub(crate) access: Access,
    /// First value, as bytes.
    pub(crate) init: Vec<u8>,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct Structure {
    pub(crate) name: String,
    pub(crate) fields: Vec<Field>,
    pub(crate) size: u32,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct Enumeration {
    pub(crate) name: String,
    pub(crate) values: Vec<(String, i32)>,
}

/// The types of a text.
#[derive(Debug, Default)]
pub(crate) struct Types {
    pub(crate) structures: Vec<Structure>,
    pub(crate) enumerations: Vec<Enumeration>,
    /// Instances of function blocks, by the number of the block.
    pub(crate) blocks: Vec<Structure>,
}

impl Types {
    /// In bytes.
    pub(crate) fn size(&self, ty: &Ty) -> u32 {
        match ty {
            Ty::Scalar(scalar) => scalar.bits() / 8,
            Ty::Enum(_) => 4,
            Ty::Struct(n) => self.structures.get(*n).map_or(0, |s| s.size),
            Ty::Block(n) => self.blocks.get(*n).map_or(0, |s| s.size),
            Ty::Array(array) => array.size,
            Ty::Wrong => 0,
        }
    }

    /// As it is written in a text.
    pub(crate) fn name(&self, ty: &Ty) -> String {
        match ty {
            Ty::Scalar(scalar) => scalar.name().to_owned(),
            Ty::Enum(n) => self.enumerations.get(*n).map_or_else(String::new, |e| e.name.clone()),
            Ty::Struct(n) => self.structures.get(*n).map_or_else(String::new, |s| s.name.clone()),
            Ty::Block(n) => self.blocks.get(*n).map_or_else(String::new, |s| s.name.clone()),
            Ty::Array(array) => {
                let ranges: Vec<String> = array
                    .ranges
                    .iter()
                    .map(|(low, count)| format!("{low}..{}", low + i64::from(*count) - 1))
                    .collect();
                format!("ARRAY[{}] OF {}", ranges.join(","), self.name(&array.of))
            }
            Ty::Wrong => "?".to_owned(),
        }
    }

    /// The type with everything that its bytes depend on: what two versions of a program must agree in to share a value.
    pub(crate) fn signature(&self, ty: &Ty) -> String {
        let fields = |s: &Structure| {
            let fields: Vec<String> = s
                .fields
                .iter()
                .map(|field| format!("{}:{}", field.name, self.signature(&field.ty)))
                .collect();
            format!("{{{}}}", fields.join(","))
        };
        match ty {
            Ty::Enum(n) => self.enumerations.get(*n).map_or_else(String::new, |e| {
                let values: Vec<String> = e.values.iter().map(|(name, value)| format!("{name}={value}")).collect();
                format!("({})", values.join(","))
            }),
            Ty::Struct(n) => self.structures.get(*n).map_or_else(String::new, fields),
            Ty::Block(n) => self.blocks.get(*n).map_or_else(String::new, fields),
            Ty::Array(array) => {
                let ranges: Vec<String> = array
                    .ranges
                    .iter()
                    .map(|(low, count)| format!("{low}+{count}"))
                    .collect();
                format!("[{}]{}", ranges.join(","), self.signature(&array.of))
            }
            Ty::Scalar(_) | Ty::Wrong => self.name(ty),
        }
    }

    pub(crate) fn structure(&self, ty: &Ty) -> Option<&Structure> {
        match ty {
            Ty::Struct(n) => self.structures.get(*n),
            Ty::Block(n) => self.blocks.get(*n),
            _ => None,
        }
    }
}

impl Ty {
    /// The elementary type that holds its values: of an enumeration DINT.
    pub(crate) const fn scalar(&self) -> Option<Scalar> {
        match self {
            Self::Scalar(scalar) => Some(*scalar),
            Self::Enum(_) => Some(Scalar::Dint),
            _ => None,
        }
    }
}
