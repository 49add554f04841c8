//! Rollouts that were asked of this host: one row each, so that it goes on with them after a restart.
//!
//! Owns: that a row is on disk when the call returns. Never: knows what is in it; deployment says so.

use redb::{Durability, ReadableTable as _, TableDefinition, TableError};
use serde::{Serialize, de::DeserializeOwned};

use crate::{database::Change, error::Error, format, store::Store};

/// Rows by number.
const ROLLOUTS: TableDefinition<u64, &[u8]> = TableDefinition::new("rollouts");

impl Store {
    /// Keeps a rollout under its number, in the place of what was there. It is on disk when this returns.
    ///
    /// # Errors
    /// [`Error::Row`] and [`Error::Size`] for one that makes no row, [`Error::Io`], [`Error::Database`].
    pub fn put_rollout<T: Serialize>(&self, number: u64, rollout: &T) -> Result<(), Error> {
        let row = format::encode(|| format!("rollout {number}"), rollout)?;
        self.inner
            .base
            .write("write a rollout to", Durability::Immediate, |txn| {
                txn.open_table(ROLLOUTS)?.insert(number, row.as_slice())?;
                Ok(Change::Keep(()))
            })
    }

    /// All rollouts with their numbers, oldest first. Rows that cannot be read are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn rollouts<T: DeserializeOwned>(&self) -> Result<Vec<(u64, T)>, Error> {
        let rows = self.inner.base.read("read the rollouts from", |txn| {
            let table = match txn.open_table(ROLLOUTS) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut rows = Vec::new();
            for row in table.iter()? {
                let (number, value) = row?;
                rows.push((number.value(), format::decode(value.value())));
            }
            Ok(rows)
        })?;
        Ok(rows
            .into_iter()
            .filter_map(|(number, row)| Some((number, self.row("rollouts", &number.to_string(), row)?)))
            .collect())
    }

    /// Forgets a rollout; says whether there was one. On disk when this returns.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn remove_rollout(&self, number: u64) -> Result<bool, Error> {
        self.inner
            .base
            .write("remove a rollout from", Durability::Immediate, |txn| {
                let there = txn.open_table(ROLLOUTS)?.remove(number)?.is_some();
                Ok(if there { Change::Keep(true) } else { Change::Drop(false) })
            })
    }
}
