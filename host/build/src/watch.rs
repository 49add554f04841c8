//! Has a source changed? Looks at the times and sizes of its files.
//!
//! It looks instead of asking the system to be told: editors replace files, folders lie on networks, and some dozen files are read
//! in less than a millisecond. Never: reads what is in a file.

use std::{
    fs,
    path::{Path, PathBuf},
    time::SystemTime,
};

/// Files that are looked at; a project has some dozen.
const FILES_MAX: usize = 5_000;
/// Levels of folders.
const DEPTH_MAX: u32 = 12;
/// Ends of names that belong to a source.
const ENDS: [&str; 4] = ["st", "rs", "toml", "wit"];
/// Folders with what is built or fetched.
const PASSED: [&str; 3] = ["target", ".git", "node_modules"];

/// A file with when it was written and its size.
type Stamp = (PathBuf, Option<SystemTime>, u64);

/// A source that is watched.
#[derive(Debug)]
pub struct Watch {
    root: PathBuf,
    seen: Vec<Stamp>,
}

impl Watch {
    /// Begins to watch a file or a folder, as it is now.
    #[must_use]
    pub fn new(root: &Path) -> Self {
        Self {
            root: root.to_owned(),
            seen: stamps(root),
        }
    }

    /// Has anything changed since it was asked last?
    pub fn changed(&mut self) -> bool {
        let now = stamps(&self.root);
        let changed = now != self.seen;
        self.seen = now;
        changed
    }
}

impl Watch {
    /// Has anything changed when so much time has passed? Blocks for it.
    pub fn changed_after(&mut self, pause: std::time::Duration) -> bool {
        std::thread::sleep(pause);
        self.changed()
    }
}

fn stamps(root: &Path) -> Vec<Stamp> {
    let mut found = Vec::new();
    walk(root, 0, &mut found);
    found.sort();
    found
}

fn walk(path: &Path, depth: u32, found: &mut Vec<Stamp>) {
    let Ok(about) = fs::metadata(path) else { return };
    if about.is_file() {
        let end = path.extension().and_then(|end| end.to_str()).unwrap_or_default();
        if found.len() < FILES_MAX && ENDS.contains(&end) {
            found.push((path.to_owned(), about.modified().ok(), about.len()));
        }
        return;
    }
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    if depth > DEPTH_MAX || (depth > 0 && PASSED.contains(&name)) {
        return;
    }
    for entry in fs::read_dir(path).into_iter().flatten().flatten() {
        walk(&entry.path(), depth + 1, found);
    }
}
