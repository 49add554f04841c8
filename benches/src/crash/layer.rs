//! A disk that fails: it counts each change of the store's files, and at a chosen one it ends the process or refuses.
//!
//! ```text
//!   change 1, 2, … n-1: made          change n:   kill   ── the process ends before it
//!                                                 torn   ── half of it is made, then the process ends
//!                                                 power  ── of what no sync covers, any part was made or not; then the end
//!                                                 full   ── the disk refuses this and some more, then has room again
//!                                                 frozen ── the disk refuses every change from here on (mounted read-only)
//! ```
//! Without power, what a sync does not cover may be there in any part: of each file's unsynced writes any 512-byte sectors, of a
//! folder's unsynced new names, renames and removals any first ones, in their order, as a journal keeps them.
//! Never: reads what a file means.

use std::{
    collections::BTreeMap,
    fs::{self, File, OpenOptions},
    io,
    os::unix::fs::FileExt as _,
    path::{Path, PathBuf},
    sync::{
        Mutex,
        atomic::{AtomicU64, Ordering},
    },
};

use bumpless_store::{Interference, Touch};

/// Bytes that a disk writes whole or not at all.
const SECTOR: usize = 512;

/// Changes of this process's stores so far: what a writer tells at its end.
pub(crate) static CHANGES: AtomicU64 = AtomicU64::new(0);

/// How a life ends, or what it has to bear.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub(crate) enum Mishap {
    /// `kill -9` between two changes.
    Kill,
    /// The process ends in the middle of a write.
    Torn,
    /// The machine loses power.
    Power,
    /// The disk is full for a while.
    Full,
    /// The disk turns read-only.
    Frozen,
    /// Nothing happens.
    None,
}

/// Changes that a full disk refuses before there is room again.
const FULL_FOR: u64 = 40;

/// One change of a file that no sync covers yet.
#[derive(Debug)]
enum Unsynced {
    Write {
        at: u64,
        before: Vec<u8>,
        length: u64,
        after: Vec<u8>,
    },
    Length {
        before: u64,
        cut: Vec<u8>,
        after: u64,
    },
}

/// One change of a folder that no sync covers yet.
#[derive(Debug)]
enum Named {
    Created(PathBuf),
    Renamed {
        from: PathBuf,
        to: PathBuf,
        replaced: Option<PathBuf>,
    },
    Removed {
        path: PathBuf,
        kept: PathBuf,
    },
}

#[derive(Debug, Default)]
struct Disk {
    changes: u64,
    files: BTreeMap<PathBuf, Vec<Unsynced>>,
    folders: BTreeMap<PathBuf, Vec<Named>>,
    kept: u64,
    random: u64,
}

/// The disk of one life.
#[derive(Debug)]
pub(crate) struct Layer {
    mishap: Mishap,
    /// The change at which it happens, from 1 on.
    at: u64,
    /// Where files lie that were removed or replaced, and may come back.
    attic: PathBuf,
    disk: Mutex<Disk>,
}

impl Layer {
    pub(crate) fn new(mishap: Mishap, at: u64, seed: u64, attic: &Path) -> Self {
        Self {
            mishap,
            at,
            attic: attic.to_owned(),
            disk: Mutex::new(Disk {
                random: seed,
                ..Disk::default()
            }),
        }
    }
}

impl Interference for Layer {
    fn before(&self, touch: &Touch<'_>) -> io::Result<()> {
        let mut disk = self.disk.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        disk.changes += 1;
        CHANGES.store(disk.changes, Ordering::Relaxed);
        let (number, at) = (disk.changes, self.at);
        match self.mishap {
            Mishap::Kill if number == at => end(),
            Mishap::Torn if number == at => {
                // A failure to tear is as good as a kill.
                let _ = tear(touch);
                end()
            }
            Mishap::Power if number == at => {
                if let Err(error) = disk.cut_off() {
                    // A loss of power that was not made whole would be a test of nothing.
                    crate::report::failed(&error);
                    std::process::exit(2);
                }
                end()
            }
            Mishap::Full if (at..at + FULL_FOR).contains(&number) && takes_room(touch) => {
                Err(io::ErrorKind::StorageFull.into())
            }
            Mishap::Frozen if number >= at => Err(io::ErrorKind::ReadOnlyFilesystem.into()),
            Mishap::Power => disk.note(touch, &self.attic),
            _ => Ok(()),
        }
    }
}

