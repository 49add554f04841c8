//! The audit trail on disk: segments of lines, each line an entry of the host's chain.
//!
//! ```text
//! <dir>/audit/000000000001.jsonl    sealed: full, never written again; named by the number of its first entry
//! <dir>/audit/000000000412.jsonl    open: grows by whole lines, synced before anybody is told
//! <dir>/audit/begun/<n>             what was begun and has no entry yet; removed when it has
//!
//! append: written ─► synced ─► head kept in the database ─► told        refused by the disk: cut back to what it was
//! open:   bytes behind the last newline are cut ─► the chain goes on from the last entry; what was found is told
//! ```
//!
//! Owns: that the chain only grows, and goes on after a crash. The oldest segment goes only where the whole is beyond its bound,
//! and only after an entry that says so ([`AuditLog::trim`]).
//! Never: knows what an entry says; deployment does.

use std::{
    fs::{self, File, OpenOptions},
    io::{self, Read as _, Seek as _, SeekFrom},
    ops::RangeInclusive,
    os::unix::fs::OpenOptionsExt as _,
    path::{Path, PathBuf},
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use bumpless_core::{
    Digest, HostId,
    audit::{self, BEGINNING, ENTRY_BYTES_MAX, Link, Misfit},
};

use crate::{
    error::Error,
    medium,
    store::{Store, private_dir, sync_parent},
};

/// Bytes that the trail may be given: from two segments on, to a disk's worth.
pub const AUDIT_BYTES_MAX: RangeInclusive<u64> = 8 * 1024 * 1024..=1024 * 1024 * 1024 * 1024;

/// Bytes from which on a segment is sealed: small enough to be read whole, some 8,000 entries.
const SEGMENT_BYTES: u64 = 4 * 1024 * 1024;

/// Most bytes that are read of one segment: what lies beyond was put there by somebody else.
const READ_BYTES_MAX: u64 = SEGMENT_BYTES + 64 * ENTRY_BYTES_MAX as u64;

/// Entries of one append: what waited for a disk.
const APPEND_MAX: usize = 64;

/// Things begun at a time; as many requests as an API works on.
const BEGUN_MAX: usize = 512;

const HEAD: &str = "audit-head";
const ENDING: &str = "jsonl";

/// What was found when the trail was opened.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AuditFound {
    /// Bytes behind the last whole line; they were cut off.
    pub cut_bytes: u64,
    /// Whole lines of the open segment that are no entries. They stay where they are.
    pub unreadable: u64,
    /// The number of the last entry that was ever kept, where the trail ends before it.
    pub missing_to: Option<u64>,
    /// What was begun and never got its entry, because the host died.
    pub begun: Vec<String>,
}

/// A segment that the trail has no room for any more.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Overdue {
    /// Number of its first entry.
    pub first: u64,
    /// Number of its last entry.
    pub last: u64,
    /// Hash of its last entry.
    pub hash: Digest,
    path: PathBuf,
    bytes: u64,
}

/// How far the trail is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AuditHead {
    /// Number of the last entry; 0 where there is none.
    pub number: u64,
    /// Its hash.
    pub hash: Digest,
    /// Bytes of all segments.
    pub bytes: u64,
    /// Segments.
    pub segments: u64,
}

#[derive(Debug)]
struct Open {
    file: File,
    bytes: u64,
}

#[derive(Debug)]
struct Tail {
    number: u64,
    hash: Digest,
    open: Option<Open>,
    /// Number of the first entry and bytes of each segment, oldest first.
    segments: Vec<(u64, u64)>,
}

/// One host's audit trail. Every call blocks on the disk, except [`AuditLog::head`].
#[derive(Debug)]
pub struct AuditLog {
    store: Store,
    host: HostId,
    dir: PathBuf,
    bytes_max: u64,
    tail: Mutex<Tail>,
    begun: AtomicU64,
}

/// The text of a file, at most so much of it; bytes that are no text become signs that no entry has.
fn text_of(path: &Path) -> Result<String, Error> {
    let mut bytes = Vec::new();
    File::open(path)
        .and_then(|file| file.take(READ_BYTES_MAX).read_to_end(&mut bytes))
        .map_err(|error| Error::io("read", path, error))?;
    Ok(String::from_utf8(bytes).unwrap_or_else(|error| String::from_utf8_lossy(error.as_bytes()).into_owned()))
}

