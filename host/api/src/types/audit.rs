//! The audit trail: entries, where a list goes on, and whether chains fit.

use bumpless_deploy::audit as model;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;

use super::SilentHost;
use crate::trail::Verdicts;

/// One field that changed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AuditChange {
    /// Its name; parts of a part are joined by dots.
    pub field: String,
    /// What it was; null where it was not there.
    pub before: Value,
    /// What it is; null where it is not there any more.
    pub after: Value,
}

/// One entry of the audit trail.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AuditEntry {
    /// When it ended, by the wall clock of the host: RFC 3339 in UTC.
    pub at: String,
    /// The host that it entered through; each has its own chain.
    pub host: String,
    /// Its number there, from 1.
    pub number: u64,
    /// What was done, such as `loop.setpoint` or `point.force`.
    pub what: String,
    /// Who did it: the account, or on a host that asks nobody what he said of himself; empty where nobody said.
    pub by: String,
    /// The way in: `api`, `modbus`, `rollout`, or `host` for what a host did of itself.
    pub via: String,
    /// From which address; empty where there is none.
    pub from: String,
    /// The loop, where it is about one.
    #[serde(rename = "loop")]
    pub loop_name: Option<String>,
    /// The component, point, alarm, job, rollout or host.
    pub target: String,
    /// What was asked for.
    pub asked: Value,
    /// What changed by it.
    pub changes: Vec<AuditChange>,
    /// `done`, or the sort of failure: `refused`, `stale`, `invalid`, `not-found`, `busy`, `unreachable`, `timeout`, `store`, `internal`;
    /// `unknown` where the host died before it knew.
    pub outcome: String,
    /// Why it failed.
    pub reason: String,
    /// How long it took, in ms.
    pub took_ms: u64,
    /// SHA-256 that the entry before ends with; zeros for the first.
    pub prev: String,
    /// SHA-256 that binds this one.
    pub hash: String,
}

impl From<model::AuditLine> for AuditEntry {
    fn from(line: model::AuditLine) -> Self {
        let entry = line.entry;
        let change = |change: model::FieldChange| AuditChange {
            field: change.field,
            before: change.before,
            after: change.after,
        };
        Self {
            at: entry.at,
            host: line.host,
            number: line.number,
            what: entry.what,
            by: entry.by,
            via: entry.via,
            from: entry.from,
            loop_name: entry.loop_name,
            target: entry.target,
            asked: entry.asked,
            changes: entry.changes.into_iter().map(change).collect(),
            outcome: entry.outcome,
            reason: entry.reason,
            took_ms: entry.took_ms,
            prev: line.prev,
            hash: line.hash,
        }
    }
}

/// Entries, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AuditEntries {
    /// The entries.
    pub entries: Vec<AuditEntry>,
    /// Give it as `after` for what comes next; none where nothing does.
    pub next: Option<String>,
    /// Hosts that did not answer.
    pub silent: Vec<SilentHost>,
}

impl From<model::AuditList> for AuditEntries {
    fn from(list: model::AuditList) -> Self {
        let silent = |(host, reason): (bumpless_core::HostId, String)| SilentHost {
            host: host.to_string(),
            reason,
        };
        Self {
            entries: list.lines.into_iter().map(Into::into).collect(),
            next: list.next,
            silent: list.silent.into_iter().map(silent).collect(),
        }
    }
}

/// The first line of a chain that does not fit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AuditFlaw {
    /// The file on the host's disk; empty where the chain as a whole does not fit.
    pub segment: String,
    /// The line in it, from 1.
    pub line: u64,
    /// Why it does not fit.
    pub reason: String,
}

/// Whether one host's chain fits.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AuditChain {
    /// The host.
    pub host: String,
    /// Does all of it fit?
    pub good: bool,
    /// Number of the first entry that is there; 0 where there is none.
    pub first: u64,
    /// Number of the last entry that fits.
    pub last: u64,
    /// Hash of that entry. Noted elsewhere, it shows later whether the chain was made anew.
    pub hash: String,
    /// Bytes on disk.
    pub bytes: u64,
    /// Entries that wait for the disk.
    pub waiting: u64,
    /// The first that does not fit.
    pub flaw: Option<AuditFlaw>,
}

/// Whether the chains fit, host by host.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AuditVerdicts {
    /// Do all of them fit, and did all hosts answer?
    pub good: bool,
    /// The chains.
    pub chains: Vec<AuditChain>,
    /// Hosts that did not answer.
    pub silent: Vec<SilentHost>,
}

impl From<Verdicts> for AuditVerdicts {
    fn from(verdicts: Verdicts) -> Self {
        let (mut chains, mut silent) = (Vec::new(), Vec::new());
        for (host, verdict) in verdicts {
            match verdict {
                Ok(verdict) => chains.push(AuditChain {
                    host: host.to_string(),
                    good: verdict.flaw.is_none(),
                    first: verdict.first,
                    last: verdict.last,
                    hash: verdict.hash,
                    bytes: verdict.bytes,
                    waiting: verdict.waiting,
                    flaw: verdict.flaw.map(|flaw| AuditFlaw {
                        segment: flaw.segment,
                        line: flaw.line,
                        reason: flaw.reason,
                    }),
                }),
                Err(error) => silent.push(SilentHost {
                    host: host.to_string(),
                    reason: error.to_string(),
                }),
            }
        }
        Self {
            good: silent.is_empty() && chains.iter().all(|chain| chain.good),
            chains,
            silent,
        }
    }
}
