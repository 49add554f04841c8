//! Everything that a store can fail with, in words that name the place and the cure.

use std::{
    io,
    path::{Path, PathBuf},
};

use bumpless_core::{Digest, LoopId};

/// Why the store did not do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system refused.
    #[error("cannot {doing} {}: {cure}", path.display())]
    Io {
        /// What was tried, as a verb.
        doing: &'static str,
        /// Where.
        path: PathBuf,
        /// What helps.
        cure: &'static str,
        /// The system's words.
        #[source]
        source: io::Error,
    },
    /// Another process has it open.
    #[error("the store {} is in use{}: stop that process, or give this host another directory", path.display(), holder(*pid))]
    Locked {
        /// The store's directory.
        path: PathBuf,
        /// The process that holds it, where it said so.
        pid: Option<u32>,
    },
    /// Written by a newer version of this program.
    #[error(
        "the store {} has format {found}, this program knows formats up to {known}: use the newer program, or another directory",
        path.display()
    )]
    Newer {
        /// The store's directory.
        path: PathBuf,
        /// Its format.
        found: u64,
        /// The newest format that is known here.
        known: u64,
    },
    /// A file among those of the history that is none of them.
    #[error("{} is no file of the history: move it away", path.display())]
    NoHistory {
        /// The file.
        path: PathBuf,
    },
    /// A directory with other things in it.
    #[error("{} holds other files and no store: give an empty or a new directory", path.display())]
    NotAStore {
        /// The directory.
        path: PathBuf,
    },
    /// The database's file is damaged.
    #[error(
        "the database {} is damaged: move it away and start again; the cell's other hosts send the intents and components",
        path.display()
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The database's words.
        #[source]
        source: Box<redb::Error>,
    },
    /// The database refused for another reason.
    #[error("cannot {doing} {}: try again, then restart the host", path.display())]
    Database {
        /// What was tried, as a verb.
        doing: &'static str,
        /// The file.
        path: PathBuf,
        /// The database's words.
        #[source]
        source: Box<redb::Error>,
    },
    /// A value that has no row form.
    #[error("{what} cannot be written as a row: report this, it is a fault of the program")]
    Row {
        /// Which value.
        what: String,
        /// The encoder's words.
        #[source]
        source: postcard::Error,
    },
    /// A value whose row form cannot be read back.
    #[error("{what} cannot be read back from its row, so it was not kept: report this, it is a fault of the program")]
    Unreadable {
        /// Which value.
        what: String,
    },
    /// A value over the limit.
    #[error("{what} has {bytes} bytes; 1 to {max} are possible")]
    Size {
        /// Which value.
        what: String,
        /// Its size.
        bytes: usize,
        /// The limit.
        max: usize,
    },
    /// A summary without its component.
    #[error("component {digest} is not in the store: put its bytes first")]
    NoComponent {
        /// The component.
        digest: Digest,
    },
    /// A copy of an intent that is older than the one held.
    #[error(
        "the intent of loop {loop_id:?} is older than the one held ({offered:?} before {held:?}): read it again, then change it"
    )]
    Stale {
        /// The loop.
        loop_id: LoopId,
        /// Position of the copy offered.
        offered: (u64, u64),
        /// Position of the copy held.
        held: (u64, u64),
    },
    /// An intent of a loop that was removed.
    #[error("loop {loop_id:?} was removed at revision {last_revision}: create it anew, from revision {} on", last_revision.saturating_add(1))]
    Removed {
        /// The loop.
        loop_id: LoopId,
        /// The last revision that was given before the removal.
        last_revision: u64,
    },
    /// A name of a setting or secret that cannot be a file name.
    #[error("{0:?} is no name for a setting or secret: use 1 to 64 lower-case letters, digits and dashes")]
    Name(String),
    /// A secret that is not one of ours.
    #[error("the secret {} has {bytes} bytes instead of 32: restore it from a copy, or delete it to get a new one", path.display())]
    Secret {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: usize,
    },
    /// A setting that is there but has another shape.
    #[error("the setting {name:?} cannot be read: set it again")]
    Setting {
        /// Its name.
        name: String,
    },
    /// Accounts that cannot be read.
    #[error(
        "the accounts on this disk cannot be read: give the host an empty data folder, and it takes them from the others"
    )]
    Access,
    /// A text that makes no entry of the audit trail.
    #[error("an entry of the audit trail cannot be made: report this, it is a fault of the program")]
    Audit(#[source] bumpless_core::audit::Misfit),
    /// The writer's thread did not answer in time.
    #[error("the record writer did not finish within {seconds} s: the disk of {} is too slow or stuck", path.display())]
    Slow {
        /// The wait.
        seconds: u64,
        /// The store's directory.
        path: PathBuf,
    },
}

fn holder(pid: Option<u32>) -> String {
    pid.map(|pid| format!(" by process {pid}")).unwrap_or_default()
}

impl Error {
    pub(crate) fn io(doing: &'static str, path: &Path, source: io::Error) -> Self {
        let cure = match source.kind() {
            io::ErrorKind::StorageFull => "the disk is full, so free some space",
            io::ErrorKind::QuotaExceeded => "the disk quota is used up, so raise it or free some space",
            io::ErrorKind::FileTooLarge => "the file size limit is reached, so raise it",
            io::ErrorKind::ReadOnlyFilesystem => "the file system is read-only, so mount it writable",
            io::ErrorKind::PermissionDenied => "this user may not, so give it the directory",
            io::ErrorKind::NotFound => "it is gone, so restore it or restart the host",
            io::ErrorKind::NotADirectory => "a part of the path is no directory, so give another one",
            io::ErrorKind::AlreadyExists => "it is there already, so move it away",
            _ => "check the disk and its permissions",
        };
        Self::Io {
            doing,
            path: path.to_owned(),
            cure,
            source,
        }
    }

    pub(crate) fn database(doing: &'static str, path: &Path, source: redb::Error) -> Self {
        match source {
            redb::Error::Io(source) => Self::io(doing, path, source),
            redb::Error::DatabaseAlreadyOpen => Self::Locked {
                path: path.to_owned(),
                pid: None,
            },
            source @ (redb::Error::Corrupted(_) | redb::Error::UpgradeRequired(_) | redb::Error::RepairAborted) => {
                Self::Damaged {
                    path: path.to_owned(),
                    source: Box::new(source),
                }
            }
            source => Self::Database {
                doing,
                path: path.to_owned(),
                source: Box::new(source),
            },
        }
    }
}
