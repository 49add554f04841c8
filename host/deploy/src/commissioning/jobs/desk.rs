//! Jobs asked for, shown and cancelled, at any host and at the one of the bus.
//!
//! Never: lets a job write where a loop writes or a person forces.

use std::{sync::Arc, time::Duration};

use bumpless_core::HostId;
use bumpless_io::{JobStep, job, modbus::Table};

use super::{
    JobDraft, JobState, JobTask, JobView,
    queue::{Job, Taken, Work},
};
use crate::{
    commissioning::{BusView, FieldAsk, FieldEvent, FieldTold, forces, points::unexpected},
    error::{Error, chain},
    limits::{JOB_QUEUE_MS_MAX, JOB_RESULT_VALUES_MAX},
    room::Room,
};

impl Room {
    /// The first reply: takes a job in, or says why not.
    pub(in crate::commissioning) fn start_job_here(self: &Arc<Self>, mut draft: JobDraft) -> Result<JobView, Error> {
        draft.by = forces::words("by", &draft.by)?;
        if let Some(key) = &draft.key {
            forces::words("the key", key)?;
        }
        if draft.queue_ms == 0 || draft.queue_ms > JOB_QUEUE_MS_MAX {
            return Err(Error::invalid(
                format!("queue_ms = {}", draft.queue_ms),
                format!("1 to {JOB_QUEUE_MS_MAX} are possible"),
            ));
        }
        let (work, time) = self.work_of(&draft)?;
        if let Work::Steps(steps, unit_id) = &work {
            for step in steps {
                self.not_in_a_loops_way(&draft.bus, step, *unit_id)?;
            }
        }
        let (job, taken) = self.commissioning.jobs.take(&self.here, draft, work, time)?;
        if taken != Taken::Known {
            tracing::info!(job = %job.view.lock().id, bus = job.draft.bus, task = job.draft.task.name(), by = job.draft.by, "a job was taken in");
            self.tell_job(&job);
            if taken == Taken::Idle {
                self.work_off(job.draft.bus.clone());
            }
        }
        Ok(self.shown(&job))
    }

    /// Ends jobs that nobody worked on in time, for as long as the host lives. One sleeper for all of them.
    pub(crate) async fn watch_queues(room: Arc<Self>) {
        let jobs = &room.commissioning.jobs;
        loop {
            let next = jobs.next_over();
            tokio::select! {
                () = jobs.waits.notified() => {}
                () = async { match next {
                    Some(at) => tokio::time::sleep_until(at).await,
                    None => std::future::pending().await,
                } } => {}
            }
            for job in jobs.take_over(tokio::time::Instant::now()) {
                room.tell_job(&job);
            }
        }
    }

    fn shown(&self, job: &Job) -> JobView {
        self.commissioning.jobs.inside.lock().view(job, true)
    }

    pub(super) fn tell_job(&self, job: &Job) {
        let view = self.commissioning.jobs.inside.lock().view(job, false);
        self.tell_field(FieldEvent::Job(view));
    }

    pub(in crate::commissioning) fn job_here(&self, number: u64) -> Result<JobView, Error> {
        self.find_job(number).map(|job| self.shown(&job))
    }

    fn find_job(&self, number: u64) -> Result<Arc<Job>, Error> {
        self.commissioning.jobs.get(number).ok_or_else(|| {
            Error::not_found(
                format!("host {} knows no job {number}", self.here),
                "the host may have started again, or forgotten it; ask for the job again with its key",
            )
        })
    }

    /// Ends a job: at once while it waits, between two requests while it runs.
    pub(in crate::commissioning) fn cancel_job_here(&self, number: u64, by: &str) -> Result<JobView, Error> {
        let by = forces::words("by", by)?;
        let job = self.find_job(number)?;
        let reason = format!("cancelled by {by}, before it began");
        if self.commissioning.jobs.drop_queued(&job, JobState::Cancelled, &reason) {
            self.tell_job(&job);
        } else if job.view.lock().state == JobState::Running {
            job.cancelled.send_replace(Some(by));
        } else {
            let state = job.view.lock().state;
            return Err(Error::refused(
                format!("the job has ended: {state:?}").to_lowercase(),
                "",
            ));
        }
        Ok(self.shown(&job))
    }

