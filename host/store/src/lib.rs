//! The host's disk: components by digest, what shall run, the last records, secrets and small settings.
//!
//! Owns: the layout of the store's directory, the format of its rows, and how durable each of them is. Never: decides what
//! runs, never touches the network, and never stands on the cycle's path: a record is offered to [`RecordWriter`] and
//! written behind.
//!
//! ```text
//! <dir>/                     0700
//!   lock                     held while a process has the store open; names that process
//!   host.redb                infos, intents, tombstones, last records, rollouts, trust, alarms, forces, settings
//!   cycles.redb              every record of the loops at home here, up to a bound
//!   audit/<number>.jsonl     who changed what, a chain of lines, up to a bound
//!   history/                 thinned history of loops and points, up to a bound
//!   components/<digest>.wasm the bytes, named by what they are
//!   secrets/<name>           0600, 32 random bytes
//!   terms                    the greatest term of ownership that was set aside
//! ```
//!
//! | what | durable when the call returns? | why |
//! |---|---|---|
//! | component, info, intent, tombstone, rollout, alarm, force, setting, secret, audit entry | yes, fsync | people were told that it is done |
//! | recorded cycle | no: within a second | it is for looking back; nothing that runs depends on it |
//! | history | no: half a second survives no kill, ten no loss of power | as recorded cycles |
//! | last record | no: within a second | the standbys hold newer ones; a sync per cycle would wear out the disk |
//!
//! All calls block on the disk. Async callers use a blocking thread. A wait for another writer is as long as that one's
//! fsync: the operating system's bound, not ours.

mod access;
mod alarms;
mod archive;
mod audit;
mod components;
mod cycles;
mod database;
mod error;
mod forces;
mod format;
mod intents;
mod medium;
pub mod parsers;
mod programs;
mod records;
mod rollouts;
mod settings;
mod store;
mod terms;
mod trust;
mod writer;

pub use alarms::ALARM_CHANGES_MAX;
pub use archive::{
    Archive, ArchiveCounts, BYTES_MAX as HISTORY_BYTES_MAX, Bounds, Judge, Lens, ROWS_MAX as HISTORY_ROWS_MAX, Reading,
    RowBlock, pack_rows, unpack_rows,
};
pub use audit::{AUDIT_BYTES_MAX, AuditBegun, AuditFound, AuditHead, AuditLog, Overdue};
pub use cycles::{BYTES_MAX as CYCLE_BYTES_MAX, Cursor, CycleCounts, CycleLog, Window};
pub use error::Error;
pub use intents::Tombstone;
pub use medium::{Interference, Touch, interfere};
pub use store::{FORMAT, Store};
pub use writer::{OnDisk, RecordWriter, WriterCounts};

#[cfg(test)]
mod tests;
