//! Free-running programs of the cell: what people write about them, what they are shown, and this host's part.
//!
//! ```text
//!   person ──► any host ──► home (serves the points): spec, owner and term, checkpoint, on its disk
//!                              │ each second, and when something changes: who runs what?     ▲ reads, writes under the term,
//!                              └── run, pause, end ──► owner (any control host): the run ────┘ checkpoints
//!   owner goes ──► home: next term, next host, from the last checkpoint. What the old one still writes has an old term.
//! ```
//! Owns: drafts and views; the desks of programs at home here; the runs here. Never: a decision about a cycle.

mod arm;
mod home;
mod owner;

use std::{
    collections::BTreeMap,
    sync::{Arc, atomic::AtomicU64},
};

use bumpless_core::{
    Fence, HostId, LogLevel, LoopId, PointId, ProgramId, ProgramSpec, Reading,
    program::{Status, Wanted},
};
use bumpless_programs::{Line, Runner};
use bumpless_store::Store;
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::sync::Notify;

use crate::error::{Error, Words, chain};

/// Programs that one host is home to: each has a row on the disk and a look a second.
pub const PROGRAMS_MAX: usize = 10_000;
/// Lines that one look at a log gives at most.
pub const LINES_MAX: u32 = 500;

const fn share() -> u8 {
    25
}

const fn memory() -> u64 {
    8 * 1024 * 1024
}

const fn starts() -> bool {
    true
}

/// A point that a program is granted, as people write it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GrantDraft {
    /// The point.
    pub point: String,
    /// May the program write it?
    #[serde(default)]
    pub write: bool,
    /// What the program reads and writes at the two ends of the point's range; the point's own unit where not given.
    #[serde(default)]
    pub raw: Option<(f64, f64)>,
}

/// A program as people write it: TOML in a file, JSON over the API.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProgramDraft {
    /// Its name.
    pub name: String,
    /// The component: `name`, `name@version`, or a digest or its beginning.
    pub component: String,
    /// Points by the program's names for them. All are of one host, which is the program's home.
    #[serde(default)]
    pub grants: BTreeMap<String, GrantDraft>,
    /// Topics that it may publish on; one that ends in `*` is a beginning.
    #[serde(default)]
    pub publishes: Vec<String>,
    /// Topics that it may listen to; the same.
    #[serde(default)]
    pub listens: Vec<String>,
    /// Names of components whose steps it may ask for.
    #[serde(default)]
    pub components: Vec<String>,
    /// Its part of one processor, in percent.
    #[serde(default = "share")]
    pub share_percent: u8,
    /// Its memory at most, in bytes.
    #[serde(default = "memory")]
    pub memory_bytes: u64,
    /// Names and labels of hosts where it would rather run, the best first.
    #[serde(default)]
    pub prefer: Vec<String>,
    /// Does it run at once?
    #[serde(default = "starts")]
    pub start: bool,
}

/// What a person may ask of a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum ProgramOrder {
    /// Run: from the last checkpoint, unless it runs already.
    Start,
    /// End. Its checkpoint stays.
    Stop,
    /// Stand where it is.
    Pause,
    /// Go on.
    Resume,
}

/// How a run is, as its owner says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunTold {
    /// The program.
    pub id: ProgramId,
    /// The ownership under which it runs.
    pub term: u64,
    /// What it does.
    pub status: Status,
    /// Why it is in fault.
    pub reason: String,
    /// Processor time, in ns.
    pub used_ns: u64,
    /// Linear memory, in bytes.
    pub memory_bytes: u64,
    /// Time since its start, in ms.
    pub up_ms: u64,
    /// Lines that it wrote, and how many of them were dropped.
    pub lines: (u64, u64),
}

/// A program as it is shown.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProgramView {
    /// As it shall be.
    pub spec: ProgramSpec,
    /// Who runs it, or ran it last.
    pub fence: Fence,
    /// What it does.
    pub status: Status,
    /// Why it is in fault, or why it does not run yet.
    pub reason: String,
    /// Its run; none where nothing is known of one.
    pub run: Option<RunTold>,
    /// Bytes of its checkpoint; none where it saved none.
    pub checkpoint_bytes: Option<u64>,
}

/// A line of a program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LineView {
    /// Counts the lines of the run, from 1.
    pub number: u64,
    /// When, in ms since the run began.
    pub at_ms: u64,
    /// How much it matters.
    pub level: LogLevel,
    /// Its text.
    pub text: String,
}

impl From<Line> for LineView {
    fn from(line: Line) -> Self {
        Self {
            number: line.number,
            at_ms: line.at_ms,
            level: line.level,
            text: line.text,
        }
    }
}

/// The programs of the cell, and the hosts that did not say.
#[derive(Debug, Clone, PartialEq)]
pub struct ProgramList {
    /// By name.
    pub programs: Vec<ProgramView>,
    /// Hosts that did not answer, and why.
    pub silent: Vec<(HostId, String)>,
}