/// A full disk syncs, cuts and removes.
fn takes_room(touch: &Touch<'_>) -> bool {
    matches!(touch, Touch::Create(_) | Touch::Write { .. } | Touch::Length { .. })
}

/// As `kill -9` does it: nothing is told, nothing is dropped.
fn end() -> ! {
    let _sent = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL);
    loop {
        std::thread::park();
    }
}

fn tear(touch: &Touch<'_>) -> io::Result<()> {
    if let Touch::Write { path, at, bytes } = touch {
        let half = bytes.get(..bytes.len() / 2).unwrap_or_default();
        OpenOptions::new().write(true).open(path)?.write_all_at(half, *at)?;
    }
    Ok(())
}

/// Bytes of a file from a place on, at most so many.
fn part(file: &File, at: u64, many: usize) -> io::Result<Vec<u8>> {
    let length = file.metadata()?.len();
    let there = usize::try_from(length.saturating_sub(at))
        .unwrap_or(usize::MAX)
        .min(many);
    let mut bytes = vec![0; there];
    file.read_exact_at(&mut bytes, at)?;
    Ok(bytes)
}

impl Disk {
    /// A number of chance (SplitMix64; Steele, Lea, Flood 2014).
    fn chance(&mut self) -> u64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Remembers how to undo a change that is about to be made.
    fn note(&mut self, touch: &Touch<'_>, attic: &Path) -> io::Result<()> {
        match touch {
            Touch::Create(path) => self.named(path, Named::Created((*path).to_owned())),
            Touch::Write { path, at, bytes } => {
                let file = File::open(path)?;
                let change = Unsynced::Write {
                    at: *at,
                    before: part(&file, *at, bytes.len())?,
                    length: file.metadata()?.len(),
                    after: bytes.to_vec(),
                };
                self.files.entry((*path).to_owned()).or_default().push(change);
            }
            Touch::Length { path, bytes } => {
                let file = File::open(path)?;
                let change = Unsynced::Length {
                    before: file.metadata()?.len(),
                    cut: part(&file, *bytes, usize::MAX)?,
                    after: *bytes,
                };
                self.files.entry((*path).to_owned()).or_default().push(change);
            }
            Touch::Sync(path) => drop(self.files.remove(*path)),
            Touch::Rename { from, to } => {
                let replaced = if to.exists() { Some(self.keep(to, attic)?) } else { None };
                self.files.remove(*to);
                // What was not synced of it goes with it.
                if let Some(changes) = self.files.remove(*from) {
                    self.files.insert((*to).to_owned(), changes);
                }
                let change = Named::Renamed {
                    from: (*from).to_owned(),
                    to: (*to).to_owned(),
                    replaced,
                };
                self.named(to, change);
            }
            Touch::Remove(path) => {
                let kept = self.keep(path, attic)?;
                self.files.remove(*path);
                let change = Named::Removed {
                    path: (*path).to_owned(),
                    kept,
                };
                self.named(path, change);
            }
            Touch::SyncFolder(folder) => drop(self.folders.remove(*folder)),
        }
        Ok(())
    }

    fn named(&mut self, path: &Path, change: Named) {
        let folder = path.parent().unwrap_or(path).to_owned();
        self.folders.entry(folder).or_default().push(change);
    }

    /// A second name for a file that is about to lose its own.
    fn keep(&mut self, path: &Path, attic: &Path) -> io::Result<PathBuf> {
        self.kept += 1;
        let kept = attic.join(self.kept.to_string());
        fs::hard_link(path, &kept)?;
        Ok(kept)
    }

