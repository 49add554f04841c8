//! The last record of each loop: what a host goes on from when no other host can tell it.
//!
//! Owns: one row per loop, which only moves forward in (term, seq). Never: history; that is a stream, this is a register.
//!
//! Durability: a record is kept in memory by its transaction and reaches the disk with the next [`Store::sync`] or any
//! durable write. A power cut or a kill so costs up to a second of records, of which the standbys hold newer copies anyway.
//! A sync for each would be some 10 per second for the life of the disk.

use std::sync::Arc;

use bumpless_core::{LoopId, Record};
use redb::{Durability, ReadableTable as _, TableDefinition, TableError};

use crate::{
    database::Change,
    error::Error,
    format::{self, RowError},
    intents::{TOMBSTONES, buried},
    store::Store,
};

/// By loop: term, seq, and the record's row. The position stands outside the row, so that a write needs not decode it.
pub(crate) const RECORDS: TableDefinition<&str, (u64, u64, &[u8])> = TableDefinition::new("records");

impl Store {
    /// Keeps the newest record of each loop in `records`; those that are older than what is held, or of a loop that was
    /// removed, are passed over. One that is too large for a row is logged and passed over. Not on disk until [`Store::sync`].
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`]; then none of them was kept.
    pub fn put_records(&self, records: &[Arc<Record>]) -> Result<(), Error> {
        if records.is_empty() {
            return Ok(());
        }
        let rows: Vec<(&Record, Vec<u8>)> = records
            .iter()
            .filter_map(|record| {
                let what = || format!("the last record of loop {:?}", record.loop_id);
                match format::encode(what, record.as_ref()) {
                    Ok(row) => Some((record.as_ref(), row)),
                    Err(error) => {
                        tracing::warn!(loop_id = %record.loop_id, %error, "a record was not kept");
                        None
                    }
                }
            })
            .collect();
        self.inner.base.write("write records to", Durability::None, |txn| {
            let tombstones = txn.open_table(TOMBSTONES)?;
            let mut table = txn.open_table(RECORDS)?;
            let mut changed = false;
            for (record, row) in &rows {
                let key = record.loop_id.as_str();
                let (term, seq) = record.position();
                let old = table.get(key)?.is_some_and(|held| {
                    let (held_term, held_seq, _) = held.value();
                    (held_term, held_seq) >= (term, seq)
                });
                if old || buried(&tombstones, &record.loop_id)?.is_some_and(|last| record.revision <= last) {
                    continue;
                }
                table.insert(key, (term, seq, row.as_slice()))?;
                changed = true;
            }
            Ok(if changed { Change::Keep(()) } else { Change::Drop(()) })
        })
    }

    /// The last record of one loop.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn last_record(&self, loop_id: &LoopId) -> Result<Option<Record>, Error> {
        let row = self
            .inner
            .base
            .read("read a record from", |txn| match txn.open_table(RECORDS) {
                Ok(table) => Ok(table.get(loop_id.as_str())?.map(|row| decode_record(row.value().2))),
                Err(TableError::TableDoesNotExist(_)) => Ok(None),
                Err(error) => Err(error.into()),
            })?;
        Ok(row.and_then(|row| self.row("records", loop_id.as_str(), row)))
    }

    /// The last record of every loop. Rows that cannot be read are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn last_records(&self) -> Result<Vec<Record>, Error> {
        let rows = self.inner.base.read("read the records from", |txn| {
            let table = match txn.open_table(RECORDS) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut rows = Vec::new();
            for row in table.iter()? {
                let (key, value) = row?;
                rows.push((key.value().to_owned(), decode_record(value.value().2)));
            }
            Ok(rows)
        })?;
        Ok(rows
            .into_iter()
            .filter_map(|(key, row)| self.row("records", &key, row))
            .collect())
    }

    /// Forgets a loop's last record; says whether there was one. On disk when this returns.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn remove_record(&self, loop_id: &LoopId) -> Result<bool, Error> {
        self.inner
            .base
            .write("remove a record from", Durability::Immediate, |txn| {
                let there = txn.open_table(RECORDS)?.remove(loop_id.as_str())?.is_some();
                Ok(if there { Change::Keep(true) } else { Change::Drop(false) })
            })
    }

    /// Brings everything written so far to the disk.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn sync(&self) -> Result<(), Error> {
        self.inner
            .base
            .write("sync", Durability::Immediate, |_| Ok(Change::Keep(())))
    }
}

fn decode_record(row: &[u8]) -> Result<Record, RowError> {
    format::decode(row)
}
