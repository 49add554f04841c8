//! The files of the history: which there are, which of them grows, and which go when there is no room.
//!
//! ```text
//! history/
//!   journal-<n>          the last minutes of the finest pieces, of all series, half a second a frame
//!   <step>s-<n>          packed pieces of one step; grows until it is full, then never changes again
//! ```
//! A journal's rows are packed into the finest step's file, under a mark that names the journal; then the journal goes. Whatever
//! a dying process left behind the last mark counts for nothing, for the journal still has it.
//! Owns: the files and their bytes. Never: the rows.

use std::{
    collections::BTreeMap,
    fs::{self, DirBuilder, File},
    os::unix::fs::DirBuilderExt as _,
    path::{Path, PathBuf},
    sync::Arc,
};

use bumpless_core::history::{Layout, Row, STEPS_NS, Series};

use super::{
    block::{self, BlockError, Head, RowBlock},
    file::{self, Found, Growing, Kind},
};
use crate::{error::Error, medium, store::sync_parent};

/// Where a block lies.
#[derive(Debug, Clone)]
pub(super) struct Place {
    pub(super) segment: u64,
    /// Whoever has the place can read it, also when the file went meanwhile.
    pub(super) file: Arc<File>,
    pub(super) at: u64,
    pub(super) bytes: u32,
    pub(super) check: u32,
    pub(super) rows: u32,
    pub(super) step_ns: u64,
    pub(super) first_ns: u64,
    pub(super) end_ns: u64,
    pub(super) layout: Arc<Layout>,
}

impl Place {
    /// Its pieces; or why they cannot be had.
    pub(super) fn read(&self, layout: &Arc<Layout>) -> Result<Vec<Row>, String> {
        let body = file::body(&self.file, self.at, self.bytes, self.check).map_err(|error| error.to_string())?;
        let body = body.ok_or_else(|| BlockError::Check.to_string())?;
        block::rows(self.step_ns, self.rows, layout, &body).map_err(|error| error.to_string())
    }
}

/// A file of packed pieces.
#[derive(Debug)]
pub(super) struct Segment {
    pub(super) level: usize,
    pub(super) growing: Growing,
    pub(super) first_ns: u64,
    pub(super) end_ns: u64,
}

/// All files.
#[derive(Debug)]
pub(super) struct Disk {
    folder: PathBuf,
    /// By number; the newest of a level grows.
    pub(super) segments: BTreeMap<u64, Segment>,
    pub(super) journal: Growing,
    pub(super) journal_number: u64,
    next: u64,
    bytes_max: u64,
    keep_ns: [u64; STEPS_NS.len()],
    /// For tests: bytes that the disk still takes.
    #[cfg(test)]
    pub(super) room: Option<Arc<std::sync::atomic::AtomicU64>>,
}

/// What was found at the start.
#[derive(Debug, Default)]
pub(super) struct Opened {
    pub(super) blocks: Vec<(usize, Series, Place)>,
    /// Bodies of the journals' entries, oldest first.
    pub(super) entries: Vec<Vec<u8>>,
    /// Bytes that counted for nothing.
    pub(super) cut_bytes: u64,
}

fn name_of(path: &Path) -> Option<(&str, u64)> {
    let (kind, number) = path.file_name()?.to_str()?.rsplit_once('-')?;
    Some((kind, number.parse().ok()?))
}

fn level_of(kind: &str) -> Option<usize> {
    let seconds: u64 = kind.strip_suffix('s')?.parse().ok()?;
    let step_ns = seconds.checked_mul(STEPS_NS[0])?;
    STEPS_NS.iter().position(|step| *step == step_ns)
}

