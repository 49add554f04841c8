//! Components: the bytes as files named by their digest, and the summaries as rows.
//!
//! Owns: the check that bytes still are what their name says. Never: what the bytes mean.

use std::{
    fs::{self, File},
    io::{self, Read as _},
    path::{Path, PathBuf},
    sync::PoisonError,
};

use bumpless_core::{ComponentInfo, Digest, limits::COMPONENT_BYTES_MAX};
use redb::{Durability, ReadableTable as _, TableDefinition, TableError};

use crate::{
    database::Change,
    error::Error,
    format,
    store::{Store, rename_durably, sync_parent, write_durably},
};

/// Component summaries by digest.
const INFOS: TableDefinition<&[u8; 32], &[u8]> = TableDefinition::new("infos");

const ENDING: &str = "wasm";

impl Store {
    fn component_path(&self, digest: &Digest) -> PathBuf {
        self.components_dir().join(format!("{digest}.{ENDING}"))
    }

    /// Keeps a component's bytes under their digest. Putting the same bytes again changes nothing; a damaged file of that
    /// name is replaced.
    ///
    /// # Errors
    /// [`Error::Size`] for none or more than 32 MiB, [`Error::Io`].
    pub fn put_component(&self, bytes: &[u8]) -> Result<Digest, Error> {
        if bytes.is_empty() || bytes.len() > COMPONENT_BYTES_MAX {
            return Err(Error::Size {
                what: "the component".into(),
                bytes: bytes.len(),
                max: COMPONENT_BYTES_MAX,
            });
        }
        let digest = Digest::of(bytes);
        let path = self.component_path(&digest);
        let _files = self.inner.files.lock().unwrap_or_else(PoisonError::into_inner);
        match read_whole(&path) {
            Ok(Some(held)) if held == bytes => {}
            _ => write_durably(&path, bytes)?,
        }
        Ok(digest)
    }

    /// A component's bytes. A file whose bytes are not what its name says is set aside as `<digest>.corrupt`, logged, and
    /// reported as missing, so that the host fetches it again.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn component(&self, digest: &Digest) -> Result<Option<Vec<u8>>, Error> {
        let path = self.component_path(digest);
        let Some(bytes) = read_whole(&path).map_err(|error| Error::io("read", &path, error))? else {
            return Ok(None);
        };
        if Digest::of(&bytes) == *digest {
            return Ok(Some(bytes));
        }
        let _files = self.inner.files.lock().unwrap_or_else(PoisonError::into_inner);
        let aside = path.with_extension("corrupt");
        tracing::warn!(
            path = %path.display(), aside = %aside.display(), bytes = bytes.len(),
            "a component's file is damaged; it is set aside and counts as missing"
        );
        match rename_durably(&path, &aside) {
            // Another thread was faster.
            Err(Error::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
            other => other.map(|()| None),
        }
    }

    /// Is there a file for this component? Its bytes are checked only when they are read.
    #[must_use]
    pub fn has_component(&self, digest: &Digest) -> bool {
        self.component_path(digest).is_file()
    }

    /// The digests of all components that have a file, sorted.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn component_digests(&self) -> Result<Vec<Digest>, Error> {
        let dir = self.components_dir();
        let mut digests = Vec::new();
        for entry in fs::read_dir(&dir).map_err(|error| Error::io("read", &dir, error))? {
            let path = entry.map_err(|error| Error::io("read", &dir, error))?.path();
            let is_component = path.extension().is_some_and(|ending| ending == ENDING);
            let stem = path.file_stem().and_then(|stem| stem.to_str());
            // Files that people put there are not ours to judge.
            if let (true, Some(Ok(digest))) = (is_component, stem.map(str::parse)) {
                digests.push(digest);
            }
        }
        digests.sort();
        Ok(digests)
    }

    /// Removes a component's bytes; says whether there were any. Its summary stays until [`Store::remove_info`].
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn remove_component(&self, digest: &Digest) -> Result<bool, Error> {
        let path = self.component_path(digest);
        let _files = self.inner.files.lock().unwrap_or_else(PoisonError::into_inner);
        match crate::medium::remove(&path) {
            Ok(()) => sync_parent(&path).map(|()| true),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(Error::io("remove", &path, error)),
        }
    }

    /// Keeps a component's summary, in place of an earlier one.
    ///
    /// # Errors
    /// [`Error::NoComponent`] when the bytes are not there: a summary alone would promise what this host cannot run.
    pub fn put_info(&self, info: &ComponentInfo) -> Result<(), Error> {
        if !self.has_component(&info.digest) {
            return Err(Error::NoComponent { digest: info.digest });
        }
        let row = format::encode(|| format!("the summary of component {}", info.digest), info)?;
        self.inner
            .base
            .write("write a component's summary to", Durability::Immediate, |txn| {
                txn.open_table(INFOS)?.insert(info.digest.as_bytes(), row.as_slice())?;
                Ok(Change::Keep(()))
            })
    }

    /// All summaries, by digest. Those that cannot be read are skipped.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn infos(&self) -> Result<Vec<ComponentInfo>, Error> {
        let rows = self.inner.base.read("read component summaries from", |txn| {
            let table = match txn.open_table(INFOS) {
                Ok(table) => table,
                Err(TableError::TableDoesNotExist(_)) => return Ok(Vec::new()),
                Err(error) => return Err(error.into()),
            };
            let mut rows = Vec::new();
            for row in table.iter()? {
                let (key, value) = row?;
                rows.push((Digest::from_bytes(*key.value()), format::decode(value.value())));
            }
            Ok(rows)
        })?;
        Ok(rows
            .into_iter()
            .filter_map(|(digest, row)| self.row("infos", &digest.to_string(), row))
            .collect())
    }

    /// Removes a component's summary; says whether there was one.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`].
    pub fn remove_info(&self, digest: &Digest) -> Result<bool, Error> {
        self.inner
            .base
            .write("remove a component's summary from", Durability::Immediate, |txn| {
                let there = txn.open_table(INFOS)?.remove(digest.as_bytes())?.is_some();
                Ok(if there { Change::Keep(true) } else { Change::Drop(false) })
            })
    }
}

/// The file's bytes, at most one more than a component may have: a longer file is damaged anyway.
fn read_whole(path: &Path) -> io::Result<Option<Vec<u8>>> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    let mut bytes = Vec::new();
    file.take(COMPONENT_BYTES_MAX as u64 + 1).read_to_end(&mut bytes)?;
    Ok(Some(bytes))
}
