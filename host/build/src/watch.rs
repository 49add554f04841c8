//! Has a source changed? The system says when to look (inotify), the times and sizes of the files say whether.
//!
//! Folders are watched, not files, because editors put new files in the place of old ones. Folders of what is built are not: each
//! build would wake the watch a thousand times. Never: reads what is in a file.

use std::{
    fs,
    mem::MaybeUninit,
    os::fd::OwnedFd,
    path::{Path, PathBuf},
    time::{Duration, Instant, SystemTime},
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    fs::inotify::{self, CreateFlags, WatchFlags},
    io::Errno,
};

use crate::Error;

/// Files that are looked at; a project has some dozen.
const FILES_MAX: usize = 5_000;
/// Folders that are watched; the system's own limit for a user is some ten thousand.
const FOLDERS_MAX: usize = 1_000;
/// Levels of folders.
const DEPTH_MAX: u32 = 12;
/// Ends of names that belong to a source.
const ENDS: [&str; 11] = ["st", "rs", "toml", "wit", "c", "h", "js", "ts", "json", "py", "sh"];
/// Folders with what is built or fetched.
const PASSED: [&str; 6] = ["target", ".git", "node_modules", "build", "venv", "__pycache__"];
/// Quiet after which a save counts as whole: an editor writes several files, or one in parts.
const SETTLED: Duration = Duration::from_millis(30);
/// Longest time that is waited for that quiet.
const SETTLED_MAX: Duration = Duration::from_secs(2);

/// A file with when it was written and its size.
type Stamp = (PathBuf, Option<SystemTime>, u64);

/// A source that is watched.
#[derive(Debug)]
pub struct Watch {
    root: PathBuf,
    notices: OwnedFd,
    seen: Vec<Stamp>,
}

/// What lies at a path.
#[derive(Debug, Default)]
struct Found {
    files: Vec<Stamp>,
    folders: Vec<PathBuf>,
}

impl Watch {
    /// Begins to watch a file or a folder, as it is now.
    ///
    /// # Errors
    /// [`Error::Watch`] where the system watches nothing more for this user, or cannot at all.
    pub fn new(root: &Path) -> Result<Self, Error> {
        let refused = |source: Errno| Error::Watch {
            path: root.to_owned(),
            source: source.into(),
        };
        let notices = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).map_err(refused)?;
        let mut watch = Self {
            root: root.to_owned(),
            notices,
            seen: Vec::new(),
        };
        watch.watch_folders()?;
        watch.seen = found(root).files;
        Ok(watch)
    }

    /// Waits for a change, at most so long. Says when it was noticed; the rest of a save is waited for, and belongs to it.
    ///
    /// # Errors
    /// As [`Watch::new`], for folders that are new.
    pub fn wait(&mut self, at_most: Duration) -> Result<Option<Instant>, Error> {
        if !self.noticed(at_most)? {
            return Ok(None);
        }
        let first = Instant::now();
        if !self.changed()? {
            return Ok(None);
        }
        while first.elapsed() < SETTLED_MAX && self.noticed(SETTLED)? {
            self.changed()?;
        }
        Ok(Some(first))
    }

    /// Takes all notices that are there or come within so long; false where none did.
    fn noticed(&self, at_most: Duration) -> Result<bool, Error> {
        let wait = Timespec {
            tv_sec: i64::try_from(at_most.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: at_most.subsec_nanos().into(),
        };
        let mut ready = [PollFd::new(&self.notices, PollFlags::IN)];
        match poll(&mut ready, Some(&wait)) {
            Ok(0) | Err(Errno::INTR) => return Ok(false),
            Ok(_) => {}
            Err(source) => return Err(self.lost(source)),
        }
        // Which files they are of is not asked: some may have been dropped, and a look at all of them takes less than a millisecond.
        let mut buffer = [MaybeUninit::uninit(); 4096];
        let mut notices = inotify::Reader::new(&self.notices, &mut buffer);
        loop {
            match notices.next() {
                Ok(_) => {}
                Err(Errno::WOULDBLOCK) => return Ok(true),
                Err(Errno::INTR) => {}
                Err(source) => return Err(self.lost(source)),
            }
        }
    }

    fn lost(&self, source: Errno) -> Error {
        Error::Watch {
            path: self.root.clone(),
            source: source.into(),
        }
    }

    /// Has anything changed since it was looked at last?
    fn changed(&mut self) -> Result<bool, Error> {
        // New folders first: what is put into them from now on is noticed, and what is there already is found.
        self.watch_folders()?;
        let now = found(&self.root).files;
        let changed = now != self.seen;
        self.seen = now;
        Ok(changed)
    }

    /// Watches every folder of the source; those that are watched stay so.
    fn watch_folders(&self) -> Result<(), Error> {
        let what = WatchFlags::CLOSE_WRITE
            | WatchFlags::MOVED_TO
            | WatchFlags::MOVED_FROM
            | WatchFlags::DELETE
            | WatchFlags::CREATE;
        for folder in found(&self.root).folders {
            match inotify::add_watch(&self.notices, &folder, what) {
                // A folder that went away meanwhile is none of the source.
                Ok(_) | Err(Errno::NOENT) => {}
                Err(source) => {
                    return Err(Error::Watch {
                        path: folder,
                        source: source.into(),
                    });
                }
            }
        }
        Ok(())
    }
}

