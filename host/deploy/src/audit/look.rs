//! Looking into the trail: lists, whole stretches, and whether the chain fits.
//!
//! Never: on an async thread (whole segments are read), or without a bound.

use std::sync::Arc;

use bumpless_core::{
    Digest, HostId,
    audit::{BEGINNING, Checker, Stretch},
};
use bumpless_store::AuditLog;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{AuditKind, AuditLine};
use crate::{
    book::on_disk,
    error::Error,
    limits::{AUDIT_LIST_MAX, AUDIT_LOOKED_SEGMENTS_MAX, AUDIT_REPLY_BYTES},
    room::Room,
    wire::Told,
};

/// Which entries.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct AuditFilter {
    /// Not older than this, in ms of Unix time.
    pub from_unix_ms: Option<u64>,
    /// Older than this, in ms of Unix time.
    pub to_unix_ms: Option<u64>,
    /// Of this loop.
    pub loop_name: Option<String>,
    /// By somebody whose name or address has this in it, whatever its case.
    pub by: Option<String>,
    /// Of this kind, or of all kinds before whose dot it stands: `loop.set`, or `loop`.
    pub what: Option<String>,
    /// With this outcome.
    pub outcome: Option<String>,
    /// At most so many, 1 to 1,000.
    pub limit: u32,
}

impl AuditFilter {
    fn check(&self) -> Result<(), Error> {
        if (1..=AUDIT_LIST_MAX).contains(&self.limit) {
            return Ok(());
        }
        Err(Error::invalid(
            format!("limit = {}", self.limit),
            format!("ask for 1 to {AUDIT_LIST_MAX} entries at a time"),
        ))
    }

    /// Times with equal digits are in the order of their texts.
    fn bounds(&self) -> (Option<String>, Option<String>) {
        let text = |ms: u64| {
            let at = std::time::UNIX_EPOCH + std::time::Duration::from_millis(ms);
            humantime::format_rfc3339_millis(at).to_string()
        };
        // Beyond the year 9999 there are no such texts, and no entries.
        let text = |ms: u64| text(ms.min(253_402_300_799_999));
        (self.from_unix_ms.map(text), self.to_unix_ms.map(text))
    }

    fn takes(&self, line: &AuditLine, (from, to): &(Option<String>, Option<String>)) -> bool {
        let entry = &line.entry;
        let has = |text: &str, part: &str| text.to_lowercase().contains(&part.to_lowercase());
        let of_kind = |what: &String| {
            let rest = entry.what.strip_prefix(what.as_str());
            rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
        };
        from.as_ref().is_none_or(|from| entry.at >= *from)
            && to.as_ref().is_none_or(|to| entry.at < *to)
            && (self.loop_name.is_none() || self.loop_name == entry.loop_name)
            && self
                .by
                .as_ref()
                .is_none_or(|by| has(&entry.by, by) || has(&entry.from, by))
            && self.what.as_ref().is_none_or(of_kind)
            && self.outcome.as_ref().is_none_or(|outcome| *outcome == entry.outcome)
    }
}

/// What may be asked of a host about its trail.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum AuditAsk {
    /// Entries that a filter takes, newest first, of numbers below this one.
    List(AuditFilter, u64),
    /// Whole lines from this number on, oldest first, as many as fit in an answer.
    Lines(u64),
    /// Does the chain fit?
    Verify,
}

/// Entries of one host, newest first.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub(crate) struct Looked {
    /// Lines of the chain.
    pub(crate) lines: Vec<String>,
    /// What has a lower number was not looked at; 1 where nothing is left.
    pub(crate) down_to: u64,
}

/// A stretch of one host's chain, oldest first.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct AuditPage {
    /// Lines of the chain.
    pub lines: Vec<String>,
    /// The number that the next page begins with; none where this is the last.
    pub next: Option<u64>,
}

/// Entries of the cell, newest first, and where the list goes on.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct AuditList {
    /// The entries.
    pub lines: Vec<AuditLine>,
    /// Where the list goes on; none where it ends.
    pub next: Option<String>,
    /// Hosts that did not answer, and why.
    pub silent: Vec<(HostId, String)>,
}

