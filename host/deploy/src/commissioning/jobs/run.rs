//! One job after the other, step by step.
//!
//! Never: sends a request whose job was cancelled or is over, or two requests of one bus at once.

use std::{sync::Arc, time::Duration};

use bumpless_core::BusId;
use bumpless_io::{Errand, ErrandError, Error as IoError, IoServer, JobStep};
use tokio::time::Instant;

use super::{
    Block, JobState,
    queue::{Job, Work},
};
use crate::{
    error::chain,
    limits::{JOB_EXPECT_PAUSE, JOB_RESULT_VALUES_MAX},
    room::Room,
};

/// How a job ended.
struct End {
    state: JobState,
    reason: String,
}

impl End {
    fn new(state: JobState, reason: impl Into<String>) -> Self {
        Self {
            state,
            reason: reason.into(),
        }
    }
}

impl Room {
    /// Works off the queue of a bus, until it is empty.
    pub(super) fn work_off(self: &Arc<Self>, bus: String) {
        let room = Arc::clone(self);
        self.spawn(async move {
            while let Some(job) = room.commissioning.jobs.next(&bus) {
                room.tell_job(&job);
                let end = room.run(&job).await;
                {
                    let mut view = job.view.lock();
                    view.state = end.state;
                    view.reason = end.reason;
                    view.ended_unix_ms = Some(room.clock.unix_ms());
                    tracing::info!(job = %view.id, bus, task = view.task, state = ?view.state, reason = view.reason, "a job ended");
                }
                room.tell_job(&job);
            }
        });
    }

    async fn run(self: &Arc<Self>, job: &Arc<Job>) -> End {
        let until = Instant::now() + job.time;
        let mut cancelled = job.cancelled.subscribe();
        let cancel = async {
            let by = cancelled
                .wait_for(Option::is_some)
                .await
                .ok()
                .map(|by| by.clone().unwrap_or_default());
            match by {
                Some(by) => by,
                // The sender lives in the job, which we hold.
                None => std::future::pending().await,
            }
        };
        let at = || {
            let view = job.view.lock();
            format!("at step {} of {}", view.step, view.steps)
        };
        tokio::select! {
            biased;
            by = cancel => End::new(
                JobState::Cancelled,
                format!("cancelled by {by} {}; a request that was under way may have been done", at()),
            ),
            end = self.work(job, until) => end,
            () = tokio::time::sleep_until(until) => End::new(
                JobState::Expired,
                format!(
                    "its {} s were over {}; a request that was under way may have been done",
                    job.time.as_secs_f32(),
                    at()
                ),
            ),
        }
    }

    async fn work(self: &Arc<Self>, job: &Arc<Job>, until: Instant) -> End {
        let (Some(io), Ok(bus)) = (&self.io, BusId::new(&job.draft.bus)) else {
            return End::new(JobState::Failed, "the bus is gone");
        };
        match &job.work {
            Work::Scan(plan) => {
                let address = match io.address(&bus) {
                    Ok(address) => address.to_owned(),
                    Err(error) => return End::new(JobState::Failed, chain(&error)),
                };
                match bumpless_io::scan::scan(&address, plan).await {
                    Ok(found) => {
                        let mut view = job.view.lock();
                        view.step = view.steps;
                        view.result = found
                            .stretches
                            .iter()
                            .map(|stretch| Block {
                                unit_id: stretch.unit_id,
                                table: stretch.table,
                                address: stretch.start,
                                count: stretch.count,
                                values: Vec::new(),
                            })
                            .collect();
                        End::new(JobState::Done, found.stopped.unwrap_or_default())
                    }
                    Err(error) => End::new(JobState::Failed, chain(&error)),
                }
            }
            Work::Steps(steps, unit_id) => {
                for (number, step) in (1..).zip(steps) {
                    job.view.lock().step = number;
                    // Looked at again: a loop may have been connected since the job was taken in.
                    if let Err(error) = self.not_in_a_loops_way(&job.draft.bus, step, *unit_id) {
                        return End::new(JobState::Failed, format!("step {number}: {error}"));
                    }
                    if let Err(reason) = one(io, &bus, job, step, *unit_id, until).await {
                        return End::new(JobState::Failed, format!("step {number}: {reason}"));
                    }
                }
                End::new(JobState::Done, "")
            }
        }
    }
}

/// One step.
async fn one(
    io: &Arc<IoServer>,
    bus: &BusId,
    job: &Job,
    step: &JobStep,
    unit_id: u8,
    until: Instant,
) -> Result<(), String> {
    let (Some(errand), Some(reading)) = (step.errand(unit_id), step.reading(unit_id)) else {
        if let JobStep::Wait { ms } = step {
            tokio::time::sleep(Duration::from_millis(*ms)).await;
        }
        return Ok(());
    };
    let place = errand.place();
    match step {
        JobStep::Write { values, verify, .. } => {
            ask(io, bus, errand, until).await?;
            if *verify {
                let held = ask(io, bus, reading, until).await?;
                if held != *values {
                    return Err(format!("{place}: written {values:?}, and the device holds {held:?}"));
                }
            }
        }
        JobStep::Read { .. } => {
            let values = ask(io, bus, errand, until).await?;
            keep(job, &reading, values)?;
        }
        JobStep::Expect { values, within_ms, .. } => {
            let patience = Instant::now() + Duration::from_millis(*within_ms);
            loop {
                let held = ask(io, bus, reading.clone(), until.min(patience + JOB_EXPECT_PAUSE)).await?;
                if held == *values {
                    break;
                }
                if Instant::now() >= patience {
                    return Err(format!(
                        "{place}: {values:?} did not come within {within_ms} ms; the device holds {held:?}"
                    ));
                }
                tokio::time::sleep(JOB_EXPECT_PAUSE).await;
            }
        }
        JobStep::Wait { .. } => {}
    }
    Ok(())
}

/// Puts what was read into the result; neighbours of one table into one block.
fn keep(job: &Job, errand: &Errand, values: Vec<u16>) -> Result<(), String> {
    let Errand::Read {
        unit_id, table, start, ..
    } = errand
    else {
        return Ok(());
    };
    let mut view = job.view.lock();
    let held: usize = view.result.iter().map(|block| block.values.len()).sum();
    if held + values.len() > JOB_RESULT_VALUES_MAX {
        return Err(format!(
            "the job reads more than {JOB_RESULT_VALUES_MAX} values; split it"
        ));
    }
    match view.result.last_mut() {
        Some(block)
            if (block.unit_id, block.table) == (*unit_id, *table)
                && u32::from(block.address) + block.count == u32::from(*start) =>
        {
            block.count += values.len() as u32;
            block.values.extend(values);
        }
        _ => view.result.push(Block {
            unit_id: *unit_id,
            table: *table,
            address: *start,
            count: values.len() as u32,
            values,
        }),
    }
    Ok(())
}

/// One request, in its turn. A full queue is waited for: the job has its own time.
async fn ask(io: &Arc<IoServer>, bus: &BusId, errand: Errand, until: Instant) -> Result<Vec<u16>, String> {
    let place = errand.place();
    loop {
        match io.errand(bus, errand.clone(), until.into_std()) {
            Ok(asked) => {
                return asked.answer().await.map_err(|error| match error {
                    ErrandError::NoTurn => format!("{place}: the device did not answer in time; nothing was sent"),
                    error => format!("{place}: {error}"),
                });
            }
            Err(IoError::ErrandsFull(_)) if Instant::now() < until => tokio::time::sleep(JOB_EXPECT_PAUSE).await,
            Err(error) => return Err(chain(&error)),
        }
    }
}
