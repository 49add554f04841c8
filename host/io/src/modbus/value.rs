//! Numbers in registers: types, and the orders in which devices lay out their bytes and words.
//!
//! Modbus defines 16-bit registers, most significant byte first, and nothing wider; how wider numbers are laid out is
//! each vendor's choice.

use serde::{Deserialize, Serialize};

/// Registers of the widest number.
pub const WORDS_MAX: usize = 4;

/// What kind of number a point's registers hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ValueType {
    /// One bit; in a register, 0 is off and anything else on.
    Bool,
    /// 16 bits, unsigned.
    U16,
    /// 16 bits, two's complement.
    I16,
    /// 32 bits, unsigned.
    U32,
    /// 32 bits, two's complement.
    I32,
    /// 64 bits, unsigned; exact up to 2^53.
    U64,
    /// 64 bits, two's complement; exact up to ±2^53.
    I64,
    /// IEEE 754 single.
    F32,
    /// IEEE 754 double.
    F64,
}

/// Which register of a wider number comes first.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WordOrder {
    /// The most significant.
    #[default]
    HighFirst,
    /// The least significant.
    LowFirst,
}

/// Which byte of a register comes first.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ByteOrder {
    /// The most significant, as Modbus says.
    #[default]
    Big,
    /// The least significant, as some devices do.
    Little,
}

/// A number as its registers, or its bit, in the order of the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Words {
    words: [u16; WORDS_MAX],
    count: u8,
}

impl Words {
    /// One register.
    pub(crate) const fn one(word: u16) -> Self {
        Self {
            words: [word, 0, 0, 0],
            count: 1,
        }
    }

    /// The registers.
    #[must_use]
    pub fn as_slice(&self) -> &[u16] {
        self.words.get(..usize::from(self.count)).unwrap_or(&[])
    }
}

impl ValueType {
    /// How many registers it takes.
    #[must_use]
    pub const fn words(self) -> u16 {
        match self {
            Self::Bool | Self::U16 | Self::I16 => 1,
            Self::U32 | Self::I32 | Self::F32 => 2,
            Self::U64 | Self::I64 | Self::F64 => 4,
        }
    }

    /// Least and greatest raw number, as far as a double tells them apart.
    #[must_use]
    pub fn range(self) -> (f64, f64) {
        // 2^53: beyond it a double skips whole numbers.
        let exact = 9_007_199_254_740_992.0;
        match self {
            Self::Bool => (0.0, 1.0),
            Self::U16 => (0.0, f64::from(u16::MAX)),
            Self::I16 => (f64::from(i16::MIN), f64::from(i16::MAX)),
            Self::U32 => (0.0, f64::from(u32::MAX)),
            Self::I32 => (f64::from(i32::MIN), f64::from(i32::MAX)),
            Self::U64 => (0.0, exact),
            Self::I64 => (-exact, exact),
            Self::F32 => (f64::from(f32::MIN), f64::from(f32::MAX)),
            Self::F64 => (f64::MIN, f64::MAX),
        }
    }

    /// The raw number in registers as they came; none where there are too few.
    #[must_use]
    pub fn decode(self, words: &[u16], word_order: WordOrder, byte_order: ByteOrder) -> Option<f64> {
        let count = usize::from(self.words());
        let words = words.get(..count)?;
        let bits = (0..count).fold(0_u64, |bits, position| {
            let from = if word_order == WordOrder::HighFirst {
                position
            } else {
                count - 1 - position
            };
            (bits << 16) | u64::from(in_order(words.get(from).copied().unwrap_or(0), byte_order))
        });
        Some(match self {
            Self::Bool => f64::from(u8::from(bits != 0)),
            Self::U16 => f64::from(bits as u16),
            Self::I16 => f64::from(bits as u16 as i16),
            Self::U32 => f64::from(bits as u32),
            Self::I32 => f64::from(bits as u32 as i32),
            Self::U64 => bits as f64,
            Self::I64 => bits as i64 as f64,
            Self::F32 => f64::from(f32::from_bits(bits as u32)),
            Self::F64 => f64::from_bits(bits),
        })
    }

    /// The registers for a raw number, rounded to the nearest whole number where the type is whole, and held at the
    /// type's ends.
    #[must_use]
    pub fn encode(self, raw: f64, word_order: WordOrder, byte_order: ByteOrder) -> Words {
        let (low, high) = self.range();
        let held = raw.max(low).min(high);
        let whole = held.round();
        // Casts from float saturate; `held` keeps them from having to.
        let bits = match self {
            Self::Bool => u64::from(raw >= 0.5),
            Self::U16 | Self::U32 | Self::U64 => whole as u64,
            Self::I16 => u64::from(whole as i16 as u16),
            Self::I32 => u64::from(whole as i32 as u32),
            Self::I64 => whole as i64 as u64,
            Self::F32 => u64::from((held as f32).to_bits()),
            Self::F64 => held.to_bits(),
        };
        self.lay_out(bits, word_order, byte_order)
    }

    /// Bits as registers in the order of the wire.
    #[must_use]
    pub fn lay_out(self, bits: u64, word_order: WordOrder, byte_order: ByteOrder) -> Words {
        let count = usize::from(self.words());
        let mut words = [0; WORDS_MAX];
        for (position, word) in words.iter_mut().take(count).enumerate() {
            let from_low = if word_order == WordOrder::HighFirst {
                count - 1 - position
            } else {
                position
            };
            *word = in_order((bits >> (16 * from_low)) as u16, byte_order);
        }
        Words {
            words,
            count: count as u8,
        }
    }
}

/// Some neighbouring bits of a register, as an unsigned number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BitField {
    first: u8,
    count: u8,
}

