//! One file of the history: frames behind each other, only ever appended to, cut where a write broke off.
//!
//! ```text
//! "bmphist1" | frame | frame | …          frame: kind (1) | length of head (4) | of body (4) | check of these and the head (4)
//!                                                | check of the body (4) | head | body
//! ```
//! Owns: frames, their checks, and the way back to the last whole one. Never: knows what a frame means.

use std::{
    fs::{File, OpenOptions},
    io::{self, BufReader, Read as _, Seek as _, SeekFrom},
    os::unix::fs::{FileExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
    sync::Arc,
};

use crate::{error::Error, medium};

const MAGIC: &[u8; 8] = b"bmphist1";

/// Bytes of a frame before its head.
const FRAME_BYTES: usize = 17;

/// Bytes of a head: names of ports, and little else.
const HEAD_BYTES_MAX: u32 = 64 * 1024;

/// Bytes of a body: half a second of very many loops, or 4,096 rows with very many outputs.
const BODY_BYTES_MAX: u32 = 64 * 1024 * 1024;

/// What a frame is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// Packed rows.
    Block,
    /// Everything before it in the file belongs together and is whole.
    Mark,
    /// Rows of the last half second, of all series.
    Entry,
}

impl Kind {
    const fn byte(self) -> u8 {
        match self {
            Self::Block => 1,
            Self::Mark => 2,
            Self::Entry => 3,
        }
    }

    const fn of(byte: u8) -> Option<Self> {
        match byte {
            1 => Some(Self::Block),
            2 => Some(Self::Mark),
            3 => Some(Self::Entry),
            _ => None,
        }
    }
}

/// A frame that was found.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) kind: Kind,
    pub(super) head: Vec<u8>,
    pub(super) body_at: u64,
    pub(super) body_bytes: u32,
    pub(super) body_check: u32,
    /// Where the next frame begins.
    pub(super) end: u64,
}

/// The bytes of a frame.
pub(super) fn frame(kind: Kind, head: &[u8], body: &[u8]) -> Vec<u8> {
    let length = |bytes: &[u8]| u32::try_from(bytes.len()).unwrap_or(u32::MAX).to_le_bytes();
    let mut bytes = Vec::with_capacity(FRAME_BYTES + head.len() + body.len());
    bytes.push(kind.byte());
    bytes.extend(length(head));
    bytes.extend(length(body));
    let mut check = crc32fast::Hasher::new();
    check.update(&bytes);
    check.update(head);
    bytes.extend(check.finalize().to_le_bytes());
    bytes.extend(crc32fast::hash(body).to_le_bytes());
    bytes.extend(head);
    bytes.extend(body);
    bytes
}

/// Bytes before the body of a frame with such a head.
pub(super) const fn before_body(head: &[u8]) -> u64 {
    (FRAME_BYTES + head.len()) as u64
}

/// A file that grows at its end.
#[derive(Debug)]
pub(super) struct Growing {
    pub(super) path: PathBuf,
    pub(super) file: Arc<File>,
    pub(super) bytes: u64,
    /// The end may hold half a frame, because a write and its undoing both failed.
    torn: bool,
    /// For tests: bytes that the disk still takes.
    #[cfg(test)]
    pub(super) room: Option<Arc<std::sync::atomic::AtomicU64>>,
}

impl Growing {
    /// A new file, private to the user.
    pub(super) fn create(path: &Path) -> Result<Self, Error> {
        let make = || -> io::Result<File> {
            let mut options = OpenOptions::new();
            options.read(true).write(true).create(true).truncate(true).mode(0o600);
            let file = medium::open(path, &options)?;
            medium::write_at(&file, path, MAGIC, 0)?;
            Ok(file)
        };
        let file = make().map_err(|error| {
            // Half a file would be found at the next start, and said to be damaged.
            let _ = medium::remove(path);
            Error::io("create", path, error)
        })?;
        Ok(Self::of(path, file, MAGIC.len() as u64))
    }

    fn of(path: &Path, file: File, bytes: u64) -> Self {
        Self {
            path: path.to_owned(),
            file: Arc::new(file),
            bytes,
            torn: false,
            #[cfg(test)]
            room: None,
        }
    }

    /// Puts frames at the end, all or none of them. Gives back where they begin.
    pub(super) fn append(&mut self, frames: &[u8]) -> Result<u64, Error> {
        let at = self.bytes;
        if self.torn {
            self.cut(at)?;
        }
        if let Err(error) = self.write(frames, at) {
            self.torn = true;
            // What fails here is tried again before the next write.
            let _ = self.cut(at);
            return Err(Error::io("write", &self.path, error));
        }
        self.bytes += frames.len() as u64;
        Ok(at)
    }

    #[cfg(not(test))]
    fn write(&self, frames: &[u8], at: u64) -> io::Result<()> {
        medium::write_at(&self.file, &self.path, frames, at)
    }

