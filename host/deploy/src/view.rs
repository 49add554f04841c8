//! What the outside sees of a cell: plain data, copied out, never read back as intent.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{
    Applied, ComponentInfo, Digest, HostId, LoopId, LoopSpec, Mode, PointId, Quality, Record, desk::Tally,
};

use crate::error::Error;

/// A component and where it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct ComponentView {
    /// What it is.
    pub info: ComponentInfo,
    /// Loops that run it, or keep it to go back to.
    pub used_by: Vec<LoopId>,
    /// Hosts that hold it compiled.
    pub ready_on: Vec<HostId>,
}

/// How a component comes in.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Upload {
    /// Who uploads it, at most 512 characters.
    pub by: String,
    /// What there is to say about it, at most 512 characters.
    pub note: String,
    /// What it is sorted by; see [`bumpless_core::component::check_label`].
    pub labels: BTreeMap<String, String>,
    /// Take it in even where its trial refuses it. Its report says who did so.
    pub force: bool,
    /// The bytes are a script of this name, for the interpreter of the library.
    pub script: Option<String>,
}

/// A change of what people wrote about a component.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Relabel {
    /// Who changes it, at most 512 characters.
    pub by: String,
    /// Another note; none where it stays.
    pub note: Option<String>,
    /// Labels to set, and to remove where there is no value.
    pub labels: BTreeMap<String, Option<String>>,
}

/// What became of one component of a bundle.
#[derive(Debug, Clone, PartialEq)]
pub struct Imported {
    /// What the bundle calls it.
    pub name: String,
    /// The component, or why it was not taken in.
    pub end: Result<ComponentInfo, Error>,
    /// Was it in the library before? Then nothing changed.
    pub known: bool,
}

/// How far a host is with a component.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Stage {
    /// It has nothing of it.
    Nothing,
    /// It has its bytes, and compiles it when it is needed.
    Bytes,
    /// It is compiling it, or about to.
    Compiling,
    /// It can be stepped there.
    Ready,
    /// It could not be compiled or loaded; it is tried again.
    Failed(String),
    /// The host did not say, and why.
    Unknown(String),
}

/// A host and how far it is with a component.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StageView {
    /// The host.
    pub host: HostId,
    /// How far it is.
    pub stage: Stage,
}

/// A loop as a host sees it.
#[derive(Debug, Clone, PartialEq)]
pub struct LoopView {
    /// The loop.
    pub id: LoopId,
    /// Its I/O host.
    pub home: HostId,
    /// The revision in force.
    pub spec: LoopSpec,
    /// A revision on its way.
    pub pending: Option<u64>,
    /// Revisions that can be gone back to, newest first.
    pub past: Vec<u64>,
    /// `name@version` of the component in force, or its short digest where the library does not know it.
    pub component: String,
    /// The last record that this host saw.
    pub last: Option<Arc<Record>>,
    /// Age of that record, in ms by this host's clock since it arrived.
    pub last_age_ms: Option<u64>,
    /// Live members in rank order, as far as this host knows.
    pub members: Vec<HostId>,
    /// Counts; only the home has them.
    pub tally: Option<Tally>,
    /// What this host could not do for the loop.
    pub failures: Vec<FailureView>,
}

/// Something that this host shall do for a loop, could not, and tries again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FailureView {
    /// The revision that it is about.
    pub revision: u64,
    /// What went wrong.
    pub reason: String,
    /// How often it was tried.
    pub tries: u32,
}

/// Empties a host, or lets it take loops again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct DrainOrder {
    /// Shall it be emptied?
    pub drain: bool,
    /// Does that hold over a restart? Only of meaning with `drain`.
    pub keep: bool,
}

/// How far a host is with an order to drain.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct DrainEnd {
    /// The host.
    pub host: HostId,
    /// Is it being emptied?
    pub draining: bool,
    /// Does that hold over a restart?
    pub kept: bool,
    /// Loops that it still owns. More than none after an order to drain: nobody else can take them, or their next cycle is
    /// yet to come.
    pub loops_owned: u32,
    /// Loops that it holds.
    pub loops_held: u32,
    /// Does it hold all that it shall? After an order to take loops again: whether it is ready to be a replica of each.
    pub ready: bool,
}

