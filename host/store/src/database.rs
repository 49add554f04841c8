//! The embedded database: opening, transactions, and coming back after a failed disk.
//!
//! Owns: the redb file. Never: knows what a row means.
//!
//! ```text
//!   open ──► working ──a read or write of the file fails──► broken ──next call opens it again──► working
//!                                                              └── that fails as well: the call's error, still broken
//! ```
//!
//! redb refuses everything after one failed write, for example on a full disk, until the file is opened again. So it is
//! opened again: a host must not need a restart because somebody freed some space.

use std::{
    fs::{File, OpenOptions},
    os::unix::fs::OpenOptionsExt,
    path::{Path, PathBuf},
    sync::{
        PoisonError, RwLock,
        atomic::{AtomicBool, Ordering},
    },
};

use redb::{
    Builder, Database, DatabaseError, Durability, ReadTransaction, ReadableDatabase, TableDefinition, TableError,
    WriteTransaction,
};

use crate::{error::Error, medium};

/// Facts about the file itself, by name.
const FACTS: TableDefinition<&str, u64> = TableDefinition::new("facts");

/// The fact that holds the format.
const FORMAT_FACT: &str = "format";

/// What a database is for decides how it is opened and written.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Use {
    /// Bytes of it that are kept in memory.
    pub(crate) cache_bytes: usize,
    /// Read all of it when it is opened, so that a damaged file is an error then and not a panic later. Takes as long as the
    /// file is large.
    pub(crate) check_all: bool,
    /// Write with each commit what makes opening after a crash quick, whatever the size.
    pub(crate) quick_repair: bool,
}

/// Small, and everything depends on it. 64 MiB are about the rows of a thousand loops.
pub(crate) const HOST: Use = Use {
    cache_bytes: 64 * 1024 * 1024,
    check_all: true,
    quick_repair: false,
};

/// How a file becomes a database. Tests put a failing disk between the two.
pub(crate) type Opener = Box<dyn Fn(&Builder, File) -> Result<Database, DatabaseError> + Send + Sync>;

/// What a writing closure made of its transaction.
pub(crate) enum Change<T> {
    /// Commit it.
    Keep(T),
    /// Nothing was changed: let it go, without a sync.
    Drop(T),
}

pub(crate) struct Base {
    path: PathBuf,
    usage: Use,
    opener: Opener,
    /// None only while it is being opened again, and after that failed.
    database: RwLock<Option<Database>>,
    broken: AtomicBool,
}

impl Base {
    /// Opens or creates the database `path`. A new one gets `format`; one with a newer format is refused.
    /// The caller holds the lock of the directory.
    pub(crate) fn open(path: &Path, format: u64, usage: Use, opener: Opener) -> Result<Self, Error> {
        if !path.exists() {
            create(path, format, usage, &opener)?;
        }
        let database = open_file(path, usage, &opener)?;
        let base = Self {
            path: path.to_owned(),
            usage,
            opener,
            database: RwLock::new(Some(database)),
            broken: AtomicBool::new(false),
        };
        let found = base.read("read the format of", |txn| match txn.open_table(FACTS) {
            Ok(table) => Ok(table.get(FORMAT_FACT)?.map(|row| row.value())),
            Err(TableError::TableDoesNotExist(_)) => Ok(None),
            Err(error) => Err(error.into()),
        })?;
        let directory = || path.parent().unwrap_or(path).to_owned();
        match found {
            Some(found) if found > format => Err(Error::Newer {
                path: directory(),
                found,
                known: format,
            }),
            // There is no older format yet; when there is, its rows are rewritten here.
            Some(_) => Ok(base),
            None => Err(Error::NotAStore { path: directory() }),
        }
    }

    /// Where it is.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Runs `work` on one consistent snapshot.
    pub(crate) fn read<T>(
        &self,
        doing: &'static str,
        work: impl Fn(&ReadTransaction) -> Result<T, redb::Error>,
    ) -> Result<T, Error> {
        self.with(doing, |database| work(&database.begin_read()?))
    }

