//! Loops on devices that two hosts can serve: their home is where the device's master is.
//!
//! ```text
//! lease taken here ──► loops whose points this host serves: intent with this home ──► home opened, terms from the epoch on
//! lease lost here  ──► homes of these loops closed; whoever has the lease next takes them
//! ```
//!
//! Owns: that the home of such a loop is open only where the lease is, and under terms that no earlier master gave.
//! Never: decides who is master (the lease in the device does), and never stops a write: the bus refuses those itself, by the
//! lease's time, however late this module hears of its end.

use std::sync::Arc;

use bumpless_core::{Intent, LoopSpec, PointId};

use crate::{error::Error, limits::TERMS_PER_EPOCH, room::Room};

/// Revision numbers passed over when a loop changes its home: what the home before gave out and could not tell any more.
const REVISIONS_SKIPPED: u64 = 100;

/// What this host is to a loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mastery {
    /// No point of the loop is on a device with two masters.
    Alone,
    /// This host is master of all such devices of the loop; the greatest epoch of them.
    Master(u32),
    /// Another host is, or nobody; or not all points are served here.
    Away,
}

impl Room {
    /// What this host is to a loop now.
    pub(crate) fn mastery(&self, spec: &LoopSpec) -> Mastery {
        self.mastery_over(spec.ports.values())
    }

    /// What this host is to these points now.
    pub(crate) fn mastery_over<'a>(&self, points: impl Iterator<Item = &'a PointId>) -> Mastery {
        let Some(io) = &self.io else { return Mastery::Alone };
        if io.masterships().is_empty() {
            return Mastery::Alone;
        }
        let (mut epoch, mut missing) = (None, false);
        for point in points {
            match io.index(point) {
                None => missing = true,
                Some(index) => match io.redundant(index).map(|(_, view)| view.epoch) {
                    None => {}
                    Some(None) => return Mastery::Away,
                    Some(Some(held)) => epoch = epoch.max(Some(held)),
                },
            }
        }
        match epoch {
            Some(_) if missing => Mastery::Away,
            Some(epoch) => Mastery::Master(epoch),
            None => Mastery::Alone,
        }
    }

    /// The least term that the loop's home here may give, less one.
    pub(crate) fn term_floor(&self, spec: &LoopSpec) -> u64 {
        match self.mastery(spec) {
            Mastery::Master(epoch) => u64::from(epoch).saturating_mul(TERMS_PER_EPOCH),
            // A loop that an earlier life of this host had must not begin with the same terms again: somebody may still hold a
            // record of them. Where there is a newer record, the desk goes on from it.
            Mastery::Alone | Mastery::Away if self.book.was_there(&spec.id) => self.terms.floor(),
            Mastery::Alone | Mastery::Away => 0,
        }
    }

    /// Looks after the loops as soon as a mastership comes or goes.
    pub(crate) fn watch_masters(self: &Arc<Self>) {
        for (bus, mut epoch) in self.io.iter().flat_map(|io| io.masterships()) {
            let room = Arc::clone(self);
            self.spawn(async move {
                while epoch.changed().await.is_ok() {
                    tracing::info!(%bus, epoch = ?*epoch.borrow(), "the mastership changed");
                    if let Some(io) = &room.io {
                        // What people force, this host knows too: before a loop writes here.
                        io.hold_forced(io.clock().now_ns());
                    }
                    room.poke();
                }
            });
        }
    }

    /// Closes homes that are no longer here, and takes over loops whose devices are served from here now. Idempotent.
    pub(crate) async fn follow_masters(self: &Arc<Self>) {
        if self.io.as_ref().is_none_or(|io| io.masterships().is_empty()) {
            return;
        }
        for intent in self.book.all() {
            let id = &intent.loop_id;
            let mastery = self.mastery(&intent.current);
            if mastery == Mastery::Alone {
                continue;
            }
            let epoch = match mastery {
                Mastery::Master(epoch) => Some(epoch),
                _ => None,
            };
            let stays = intent.home == self.here && epoch.is_some() && self.homes.epoch(id) == epoch;
            if self.homes.is_open(id) && !stays {
                // One that has another epoch now is opened again, under terms of that epoch.
                tracing::info!(loop_id = %id, home = %intent.home, "the loop's home here is closed");
                self.homes.closed(id);
                if let Err(error) = self.field.close_home(id) {
                    tracing::warn!(loop_id = %id, %error, "a home could not be closed; its bus refuses its writes");
                }
            }
            if epoch.is_some()
                && intent.home != self.here
                && let Err(error) = self.adopt(&intent).await
            {
                tracing::warn!(loop_id = %id, %error, "a loop could not be taken over; it is tried again");
            }
        }
    }

    /// Makes this host the loop's home.
    async fn adopt(&self, intent: &Intent) -> Result<(), Error> {
        let mut adopted = intent.clone();
        adopted.adopt(self.here.clone(), REVISIONS_SKIPPED);
        let from = intent.home.clone();
        self.publish(adopted).await?;
        tracing::warn!(loop_id = %intent.loop_id, %from, "this host is the loop's home now");
        // What is held here and elsewhere is told to the new home.
        self.poke();
        Ok(())
    }

    /// Is this host the one to ask about a point?
    pub(crate) fn speaks_for(&self, point: &PointId) -> bool {
        self.io
            .as_ref()
            .is_some_and(|io| io.index(point).is_some_and(|index| io.speaks_for(index)))
    }
}
