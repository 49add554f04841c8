//! What two masters of one device know of its forces, kept alike on both.
//!
//! ```text
//! master: force, unforce ──► own disk ──► the other host: newer than what it knows? ──► its disk, its image
//!              ▲ what the other knows better comes back with its answer     │
//!              └────────────────────────────────────────────────────────────┘   again every second until it has answered
//! ```
//!
//! A mark says the newest wish for a point, a force or its end, and is numbered by the mastership under which it was said;
//! the greater number counts. An end is remembered for as long as the force would have lasted, so that a host that was away
//! does not bring it back. Times travel as what is left: the clocks of two hosts are never compared.
//!
//! Owns: which wish counts. Never: puts a force into the image by itself; who calls does.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{HostId, PointId};
use bumpless_io::{IoServer, limits::FORCES_MAX};
use futures_util::future::join_all;
use serde::{Deserialize, Serialize};

use super::{FieldAsk, FieldTold, ForceView, forces::as_force, points::unexpected};
use crate::{
    book::on_disk,
    error::{Error, chain},
    limits::{FORCE_SHARE_WAIT, WORDS_CHARS_MAX},
    room::Room,
    wire::{Ask, Told},
};

/// An end is remembered so much longer than its force would have lasted: the other host's clock may run a little slower.
const ENDED_KEPT_MS: u64 = 60_000;

/// Which of two wishes is the newer one. The master's epoch comes first: only one host has it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct Position {
    /// Number of the mastership; 0 of a device with one master.
    epoch: u32,
    /// Only grows within it.
    count: u64,
}

impl Position {
    /// Behind `before`, under this mastership.
    pub(super) fn after(before: Option<Self>, epoch: u32, now_ms: u64) -> Self {
        let floor = before.filter(|before| before.epoch >= epoch);
        Self {
            epoch: floor.map_or(epoch, |floor| floor.epoch),
            count: floor.map_or(now_ms, |floor| now_ms.max(floor.count.saturating_add(1))),
        }
    }
}

/// The newest wish for a point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Mark {
    pub(super) position: Position,
    /// The force ends by itself then; an end is forgotten then. In ms of this host's Unix time.
    pub(super) until_unix_ms: u64,
    /// The force; none where it was ended.
    pub(super) force: Option<ForceView>,
}

impl Mark {
    /// The same wish, whose time is over.
    pub(super) fn over(&self) -> Self {
        Self {
            force: None,
            until_unix_ms: self.until_unix_ms.saturating_add(ENDED_KEPT_MS),
            ..self.clone()
        }
    }
}

/// A mark on its way to the other master.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct SharedMark {
    point: PointId,
    position: Position,
    /// For how long it matters still, in ms.
    left_ms: u64,
    force: Option<ForceView>,
}

/// All marks of a host.
#[derive(Debug, Default)]
pub(crate) struct Marks {
    marks: BTreeMap<PointId, Mark>,
    /// Grows with each change.
    generation: u64,
    /// The generation that another master has answered to.
    told: BTreeMap<HostId, u64>,
}

impl Marks {
    pub(super) fn new(rows: Vec<(PointId, Mark)>) -> Self {
        Self {
            marks: rows.into_iter().collect(),
            generation: 1,
            told: BTreeMap::new(),
        }
    }

    pub(super) fn get(&self, point: &PointId) -> Option<&Mark> {
        self.marks.get(point)
    }

    pub(super) fn force(&self, point: &PointId) -> Option<&ForceView> {
        // Mostly there are none, and a list of points asks for each.
        if self.marks.is_empty() {
            return None;
        }
        self.marks.get(point)?.force.as_ref()
    }

    pub(super) fn forces(&self) -> Vec<(PointId, ForceView)> {
        let force = |(point, mark): (&PointId, &Mark)| Some((point.clone(), mark.force.clone()?));
        self.marks.iter().filter_map(force).collect()
    }

    pub(super) fn put(&mut self, point: PointId, mark: Mark) {
        self.generation += 1;
        self.marks.insert(point, mark);
    }

    pub(super) fn forget(&mut self, point: &PointId) {
        self.marks.remove(point);
    }

    /// Is this newer than what is known?
    fn is_news(&self, mark: &SharedMark) -> bool {
        self.marks
            .get(&mark.point)
            .is_none_or(|known| known.position < mark.position)
    }

