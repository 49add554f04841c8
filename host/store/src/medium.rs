//! What the store's files lie on: each change of the file system goes through here.
//!
//! Owns: the list of changes that a store makes, and the place where somebody may stand in their way: the crash bench, whose disks
//! fill up, tear writes and lose power. Never: reads a file, or knows what is in one. A host lets nobody in; then this is the
//! system's own file system and one look at an empty cell per change.

use std::{
    fs::{self, File, OpenOptions},
    io,
    ops::Bound,
    os::unix::fs::FileExt as _,
    path::{Path, PathBuf},
    sync::OnceLock,
};

use redb::{BackendError, StorageBackend, backends::FileBackend};

/// A change that is about to be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Touch<'a> {
    /// A file comes to be. Its folder knows of it for good once that is synced.
    Create(&'a Path),
    /// Bytes go into a file.
    Write {
        /// The file.
        path: &'a Path,
        /// Where in it.
        at: u64,
        /// What.
        bytes: &'a [u8],
    },
    /// A file becomes so long.
    Length {
        /// The file.
        path: &'a Path,
        /// Bytes.
        bytes: u64,
    },
    /// What was written into a file is to outlive a loss of power.
    Sync(&'a Path),
    /// A file gets another name, and takes the place of what had it.
    Rename {
        /// Before.
        from: &'a Path,
        /// After.
        to: &'a Path,
    },
    /// A file goes.
    Remove(&'a Path),
    /// What was created, renamed and removed in a folder is to outlive a loss of power.
    SyncFolder(&'a Path),
}

/// Somebody who stands in the way of changes.
pub trait Interference: Send + Sync {
    /// Called right before each change, on the thread that makes it. An error is what the store is told instead, as if the disk had
    /// said so; the change is not made then.
    ///
    /// # Errors
    /// Whatever a disk can say.
    fn before(&self, touch: &Touch<'_>) -> io::Result<()>;
}

static INTERFERENCE: OnceLock<Box<dyn Interference>> = OnceLock::new();

/// Lets somebody stand in the way of every change of this process's stores, for the rest of its life. False where somebody does
/// already.
pub fn interfere(with: Box<dyn Interference>) -> bool {
    INTERFERENCE.set(with).is_ok()
}

pub(crate) fn is_interfered_with() -> bool {
    INTERFERENCE.get().is_some()
}

pub(crate) fn before(touch: &Touch<'_>) -> io::Result<()> {
    INTERFERENCE.get().map_or(Ok(()), |somebody| somebody.before(touch))
}

/// Opens a file that may come to be by it.
pub(crate) fn open(path: &Path, options: &OpenOptions) -> io::Result<File> {
    if is_interfered_with() && !path.exists() {
        before(&Touch::Create(path))?;
    }
    options.open(path)
}

/// Writes into a file at a place. `options.append` files get theirs by [`append`].
pub(crate) fn write_at(file: &File, path: &Path, bytes: &[u8], at: u64) -> io::Result<()> {
    before(&Touch::Write { path, at, bytes })?;
    file.write_all_at(bytes, at)
}

/// Writes at the end of a file that was opened to append, and has `at` bytes.
pub(crate) fn append(mut file: &File, path: &Path, bytes: &[u8], at: u64) -> io::Result<()> {
    before(&Touch::Write { path, at, bytes })?;
    io::Write::write_all(&mut file, bytes)
}

pub(crate) fn set_len(file: &File, path: &Path, bytes: u64) -> io::Result<()> {
    before(&Touch::Length { path, bytes })?;
    file.set_len(bytes)
}

pub(crate) fn sync(file: &File, path: &Path) -> io::Result<()> {
    before(&Touch::Sync(path))?;
    file.sync_all()
}

pub(crate) fn sync_data(file: &File, path: &Path) -> io::Result<()> {
    before(&Touch::Sync(path))?;
    file.sync_data()
}

pub(crate) fn rename(from: &Path, to: &Path) -> io::Result<()> {
    before(&Touch::Rename { from, to })?;
    fs::rename(from, to)
}

pub(crate) fn remove(path: &Path) -> io::Result<()> {
    if is_interfered_with() && path.exists() {
        before(&Touch::Remove(path))?;
    }
    fs::remove_file(path)
}

pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    before(&Touch::SyncFolder(folder))?;
    File::open(folder)?.sync_all()
}

/// A database's file behind whoever interferes.
#[derive(Debug)]
pub(crate) struct Watched {
    file: FileBackend,
    path: PathBuf,
}

impl Watched {
    pub(crate) fn new(file: File, path: &Path) -> Result<Self, redb::DatabaseError> {
        Ok(Self {
            file: FileBackend::new(file)?,
            path: path.to_owned(),
        })
    }
}

impl StorageBackend for Watched {
    fn len(&self) -> io::Result<u64> {
        self.file.len()
    }
    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        self.file.read(offset, out)
    }
    fn set_len(&self, len: u64) -> io::Result<()> {
        before(&Touch::Length {
            path: &self.path,
            bytes: len,
        })?;
        self.file.set_len(len)
    }
    fn sync_data(&self) -> io::Result<()> {
        before(&Touch::Sync(&self.path))?;
        self.file.sync_data()
    }
    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        before(&Touch::Write {
            path: &self.path,
            at: offset,
            bytes: data,
        })?;
        self.file.write(offset, data)
    }
    fn close(&self) -> io::Result<()> {
        self.file.close()
    }
    fn try_lock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<bool, BackendError> {
        self.file.try_lock_range(start, end)
    }
    fn try_lock_shared_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<bool, BackendError> {
        self.file.try_lock_shared_range(start, end)
    }
    fn lock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<(), BackendError> {
        self.file.lock_range(start, end)
    }
    fn lock_shared_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<(), BackendError> {
        self.file.lock_shared_range(start, end)
    }
    fn unlock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<(), BackendError> {
        self.file.unlock_range(start, end)
    }
    fn query_lock_range(&self, start: Bound<u64>, end: Bound<u64>) -> Result<bool, BackendError> {
        self.file.query_lock_range(start, end)
    }
}