fn found(root: &Path) -> Found {
    let mut found = Found::default();
    if fs::metadata(root).is_ok_and(|about| about.is_dir()) {
        walk(root, 0, &mut found);
    } else {
        let folder = root.parent().filter(|folder| !folder.as_os_str().is_empty());
        found.folders.push(folder.unwrap_or(Path::new(".")).to_owned());
        file(root, &mut found);
    }
    found.files.sort();
    found
}

fn file(path: &Path, found: &mut Found) {
    let end = path.extension().and_then(|end| end.to_str()).unwrap_or_default();
    if found.files.len() < FILES_MAX
        && ENDS.contains(&end)
        && let Ok(about) = fs::metadata(path)
    {
        found.files.push((path.to_owned(), about.modified().ok(), about.len()));
    }
}

fn walk(folder: &Path, depth: u32, found: &mut Found) {
    let name = folder.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    if depth > DEPTH_MAX || found.folders.len() >= FOLDERS_MAX || (depth > 0 && PASSED.contains(&name)) {
        return;
    }
    found.folders.push(folder.to_owned());
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        // Of a link to a folder nothing is followed: it may lead back.
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => walk(&entry.path(), depth + 1, found),
            Ok(_) => file(&entry.path(), found),
            Err(_) => {}
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    /// Long enough for any machine; a test that is right never waits so long.
    const LONG: Duration = Duration::from_secs(20);
    /// What is not there is not waited for.
    const NOT: Duration = Duration::ZERO;

    #[test]
    fn a_change_is_seen_once() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.st");
        fs::write(&file, "one").unwrap();
        let mut watch = Watch::new(folder.path()).unwrap();
        assert!(watch.wait(NOT).unwrap().is_none());
        fs::write(&file, "another").unwrap();
        assert!(watch.wait(LONG).unwrap().is_some());
        assert!(watch.wait(NOT).unwrap().is_none());
        fs::write(folder.path().join("notes.txt"), "x").unwrap();
        assert!(watch.wait(LONG).unwrap().is_none(), "no part of a source");
        fs::remove_file(&file).unwrap();
        assert!(watch.wait(LONG).unwrap().is_some());
    }

    #[test]
    fn new_folders_are_watched_and_those_of_builds_are_not() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("target")).unwrap();
        let mut watch = Watch::new(folder.path()).unwrap();
        fs::write(folder.path().join("target/a.rs"), "built").unwrap();
        assert!(watch.wait(NOT).unwrap().is_none());
        fs::create_dir(folder.path().join("src")).unwrap();
        assert!(watch.wait(LONG).unwrap().is_none(), "a folder alone is no change");
        fs::write(folder.path().join("src/lib.rs"), "fn a() {}").unwrap();
        assert!(watch.wait(LONG).unwrap().is_some());
    }

    #[test]
    fn one_file_is_watched_as_editors_write_it() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.st");
        fs::write(&file, "one").unwrap();
        let mut watch = Watch::new(&file).unwrap();
        fs::write(folder.path().join("b.st"), "another's").unwrap();
        assert!(watch.wait(LONG).unwrap().is_none());
        // Beside it first, then into its place.
        let beside = folder.path().join(".a.swp");
        fs::write(&beside, "and two").unwrap();
        fs::rename(&beside, &file).unwrap();
        let mut seen = false;
        for _ in 0..2 {
            seen |= watch.wait(LONG).unwrap().is_some();
            if seen {
                break;
            }
        }
        assert!(seen);
        let gone = Watch::new(&folder.path().join("no/such/a.st"));
        assert!(gone.is_ok(), "it may still come");
    }
}
