//! What shall run, and what was removed.
//!
//! Owns: that an older copy never replaces a newer one, and that a removed loop stays removed. Never: changes an intent.
//!
//! ```text
//!   nothing ──put_intent──► held ──remove_intent / put_tombstone──► removed (tombstone: last revision n)
//!                            ▲                                          │
//!                            └────────put_intent with revision > n──────┘
//! ```
//!
//! The tombstone stays after that, so that late copies and late records of the removed loop are still known as such.

use bumpless_core::{Intent, LoopId};
use redb::{Durability, ReadableTable, ReadableTableMetadata as _, TableDefinition, TableError, WriteTransaction};
use serde::{Deserialize, Serialize};

use crate::{
    database::Change,
    error::Error,
    format::{self, RowError},
    records::RECORDS,
    store::Store,
};

/// Intents by loop.
const INTENTS: TableDefinition<&str, &[u8]> = TableDefinition::new("intents");

/// By loop: the last revision before the removal, and a serial number that grows with each removal.
pub(crate) const TOMBSTONES: TableDefinition<&str, (u64, u64)> = TableDefinition::new("tombstones");

/// Tombstones that are kept; beyond that the oldest goes. 80 bytes each, and a host that was away while this many loops
/// were removed has been replaced.
const TOMBSTONES_MAX: u64 = 10_000;

/// A loop that was removed. Travels to the cell's other hosts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tombstone {
    /// The loop.
    pub loop_id: LoopId,
    /// The last revision number that was given for it. Copies up to this one are dead; a new loop of that name starts after.
    pub last_revision: u64,
}

impl Store {
    /// Keeps an intent. It is on disk when this returns. The same copy again changes nothing.
    ///
    /// # Errors
    /// [`Error::Stale`] when a newer copy is held, [`Error::Removed`] for a copy from before the loop's removal,
    /// [`Error::Unreadable`], [`Error::Io`], [`Error::Database`].
    pub fn put_intent(&self, intent: &Intent) -> Result<(), Error> {
        let loop_id = &intent.loop_id;
        let what = || format!("the intent of loop {loop_id:?}");
        let row = format::encode(what, intent)?;
        // Before anything is promised: a row that cannot be read back would be a loop lost at the next start.
        if decode_intent(&row).is_err() {
            return Err(Error::Unreadable { what: what() });
        }
        self.inner
            .base
            .write("write an intent to", Durability::Immediate, |txn| {
                if let Some(last_revision) = buried(&txn.open_table(TOMBSTONES)?, loop_id)?
                    && intent.last_revision <= last_revision
                {
                    return Ok(Change::Drop(Err(Error::Removed {
                        loop_id: loop_id.clone(),
                        last_revision,
                    })));
                }
                let mut intents = txn.open_table(INTENTS)?;
                let held = intents
                    .get(loop_id.as_str())?
                    .map(|held| (held.value() == row, decode_intent(held.value())));
                match held {
                    Some((true, _)) => return Ok(Change::Drop(Ok(()))),
                    Some((false, Ok(held))) if held.position() > intent.position() => {
                        let (offered, held) = (intent.position(), held.position());
                        return Ok(Change::Drop(Err(Error::Stale {
                            loop_id: loop_id.clone(),
                            offered,
                            held,
                        })));
                    }
                    // A row that cannot be read is worth less than one that can.
                    _ => {}
                }
                intents.insert(loop_id.as_str(), row.as_slice())?;
                Ok(Change::Keep(Ok(())))
            })?
    }

