//! Which values are written together: neighbours in one request, bits of one register in one mask.
//!
//! Pure. Never: mixes units or tables, or passes the protocol's limits.

use super::{PlannedPoint, WriteWith, group::Table, outbox::Wish, request::Request};
use crate::limits::{BITS_PER_WRITE_MAX, REGISTERS_PER_READ_WRITE_MAX, REGISTERS_PER_WRITE_MAX};

/// What goes in one request, and the wishes that it fulfils.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Batch {
    pub(crate) unit_id: u8,
    pub(crate) start: u16,
    pub(crate) content: Content,
    pub(crate) wishes: Vec<Wish>,
}

/// What is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Content {
    Coils(Vec<bool>),
    Registers(Vec<u16>),
    /// A register becomes (register and `and`) or (`or` and not `and`).
    Mask {
        and: u16,
        or: u16,
    },
}

impl Batch {
    pub(crate) const fn table(&self) -> Table {
        match self.content {
            Content::Coils(_) => Table::Coil,
            Content::Registers(_) | Content::Mask { .. } => Table::Holding,
        }
    }

    /// How many addresses it covers.
    pub(crate) fn count(&self) -> u16 {
        match &self.content {
            Content::Coils(bits) => bits.len() as u16,
            Content::Registers(words) => words.len() as u16,
            Content::Mask { .. } => 1,
        }
    }

    /// The request that writes it.
    pub(crate) fn request(&self, write_with: WriteWith) -> Request {
        let single = write_with != WriteWith::Multiple;
        let start = self.start;
        match &self.content {
            Content::Coils(bits) => match bits.as_slice() {
                [on] if single => Request::WriteCoil {
                    address: start,
                    on: *on,
                },
                _ => Request::WriteCoils {
                    start,
                    bits: bits.clone(),
                },
            },
            Content::Registers(words) if write_with == WriteWith::ReadWrite => Request::ReadWrite {
                read_start: start,
                read_count: self.count(),
                write_start: start,
                words: words.clone(),
            },
            Content::Registers(words) => match words.as_slice() {
                [word] if single => Request::WriteRegister {
                    address: start,
                    word: *word,
                },
                _ => Request::WriteRegisters {
                    start,
                    words: words.clone(),
                },
            },
            Content::Mask { and, or } => Request::MaskWrite {
                address: start,
                and: *and,
                or: *or,
            },
        }
    }

    /// The request that reads it back.
    pub(crate) fn read_back(&self) -> Request {
        Request::Read {
            table: self.table(),
            start: self.start,
            count: self.count(),
        }
    }

    /// Does the device hold what was written? `words` are the registers, or bits as 0 and 1.
    pub(crate) fn is_held(&self, words: &[u16]) -> bool {
        match &self.content {
            Content::Coils(bits) => bits
                .iter()
                .map(|on| u16::from(*on))
                .eq(words.iter().map(|w| u16::from(*w != 0))),
            Content::Registers(written) => written == words,
            Content::Mask { and, or } => matches!(words, [word] if word & !and == or & !and),
        }
    }
}

