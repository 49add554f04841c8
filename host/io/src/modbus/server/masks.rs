//! Function 22, in one piece: whoever changes some bits of a register goes on from what the one before left there.
//!
//! ```text
//! writes of whole registers ── beside each other ──┐
//! a mask ── alone ─────────────────────────────────┴─► read, change the bits, write, remember
//! ```
//!
//! Why it remembers: a written value shows in a register when its device has confirmed it, which may be a poll later. A
//! second mask in this while would start from the old value and undo the first.
//!
//! Owns: the order, and the last masked value of each register for some seconds. Never: holds up a read.

use std::{collections::HashMap, time::Duration};

use parking_lot::Mutex;
use tokio::{
    sync::{RwLock, RwLockReadGuard, RwLockWriteGuard},
    time::Instant,
};

/// A masked value that does not show after so long never will: the device refused it, or somebody wrote over it.
const SHOWS_WITHIN: Duration = Duration::from_secs(5);
/// Registers that are remembered before those whose time is over are swept out.
const REMEMBERED: usize = 256;

/// What a mask left.
#[derive(Debug, Clone, Copy)]
struct Left {
    /// What the register showed before.
    shown: u16,
    word: u16,
    at: Instant,
}

/// The order of masks and other writes of one server.
#[derive(Debug, Default)]
pub struct Masks {
    order: RwLock<()>,
    left: Mutex<HashMap<u16, Left>>,
}

/// Nobody else writes registers while it lives.
pub(super) struct Alone<'a> {
    masks: &'a Masks,
    _order: RwLockWriteGuard<'a, ()>,
}

impl Masks {
    /// The place of a write of whole registers, beside others. What a mask left there counts no more.
    pub(super) async fn beside(&self, start: u16, count: usize) -> RwLockReadGuard<'_, ()> {
        let order = self.order.read().await;
        let mut left = self.left.lock();
        if !left.is_empty() {
            let start = usize::from(start);
            left.retain(|address, _| !(start..start + count).contains(&usize::from(*address)));
        }
        order
    }

    /// The place of a mask.
    pub(super) async fn alone(&self) -> Alone<'_> {
        Alone {
            _order: self.order.write().await,
            masks: self,
        }
    }
}

impl Alone<'_> {
    /// What the register holds, as far as anyone knows: what it shows, or what the mask before left and does not show yet.
    pub(super) fn base(&self, address: u16, shown: u16, now: Instant) -> u16 {
        let left = self.masks.left.lock().get(&address).copied();
        match left {
            Some(left) if left.shown == shown && now.saturating_duration_since(left.at) < SHOWS_WITHIN => left.word,
            _ => shown,
        }
    }

    /// The write was taken.
    pub(super) fn remember(&mut self, address: u16, shown: u16, word: u16, at: Instant) {
        let mut left = self.masks.left.lock();
        if left.len() >= REMEMBERED {
            left.retain(|_, left| at.saturating_duration_since(left.at) < SHOWS_WITHIN);
        }
        left.insert(address, Left { shown, word, at });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_mask_goes_on_from_the_one_before_until_that_shows_or_is_old() {
        let masks = Masks::default();
        let now = Instant::now();
        let mut alone = masks.alone().await;
        assert_eq!(alone.base(7, 0b0001, now), 0b0001);
        alone.remember(7, 0b0001, 0b0011, now);
        assert_eq!(alone.base(7, 0b0001, now), 0b0011, "it does not show yet");
        assert_eq!(alone.base(7, 0b1000, now), 0b1000, "another value shows");
        assert_eq!(alone.base(8, 0b0001, now), 0b0001, "another register");
        assert_eq!(alone.base(7, 0b0001, now + SHOWS_WITHIN), 0b0001, "too old");
        drop(alone);
        drop(masks.beside(6, 1).await);
        assert_eq!(masks.alone().await.base(7, 0b0001, now), 0b0011);
        drop(masks.beside(6, 2).await);
        assert_eq!(
            masks.alone().await.base(7, 0b0001, now),
            0b0001,
            "written whole meanwhile"
        );
    }
}