    #[cfg(test)]
    fn write(&self, frames: &[u8], at: u64) -> io::Result<()> {
        use std::sync::atomic::Ordering;
        let Some(room) = &self.room else {
            return self.file.write_all_at(frames, at);
        };
        let left = room.load(Ordering::SeqCst);
        let fits = usize::try_from(left).unwrap_or(usize::MAX).min(frames.len());
        self.file.write_all_at(&frames[..fits], at)?;
        room.store(left - fits as u64, Ordering::SeqCst);
        if fits < frames.len() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        Ok(())
    }

    fn cut(&mut self, at: u64) -> Result<(), Error> {
        medium::set_len(&self.file, &self.path, at).map_err(|error| Error::io("cut", &self.path, error))?;
        self.torn = false;
        Ok(())
    }

    /// Brings it to the disk.
    pub(super) fn sync(&self) -> Result<(), Error> {
        medium::sync_data(&self.file, &self.path).map_err(|error| Error::io("sync", &self.path, error))
    }
}

/// Opens a file and hands its whole frames to `take`, in order, until one cannot be taken. What is behind the last one of which
/// `take` said that everything up to it counts is cut away where `may_cut`. Gives back how many bytes count for nothing.
pub(super) fn open(
    path: &Path,
    may_cut: bool,
    mut take: impl FnMut(&File, Found) -> io::Result<Option<bool>>,
) -> Result<(Growing, u64), Error> {
    let failed = |error| Error::io("read", path, error);
    let file = OpenOptions::new().read(true).write(true).open(path).map_err(failed)?;
    let length = file.metadata().map_err(failed)?.len();
    let mut reader = BufReader::with_capacity(64 * 1024, &file);
    let mut magic = [0; MAGIC.len()];
    if reader.read_exact(&mut magic).is_err() || magic != *MAGIC {
        return Err(Error::NoHistory { path: path.to_owned() });
    }
    let (mut at, mut whole) = (MAGIC.len() as u64, MAGIC.len() as u64);
    while let Some(found) = next(&mut reader, at, length).map_err(failed)? {
        at = found.end;
        reader.seek(SeekFrom::Start(at)).map_err(failed)?;
        match take(&file, found).map_err(failed)? {
            Some(true) => whole = at,
            Some(false) => {}
            None => break,
        }
    }
    let lost = length.saturating_sub(whole);
    let mut growing = Growing::of(path, file, whole);
    if lost > 0 && may_cut {
        growing.cut(whole)?;
    } else {
        growing.bytes = length;
    }
    Ok((growing, lost))
}

/// The frame at `at`; none where there is no whole one.
fn next(reader: &mut impl io::Read, at: u64, length: u64) -> io::Result<Option<Found>> {
    let mut fixed = [0; FRAME_BYTES];
    if at + FRAME_BYTES as u64 > length {
        return Ok(None);
    }
    reader.read_exact(&mut fixed)?;
    let number = |from: usize| {
        let bytes = fixed.get(from..from + 4).and_then(|bytes| bytes.try_into().ok());
        u32::from_le_bytes(bytes.unwrap_or_default())
    };
    let (head_bytes, body_bytes, check, body_check) = (number(1), number(5), number(9), number(13));
    let body_at = at + FRAME_BYTES as u64 + u64::from(head_bytes);
    let end = body_at + u64::from(body_bytes);
    let Some(kind) = Kind::of(fixed[0]) else {
        return Ok(None);
    };
    if head_bytes > HEAD_BYTES_MAX || body_bytes > BODY_BYTES_MAX || end > length {
        return Ok(None);
    }
    let mut head = vec![0; head_bytes as usize];
    reader.read_exact(&mut head)?;
    let mut found = crc32fast::Hasher::new();
    found.update(fixed.get(..9).unwrap_or_default());
    found.update(&head);
    Ok((found.finalize() == check).then_some(Found {
        kind,
        head,
        body_at,
        body_bytes,
        body_check,
        end,
    }))
}

/// The whole frames of a file's bytes, head and body, up to the first that is none.
pub(crate) fn frames(bytes: &[u8]) -> Vec<(Vec<u8>, &[u8])> {
    let mut frames = Vec::new();
    if !bytes.starts_with(MAGIC) {
        return frames;
    }
    let mut at = MAGIC.len();
    while let Some(rest) = bytes.get(at..)
        && let Ok(Some(found)) = next(&mut &*rest, at as u64, bytes.len() as u64)
        && let (Ok(from), Ok(end)) = (usize::try_from(found.body_at), usize::try_from(found.end))
    {
        let body = bytes.get(from..end).unwrap_or_default();
        if crc32fast::hash(body) == found.body_check {
            frames.push((found.head, body));
        }
        at = end;
    }
    frames
}

/// A body; none where its bytes are not those that were written.
pub(super) fn body(file: &File, at: u64, bytes: u32, check: u32) -> io::Result<Option<Vec<u8>>> {
    let mut body = vec![0; bytes as usize];
    file.read_exact_at(&mut body, at)?;
    Ok((crc32fast::hash(&body) == check).then_some(body))
}
