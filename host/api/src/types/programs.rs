//! Programs: free-running code and scripts.

use std::collections::BTreeMap;

use bumpless_core::program::{Status, Wanted};
use bumpless_deploy::programs::{GrantDraft, LineView, ProgramDraft, ProgramList, ProgramOrder, ProgramView};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{LogLevel, SilentHost};

/// A point that a program is granted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ProgramGrant {
    /// The point.
    pub point: String,
    /// May the program write it?
    #[serde(default)]
    pub write: bool,
    /// What the program reads and writes at the two ends of the point's range: a converter's counts, for example. The point's own
    /// unit where not given.
    #[serde(default)]
    #[schema(value_type = Option<Vec<f64>>, min_items = 2, max_items = 2)]
    pub raw: Option<(f64, f64)>,
}

const fn share() -> u8 {
    25
}

const fn memory() -> u64 {
    8 * 1024 * 1024
}

const fn starts() -> bool {
    true
}

/// A program to create, or to change where there is one of the name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ProgramRequest {
    /// Its name.
    pub name: String,
    /// The component or script: `name`, `name@version`, or a digest or its beginning.
    pub component: String,
    /// Points by the program's names for them; all are of one host, which is the program's home. A 3C script's are `ain-0`,
    /// `aout-2`, `din-1`, `dout-17`.
    #[serde(default)]
    pub grants: BTreeMap<String, ProgramGrant>,
    /// Topics that it may publish on; one that ends in `*` is a beginning. A 3C script's id 10 is `n3c.10`.
    #[serde(default)]
    pub publishes: Vec<String>,
    /// Topics that it may listen to; the same.
    #[serde(default)]
    pub listens: Vec<String>,
    /// Names of components whose steps it may ask for.
    #[serde(default)]
    pub components: Vec<String>,
    /// Its part of one processor, in percent, over each tenth of a second; 1 to 100.
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

impl From<ProgramRequest> for ProgramDraft {
    fn from(request: ProgramRequest) -> Self {
        let grant = |(name, grant): (String, ProgramGrant)| {
            let draft = GrantDraft {
                point: grant.point,
                write: grant.write,
                raw: grant.raw,
            };
            (name, draft)
        };
        Self {
            name: request.name,
            component: request.component,
            grants: request.grants.into_iter().map(grant).collect(),
            publishes: request.publishes,
            listens: request.listens,
            components: request.components,
            share_percent: request.share_percent,
            memory_bytes: request.memory_bytes,
            prefer: request.prefer,
            start: request.start,
        }
    }
}

/// What is asked of a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ProgramWord {
    /// Run, from the last checkpoint.
    Start,
    /// End; the checkpoint stays.
    Stop,
    /// Stand where it is.
    Pause,
    /// Go on.
    Resume,
}

impl From<ProgramWord> for ProgramOrder {
    fn from(word: ProgramWord) -> Self {
        match word {
            ProgramWord::Start => Self::Start,
            ProgramWord::Stop => Self::Stop,
            ProgramWord::Pause => Self::Pause,
            ProgramWord::Resume => Self::Resume,
        }
    }
}

/// A person's order to a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ProgramOrderRequest {
    /// What it shall do.
    pub order: ProgramWord,
}

/// What a program does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ProgramStatus {
    /// It runs, or waits for something.
    Running,
    /// It stands where it is.
    Paused,
    /// It was stopped, or has come to its end.
    Stopped,
    /// It could not go on.
    Fault,
}

impl From<Status> for ProgramStatus {
    fn from(status: Status) -> Self {
        match status {
            Status::Running => Self::Running,
            Status::Paused => Self::Paused,
            Status::Stopped => Self::Stopped,
            Status::Fault => Self::Fault,
        }
    }
}

