//! Requests and answers of Modbus as bytes, for both sides: what a client sends and a server reads, and back.
//!
//! Pure: no connection, no time, no allocation beyond the answer itself. Never: believes a length that it was told.
//! Source: Modbus application protocol V1.1b3, section 6. The bytes here are the *PDU*: function and data, without what
//! the transport puts around them (that is `frame`).

use super::{exception::Exception, group::Table};
use crate::limits::{
    BITS_PER_WRITE_MAX, REGISTERS_PER_READ_MAX, REGISTERS_PER_READ_WRITE_MAX, REGISTERS_PER_WRITE_MAX,
};

/// What a device can be asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// Functions 1 to 4, by table.
    Read {
        /// The address space.
        table: Table,
        /// First address.
        start: u16,
        /// How many addresses: 1 to 2000 bits, 1 to 125 registers.
        count: u16,
    },
    /// Function 5.
    WriteCoil {
        /// The coil.
        address: u16,
        /// On or off.
        on: bool,
    },
    /// Function 6.
    WriteRegister {
        /// The register.
        address: u16,
        /// Its value.
        word: u16,
    },
    /// Function 15.
    WriteCoils {
        /// First coil.
        start: u16,
        /// 1 to 1968 of them.
        bits: Vec<bool>,
    },
    /// Function 16.
    WriteRegisters {
        /// First register.
        start: u16,
        /// 1 to 123 of them.
        words: Vec<u16>,
    },
    /// Function 22: the register becomes (register and `and`) or (`or` and not `and`).
    MaskWrite {
        /// The register.
        address: u16,
        /// Bits that stay.
        and: u16,
        /// What the other bits become.
        or: u16,
    },
    /// Function 23: writes first, then reads.
    ReadWrite {
        /// First register to read.
        read_start: u16,
        /// 1 to 125 of them.
        read_count: u16,
        /// First register to write.
        write_start: u16,
        /// 1 to 121 of them.
        words: Vec<u16>,
    },
    /// Function 43, type 14: who are you?
    Identify {
        /// 1 basic, 2 regular, 3 extended, 4 one object.
        depth: u8,
        /// First object, or the one.
        object: u8,
    },
}

/// What a device answers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// Coils or discrete inputs.
    Bits(Vec<bool>),
    /// Registers.
    Words(Vec<u16>),
    /// A write was done.
    Done,
    /// Objects of an identification with their numbers, and the number of the next one where there are more.
    Identity {
        /// How much the device can tell: see function 43, type 14.
        conformity: u8,
        /// Where to go on, if need be.
        next: Option<u8>,
        /// Number and text of each.
        objects: Vec<(u8, Vec<u8>)>,
    },
}

/// Why bytes are no answer to the request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fault {
    /// The device refused.
    Exception(Exception),
    /// It answered something else than was asked; in words.
    Malformed(String),
}

const READ_COILS: u8 = 1;
const READ_DISCRETE: u8 = 2;
const READ_HOLDING: u8 = 3;
const READ_INPUT: u8 = 4;
const WRITE_COIL: u8 = 5;
const WRITE_REGISTER: u8 = 6;
const WRITE_COILS: u8 = 15;
const WRITE_REGISTERS: u8 = 16;
const MASK_WRITE: u8 = 22;
const READ_WRITE: u8 = 23;
const ENCAPSULATED: u8 = 43;
/// The type of function 43 that reads the identification.
const IDENTIFY: u8 = 14;
/// Set in the function of an answer that is an exception.
pub(crate) const EXCEPTION_BIT: u8 = 0x80;

impl Request {
    /// The function's number.
    #[must_use]
    pub const fn function(&self) -> u8 {
        match self {
            Self::Read { table, .. } => match table {
                Table::Coil => READ_COILS,
                Table::Discrete => READ_DISCRETE,
                Table::Holding => READ_HOLDING,
                Table::Input => READ_INPUT,
            },
            Self::WriteCoil { .. } => WRITE_COIL,
            Self::WriteRegister { .. } => WRITE_REGISTER,
            Self::WriteCoils { .. } => WRITE_COILS,
            Self::WriteRegisters { .. } => WRITE_REGISTERS,
            Self::MaskWrite { .. } => MASK_WRITE,
            Self::ReadWrite { .. } => READ_WRITE,
            Self::Identify { .. } => ENCAPSULATED,
        }
    }

    /// Does it change anything?
    #[must_use]
    pub const fn is_write(&self) -> bool {
        !matches!(self, Self::Read { .. } | Self::Identify { .. })
    }