/// What hosts ask each other about programs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum ProgramAsk {
    /// To the home: there shall be this one.
    Create(Box<ProgramDraft>),
    /// To the home: a person's order.
    Order(ProgramId, ProgramOrder),
    /// To the home: end it and forget it.
    Remove(ProgramId),
    /// The programs at home there.
    List,
    /// To the home: one of them.
    Show(ProgramId),
    /// To the home: lines after one of that number, at most so many.
    Log(ProgramId, u64, u32),
    /// To the home: what it saved.
    Checkpoint(ProgramId),
    /// To an owner: what runs there for the asker.
    Runs,
    /// To an owner: run this under this term.
    Run(Box<ProgramSpec>, u64, Option<Vec<u8>>),
    /// To an owner: stand still, or go on.
    Pause(ProgramId, bool),
    /// To an owner: end it.
    End(ProgramId),
    /// To an owner: lines.
    Lines(ProgramId, u64, u32),
    /// To the home, under a term: what a grant shows.
    Read(ProgramId, u64, u32),
    /// To the home, under a term: write a grant.
    Write(ProgramId, u64, u32, f64),
    /// To the home, under a term: keep this.
    Save(ProgramId, u64, Vec<u8>),
}

/// What is answered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum ProgramTold {
    /// It is done.
    Done,
    /// Programs.
    Views(Vec<ProgramView>),
    /// Lines.
    Lines(Vec<LineView>),
    /// A checkpoint.
    Checkpoint(Option<Vec<u8>>),
    /// Runs.
    Runs(Vec<RunTold>),
    /// A reading, and the age of its value in ns.
    Sight(Reading, u64),
}

/// A program at home here, as it is on disk.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Desk {
    pub(crate) spec: ProgramSpec,
    pub(crate) fence: Fence,
    pub(crate) checkpoint: Option<Vec<u8>>,
}

/// A desk with what was heard of its run.
#[derive(Debug)]
pub(crate) struct Kept {
    pub(crate) desk: Desk,
    pub(crate) run: Option<RunTold>,
    /// Why it does not run, though it shall.
    pub(crate) hindrance: String,
    /// Writes so far, for the actuators' journal.
    pub(crate) writes: u64,
}

/// This host's part.
pub(crate) struct Programs {
    pub(crate) runner: Runner,
    pub(crate) desks: Mutex<BTreeMap<ProgramId, Kept>>,
    /// The greatest term that was given, of any program: one that is removed and comes again must not meet its own past.
    pub(crate) last_term: AtomicU64,
    /// Held while a desk is changed, so that what is older never overwrites what is newer on the disk.
    pub(crate) changing: tokio::sync::Mutex<()>,
    pub(crate) poke: Notify,
}

impl Programs {
    /// Reads what is at home here, and begins a term of each: writes are counted from anew in this life. Blocks.
    pub(crate) fn open(store: &Store) -> Result<Self, Error> {
        let runner = Runner::start().map_err(|error| Error::Internal(Words::new(chain(&error), "")))?;
        let (mut desks, mut last_term) = (BTreeMap::new(), 0);
        for (_, mut desk) in store.programs::<Desk>()? {
            desk.fence = desk.fence.given_to(desk.fence.owner.clone());
            store.put_program(desk.spec.id.as_str(), &desk)?;
            last_term = last_term.max(desk.fence.term);
            desks.insert(desk.spec.id.clone(), Kept::new(desk));
        }
        Ok(Self {
            runner,
            desks: Mutex::new(desks),
            last_term: AtomicU64::new(last_term),
            changing: tokio::sync::Mutex::default(),
            poke: Notify::new(),
        })
    }

    /// The program that may write this point, by a name for people.
    pub(crate) fn writer_of(&self, point: &PointId) -> Option<LoopId> {
        let desks = self.desks.lock();
        let writer = desks
            .values()
            .find(|kept| kept.desk.spec.written().any(|written| written == point))?;
        let id = &writer.desk.spec.id;
        LoopId::new(format!("program.{id}"))
            .or_else(|_| LoopId::new(id.as_str()))
            .ok()
    }

    /// Digests that programs at home here need, with their names.
    pub(crate) fn users(&self, digest: &bumpless_core::Digest) -> Vec<ProgramId> {
        let desks = self.desks.lock();
        desks
            .values()
            .filter(|kept| kept.desk.spec.digest == *digest)
            .map(|kept| kept.desk.spec.id.clone())
            .collect()
    }
}

impl Kept {
    pub(crate) fn new(desk: Desk) -> Self {
        Self {
            desk,
            run: None,
            hindrance: String::new(),
            writes: 0,
        }
    }

    pub(crate) fn view(&self) -> ProgramView {
        let run = self.run.as_ref().filter(|run| run.term == self.desk.fence.term);
        let (status, reason) = match (self.desk.spec.wanted, run) {
            (Wanted::Stopped, Some(run)) if run.status == Status::Fault => (Status::Fault, run.reason.clone()),
            (Wanted::Stopped, _) => (Status::Stopped, String::new()),
            (_, Some(run)) => (run.status, run.reason.clone()),
            (_, None) => (Status::Stopped, self.hindrance.clone()),
        };
        ProgramView {
            spec: self.desk.spec.clone(),
            fence: self.desk.fence.clone(),
            status,
            reason,
            run: run.cloned(),
            checkpoint_bytes: self.desk.checkpoint.as_ref().map(|bytes| bytes.len() as u64),
        }
    }
}

/// The error for a program that is not at home here.
pub(crate) fn no_program(id: &ProgramId) -> Error {
    Error::not_found(format!("there is no program {id}"), "list the programs for their names")
}

/// Shared by what reaches out of a run.
pub(crate) type Spec = Arc<ProgramSpec>;