    /// The power is gone: makes the files what they might be.
    fn cut_off(&mut self) -> io::Result<()> {
        for (path, changes) in std::mem::take(&mut self.files) {
            // The last change of all may not have been made yet, and a file may be gone.
            let Ok(file) = OpenOptions::new().write(true).open(&path) else {
                continue;
            };
            for change in changes.iter().rev() {
                match change {
                    Unsynced::Write { at, before, length, .. } => {
                        file.write_all_at(before, *at)?;
                        file.set_len(*length)?;
                    }
                    Unsynced::Length { before, cut, after } => {
                        file.set_len(*before)?;
                        file.write_all_at(cut, *after)?;
                    }
                }
            }
            for change in &changes {
                match change {
                    Unsynced::Write { at, after, .. } => {
                        let all = self.chance().is_multiple_of(3);
                        let mut at = *at;
                        let mut rest = after.as_slice();
                        while !rest.is_empty() {
                            let to_border = SECTOR - usize::try_from(at % SECTOR as u64).unwrap_or_default();
                            let (sector, later) = rest.split_at(to_border.min(rest.len()));
                            if all || self.chance().is_multiple_of(2) {
                                file.write_all_at(sector, at)?;
                            }
                            at += sector.len() as u64;
                            rest = later;
                        }
                    }
                    Unsynced::Length { after, .. } if self.chance().is_multiple_of(2) => file.set_len(*after)?,
                    Unsynced::Length { .. } => {}
                }
            }
        }
        for (_, changes) in std::mem::take(&mut self.folders) {
            let kept = usize::try_from(self.chance()).unwrap_or_default() % (changes.len() + 1);
            for change in changes.iter().skip(kept).rev() {
                // A name that is not there was given by the change at which this happens, which was not made.
                let _undone = match change {
                    Named::Created(path) => fs::remove_file(path),
                    Named::Renamed { from, to, replaced } => fs::rename(to, from)
                        .and_then(|()| replaced.as_ref().map_or(Ok(()), |kept| fs::rename(kept, to))),
                    Named::Removed { path, kept } => fs::rename(kept, path),
                };
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn write(disk: &mut Disk, attic: &Path, path: &Path, at: u64, bytes: &[u8]) {
        if !path.exists() {
            disk.note(&Touch::Create(path), attic).unwrap();
            File::create(path).unwrap();
        }
        disk.note(&Touch::Write { path, at, bytes }, attic).unwrap();
        let file = OpenOptions::new().write(true).open(path).unwrap();
        file.write_all_at(bytes, at).unwrap();
    }

    #[test]
    fn what_a_sync_covers_stays_and_the_rest_is_any_part_of_it() {
        let mut seen = std::collections::BTreeSet::new();
        for seed in 0..64 {
            let folder = tempfile::tempdir().unwrap();
            let (attic, path) = (folder.path().join("attic"), folder.path().join("data"));
            fs::create_dir(&attic).unwrap();
            let mut disk = Disk {
                random: seed,
                ..Disk::default()
            };
            write(&mut disk, &attic, &path, 0, &[1; 1024]);
            disk.note(&Touch::Sync(&path), &attic).unwrap();
            disk.note(&Touch::SyncFolder(folder.path()), &attic).unwrap();
            write(&mut disk, &attic, &path, 512, &[2; 1024]);
            disk.cut_off().unwrap();
            let left = fs::read(&path).unwrap();
            assert_eq!(left[..512], [1; 512], "a sync covered it");
            let sectors: Vec<u8> = left.chunks(512).map(|sector| sector[0]).collect();
            assert!(
                left.chunks(512)
                    .all(|sector| sector.iter().all(|byte| *byte == sector[0]))
            );
            seen.insert(sectors);
        }
        // Nothing, each one of the two, both.
        let wanted: [&[u8]; 4] = [&[1, 1], &[1, 2], &[1, 1, 2], &[1, 2, 2]];
        assert_eq!(seen.len(), wanted.len(), "{seen:?}");
        assert!(wanted.iter().all(|one| seen.contains(*one)), "{seen:?}");
    }

    #[test]
    fn names_that_no_sync_covers_go_from_the_last_one_on() {
        let mut seen = std::collections::BTreeSet::new();
        for seed in 0..64 {
            let folder = tempfile::tempdir().unwrap();
            let attic = folder.path().join("attic");
            fs::create_dir(&attic).unwrap();
            let (old, draft) = (folder.path().join("old"), folder.path().join("draft"));
            fs::write(&old, "old").unwrap();
            let mut disk = Disk {
                random: seed,
                ..Disk::default()
            };
            write(&mut disk, &attic, &draft, 0, b"new");
            disk.note(&Touch::Sync(&draft), &attic).unwrap();
            disk.note(&Touch::Rename { from: &draft, to: &old }, &attic).unwrap();
            fs::rename(&draft, &old).unwrap();
            disk.cut_off().unwrap();
            seen.insert((fs::read_to_string(&old).unwrap(), draft.exists()));
        }
        let pairs = [("new", false), ("old", false), ("old", true)];
        assert_eq!(seen, pairs.map(|(text, draft)| (text.to_owned(), draft)).into());
    }
}
