//! What the transport puts around a request: a header on TCP, unit and checksum on a serial line.
//!
//! Pure: bytes in, frames out. A stream may be cut anywhere; `More` asks for the rest. Sources: Modbus messaging on TCP/IP
//! V1.0b, section 3.1.3; Modbus over serial line V1.02, sections 2.5 and 6.2.2.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::request::EXCEPTION_BIT;

/// Longest request or answer without what is around it.
pub const PDU_BYTES_MAX: usize = 253;
/// Bytes of the TCP header, the unit among them.
pub const HEADER_BYTES: usize = 7;
/// Bytes of the longest frame on TCP.
pub const FRAME_BYTES_MAX: usize = HEADER_BYTES + PDU_BYTES_MAX;

/// How requests travel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Framing {
    /// With a header that numbers each request: Modbus TCP.
    #[default]
    Tcp,
    /// With a checksum, as on a serial line; also through a terminal server on TCP.
    Rtu,
}

/// A piece of the stream.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Cut {
    /// The frame is not whole yet.
    More,
    /// One frame.
    Frame {
        /// Number of the request; 0 where the transport has none.
        transaction: u16,
        /// The unit.
        unit: u8,
        /// Where the request or answer is.
        pdu: Range<usize>,
        /// Where the next frame begins.
        end: usize,
    },
    /// This is no Modbus; why, in words.
    Broken(String),
}

/// A frame for TCP.
#[must_use]
pub fn with_header(transaction: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(HEADER_BYTES + pdu.len());
    out.extend(transaction.to_be_bytes());
    out.extend([0, 0]);
    out.extend((pdu.len() as u16).wrapping_add(1).to_be_bytes());
    out.push(unit);
    out.extend(pdu);
    out
}

/// The first frame of a TCP stream.
#[must_use]
pub fn cut_header(bytes: &[u8]) -> Cut {
    // Told as early as it can be: a stream that is no Modbus may never bring seven bytes.
    if let [_, _, high, low, ..] = bytes
        && (*high, *low) != (0, 0)
    {
        let protocol = u16::from_be_bytes([*high, *low]);
        return Cut::Broken(format!("the stream is no Modbus: its frame names protocol {protocol}"));
    }
    let [a, b, _, _, high, low, unit, ..] = bytes else {
        return Cut::More;
    };
    let length = usize::from(u16::from_be_bytes([*high, *low]));
    // Unit and function at least.
    if !(2..=PDU_BYTES_MAX + 1).contains(&length) {
        return Cut::Broken(format!("the stream is no Modbus: its frame claims {length} bytes"));
    }
    let end = HEADER_BYTES - 1 + length;
    if bytes.len() < end {
        return Cut::More;
    }
    Cut::Frame {
        transaction: u16::from_be_bytes([*a, *b]),
        unit: *unit,
        pdu: HEADER_BYTES..end,
        end,
    }
}

/// A frame for a serial line.
#[must_use]
pub fn with_checksum(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(pdu.len() + 3);
    out.push(unit);
    out.extend(pdu);
    let sum = checksum(&out);
    out.extend(sum.to_le_bytes());
    out
}

/// The answer to a request on a serial line: the first stretch of bytes that begins with the unit and the function (or its
/// exception), has the length that its own bytes tell, and a good checksum. What is before it is noise, or the echo of the
/// request on a two-wire line. None asks for more.
#[must_use]
pub fn find_answer(bytes: &[u8], unit: u8, function: u8) -> Option<Range<usize>> {
    (0..bytes.len()).find_map(|start| {
        let rest = bytes.get(start..)?;
        let &[first, second, third, ..] = rest else {
            return None;
        };
        if first != unit || second & !EXCEPTION_BIT != function {
            return None;
        }
        let length = if second & EXCEPTION_BIT != 0 {
            5
        } else {
            match function {
                1..=4 | 23 => 5 + usize::from(third),
                22 => 10,
                43 => identity_length(rest)?,
                _ => 8,
            }
        };
        let frame = rest.get(..length)?;
        let (body, sum) = frame.split_at_checked(length - 2)?;
        (checksum(body).to_le_bytes() == sum).then_some(start + 1..start + length - 2)
    })
}

/// Bytes of an identification on a serial line: its objects tell their own lengths.
fn identity_length(bytes: &[u8]) -> Option<usize> {
    let count = *bytes.get(7)?;
    let mut end = 8;
    for _ in 0..count {
        end += 2 + usize::from(*bytes.get(end + 1)?);
    }
    Some(end + 2)
}