impl Disk {
    /// Opens the folder, and makes it where there is none. Cuts what a dying process left half written, and says so.
    pub(super) fn open(folder: &Path, bytes_max: u64, keep_ns: [u64; STEPS_NS.len()]) -> Result<(Self, Opened), Error> {
        match DirBuilder::new().mode(0o700).create(folder) {
            Err(error) if error.kind() != std::io::ErrorKind::AlreadyExists => {
                return Err(Error::io("create", folder, error));
            }
            _ => {}
        }
        let mut opened = Opened::default();
        let (mut files, mut journals) = (BTreeMap::new(), BTreeMap::new());
        for entry in fs::read_dir(folder).map_err(|error| Error::io("read", folder, error))? {
            let path = entry.map_err(|error| Error::io("read", folder, error))?.path();
            match name_of(&path) {
                Some(("journal", number)) => drop(journals.insert(number, path)),
                Some((kind, number)) => {
                    if let Some(level) = level_of(kind) {
                        files.insert(number, (level, path));
                    }
                }
                None => {}
            }
        }
        let newest: BTreeMap<usize, u64> = files.iter().map(|(number, (level, _))| (*level, *number)).collect();
        let next = 1 + files.keys().chain(journals.keys()).max().copied().unwrap_or(0);
        let mut segments = BTreeMap::new();
        let mut packed = None;
        for (number, (level, path)) in files {
            let grows = newest.get(&level) == Some(&number);
            let segment = read_segment(number, level, &path, grows, &mut opened, &mut packed)?;
            segments.extend(segment.map(|segment| (number, segment)));
        }
        let mut journal = None;
        for (number, path) in journals {
            if packed.is_some_and(|packed| number <= packed) {
                medium::remove(&path).map_err(|error| Error::io("remove", &path, error))?;
                continue;
            }
            journal = read_journal(&path, &mut opened)?.map(|file| (number, file)).or(journal);
        }
        let (journal_number, journal) = match journal {
            Some(found) => found,
            None => (next, Growing::create(&folder.join(format!("journal-{next}")))?),
        };
        let disk = Self {
            folder: folder.to_owned(),
            segments,
            next: next + 1,
            journal,
            journal_number,
            bytes_max,
            keep_ns,
            #[cfg(test)]
            room: None,
        };
        Ok((disk, opened))
    }

    /// Bytes of all files.
    pub(super) fn bytes(&self) -> u64 {
        self.segments.values().map(|segment| segment.growing.bytes).sum::<u64>() + self.journal.bytes
    }

    /// Bytes of a file at which the next one begins: small parts of the whole, so that little goes at once, but some hundred
    /// files at most.
    const fn segment_bytes(&self) -> u64 {
        self.bytes_max / 128
    }

    /// Bytes of a journal at which it is packed.
    pub(super) const fn journal_bytes_max(&self) -> u64 {
        let part = self.bytes_max / 32;
        if part < 4 * 1024 * 1024 { part } else { 4 * 1024 * 1024 }
    }

    /// Puts packed pieces behind those of their level, all or none. Gives back where each lies.
    pub(super) fn put(&mut self, level: usize, blocks: Vec<RowBlock>) -> Result<Vec<(Series, Place)>, Error> {
        let number = self.growing(level)?;
        let journal = self.journal_number;
        let Some(segment) = self.segments.get_mut(&number) else {
            return Ok(Vec::new());
        };
        #[cfg(test)]
        segment.growing.room.clone_from(&self.room);
        let mut bytes = Vec::new();
        let mut places = Vec::with_capacity(blocks.len());
        for RowBlock { head, body } in blocks {
            let Ok(head_bytes) = postcard::to_allocvec(&head) else {
                continue;
            };
            places.push((
                head.series,
                Place {
                    segment: number,
                    file: Arc::clone(&segment.growing.file),
                    at: segment.growing.bytes + bytes.len() as u64 + file::before_body(&head_bytes),
                    bytes: u32::try_from(body.len()).unwrap_or(u32::MAX),
                    check: crc32fast::hash(&body),
                    rows: head.rows,
                    step_ns: head.step_ns,
                    first_ns: head.first_ns,
                    end_ns: head.end_ns,
                    layout: Arc::new(head.layout),
                },
            ));
            bytes.extend(file::frame(Kind::Block, &head_bytes, &body));
        }
        // Only the finest step is packed from a journal.
        let packed = if level == 0 { journal } else { 0 };
        bytes.extend(file::frame(Kind::Mark, &packed.to_le_bytes(), &[]));
        segment.growing.append(&bytes)?;
        for (_, place) in &places {
            segment.first_ns = segment.first_ns.min(place.first_ns);
            segment.end_ns = segment.end_ns.max(place.end_ns);
        }
        Ok(places)
    }

