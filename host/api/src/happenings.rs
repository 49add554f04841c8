//! What happened to alarms of the cell lately: kept in a ring, numbered, for readers that come back.
//!
//! ```text
//! event of any home ─► number ─► ring (HAPPENINGS_MAX, the oldest goes) ─► readers, by number
//! ```
//! It is memory, not a log: every home keeps its own on disk (`/v1/alarms/history`). Numbers are of this process; each event has
//! an id of its own beside it, the same at every host. Never: waits for a reader, or holds a home up.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use tokio::sync::broadcast::error::RecvError;

use crate::{limits::HAPPENINGS_MAX, server::App, types::AlarmHappening};

#[derive(Default)]
struct Kept {
    ring: VecDeque<(u64, Arc<AlarmHappening>)>,
    number: u64,
}

/// The ring.
#[derive(Default)]
pub(crate) struct Happenings {
    kept: Mutex<Kept>,
}

impl Happenings {
    fn kept(&self) -> MutexGuard<'_, Kept> {
        // A poisoned ring is still a ring: each push is whole.
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The last number given.
    pub(crate) fn number(&self) -> u64 {
        self.kept().number
    }

    /// Those with a greater number, oldest first, and the last number.
    pub(crate) fn since(&self, number: u64) -> (Vec<Arc<AlarmHappening>>, u64) {
        let kept = self.kept();
        let newer = kept.ring.iter().filter(|(at, _)| *at > number);
        (newer.map(|(_, event)| Arc::clone(event)).collect(), kept.number)
    }

    /// The number to go on from for a reader that knew another process and had everything up to this time.
    pub(crate) fn number_at(&self, at_unix_us: u64) -> u64 {
        let kept = self.kept();
        let first = kept.ring.iter().find(|(_, event)| event.at_unix_us > at_unix_us);
        first.map_or(kept.number, |(number, _)| number.saturating_sub(1))
    }

    /// Takes one up.
    pub(crate) fn take(&self, event: AlarmHappening) {
        let mut kept = self.kept();
        kept.number += 1;
        let number = kept.number;
        if kept.ring.len() >= HAPPENINGS_MAX {
            kept.ring.pop_front();
        }
        kept.ring.push_back((number, Arc::new(event)));
    }

    /// Follows the alarms of the cell until the host stops.
    pub(crate) async fn follow(app: App) {
        let mut events = app.cell.alarm_events();
        let mut stop = app.stop.clone();
        loop {
            let next = tokio::select! {
                biased;
                _ = stop.wait_for(|stop| *stop) => return,
                next = events.recv() => next,
            };
            match next {
                Ok(event) => app.happenings.take(AlarmHappening::from(&*event)),
                Err(RecvError::Lagged(missed)) => tracing::debug!(missed, "alarms: events were missed"),
                Err(RecvError::Closed) => return,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::alarms::happening;

    #[test]
    fn the_ring_forgets_the_oldest_and_readers_go_on_where_they_were() {
        let ring = Happenings::default();
        assert_eq!((ring.since(0).0.len(), ring.number_at(0)), (0, 0));
        for at in 1..=HAPPENINGS_MAX as u64 + 5 {
            ring.take(happening(at));
        }
        let (all, last) = ring.since(0);
        assert_eq!((all.len(), all[0].at_unix_us), (HAPPENINGS_MAX, 6));
        assert_eq!(last, HAPPENINGS_MAX as u64 + 5);
        assert_eq!(ring.since(last - 2).0.len(), 2);
        assert_eq!(
            ring.number_at(9),
            9,
            "what came later than 9 has the numbers from 10 on"
        );
        assert_eq!(ring.number_at(u64::MAX), last);
    }
}
