//! The store's directory: opening it, its lock, and the file operations that outlive a power cut.
//!
//! Owns: the directory's layout and rights. Never: a row's meaning; `components`, `intents`, `records` and `settings` add
//! those to [`Store`].

use std::{
    fs::{self, DirBuilder, File, OpenOptions, TryLockError},
    io::{self, Read as _, Write as _},
    os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt},
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use redb::backends::FileBackend;

use crate::{
    database::{Base, HOST, Opener},
    error::Error,
    format::RowError,
    medium,
};

/// Version of the directory's layout and of the tables in it.
pub const FORMAT: u64 = 1;

const DATABASE_FILE: &str = "host.redb";
const LOCK_FILE: &str = "lock";
const COMPONENTS_DIR: &str = "components";
const SECRETS_DIR: &str = "secrets";

/// Ending of a file that is being written; one that is found at the start was left by a process that died.
const DRAFT: &str = "draft";

/// One host's disk. Clones share it. Closed when the last clone is gone.
#[derive(Debug, Clone)]
pub struct Store {
    pub(crate) inner: Arc<Inner>,
}

#[derive(Debug)]
pub(crate) struct Inner {
    pub(crate) base: Base,
    pub(crate) directory: PathBuf,
    /// Held while files of components and secrets are written, so that two threads never share a draft.
    pub(crate) files: Mutex<()>,
    skipped: AtomicU64,
    // The last field, so the lock is let go when the database is closed.
    _lock: File,
}

impl Store {
    /// Opens the store in `dir`, and creates it where there is none: `dir` is then new or empty, and gets the rights 0700.
    ///
    /// # Errors
    /// [`Error::Locked`], [`Error::Newer`], [`Error::NotAStore`], [`Error::Damaged`], [`Error::Io`].
    pub fn open(dir: &Path) -> Result<Self, Error> {
        let opener: Opener = Box::new(|builder, file| builder.create_with_backend(FileBackend::new(file)?));
        Self::open_with(dir, opener)
    }

    pub(crate) fn open_with(dir: &Path, opener: Opener) -> Result<Self, Error> {
        prepare(dir)?;
        let lock = lock(dir)?;
        for folder in [COMPONENTS_DIR, SECRETS_DIR] {
            let folder = dir.join(folder);
            private_dir(&folder)?;
            remove_drafts(&folder)?;
        }
        let base = Base::open(&dir.join(DATABASE_FILE), FORMAT, HOST, opener)?;
        let inner = Inner {
            base,
            directory: dir.to_owned(),
            files: Mutex::new(()),
            skipped: AtomicU64::new(0),
            _lock: lock,
        };
        Ok(Self { inner: Arc::new(inner) })
    }

    /// Where it is.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.inner.directory
    }

    /// Rows that could not be read and were skipped since the store was opened; each was also logged.
    #[must_use]
    pub fn skipped_rows(&self) -> u64 {
        self.inner.skipped.load(Ordering::Relaxed)
    }

    pub(crate) fn components_dir(&self) -> PathBuf {
        self.inner.directory.join(COMPONENTS_DIR)
    }

    pub(crate) fn secrets_dir(&self) -> PathBuf {
        self.inner.directory.join(SECRETS_DIR)
    }

    /// The row's value, or none and a warning: one bad row must not stop a host.
    pub(crate) fn row<T>(&self, table: &str, key: &str, row: Result<T, RowError>) -> Option<T> {
        row.inspect_err(|error| {
            self.inner.skipped.fetch_add(1, Ordering::Relaxed);
            let source = std::error::Error::source(error)
                .map(ToString::to_string)
                .unwrap_or_default();
            tracing::warn!(table, key, %error, source, path = %self.inner.base.path().display(), "a row was skipped");
        })
        .ok()
    }
}

/// Makes `dir`, or checks that it is a store or empty: the rights of somebody's own directory are not ours to change.
fn prepare(dir: &Path) -> Result<(), Error> {
    private_dir_all(dir)?;
    let is_store = dir.join(DATABASE_FILE).exists() || dir.join(LOCK_FILE).exists();
    if !is_store {
        let mut entries = fs::read_dir(dir).map_err(|error| Error::io("read", dir, error))?;
        if entries.next().is_some() {
            return Err(Error::NotAStore { path: dir.to_owned() });
        }
    }
    restrict(dir, 0o700)
}

