//! The form of a chunk: some records of one loop, in order, compressed.
//!
//! ```text
//! version (1) | length before compression (4) | check (8) | lz4 block of postcard
//! ```
//! Owns: that form. Never: guesses. A chunk of another version, a cut one, or one whose check does not hold is an error that
//! the reader counts and skips. The check is there because a few wrong bits may decompress to records that never were.

use std::sync::Arc;

use bumpless_core::{Digest, Record};

use crate::format::ROW_VERSION;

/// Records of one chunk at most: a second of a loop at 1 kHz.
pub(super) const RECORDS_MAX: usize = 1024;

/// Bytes of a chunk before compression at which no further record goes in.
pub(super) const BYTES_FULL: usize = 1024 * 1024;

/// Bytes of a chunk before compression at most: a full one and the largest record. What says more is not ours.
const BYTES_MAX: usize = 4 * 1024 * 1024;

const CHECK_BYTES: usize = 8;
const HEAD_BYTES: usize = 1 + 4 + CHECK_BYTES;

/// Why a chunk cannot be read.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ChunkError {
    #[error("the chunk is cut")]
    Cut,
    #[error("the chunk has version {0}; version {ROW_VERSION} is known")]
    Version(u8),
    #[error("the chunk's bytes are not those that were written")]
    Check,
    #[error("the chunk does not decompress")]
    Compression,
    #[error("the chunk does not decode")]
    Body(#[source] postcard::Error),
}

fn check(body: &[u8]) -> [u8; CHECK_BYTES] {
    let digest = Digest::of(body);
    let mut check = [0; CHECK_BYTES];
    for (to, from) in check.iter_mut().zip(digest.as_bytes()) {
        *to = *from;
    }
    check
}

/// Bytes that a record takes before compression, about: enough for bounds, and cheap enough for a cycle's thread.
pub(super) fn weight(record: &Record) -> usize {
    let messages = record.messages.iter().chain(&record.heard);
    let messages: usize = messages.map(|m| m.topic.len() + m.data.len()).sum();
    let log: usize = record.log.iter().map(|line| line.text.len()).sum();
    512 + record.state.len() + record.readings.len() * 32 + record.applied.len() * 24 + messages + log
}

/// The chunk of some records.
pub(crate) fn encode(records: &[Arc<Record>]) -> Result<Vec<u8>, postcard::Error> {
    let plain = postcard::to_allocvec(records)?;
    let length = u32::try_from(plain.len()).map_err(|_| postcard::Error::SerializeBufferFull)?;
    Ok(sealed(length, &lz4_flex::block::compress(&plain)))
}

/// The chunk of a body that says to have so many bytes before compression.
pub(crate) fn sealed(length: u32, body: &[u8]) -> Vec<u8> {
    let mut chunk = Vec::with_capacity(HEAD_BYTES + body.len());
    chunk.push(ROW_VERSION);
    chunk.extend(length.to_le_bytes());
    chunk.extend(check(body));
    chunk.extend(body);
    chunk
}

/// The records of a chunk.
pub(crate) fn decode(chunk: &[u8]) -> Result<Vec<Arc<Record>>, ChunkError> {
    let (version, rest) = chunk.split_first().ok_or(ChunkError::Cut)?;
    if *version != ROW_VERSION {
        return Err(ChunkError::Version(*version));
    }
    let (length, rest) = rest.split_first_chunk::<4>().ok_or(ChunkError::Cut)?;
    let (checked, body) = rest.split_first_chunk::<CHECK_BYTES>().ok_or(ChunkError::Cut)?;
    if *checked != check(body) {
        return Err(ChunkError::Check);
    }
    let length = u32::from_le_bytes(*length) as usize;
    if length > BYTES_MAX {
        return Err(ChunkError::Compression);
    }
    let plain = lz4_flex::block::decompress(body, length).map_err(|_| ChunkError::Compression)?;
    match postcard::take_from_bytes(&plain) {
        Ok((records, [])) => Ok(records),
        Ok(_) => Err(ChunkError::Compression),
        Err(error) => Err(ChunkError::Body(error)),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;
    use crate::tests::samples::record;

    #[test]
    fn records_come_back_and_take_less_room() {
        let records: Vec<_> = (1..=100).map(|seq| record("level-1", 1, seq)).collect();
        let chunk = encode(&records).unwrap();
        assert_eq!(decode(&chunk).unwrap(), records);
        let plain = postcard::to_allocvec(&records).unwrap().len();
        assert!(chunk.len() * 2 < plain, "{} of {plain}", chunk.len());
        assert_eq!(decode(&encode(&[]).unwrap()).unwrap(), []);
    }

    #[test]
    fn other_bytes_are_no_chunk() {
        let good = encode(&[record("level-1", 1, 1)]).unwrap();
        for at in 0..good.len() {
            let mut bad = good.clone();
            bad[at] ^= 0x10;
            assert!(decode(&bad).is_err(), "byte {at}");
            assert!(decode(&good[..at]).is_err(), "cut at {at}");
        }
        let mut long = good;
        long.push(0);
        assert_eq!(decode(&long), Err(ChunkError::Check));
    }

    #[test]
    fn a_length_beyond_all_reason_takes_no_memory() {
        let body = lz4_flex::block::compress(&[0; 8]);
        let mut chunk = vec![ROW_VERSION];
        chunk.extend(u32::MAX.to_le_bytes());
        chunk.extend(check(&body));
        chunk.extend(body);
        assert_eq!(decode(&chunk), Err(ChunkError::Compression));
    }
}
