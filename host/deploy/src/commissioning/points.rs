//! Single points and buses: found, read, written by hand.
//!
//! Never: writes an output that a loop writes.

use std::sync::Arc;

use bumpless_core::{HostId, LoopId, PointId};
use bumpless_io::{IoServer, PointIndex, WriteStamp};
use futures_util::future::join_all;

use super::{BusView, FieldAsk, FieldEvent, FieldTold, ForceDraft, MasterPart, forces};
use crate::{
    error::{Error, chain},
    limits::ANSWER_WAIT,
    room::Room,
    view::PointView,
    wire::{Ask, Told},
};

/// The name under which writes by hand stand in an actuator's journal.
const BY_HAND: &str = "by-hand";

impl Room {
    /// Answers what was asked about points, buses, forces and jobs of this host.
    pub(crate) async fn field_here(self: &Arc<Self>, ask: FieldAsk) -> Result<FieldTold, Error> {
        match ask {
            FieldAsk::Point(point) => self.told_point(&point),
            FieldAsk::Write(point, value, by) => {
                self.write_here(&point, value, &by)?;
                self.told_point(&point)
            }
            FieldAsk::Force(point, draft) => {
                self.force_here(&point, draft).await?;
                self.told_point(&point)
            }
            FieldAsk::Unforce(point, by) => {
                self.unforce_here(&point, &by).await?;
                self.told_point(&point)
            }
            FieldAsk::Buses => Ok(FieldTold::Buses(self.buses_here())),
            FieldAsk::StartJob(draft) => self.start_job_here(draft).map(|job| FieldTold::Jobs(vec![job])),
            FieldAsk::Jobs => Ok(FieldTold::Jobs(self.commissioning.jobs.all())),
            FieldAsk::Job(number) => self.job_here(number).map(|job| FieldTold::Jobs(vec![job])),
            FieldAsk::CancelJob(number, by) => self.cancel_job_here(number, &by).map(|job| FieldTold::Jobs(vec![job])),
            FieldAsk::Forces(marks) => Ok(self.forces_told(marks).await),
        }
    }

    /// A point of this host.
    pub(super) fn point_here(&self, point: &PointId) -> Result<(&Arc<IoServer>, PointIndex), Error> {
        self.io
            .as_ref()
            .and_then(|io| Some((io, io.index(point)?)))
            .ok_or_else(|| Error::not_found(format!("host {} has no point {point}", self.here), "list the points"))
    }

    fn told_point(&self, point: &PointId) -> Result<FieldTold, Error> {
        let (io, index) = self.point_here(point)?;
        let info = io
            .info(index)
            .ok_or_else(|| Error::internal("a point without a description"))?;
        let writers = self.book.writers();
        Ok(FieldTold::Point(Box::new(self.point_view(io, info, &writers))))
    }

    fn write_here(&self, point: &PointId, value: f64, by: &str) -> Result<(), Error> {
        let by = forces::words("by", by)?;
        let (io, index) = self.point_here(point)?;
        if !io.speaks_for(index) {
            return Err(self.not_master(point));
        }
        if let Some(writer) = self
            .book
            .writer_of(point, None)
            .or_else(|| self.programs.writer_of(point))
        {
            return Err(Error::refused(
                format!("loop {writer} writes {point}"),
                "put the loop in manual and set its output, or force the point",
            ));
        }
        let now_ns = io.clock().now_ns();
        if let Some(force) = self.commissioning.force_of(point) {
            let left = forces::left(&force, now_ns);
            return Err(Error::refused(
                format!(
                    "{point} is forced to {} by {} for another {} s",
                    force.value,
                    force.by,
                    left.as_secs()
                ),
                "force it to the other value, or end the force first",
            ));
        }
        let stamp = WriteStamp {
            loop_id: LoopId::new(BY_HAND).map_err(|error| Error::internal(error.to_string()))?,
            term: 0,
            seq: 0,
        };
        io.write(&[(index, value)], &stamp, now_ns)
            .map_err(|error| Error::invalid(chain(&error), ""))?;
        tracing::info!(%point, value, by, "written by hand");
        self.tell_field(FieldEvent::Written {
            point: point.clone(),
            host: self.here.clone(),
            value,
            by,
        });
        Ok(())
    }

    pub(super) fn not_master(&self, point: &PointId) -> Error {
        Error::busy(
            format!("host {} is not the master of {point}'s device now", self.here),
            "ask again; the master answers",
        )
    }