    /// The intent of one loop.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn intent(&self, loop_id: &LoopId) -> Result<Option<Intent>, Error> {
        let row = self
            .inner
            .base
            .read("read an intent from", |txn| match txn.open_table(INTENTS) {
                Ok(table) => Ok(table.get(loop_id.as_str())?.map(|row| decode_intent(row.value()))),
                Err(TableError::TableDoesNotExist(_)) => Ok(None),
                Err(error) => Err(error.into()),
            })?;
        Ok(row.and_then(|row| self.row("intents", loop_id.as_str(), row)))
    }

    /// All intents, by loop. Rows that cannot be read are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn intents(&self) -> Result<Vec<Intent>, Error> {
        let rows = self.inner.base.read("read the intents from", |txn| {
            let table = match txn.open_table(INTENTS) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut rows = Vec::new();
            for row in table.iter()? {
                let (key, value) = row?;
                rows.push((key.value().to_owned(), decode_intent(value.value())));
            }
            Ok(rows)
        })?;
        Ok(rows
            .into_iter()
            .filter_map(|(key, row)| self.row("intents", &key, row))
            .collect())
    }

    /// Removes a loop's intent and its last record, and leaves a tombstone, which is returned for the other hosts; none
    /// when there was no intent. It is on disk when this returns.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn remove_intent(&self, loop_id: &LoopId) -> Result<Option<Tombstone>, Error> {
        let removed = self
            .inner
            .base
            .write("remove an intent from", Durability::Immediate, |txn| {
                let mut intents = txn.open_table(INTENTS)?;
                let Some(held) = intents.remove(loop_id.as_str())?.map(|row| decode_intent(row.value())) else {
                    return Ok(Change::Drop(None));
                };
                txn.open_table(RECORDS)?.remove(loop_id.as_str())?;
                if let Ok(held) = &held {
                    bury(txn, loop_id, held.last_revision)?;
                }
                Ok(Change::Keep(Some(held)))
            })?;
        let Some(row) = removed else { return Ok(None) };
        let held = self.row("intents", loop_id.as_str(), row);
        Ok(held.map(|held| Tombstone {
            loop_id: loop_id.clone(),
            last_revision: held.last_revision,
        }))
    }

    /// Takes another host's word that a loop was removed. Says whether an intent was removed here. One that was created
    /// anew since stays. It is on disk when this returns.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn put_tombstone(&self, tombstone: &Tombstone) -> Result<bool, Error> {
        let Tombstone { loop_id, last_revision } = tombstone;
        self.inner
            .base
            .write("write a tombstone to", Durability::Immediate, |txn| {
                let news = bury(txn, loop_id, *last_revision)?;
                let mut intents = txn.open_table(INTENTS)?;
                let dead = match intents.get(loop_id.as_str())?.map(|row| decode_intent(row.value())) {
                    Some(Ok(held)) => held.last_revision <= *last_revision,
                    Some(Err(_)) => true,
                    None => false,
                };
                if dead {
                    intents.remove(loop_id.as_str())?;
                    txn.open_table(RECORDS)?.remove(loop_id.as_str())?;
                }
                Ok(if news || dead {
                    Change::Keep(dead)
                } else {
                    Change::Drop(false)
                })
            })
    }

    /// All loops that were removed, for hosts that were away.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn tombstones(&self) -> Result<Vec<Tombstone>, Error> {
        self.inner.base.read("read the tombstones from", |txn| {
            let table = match txn.open_table(TOMBSTONES) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut tombstones = Vec::new();
            for row in table.iter()? {
                let (key, value) = row?;
                if let Ok(loop_id) = LoopId::new(key.value()) {
                    tombstones.push(Tombstone {
                        loop_id,
                        last_revision: value.value().0,
                    });
                }
            }
            Ok(tombstones)
        })
    }

    /// The last revision of a removed loop of this name; 0 where there was none. [`Intent::new`] starts after it.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn last_removed_revision(&self, loop_id: &LoopId) -> Result<u64, Error> {
        self.inner
            .base
            .read("read a tombstone from", |txn| match txn.open_table(TOMBSTONES) {
                Ok(table) => Ok(buried(&table, loop_id)?.unwrap_or(0)),
                Err(TableError::TableDoesNotExist(_)) => Ok(0),
                Err(error) => Err(error.into()),
            })
    }
}

fn decode_intent(row: &[u8]) -> Result<Intent, RowError> {
    format::decode(row)
}

/// The last revision of a removed loop.
pub(crate) fn buried(
    tombstones: &impl ReadableTable<&'static str, (u64, u64)>,
    loop_id: &LoopId,
) -> Result<Option<u64>, redb::StorageError> {
    Ok(tombstones.get(loop_id.as_str())?.map(|row| row.value().0))
}

/// Keeps the greater of two tombstones, and says whether that changed anything.
fn bury(txn: &WriteTransaction, loop_id: &LoopId, last_revision: u64) -> Result<bool, redb::Error> {
    let mut tombstones = txn.open_table(TOMBSTONES)?;
    if buried(&tombstones, loop_id)?.is_some_and(|held| held >= last_revision) {
        return Ok(false);
    }
    let mut newest = 0;
    let mut oldest: Option<(u64, String)> = None;
    for row in tombstones.iter()? {
        let (key, value) = row?;
        let (_, serial) = value.value();
        newest = newest.max(serial);
        if oldest.as_ref().is_none_or(|(least, _)| serial < *least) {
            oldest = Some((serial, key.value().to_owned()));
        }
    }
    tombstones.insert(loop_id.as_str(), (last_revision, newest.saturating_add(1)))?;
    if tombstones.len()? > TOMBSTONES_MAX
        && let Some((_, key)) = oldest
    {
        tombstones.remove(key.as_str())?;
    }
    Ok(true)
}