/// How long a lock is waited for: a process that is being started, by whoever had the store before, has a copy of it until it runs
/// its own program.
const LOCK_WAIT: Duration = Duration::from_millis(500);
/// How often it is looked at.
const LOCK_LOOK: Duration = Duration::from_millis(10);

fn lock(dir: &Path) -> Result<File, Error> {
    let path = dir.join(LOCK_FILE);
    let mut file = OpenOptions::new()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .mode(0o600)
        .open(&path)
        .map_err(|error| Error::io("open", &path, error))?;
    let began = Instant::now();
    let end = loop {
        match file.try_lock() {
            Err(TryLockError::WouldBlock) if began.elapsed() < LOCK_WAIT => std::thread::sleep(LOCK_LOOK),
            end => break end,
        }
    };
    match end {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let mut text = String::new();
            // The text only helps people; it may be half written.
            let _ = (&file).take(16).read_to_string(&mut text);
            return Err(Error::Locked {
                path: dir.to_owned(),
                pid: text.trim().parse().ok(),
            });
        }
        Err(TryLockError::Error(error)) => return Err(Error::io("lock", &path, error)),
    }
    let note = || -> io::Result<()> {
        file.set_len(0)?;
        file.write_all(format!("{}\n", std::process::id()).as_bytes())
    };
    let mut note = note;
    note().map_err(|error| Error::io("write", &path, error))?;
    Ok(file)
}

fn private_dir_all(dir: &Path) -> Result<(), Error> {
    // Missing parents get the usual rights: only the last one is ours.
    if let Some(parent) = dir.parent() {
        fs::create_dir_all(parent).map_err(|error| Error::io("create", parent, error))?;
    }
    private_dir(dir)
}

pub(crate) fn private_dir(dir: &Path) -> Result<(), Error> {
    match DirBuilder::new().mode(0o700).create(dir) {
        Ok(()) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && dir.is_dir() => Ok(()),
        Err(error) => Err(Error::io("create", dir, error)),
    }
}

/// Takes away rights beyond `mode`.
pub(crate) fn restrict(path: &Path, mode: u32) -> Result<(), Error> {
    let found = fs::metadata(path)
        .map_err(|error| Error::io("read", path, error))?
        .permissions()
        .mode();
    if found & 0o777 & !mode == 0 {
        return Ok(());
    }
    tracing::warn!(path = %path.display(), "others had access to this path; it is taken away");
    fs::set_permissions(path, fs::Permissions::from_mode(mode))
        .map_err(|error| Error::io("restrict the rights of", path, error))
}

fn remove_drafts(dir: &Path) -> Result<(), Error> {
    for entry in fs::read_dir(dir).map_err(|error| Error::io("read", dir, error))? {
        let path = entry.map_err(|error| Error::io("read", dir, error))?.path();
        if path.extension().is_some_and(|ending| ending == DRAFT) {
            medium::remove(&path).map_err(|error| Error::io("remove", &path, error))?;
        }
    }
    Ok(())
}

/// Writes a whole file so that it is there with all its bytes, or not at all, whatever happens in between.
pub(crate) fn write_durably(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    let draft = path.with_extension(DRAFT);
    let write = || -> io::Result<()> {
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true).mode(0o600);
        let file = medium::open(&draft, &options)?;
        medium::write_at(&file, &draft, bytes, 0)?;
        medium::sync(&file, &draft)
    };
    if let Err(error) = write() {
        // A full disk must not keep the half file; its error is the one that counts.
        let _ = medium::remove(&draft);
        return Err(Error::io("write", path, error));
    }
    rename_durably(&draft, path)
}

/// Renames within one directory, and makes the new name outlive a power cut.
pub(crate) fn rename_durably(from: &Path, to: &Path) -> Result<(), Error> {
    medium::rename(from, to).map_err(|error| Error::io("rename a file to", to, error))?;
    sync_parent(to)
}

/// A name is durable when its directory is synced.
pub(crate) fn sync_parent(path: &Path) -> Result<(), Error> {
    let parent = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    medium::sync_folder(parent).map_err(|error| Error::io("sync", parent, error))
}
