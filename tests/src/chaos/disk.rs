//! A small disk of a host's own, that can be filled: a memory file system of a bounded size.
//!
//! A shell takes it down when this process is gone, however it went. Never: fills a disk that it did not make.

use std::{
    fs::{self, File},
    io::Write as _,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
};

use crate::Error;

/// Bytes written at once while it is filled.
const CHUNK_BYTES: usize = 64 * 1024;

/// A mounted disk.
#[derive(Debug)]
pub struct Disk {
    path: PathBuf,
    cleaner: Child,
}

impl Disk {
    /// Mounts an empty disk of so many bytes at a folder, which is made.
    ///
    /// # Errors
    /// [`Error::File`], or [`Error::Program`] where this user may not mount.
    pub fn mount(path: &Path, bytes: u64) -> Result<Self, Error> {
        fs::create_dir_all(path).map_err(|source| Error::File {
            path: path.to_owned(),
            action: "written",
            source,
        })?;
        let program = |program: &str, source| Error::Program {
            program: program.to_owned(),
            source,
        };
        let output = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &format!("size={bytes},mode=0700"), "tmpfs"])
            .arg(path)
            .stdin(Stdio::null())
            .output()
            .map_err(|source| program("mount", source))?;
        if !output.status.success() {
            let words = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            return Err(program("mount", std::io::Error::other(words)));
        }
        let cleaner = Command::new("sh")
            .args(["-c", "read -r _; umount -l \"$0\""])
            .arg(path)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|source| program("sh", source))?;
        Ok(Self {
            path: path.to_owned(),
            cleaner,
        })
    }

    fn filler(&self) -> PathBuf {
        self.path.join("filler")
    }

    /// Fills it to the last byte.
    ///
    /// # Errors
    /// [`Error::File`] where something else than a full disk ends it.
    pub fn fill(&self) -> Result<(), Error> {
        let path = self.filler();
        let failed = |source| Error::File {
            path: path.clone(),
            action: "written",
            source,
        };
        let mut file = File::options().create(true).append(true).open(&path).map_err(failed)?;
        let zeros = [0; CHUNK_BYTES];
        let mut chunk = CHUNK_BYTES;
        loop {
            match file.write(zeros.get(..chunk).unwrap_or_default()) {
                Ok(_) => {}
                // Less and less, so that no byte is left.
                Err(error) if error.kind() == std::io::ErrorKind::StorageFull && chunk > 1 => chunk /= 2,
                Err(error) if error.kind() == std::io::ErrorKind::StorageFull => return Ok(()),
                Err(error) => return Err(failed(error)),
            }
        }
    }

    /// Gives the room back.
    ///
    /// # Errors
    /// [`Error::File`].
    pub fn free(&self) -> Result<(), Error> {
        let path = self.filler();
        fs::remove_file(&path).map_err(|source| Error::File {
            path,
            action: "removed",
            source,
        })
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        drop(self.cleaner.stdin.take());
        let _cleaned = self.cleaner.wait();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic, clippy::print_stderr, reason = "tests")]

    use super::*;

    #[test]
    fn it_is_full_and_then_it_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let disk = match Disk::mount(&folder.path().join("data"), 1024 * 1024) {
            Ok(disk) => disk,
            Err(error) if rustix::process::getuid().is_root() => panic!("as root it must work: {error}"),
            Err(error) => {
                eprintln!("NOT RUN: only root may mount a small disk: {error}");
                return;
            }
        };
        let note = folder.path().join("data/note");
        fs::write(&note, "a").unwrap();
        disk.fill().unwrap();
        let full = fs::write(folder.path().join("data/more"), vec![1; 8192]).unwrap_err();
        assert_eq!(full.kind(), std::io::ErrorKind::StorageFull);
        disk.free().unwrap();
        fs::write(folder.path().join("data/more"), vec![1; 8192]).unwrap();
        assert_eq!(fs::read_to_string(note).unwrap(), "a");
    }
}