    /// The file of a level that grows.
    fn growing(&mut self, level: usize) -> Result<u64, Error> {
        let keep_ns = self.keep_ns.get(level).copied().unwrap_or(u64::MAX);
        let newest = self.segments.iter().rev().find(|(_, segment)| segment.level == level);
        if let Some((number, segment)) = newest
            && segment.growing.bytes < self.segment_bytes()
            // A file goes as a whole, so none spans much of the time that its pieces are kept.
            && segment.end_ns.saturating_sub(segment.first_ns) < keep_ns / 8
        {
            return Ok(*number);
        }
        let seconds = STEPS_NS.get(level).copied().unwrap_or_default() / STEPS_NS[0];
        let number = self.next;
        let path = self.folder.join(format!("{seconds}s-{number}"));
        let growing = Growing::create(&path)?;
        sync_parent(&path)?;
        self.next += 1;
        let segment = Segment {
            level,
            growing,
            first_ns: u64::MAX,
            end_ns: 0,
        };
        self.segments.insert(number, segment);
        Ok(number)
    }

    /// Puts what the journal has, packed, into the finest step's file, and begins the next journal. All or nothing: where this
    /// fails the journal goes on.
    pub(super) fn pack_journal(&mut self, blocks: Vec<RowBlock>) -> Result<Vec<(Series, Place)>, Error> {
        let number = self.next;
        let path = self.folder.join(format!("journal-{number}"));
        // First of all: once the mark is written nothing more may go into the old one.
        let next = Growing::create(&path)?;
        self.next += 1;
        let places = self.put(0, blocks).inspect_err(|_| {
            // An empty journal that stays is read as one at the next start.
            let _ = medium::remove(&path);
        })?;
        let synced = sync_parent(&path).and_then(|()| match places.first() {
            Some((_, place)) => self.segments.get(&place.segment).map_or(Ok(()), |s| s.growing.sync()),
            None => Ok(()),
        });
        let old = std::mem::replace(&mut self.journal, next);
        self.journal_number = number;
        match synced {
            Ok(()) => {
                // One that stays is known by its number, and goes at the next start.
                let _ = medium::remove(&old.path);
            }
            Err(error) => tracing::warn!(%error, "packed history may not outlive a loss of power"),
        }
        Ok(places)
    }

    /// Puts an entry into the journal.
    pub(super) fn journal(&mut self, entry: &[u8]) -> Result<(), Error> {
        #[cfg(test)]
        self.journal.room.clone_from(&self.room);
        self.journal.append(&file::frame(Kind::Entry, &[], entry)).map(|_| ())
    }

    /// The file that should go next: one whose pieces are older than they are kept, else, where the bound is near, the oldest of
    /// the finest level that has one which does not grow any more.
    pub(super) fn next_to_go(&self, newest_ns: u64) -> Option<(u64, usize)> {
        let rest = |level: usize| {
            let mut of_level = self.segments.iter().filter(move |(_, segment)| segment.level == level);
            // Those that do not grow any more, oldest first.
            of_level.next_back();
            of_level
        };
        let over = self.bytes().saturating_add(2 * self.journal_bytes_max()) > self.bytes_max;
        (0..STEPS_NS.len()).find_map(|level| {
            let (number, oldest) = rest(level).next()?;
            let keep_ns = self.keep_ns.get(level).copied().unwrap_or(u64::MAX);
            let outdated = oldest.end_ns.saturating_add(keep_ns) < newest_ns;
            (over || outdated).then_some((*number, level))
        })
    }