    /// The steps and the time of a job.
    fn work_of(&self, draft: &JobDraft) -> Result<(Work, Duration), Error> {
        let io = self
            .io
            .as_ref()
            .ok_or_else(|| Error::not_found(format!("host {} has no buses", self.here), ""))?;
        let missing = |error: bumpless_io::Error| Error::not_found(chain(&error), "list the buses");
        let invalid = |error: bumpless_io::Error| Error::invalid(chain(&error), "");
        let bus = bumpless_core::BusId::new(&draft.bus).map_err(|error| Error::invalid(error.to_string(), ""))?;
        let (named, unit_id) = io.jobs(&bus).map_err(missing)?;
        let (steps, own_ms) = match &draft.task {
            JobTask::Named(name) => {
                let found = named.iter().find(|job| job.name == *name).ok_or_else(|| {
                    let known: Vec<&str> = named.iter().map(|job| job.name.as_str()).collect();
                    Error::not_found(
                        format!("bus {bus} has no job {name:?}"),
                        format!("it has write-block, read-block, scan {}", known.join(", ")),
                    )
                })?;
                (found.steps.clone(), found.timeout_ms)
            }
            JobTask::WriteBlock {
                unit_id,
                table,
                address,
                values,
                verify,
            } => (
                write_steps(*unit_id, *table, *address, values, *verify)?,
                job::JOB_MS_DEFAULT,
            ),
            JobTask::ReadBlock {
                unit_id,
                table,
                address,
                count,
            } => (read_steps(*unit_id, *table, *address, *count)?, job::JOB_MS_DEFAULT),
            JobTask::Scan(plan) => {
                plan.check().map_err(invalid)?;
                let time_ms = draft.timeout_ms.unwrap_or(bumpless_io::limits::JOB_MS_MAX / 12);
                job::check("the job", &[JobStep::Wait { ms: 1 }], time_ms).map_err(invalid)?;
                return Ok((Work::Scan(plan.clone()), Duration::from_millis(time_ms)));
            }
        };
        let time_ms = draft.timeout_ms.unwrap_or(own_ms);
        job::check("the job", &steps, time_ms).map_err(invalid)?;
        Ok((Work::Steps(steps, unit_id), Duration::from_millis(time_ms)))
    }

    /// A job must not write what a loop writes or a person forces.
    pub(super) fn not_in_a_loops_way(&self, bus: &str, step: &JobStep, unit_id: u8) -> Result<(), Error> {
        let (JobStep::Write { .. }, Some(errand), Some(io)) = (step, step.errand(unit_id), &self.io) else {
            return Ok(());
        };
        let bus = bumpless_core::BusId::new(bus).map_err(|error| Error::invalid(error.to_string(), ""))?;
        let touched = io
            .touched(&bus, &errand)
            .map_err(|error| Error::not_found(chain(&error), ""))?;
        for point in touched {
            if let Some(writer) = self
                .book
                .writer_of(&point, None)
                .or_else(|| self.programs.writer_of(&point))
            {
                return Err(Error::refused(
                    format!("{} is point {point}, which loop {writer} writes", errand.place()),
                    "delete the loop, or leave these addresses to it",
                ));
            }
            if self.commissioning.force_of(&point).is_some() {
                return Err(Error::refused(
                    format!("{} is point {point}, which is forced", errand.place()),
                    "end the force first",
                ));
            }
        }
        Ok(())
    }

    /// Hands a job to the host of its bus.
    pub(crate) async fn start_job(self: &Arc<Self>, draft: JobDraft) -> Result<JobView, Error> {
        let host = match &draft.host {
            Some(host) => host.clone(),
            None => {
                let buses = self.buses().await?;
                // Of a device with two masters, the one that is.
                let stands_by = |bus: &&BusView| bus.master.as_ref().is_some_and(|part| part.epoch.is_none());
                let mut hosts = buses
                    .iter()
                    .filter(|bus| bus.id == draft.bus && !stands_by(bus))
                    .map(|bus| &bus.host);
                match (hosts.next(), hosts.next()) {
                    (Some(host), None) => host.clone(),
                    (Some(one), Some(other)) => {
                        return Err(Error::invalid(
                            format!("hosts {one} and {other} both have a bus {}", draft.bus),
                            "name the host",
                        ));
                    }
                    (None, _) => {
                        return Err(Error::not_found(
                            format!("no host has a bus {:?}", draft.bus),
                            "list the buses",
                        ));
                    }
                }
            }
        };
        self.one_job(&host, FieldAsk::StartJob(draft)).await
    }

    /// One job, by its name in the cell.
    pub(crate) async fn job(self: &Arc<Self>, id: &str) -> Result<JobView, Error> {
        let (host, number) = job_name(id)?;
        self.one_job(&host, FieldAsk::Job(number)).await
    }

    /// Ends a job.
    pub(crate) async fn cancel_job(self: &Arc<Self>, id: &str, by: String) -> Result<JobView, Error> {
        let (host, number) = job_name(id)?;
        self.one_job(&host, FieldAsk::CancelJob(number, by)).await
    }

