//! Points and records as a server of another protocol needs them: quickly, and in numbers.
//!
//! Never: writes a point that a loop writes. What is on this host is answered from memory; other hosts are asked once for
//! all that is wanted of them.

use std::{sync::Arc, time::Duration};

use bumpless_core::{HostId, LoopId, PointId, Reading, Record};
use bumpless_io::WriteStamp;
use futures_util::future::join_all;

use super::Deploy;
use crate::{
    error::{Error, chain},
    limits::{ANSWER_WAIT, POINTS_PER_PAGE},
    wire::{Ask, Told},
};

/// The name under which writes from outside the loops stand in an actuator's journal.
const FROM_OUTSIDE: &str = "from-outside";
/// Characters of who wants a write, in the log.
const WHO_CHARS_MAX: usize = 100;

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

impl Deploy {
    /// Gives a value to a point that no loop writes, wherever it is. `by` says who wants it, for the log.
    ///
    /// # Errors
    /// [`Error::NotFound`] where no host that answers has it, [`Error::Refused`] where a loop writes it, [`Error::Invalid`]
    /// for an input or a value outside its range, [`Error::Unreachable`].
    pub async fn put_point(&self, point: &PointId, value: f64, by: String) -> Result<(), Error> {
        let host = self.host_of(point).await?;
        match self
            .room
            .ask(&host, Ask::Put(point.clone(), value, by), ANSWER_WAIT)
            .await?
        {
            Told::Done => Ok(()),
            _ => Err(Error::internal("a host gave an answer to another question")),
        }
    }

    /// The host that serves a point.
    async fn host_of(&self, point: &PointId) -> Result<HostId, Error> {
        if self.reading_here(point).is_some() {
            return Ok(self.room.here.clone());
        }
        let hosts = self.room.roster.with_io();
        let room = &self.room;
        let found = join_all(hosts.iter().map(|host| async move {
            let told = room.ask(host, Ask::Find(vec![point.clone()]), ANSWER_WAIT).await;
            matches!(told, Ok(Told::Found(found)) if found == [true])
        }));
        let found = found.await;
        let mut serving = hosts.iter().zip(found).filter(|(_, found)| *found);
        serving.next().map(|(host, _)| host.clone()).ok_or_else(|| {
            Error::not_found(
                format!("no host that answers serves {point}"),
                "list the points for their names",
            )
        })
    }
}

impl crate::room::Room {
    /// Gives a value to a point of this host that no loop writes.
    pub(crate) fn put_here(&self, point: &PointId, value: f64, by: &str) -> Result<(), Error> {
        let missing = || Error::not_found(format!("host {} does not serve {point}", self.here), "list the points");
        let io = self.io.as_ref().ok_or_else(missing)?;
        let index = io.index(point).ok_or_else(missing)?;
        if let Some(writer) = self.book.writer_of(point, None) {
            return Err(Error::refused(
                format!("loop {writer} writes {point}"),
                "put the loop in manual and set its output",
            ));
        }
        let stamp = WriteStamp {
            loop_id: LoopId::new(FROM_OUTSIDE).map_err(|error| Error::internal(error.to_string()))?,
            term: 0,
            seq: 0,
        };
        io.write(&[(index, value)], &stamp, io.clock().now_ns())
            .map_err(|error| Error::invalid(chain(&error), ""))?;
        let by: String = by.chars().take(WHO_CHARS_MAX).collect();
        tracing::info!(%point, value, by, "written from outside");
        Ok(())
    }

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
