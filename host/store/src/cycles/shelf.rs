//! The chunks on disk: put, found by loop and position, and thrown away, the oldest of all loops first.
//!
//! Owns: the tables of `cycles.redb`, and that their bytes stay within the bound.
//! Never: knows what is in a chunk.
//!
//! | table | from | to |
//! |---|---|---|
//! | `heads` | loop, first position | [`Head`]: small, so that many can be looked through |
//! | `chunks` | number of the chunk, growing | the bytes: those of one second lie together, and go together |
//! | `ages` | number of the chunk | its loop and first position |
//! | `totals` | `bytes`, `next` | bytes of all chunks; number of the next one |

use std::path::Path;

use bumpless_core::LoopId;
use redb::{Durability, ReadTransaction, ReadableTable, TableDefinition, TableError, WriteTransaction};

use crate::{
    database::{Base, Change, Opener, Use},
    error::Error,
};

/// Version of the tables.
const FORMAT: u64 = 1;

/// Reads go through a second of all loops, then away; a crash must not cost minutes on a file of gigabytes.
const CYCLES: Use = Use {
    cache_bytes: 16 * 1024 * 1024,
    check_all: false,
    quick_repair: true,
};

/// Bytes that a chunk takes beside its own: its rows in three tables.
const ROWS_BYTES: u64 = 192;

/// Chunks that one commit throws away at most, so that none takes long; the next goes on.
const TRIMMED_MAX: usize = 4096;

/// Heads that are looked through at once: 80 MB, and eleven days of chunks of one second each.
const HEADS_MAX: usize = 1_000_000;

type Key<'a> = (&'a str, u64, u64);
type HeadRow = (u64, u64, u64, u64, u64, u64, u64);

const HEADS: TableDefinition<Key<'static>, HeadRow> = TableDefinition::new("heads");
const CHUNKS: TableDefinition<u64, &[u8]> = TableDefinition::new("chunks");
const AGES: TableDefinition<u64, Key<'static>> = TableDefinition::new("ages");
const TOTALS: TableDefinition<&str, u64> = TableDefinition::new("totals");

/// What is known of a chunk without reading it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Head {
    /// Number of the chunk; given when it is put.
    pub(super) number: u64,
    /// Position of its first record.
    pub(super) first: (u64, u64),
    /// Position of its last record.
    pub(super) last: (u64, u64),
    /// Time of its first record, in ns.
    pub(super) first_at_ns: u64,
    /// Time of its last record, in ns.
    pub(super) last_at_ns: u64,
    /// Records in it.
    pub(super) count: u64,
}

/// A chunk on its way to the disk.
#[derive(Debug)]
pub(super) struct Parcel {
    pub(super) loop_id: LoopId,
    pub(super) head: Head,
    pub(super) bytes: Vec<u8>,
}

/// The chunks of all loops.
#[derive(Debug)]
pub(super) struct Shelf {
    base: Base,
    bytes_max: u64,
    /// Chunks that are so much older than the newest go, in ns.
    keep_ns: u64,
}

fn head((term, seq): (u64, u64), row: HeadRow) -> Head {
    let (number, last_term, last_seq, first_at_ns, last_at_ns, count, _) = row;
    Head {
        number,
        first: (term, seq),
        last: (last_term, last_seq),
        first_at_ns,
        last_at_ns,
        count,
    }
}