    /// The bytes. Counts beyond the protocol's are the caller's mistake; the device refuses them.
    #[must_use]
    pub fn encode(&self) -> Vec<u8> {
        let mut out = vec![self.function()];
        let mut put = |words: &[u16]| out.extend(words.iter().flat_map(|word| word.to_be_bytes()));
        match self {
            Self::Read { start, count, .. } => put(&[*start, *count]),
            Self::WriteCoil { address, on } => put(&[*address, if *on { 0xFF00 } else { 0 }]),
            Self::WriteRegister { address, word } => put(&[*address, *word]),
            Self::MaskWrite { address, and, or } => put(&[*address, *and, *or]),
            Self::WriteCoils { start, bits } => {
                put(&[*start, bits.len() as u16]);
                let bytes = packed(bits);
                out.push(bytes.len() as u8);
                out.extend(bytes);
            }
            Self::WriteRegisters { start, words } => {
                put(&[*start, words.len() as u16]);
                out.push((2 * words.len()) as u8);
                out.extend(words.iter().flat_map(|word| word.to_be_bytes()));
            }
            Self::ReadWrite {
                read_start,
                read_count,
                write_start,
                words,
            } => {
                put(&[*read_start, *read_count, *write_start, words.len() as u16]);
                out.push((2 * words.len()) as u8);
                out.extend(words.iter().flat_map(|word| word.to_be_bytes()));
            }
            Self::Identify { depth, object } => out.extend([IDENTIFY, *depth, *object]),
        }
        out
    }

    /// What a client asks.
    ///
    /// # Errors
    /// The exception that the protocol has for it: 1 for a function that does not exist here, 3 for counts, lengths and
    /// values that cannot be, 2 for addresses beyond 65,535.
    pub fn parse(pdu: &[u8]) -> Result<Self, Exception> {
        let (&function, data) = pdu.split_first().ok_or(Exception::FUNCTION)?;
        let word = |at: usize| word_at(data, at).ok_or(Exception::VALUE);
        let exactly = |length: usize| {
            if data.len() == length {
                Ok(())
            } else {
                Err(Exception::VALUE)
            }
        };
        // The bytes behind a count, whose own length is said once more.
        let rest = |at: usize, wanted: usize| match data.get(at..) {
            Some([length, rest @ ..]) if usize::from(*length) == wanted && rest.len() == wanted => Ok(rest),
            _ => Err(Exception::VALUE),
        };
        match function {
            READ_COILS | READ_DISCRETE | READ_HOLDING | READ_INPUT => {
                exactly(4)?;
                let table = match function {
                    READ_COILS => Table::Coil,
                    READ_DISCRETE => Table::Discrete,
                    READ_HOLDING => Table::Holding,
                    _ => Table::Input,
                };
                let (start, count) = (word(0)?, word(2)?);
                counted(start, count, table.read_max())?;
                Ok(Self::Read { table, start, count })
            }
            WRITE_COIL => {
                exactly(4)?;
                let on = match word(2)? {
                    0 => false,
                    0xFF00 => true,
                    _ => return Err(Exception::VALUE),
                };
                Ok(Self::WriteCoil { address: word(0)?, on })
            }
            WRITE_REGISTER => {
                exactly(4)?;
                Ok(Self::WriteRegister {
                    address: word(0)?,
                    word: word(2)?,
                })
            }
            WRITE_COILS => {
                let (start, count) = (word(0)?, word(2)?);
                let bytes = rest(4, usize::from(count).div_ceil(8))?;
                counted(start, count, BITS_PER_WRITE_MAX)?;
                Ok(Self::WriteCoils {
                    start,
                    bits: unpacked(bytes, usize::from(count)),
                })
            }
            WRITE_REGISTERS => {
                let (start, count) = (word(0)?, word(2)?);
                let bytes = rest(4, 2 * usize::from(count))?;
                counted(start, count, REGISTERS_PER_WRITE_MAX)?;
                Ok(Self::WriteRegisters {
                    start,
                    words: words_of(bytes),
                })
            }
            MASK_WRITE => {
                exactly(6)?;
                Ok(Self::MaskWrite {
                    address: word(0)?,
                    and: word(2)?,
                    or: word(4)?,
                })
            }
            READ_WRITE => {
                let (read_start, read_count, write_start, count) = (word(0)?, word(2)?, word(4)?, word(6)?);
                let bytes = rest(8, 2 * usize::from(count))?;
                counted(read_start, read_count, REGISTERS_PER_READ_MAX)?;
                counted(write_start, count, REGISTERS_PER_READ_WRITE_MAX)?;
                Ok(Self::ReadWrite {
                    read_start,
                    read_count,
                    write_start,
                    words: words_of(bytes),
                })
            }
            ENCAPSULATED => match data {
                [IDENTIFY, depth @ 1..=4, object] => Ok(Self::Identify {
                    depth: *depth,
                    object: *object,
                }),
                [IDENTIFY, ..] => Err(Exception::VALUE),
                _ => Err(Exception::FUNCTION),
            },
            _ => Err(Exception::FUNCTION),
        }
    }

