//! Jobs: what a device is asked that takes long. Two replies each: taken in or refused at once, and what became of it later.
//!
//! ```text
//!            ┌ refused: full, unknown, in a loop's way (the first reply: no)
//! asked ─────┤
//!            └► queued ──its turn──► running ──all steps──► done
//!                 │ queue_ms over       │ a step fails ───► failed
//!                 ├──────► expired ◄────┤ timeout_ms over
//!                 └──cancel─► cancelled ◄┘ cancel, between two requests
//! ```
//!
//! Owns: one bounded queue per bus, one job of a bus at a time, and what is told of each. Jobs of different buses run beside
//! each other, and nothing that is answered from memory (points, buses, jobs themselves) waits for any of them.
//! Never: survives the host's process. A client that finds its job gone asks again, with its key.

use bumpless_core::HostId;
use bumpless_io::{modbus::Table, scan::ScanPlan};
use serde::{Deserialize, Serialize};

mod desk;
mod queue;
mod run;

pub(super) use queue::Jobs;

/// What a job shall do.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum JobTask {
    /// A sequence of the bus's configuration, by name.
    Named(String),
    /// Writes neighbouring registers or coils, in as many requests as it takes.
    WriteBlock {
        /// The unit; the bus's where none is named.
        unit_id: Option<u8>,
        /// Coil or holding.
        table: Table,
        /// First address, from 0.
        address: u16,
        /// The values; for coils 0 and 1.
        values: Vec<u16>,
        /// Read back and compared.
        verify: bool,
    },
    /// Reads neighbouring registers or bits, in as many requests as it takes.
    ReadBlock {
        /// The unit; the bus's where none is named.
        unit_id: Option<u8>,
        /// The address space.
        table: Table,
        /// First address, from 0.
        address: u16,
        /// How many.
        count: u16,
    },
    /// Looks which units and addresses answer, on a connection of its own.
    Scan(ScanPlan),
}

impl JobTask {
    fn name(&self) -> &str {
        match self {
            Self::Named(name) => name,
            Self::WriteBlock { .. } => "write-block",
            Self::ReadBlock { .. } => "read-block",
            Self::Scan(_) => "scan",
        }
    }
}

/// A wish for a job.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobDraft {
    /// The host of the bus, where several hosts have one of that name.
    pub host: Option<HostId>,
    /// The bus.
    pub bus: String,
    /// What to do.
    pub task: JobTask,
    /// The client's own name for the wish: asked again with it, it is done once.
    pub key: Option<String>,
    /// Who wants it.
    pub by: String,
    /// Longest wait for its turn, in ms.
    pub queue_ms: u64,
    /// Longest time once it runs, in ms; the configuration's, or 30 s, where none is given.
    pub timeout_ms: Option<u64>,
}

/// Where a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
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

impl JobState {
    /// Is it over?
    #[must_use]
    pub const fn ended(self) -> bool {
        !matches!(self, Self::Queued | Self::Running)
    }
}

/// Values that a job read, or a stretch that a scan found (then without values).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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

/// A job as people see it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobView {
    /// Its name in the cell: host and number.
    pub id: String,
    /// Its host.
    pub host: HostId,
    /// Its bus.
    pub bus: String,
    /// What it does: the sequence's name, `write-block`, `read-block` or `scan`.
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
    /// Why it ended otherwise than done; also what a scan could not finish. Empty where there is nothing to say.
    pub reason: String,
    /// What it read so far.
    pub result: Vec<Block>,
    /// When it was taken in, in ms of Unix time.
    pub asked_unix_ms: u64,
    /// When it began to run.
    pub began_unix_ms: Option<u64>,
    /// When it ended.
    pub ended_unix_ms: Option<u64>,
}
