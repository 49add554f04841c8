//! Points by hand, buses and jobs.

use bumpless_core::HostId;
use bumpless_deploy::{
    Error as DeployError,
    audit::Asker,
    commissioning::{self as model, ForceView, JobTask, ScanPlan},
};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::finite;

/// Who holds a point at its value, and until when.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Force {
    /// In the point's unit.
    pub value: Option<f64>,
    /// Since when, in ms of Unix time.
    pub since_unix_ms: u64,
    /// It ends by itself then, in ms of Unix time.
    pub until_unix_ms: u64,
    /// Who wanted it.
    pub by: String,
    /// Why.
    pub why: String,
}

impl From<ForceView> for Force {
    fn from(view: ForceView) -> Self {
        Self {
            value: finite(view.value),
            since_unix_ms: view.since_unix_ms,
            until_unix_ms: view.until_unix_ms,
            by: view.by,
            why: view.why,
        }
    }
}

/// A value for a point that no loop writes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct WriteRequest {
    /// In the point's unit.
    pub value: f64,
    /// Who writes.
    pub by: String,
}

/// A wish to hold a point at a value, over takeovers and restarts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ForceRequest {
    /// In the point's unit.
    pub value: f64,
    /// For so long, in s: 1 to 86,400.
    pub seconds: u64,
    /// Who wants it.
    pub by: String,
    /// Why: the next shift will ask.
    pub why: String,
}

impl From<ForceRequest> for model::ForceDraft {
    fn from(request: ForceRequest) -> Self {
        Self {
            value: request.value,
            seconds: request.seconds,
            by: Asker::signed(request.by),
            why: request.why,
        }
    }
}

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ByRequest {
    /// Who.
    pub by: String,
}

/// The buses of all hosts, by name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Buses {
    /// The buses.
    pub buses: Vec<Bus>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

/// A bus as its host sees it. Counters count since the host's start.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Bus {
    /// Its name.
    pub name: String,
    /// Its host.
    pub host: String,
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
    /// What went wrong last; stays after recovery.
    pub last_error: Option<String>,
    /// Time of the last request, in µs.
    pub latency_us: u64,
    /// Jobs of its configuration.
    pub jobs: Vec<NamedJob>,
    /// Jobs that wait or run.
    pub jobs_waiting: u32,
    /// The other master of the device; null where there is only one.
    pub redundant: Option<Redundant>,
}

/// The part of a host in a device with two masters.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Redundant {
    /// The other host.
    pub with: String,
    /// The number of the mastership, while this host has it; null while it stands by.
    pub epoch: Option<u32>,
    /// Its own connection works: it is master, or could take over.
    pub ready: bool,
    /// Forces of the device's points that this host knows of; the same on both hosts, a moment after one began or ended.
    pub forces: u32,
}

/// A job of a bus's configuration.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct NamedJob {
    /// Its name.
    pub name: String,
    /// One line for people.
    pub text: String,
}

impl From<model::BusView> for Bus {
    fn from(view: model::BusView) -> Self {
        Self {
            name: view.id,
            host: view.host.to_string(),
            driver: view.driver,
            connected: view.connected,
            points: view.points,
            polls: view.polls,
            writes: view.writes,
            errors: view.errors,
            last_error: view.last_error,
            latency_us: view.latency_us,
            jobs: view
                .jobs
                .into_iter()
                .map(|(name, text)| NamedJob { name, text })
                .collect(),
            jobs_waiting: view.jobs_waiting,
            redundant: view.master.map(|part| Redundant {
                with: part.with,
                epoch: part.epoch,
                ready: part.ready,
                forces: part.forces,
            }),
        }
    }
}

/// The four address spaces of a Modbus device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Table {
    /// Bits to read and write.
    Coil,
    /// Bits to read.
    Discrete,
    /// Registers to read and write.
    Holding,
    /// Registers to read.
    Input,
}

impl From<model::Table> for Table {
    fn from(table: model::Table) -> Self {
        match table {
            model::Table::Coil => Self::Coil,
            model::Table::Discrete => Self::Discrete,
            model::Table::Holding => Self::Holding,
            model::Table::Input => Self::Input,
        }
    }
}