/// The first line that does not fit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AuditFlaw {
    /// The segment's file; empty where the chain as a whole does not fit.
    pub segment: String,
    /// The line in it, from 1.
    pub line: u64,
    /// Why it does not fit.
    pub reason: String,
}

/// Whether a host's chain fits.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AuditVerdict {
    /// The host.
    pub host: HostId,
    /// Number of the first entry that is there; 0 where there is none.
    pub first: u64,
    /// Number of the last entry that fits.
    pub last: u64,
    /// Hash of the last entry that fits: noted elsewhere, it shows later whether the chain was made anew.
    pub hash: String,
    /// Bytes on disk.
    pub bytes: u64,
    /// Entries that wait for the disk.
    pub waiting: u64,
    /// The first that does not fit.
    pub flaw: Option<AuditFlaw>,
}

fn parsed(line: &str) -> Option<AuditLine> {
    serde_json::from_str(line).ok()
}

impl Room {
    /// Answers a question about the trail of this host.
    pub(crate) async fn audit_here(self: &Arc<Self>, ask: AuditAsk) -> Result<Told, Error> {
        let log = Arc::clone(&self.audit.log);
        match ask {
            AuditAsk::List(filter, below) => {
                filter.check()?;
                on_disk(move || listed(&log, &filter, below)).await?.map(Told::Audit)
            }
            AuditAsk::Lines(from) => on_disk(move || page(&log, from)).await?.map(Told::AuditPage),
            AuditAsk::Verify => {
                let (host, waiting) = (self.here.clone(), self.audit.waiting() as u64);
                on_disk(move || verified(&log, &host, waiting))
                    .await?
                    .map(|verdict| Told::AuditVerdict(Box::new(verdict)))
            }
        }
    }
}

/// Newest first, through a bounded number of segments.
fn listed(log: &AuditLog, filter: &AuditFilter, below: u64) -> Result<Looked, Error> {
    let bounds = filter.bounds();
    let mut looked = Looked {
        lines: Vec::new(),
        down_to: 1,
    };
    let (mut bytes, mut segments_read) = (0, 0);
    for segment in log.segments().into_iter().rev().filter(|first| *first < below) {
        if segments_read >= AUDIT_LOOKED_SEGMENTS_MAX {
            // Whoever asks for more goes on from there.
            return Ok(looked);
        }
        segments_read += 1;
        let Some(text) = log.lines(segment)? else { continue };
        for line in text.lines().rev() {
            let Some(entry) = parsed(line) else { continue };
            if entry.number >= below {
                continue;
            }
            if filter.takes(&entry, &bounds) {
                bytes += line.len();
                looked.lines.push(line.to_owned());
            }
            looked.down_to = entry.number;
            if looked.lines.len() >= filter.limit as usize || bytes >= AUDIT_REPLY_BYTES {
                return Ok(looked);
            }
        }
        looked.down_to = segment;
    }
    looked.down_to = 1;
    Ok(looked)
}

/// Oldest first, whatever the lines are: also those that do not fit belong into an export.
fn page(log: &AuditLog, from: u64) -> Result<AuditPage, Error> {
    let segments = log.segments();
    // The last segment that begins at or before the number; the first of all where it was trimmed.
    let at = segments.partition_point(|first| *first <= from).saturating_sub(1);
    let mut page = AuditPage::default();
    let mut bytes = 0;
    for segment in segments.iter().skip(at) {
        let Some(text) = log.lines(*segment)? else { continue };
        let mut number = *segment;
        for line in text.lines() {
            number = bumpless_core::audit::read(line).map_or(number, |link| link.number);
            if number < from {
                continue;
            }
            if bytes + line.len() > AUDIT_REPLY_BYTES {
                page.next = Some(number);
                return Ok(page);
            }
            bytes += line.len();
            page.lines.push(line.to_owned());
        }
    }
    Ok(page)
}

/// Has the trail itself said that it removed everything up to here?
fn removed_up_to(line: &str, first: u64, prev: Digest) -> bool {
    line.contains(AuditKind::TrailTrimmed.name())
        && parsed(line).is_some_and(|line| {
            line.entry.what == AuditKind::TrailTrimmed.name()
                && line.entry.asked.get("last").and_then(Value::as_u64) == Some(first - 1)
                && line.entry.asked.get("hash").and_then(Value::as_str) == Some(&prev.to_string())
        })
}

