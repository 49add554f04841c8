//! Programs that are at home on this host, or that it keeps a copy of: one row each, with who owns it and what it saved.
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
        self.put_programs(&[(name, program)])
    }

    /// As [`Store::put_program`], for several at once: all of them are on disk when this returns, or none.
    ///
    /// # Errors
    /// As [`Store::put_program`].
    pub fn put_programs<T: Serialize>(&self, programs: &[(&str, &T)]) -> Result<(), Error> {
        let rows = programs
            .iter()
            .map(|(name, program)| Ok((*name, format::encode(|| format!("program {name}"), program)?)))
            .collect::<Result<Vec<_>, Error>>()?;
        self.inner
            .base
            .write("write programs to", Durability::Immediate, |txn| {
                let mut table = txn.open_table(PROGRAMS)?;
                for (name, row) in &rows {
                    table.insert(*name, row.as_slice())?;
                }
                drop(table);
                Ok(Change::Keep(()))
            })
    }

    /// The program of a name; none where there is none, or where its row cannot be read.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn program<T: DeserializeOwned>(&self, name: &str) -> Result<Option<T>, Error> {
        let row = self.inner.base.read("read a program from", |txn| {
            let table = match txn.open_table(PROGRAMS) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(None),
                Err(error) => return Err(error.into()),
            };
            Ok(table.get(name)?.map(|value| format::decode(value.value())))
        })?;
        Ok(row.and_then(|row| self.row("programs", name, row)))
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn programs_come_back_after_a_start_and_go_when_they_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        {
            let store = Store::open(folder.path()).unwrap();
            assert!(store.programs::<u64>().unwrap().is_empty());
            assert_eq!(store.program::<u64>("a").unwrap(), None);
            store.put_programs(&[("a", &1_u64), ("b", &2)]).unwrap();
            store.put_program("a", &3_u64).unwrap();
            assert!(store.remove_program("b").unwrap());
            assert!(!store.remove_program("b").unwrap());
        }
        let store = Store::open(folder.path()).unwrap();
        assert_eq!(store.programs::<u64>().unwrap(), [("a".to_owned(), 3)]);
        assert_eq!(store.program::<u64>("a").unwrap(), Some(3));
        assert_eq!(
            store.program::<String>("a").unwrap(),
            None,
            "a row of another shape is skipped"
        );
    }
}