impl From<Table> for model::Table {
    fn from(table: Table) -> Self {
        match table {
            Table::Coil => Self::Coil,
            Table::Discrete => Self::Discrete,
            Table::Holding => Self::Holding,
            Table::Input => Self::Input,
        }
    }
}

impl Table {
    /// The word as JSON has it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Coil => "coil",
            Self::Discrete => "discrete",
            Self::Holding => "holding",
            Self::Input => "input",
        }
    }
}

/// A wish for a job. Exactly one of `name`, `write_block`, `read_block` and `scan` says what to do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct JobRequest {
    /// The bus.
    pub bus: String,
    /// Its host, where several hosts have a bus of that name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub host: Option<String>,
    /// A job of the bus's configuration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Writes neighbours.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub write_block: Option<WriteBlock>,
    /// Reads neighbours.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub read_block: Option<ReadBlock>,
    /// Looks which units and addresses answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scan: Option<ScanRequest>,
    /// Who wants it.
    pub by: String,
    /// The client's own name for the wish: asked again with it, it is done once, for as long as the host knows the job.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key: Option<String>,
    /// Longest wait for its turn, in ms; 60,000 where not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub queue_ms: Option<u64>,
    /// Longest time once it runs, in ms; the configuration's, or 30,000, where not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout_ms: Option<u64>,
}

/// Values for neighbouring addresses, in as many requests as it takes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct WriteBlock {
    /// The unit; the bus's where none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit_id: Option<u8>,
    /// `coil` or `holding`.
    pub table: Table,
    /// First address, from 0.
    pub address: u16,
    /// Registers, or coils as 0 and 1; at most 20,000.
    pub values: Vec<u16>,
    /// Read back and compared; true where not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verify: Option<bool>,
}

/// Neighbouring addresses, in as many requests as it takes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ReadBlock {
    /// The unit; the bus's where none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit_id: Option<u8>,
    /// The address space.
    pub table: Table,
    /// First address, from 0.
    pub address: u16,
    /// How many; at most 20,000.
    pub count: u16,
}

/// What to look at. What is left out: units 1 to 10, all tables, addresses 0 to 99, 300 ms, a pause of 10 ms.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ScanRequest {
    /// The units.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub units: Option<Vec<u8>>,
    /// The address spaces.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tables: Option<Vec<Table>>,
    /// First address, from 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first: Option<u16>,
    /// Last address.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last: Option<u16>,
    /// Longest wait for an answer, in ms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timeout_ms: Option<u64>,
    /// Pause between two requests, in ms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pause_ms: Option<u64>,
}

impl From<ScanRequest> for ScanPlan {
    fn from(request: ScanRequest) -> Self {
        let usual = Self::default();
        Self {
            units: request.units.unwrap_or(usual.units),
            tables: request
                .tables
                .map_or(usual.tables, |tables| tables.into_iter().map(Into::into).collect()),
            first: request.first.unwrap_or(usual.first),
            last: request.last.unwrap_or(usual.last),
            timeout_ms: request.timeout_ms.unwrap_or(usual.timeout_ms),
            pause_ms: request.pause_ms.unwrap_or(usual.pause_ms),
        }
    }
}

/// Longest wait for its turn where the asker names none, in ms.
const QUEUE_MS_DEFAULT: u64 = 60_000;