/// A host as another sees it.
#[derive(Debug, Clone, PartialEq)]
pub struct HostView {
    /// The host.
    pub id: HostId,
    /// Is it this one?
    pub here: bool,
    /// Is it alive by liveliness and fresh vitals?
    pub alive: bool,
    /// Serves I/O.
    pub io: bool,
    /// Runs controllers.
    pub control: bool,
    /// Is it being emptied?
    pub draining: bool,
    /// Does it stay so over a restart?
    pub drain_kept: bool,
    /// Words that it goes by besides its name.
    pub labels: Vec<String>,
    /// Address of its API.
    pub api: Option<String>,
    /// Load of the cores that it may use, 0 to 1.
    pub cpu: f32,
    /// Its own use, in cores.
    pub cpu_process: f32,
    /// Resident bytes.
    pub memory_bytes: u64,
    /// Smoothed latency of a step there, as this host measures it, in ns.
    pub latency_ns: Option<u64>,
    /// Loops it owns now.
    pub loops_owned: u32,
    /// Loops it holds.
    pub loops_held: u32,
    /// Program version.
    pub version: String,
}

/// A point as its I/O host sees it.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PointView {
    /// The point.
    pub id: PointId,
    /// Its I/O host.
    pub host: HostId,
    /// Its bus.
    pub bus: String,
    /// Unit.
    pub unit: String,
    /// Least and greatest value.
    pub range: (f64, f64),
    /// May it be written?
    pub writable: bool,
    /// Value now, or the last good one.
    pub value: Option<f64>,
    /// How far it may be trusted.
    pub quality: Quality,
    /// Why there is no value, in words; empty where there is one.
    pub reason: String,
    /// Age of the value, in ms.
    pub age_ms: u64,
    /// The loop that writes it, if any.
    pub written_by: Option<LoopId>,
    /// One line for people.
    pub text: String,
    /// Who holds it at its value by hand, and until when; none where nobody does.
    pub force: Option<crate::commissioning::ForceView>,
}

/// How an `apply` ended.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ApplyEnd {
    /// The loop.
    pub id: LoopId,
    /// The revision in force now.
    pub revision: u64,
    /// Was the loop new?
    pub created: bool,
    /// Nothing differed, so nothing was done.
    pub unchanged: bool,
    /// How a change of a running loop went: hand-over and bump.
    pub hand_over: Option<HandOverView>,
    /// Parameters of the old component that the new one does not have, or not with that value: left out of a swap.
    pub dropped_parameters: Vec<String>,
    /// Input ports that the new component does not have: disconnected in a swap.
    pub dropped_ports: Vec<String>,
    /// What to look at, for example a step that came near the loop's limit when the component was tried.
    pub warnings: Vec<String>,
}

/// How a state came over, as the committed record says.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct HandOverView {
    /// "same", "migrate" or "start".
    pub by: String,
    /// Output step beyond what the old controller would have done, in % of span.
    pub bump_percent: f64,
    /// Digest before.
    pub from_digest: Digest,
}

/// How a command ended: it is part of a committed record.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct CommandEnd {
    /// Its id and outcome.
    pub applied: Applied,
    /// Position of the record that holds it.
    pub position: (u64, u64),
    /// Mode in force with that record.
    pub mode: Mode,
    /// Setpoint in force with that record.
    pub setpoint: f64,
}

/// A step asked for from outside: the cell as a control service.
#[derive(Debug, Clone, PartialEq)]
pub struct Call {
    /// Component reference, as in a loop file.
    pub component: String,
    /// How the replica is chosen.
    pub strategy: bumpless_core::Strategy,
    /// Parameters by name; defaults for the rest. Used where `state` is none.
    pub parameters: BTreeMap<String, f64>,
    /// State from the call before; none for a first step.
    pub state: Option<Vec<u8>>,
    /// What the outputs hold, by output port name.
    pub track: BTreeMap<String, f64>,
    /// Input values by port name.
    pub inputs: BTreeMap<String, f64>,
    /// Wanted value.
    pub setpoint: f64,
    /// Who decides the output.
    pub mode: Mode,
    /// Time since the call before, in ns; at least 1.
    pub dt_ns: u64,
    /// Number of the call; chooses the turn in round-robin.
    pub seq: u64,
}

/// What a call gave.
#[derive(Debug, Clone, PartialEq)]
pub struct CallEnd {
    /// The host that stepped.
    pub host: HostId,
    /// State for the next call.
    pub state: Vec<u8>,
    /// Outputs by port name.
    pub outputs: BTreeMap<String, f64>,
    /// Time inside the component, in ns.
    pub step_ns: u64,
    /// Time until the answer, network included, in ns.
    pub total_ns: u64,
}

