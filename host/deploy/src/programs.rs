//! Free-running programs of the cell: what people write about them, what they are shown, and this host's part.
//!
//! ```text
//!   person ──► any host ──► home (serves the points): spec, owner and term, checkpoint, on its disk
//!                              │ each second, and when something changes: who runs what?     ▲ reads, writes under the term,
//!                              └── run, pause, end ──► owner (any control host): the run ────┘ checkpoints
//!   owner goes ──► home: next term, next host, from the last checkpoint. What the old one still writes has an old term.
//!   home goes ──► a standby, which has a copy of all that: it is the home, where it can serve the points
//! ```
//! Owns: drafts and views; the desks of programs at home here; copies of others; the runs here. Never: a decision about a cycle.

mod arm;
mod copies;
mod home;
mod keep;
mod owner;
mod standby;

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64},
    },
    time::Instant,
};

use bumpless_core::{
    Digest, Fence, HostId, LogLevel, LoopId, PointId, ProgramId, ProgramSpec, Reading,
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
    /// The host for which it runs.
    pub home: HostId,
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
    /// Hosts that keep copies of it, the first of which goes on with it when its home is gone.
    pub standbys: Vec<HostId>,
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
    /// Is that one at home there?
    Find(ProgramId),
    /// Which programs at home there, or copied there, need this component?
    Uses(Digest),
    /// The programs at home there.
    List,
    /// To the home: one of them.
    Show(ProgramId),
    /// To the home: lines after one of that number, at most so many.
    Log(ProgramId, u64, u32),
    /// To the home: what it saved.
    Checkpoint(ProgramId),
    /// To an owner: what runs there.
    Runs,
    /// To an owner: how that one is; nothing where it did not run there.
    RunOf(ProgramId),
    /// To an owner: run this under this term.
    Run(Box<ProgramSpec>, u64, Option<Vec<u8>>),
    /// To an owner: what runs under this term stands still, or goes on.
    Pause(ProgramId, u64, bool),
    /// To an owner: what runs under this term or an earlier one ends.
    End(ProgramId, u64),
    /// The same, and it is forgotten with its lines.
    Forget(ProgramId, u64),
    /// To an owner: lines.
    Lines(ProgramId, u64, u32),
    /// To the home, under a term: what a grant shows.
    Read(ProgramId, u64, u32),
    /// To the home, under a term: write a grant.
    Write(ProgramId, u64, u32, f64),
    /// To the home, under a term: keep this.
    Save(ProgramId, u64, Vec<u8>),
    /// To a standby: keep copies of these. To a home of earlier: these are at home at the asker now.
    Copies(Vec<Desk>),
    /// To a standby: this one was removed, as of this term.
    Removed(ProgramId, u64),
    /// To a home: the asker has copies of these. Shall it keep them?
    Kept(Vec<ProgramId>),
    /// To a home that knows nothing of it: this is a copy.
    Return(Box<Desk>),
    /// To any host: what is known of these there?
    Known(Vec<ProgramId>),
}

/// What is answered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum ProgramTold {
    /// It is done.
    Done,
    /// Programs.
    Views(Vec<ProgramView>),
    /// Their names.
    Names(Vec<ProgramId>),
    /// Lines.
    Lines(Vec<LineView>),
    /// A checkpoint.
    Checkpoint(Option<Vec<u8>>),
    /// Runs.
    Runs(Vec<RunTold>),
    /// A reading, and the age of its value in ns.
    Sight(Reading, u64),
    /// What became of each copy.
    Copied(Vec<Copied>),
    /// What is known of each program.
    Known(Vec<Option<Known>>),
}

/// What a host says of a copy that it was given, or that another one has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) enum Copied {
    /// It is kept, or shall be.
    Kept,
    /// It is at home here, and this is newer.
    Newer(Box<Desk>),
    /// The program was removed, or the copy is not needed.
    Gone,
    /// Nothing is known of the program here.
    Unknown,
    /// There is no room for it, or no disk.
    Refused,
}

/// Which of two copies is newer: its term, then how many changes it has seen.
pub(crate) type Position = (u64, u64);

/// What a host has of a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Known {
    /// It is at home there, and no mere copy.
    pub(crate) home: bool,
    /// How new it is.
    pub(crate) position: Position,
}

/// A program as its home has it on its disk, and its standbys on theirs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Desk {
    pub(crate) spec: ProgramSpec,
    pub(crate) fence: Fence,
    pub(crate) checkpoint: Option<Vec<u8>>,
    /// How its run under this ownership came to its end, and why; none while it has not.
    pub(crate) ended: Option<(Status, String)>,
    /// Hosts that have copies, the first of which goes on when the home is gone.
    pub(crate) standbys: Vec<HostId>,
    /// The home before this one, until it knows.
    pub(crate) former: Option<HostId>,
    /// Counts the changes.
    pub(crate) change: u64,
}

impl Desk {
    pub(crate) fn position(&self) -> Position {
        (self.fence.term, self.change)
    }

    /// Gives it to an owner, under the term after this one or after `floor`.
    pub(crate) fn give(&mut self, owner: HostId, floor: u64) {
        self.fence.term = self.fence.term.max(floor);
        self.fence = self.fence.given_to(owner);
        self.ended = None;
    }
}

/// A row on the disk.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) enum Row {
    /// At home here.
    Home(Box<Desk>),
    /// A copy of what is at home elsewhere.
    Copy(Box<Desk>),
    /// It was removed, as of this term: copies that turn up later are none.
    Gone(u64),
}

