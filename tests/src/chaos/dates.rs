//! Dates that step while a host runs: the system's clock as a library in front of it says it is.
//!
//! The library is libfaketime (Debian's package `faketime`), loaded before all others into the host's process. It reads a file
//! once a second, so a test sets a host's date by writing there. Monotonic time stays the system's.
//! Never: changes this machine's own date, or that of any other process.

use std::{
    fs,
    path::{Path, PathBuf},
};

use crate::Error;

/// Name of the file in a host's folder.
const FILE: &str = "date";

/// Where the library is, if it is installed.
pub(crate) fn library() -> Option<PathBuf> {
    let folders = |root: &str| {
        let inner = fs::read_dir(root)
            .into_iter()
            .flatten()
            .flatten()
            .map(|entry| entry.path());
        std::iter::once(PathBuf::from(root)).chain(inner)
    };
    ["/usr/lib", "/usr/lib64", "/usr/local/lib"]
        .into_iter()
        .flat_map(folders)
        .map(|folder| folder.join("faketime/libfaketimeMT.so.1"))
        .find(|library| library.is_file())
}

/// Makes the file for a host, and gives the variables of its environment.
pub(crate) fn prepare(library: &Path, folder: &Path) -> Result<Vec<(String, String)>, Error> {
    fs::create_dir_all(folder).map_err(|source| Error::File {
        path: folder.to_owned(),
        action: "written",
        source,
    })?;
    step(folder, 0)?;
    let pairs = [
        ("LD_PRELOAD", library.display().to_string()),
        ("FAKETIME_TIMESTAMP_FILE", folder.join(FILE).display().to_string()),
        ("FAKETIME_CACHE_DURATION", "1".to_owned()),
        ("FAKETIME_DONT_FAKE_MONOTONIC", "1".to_owned()),
        ("NO_FAKE_STAT", "1".to_owned()),
    ];
    Ok(pairs.map(|(name, value)| (name.to_owned(), value)).to_vec())
}

/// Sets a host's date so many seconds off, within about a second.
pub(crate) fn step(folder: &Path, by_s: i64) -> Result<(), Error> {
    let (path, new) = (folder.join(FILE), folder.join("date.new"));
    // Renamed, so that it is never read half.
    fs::write(&new, format!("{by_s:+}"))
        .and_then(|()| fs::rename(&new, &path))
        .map_err(|source| Error::File {
            path,
            action: "written",
            source,
        })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests")]

    use std::{
        process::Command,
        time::{SystemTime, UNIX_EPOCH},
    };

    use super::*;

    #[test]
    fn a_process_sees_the_date_that_it_is_given() {
        let Some(library) = library() else {
            eprintln!("NOT RUN: there is no libfaketime here (Debian: faketime)");
            return;
        };
        let folder = tempfile::tempdir().unwrap();
        let environment = prepare(&library, folder.path()).unwrap();
        for by_s in [0, 86_400, -7_200] {
            step(folder.path(), by_s).unwrap();
            let output = Command::new("date")
                .arg("+%s")
                .envs(environment.clone())
                .output()
                .unwrap();
            let told: i64 = String::from_utf8(output.stdout).unwrap().trim().parse().unwrap();
            let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs();
            let off_s = told - i64::try_from(now).unwrap();
            assert!((off_s - by_s).abs() < 600, "{off_s} s off, not {by_s} s");
        }
    }
}