impl TryFrom<JobRequest> for model::JobDraft {
    type Error = DeployError;
    fn try_from(request: JobRequest) -> Result<Self, DeployError> {
        let invalid = |reason: &str| {
            DeployError::invalid(
                reason.to_owned(),
                "give exactly one of name, write_block, read_block and scan",
            )
        };
        let task = match (request.name, request.write_block, request.read_block, request.scan) {
            (Some(name), None, None, None) => JobTask::Named(name),
            (None, Some(block), None, None) => JobTask::WriteBlock {
                unit_id: block.unit_id,
                table: block.table.into(),
                address: block.address,
                values: block.values,
                verify: block.verify.unwrap_or(true),
            },
            (None, None, Some(block), None) => JobTask::ReadBlock {
                unit_id: block.unit_id,
                table: block.table.into(),
                address: block.address,
                count: block.count,
            },
            (None, None, None, Some(scan)) => JobTask::Scan(scan.into()),
            (None, None, None, None) => return Err(invalid("the job does nothing")),
            _ => return Err(invalid("the job is several jobs")),
        };
        let host = request
            .host
            .map(HostId::new)
            .transpose()
            .map_err(|error| DeployError::invalid(error.to_string(), ""))?;
        Ok(Self {
            host,
            bus: request.bus,
            task,
            key: request.key,
            by: Asker::signed(request.by),
            queue_ms: request.queue_ms.unwrap_or(QUEUE_MS_DEFAULT),
            timeout_ms: request.timeout_ms,
        })
    }
}

/// Where a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum JobState {
    /// It waits for its turn.
    Queued,
    /// Its steps are under way.
    Running,
    /// All steps are done.
    Done,
    /// A step failed; the rest was not done.
    Failed,
    /// It was cancelled; steps before that are done.
    Cancelled,
    /// Its time was over, waiting or running.
    Expired,
}

impl From<model::JobState> for JobState {
    fn from(state: model::JobState) -> Self {
        match state {
            model::JobState::Queued => Self::Queued,
            model::JobState::Running => Self::Running,
            model::JobState::Done => Self::Done,
            model::JobState::Failed => Self::Failed,
            model::JobState::Cancelled => Self::Cancelled,
            model::JobState::Expired => Self::Expired,
        }
    }
}

impl JobState {
    /// The word as JSON has it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Expired => "expired",
        }
    }

    /// Is it over?
    #[must_use]
    pub const fn ended(self) -> bool {
        !matches!(self, Self::Queued | Self::Running)
    }
}

/// The jobs of all hosts, oldest first, without their results.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Jobs {
    /// The jobs.
    pub jobs: Vec<Job>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

/// A job.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Job {
    /// Its name in the cell: `HOST.NUMBER`.
    pub id: String,
    /// Its host.
    pub host: String,
    /// Its bus.
    pub bus: String,
    /// What it does: the name of a job of the configuration, `write-block`, `read-block` or `scan`.
    pub task: String,
    /// Who wanted it.
    pub by: String,
    /// The client's name for it.
    pub key: Option<String>,
    /// Where it stands.
    pub state: JobState,
    /// Jobs of its bus before it, while it is queued.
    pub ahead: u32,
    /// The step that it is at, from 1; 0 before it runs.
    pub step: u32,
    /// Steps in all.
    pub steps: u32,
    /// Why it ended otherwise than done; also what a scan could not finish.
    pub reason: String,
    /// What it read so far, or what a scan found.
    pub result: Vec<Block>,
    /// When it was taken in, in ms of Unix time.
    pub asked_unix_ms: u64,
    /// When it began to run.
    pub began_unix_ms: Option<u64>,
    /// When it ended.
    pub ended_unix_ms: Option<u64>,
}

/// Values that a job read, or a stretch that a scan found (then without values).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Block {
    /// The unit.
    pub unit_id: u8,
    /// The address space.
    pub table: Table,
    /// First address.
    pub address: u16,
    /// How many addresses.
    pub count: u32,
    /// The values; none of a scan.
    pub values: Vec<u16>,
}

impl From<model::JobView> for Job {
    fn from(view: model::JobView) -> Self {
        let block = |block: model::Block| Block {
            unit_id: block.unit_id,
            table: block.table.into(),
            address: block.address,
            count: block.count,
            values: block.values,
        };
        Self {
            id: view.id,
            host: view.host.to_string(),
            bus: view.bus,
            task: view.task,
            by: view.by,
            key: view.key,
            state: view.state.into(),
            ahead: view.ahead,
            step: view.step,
            steps: view.steps,
            reason: view.reason,
            result: view.result.into_iter().map(block).collect(),
            asked_unix_ms: view.asked_unix_ms,
            began_unix_ms: view.began_unix_ms,
            ended_unix_ms: view.ended_unix_ms,
        }
    }
}
