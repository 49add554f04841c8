//! How well a host is: what must hold before work is sent to it, each with a word why it does not.
//!
//! | check | holds while |
//! |---|---|
//! | `bus` | the session to the cell is open |
//! | `cell` | the cell hears of this host: its own vitals are fresh |
//! | `store` | the disk took a write, tried at most every few seconds |
//! | `service` | the host is not being emptied |
//! | `io` | its points are served (hosts with points) |
//! Never: repairs anything, and never asks the disk more often than it must.

use std::{sync::Arc, time::Instant};

use bumpless_core::HostId;
use serde::{Deserialize, Serialize};
use tokio::{sync::Mutex, time::timeout};

use crate::{
    book::on_disk,
    error::chain,
    limits::{DISK_TRIED_EVERY, DISK_WAIT},
    room::Room,
};

/// The setting that is written to see whether writing works.
const TRIED: &str = "disk-tried";

/// One thing that must hold.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Check {
    /// Its name, from the table above.
    pub name: String,
    /// Does it hold?
    pub good: bool,
    /// How it stands, in words.
    pub text: String,
}

/// How well a host is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct HealthView {
    /// The host.
    pub host: HostId,
    /// May work be sent to it? All checks hold.
    pub ready: bool,
    /// For how long its process runs, in ms.
    pub up_ms: u64,
    /// Each thing that must hold.
    pub checks: Vec<Check>,
}

impl HealthView {
    /// From its checks.
    #[must_use]
    pub fn new(host: HostId, up_ms: u64, checks: Vec<Check>) -> Self {
        Self {
            ready: checks.iter().all(|check| check.good),
            host,
            up_ms,
            checks,
        }
    }

    /// What does not hold, in one line; empty where the host is ready.
    #[must_use]
    pub fn why_not(&self) -> String {
        let bad = self.checks.iter().filter(|check| !check.good);
        bad.map(|check| format!("{}: {}", check.name, check.text))
            .collect::<Vec<_>>()
            .join("; ")
    }
}

/// What the last try to write gave, and when that was. Whoever finds it old tries again, one at a time.
#[derive(Debug, Default)]
pub(crate) struct Disk(Mutex<Option<(Instant, Result<(), String>)>>);

fn check(name: &str, good: bool, text: impl Into<String>) -> Check {
    Check {
        name: name.to_owned(),
        good,
        text: text.into(),
    }
}

impl Room {
    /// How well this host is.
    pub(crate) async fn health_here(self: &Arc<Self>) -> HealthView {
        let now = Instant::now();
        let bus = self.session.is_open();
        let mut checks = vec![check(
            "bus",
            bus,
            if bus {
                "open"
            } else {
                "closed: the host must be restarted"
            },
        )];
        let seen = self.roster.all().into_iter().find(|(host, _)| *host == self.here);
        // It hears itself at every beat, however large the cell is.
        let heard = seen.as_ref().is_some_and(|(_, seen)| seen.alive(now, 1));
        let others = self.roster.others().len();
        checks.push(check(
            "cell",
            heard,
            if heard {
                format!("joined, with {others} other hosts")
            } else {
                "this host has not told the cell of itself lately: it starts, or is held up".to_owned()
            },
        ));
        checks.push(match self.disk_tried().await {
            Ok(()) => check("store", true, "takes writes"),
            Err(reason) => check("store", false, reason),
        });
        let draining = self.is_draining();
        let kept = self.drain_kept.load(std::sync::atomic::Ordering::Acquire);
        checks.push(match (draining, kept) {
            (false, _) => check("service", true, "takes loops"),
            (true, false) => check("service", false, "the host is being emptied"),
            (true, true) => check("service", false, "the host is being emptied, also after a restart"),
        });
        if let Some(io) = &self.io {
            checks.push(check("io", true, format!("serves {} points", io.points().len())));
        }
        let started_ms = seen
            .and_then(|(_, seen)| seen.vitals)
            .map(|vitals| vitals.started_at_ms);
        let up_ms = started_ms.map_or(0, |started| self.clock.unix_ms().saturating_sub(started));
        HealthView::new(self.here.clone(), up_ms, checks)
    }

    /// Does the disk take a write? Not asked more often than it can bear; a disk that does not answer is no good one.
    async fn disk_tried(&self) -> Result<(), String> {
        let Ok(mut last) = timeout(DISK_WAIT, self.disk.0.lock()).await else {
            return Err("the disk has not answered an earlier try".to_owned());
        };
        if let Some((at, end)) = last.as_ref()
            && at.elapsed() < DISK_TRIED_EVERY
        {
            return end.clone();
        }
        let (store, now_ms) = (self.store.clone(), self.clock.unix_ms());
        let tried = timeout(DISK_WAIT, on_disk(move || store.set_host_value(TRIED, &now_ms))).await;
        let end = match tried {
            Ok(Ok(Ok(()))) => Ok(()),
            Ok(Ok(Err(error))) => Err(chain(&error)),
            Ok(Err(error)) => Err(error.to_string()),
            Err(_) => Err(format!("a write took longer than {} s", DISK_WAIT.as_secs())),
        };
        *last = Some((Instant::now(), end.clone()));
        end
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn a_host_is_ready_when_everything_holds_and_says_what_does_not() {
        let host = HostId::new("h").unwrap();
        let good = HealthView::new(host.clone(), 1, vec![check("bus", true, "open")]);
        assert!(good.ready && good.why_not().is_empty());
        let checks = vec![
            check("bus", true, "open"),
            check("store", false, "disk full"),
            check("service", false, "emptied"),
        ];
        let bad = HealthView::new(host, 1, checks);
        assert!(!bad.ready);
        assert_eq!(bad.why_not(), "store: disk full; service: emptied");
    }
}
