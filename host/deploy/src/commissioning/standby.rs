//! Hosts that stand by for a device: whoever counts on one must hear that it could not take over.
//!
//! ```text
//! ready ──its own connection fails, or the lease's registers cannot be reached for a lease's time──► not ready ──► ready
//! ```
//!
//! Owns: that each change is told once, to everyone. Never: tests a connection itself; the lease's own looks, four a lease,
//! and the polls do.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::BusId;
use bumpless_io::MasterView;
use parking_lot::Mutex;

use super::FieldEvent;
use crate::room::Room;

/// What was told last of each bus that has two masters.
#[derive(Debug, Default)]
pub(crate) struct Standbys(Mutex<BTreeMap<BusId, bool>>);

impl Standbys {
    /// Is this to be told? A host that has just started may take a while to reach its device: the first word is that it does,
    /// and is not worth one, or that it has given up, which shows in an error of the bus.
    fn is_news(&self, bus: &BusId, errors: u64, view: &MasterView) -> bool {
        let mut told = self.0.lock();
        if view.epoch.is_some() {
            // The master's own troubles show in its points.
            told.insert(bus.clone(), true);
            return false;
        }
        match told.get(bus) {
            Some(before) if *before == view.ready => false,
            None if view.ready || errors == 0 => {
                if view.ready {
                    told.insert(bus.clone(), true);
                }
                false
            }
            _ => {
                told.insert(bus.clone(), view.ready);
                true
            }
        }
    }
}

impl Room {
    /// Tells of standbys that can take over no more, or can again.
    pub(super) fn look_after_standbys(self: &Arc<Self>) {
        let Some(io) = &self.io else { return };
        for status in io.status() {
            let Some(view) = io.master(&status.bus) else { continue };
            if !self.commissioning.standbys.is_news(&status.bus, status.errors, &view) {
                continue;
            }
            let reason = if view.ready {
                String::new()
            } else {
                status
                    .last_error
                    .unwrap_or_else(|| "the registers of the lease cannot be reached".to_owned())
            };
            if view.ready {
                tracing::warn!(bus = %status.bus, with = %view.with, "this host can take the device over again");
            } else {
                tracing::error!(bus = %status.bus, with = %view.with, reason, "this host stands by and could not take the device over");
            }
            self.tell_field(FieldEvent::Standby {
                bus: status.bus.to_string(),
                host: self.here.clone(),
                with: view.with,
                ready: view.ready,
                reason,
            });
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use bumpless_core::HostId;

    use super::*;

    #[test]
    fn each_change_of_a_standby_is_told_once() {
        let (standbys, bus) = (Standbys::default(), BusId::new("line").unwrap());
        let mut told = Vec::new();
        for (ready, epoch, errors) in [
            // Not there yet, then there: nothing to tell.
            (false, None, 0),
            (true, None, 0),
            (false, None, 1),
            (false, None, 2),
            (true, None, 2),
            // As master it says nothing, and as a standby again only what changes.
            (false, Some(7), 3),
            (true, None, 3),
            (false, None, 4),
        ] {
            let view = MasterView {
                with: HostId::new("io-2").unwrap(),
                epoch,
                ready,
            };
            told.push(standbys.is_news(&bus, errors, &view));
        }
        assert_eq!(told, [false, false, true, false, true, false, false, true]);
        // One that never reached its device says so, once its bus has tried.
        let standbys = Standbys::default();
        let view = MasterView {
            with: HostId::new("io-2").unwrap(),
            epoch: None,
            ready: false,
        };
        assert!(!standbys.is_news(&bus, 0, &view));
        assert!(standbys.is_news(&bus, 1, &view));
        assert!(!standbys.is_news(&bus, 2, &view));
    }
}