/// What this host counts, for metrics. Counts only grow until the process ends; the others are as of now.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Counters {
    /// Hosts that are alive, this one included (as of now).
    pub hosts_alive: u64,
    /// Loops known to this host (as of now).
    pub loops_known: u64,
    /// Loops whose home is here (as of now).
    pub loops_home: u64,
    /// Loops held here, owned or standing by (as of now).
    pub loops_held: u64,
    /// Loops owned here (as of now).
    pub loops_owned: u64,
    /// Programs whose home is here (as of now).
    pub programs_home: u64,
    /// Programs that run here or stand paused (as of now).
    pub programs_running: u64,
    /// Programs whose last run here ended in a fault (as of now).
    pub programs_faulted: u64,
    /// Programs of other homes that are copied here (as of now).
    pub programs_copied: u64,
    /// Components in the library (as of now).
    pub components: u64,
    /// Records that reached this host, own ones included.
    pub records: u64,
    /// Cycles taken, over all loops whose home is here.
    pub cycles_taken: u64,
    /// Cycles lost.
    pub cycles_lost: u64,
    /// Cycles that the home itself came too late for.
    pub cycles_skipped: u64,
    /// Changes of ownership after a silence.
    pub takeovers: u64,
    /// Commits refused by the arbiter.
    pub commits_refused: u64,
    /// Components taken in.
    pub uploads: u64,
    /// Components refused.
    pub uploads_refused: u64,
    /// Changes of loops that ended well, at this home.
    pub applies: u64,
    /// Changes of loops that were refused, at this home.
    pub applies_refused: u64,
    /// Components fetched from other hosts.
    pub fetches: u64,
    /// Fetches that failed; every host that was asked counts.
    pub fetches_failed: u64,
    /// Fetched bytes whose digest was wrong.
    pub fetches_corrupt: u64,
    /// Revisions that could not be made ready here; each try counts.
    pub prepares_failed: u64,
    /// Requests from other hosts that were answered.
    pub requests: u64,
    /// Messages from other hosts that could not be read.
    pub malformed: u64,
    /// Messages for deploy that were dropped because its queue was full.
    pub arrivals_dropped: u64,
    /// Cycles of loops at home here that are in the log on disk, counted since the host started.
    pub cycles_recorded: u64,
    /// Cycles that the log dropped because too many waited for the disk.
    pub cycles_unrecorded: u64,
    /// Pieces of the log that could not be read; each try counts.
    pub cycle_log_damaged: u64,
    /// Bytes of the log (as of now).
    pub cycle_log_bytes: u64,
    /// Entries of the audit trail, those that were removed too.
    pub audit_entries: u64,
    /// Bytes of the audit trail on disk (as of now).
    pub audit_bytes: u64,
    /// Entries that wait for the disk (as of now).
    pub audit_waiting: u64,
    /// Times that the disk refused entries.
    pub audit_refused: u64,
    /// Entries that were lost because the disk refused them for too long.
    pub audit_lost: u64,
    /// Alarms that stand and are not kept quiet, loops at home here (as of now).
    pub alarms_standing: u64,
    /// Alarms that wait for a person (as of now).
    pub alarms_unacknowledged: u64,
    /// Alarms that stand for more than a day (as of now).
    pub alarms_stale: u64,
    /// Alarms that are shelved, suppressed, or out of service (as of now).
    pub alarms_quiet: u64,
    /// Alarms that came in the last ten minutes (as of now).
    pub alarms_recent: u64,
    /// How far this host's clock is off, in ms (as of now).
    pub clock_offset_ms: i64,
    /// Room on the disk, in bytes (as of now); none where it is not known.
    pub disk_free_bytes: Option<u64>,
    /// How its webhooks do.
    pub webhooks: Vec<crate::webhook::WebhookView>,
    /// Cycles and values of points that are in the history.
    pub history_taken: u64,
    /// Those that are not, because too many waited or the disk took nothing.
    pub history_dropped: u64,
    /// Blocks of the history that could not be read; each reading counts.
    pub history_damaged: u64,
    /// Bytes of the history that were left out at the start because a write had broken off.
    pub history_cut_bytes: u64,
    /// Bytes of the history's files.
    pub history_bytes: u64,
    /// Does the disk take no history now?
    pub history_failing: bool,
}