/// None where nothing was ever written.
fn maybe<T>(table: Result<T, TableError>) -> Result<Option<T>, redb::Error> {
    match table {
        Ok(table) => Ok(Some(table)),
        Err(TableError::TableDoesNotExist(_)) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

impl Shelf {
    /// `bounds`: bytes of all chunks, and how long they are kept, in ns.
    pub(super) fn open(path: &Path, bounds: (u64, u64), opener: Opener) -> Result<Self, Error> {
        let (bytes_max, keep_ns) = bounds;
        Base::open(path, FORMAT, CYCLES, opener).map(|base| Self {
            base,
            bytes_max,
            keep_ns,
        })
    }

    pub(super) fn path(&self) -> &Path {
        self.base.path()
    }

    /// Bytes of all chunks with their rows.
    pub(super) fn bytes(&self) -> Result<u64, Error> {
        self.base.read("read the size of", |txn| {
            let totals = maybe(txn.open_table(TOTALS))?;
            Ok(totals
                .and_then(|table| table.get("bytes").transpose())
                .transpose()?
                .map_or(0, |row| row.value()))
        })
    }

    /// Puts chunks, and throws away the oldest beyond the bound. On disk when this returns. Gives back the bytes of all.
    pub(super) fn put(&self, parcels: &[Parcel]) -> Result<u64, Error> {
        self.base.write("write cycles to", Durability::Immediate, |txn| {
            let (mut heads, mut chunks) = (txn.open_table(HEADS)?, txn.open_table(CHUNKS)?);
            let (mut ages, mut totals) = (txn.open_table(AGES)?, txn.open_table(TOTALS)?);
            let total = |name| -> Result<u64, redb::Error> { Ok(totals.get(name)?.map_or(0, |row| row.value())) };
            let (mut bytes, mut next) = (total("bytes")?, total("next")?);
            for Parcel {
                loop_id,
                head,
                bytes: chunk,
            } in parcels
            {
                let key = (loop_id.as_str(), head.first.0, head.first.1);
                let size = chunk.len() as u64 + ROWS_BYTES;
                let row = (
                    next,
                    head.last.0,
                    head.last.1,
                    head.first_at_ns,
                    head.last_at_ns,
                    head.count,
                    size,
                );
                let replaced = heads.insert(key, row)?.map(|old| old.value());
                if let Some((number, .., old_size)) = replaced {
                    ages.remove(number)?;
                    chunks.remove(number)?;
                    bytes = bytes.saturating_sub(old_size);
                }
                chunks.insert(next, chunk.as_slice())?;
                ages.insert(next, key)?;
                bytes += size;
                next += 1;
            }
            let newest_ns = parcels.iter().map(|parcel| parcel.head.last_at_ns).max().unwrap_or(0);
            for _ in 0..TRIMMED_MAX {
                let last_at_ns = match ages.first()? {
                    Some((_, key)) => heads.get(key.value())?.map_or(0, |row| row.value().4),
                    None => break,
                };
                if bytes <= self.bytes_max && last_at_ns.saturating_add(self.keep_ns) >= newest_ns {
                    break;
                }
                let Some(oldest) = ages.pop_first()?.map(|(number, key)| {
                    let (loop_id, term, seq) = key.value();
                    (number.value(), loop_id.to_owned(), term, seq)
                }) else {
                    break;
                };
                let size = heads
                    .remove((oldest.1.as_str(), oldest.2, oldest.3))?
                    .map_or(0, |row| row.value().6);
                chunks.remove(oldest.0)?;
                bytes = bytes.saturating_sub(size);
            }
            totals.insert("bytes", bytes)?;
            totals.insert("next", next)?;
            Ok(Change::Keep(bytes))
        })
    }

    /// The heads of a loop's chunks, newest first, for as long as `more` wants them: it is given the oldest so far, and how
    /// many records there are from it on.
    pub(super) fn heads(&self, loop_id: &LoopId, more: impl Fn(&Head, u64) -> bool) -> Result<Vec<Head>, Error> {
        let id = loop_id.as_str();
        self.base.read("look for cycles in", |txn: &ReadTransaction| {
            let (mut found, mut counted) = (Vec::new(), 0_u64);
            let Some(table) = maybe(txn.open_table(HEADS))? else {
                return Ok(found);
            };
            for row in table.range((id, 0, 0)..=(id, u64::MAX, u64::MAX))?.rev() {
                let (key, row) = row?;
                let (_, term, seq) = key.value();
                let head = head((term, seq), row.value());
                counted = counted.saturating_add(head.count);
                found.push(head);
                if found.len() >= HEADS_MAX || !more(&head, counted) {
                    break;
                }
            }
            Ok(found)
        })
    }

    /// A chunk; none where it was thrown away meanwhile.
    pub(super) fn chunk(&self, number: u64) -> Result<Option<Vec<u8>>, Error> {
        self.base.read("read cycles from", |txn| {
            let Some(table) = maybe(txn.open_table(CHUNKS))? else {
                return Ok(None);
            };
            let row = table.get(number)?;
            Ok(row.map(|row| row.value().to_vec()))
        })
    }

    /// The loops that have chunks.
    pub(super) fn loops(&self) -> Result<Vec<String>, Error> {
        self.base.read("list the loops in", |txn| {
            let mut found: Vec<String> = Vec::new();
            let Some(table) = maybe(txn.open_table(HEADS))? else {
                return Ok(found);
            };
            loop {
                // From the last key of one loop to the first of the next.
                let after = found.last().cloned().unwrap_or_default();
                let next = table
                    .range((after.as_str(), u64::MAX, u64::MAX)..)?
                    .next()
                    .transpose()?;
                match next.map(|(key, _)| key.value().0.to_owned()) {
                    Some(id) if id != after => found.push(id),
                    _ => return Ok(found),
                }
            }
        })
    }

    /// Throws a loop's chunks away. On disk when this returns. Gives back the bytes of all that are left.
    pub(super) fn forget(&self, id: &str) -> Result<u64, Error> {
        loop {
            let (left, done) = self.base.write("forget cycles in", Durability::Immediate, |txn| {
                let (left, removed) = forget_some(txn, id)?;
                let end = (left, removed < TRIMMED_MAX);
                Ok(if removed == 0 {
                    Change::Drop(end)
                } else {
                    Change::Keep(end)
                })
            })?;
            if done {
                return Ok(left);
            }
        }
    }

    #[cfg(test)]
    pub(super) fn spoil(&self, loop_id: &LoopId, first: (u64, u64), spoil: impl Fn(&mut Vec<u8>)) {
        let heads = self.heads(loop_id, |_, _| true).unwrap();
        let number = heads.iter().find(|head| head.first == first).unwrap().number;
        let mut bytes = self.chunk(number).unwrap().unwrap();
        spoil(&mut bytes);
        self.base
            .write("spoil", Durability::Immediate, |txn| {
                txn.open_table(CHUNKS)?.insert(number, bytes.as_slice())?;
                Ok(Change::Keep(()))
            })
            .unwrap();
    }
}

fn forget_some(txn: &WriteTransaction, id: &str) -> Result<(u64, usize), redb::Error> {
    let (mut heads, mut chunks) = (txn.open_table(HEADS)?, txn.open_table(CHUNKS)?);
    let (mut ages, mut totals) = (txn.open_table(AGES)?, txn.open_table(TOTALS)?);
    let mut bytes = totals.get("bytes")?.map_or(0, |row| row.value());
    let mut going = Vec::new();
    for row in heads.range((id, 0, 0)..=(id, u64::MAX, u64::MAX))?.take(TRIMMED_MAX) {
        let (key, row) = row?;
        let ((_, term, seq), (number, .., size)) = (key.value(), row.value());
        going.push((term, seq, number, size));
    }
    for &(term, seq, number, size) in &going {
        heads.remove((id, term, seq))?;
        chunks.remove(number)?;
        ages.remove(number)?;
        bytes = bytes.saturating_sub(size);
    }
    totals.insert("bytes", bytes)?;
    Ok((bytes, going.len()))
}
