//! What a disk gave back, read as this room reads it, without a store: for fuzzers.
//!
//! Owns: nothing; each function hands bytes to the reader that the store itself uses, and does with what comes out what the store
//! does with it. Never: writes a file. None of it panics, whatever the bytes are; that is what it is here to show.

use std::sync::Arc;

use bumpless_core::{
    ComponentInfo, Intent, Record,
    history::{Bucket, Layout, Row, STEPS_NS, Series},
};
use serde::{Serialize, de::DeserializeOwned};

use crate::{
    archive::parsing::{self, Head},
    cycles::parsing as chunk,
    format, terms,
};

/// A row of the database, as each of the types that are kept as rows. Gives how many of them it could be.
///
/// # Errors
/// A row that was read, but is another one once it is written again: the type's name.
pub fn row(bytes: &[u8]) -> Result<usize, &'static str> {
    fn as_one<T: Serialize + DeserializeOwned>(name: &'static str, bytes: &[u8]) -> Result<usize, &'static str> {
        let Ok(value) = format::decode::<T>(bytes) else {
            return Ok(0);
        };
        let once = format::encode(|| name.to_owned(), &value).map_err(|_| name)?;
        let again = format::decode::<T>(&once).map_err(|_| name)?;
        let twice = format::encode(|| name.to_owned(), &again).map_err(|_| name)?;
        if once == twice { Ok(1) } else { Err(name) }
    }
    Ok(as_one::<Record>("record", bytes)?
        + as_one::<Intent>("intent", bytes)?
        + as_one::<ComponentInfo>("summary", bytes)?
        + as_one::<u64>("number", bytes)?)
}

/// A chunk of recorded cycles. Gives how many records are in it; none where it is no chunk. With `sealed` the bytes are a chunk's
/// body, and its head is made for them: a check keeps others from getting so far.
#[must_use]
pub fn cycles(bytes: &[u8], sealed: bool) -> Option<usize> {
    let records = if sealed {
        let (length, body) = bytes.split_first_chunk::<4>()?;
        chunk::decode(&chunk::sealed(u32::from_le_bytes(*length), body))
    } else {
        chunk::decode(bytes)
    };
    records.ok().map(|records| records.len())
}

/// A file of the history: its frames, and what is in them. Gives how many whole frames it has.
#[must_use]
pub fn history_file(bytes: &[u8]) -> usize {
    let frames = parsing::frames(bytes);
    for (head, body) in &frames {
        let _rows = history_block(head, body);
        let _entry = history_entry(body);
    }
    frames.len()
}

/// A block of the history: its head and its body. Gives how many pieces are in it.
#[must_use]
pub fn history_block(head: &[u8], body: &[u8]) -> Option<usize> {
    let head = postcard::from_bytes::<Head>(head).ok()?;
    let rows = parsing::rows(head.step_ns, head.rows, &Arc::new(head.layout), body).ok()?;
    looked_at(&rows);
    Some(rows.len())
}

/// As [`history_block`], from one piece: the head, and behind it the body.
#[must_use]
pub fn history_block_of(bytes: &[u8]) -> Option<usize> {
    let (_, body) = postcard::take_from_bytes::<Head>(bytes).ok()?;
    let head = bytes.get(..bytes.len() - body.len())?;
    history_block(head, body)
}

/// An entry of the history's journal. Gives how many pieces are in it.
#[must_use]
pub fn history_entry(bytes: &[u8]) -> Option<usize> {
    let pieces = postcard::from_bytes::<Vec<(Series, Layout, Bucket)>>(bytes).ok()?;
    let rows = pieces.into_iter().map(|(_, layout, bucket)| Row {
        step_ns: STEPS_NS[0],
        layout: Arc::new(layout),
        bucket,
    });
    let rows: Vec<Row> = rows.collect();
    looked_at(&rows);
    Some(rows.len())
}

/// The file of the terms that were set aside.
#[must_use]
pub fn terms(bytes: &[u8]) -> u64 {
    terms::greatest(bytes)
}

/// What is done with every piece that was read.
fn looked_at(rows: &[Row]) {
    for row in rows {
        let _times = (row.start_ns(), row.end_ns());
        let bucket = &row.bucket;
        for spread in bucket.outputs.iter().chain([&bucket.setpoint, &bucket.measurement]) {
            let _figures = (spread.least(), spread.greatest(), spread.mean());
        }
    }
}
