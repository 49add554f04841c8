//! Alarms of the loops at home here: one row per loop, and what happened to them, newest kept.
//!
//! Owns: that rows are on disk when the call returns, and the bound of what happened. Never: knows what is in a row;
//! deployment says so.

use redb::{Durability, ReadableTable as _, ReadableTableMetadata as _, TableDefinition, TableError};
use serde::{Serialize, de::DeserializeOwned};

use crate::{database::Change, error::Error, format, store::Store};

/// Boards by the loop's name.
const BOARDS: TableDefinition<&str, &[u8]> = TableDefinition::new("alarm_boards");
/// What happened, by a number that grows.
const CHANGES: TableDefinition<u64, &[u8]> = TableDefinition::new("alarm_changes");
/// Changes that are kept: at an operator's greatest bearable rate, ten in ten minutes, more than two months.
pub const ALARM_CHANGES_MAX: u64 = 100_000;

impl Store {
    /// Keeps the boards, each in the place of what was there, and adds what happened under its numbers, which grow. On disk when
    /// this returns.
    ///
    /// # Errors
    /// [`Error::Row`] and [`Error::Size`] for what makes no row, [`Error::Io`], [`Error::Database`].
    pub fn keep_alarms<B: Serialize, C: Serialize>(
        &self,
        boards: &[(String, B)],
        changes: &[(u64, C)],
    ) -> Result<(), Error> {
        let boards = boards
            .iter()
            .map(|(name, board)| Ok((name, format::encode(|| format!("alarms of {name}"), board)?)))
            .collect::<Result<Vec<_>, Error>>()?;
        let changes = changes
            .iter()
            .map(|(number, change)| Ok((*number, format::encode(|| "a change of an alarm".to_owned(), change)?)))
            .collect::<Result<Vec<_>, Error>>()?;
        self.inner.base.write("write alarms to", Durability::Immediate, |txn| {
            let mut table = txn.open_table(BOARDS)?;
            for (name, row) in &boards {
                table.insert(name.as_str(), row.as_slice())?;
            }
            let mut table = txn.open_table(CHANGES)?;
            for (number, row) in &changes {
                table.insert(number, row.as_slice())?;
            }
            while table.len()? > ALARM_CHANGES_MAX {
                table.pop_first()?;
            }
            Ok(Change::Keep(()))
        })
    }

    /// All boards with the names of their loops. Rows that cannot be read are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn alarm_boards<B: DeserializeOwned>(&self) -> Result<Vec<(String, B)>, Error> {
        let rows = self.inner.base.read("read the alarms from", |txn| {
            let table = match txn.open_table(BOARDS) {
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
                let board = self.row("alarms", &name, row)?;
                Some((name, board))
            })
            .collect())
    }

    /// The greatest number of what happened; 0 where nothing did.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn last_alarm_change(&self) -> Result<u64, Error> {
        self.inner
            .base
            .read("read the alarms' changes from", |txn| match txn.open_table(CHANGES) {
                Ok(table) => Ok(table.last()?.map_or(0, |(number, _)| number.value())),
                Err(TableError::TableDoesNotExist(_)) => Ok(0),
                Err(error) => Err(error.into()),
            })
    }

    /// What happened after a number, oldest first, at most `max`. Rows that cannot be read are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn alarm_changes_after<C: DeserializeOwned>(&self, number: u64, max: usize) -> Result<Vec<C>, Error> {
        self.changes(number.saturating_add(1), false, max)
    }

    /// What happened, newest first, at most `max`. Rows that cannot be read are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn alarm_changes<C: DeserializeOwned>(&self, max: usize) -> Result<Vec<C>, Error> {
        self.changes(0, true, max)
    }

    fn changes<C: DeserializeOwned>(&self, first: u64, newest_first: bool, max: usize) -> Result<Vec<C>, Error> {
        let rows = self.inner.base.read("read the alarms' changes from", |txn| {
            let table = match txn.open_table(CHANGES) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut range = table.range(first..)?;
            let next = || if newest_first { range.next_back() } else { range.next() };
            let mut rows = Vec::new();
            for row in std::iter::from_fn(next).take(max) {
                let (number, value) = row?;
                rows.push((number.value(), format::decode(value.value())));
            }
            Ok(rows)
        })?;
        Ok(rows
            .into_iter()
            .filter_map(|(number, row)| self.row("alarm changes", &number.to_string(), row))
            .collect())
    }

    /// Forgets the board of a loop that is gone; what happened stays. On disk when this returns.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn remove_alarm_board(&self, name: &str) -> Result<(), Error> {
        self.inner
            .base
            .write("remove alarms from", Durability::Immediate, |txn| {
                let there = txn.open_table(BOARDS)?.remove(name)?.is_some();
                Ok(if there { Change::Keep(()) } else { Change::Drop(()) })
            })
    }
}