    /// Forgets ends that matter no more, and the oldest beyond [`FORCES_MAX`]; says which.
    pub(super) fn sweep(&mut self, now_ms: u64) -> Vec<PointId> {
        let mut ended: Vec<(u64, PointId)> = self
            .marks
            .iter()
            .filter(|(_, mark)| mark.force.is_none())
            .map(|(point, mark)| (mark.until_unix_ms, point.clone()))
            .collect();
        ended.sort();
        let extra = ended.len().saturating_sub(FORCES_MAX);
        let over = |(number, (until_ms, point)): (usize, (u64, PointId))| {
            (number < extra || until_ms <= now_ms).then_some(point)
        };
        let gone: Vec<PointId> = ended.into_iter().enumerate().filter_map(over).collect();
        for point in &gone {
            self.marks.remove(point);
        }
        gone
    }

    /// What another master is to be told of these points; none where it has answered to all of it.
    fn to_tell(&self, host: &HostId, now_ms: u64, shared: impl Fn(&PointId) -> bool) -> Option<(u64, Vec<SharedMark>)> {
        if self.marks.is_empty() || self.told.get(host) == Some(&self.generation) {
            return None;
        }
        let marks = self
            .marks
            .iter()
            .filter(|(point, mark)| mark.until_unix_ms > now_ms && shared(point))
            .map(|(point, mark)| SharedMark {
                point: point.clone(),
                position: mark.position,
                left_ms: mark.until_unix_ms - now_ms,
                force: mark.force.clone(),
            })
            .collect();
        Some((self.generation, marks))
    }
}

impl Room {
    /// Tells the other masters of this host's devices what they have not answered to. What does not arrive is told again.
    pub(super) async fn share_forces(self: &Arc<Self>) {
        let Some(io) = &self.io else { return };
        let there = self.roster.others();
        let mut hosts: Vec<HostId> = io
            .masterships()
            .iter()
            .filter_map(|(bus, _)| io.master(bus).map(|view| view.with))
            .filter(|host| there.contains(host))
            .collect();
        hosts.sort();
        hosts.dedup();
        let now_ms = io.clock().now_ns() / 1_000_000;
        let tellings: Vec<_> = {
            let marks = self.commissioning.forces.marks.lock();
            let telling = |host: HostId| {
                let (generation, told) = marks.to_tell(&host, now_ms, |point| shared_with(io, point, &host))?;
                Some((host, generation, told))
            };
            hosts.into_iter().filter_map(telling).collect()
        };
        let tell = |(host, generation, marks): (HostId, u64, Vec<SharedMark>)| async move {
            let ask = Ask::Field(Box::new(FieldAsk::Forces(marks)));
            let answer = match self.ask(&host, ask, FORCE_SHARE_WAIT).await {
                Ok(Told::Field(told)) => match *told {
                    FieldTold::Forces(known) => Ok(known),
                    _ => Err(unexpected()),
                },
                Ok(_) => Err(unexpected()),
                Err(error) => Err(error),
            };
            match answer {
                Ok(known) => {
                    self.learn_forces(known).await;
                    self.commissioning.forces.marks.lock().told.insert(host, generation);
                }
                Err(error) => {
                    tracing::debug!(%host, %error, "the other master was not told of the forces; it is tried again");
                }
            }
        };
        join_all(tellings.into_iter().map(tell)).await;
    }

    /// Takes what another master knows better, and answers what this host knows better.
    pub(super) async fn forces_told(self: &Arc<Self>, marks: Vec<SharedMark>) -> FieldTold {
        let asked: BTreeMap<PointId, Position> = marks.iter().map(|mark| (mark.point.clone(), mark.position)).collect();
        self.learn_forces(marks).await;
        let now_ms = self.clock.now_ns() / 1_000_000;
        let marks = self.commissioning.forces.marks.lock();
        let better = asked.iter().filter_map(|(point, position)| {
            let mark = marks.get(point).filter(|mark| mark.position > *position)?;
            Some(SharedMark {
                point: point.clone(),
                position: mark.position,
                left_ms: mark.until_unix_ms.checked_sub(now_ms)?,
                force: mark.force.clone(),
            })
        });
        FieldTold::Forces(better.collect())
    }

    async fn learn_forces(&self, marks: Vec<SharedMark>) {
        let Some(io) = &self.io else { return };
        for mark in marks.into_iter().take(2 * FORCES_MAX) {
            let point = mark.point.clone();
            if let Err(error) = self.learn_force(io, mark).await {
                tracing::warn!(%point, %error, "a force of the other master could not be taken over; it is told again");
            }
        }
    }

