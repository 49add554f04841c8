//! The form of a row: one version byte, then postcard.
//!
//! Owns: the version numbers. Never: guesses. A row of another version, a cut one, or one with bytes left over is an error
//! that the caller reports and skips. Postcard has no field names, so every change of a stored type's shape is a new version
//! here; the old one is then read by its own branch or skipped.

use serde::{Serialize, de::DeserializeOwned};

use crate::error::Error;

/// Version of every row that is written now.
pub(crate) const ROW_VERSION: u8 = 3;

/// Bytes of one row at most. The largest is a record: 64 KiB of state and some tens of messages of 4 KiB.
pub(crate) const ROW_BYTES_MAX: usize = 1024 * 1024;

/// Why a row cannot be read.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum RowError {
    #[error("the row is empty")]
    Empty,
    #[error("the row has version {0}; version {ROW_VERSION} is known")]
    Version(u8),
    #[error("the row does not decode")]
    Body(#[source] postcard::Error),
    #[error("the row has {0} bytes too many")]
    LeftOver(usize),
}

/// The row of a value. `what` names it in errors.
pub(crate) fn encode<T: Serialize>(what: impl Fn() -> String, value: &T) -> Result<Vec<u8>, Error> {
    let row = postcard::to_extend(value, vec![ROW_VERSION]).map_err(|source| Error::Row { what: what(), source })?;
    if row.len() > ROW_BYTES_MAX {
        return Err(Error::Size {
            what: what(),
            bytes: row.len(),
            max: ROW_BYTES_MAX,
        });
    }
    Ok(row)
}

/// The value of a row.
pub(crate) fn decode<T: DeserializeOwned>(row: &[u8]) -> Result<T, RowError> {
    let (version, body) = row.split_first().ok_or(RowError::Empty)?;
    if *version != ROW_VERSION {
        return Err(RowError::Version(*version));
    }
    let (value, rest) = postcard::take_from_bytes(body).map_err(RowError::Body)?;
    if rest.is_empty() {
        Ok(value)
    } else {
        Err(RowError::LeftOver(rest.len()))
    }
}