fn named(dir: &Path, first: u64) -> PathBuf {
    dir.join(format!("{first:012}.{ENDING}"))
}

/// Segments by the number of their first entry.
fn segments(dir: &Path) -> Result<Vec<(u64, u64)>, Error> {
    let failed = |error| Error::io("read", dir, error);
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let path = entry.path();
        let first = path
            .file_stem()
            .filter(|_| path.extension().is_some_and(|ending| ending == ENDING))
            .and_then(|stem| stem.to_str()?.parse::<u64>().ok());
        if let Some(first) = first {
            found.push((first, entry.metadata().map_err(failed)?.len()));
        }
    }
    found.sort_unstable();
    Ok(found)
}

impl AuditLog {
    /// Opens the trail of a host in its store; makes it where there is none. `bytes_max` of all segments together, within
    /// [`AUDIT_BYTES_MAX`].
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Database`], [`Error::Size`] for the bound.
    pub fn open(store: &Store, host: &HostId, bytes_max: u64) -> Result<(Self, AuditFound), Error> {
        if !AUDIT_BYTES_MAX.contains(&bytes_max) {
            return Err(Error::Size {
                what: "the audit trail".to_owned(),
                bytes: usize::try_from(bytes_max).unwrap_or(usize::MAX),
                max: usize::try_from(*AUDIT_BYTES_MAX.end()).unwrap_or(usize::MAX),
            });
        }
        let dir = store.directory().join("audit");
        private_dir(&dir)?;
        private_dir(&dir.join("begun"))?;
        let mut found = AuditFound {
            begun: begun(&dir.join("begun"))?,
            ..AuditFound::default()
        };
        let mut segments = segments(&dir)?;
        let (mut number, mut hash, mut open) = (0, BEGINNING, None);
        if let Some((first, bytes)) = segments.last_mut() {
            let path = named(&dir, *first);
            let (kept, text) = cut(&path)?;
            found.cut_bytes = bytes.saturating_sub(kept);
            *bytes = kept;
            // A segment without a good line says by its name how far the chain was.
            number = first.saturating_sub(1);
            for line in text.lines() {
                match audit::read(line) {
                    Ok(link) if link.host == *host => (number, hash) = (link.number, link.hash),
                    _ => found.unreadable += 1,
                }
            }
            if kept < SEGMENT_BYTES && found.unreadable == 0 {
                open = Some(Open {
                    file: appending(&path)?,
                    bytes: kept,
                });
            }
        }
        if let Some((kept, kept_hash)) = store.host_value::<(u64, Digest)>(HEAD)?
            && kept >= number
            && (kept, kept_hash) != (number, hash)
        {
            found.missing_to = Some(kept);
            (number, hash, open) = (kept, kept_hash, None);
        }
        let log = Self {
            store: store.clone(),
            host: host.clone(),
            dir,
            bytes_max,
            tail: Mutex::new(Tail {
                number,
                hash,
                open,
                segments,
            }),
            begun: AtomicU64::new(0),
        };
        Ok((log, found))
    }

    fn tail(&self) -> MutexGuard<'_, Tail> {
        // A poisoned tail is still one: it changes only once the disk has the lines.
        self.tail.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds entries, each a JSON object on one line. On disk when this returns; where it fails, none of them is.
    ///
    /// # Errors
    /// [`Error::Audit`] for what makes no entry, [`Error::Size`] for more than 64 at once, [`Error::Io`].
    pub fn append(&self, said: &[String]) -> Result<Vec<Link>, Error> {
        if said.len() > APPEND_MAX {
            return Err(Error::Size {
                what: "one addition to the audit trail".to_owned(),
                bytes: said.len(),
                max: APPEND_MAX,
            });
        }
        let mut tail = self.tail();
        let (mut number, mut hash) = (tail.number, tail.hash);
        let (mut text, mut links) = (String::new(), Vec::with_capacity(said.len()));
        for said in said {
            let (line, link) = audit::bind(&self.host, number + 1, hash, said).map_err(Error::Audit)?;
            (number, hash) = (link.number, link.hash);
            text.push_str(&line);
            text.push('\n');
            links.push(link);
        }
        if links.is_empty() {
            return Ok(links);
        }
        let first = tail.number + 1;
        if tail.open.is_none() {
            let path = named(&self.dir, first);
            let mut options = OpenOptions::new();
            options.append(true).create(true).mode(0o600);
            let file = medium::open(&path, &options).map_err(|error| Error::io("create", &path, error))?;
            sync_parent(&path)?;
            let bytes = file.metadata().map_err(|error| Error::io("read", &path, error))?.len();
            if tail.segments.last().is_none_or(|(last, _)| *last != first) {
                tail.segments.push((first, bytes));
            }
            tail.open = Some(Open { file, bytes });
        }
        let path = named(&self.dir, tail.segments.last().map_or(first, |(first, _)| *first));
        let Some(open) = tail.open.as_mut() else {
            return Ok(Vec::new());
        };
        let written = medium::append(&open.file, &path, text.as_bytes(), open.bytes)
            .and_then(|()| medium::sync_data(&open.file, &path));
        if let Err(error) = written {
            // Half a line would be cut at the next start; here it would stand between two entries.
            if medium::set_len(&open.file, &path, open.bytes)
                .and_then(|()| medium::sync_data(&open.file, &path))
                .is_err()
            {
                tail.open = None;
            }
            return Err(Error::io("write the audit trail to", &path, error));
        }
        open.bytes += text.len() as u64;
        let bytes = open.bytes;
        (tail.number, tail.hash) = (number, hash);
        if let Some(last) = tail.segments.last_mut() {
            last.1 = bytes;
        }
        if bytes >= SEGMENT_BYTES {
            tail.open = None;
        }
        // The entries are on disk; a head that is behind them is no harm.
        if let Err(error) = self.store.set_host_value(HEAD, &(number, hash)) {
            tracing::warn!(%error, "the head of the audit trail is not kept");
        }
        Ok(links)
    }

    /// The oldest segment, where all together are beyond the bound and it is not the last one.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn overdue(&self) -> Result<Option<Overdue>, Error> {
        let (first, bytes, next) = {
            let tail = self.tail();
            let all: u64 = tail.segments.iter().map(|(_, bytes)| bytes).sum();
            match tail.segments.as_slice() {
                [(first, bytes), (next, _), ..] if all > self.bytes_max => (*first, *bytes, *next),
                _ => return Ok(None),
            }
        };
        let path = named(&self.dir, first);
        let last = text_of(&path)?
            .lines()
            .rev()
            .find_map(|line| audit::read(line).ok())
            .map_or((next.saturating_sub(1), BEGINNING), |link| (link.number, link.hash));
        Ok(Some(Overdue {
            first,
            last: last.0,
            hash: last.1,
            path,
            bytes,
        }))
    }

    /// Removes a segment, after an entry that says so.
    ///
    /// # Errors
    /// As [`AuditLog::append`]; nothing is removed then.
    pub fn trim(&self, overdue: &Overdue, said: String) -> Result<(), Error> {
        self.append(&[said])?;
        medium::remove(&overdue.path).map_err(|error| Error::io("remove", &overdue.path, error))?;
        self.tail().segments.retain(|(first, _)| *first != overdue.first);
        tracing::info!(bytes = overdue.bytes, "the oldest part of the audit trail is removed");
        sync_parent(&overdue.path)
    }

    /// How far the trail is. Does not touch the disk.
    #[must_use]
    pub fn head(&self) -> AuditHead {
        let tail = self.tail();
        AuditHead {
            number: tail.number,
            hash: tail.hash,
            bytes: tail.segments.iter().map(|(_, bytes)| bytes).sum(),
            segments: tail.segments.len() as u64,
        }
    }

    /// Numbers of the segments' first entries, oldest first.
    #[must_use]
    pub fn segments(&self) -> Vec<u64> {
        self.tail().segments.iter().map(|(first, _)| *first).collect()
    }

    /// The lines of a segment that are on disk now, whatever they are; none where it was removed meanwhile.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn lines(&self, segment: u64) -> Result<Option<String>, Error> {
        let told = self
            .tail()
            .segments
            .iter()
            .find(|(first, _)| *first == segment)
            .copied();
        let path = named(&self.dir, segment);
        match (told, text_of(&path)) {
            (Some((_, bytes)), Ok(mut text)) => {
                // What is being appended now is no line yet.
                let bytes = usize::try_from(bytes).unwrap_or(usize::MAX);
                if bytes < text.len()
                    && text.is_char_boundary(bytes)
                    && Some(segment) == self.segments().last().copied()
                {
                    text.truncate(bytes);
                }
                Ok(Some(text))
            }
            (None, _) => Ok(None),
            (Some(_), Err(Error::Io { source, .. }))
                if source.kind() == io::ErrorKind::NotFound && !self.segments().contains(&segment) =>
            {
                Ok(None)
            }
            (Some(_), Err(error)) => Err(error),
        }
    }

    /// Notes that something is begun, so that a host that dies before its entry says so after its start. It outlives the process,
    /// not a power cut: a sync for what is done in a moment would cost more than it tells. None where too much is begun, or the
    /// disk refuses: then only the entry tells.
    #[must_use]
    pub fn begin(&self, said: &str) -> Option<AuditBegun> {
        let number = self.begun.fetch_add(1, Ordering::Relaxed);
        let path = self.dir.join("begun").join(number.to_string());
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true).mode(0o600);
        let written = medium::open(&path, &options).and_then(|file| medium::write_at(&file, &path, said.as_bytes(), 0));
        match written {
            Ok(()) => Some(AuditBegun { path }),
            Err(error) => {
                tracing::debug!(%error, "what is begun is not noted");
                drop(medium::remove(&path));
                None
            }
        }
    }

    /// Where the segments are, for messages.
    #[must_use]
    pub fn directory(&self) -> &Path {
        &self.dir
    }
}

/// A note of something begun. Dropped, it is gone: what was begun has its entry.
#[derive(Debug)]
pub struct AuditBegun {
    path: PathBuf,
}

impl Drop for AuditBegun {
    fn drop(&mut self) {
        if let Err(error) = medium::remove(&self.path) {
            tracing::debug!(%error, "a note of something begun stays until the next start");
        }
    }
}

/// Reads the notes of a process that died, and removes them.
fn begun(dir: &Path) -> Result<Vec<String>, Error> {
    let failed = |error| Error::io("read", dir, error);
    let mut notes = Vec::new();
    for entry in fs::read_dir(dir).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let mut text = String::new();
        let read = File::open(&path).and_then(|file| file.take(ENTRY_BYTES_MAX as u64).read_to_string(&mut text));
        // Half a note says nothing.
        if read.is_ok() && !text.is_empty() && notes.len() < BEGUN_MAX {
            notes.push(text);
        }
        medium::remove(&path).map_err(|error| Error::io("remove", &path, error))?;
    }
    notes.sort();
    Ok(notes)
}

fn appending(path: &Path) -> Result<File, Error> {
    OpenOptions::new()
        .append(true)
        .open(path)
        .map_err(|error| Error::io("open", path, error))
}

/// Cuts off what stands behind the last newline. Gives the bytes that stay, and their text.
fn cut(path: &Path) -> Result<(u64, String), Error> {
    let mut text = text_of(path)?;
    let length = fs::metadata(path)
        .map_err(|error| Error::io("read", path, error))?
        .len();
    if length > READ_BYTES_MAX {
        // Nothing of ours is so long; the lines that can be read are, and the rest stays as it is for those who look into it.
        return Ok((length, text));
    }
    let kept = last_newline(path)?;
    if kept < length {
        let file = OpenOptions::new()
            .write(true)
            .open(path)
            .map_err(|error| Error::io("open", path, error))?;
        medium::set_len(&file, path, kept)
            .and_then(|()| medium::sync(&file, path))
            .map_err(|error| Error::io("cut", path, error))?;
        text = text_of(path)?;
    }
    Ok((kept, text))
}

/// Bytes up to and with the last newline.
fn last_newline(path: &Path) -> Result<u64, Error> {
    let failed = |error| Error::io("read", path, error);
    let mut file = File::open(path).map_err(failed)?;
    file.seek(SeekFrom::Start(0)).map_err(failed)?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).map_err(failed)?;
    Ok(bytes
        .iter()
        .rposition(|byte| *byte == b'\n')
        .map_or(0, |at| at as u64 + 1))
}

impl From<Misfit> for Error {
    fn from(misfit: Misfit) -> Self {
        Self::Audit(misfit)
    }
}