    fn buses_here(&self) -> Vec<BusView> {
        let Some(io) = &self.io else { return Vec::new() };
        let view = |status: bumpless_io::BusStatus| BusView {
            host: self.here.clone(),
            id: status.bus.to_string(),
            driver: status.driver.to_owned(),
            connected: status.connected,
            points: status.points as u64,
            polls: status.polls,
            writes: status.writes,
            errors: status.errors,
            last_error: status.last_error,
            latency_us: status.latency_us,
            jobs: io.jobs(&status.bus).map_or_else(
                |_| Vec::new(),
                |(jobs, _)| jobs.iter().map(|job| (job.name.clone(), job.text.clone())).collect(),
            ),
            jobs_waiting: self.commissioning.jobs.waiting(status.bus.as_str()),
            master: io.master(&status.bus).map(|view| MasterPart {
                with: view.with.to_string(),
                epoch: view.epoch,
                ready: view.ready,
                forces: forced_on(io, &status.bus),
            }),
        };
        io.status().into_iter().map(view).collect()
    }

    /// The host that serves a point: this one, or the one that says so.
    pub(crate) async fn host_of(self: &Arc<Self>, point: &PointId) -> Result<HostId, Error> {
        if self.speaks_for(point) {
            return Ok(self.here.clone());
        }
        let hosts = self.roster.with_io();
        let ask = |host: HostId| async move {
            let found = self.ask(&host, Ask::Find(vec![point.clone()]), ANSWER_WAIT).await;
            (host, found)
        };
        let mut silent = None;
        for (host, found) in join_all(hosts.into_iter().map(ask)).await {
            match found {
                Ok(Told::Found(found)) if found == [true] => return Ok(host),
                Ok(_) => {}
                Err(error) => silent = Some(error),
            }
        }
        Err(silent.unwrap_or_else(|| {
            Error::not_found(
                format!("no host serves a point {point}"),
                "list the points for their names",
            )
        }))
    }

    pub(super) async fn field_at(self: &Arc<Self>, host: &HostId, ask: FieldAsk) -> Result<FieldTold, Error> {
        match self.ask(host, Ask::Field(Box::new(ask)), ANSWER_WAIT).await? {
            Told::Field(told) => Ok(*told),
            _ => Err(unexpected()),
        }
    }

    async fn at_point(self: &Arc<Self>, point: &PointId, ask: FieldAsk) -> Result<PointView, Error> {
        let host = self.host_of(point).await?;
        match self.field_at(&host, ask).await? {
            FieldTold::Point(view) => Ok(*view),
            _ => Err(unexpected()),
        }
    }

    /// One point, wherever it is.
    pub(crate) async fn point(self: &Arc<Self>, point: &PointId) -> Result<PointView, Error> {
        self.at_point(point, FieldAsk::Point(point.clone())).await
    }

    /// Writes a point that no loop writes.
    pub(crate) async fn write_point(
        self: &Arc<Self>,
        point: &PointId,
        value: f64,
        by: String,
    ) -> Result<PointView, Error> {
        self.at_point(point, FieldAsk::Write(point.clone(), value, by)).await
    }

    /// Holds a point at a value.
    pub(crate) async fn force(self: &Arc<Self>, point: &PointId, draft: ForceDraft) -> Result<PointView, Error> {
        self.at_point(point, FieldAsk::Force(point.clone(), draft)).await
    }

    /// Lets a point go.
    pub(crate) async fn unforce(self: &Arc<Self>, point: &PointId, by: String) -> Result<PointView, Error> {
        self.at_point(point, FieldAsk::Unforce(point.clone(), by)).await
    }

    /// The buses of all hosts. One that does not answer is left out, unless none does.
    pub(crate) async fn buses(self: &Arc<Self>) -> Result<Vec<BusView>, Error> {
        let hosts = self.roster.with_io();
        let lists = join_all(hosts.iter().map(|host| self.field_at(host, FieldAsk::Buses))).await;
        let (mut all, mut failed) = (Vec::new(), None);
        for (host, list) in hosts.iter().zip(lists) {
            match list {
                Ok(FieldTold::Buses(buses)) => all.extend(buses),
                Ok(_) => failed = Some(unexpected()),
                Err(error) => {
                    tracing::warn!(%host, %error, "the buses of a host are missing from the list");
                    failed = Some(error);
                }
            }
        }
        match failed {
            Some(error) if all.is_empty() => Err(error),
            _ => {
                all.sort_by(|a: &BusView, b| (&a.id, &a.host).cmp(&(&b.id, &b.host)));
                Ok(all)
            }
        }
    }
}

/// Forces on the points of a bus that has two masters.
fn forced_on(io: &IoServer, bus: &bumpless_core::BusId) -> u32 {
    let here = |index: PointIndex| io.redundant(index).is_some_and(|(own, _)| own == *bus);
    io.forced().into_iter().filter(|(index, _)| here(*index)).count() as u32
}

pub(super) fn unexpected() -> Error {
    Error::internal("another host answered something else than was asked")
}