    async fn learn_force(&self, io: &Arc<IoServer>, mark: SharedMark) -> Result<(), Error> {
        let index = io.index(&mark.point).filter(|index| io.redundant(*index).is_some());
        let Some(index) = index else { return Ok(()) };
        let _turn = self.commissioning.forces.changing.lock().await;
        if mark.left_ms == 0 || !self.commissioning.forces.marks.lock().is_news(&mark) {
            return Ok(());
        }
        let now_ns = io.clock().now_ns();
        let until_unix_ms = (now_ns / 1_000_000).saturating_add(mark.left_ms);
        let words = |text: &str| text.chars().take(WORDS_CHARS_MAX).collect::<String>();
        let force = mark.force.map(|force| ForceView {
            until_unix_ms,
            by: words(&force.by),
            why: words(&force.why),
            ..force
        });
        if let Some(force) = &force {
            io.force(index, as_force(force), now_ns)
                .map_err(|error| Error::invalid(chain(&error), ""))?;
        }
        let row = Mark {
            position: mark.position,
            until_unix_ms,
            force,
        };
        let (store, key, copy) = (self.store.clone(), mark.point.clone(), row.clone());
        on_disk(move || store.put_force(&key, &copy)).await??;
        if row.force.is_none() {
            io.unforce(index);
        }
        tracing::warn!(point = %mark.point, forced = row.force.is_some(), "the other master told of a force");
        let mut marks = self.commissioning.forces.marks.lock();
        marks.put(mark.point, row);
        Ok(())
    }
}

/// Is a point on a device that the host is the other master of?
fn shared_with(io: &IoServer, point: &PointId, host: &HostId) -> bool {
    io.index(point)
        .and_then(|index| io.redundant(index))
        .is_some_and(|(_, view)| view.with == *host)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    fn point(name: &str) -> PointId {
        PointId::new(name).unwrap()
    }

    fn mark(epoch: u32, count: u64, until_unix_ms: u64, forced: bool) -> Mark {
        Mark {
            position: Position { epoch, count },
            until_unix_ms,
            force: forced.then(|| ForceView {
                value: 1.0,
                since_unix_ms: 0,
                until_unix_ms,
                by: "ann".to_owned(),
                why: "test".to_owned(),
            }),
        }
    }

    fn shared(epoch: u32, count: u64) -> SharedMark {
        SharedMark {
            point: point("l.v"),
            position: Position { epoch, count },
            left_ms: 1,
            force: None,
        }
    }

    #[test]
    fn the_later_mastership_counts_and_within_it_the_later_wish() {
        let first = Position::after(None, 3, 1_000);
        let second = Position::after(Some(first), 3, 900);
        let third = Position::after(Some(second), 4, 5);
        assert!(first < second && second < third, "{first:?} {second:?} {third:?}");
        // A host whose mastership is older than what it knows cannot fall behind.
        assert!(Position::after(Some(third), 3, 1) > third);
        let marks = Marks::new(vec![(point("l.v"), mark(4, 10, 9, true))]);
        for (epoch, count, news) in [
            (4, 10, false),
            (4, 9, false),
            (3, 99, false),
            (4, 11, true),
            (5, 0, true),
        ] {
            assert_eq!(marks.is_news(&shared(epoch, count)), news, "{epoch}, {count}");
        }
    }

    #[test]
    fn an_end_is_remembered_as_long_as_its_force_would_have_lasted() {
        let mut marks = Marks::new(vec![(point("l.v"), mark(1, 1, 1_000, true).over())]);
        assert!(marks.force(&point("l.v")).is_none());
        assert!(marks.sweep(1_000).is_empty() && marks.get(&point("l.v")).is_some());
        assert_eq!(marks.sweep(1_000 + ENDED_KEPT_MS), [point("l.v")]);
        marks.put(point("l.w"), mark(1, 1, 5, true));
        assert!(
            marks.sweep(u64::MAX).is_empty(),
            "a force is ended by the I/O server's time alone"
        );
        for n in 0..FORCES_MAX as u64 + 3 {
            marks.put(point(&format!("p.{n}")), mark(1, 1, 10 + n, false));
        }
        let gone = marks.sweep(0);
        assert_eq!(
            gone,
            [point("p.0"), point("p.1"), point("p.2")],
            "the oldest beyond the bound"
        );
    }

    #[test]
    fn what_was_answered_to_is_not_told_again_until_it_changes() {
        let host = HostId::new("io-2").unwrap();
        let mut marks = Marks::default();
        assert!(marks.to_tell(&host, 0, |_| true).is_none());
        marks.put(point("l.v"), mark(1, 1, 100, true));
        let (generation, told) = marks.to_tell(&host, 40, |_| true).expect("news");
        assert_eq!((told.len(), told.first().unwrap().left_ms), (1, 60));
        assert_eq!(
            marks.to_tell(&host, 40, |_| false).expect("nothing of it is shared").1,
            []
        );
        marks.told.insert(host.clone(), generation);
        assert!(marks.to_tell(&host, 40, |_| true).is_none());
        marks.put(point("l.v"), mark(1, 2, 100, false));
        assert!(marks.to_tell(&host, 40, |_| true).is_some());
    }
}