    /// Runs `work` in one transaction: all of it is kept, or nothing.
    pub(crate) fn write<T>(
        &self,
        doing: &'static str,
        durability: Durability,
        work: impl Fn(&WriteTransaction) -> Result<Change<T>, redb::Error>,
    ) -> Result<T, Error> {
        self.with(doing, |database| {
            let mut txn = database.begin_write()?;
            txn.set_durability(durability)?;
            txn.set_quick_repair(self.usage.quick_repair);
            match work(&txn)? {
                Change::Keep(value) => {
                    txn.commit()?;
                    Ok(value)
                }
                Change::Drop(value) => {
                    txn.abort()?;
                    Ok(value)
                }
            }
        })
    }

    /// One try, and a second one if the first met a database that an earlier failure had closed.
    fn with<T>(&self, doing: &'static str, work: impl Fn(&Database) -> Result<T, redb::Error>) -> Result<T, Error> {
        let mut tried = false;
        loop {
            if self.broken.load(Ordering::Acquire) {
                self.reopen()?;
            }
            let result = {
                let guard = self.database.read().unwrap_or_else(PoisonError::into_inner);
                match guard.as_ref() {
                    Some(database) => work(database),
                    None => Err(redb::Error::DatabaseClosed),
                }
            };
            let error = match result {
                Ok(value) => return Ok(value),
                Err(error) => error,
            };
            let earlier = matches!(error, redb::Error::PreviousIo | redb::Error::DatabaseClosed);
            if earlier || matches!(error, redb::Error::Io(_) | redb::Error::LockPoisoned(_)) {
                self.broken.store(true, Ordering::Release);
            }
            if !earlier || tried {
                return Err(Error::database(doing, &self.path, error));
            }
            tried = true;
        }
    }

    fn reopen(&self) -> Result<(), Error> {
        let mut slot = self.database.write().unwrap_or_else(PoisonError::into_inner);
        if !self.broken.load(Ordering::Acquire) {
            return Ok(()); // Another thread was faster.
        }
        // The old one must be gone first: it holds the file's lock.
        *slot = None;
        *slot = Some(open_file(&self.path, self.usage, &self.opener)?);
        self.broken.store(false, Ordering::Release);
        tracing::info!(path = %self.path.display(), "the database was opened again after a failure");
        Ok(())
    }
}

impl std::fmt::Debug for Base {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Base").field("path", &self.path).finish_non_exhaustive()
    }
}

/// Makes the file under another name first: a process that dies in the middle leaves no half database behind.
fn create(path: &Path, format: u64, usage: Use, opener: &Opener) -> Result<(), Error> {
    let draft = path.with_extension("new");
    match medium::remove(&draft) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            return Err(Error::io("remove", &draft, error));
        }
        _ => {}
    }
    let database = open_file(&draft, usage, opener)?;
    let fill = || -> Result<(), redb::Error> {
        let txn = database.begin_write()?;
        txn.open_table(FACTS)?.insert(FORMAT_FACT, format)?;
        txn.commit()?;
        Ok(())
    };
    fill().map_err(|error| Error::database("create", &draft, error))?;
    database
        .close()
        .map_err(|error| Error::database("create", &draft, error.into()))?;
    crate::store::rename_durably(&draft, path)
}

fn open_file(path: &Path, usage: Use, opener: &Opener) -> Result<Database, Error> {
    let mut options = OpenOptions::new();
    options.read(true).write(true).create(true).truncate(false).mode(0o600);
    let file = medium::open(path, &options).map_err(|error| Error::io("open", path, error))?;
    let mut builder = Builder::new();
    builder
        .set_cache_size(usage.cache_bytes)
        .set_check_integrity_on_open(usage.check_all);
    let opened = if medium::is_interfered_with() {
        medium::Watched::new(file, path).and_then(|watched| builder.create_with_backend(watched))
    } else {
        opener(&builder, file)
    };
    opened.map_err(|error| match error {
        // redb says so of a file that is not its own.
        DatabaseError::Storage(redb::StorageError::Io(error)) if error.kind() == std::io::ErrorKind::InvalidData => {
            let source = Box::new(redb::Error::Corrupted(error.to_string()));
            Error::Damaged {
                path: path.to_owned(),
                source,
            }
        }
        error => Error::database("open", path, error.into()),
    })
}