    /// Throws a file away. Who still reads it has it until it is done.
    pub(super) fn remove(&mut self, number: u64) -> Result<(), Error> {
        if let Some(segment) = self.segments.get(&number) {
            let path = &segment.growing.path;
            medium::remove(path).map_err(|error| Error::io("remove", path, error))?;
        }
        self.segments.remove(&number);
        Ok(())
    }

    /// Brings everything that grows to the disk.
    pub(super) fn sync(&self) -> Result<(), Error> {
        self.journal.sync()?;
        let mut newest: BTreeMap<usize, &Segment> = BTreeMap::new();
        for segment in self.segments.values() {
            newest.insert(segment.level, segment);
        }
        newest.values().try_for_each(|segment| segment.growing.sync())
    }
}

/// Reads the heads of a file of packed pieces. `packed` becomes the last journal that is packed in one.
fn read_segment(
    number: u64,
    level: usize,
    path: &Path,
    grows: bool,
    opened: &mut Opened,
    packed: &mut Option<u64>,
) -> Result<Option<Segment>, Error> {
    let mut pending: Vec<(Head, Found)> = Vec::new();
    let mut marked = Vec::new();
    let take = |_: &File, found: Found| {
        Ok(match found.kind {
            Kind::Block => {
                let Ok(head) = postcard::from_bytes::<Head>(&found.head) else {
                    return Ok(None);
                };
                pending.push((head, found));
                Some(false)
            }
            Kind::Mark => {
                marked.append(&mut pending);
                if let Ok(journal) = <[u8; 8]>::try_from(found.head.as_slice()) {
                    *packed = (*packed).max(Some(u64::from_le_bytes(journal)));
                }
                Some(true)
            }
            Kind::Entry => None,
        })
    };
    let (growing, lost) = match file::open(path, grows, take) {
        Err(error @ Error::NoHistory { .. }) => {
            set_aside(path, &error)?;
            return Ok(None);
        }
        other => other?,
    };
    say_cut(path, lost, opened);
    let place = |(head, found): (Head, Found)| {
        let place = Place {
            segment: number,
            file: Arc::clone(&growing.file),
            at: found.body_at,
            bytes: found.body_bytes,
            check: found.body_check,
            rows: head.rows,
            step_ns: head.step_ns,
            first_ns: head.first_ns,
            end_ns: head.end_ns,
            layout: Arc::new(head.layout),
        };
        (level, head.series, place)
    };
    let first_ns = marked.iter().map(|(head, _)| head.first_ns).min();
    let end_ns = marked.iter().map(|(head, _)| head.end_ns).max();
    opened.blocks.extend(marked.into_iter().map(place));
    Ok(Some(Segment {
        level,
        growing,
        first_ns: first_ns.unwrap_or(u64::MAX),
        end_ns: end_ns.unwrap_or(0),
    }))
}

fn read_journal(path: &Path, opened: &mut Opened) -> Result<Option<Growing>, Error> {
    let mut entries = Vec::new();
    let take = |file: &File, found: Found| {
        if found.kind != Kind::Entry {
            return Ok(None);
        }
        let body = file::body(file, found.body_at, found.body_bytes, found.body_check)?;
        Ok(body.map(|body| {
            entries.push(body);
            true
        }))
    };
    let (growing, lost) = match file::open(path, true, take) {
        Err(error @ Error::NoHistory { .. }) => {
            set_aside(path, &error)?;
            return Ok(None);
        }
        other => other?,
    };
    say_cut(path, lost, opened);
    opened.entries.append(&mut entries);
    Ok(Some(growing))
}

/// History must not keep a host from starting.
fn set_aside(path: &Path, error: &Error) -> Result<(), Error> {
    let aside = path.with_extension("damaged");
    tracing::error!(%error, aside = %aside.display(), "a file of the history is moved aside");
    medium::rename(path, &aside).map_err(|error| Error::io("move away", path, error))
}

fn say_cut(path: &Path, lost: u64, opened: &mut Opened) {
    if lost > 0 {
        opened.cut_bytes += lost;
        tracing::warn!(path = %path.display(), bytes = lost, "the end of a file of the history was not whole and is left out");
    }
}