fn verified(log: &AuditLog, host: &HostId, waiting: u64) -> Result<AuditVerdict, Error> {
    // Before the lines are read: what is added meanwhile is not looked for.
    let head = log.head();
    let mut checker = Checker::default();
    let mut verdict = AuditVerdict {
        host: host.clone(),
        first: 0,
        last: 0,
        hash: BEGINNING.to_string(),
        bytes: head.bytes,
        waiting,
        flaw: None,
    };
    let mut said_so = false;
    let mut begins: Option<(u64, Digest)> = None;
    'all: for segment in log.segments() {
        let Some(text) = log.lines(segment)? else { continue };
        for (at, line) in (1..).zip(text.lines()) {
            if let Err(misfit) = checker.look(line) {
                verdict.flaw = Some(AuditFlaw {
                    segment: format!("{segment:012}.jsonl"),
                    line: at,
                    reason: misfit.to_string(),
                });
                break 'all;
            }
            if begins.is_none() {
                begins = checker
                    .stretches()
                    .next()
                    .map(|(_, stretch)| (stretch.first, stretch.prev));
            }
            if let Some((first, prev)) = begins
                && first > 1
                && !said_so
            {
                said_so = removed_up_to(line, first, prev);
            }
        }
    }
    let whole = |reason: String| AuditFlaw {
        segment: String::new(),
        line: 0,
        reason,
    };
    let found: Option<Stretch> = checker
        .stretches()
        .find(|(of, _)| *of == host)
        .map(|(_, found)| found.clone());
    if let Some(found) = &found {
        (verdict.first, verdict.last, verdict.hash) = (found.first, found.last, found.hash.to_string());
    }
    if verdict.flaw.is_none() {
        let last = verdict.last;
        verdict.flaw = match begins {
            Some((first, _)) if first > 1 && !said_so => Some(whole(format!(
                "entries 1 to {} are missing, and no entry says that they were removed",
                first - 1
            ))),
            _ if last < head.number => Some(whole(format!(
                "entries {} to {} are missing at the end",
                last + 1,
                head.number
            ))),
            _ => None,
        };
    }
    Ok(verdict)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use bumpless_store::{AUDIT_BYTES_MAX, Store};
    use serde_json::json;

    use super::*;
    use crate::audit::AuditEntry;

    fn host() -> HostId {
        HostId::new("a").unwrap()
    }

    fn trail(dir: &std::path::Path) -> AuditLog {
        AuditLog::open(&Store::open(dir).unwrap(), &host(), *AUDIT_BYTES_MAX.start())
            .unwrap()
            .0
    }

    fn entry(n: u64, what: AuditKind, by: &str) -> String {
        let entry = AuditEntry {
            at: format!("2026-01-01T00:00:{n:02}.000Z"),
            by: by.to_owned(),
            loop_name: Some(format!("l{}", n % 2)),
            ..AuditEntry::own(what, json!({}))
        };
        entry.text()
    }

    #[test]
    fn a_filter_takes_what_it_says_and_pages_follow_each_other() {
        let dir = tempfile::tempdir().unwrap();
        let log = trail(dir.path());
        let kinds = [AuditKind::LoopSet, AuditKind::LoopSetpoint, AuditKind::PointForce];
        for n in 0..30_u64 {
            let by = if n < 10 { "Ann" } else { "bob" };
            log.append(&[entry(n, kinds[(n % 3) as usize], by)]).unwrap();
        }
        let numbers = |filter: AuditFilter, below: u64| -> Vec<u64> {
            let looked = listed(&log, &filter, below).unwrap();
            looked.lines.iter().map(|line| parsed(line).unwrap().number).collect()
        };
        let all = || AuditFilter {
            limit: 1_000,
            ..AuditFilter::default()
        };
        assert_eq!(numbers(all(), u64::MAX), (1..=30).rev().collect::<Vec<_>>());
        assert_eq!(numbers(AuditFilter { limit: 3, ..all() }, 21), [20, 19, 18]);
        let count = |filter| numbers(filter, u64::MAX).len();
        assert_eq!(
            count(AuditFilter {
                what: Some("loop".into()),
                ..all()
            }),
            20
        );
        assert_eq!(
            count(AuditFilter {
                what: Some("loop.set".into()),
                ..all()
            }),
            10,
            "not loop.setpoint"
        );
        assert_eq!(
            count(AuditFilter {
                what: Some("lo".into()),
                ..all()
            }),
            0
        );
        assert_eq!(
            count(AuditFilter {
                by: Some("ann".into()),
                ..all()
            }),
            10
        );
        assert_eq!(
            count(AuditFilter {
                loop_name: Some("l1".into()),
                ..all()
            }),
            15
        );
        assert_eq!(
            count(AuditFilter {
                outcome: Some("refused".into()),
                ..all()
            }),
            0
        );
        // 2026-01-01T00:00:00Z.
        let second = |n: u64| Some(1_767_225_600_000 + n * 1_000);
        let window = AuditFilter {
            from_unix_ms: second(5),
            to_unix_ms: second(8),
            ..all()
        };
        assert_eq!(numbers(window, u64::MAX), [8, 7, 6]);
        assert_eq!(
            count(AuditFilter {
                to_unix_ms: Some(u64::MAX),
                ..all()
            }),
            30
        );
        assert!(AuditFilter { limit: 0, ..all() }.check().is_err());
        let page = page(&log, 29).unwrap();
        assert_eq!((page.lines.len(), page.next), (2, None));
    }

    #[test]
    fn a_verdict_names_the_first_line_that_does_not_fit() {
        let dir = tempfile::tempdir().unwrap();
        let log = trail(dir.path());
        assert_eq!(verified(&log, &host(), 0).unwrap().flaw, None, "an empty trail fits");
        for n in 0..3 {
            log.append(&[entry(n, AuditKind::LoopSet, "ann")]).unwrap();
        }
        let good = verified(&log, &host(), 0).unwrap();
        assert_eq!((good.first, good.last, good.flaw), (1, 3, None));
        assert_eq!(good.hash, log.head().hash.to_string());
        let path = log.directory().join("000000000001.jsonl");
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, text.replacen("00:00:01", "00:00:09", 1)).unwrap();
        let flaw = verified(&log, &host(), 0).unwrap().flaw.unwrap();
        assert_eq!((flaw.segment.as_str(), flaw.line), ("000000000001.jsonl", 2));
        assert!(flaw.reason.contains("entry 2 of host a was changed"), "{}", flaw.reason);
        let end = text.rfind("{\"host\"").unwrap();
        std::fs::write(&path, &text[..end]).unwrap();
        let flaw = verified(&log, &host(), 0).unwrap().flaw.unwrap();
        assert!(
            flaw.reason.contains("entries 3 to 3 are missing at the end"),
            "{}",
            flaw.reason
        );
    }

    #[test]
    fn what_was_removed_for_want_of_room_is_no_flaw_and_anything_else_is() {
        let dir = tempfile::tempdir().unwrap();
        let log = trail(dir.path());
        let long = AuditEntry {
            reason: "x".repeat(60_000),
            ..AuditEntry::own(AuditKind::LoopSet, json!({}))
        };
        let overdue = loop {
            log.append(&vec![long.text(); 20]).unwrap();
            if let Some(overdue) = log.overdue().unwrap() {
                break overdue;
            }
        };
        // Two are left whole, so that the first of them is not the end.
        while log.segments().len() < 4 {
            log.append(&vec![long.text(); 20]).unwrap();
        }
        let removed = json!({ "first": overdue.first, "last": overdue.last, "hash": overdue.hash.to_string() });
        log.trim(&overdue, AuditEntry::own(AuditKind::TrailTrimmed, removed).text())
            .unwrap();
        let verdict = verified(&log, &host(), 0).unwrap();
        assert_eq!((verdict.first, verdict.flaw), (overdue.last + 1, None));
        std::fs::remove_file(log.directory().join(format!("{:012}.jsonl", log.segments()[0]))).unwrap();
        drop(log);
        let verdict = verified(&trail(dir.path()), &host(), 0).unwrap();
        let flaw = verdict.flaw.unwrap();
        assert!(
            flaw.reason.contains("no entry says that they were removed"),
            "{}",
            flaw.reason
        );
    }
}
