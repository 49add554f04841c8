//! Points that are held at a value by hand: one row each, so that a force outlives its host's process.
//!
//! Owns: that a row is on disk when the call returns. Never: knows what is in it; deployment says so.

use bumpless_core::PointId;
use redb::{Durability, ReadableTable as _, TableDefinition, TableError};
use serde::{Serialize, de::DeserializeOwned};

use crate::{database::Change, error::Error, format, store::Store};

/// Rows by point.
const FORCES: TableDefinition<&str, &[u8]> = TableDefinition::new("forces");

impl Store {
    /// Keeps a force, in the place of what was there. It is on disk when this returns.
    ///
    /// # Errors
    /// [`Error::Row`] and [`Error::Size`] for one that makes no row, [`Error::Io`], [`Error::Database`].
    pub fn put_force<T: Serialize>(&self, point: &PointId, force: &T) -> Result<(), Error> {
        let row = format::encode(|| format!("the force of {point}"), force)?;
        self.inner.base.write("write a force to", Durability::Immediate, |txn| {
            txn.open_table(FORCES)?.insert(point.as_str(), row.as_slice())?;
            Ok(Change::Keep(()))
        })
    }

    /// All forces with their points. Rows that cannot be read are skipped and counted.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn forces<T: DeserializeOwned>(&self) -> Result<Vec<(PointId, T)>, Error> {
        let rows = self.inner.base.read("read the forces from", |txn| {
            let table = match txn.open_table(FORCES) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut rows = Vec::new();
            for row in table.iter()? {
                let (point, value) = row?;
                rows.push((point.value().to_owned(), format::decode(value.value())));
            }
            Ok(rows)
        })?;
        Ok(rows
            .into_iter()
            .filter_map(|(point, row)| Some((PointId::new(&point).ok()?, self.row("forces", &point, row)?)))
            .collect())
    }

    /// Forgets a force; says whether there was one. On disk when this returns.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn remove_force(&self, point: &PointId) -> Result<bool, Error> {
        self.inner
            .base
            .write("remove a force from", Durability::Immediate, |txn| {
                let there = txn.open_table(FORCES)?.remove(point.as_str())?.is_some();
                Ok(if there { Change::Keep(true) } else { Change::Drop(false) })
            })
    }
}
