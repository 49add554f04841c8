//! Whether a run may go on: open, shut for a pause, or ended for good.
//!
//! ```text
//!   open ◄── pause, resume ──► shut          open, shut ── stop ──► ended
//! ```
//! Owns: that word, and those who wait for it. Never: waits itself on a thread.

use std::sync::atomic::{AtomicU8, Ordering};

use tokio::sync::Notify;

const OPEN: u8 = 0;
const SHUT: u8 = 1;
const ENDED: u8 = 2;

/// The gate of one run.
#[derive(Debug, Default)]
pub(crate) struct Gate {
    word: AtomicU8,
    changed: Notify,
}

impl Gate {
    /// Shuts or opens it; nothing where it has ended.
    pub(crate) fn pause(&self, shut: bool) {
        let (from, to) = if shut { (OPEN, SHUT) } else { (SHUT, OPEN) };
        // Where it stands otherwise there is nothing to do.
        let _ = self.word.compare_exchange(from, to, Ordering::SeqCst, Ordering::SeqCst);
        self.changed.notify_waiters();
    }

    /// Ends it.
    pub(crate) fn end(&self) {
        self.word.store(ENDED, Ordering::SeqCst);
        self.changed.notify_waiters();
    }

    pub(crate) fn is_shut(&self) -> bool {
        self.word.load(Ordering::SeqCst) == SHUT
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.word.load(Ordering::SeqCst) == ENDED
    }

    /// Waits for as long as it is shut. One that has ended lets through: the run is being dropped.
    pub(crate) async fn pass(&self) {
        while self.is_shut() {
            let changed = self.changed.notified();
            if self.is_shut() {
                changed.await;
            }
        }
    }

    /// Waits for the end.
    pub(crate) async fn ended(&self) {
        while !self.has_ended() {
            let changed = self.changed.notified();
            if !self.has_ended() {
                changed.await;
            }
        }
    }
}
