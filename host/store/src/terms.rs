//! Terms that were set aside: what no later life of this host may give out again.
//!
//! ```text
//! terms: slot 0 │ slot 1      a slot is a number and its complement; the greater of the good ones counts
//!          ▲───────▲── each writing goes into the slot that does not count
//! ```
//! A file of its own with a fixed size: it is written over in place, so a full disk takes it too, and a writing that breaks off
//! leaves the other slot. Never: decides how many terms to set aside.

use std::{
    fs::{File, OpenOptions},
    io,
    os::unix::fs::{FileExt as _, OpenOptionsExt as _},
    path::PathBuf,
    sync::PoisonError,
};

use crate::{Error, Store, medium};

const TERMS_FILE: &str = "terms";
const SLOT_BYTES: u64 = 16;

fn slot(term: u64) -> [u8; 16] {
    (u128::from(!term) << 64 | u128::from(term)).to_le_bytes()
}

fn term(slot: [u8; 16]) -> Option<u64> {
    let both = u128::from_le_bytes(slot);
    let (term, complement) = (both as u64, (both >> 64) as u64);
    (term == !complement).then_some(term)
}

impl Store {
    /// The greatest term that was set aside; 0 where none was.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn terms_set_aside(&self) -> Result<u64, Error> {
        let path = self.terms_path();
        match File::open(&path) {
            Ok(file) => Ok(slots(&file).map_err(|error| Error::io("read", &path, error))?.0),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(0),
            Err(error) => Err(Error::io("open", &path, error)),
        }
    }

    /// Sets aside all terms up to this one. They are when it returns; a lesser term than before changes nothing. After the first
    /// time it needs no room on the disk.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn set_aside_terms(&self, up_to: u64) -> Result<(), Error> {
        let path = self.terms_path();
        let _files = self.inner.files.lock().unwrap_or_else(PoisonError::into_inner);
        let is_new = !path.exists();
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(false).mode(0o600);
        let file = medium::open(&path, &options).map_err(|error| Error::io("open", &path, error))?;
        let write = || {
            let (kept, counts) = slots(&file)?;
            if up_to <= kept {
                return Ok(());
            }
            if is_new {
                medium::write_at(&file, &path, &slot(0), SLOT_BYTES)?;
            }
            medium::write_at(&file, &path, &slot(up_to), (1 - counts) * SLOT_BYTES)?;
            medium::sync(&file, &path)
        };
        write().map_err(|error| Error::io("write", &path, error))?;
        if is_new {
            crate::store::sync_parent(&path)?;
        }
        Ok(())
    }

    fn terms_path(&self) -> PathBuf {
        self.directory().join(TERMS_FILE)
    }
}

/// What counts, and in which slot it is; of an empty file 0, and the second one.
fn slots(file: &File) -> io::Result<(u64, u64)> {
    let mut best = (0, 1);
    for number in [1, 0] {
        let mut bytes = [0; SLOT_BYTES as usize];
        match file.read_exact_at(&mut bytes, number * SLOT_BYTES) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => continue,
            Err(error) => return Err(error),
        }
        match term(bytes) {
            Some(found) if found > best.0 => best = (found, number),
            Some(_) => {}
            None => tracing::warn!(
                slot = number,
                "terms that were set aside cannot be read; those before them count"
            ),
        }
    }
    Ok(best)
}

/// The greatest good one of a file's bytes.
pub(crate) fn greatest(bytes: &[u8]) -> u64 {
    let (slots, _) = bytes.as_chunks::<{ SLOT_BYTES as usize }>();
    slots.iter().take(2).filter_map(|slot| term(*slot)).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn the_greatest_term_stays_whatever_breaks_off() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).unwrap();
        assert_eq!(store.terms_set_aside().unwrap(), 0);
        for (asked, kept) in [(4_096, 4_096), (7, 4_096), (9_000, 9_000), (13_000, 13_000)] {
            store.set_aside_terms(asked).unwrap();
            assert_eq!(store.terms_set_aside().unwrap(), kept);
        }
        drop(store);
        // Any one slot may be torn: the other one counts.
        let path = dir.path().join(TERMS_FILE);
        let whole = std::fs::read(&path).unwrap();
        assert_eq!(whole.len() as u64, 2 * SLOT_BYTES);
        for (torn, left) in [(0_usize, 9_000), (1, 13_000)] {
            let mut bytes = whole.clone();
            let newest = usize::try_from(slots(&File::open(&path).unwrap()).unwrap().1).unwrap();
            let at = if torn == 0 { newest } else { 1 - newest } * 16 + 3;
            bytes[at] ^= 0xFF;
            std::fs::write(&path, &bytes).unwrap();
            let store = Store::open(dir.path()).unwrap();
            assert_eq!(store.terms_set_aside().unwrap(), left);
            drop(store);
            std::fs::write(&path, &whole).unwrap();
        }
    }
}
