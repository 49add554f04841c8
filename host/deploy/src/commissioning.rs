//! What people do with points and devices beside the loops: look, write by hand, force, and start jobs.
//!
//! Owns: the words of it (asked at any host, answered by the I/O host), and what of it a host keeps.
//! Never: on a cycle's thread; and nothing here writes an output that a loop writes, except a force, which says so.
//!
//! ```text
//! any host ──Ask::Field──► I/O host: points, buses     answered from the image, at once
//!                                    force, write      on disk, then on the actuator
//!                                    job               queued: acknowledged, or refused with the reason
//!                          every host ◄──Notice::Field── what became of it
//! ```

use bumpless_core::{HostId, PointId};
use bumpless_io::Clock;
use bumpless_store::Store;
use serde::{Deserialize, Serialize};
use tokio::sync::broadcast;

use crate::{error::Error, limits::FIELD_EVENTS, view::PointView};

mod forces;
mod jobs;
mod marks;
mod points;
mod standby;

pub use bumpless_io::{modbus::Table, scan::ScanPlan};
pub use forces::{ForceDraft, ForceView};
pub use jobs::{Block, JobDraft, JobState, JobTask, JobView};

/// What is wanted of an I/O host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum FieldAsk {
    /// One point.
    Point(PointId),
    /// Write a point that no loop writes: the value, and who asks.
    Write(PointId, f64, String),
    /// Hold a point at a value.
    Force(PointId, ForceDraft),
    /// Let it go again; who asks.
    Unforce(PointId, String),
    /// The buses.
    Buses,
    /// Take a job.
    StartJob(JobDraft),
    /// All jobs that are still known.
    Jobs,
    /// One job, with its result.
    Job(u64),
    /// End one; who asks.
    CancelJob(u64, String),
    /// To the other master of a device: the newest wishes about forces that the asker knows.
    Forces(Vec<marks::SharedMark>),
}

/// What an I/O host answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum FieldTold {
    /// A point as it is now.
    Point(Box<PointView>),
    /// The buses.
    Buses(Vec<BusView>),
    /// Jobs.
    Jobs(Vec<JobView>),
    /// What this host knows better of forces.
    Forces(Vec<marks::SharedMark>),
}

/// A bus as its host sees it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct BusView {
    /// Its host.
    pub host: HostId,
    /// The bus.
    pub id: String,
    /// `sim` or `modbus-tcp`.
    pub driver: String,
    /// Does the device answer?
    pub connected: bool,
    /// Points that it owns.
    pub points: u64,
    /// Requests answered well.
    pub polls: u64,
    /// Writes that the device took.
    pub writes: u64,
    /// Requests and connections that failed, and writes that were given up.
    pub errors: u64,
    /// What went wrong last; none where nothing did. Stays after recovery.
    pub last_error: Option<String>,
    /// Time of the last request, in µs.
    pub latency_us: u64,
    /// Named jobs, with a line for people.
    pub jobs: Vec<(String, String)>,
    /// Jobs that wait or run.
    pub jobs_waiting: u32,
    /// Of a device with two masters: this host's part.
    pub master: Option<MasterPart>,
}

/// The part of a host in a device with two masters.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MasterPart {
    /// The other host.
    pub with: String,
    /// The number of the mastership, while this host has it.
    pub epoch: Option<u32>,
    /// Its own connection works: it is master, or could take over.
    pub ready: bool,
    /// Forces of the device's points that this host knows of; the same on both hosts, a moment after one began or ended.
    pub forces: u32,
}

/// What happened to a point or a job. A feed that lags loses the oldest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum FieldEvent {
    /// A job was taken in, began, or ended. Without its result.
    Job(JobView),
    /// A point is held at a value.
    Forced {
        /// The point.
        point: PointId,
        /// Its host.
        host: HostId,
        /// The value, by whom, why and until when.
        force: ForceView,
    },
    /// A point is held no more.
    Unforced {
        /// The point.
        point: PointId,
        /// Its host.
        host: HostId,
        /// By whom, or that its time was over.
        by: String,
    },
    /// A point was written by hand.
    Written {
        /// The point.
        point: PointId,
        /// Its host.
        host: HostId,
        /// The value.
        value: f64,
        /// By whom.
        by: String,
    },
    /// A host that stands by for another's device can take it over no more, or can again.
    Standby {
        /// The bus.
        bus: String,
        /// The host that stands by.
        host: HostId,
        /// The one that it stands by for.
        with: HostId,
        /// It could take over.
        ready: bool,
        /// Why not; empty where it could.
        reason: String,
    },
}

/// What a host keeps of it.
pub(crate) struct Commissioning {
    forces: forces::Forces,
    jobs: jobs::Jobs,
    standbys: standby::Standbys,
    events: broadcast::Sender<FieldEvent>,
}

impl Commissioning {
    /// Reads what is on disk.
    pub(crate) fn new(store: &Store, clock: Clock) -> Result<Self, Error> {
        Ok(Self {
            forces: forces::Forces::open(store)?,
            jobs: jobs::Jobs::new(store.count_up("jobs-start")?, clock),
            standbys: standby::Standbys::default(),
            events: broadcast::Sender::new(FIELD_EVENTS),
        })
    }

    /// Passes an event on to those who listen here. Nobody listening is no error.
    pub(crate) fn tell(&self, event: FieldEvent) {
        let _ = self.events.send(event);
    }

    pub(crate) fn subscribe(&self) -> broadcast::Receiver<FieldEvent> {
        self.events.subscribe()
    }

    pub(crate) fn force_of(&self, point: &PointId) -> Option<ForceView> {
        self.forces.of(point)
    }
}
