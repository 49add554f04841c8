//! Accounts and tokens of the cell: one row, replaced as a whole.
//!
//! Owns: that the row is on disk when the call returns. Never: knows what is in it; deployment says so.

use redb::{Durability, TableDefinition, TableError};
use serde::{Serialize, de::DeserializeOwned};

use crate::{database::Change, error::Error, format, store::Store};

/// One row.
const ACCESS: TableDefinition<&str, &[u8]> = TableDefinition::new("access");

/// Its key.
const REGISTER: &str = "register";

impl Store {
    /// Keeps who may do what, in the place of what was there. It is on disk when this returns.
    ///
    /// # Errors
    /// [`Error::Row`] and [`Error::Size`] for one that makes no row, [`Error::Io`], [`Error::Database`].
    pub fn put_access<T: Serialize>(&self, register: &T) -> Result<(), Error> {
        let row = format::encode(|| "the register of accounts".to_owned(), register)?;
        self.inner
            .base
            .write("write accounts to", Durability::Immediate, |txn| {
                txn.open_table(ACCESS)?.insert(REGISTER, row.as_slice())?;
                Ok(Change::Keep(()))
            })
    }

    /// Who may do what, as it was kept; none where it never was.
    ///
    /// # Errors
    /// [`Error::Access`] where the row cannot be read: a host that forgot its accounts would be an open one. [`Error::Io`],
    /// [`Error::Database`].
    pub fn access<T: DeserializeOwned>(&self) -> Result<Option<T>, Error> {
        let row = self
            .inner
            .base
            .read("read accounts from", |txn| match txn.open_table(ACCESS) {
                Ok(table) => Ok(table.get(REGISTER)?.map(|row| format::decode(row.value()))),
                Err(TableError::TableDoesNotExist(_)) => Ok(None),
                Err(error) => Err(error.into()),
            })?;
        match row {
            None => Ok(None),
            Some(row) => self.row("access", REGISTER, row).map(Some).ok_or(Error::Access),
        }
    }

    /// Writes a secret text into a file of its own beside the data, which only this user may read; in the place of what was there.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn put_secret_text(&self, name: &str, text: &str) -> Result<std::path::PathBuf, Error> {
        let path = self.inner.directory.join(name);
        crate::store::write_durably(&path, text.as_bytes())?;
        Ok(path)
    }

    /// Removes a file that [`Store::put_secret_text`] wrote; none is fine.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn remove_secret_text(&self, name: &str) -> Result<(), Error> {
        let path = self.inner.directory.join(name);
        match std::fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(Error::io("remove", &path, error)),
            _ => Ok(()),
        }
    }
}