/// Wishes by unit, table and address, in as few requests as `write_with` allows.
pub(crate) fn batches(points: &[PlannedPoint], mut wishes: Vec<Wish>, write_with: WriteWith) -> Vec<Batch> {
    let registers_max = if write_with == WriteWith::ReadWrite {
        REGISTERS_PER_READ_WRITE_MAX
    } else {
        REGISTERS_PER_WRITE_MAX
    };
    let key = |wish: &Wish| points.get(wish.point).map(|p| (p.unit_id, p.table, p.address));
    wishes.sort_by_key(key);
    let mut batches: Vec<Batch> = Vec::new();
    for wish in wishes {
        let (Some(point), Some(&first)) = (points.get(wish.point), wish.words.as_slice().first()) else {
            continue;
        };
        let content = match point.bits {
            Some(bits) => Content::Mask {
                and: !bits.mask(),
                or: bits.put(first),
            },
            None if point.table.is_bits() => Content::Coils(vec![first != 0]),
            None => Content::Registers(wish.words.as_slice().to_vec()),
        };
        let joins = |batch: &&mut Batch| {
            batch.unit_id == point.unit_id && batch.table() == point.table && write_with != WriteWith::Single
        };
        let behind = |batch: &Batch| u32::from(batch.start) + u32::from(batch.count()) == u32::from(point.address);
        if let Some(last) = batches.last_mut().filter(joins) {
            let is_behind = behind(last);
            let length = usize::from(last.count());
            let joined = match (&mut last.content, &content) {
                (Content::Coils(bits), Content::Coils(more))
                    if is_behind && length < usize::from(BITS_PER_WRITE_MAX) =>
                {
                    bits.extend(more);
                    true
                }
                (Content::Registers(words), Content::Registers(more))
                    if is_behind && length + more.len() <= usize::from(registers_max) =>
                {
                    words.extend(more);
                    true
                }
                (Content::Mask { and, or }, Content::Mask { and: mine, or: put }) if last.start == point.address => {
                    *and &= mine;
                    // Points that share bits: the later one counts, as it would in two requests.
                    *or = (*or & mine) | put;
                    true
                }
                _ => false,
            };
            if joined {
                last.wishes.push(wish);
                continue;
            }
        }
        batches.push(Batch {
            unit_id: point.unit_id,
            start: point.address,
            content,
            wishes: vec![wish],
        });
    }
    batches
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]
    use super::*;
    use crate::modbus::ModbusConfig;

    fn points(text: &str) -> Vec<PlannedPoint> {
        let config: ModbusConfig = toml::from_str(&format!("id = \"line\"\naddress = \"h:1\"\n{text}")).unwrap();
        config.plan(super::super::Transport::Tcp).unwrap().0.points
    }

    fn register(n: usize, address: u16, rest: &str) -> String {
        format!(
            "[[point]]\nid = \"p{n}\"\ntable = \"holding\"\naddress = {address}\nwritable = true\nlow = 0.0\nhigh = 1.0\n{rest}\n"
        )
    }

    fn wishes(points: &[PlannedPoint], values: &[(usize, f64)]) -> Vec<Wish> {
        values
            .iter()
            .map(|(point, value)| Wish {
                point: *point,
                words: super::super::outbox::encoded(&points[*point], *value),
                at_ns: 0,
            })
            .collect()
    }

    #[test]
    fn bits_of_one_register_share_a_mask() {
        let bit = |n, address, bit| {
            format!(
                "[[point]]\nid = \"p{n}\"\ntable = \"holding\"\naddress = {address}\nwritable = true\nbit = {bit}\n"
            )
        };
        let text = [
            bit(0, 4, 0),
            bit(1, 4, 15),
            bit(2, 5, 3),
            register(3, 6, "raw = [0, 7]\nbits = [4, 3]"),
        ]
        .concat();
        let points = points(&text);
        let all = wishes(&points, &[(0, 1.0), (1, 0.0), (2, 1.0), (3, 1.0)]);
        let made = batches(&points, all, WriteWith::Auto);
        let requests: Vec<Request> = made.iter().map(|b| b.request(WriteWith::Auto)).collect();
        assert_eq!(
            requests,
            [
                Request::MaskWrite {
                    address: 4,
                    and: 0x7FFE,
                    or: 1
                },
                Request::MaskWrite {
                    address: 5,
                    and: 0xFFF7,
                    or: 8
                },
                Request::MaskWrite {
                    address: 6,
                    and: 0xFF8F,
                    or: 0x70
                },
            ]
        );
        assert!(made[0].is_held(&[0x0101]) && !made[0].is_held(&[0x8001]) && !made[0].is_held(&[]));
    }

    #[test]
    fn functions_and_limits_follow_what_the_device_has() {
        let text: String = (0..130).map(|n| register(n, n as u16, "")).collect();
        let points = points(&text);
        let all = || wishes(&points, &(0..130).map(|n| (n, 1.0)).collect::<Vec<_>>());
        let counts = |with| -> Vec<usize> { batches(&points, all(), with).iter().map(|b| b.wishes.len()).collect() };
        assert_eq!(counts(WriteWith::Auto), [123, 7]);
        assert_eq!(counts(WriteWith::ReadWrite), [121, 9]);
        assert_eq!(counts(WriteWith::Single), vec![1; 130]);
        let one = |with| {
            batches(&points, wishes(&points, &[(0, 1.0)]), with)[0]
                .request(with)
                .function()
        };
        assert_eq!(
            [
                WriteWith::Auto,
                WriteWith::Single,
                WriteWith::Multiple,
                WriteWith::ReadWrite
            ]
            .map(one),
            [6, 6, 16, 23]
        );
    }
}
