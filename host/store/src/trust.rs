//! What the cell trusts, and signatures of components: one row each, by name.
//!
//! Owns: that a row is on disk when the call returns. Never: knows what is in it; deployment says so.

use redb::{Durability, ReadableTable as _, TableDefinition, TableError};
use serde::{Serialize, de::DeserializeOwned};

use crate::{database::Change, error::Error, format, store::Store};

/// Rows by name: of a document, or of a component's digest.
const TRUST: TableDefinition<&str, &[u8]> = TableDefinition::new("trust");

impl Store {
    /// Keeps a row under its name, in the place of what was there. It is on disk when this returns.
    ///
    /// # Errors
    /// [`Error::Row`] and [`Error::Size`] for one that makes no row, [`Error::Io`], [`Error::Database`].
    pub fn put_trust<T: Serialize>(&self, name: &str, value: &T) -> Result<(), Error> {
        let row = format::encode(|| format!("trust {name}"), value)?;
        self.inner
            .base
            .write("write what is trusted to", Durability::Immediate, |txn| {
                txn.open_table(TRUST)?.insert(name, row.as_slice())?;
                Ok(Change::Keep(()))
            })
    }

    /// All rows of this kind with their names. Rows of another kind, and those that cannot be read, are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn trust<T: DeserializeOwned>(&self, is_wanted: impl Fn(&str) -> bool) -> Result<Vec<(String, T)>, Error> {
        let rows = self.inner.base.read("read what is trusted from", |txn| {
            let table = match txn.open_table(TRUST) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut rows = Vec::new();
            for row in table.iter()? {
                let (name, value) = row?;
                if is_wanted(name.value()) {
                    rows.push((name.value().to_owned(), format::decode(value.value())));
                }
            }
            Ok(rows)
        })?;
        Ok(rows
            .into_iter()
            .filter_map(|(name, row)| {
                let row = self.row("trust", &name, row)?;
                Some((name, row))
            })
            .collect())
    }

    /// Forgets a row; says whether there was one. On disk when this returns.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn remove_trust(&self, name: &str) -> Result<bool, Error> {
        self.inner
            .base
            .write("remove what is trusted from", Durability::Immediate, |txn| {
                let there = txn.open_table(TRUST)?.remove(name)?.is_some();
                Ok(if there { Change::Keep(true) } else { Change::Drop(false) })
            })
    }
}