/// CRC-16 of Modbus over serial line, 6.2.2: polynomial 0xA001, beginning with 0xFFFF, sent low byte first.
#[must_use]
pub fn checksum(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |sum, byte| {
        (0..8).fold(sum ^ u16::from(*byte), |sum, _| {
            if sum & 1 == 1 { sum >> 1 ^ 0xA001 } else { sum >> 1 }
        })
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn checksums_are_the_standards() {
        // Modbus over serial line V1.02, 6.2.2: 02 07 gives 41 12.
        assert_eq!(checksum(&[0x02, 0x07]), 0x1241);
        assert_eq!(with_checksum(1, &[3, 0, 0, 0, 10]), [1, 3, 0, 0, 0, 10, 0xC5, 0xCD]);
    }

    #[test]
    fn frames_are_cut_or_told_from_something_else() {
        let frame = with_header(7, 9, &[3, 2, 0, 1]);
        assert_eq!(frame, [0, 7, 0, 0, 0, 5, 9, 3, 2, 0, 1]);
        for end in 0..frame.len() {
            assert_eq!(cut_header(&frame[..end]), Cut::More, "{end}");
        }
        let whole = Cut::Frame {
            transaction: 7,
            unit: 9,
            pdu: 7..11,
            end: 11,
        };
        assert_eq!(cut_header(&frame), whole);
        // What comes behind is the next one's.
        assert_eq!(cut_header(&[frame.as_slice(), &[1, 2]].concat()), whole);
        for (bytes, part) in [
            (&b"HTTP/1.1 400"[..], "protocol 21584"),
            (&[0, 1, 0, 0, 0, 1, 1], "claims 1 bytes"),
            (&[0, 1, 0, 0, 0, 0, 1], "claims 0 bytes"),
            (&[0, 1, 0, 0, 0, 255, 1], "claims 255 bytes"),
            (&[0, 1, 0, 0, 0xFF, 0xFF, 1], "claims 65535 bytes"),
        ] {
            assert!(
                matches!(cut_header(bytes), Cut::Broken(text) if text.contains(part)),
                "{bytes:?}"
            );
        }
    }

    #[test]
    fn answers_are_found_behind_noise_and_echo() {
        let request = with_checksum(1, &[3, 0, 0, 0, 1]);
        let answer = with_checksum(1, &[3, 2, 0x12, 0x34]);
        let exception = with_checksum(1, &[0x83, 2]);
        for before in [&[][..], &[0xFF, 0, 1, 3], &request, &[1, 3, 250]] {
            for (frame, pdu) in [(&answer, &[3, 2, 0x12, 0x34][..]), (&exception, &[0x83, 2])] {
                let stream = [before, frame].concat();
                let found = find_answer(&stream, 1, 3);
                assert_eq!(
                    found.map(|range| stream[range].to_vec()).as_deref(),
                    Some(pdu),
                    "{stream:?}"
                );
                assert_eq!(find_answer(&stream[..stream.len() - 1], 1, 3), None);
            }
        }
        let mut damaged = answer.clone();
        damaged[3] ^= 1;
        assert_eq!(find_answer(&damaged, 1, 3), None);
        assert_eq!(find_answer(&answer, 2, 3), None);
        assert_eq!(find_answer(&answer, 1, 4), None);
        let identity = with_checksum(1, &[43, 14, 1, 0x81, 0, 0, 1, 0, 2, b'o', b'k']);
        assert_eq!(find_answer(&identity, 1, 43), Some(1..12));
    }

    proptest! {
        #[test]
        fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..600), unit in any::<u8>()) {
            if let Cut::Frame { pdu, end, .. } = cut_header(&bytes) {
                prop_assert!(pdu.end == end && end <= bytes.len() && (1..=PDU_BYTES_MAX).contains(&pdu.len()));
            }
            for function in [1, 3, 6, 16, 22, 23, 43] {
                if let Some(range) = find_answer(&bytes, unit, function) {
                    prop_assert!(range.start < range.end && range.end + 2 <= bytes.len());
                }
            }
        }

        #[test]
        fn frames_split_anywhere_come_out_whole(
            pdus in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 1..=PDU_BYTES_MAX), 1..8),
            sizes in proptest::collection::vec(1..40_usize, 1..20),
        ) {
            let stream: Vec<u8> = pdus
                .iter()
                .enumerate()
                .flat_map(|(n, pdu)| with_header(n as u16, 1, pdu))
                .collect();
            let (mut buffer, mut found, mut rest, mut turn) = (Vec::new(), Vec::new(), stream.as_slice(), 0);
            while !rest.is_empty() {
                let (piece, behind) = rest.split_at(sizes[turn % sizes.len()].min(rest.len()));
                turn += 1;
                rest = behind;
                buffer.extend_from_slice(piece);
                while let Cut::Frame { transaction, pdu, end, .. } = cut_header(&buffer) {
                    prop_assert_eq!(usize::from(transaction), found.len());
                    found.push(buffer[pdu].to_vec());
                    buffer.drain(..end);
                }
            }
            prop_assert_eq!(found, pdus);
            prop_assert!(buffer.is_empty());
        }
    }
}
