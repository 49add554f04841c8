//! The facade's part for the audit trail: listed over all hosts by time, read host by host, verified.
//!
//! Never: writes; the changes do.

use std::collections::{BTreeMap, VecDeque};

use bumpless_core::{HostId, audit::Stretch};
use futures_util::future::join_all;
use serde_json::json;

use super::{Deploy, unexpected};
use crate::{
    audit::{Act, AuditAsk, AuditFilter, AuditKind, AuditLine, AuditList, AuditPage, AuditVerdict, Seen},
    error::Error,
    limits::{ANSWER_WAIT, AUDIT_VERIFY_WAIT},
    wire::{Ask, Told},
};

/// Where a list goes on, host by host: `plant:120,a:7`.
fn places(after: &str) -> Result<BTreeMap<HostId, u64>, Error> {
    let place = |part: &str| {
        let (host, number) = part.split_once(':')?;
        Some((HostId::new(host).ok()?, number.parse().ok()?))
    };
    after
        .split(',')
        .map(|part| {
            place(part).ok_or_else(|| {
                let part: String = part.chars().take(80).collect();
                Error::invalid(
                    format!("{part:?} is no place in a list of the audit trail"),
                    "give what the list before called next",
                )
            })
        })
        .collect()
}

impl Deploy {
    /// The hosts that are there, by name.
    pub(super) fn every_host(&self) -> Vec<HostId> {
        let mut hosts = self.room.roster.others();
        hosts.push(self.room.here.clone());
        hosts.sort();
        hosts
    }

    /// Entries of all hosts, newest first; `after` is what the list before called next. A host that does not answer is named.
    ///
    /// # Errors
    /// [`Error::Invalid`] for the filter's limit, or a place that no list gave.
    pub async fn audit(&self, filter: &AuditFilter, after: Option<&str>) -> Result<AuditList, Error> {
        let mut places = after.map(places).transpose()?.unwrap_or_default();
        let ask = |host: HostId| {
            let below = places.get(&host).copied().unwrap_or(u64::MAX);
            (below > 1).then(|| (host, Ask::Audit(AuditAsk::List(filter.clone(), below))))
        };
        let asked: Vec<(HostId, Ask)> = self.every_host().into_iter().filter_map(ask).collect();
        let answers = join_all(
            asked
                .iter()
                .map(|(host, ask)| self.room.ask(host, ask.clone(), ANSWER_WAIT)),
        )
        .await;
        let mut list = AuditList::default();
        let mut queues: Vec<(HostId, VecDeque<AuditLine>, u64)> = Vec::new();
        for ((host, _), answer) in asked.iter().zip(answers) {
            match answer {
                Ok(Told::Audit(looked)) => {
                    let lines = looked.lines.iter().filter_map(|line| serde_json::from_str(line).ok());
                    queues.push((host.clone(), lines.collect(), looked.down_to));
                }
                Ok(_) => list.silent.push((host.clone(), unexpected().to_string())),
                Err(error @ Error::Invalid(_)) => return Err(error),
                Err(error) => list.silent.push((host.clone(), error.to_string())),
            }
        }
        while list.lines.len() < filter.limit as usize {
            // A host that was not looked through to its end may have something newer than the others' next: the list ends there.
            if queues
                .iter()
                .any(|(_, lines, down_to)| lines.is_empty() && *down_to > 1)
            {
                break;
            }
            let newest = queues
                .iter_mut()
                .filter(|(_, lines, _)| !lines.is_empty())
                .max_by(|(_, a, _), (_, b, _)| a.front().map(|l| &l.entry.at).cmp(&b.front().map(|l| &l.entry.at)));
            let Some((host, lines, _)) = newest else { break };
            if let Some(line) = lines.pop_front() {
                places.insert(host.clone(), line.number);
                list.lines.push(line);
            }
        }
        for (host, lines, down_to) in &queues {
            if lines.is_empty() {
                places.insert(host.clone(), *down_to);
            }
        }
        if queues
            .iter()
            .any(|(_, lines, down_to)| !lines.is_empty() || *down_to > 1)
        {
            let places = places.iter().map(|(host, number)| format!("{host}:{number}"));
            list.next = Some(places.collect::<Vec<_>>().join(","));
        }
        Ok(list)
    }

    /// Lines of a host's chain from a number on, oldest first, as they are on its disk.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::Timeout`], [`Error::Store`].
    pub async fn audit_page(&self, host: &HostId, from: u64) -> Result<AuditPage, Error> {
        match self
            .room
            .ask(host, Ask::Audit(AuditAsk::Lines(from)), ANSWER_WAIT * 2)
            .await?
        {
            Told::AuditPage(page) => Ok(page),
            _ => Err(unexpected()),
        }
    }

    /// The line that closes an export of these lines; none where there is none that is an entry.
    #[must_use]
    pub fn audit_seal(host: &HostId, first: &str, last: &str) -> Option<String> {
        let (first, last) = (
            bumpless_core::audit::read(first).ok()?,
            bumpless_core::audit::read(last).ok()?,
        );
        let stretch = Stretch {
            first: first.number,
            prev: first.prev,
            last: last.number,
            hash: last.hash,
        };
        Some(stretch.seal(host))
    }

    /// Whether each host's chain fits; with the reason for each host that did not answer.
    pub async fn verify_audit(&self) -> Vec<(HostId, Result<AuditVerdict, Error>)> {
        let hosts = self.every_host();
        let answers = join_all(
            hosts
                .iter()
                .map(|host| self.room.ask(host, Ask::Audit(AuditAsk::Verify), AUDIT_VERIFY_WAIT)),
        )
        .await;
        let verdicts = answers.into_iter().map(|answer| match answer {
            Ok(Told::AuditVerdict(verdict)) => Ok(*verdict),
            Ok(_) => Err(unexpected()),
            Err(error) => Err(error),
        });
        hosts.into_iter().zip(verdicts).collect()
    }

    /// Writes down that something was refused before it became a question to the cell.
    pub async fn note_refusal(&self, target: &str, asked: &str, refused: &Error) {
        let act = Act::new(AuditKind::ModbusRefuse, target, json!({ "write": asked }));
        self.room.audit_own(act, Seen::default(), Some(refused)).await;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_place_is_read_as_it_was_told() {
        let found = places("plant:120,a.west:7").unwrap();
        let found: Vec<(&str, u64)> = found.iter().map(|(host, number)| (host.as_str(), *number)).collect();
        assert_eq!(found, [("a.west", 7), ("plant", 120)]);
        for bad in ["", "plant", "plant:", "plant:x", "Plant:1", "plant:1,", "plant:-1"] {
            let error = places(bad).expect_err(bad).to_string();
            assert!(error.contains("is no place in a list"), "{error}");
        }
    }
}