    /// What the device's bytes say to this request.
    ///
    /// # Errors
    /// An exception, or why the bytes are no answer to what was asked.
    pub fn answer(&self, pdu: &[u8]) -> Result<Answer, Fault> {
        let own = self.function();
        let other = |what: &str| Fault::Malformed(what.to_owned());
        let Some((&function, data)) = pdu.split_first() else {
            return Err(other("the answer is empty"));
        };
        if function == own | EXCEPTION_BIT {
            return Err(match data {
                [code] => Fault::Exception(Exception(*code)),
                _ => other("the exception has another length than one code"),
            });
        }
        if function != own {
            return Err(Fault::Malformed(format!(
                "the answer is to function {function}, not {own}"
            )));
        }
        let length = || other("the answer has another length than asked for");
        let echo = |bytes: usize| {
            let asked = self.encode();
            match (data.get(..bytes), asked.get(1..=bytes)) {
                (Some(said), Some(meant)) if said.len() == data.len() && said == meant => Ok(Answer::Done),
                (Some(said), Some(_)) if said.len() == data.len() => {
                    Err(other("the answer confirms something else than was written"))
                }
                _ => Err(length()),
            }
        };
        let counted = |wanted: usize| match data {
            [said, bytes @ ..] if usize::from(*said) == wanted && bytes.len() == wanted => Ok(bytes),
            _ => Err(length()),
        };
        match self {
            Self::Read { table, count, .. } if table.is_bits() => {
                let count = usize::from(*count);
                counted(count.div_ceil(8)).map(|bytes| Answer::Bits(unpacked(bytes, count)))
            }
            Self::Read { count, .. } | Self::ReadWrite { read_count: count, .. } => {
                counted(2 * usize::from(*count)).map(|bytes| Answer::Words(words_of(bytes)))
            }
            Self::MaskWrite { .. } => echo(6),
            Self::WriteCoil { .. }
            | Self::WriteRegister { .. }
            | Self::WriteCoils { .. }
            | Self::WriteRegisters { .. } => echo(4),
            Self::Identify { depth, .. } => identity(*depth, data).ok_or_else(length),
        }
    }

    /// The bytes of a server's answer. An answer of another kind than was asked for is the server's own mistake, and is
    /// told as such.
    #[must_use]
    pub fn respond(&self, answer: &Result<Answer, Exception>) -> Vec<u8> {
        let exception = |exception: Exception| vec![self.function() | EXCEPTION_BIT, exception.0];
        let mut out = vec![self.function()];
        match (self, answer) {
            (_, Err(refused)) => return exception(*refused),
            (Self::Read { .. }, Ok(Answer::Bits(bits))) => {
                let bytes = packed(bits);
                out.push(bytes.len() as u8);
                out.extend(bytes);
            }
            (Self::Read { .. } | Self::ReadWrite { .. }, Ok(Answer::Words(words))) => {
                out.push((2 * words.len()) as u8);
                out.extend(words.iter().flat_map(|word| word.to_be_bytes()));
            }
            (Self::MaskWrite { .. }, Ok(Answer::Done)) => return self.encode(),
            (_, Ok(Answer::Done)) => out.extend(self.encode().get(1..5).unwrap_or_default()),
            (
                Self::Identify { depth, .. },
                Ok(Answer::Identity {
                    conformity,
                    next,
                    objects,
                }),
            ) => {
                let more = if next.is_some() { 0xFF } else { 0 };
                out.extend([
                    IDENTIFY,
                    *depth,
                    *conformity,
                    more,
                    next.unwrap_or(0),
                    objects.len() as u8,
                ]);
                for (number, text) in objects {
                    out.extend([*number, text.len() as u8]);
                    out.extend(text);
                }
            }
            _ => return exception(Exception::FAILURE),
        }
        out
    }
}

/// Where a count or a last address cannot be, says so: the count first, as the protocol's diagrams do.
const fn counted(start: u16, count: u16, most: u16) -> Result<(), Exception> {
    if count == 0 || count > most {
        Err(Exception::VALUE)
    } else if start as u32 + count as u32 > 65_536 {
        Err(Exception::ADDRESS)
    } else {
        Ok(())
    }
}

fn identity(depth: u8, data: &[u8]) -> Option<Answer> {
    let [IDENTIFY, said, conformity, more, next, count, rest @ ..] = data else {
        return None;
    };
    let (mut objects, mut rest) = (Vec::new(), rest);
    for _ in 0..*count {
        let [number, length, behind @ ..] = rest else {
            return None;
        };
        objects.push((*number, behind.get(..usize::from(*length))?.to_vec()));
        rest = behind.get(usize::from(*length)..)?;
    }
    (*said == depth && rest.is_empty()).then(|| Answer::Identity {
        conformity: *conformity,
        next: (*more == 0xFF).then_some(*next),
        objects,
    })
}

fn word_at(bytes: &[u8], at: usize) -> Option<u16> {
    match bytes.get(at..at + 2) {
        Some([high, low]) => Some(u16::from_be_bytes([*high, *low])),
        _ => None,
    }
}

fn words_of(bytes: &[u8]) -> Vec<u16> {
    (0..bytes.len() / 2).filter_map(|n| word_at(bytes, 2 * n)).collect()
}

/// Eight bits a byte, the first in the lowest place.
fn packed(bits: &[bool]) -> Vec<u8> {
    let byte = |bits: &[bool]| bits.iter().rev().fold(0, |byte, on| byte << 1 | u8::from(*on));
    bits.chunks(8).map(byte).collect()
}

fn unpacked(bytes: &[u8], count: usize) -> Vec<bool> {
    let bit = |n: usize| bytes.get(n / 8).is_some_and(|byte| byte >> (n % 8) & 1 == 1);
    (0..count).map(bit).collect()
}

#[cfg(test)]
mod tests;
