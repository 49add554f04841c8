//! Points and records as a server of another protocol needs them: quickly, and in numbers.
//!
//! Never: writes; that is `commissioning`'s, with its checks. What is on this host is answered from memory; other hosts are asked once for
//! all that is wanted of them.

use std::{sync::Arc, time::Duration};

use bumpless_core::{LoopId, PointId, Reading, Record};
use futures_util::future::join_all;

use super::Deploy;
use crate::{
    limits::{ANSWER_WAIT, POINTS_PER_PAGE},
    wire::{Ask, Told},
};

impl Deploy {
    /// A point of this host now, with the age of its value; none where this host does not have it.
    #[must_use]
    pub fn reading_here(&self, point: &PointId) -> Option<(Reading, Duration)> {
        self.room.reading_here(point)
    }

    /// A loop's last record as far as this host has seen, and how long ago it came.
    #[must_use]
    pub fn last_record(&self, id: &LoopId) -> Option<(Arc<Record>, Duration)> {
        let last = self.room.feed.last(id)?;
        Some((last.record, last.came.elapsed()))
    }

    /// Points of other hosts now, in the order asked, with the age of their values; none for what no host that answers
    /// has.
    pub async fn readings_elsewhere(&self, points: &[PointId]) -> Vec<Option<(Reading, Duration)>> {
        let mut found: Vec<Option<(Reading, Duration)>> = vec![None; points.len()];
        let hosts = self.room.roster.with_io();
        let others = hosts.iter().filter(|host| **host != self.room.here);
        let room = &self.room;
        let answers = join_all(others.map(|host| async move {
            let mut all = Vec::with_capacity(points.len());
            for page in points.chunks(POINTS_PER_PAGE) {
                match room.ask(host, Ask::Read(page.to_vec()), ANSWER_WAIT).await {
                    Ok(Told::Read(readings)) if readings.len() == page.len() => all.extend(readings),
                    // What one host does not tell, another may; and the next look comes soon.
                    _ => return Vec::new(),
                }
            }
            all
        }));
        for answer in answers.await {
            for (slot, reading) in found.iter_mut().zip(answer) {
                if let Some((reading, age_ns)) = reading {
                    *slot = Some((reading, Duration::from_nanos(age_ns)));
                }
            }
        }
        found
    }
}

impl crate::room::Room {
    /// A point of this host now, with the age of its value.
    pub(crate) fn reading_here(&self, point: &PointId) -> Option<(Reading, Duration)> {
        let io = self.io.as_ref()?;
        let now_ns = io.clock().now_ns();
        let reading = io.read_one(io.index(point)?, now_ns);
        Some((reading, Duration::from_nanos(now_ns.saturating_sub(reading.at_ns))))
    }

    /// Points of this host, in the order asked, with the ages of their values in ns; at most a page.
    pub(crate) fn read_here(&self, points: &[PointId]) -> Told {
        let one = |point: &PointId| {
            let (reading, age) = self.reading_here(point)?;
            Some((reading, u64::try_from(age.as_nanos()).unwrap_or(u64::MAX)))
        };
        Told::Read(points.iter().take(POINTS_PER_PAGE).map(one).collect())
    }
}
