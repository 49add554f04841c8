//! What is known of each series without looking at the disk: where its blocks lie, and the pieces that are not packed yet.
//!
//! ```text
//! cycle ──► the open piece of each step ──next one begins──► waiting ──packed──► a place on the disk
//! ```
//! Owns: that each cycle is in one piece of each step. Never: reads or writes a file.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{
    Mode,
    history::{Bucket, Layout, Row, STEPS_NS, Seen, Series},
};

use super::disk::Place;

/// Pieces of a coarse step that wait at least, until they are packed: fewer would not pack well.
pub(super) const PACKED_MIN: usize = 240;

/// One step of one series.
#[derive(Debug, Default)]
pub(super) struct Held {
    /// Packed, oldest first.
    pub(super) places: Vec<Place>,
    /// Not packed yet; the last one is open.
    pub(super) waiting: Vec<Row>,
}

impl Held {
    /// Takes a cycle.
    fn take(&mut self, step_ns: u64, layout: &Arc<Layout>, seen: &Seen<'_>) {
        take(&mut self.waiting, step_ns, layout, seen);
    }

    /// Up to here it is packed, in ns since 1970.
    pub(super) fn packed_to_ns(&self) -> u64 {
        self.places.iter().map(|place| place.end_ns).max().unwrap_or(0)
    }
}

/// Takes a cycle into the last of some pieces, or begins the next one.
pub(super) fn take(rows: &mut Vec<Row>, step_ns: u64, layout: &Arc<Layout>, seen: &Seen<'_>) {
    let start_ns = seen.at_ns / step_ns * step_ns;
    let goes_on =
        |row: &&mut Row| row.start_ns() == start_ns && (Arc::ptr_eq(&row.layout, layout) || row.layout == *layout);
    match rows.last_mut().filter(goes_on) {
        Some(row) => row.bucket.take(seen),
        None => {
            let mut bucket = Bucket::at(start_ns);
            bucket.take(seen);
            rows.push(Row {
                step_ns,
                layout: Arc::clone(layout),
                bucket,
            });
        }
    }
}

/// One series.
#[derive(Debug, Default)]
pub(super) struct Kept {
    pub(super) levels: [Held; STEPS_NS.len()],
    /// Position and mode of the record that was taken last.
    pub(super) last: Option<((u64, u64), Mode)>,
}

/// All series.
#[derive(Debug, Default)]
pub(super) struct Memory {
    pub(super) series: BTreeMap<Series, Kept>,
    /// Pieces of the finest step that wait, of all series.
    pub(super) fresh: usize,
    /// End of the newest piece, in ns since 1970.
    pub(super) newest_ns: u64,
}

impl Memory {
    /// Takes a cycle into the open piece of each step.
    pub(super) fn take(&mut self, series: &Series, layout: &Arc<Layout>, seen: &Seen<'_>) -> &mut Kept {
        if !self.series.contains_key(series) {
            self.series.insert(series.clone(), Kept::default());
        }
        let kept = self.series.entry(series.clone()).or_default();
        let before = kept.levels.first().map_or(0, |finest| finest.waiting.len());
        for (held, step_ns) in kept.levels.iter_mut().zip(STEPS_NS) {
            held.take(step_ns, layout, seen);
        }
        let after = kept.levels.first().map_or(0, |finest| finest.waiting.len());
        self.fresh += after.saturating_sub(before);
        self.newest_ns = self.newest_ns.max(seen.at_ns);
        kept
    }

    /// Takes a piece of the finest step, from a journal: entries hold parts of pieces.
    pub(super) fn take_entry(&mut self, series: Series, row: Row) {
        self.newest_ns = self.newest_ns.max(row.end_ns());
        let kept = self.series.entry(series).or_default();
        let Some(finest) = kept.levels.first_mut() else { return };
        match finest.waiting.last_mut() {
            Some(last) if last.start_ns() == row.start_ns() && last.layout == row.layout => last.merge(&row),
            _ => {
                finest.waiting.push(row);
                self.fresh += 1;
            }
        }
    }

    /// A file went: its blocks are forgotten. Series of which nothing is left too.
    pub(super) fn forget(&mut self, segment: u64, level: usize) {
        self.series.retain(|_, kept| {
            if let Some(held) = kept.levels.get_mut(level) {
                held.places.retain(|place| place.segment != segment);
            }
            let empty = |held: &Held| held.places.is_empty() && held.waiting.is_empty();
            !kept.levels.iter().all(empty)
        });
    }

    /// Where nothing can be written: the older half of what waits for the finest step goes, of each series, and what is beyond
    /// reason of the others. Gives back how many pieces.
    pub(super) fn shed(&mut self) -> u64 {
        let mut shed = 0;
        for kept in self.series.values_mut() {
            for (level, held) in kept.levels.iter_mut().enumerate() {
                let count = held.waiting.len();
                let going = if level == 0 {
                    count / 2
                } else {
                    count.saturating_sub(PACKED_MIN * 4)
                };
                held.waiting.drain(..going);
                shed += going as u64;
                if level == 0 {
                    self.fresh -= going.min(self.fresh);
                }
            }
        }
        shed
    }
}
