//! A host that is emptied: its loops go to others between two cycles, and new ones stay away.
//!
//! ```text
//! in service ──drain──► draining: vitals say so ──► homes move its loops ──► owns none ──► stopped, or back in service
//!     ▲                    │  kept: so again after a restart                                          │
//!     └──── undrain ───────┴──────────────────────────────────────────────────────────────────────────┘
//! ```
//! Never: stops the host, and never takes a loop from it that nobody else can run.

use std::{
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use crate::{
    book::on_disk,
    error::Error,
    limits::DRAIN_ORDER_WAIT,
    room::Room,
    view::{DrainEnd, DrainOrder},
};

/// The setting that holds over a restart.
pub(crate) const KEPT: &str = "drain-kept";

/// Pause between two looks how far it is.
const LOOK_EVERY: Duration = Duration::from_millis(20);

impl Room {
    /// Follows an order at this host, and says how far it came.
    pub(crate) async fn drain_here(self: &Arc<Self>, order: DrainOrder) -> Result<DrainEnd, Error> {
        let kept = order.drain && order.keep;
        if kept != self.drain_kept.load(Ordering::Acquire) {
            // On disk first: an order that was said to hold must.
            let store = self.store.clone();
            on_disk(move || store.set_host_value(KEPT, &kept)).await??;
            self.drain_kept.store(kept, Ordering::Release);
        }
        self.set_draining(order.drain);
        if order.drain {
            self.wait_empty(DRAIN_ORDER_WAIT).await;
        } else {
            self.wait(DRAIN_ORDER_WAIT, || self.holds_all()).await;
        }
        Ok(DrainEnd {
            host: self.here.clone(),
            draining: self.is_draining(),
            kept: self.drain_kept.load(Ordering::Acquire),
            loops_owned: self.field.owned(),
            loops_held: u32::try_from(self.holder.len()).unwrap_or(u32::MAX),
            ready: self.holds_all(),
        })
    }

    /// Is there a host that could take this one's loops?
    pub(crate) fn others_can_take(&self) -> bool {
        let eligible = self.roster.eligible();
        eligible.iter().any(|candidate| candidate.host != self.here)
    }

    /// Waits until this host owns no loop, where others can take them.
    pub(crate) async fn wait_empty(&self, longest: Duration) {
        self.wait(longest, || self.field.owned() == 0 || !self.others_can_take())
            .await;
    }

    async fn wait(&self, longest: Duration, is: impl Fn() -> bool) {
        let until = tokio::time::Instant::now() + longest;
        while !is() && !self.stopped() && tokio::time::Instant::now() < until {
            tokio::time::sleep(LOOK_EVERY).await;
        }
    }
}