/// A program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Program {
    /// Its name.
    pub name: String,
    /// Grows with each change and order.
    pub revision: u64,
    /// Digest of its component.
    pub digest: String,
    /// The host that serves its points and names its owner.
    pub home: String,
    /// The host that runs it, or ran it last.
    pub owner: String,
    /// Number of the ownership; writes of an earlier one are refused.
    pub term: u64,
    /// What it shall do: `running`, `paused` or `stopped`.
    pub wanted: ProgramStatus,
    /// What it does.
    pub status: ProgramStatus,
    /// Why it is in fault, or does not run yet; empty otherwise.
    pub reason: String,
    /// Granted points.
    pub grants: BTreeMap<String, ProgramGrant>,
    /// Topics that it may publish on.
    pub publishes: Vec<String>,
    /// Topics that it may listen to.
    pub listens: Vec<String>,
    /// Components whose steps it may ask for.
    pub components: Vec<String>,
    /// Its part of one processor, in percent.
    pub share_percent: u8,
    /// Its memory at most, in bytes.
    pub memory_bytes_max: u64,
    /// Hosts where it would rather run.
    pub prefer: Vec<String>,
    /// Processor time of this run, in ms; none where nothing is known of one.
    pub used_ms: Option<f64>,
    /// Memory that it has, in bytes.
    pub memory_bytes: Option<u64>,
    /// Time since the start of this run, in ms.
    pub up_ms: Option<u64>,
    /// Lines that this run wrote.
    pub lines: Option<u64>,
    /// Lines beyond 50 a second, which were dropped.
    pub lines_dropped: Option<u64>,
    /// Bytes of its checkpoint.
    pub checkpoint_bytes: Option<u64>,
    /// Hosts that keep copies of it with its checkpoint, the first of which goes on with it when its home is gone.
    pub standbys: Vec<String>,
}

impl From<ProgramView> for Program {
    fn from(view: ProgramView) -> Self {
        let spec = view.spec;
        let run = view.run.as_ref();
        Self {
            name: spec.id.to_string(),
            revision: spec.revision,
            digest: spec.digest.to_string(),
            home: spec.home.to_string(),
            owner: view.fence.owner.to_string(),
            term: view.fence.term,
            wanted: match spec.wanted {
                Wanted::Running => ProgramStatus::Running,
                Wanted::Paused => ProgramStatus::Paused,
                Wanted::Stopped => ProgramStatus::Stopped,
            },
            status: view.status.into(),
            reason: view.reason,
            grants: spec
                .grants
                .into_iter()
                .map(|(name, grant)| {
                    let grant = ProgramGrant {
                        point: grant.point.to_string(),
                        write: grant.write,
                        raw: grant.raw,
                    };
                    (name, grant)
                })
                .collect(),
            publishes: spec.publishes,
            listens: spec.listens,
            components: spec.components,
            share_percent: spec.share_percent,
            memory_bytes_max: spec.memory_bytes,
            prefer: spec.prefer,
            used_ms: run.map(|run| run.used_ns as f64 / 1e6),
            memory_bytes: run.map(|run| run.memory_bytes),
            up_ms: run.map(|run| run.up_ms),
            lines: run.map(|run| run.lines.0),
            lines_dropped: run.map(|run| run.lines.1),
            checkpoint_bytes: view.checkpoint_bytes,
            standbys: view.standbys.iter().map(ToString::to_string).collect(),
        }
    }
}

/// Programs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Programs {
    /// By name.
    pub programs: Vec<Program>,
    /// Where the next part of the list begins; null where this is the last.
    pub next: Option<String>,
    /// Hosts that did not answer: programs at home there are missing.
    pub silent: Vec<SilentHost>,
}

impl From<ProgramList> for Programs {
    fn from(list: ProgramList) -> Self {
        let silent = |(host, reason): (bumpless_core::HostId, String)| SilentHost {
            host: host.to_string(),
            reason,
        };
        Self {
            programs: list.programs.into_iter().map(Program::from).collect(),
            next: None,
            silent: list.silent.into_iter().map(silent).collect(),
        }
    }
}

/// A line of a program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ProgramLine {
    /// Counts the lines of the run, from 1; lines that were dropped are missing.
    pub number: u64,
    /// When, in ms since the run began.
    pub at_ms: u64,
    /// How much it matters.
    pub level: LogLevel,
    /// Its text.
    pub text: String,
}

/// Lines of a program's present or last run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ProgramLog {
    /// Oldest first.
    pub lines: Vec<ProgramLine>,
}

impl From<Vec<LineView>> for ProgramLog {
    fn from(lines: Vec<LineView>) -> Self {
        let line = |line: LineView| ProgramLine {
            number: line.number,
            at_ms: line.at_ms,
            level: line.level.into(),
            text: line.text,
        };
        Self {
            lines: lines.into_iter().map(line).collect(),
        }
    }
}
