//! Secrets and small settings of this host.
//!
//! Owns: that a secret is made once and read by nobody else. Never: says what a secret or a setting is for.

use std::{
    fs::File,
    io::{self, Read as _},
    sync::PoisonError,
};

use redb::{Durability, ReadableTable as _, TableDefinition, TableError};
use serde::{Serialize, de::DeserializeOwned};

use crate::{
    database::Change,
    error::Error,
    format,
    store::{Store, restrict, write_durably},
};

/// Settings by name.
const SETTINGS: TableDefinition<&str, &[u8]> = TableDefinition::new("settings");

/// Bytes of one setting: settings are numbers and short texts.
const SETTING_BYTES_MAX: usize = 4096;

/// Bytes of a secret: the key length of HMAC-SHA-256 (RFC 2104, section 3).
const SECRET_BYTES: usize = 32;

impl Store {
    /// The secret of that name: 32 random bytes, made at the first call and the same ever after. Kept in a file of its own
    /// that only this user may read, so that it can be copied to another host, or deleted, without the rest.
    ///
    /// # Errors
    /// [`Error::Name`], [`Error::Secret`], [`Error::Io`].
    pub fn secret(&self, name: &str) -> Result<[u8; 32], Error> {
        check_name(name)?;
        let path = self.secrets_dir().join(name);
        let _files = self.inner.files.lock().unwrap_or_else(PoisonError::into_inner);
        match File::open(&path) {
            Ok(file) => {
                restrict(&path, 0o600)?;
                let mut bytes = Vec::new();
                file.take(SECRET_BYTES as u64 + 1)
                    .read_to_end(&mut bytes)
                    .map_err(|error| Error::io("read", &path, error))?;
                bytes.try_into().map_err(|bytes: Vec<u8>| Error::Secret {
                    path,
                    bytes: bytes.len(),
                })
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let mut secret = [0; SECRET_BYTES];
                getrandom::fill(&mut secret)
                    .map_err(|error| Error::io("draw a random number for", &path, io::Error::other(error)))?;
                write_durably(&path, &secret)?;
                Ok(secret)
            }
            Err(error) => Err(Error::io("open", &path, error)),
        }
    }

    /// A setting of this host; none where it was never set.
    ///
    /// # Errors
    /// [`Error::Name`], [`Error::Setting`] when it was set with another type, [`Error::Io`], [`Error::Database`].
    pub fn host_value<T: DeserializeOwned>(&self, name: &str) -> Result<Option<T>, Error> {
        check_name(name)?;
        let row = self
            .inner
            .base
            .read("read a setting from", |txn| match txn.open_table(SETTINGS) {
                Ok(table) => Ok(table.get(name)?.map(|row| format::decode(row.value()))),
                Err(TableError::TableDoesNotExist(_)) => Ok(None),
                Err(error) => Err(error.into()),
            })?;
        match row {
            None => Ok(None),
            // Unlike the other rows a setting has no second copy in the cell, so the caller must hear of it.
            Some(row) => match self.row("settings", name, row) {
                Some(value) => Ok(Some(value)),
                None => Err(Error::Setting { name: name.to_owned() }),
            },
        }
    }

    /// Sets a setting of this host. It is on disk when this returns.
    ///
    /// # Errors
    /// [`Error::Name`], [`Error::Size`] over 4,096 bytes, [`Error::Io`], [`Error::Database`].
    pub fn set_host_value<T: Serialize>(&self, name: &str, value: &T) -> Result<(), Error> {
        check_name(name)?;
        let what = || format!("the setting {name:?}");
        let row = format::encode(what, value)?;
        if row.len() > SETTING_BYTES_MAX {
            return Err(Error::Size {
                what: what(),
                bytes: row.len(),
                max: SETTING_BYTES_MAX,
            });
        }
        self.inner
            .base
            .write("write a setting to", Durability::Immediate, |txn| {
                txn.open_table(SETTINGS)?.insert(name, row.as_slice())?;
                Ok(Change::Keep(()))
            })
    }

    /// Adds one to a number, and returns it: 1 at the first call. It is on disk when this returns, so no two starts of a
    /// host ever get the same one.
    ///
    /// # Errors
    /// [`Error::Name`], [`Error::Setting`] when the setting is no number or at its end, [`Error::Io`], [`Error::Database`].
    pub fn count_up(&self, name: &str) -> Result<u64, Error> {
        check_name(name)?;
        let bad = || Error::Setting { name: name.to_owned() };
        self.inner
            .base
            .write("write a setting to", Durability::Immediate, |txn| {
                let mut table = txn.open_table(SETTINGS)?;
                let held = match table.get(name)?.map(|row| format::decode::<u64>(row.value())) {
                    None => 0,
                    Some(Ok(held)) => held,
                    Some(Err(_)) => return Ok(Change::Drop(Err(bad()))),
                };
                let Some(next) = held.checked_add(1) else {
                    return Ok(Change::Drop(Err(bad())));
                };
                match format::encode(|| format!("the setting {name:?}"), &next) {
                    Ok(row) => {
                        table.insert(name, row.as_slice())?;
                        Ok(Change::Keep(Ok(next)))
                    }
                    Err(error) => Ok(Change::Drop(Err(error))),
                }
            })?
    }
}

/// Names become file names, so nothing that could leave the folder or end like a draft.
fn check_name(name: &str) -> Result<(), Error> {
    let allowed = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-';
    if (1..=64).contains(&name.len()) && name.bytes().all(allowed) {
        Ok(())
    } else {
        Err(Error::Name(name.chars().take(64).collect()))
    }
}
