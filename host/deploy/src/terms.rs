//! Terms of ownership over the lives of this host: no two lives give out the same.
//!
//! ```text
//! start: what the life before set aside, and the records on disk ──► this life begins after them, and sets that aside
//! home opens after a record with a greater term (a member had it) ──► that is set aside first
//! ```
//! Never: gives out terms (the arbiter does), and never keeps a loop from running: a disk that refuses is warned of.

use bumpless_core::{Record, desk::terms_passed_over};
use bumpless_store::Store;

use crate::{book::on_disk, error::chain, limits::TERMS_PER_EPOCH, room::Room};

/// What is set aside.
pub(crate) struct Terms {
    /// This life's homes begin after it.
    floor: u64,
    kept: tokio::sync::Mutex<u64>,
}

/// A term that no lease of a device gave: those have ranges of their own.
fn own(record: &Record) -> Option<u64> {
    Some(record.term).filter(|term| *term < TERMS_PER_EPOCH)
}

impl Terms {
    /// Begins a life, after those records. Blocks for the disk.
    pub(crate) fn begin(store: &Store, records: &[Record]) -> Self {
        let kept = store.terms_set_aside().unwrap_or_else(|error| {
            tracing::warn!(error = chain(&error), "which terms were set aside is not known");
            0
        });
        let found = records.iter().filter_map(own).max().unwrap_or(0);
        let floor = terms_passed_over(kept, found);
        let kept = match store.set_aside_terms(floor) {
            Ok(()) => floor,
            Err(error) => {
                not_set_aside(&chain(&error));
                kept
            }
        };
        Self {
            floor,
            kept: tokio::sync::Mutex::new(kept),
        }
    }

    /// A loop of an earlier life begins after this one.
    pub(crate) fn floor(&self) -> u64 {
        self.floor
    }
}

fn not_set_aside(error: &str) {
    tracing::warn!(
        error,
        "terms could not be set aside: if this host dies before its disk takes a record, and again, a position may come twice"
    );
}

impl Room {
    /// Before a home opens after this record: what it will give out is set aside.
    pub(crate) async fn set_aside_terms(&self, last: Option<&Record>) {
        let mut kept = self.terms.kept.lock().await;
        let wanted = last
            .and_then(own)
            .map_or(0, |term| terms_passed_over(0, term))
            .max(self.terms.floor);
        if wanted <= *kept {
            return;
        }
        let store = self.store.clone();
        let written = on_disk(move || store.set_aside_terms(wanted)).await;
        match written.and_then(|written| written.map_err(Into::into)) {
            Ok(()) => *kept = wanted,
            Err(error) => not_set_aside(&chain(&error)),
        }
    }
}
