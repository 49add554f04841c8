//! Programs that are at home on this host: one row each, with who owns it and what it saved.
//!
//! Owns: that a row is on disk when the call returns. Never: knows what is in it; deployment says so.

use redb::{Durability, ReadableTable as _, TableDefinition, TableError};
use serde::{Serialize, de::DeserializeOwned};

use crate::{database::Change, error::Error, format, store::Store};

/// Rows by the program's name.
const PROGRAMS: TableDefinition<&str, &[u8]> = TableDefinition::new("programs");

impl Store {
    /// Keeps a program under its name, in the place of what was there. It is on disk when this returns.
    ///
    /// # Errors
    /// [`Error::Row`] and [`Error::Size`] for one that makes no row, [`Error::Io`], [`Error::Database`].
    pub fn put_program<T: Serialize>(&self, name: &str, program: &T) -> Result<(), Error> {
        let row = format::encode(|| format!("program {name}"), program)?;
        self.inner
            .base
            .write("write a program to", Durability::Immediate, |txn| {
                txn.open_table(PROGRAMS)?.insert(name, row.as_slice())?;
                Ok(Change::Keep(()))
            })
    }

    /// All programs with their names. Rows that cannot be read are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn programs<T: DeserializeOwned>(&self) -> Result<Vec<(String, T)>, Error> {
        let rows = self.inner.base.read("read the programs from", |txn| {
            let table = match txn.open_table(PROGRAMS) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut rows = Vec::new();
            for row in table.iter()? {
                let (name, value) = row?;
                rows.push((name.value().to_owned(), format::decode(value.value())));
            }
            Ok(rows)
        })?;
        Ok(rows
            .into_iter()
            .filter_map(|(name, row)| {
                let row = self.row("programs", &name, row)?;
                Some((name, row))
            })
            .collect())
    }

    /// Forgets a program; says whether there was one. On disk when this returns.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn remove_program(&self, name: &str) -> Result<bool, Error> {
        self.inner
            .base
            .write("remove a program from", Durability::Immediate, |txn| {
                let there = txn.open_table(PROGRAMS)?.remove(name)?.is_some();
                Ok(if there { Change::Keep(true) } else { Change::Drop(false) })
            })
    }
}