/// A desk with what was heard of its run.
#[derive(Debug)]
pub(crate) struct Kept {
    pub(crate) desk: Desk,
    pub(crate) run: Option<RunTold>,
    /// What each standby has on its disk.
    pub(crate) told: BTreeMap<HostId, Position>,
    /// No other host has it in a newer state: known after a start when the standbys have said so, or were waited for.
    pub(crate) sure: bool,
    /// Why it does not run, though it shall.
    pub(crate) hindrance: String,
    /// Writes so far, for the actuators' journal.
    pub(crate) writes: u64,
}

/// This host's part.
pub(crate) struct Programs {
    pub(crate) runner: Runner,
    pub(crate) desks: Mutex<BTreeMap<ProgramId, Kept>>,
    pub(crate) copies: Mutex<BTreeMap<ProgramId, standby::Copy>>,
    /// Programs that were removed while somebody had a copy, with their last terms.
    pub(crate) gone: Mutex<BTreeMap<ProgramId, u64>>,
    /// The greatest term that was given, of any program: one that is removed and comes again must not meet its own past.
    pub(crate) last_term: AtomicU64,
    /// Held while a desk is changed, so that what is older never overwrites what is newer on the disk.
    pub(crate) changing: tokio::sync::Mutex<()>,
    pub(crate) poke: Notify,
    /// A desk has changed: its copies are to follow.
    pub(crate) changed: Notify,
    /// There was a program at home here in this life: runs for it may be somewhere.
    pub(crate) had_some: AtomicBool,
    pub(crate) opened: Instant,
}

impl Programs {
    /// Reads what is at home here, and begins a term of each: writes are counted from anew in this life. Blocks.
    pub(crate) fn open(store: &Store) -> Result<Self, Error> {
        let runner = Runner::start().map_err(|error| Error::Internal(Words::new(chain(&error), "")))?;
        let (mut desks, mut copies, mut gone, mut last_term) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new(), 0);
        for (name, row) in store.programs::<Row>()? {
            match row {
                Row::Home(mut desk) => {
                    // One that has ended goes on having ended: nobody asked for it again.
                    desk.fence = desk.fence.given_to(desk.fence.owner.clone());
                    desk.change += 1;
                    store.put_program(&name, &Row::Home(desk.clone()))?;
                    last_term = last_term.max(desk.fence.term);
                    let mut kept = Kept::new(*desk);
                    kept.sure = kept.desk.standbys.is_empty() && kept.desk.former.is_none();
                    desks.insert(kept.desk.spec.id.clone(), kept);
                }
                Row::Copy(desk) => {
                    last_term = last_term.max(desk.fence.term);
                    copies.insert(desk.spec.id.clone(), standby::Copy::of(*desk));
                }
                Row::Gone(term) => {
                    last_term = last_term.max(term);
                    if let Ok(id) = ProgramId::new(&name) {
                        gone.insert(id, term);
                    }
                }
            }
        }
        Ok(Self {
            runner,
            had_some: AtomicBool::new(!desks.is_empty()),
            desks: Mutex::new(desks),
            copies: Mutex::new(copies),
            gone: Mutex::new(gone),
            last_term: AtomicU64::new(last_term),
            changing: tokio::sync::Mutex::default(),
            poke: Notify::new(),
            changed: Notify::new(),
            opened: Instant::now(),
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

    /// Programs that need a component: those at home here, and those that this host has copies of.
    pub(crate) fn users(&self, digest: &Digest) -> Vec<ProgramId> {
        let desks = self.desks.lock();
        let copies = self.copies.lock();
        let specs = desks
            .values()
            .map(|kept| &kept.desk.spec)
            .chain(copies.values().map(|copy| &copy.desk.spec));
        specs
            .filter(|spec| spec.digest == *digest)
            .map(|spec| spec.id.clone())
            .collect()
    }
}

impl Kept {
    /// A desk that this host may act on.
    pub(crate) fn new(desk: Desk) -> Self {
        Self {
            desk,
            run: None,
            told: BTreeMap::new(),
            sure: true,
            hindrance: String::new(),
            writes: 0,
        }
    }

    pub(crate) fn view(&self) -> ProgramView {
        let run = self.run.as_ref().filter(|run| run.term == self.desk.fence.term);
        let (status, reason) = match (&self.desk.ended, self.desk.spec.wanted, run) {
            (Some((status, reason)), ..) => (*status, reason.clone()),
            (None, _, Some(run)) if run.status == Status::Fault => (Status::Fault, run.reason.clone()),
            (None, Wanted::Stopped, _) => (Status::Stopped, String::new()),
            (None, _, Some(run)) => (run.status, run.reason.clone()),
            (None, _, None) => (Status::Stopped, self.hindrance.clone()),
        };
        ProgramView {
            spec: self.desk.spec.clone(),
            fence: self.desk.fence.clone(),
            status,
            reason,
            run: run.cloned(),
            checkpoint_bytes: self.desk.checkpoint.as_ref().map(|bytes| bytes.len() as u64),
            standbys: self.desk.standbys.clone(),
        }
    }
}

/// The error for a program that is not at home here.
pub(crate) fn no_program(id: &ProgramId) -> Error {
    Error::not_found(format!("there is no program {id}"), "list the programs for their names")
}

/// Shared by what reaches out of a run.
pub(crate) type Spec = Arc<ProgramSpec>;