impl BitField {
    /// `count` bits from `first` on, 0 the least significant; none where they leave the register.
    #[must_use]
    pub const fn new(first: u8, count: u8) -> Option<Self> {
        if first < 16 && count >= 1 && count <= 16 - first {
            Some(Self { first, count })
        } else {
            None
        }
    }

    /// The greatest number.
    #[must_use]
    pub const fn most(self) -> u16 {
        u16::MAX >> (16 - self.count)
    }

    /// Ones where the field is in its register.
    #[must_use]
    pub const fn mask(self) -> u16 {
        self.most() << self.first
    }

    /// The number in a register.
    #[must_use]
    pub const fn of(self, register: u16) -> u16 {
        (register & self.mask()) >> self.first
    }

    /// A register with the number in its place and zeros elsewhere; a greater number is held at the greatest.
    #[must_use]
    pub const fn put(self, number: u16) -> u16 {
        let most = self.most();
        (if number > most { most } else { number }) << self.first
    }
}

const fn in_order(word: u16, order: ByteOrder) -> u16 {
    match order {
        ByteOrder::Big => word,
        ByteOrder::Little => word.swap_bytes(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use proptest::prelude::*;

    use super::*;

    const TYPES: [ValueType; 9] = [
        ValueType::Bool,
        ValueType::U16,
        ValueType::I16,
        ValueType::U32,
        ValueType::I32,
        ValueType::U64,
        ValueType::I64,
        ValueType::F32,
        ValueType::F64,
    ];
    const WORD_ORDERS: [WordOrder; 2] = [WordOrder::HighFirst, WordOrder::LowFirst];
    const BYTE_ORDERS: [ByteOrder; 2] = [ByteOrder::Big, ByteOrder::Little];

    #[test]
    fn layouts_are_those_of_the_vendors() {
        use {ByteOrder::*, WordOrder::*};
        // 123.456 as a single is 0x42F6E979.
        let cases: [(ValueType, &[u16], WordOrder, ByteOrder, f64); 9] = [
            (ValueType::F32, &[0x42F6, 0xE979], HighFirst, Big, 123.456),
            (ValueType::F32, &[0xE979, 0x42F6], LowFirst, Big, 123.456),
            (ValueType::F32, &[0xF642, 0x79E9], HighFirst, Little, 123.456),
            (ValueType::F32, &[0x79E9, 0xF642], LowFirst, Little, 123.456),
            (ValueType::I16, &[0xFFFE], HighFirst, Big, -2.0),
            (ValueType::U32, &[0x0001, 0x0000], HighFirst, Big, 65_536.0),
            (ValueType::I32, &[0xFFFF, 0xFFFF], LowFirst, Big, -1.0),
            (ValueType::I64, &[0xFFFF, 0xFFFF, 0xFFFF, 0xFFFE], HighFirst, Big, -2.0),
            (ValueType::F64, &[0x0000, 0x0000, 0x0000, 0x4000], LowFirst, Big, 2.0),
        ];
        for (kind, words, word_order, byte_order, value) in cases {
            let got = kind.decode(words, word_order, byte_order).unwrap();
            assert!((got - value).abs() < 1e-5, "{kind:?} {words:04X?}: {got}");
            assert_eq!(
                kind.encode(got, word_order, byte_order).as_slice(),
                words,
                "{kind:?} {value}"
            );
        }
        assert_eq!(ValueType::F32.decode(&[1], HighFirst, Big), None);
    }

    #[test]
    fn fields_are_taken_from_and_put_into_their_register() {
        let field = BitField::new(4, 3).unwrap();
        assert_eq!((field.most(), field.mask()), (7, 0x70));
        assert_eq!((field.of(0xFFAF), field.put(5), field.put(9)), (2, 0x50, 0x70));
        let whole = BitField::new(0, 16).unwrap();
        assert_eq!((whole.most(), whole.of(0xABCD)), (0xFFFF, 0xABCD));
        assert_eq!(BitField::new(15, 1).map(BitField::mask), Some(0x8000));
        for (first, count) in [(16, 1), (0, 0), (0, 17), (15, 2), (255, 255)] {
            assert_eq!(BitField::new(first, count), None, "{first} {count}");
        }
    }

    #[test]
    fn numbers_beyond_the_type_stay_at_its_end() {
        for kind in TYPES {
            for raw in [f64::MAX, -f64::MAX, 1e6, -1e6] {
                let words = kind.encode(raw, WordOrder::HighFirst, ByteOrder::Big);
                let back = kind
                    .decode(words.as_slice(), WordOrder::HighFirst, ByteOrder::Big)
                    .unwrap();
                let (low, high) = kind.range();
                assert!((low..=high).contains(&back), "{kind:?} {raw}: {back}");
            }
        }
        assert_eq!(
            ValueType::U16
                .encode(2.5, WordOrder::HighFirst, ByteOrder::Big)
                .as_slice(),
            [3]
        );
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(raw in -30_000.0..30_000.0_f64, kind in 0..9_usize, orders in 0..4_usize) {
            let kind = TYPES[kind];
            let (word_order, byte_order) = (WORD_ORDERS[orders % 2], BYTE_ORDERS[orders / 2]);
            let (low, high) = kind.range();
            let expected = match kind {
                ValueType::F32 => f64::from(raw as f32),
                ValueType::F64 => raw,
                ValueType::Bool => f64::from(u8::from(raw >= 0.5)),
                _ => raw.round().max(low).min(high),
            };
            let words = kind.encode(raw, word_order, byte_order);
            prop_assert_eq!(words.as_slice().len(), usize::from(kind.words()));
            prop_assert_eq!(kind.decode(words.as_slice(), word_order, byte_order), Some(expected));
        }
    }
}