    async fn one_job(self: &Arc<Self>, host: &HostId, ask: FieldAsk) -> Result<JobView, Error> {
        match self.field_at(host, ask).await? {
            FieldTold::Jobs(jobs) => jobs.into_iter().next().ok_or_else(unexpected),
            _ => Err(unexpected()),
        }
    }

    /// The jobs of all hosts, oldest first. Hosts that do not answer are left out.
    pub(crate) async fn jobs(self: &Arc<Self>) -> Vec<JobView> {
        let hosts = self.roster.with_io();
        let lists = futures_util::future::join_all(hosts.iter().map(|host| self.field_at(host, FieldAsk::Jobs))).await;
        let mut all = Vec::new();
        for (host, list) in hosts.iter().zip(lists) {
            match list {
                Ok(FieldTold::Jobs(jobs)) => all.extend(jobs),
                Ok(_) => tracing::warn!(%host, "another answer than a list of jobs"),
                Err(error) => tracing::warn!(%host, %error, "the jobs of a host are missing from the list"),
            }
        }
        all.sort_by(|a: &JobView, b| (a.asked_unix_ms, &a.id).cmp(&(b.asked_unix_ms, &b.id)));
        all
    }
}

/// `host.number`.
fn job_name(id: &str) -> Result<(HostId, u64), Error> {
    id.rsplit_once('.')
        .and_then(|(host, number)| Some((HostId::new(host).ok()?, number.parse().ok()?)))
        .ok_or_else(|| {
            let short: String = id.chars().take(80).collect();
            Error::invalid(
                format!("{short:?} is no name of a job"),
                "a job's name is HOST.NUMBER, as its start gave it",
            )
        })
}

/// A block in as many requests as it takes.
fn write_steps(
    unit_id: Option<u8>,
    table: Table,
    address: u16,
    values: &[u16],
    verify: bool,
) -> Result<Vec<JobStep>, Error> {
    fits(address, values.len())?;
    let most = if table.is_bits() {
        bumpless_io::limits::BITS_PER_WRITE_MAX
    } else {
        bumpless_io::limits::REGISTERS_PER_WRITE_MAX
    };
    let steps = values
        .chunks(usize::from(most))
        .zip((u32::from(address)..).step_by(usize::from(most)));
    Ok(steps
        .map(|(values, address)| JobStep::Write {
            unit_id,
            table,
            address: address as u16,
            values: values.to_vec(),
            verify,
        })
        .collect())
}

fn read_steps(unit_id: Option<u8>, table: Table, address: u16, count: u16) -> Result<Vec<JobStep>, Error> {
    fits(address, usize::from(count))?;
    let most = u32::from(table.read_max());
    let (first, end) = (u32::from(address), u32::from(address) + u32::from(count));
    Ok((first..end)
        .step_by(most as usize)
        .map(|start| JobStep::Read {
            unit_id,
            table,
            address: start as u16,
            count: most.min(end - start) as u16,
        })
        .collect())
}

fn fits(address: u16, count: usize) -> Result<(), Error> {
    if count == 0 || count > JOB_RESULT_VALUES_MAX {
        return Err(Error::invalid(
            format!("a block of {count} values"),
            format!("1 to {JOB_RESULT_VALUES_MAX} are possible"),
        ));
    }
    if usize::from(address) + count > 65_536 {
        return Err(Error::invalid(
            format!("{count} values from address {address} reach behind the last address, 65535"),
            "ask for fewer",
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    #[test]
    fn blocks_are_cut_into_requests() {
        let steps = read_steps(None, Table::Input, 65_300, 236).unwrap();
        let shapes: Vec<_> = steps
            .iter()
            .map(|step| match step {
                JobStep::Read { address, count, .. } => (*address, *count),
                _ => (0, 0),
            })
            .collect();
        assert_eq!(shapes, [(65_300, 125), (65_425, 111)]);
        assert_eq!(
            write_steps(Some(2), Table::Holding, 0, &[0; 124], true).unwrap().len(),
            2
        );
        for (address, count, part) in [(65_300, 237, "behind the last"), (0, 0, "0 values")] {
            let error = read_steps(None, Table::Input, address, count)
                .expect_err(part)
                .to_string();
            assert!(error.contains(part), "{error}");
        }
        assert!(job_name("plant.1000001").is_ok() && job_name("a.b.3").is_ok());
        for bad in ["", "plant", "plant.x", ".3"] {
            assert!(job_name(bad).is_err(), "{bad}");
        }
    }
}
