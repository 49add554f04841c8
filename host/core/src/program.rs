//! Free-running programs: what one is granted, what it shall do, and who may write for it.
//!
//! ```text
//!            start                 pause                  the run returns, faults or is stopped
//!  Stopped ────────► Running ◄──────────────► Paused   ───────────────────────────────────────► Stopped | Fault
//!                                 resume
//! ```
//! Owns: the specification and its checks, topics and raw scales, and the fence between owners.
//! Never: runs anything, or knows what a program does.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{
    digest::Digest,
    limits::{NAME_CHARS_MAX, PORTS_MAX, TEXT_CHARS_MAX},
    name::{HostId, PointId, ProgramId},
};

/// Topics that a program may publish on, and as many that it may listen to, at most.
pub const TOPICS_MAX: usize = 32;
/// Components whose steps a program may ask for, at most.
pub const COMPONENTS_MAX: usize = 16;
/// Least memory of a program, in bytes: below it an interpreter does not start.
pub const MEMORY_BYTES_MIN: u64 = 1024 * 1024;
/// Most memory of a program, in bytes; the engine's own bound may be less.
pub const MEMORY_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// What shall become of a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Wanted {
    /// It runs.
    Running,
    /// It stands where it is, and goes on from there.
    Paused,
    /// It does not run; its checkpoint is kept.
    Stopped,
}

/// What a program does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Status {
    /// It runs, or waits for something.
    Running,
    /// It stands where it is.
    Paused,
    /// It was stopped, or has come to its end.
    Stopped,
    /// It could not go on; the reason stands beside.
    Fault,
}

/// A point that a program is granted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Grant {
    /// The point.
    pub point: PointId,
    /// May the program write it?
    pub write: bool,
    /// What the program reads and writes at the two ends of the point's range, where that is not the point's own unit: a
    /// converter's counts, for example.
    pub raw: Option<(f64, f64)>,
    /// The point's range, in its unit.
    pub range: (f64, f64),
    /// The point's unit.
    pub unit: String,
}

impl Grant {
    /// A value of the point as the program sees it.
    #[must_use]
    pub fn to_program(&self, value: f64) -> f64 {
        let (low, high) = self.range;
        self.raw.map_or(value, |raw| scale(value, (low, high), raw))
    }

    /// A value of the program as the point's, within the point's range: what an output stage does with a number beyond it.
    #[must_use]
    pub fn to_point(&self, value: f64) -> f64 {
        let (low, high) = self.range;
        let value = self.raw.map_or(value, |raw| scale(value, raw, (low, high)));
        value.clamp(low, high)
    }
}

fn scale(value: f64, (from_low, from_high): (f64, f64), (to_low, to_high): (f64, f64)) -> f64 {
    to_low + (value - from_low) / (from_high - from_low) * (to_high - to_low)
}

/// A program as it shall be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProgramSpec {
    /// Its name.
    pub id: ProgramId,
    /// Grows with each change.
    pub revision: u64,
    /// Its component, with its script.
    pub digest: Digest,
    /// The host that serves its points, and names its owner.
    pub home: HostId,
    /// Granted points by the program's names for them.
    pub grants: BTreeMap<String, Grant>,
    /// Topics that it may publish on; one that ends in `*` is a beginning.
    pub publishes: Vec<String>,
    /// Topics that it may listen to; the same.
    pub listens: Vec<String>,
    /// Names of components whose steps it may ask for.
    pub components: Vec<String>,
    /// Its part of one processor, in percent, over each tenth of a second; 1 to 100.
    pub share_percent: u8,
    /// Its linear memory at most, in bytes.
    pub memory_bytes: u64,
    /// Names and labels of hosts where it would rather run, the best first.
    pub prefer: Vec<String>,
    /// What shall become of it.
    pub wanted: Wanted,
}

/// What is wrong with a specification.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ProgramError {
    /// Too many of something.
    #[error("{count} {what}; at most {max} are possible")]
    TooMany {
        /// How many.
        count: usize,
        /// Of what.
        what: &'static str,
        /// The limit.
        max: usize,
    },
    /// A name of a granted point.
    #[error("the grant {0:?}: a name has 1 to 32 lower-case letters, digits and dashes")]
    GrantName(String),
    /// A raw scale that cannot be.
    #[error("the grant {0:?}: a raw scale has two different finite ends, and the point's range too")]
    Raw(String),
    /// Two grants to write one point.
    #[error("the point {0} is granted for writing twice")]
    Twice(PointId),
    /// A topic.
    #[error("topic {0:?}: a topic has 1 to {NAME_CHARS_MAX} characters")]
    Topic(String),
    /// The share.
    #[error("share_percent = {0}: use 1 to 100")]
    Share(u8),
    /// The memory.
    #[error("memory_bytes = {0}: use {MEMORY_BYTES_MIN} to {MEMORY_BYTES_MAX}")]
    Memory(u64),
    /// A long text.
    #[error("{0} is longer than {TEXT_CHARS_MAX} characters")]
    Long(&'static str),
}

impl ProgramSpec {
    /// Checks everything that needs neither component nor point.
    ///
    /// # Errors
    /// The first thing that does not hold.
    pub fn check(&self) -> Result<(), ProgramError> {
        for (count, what, max) in [
            (self.grants.len(), "granted points", PORTS_MAX),
            (self.publishes.len(), "topics to publish on", TOPICS_MAX),
            (self.listens.len(), "topics to listen to", TOPICS_MAX),
            (self.components.len(), "components", COMPONENTS_MAX),
            (self.prefer.len(), "preferred hosts", crate::limits::PREFER_MAX),
        ] {
            if count > max {
                return Err(ProgramError::TooMany { count, what, max });
            }
        }
        let mut written = std::collections::BTreeSet::new();
        for (name, grant) in &self.grants {
            let good = (1..=32).contains(&name.len())
                && name
                    .bytes()
                    .all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-');
            if !good {
                return Err(ProgramError::GrantName(name.chars().take(64).collect()));
            }
            let apart = |(low, high): (f64, f64)| low.is_finite() && high.is_finite() && low != high;
            if !apart(grant.range) || grant.range.0 > grant.range.1 || grant.raw.is_some_and(|raw| !apart(raw)) {
                return Err(ProgramError::Raw(name.clone()));
            }
            if grant.write && !written.insert(&grant.point) {
                return Err(ProgramError::Twice(grant.point.clone()));
            }
        }
        for topic in self.publishes.iter().chain(&self.listens) {
            if topic.is_empty() || topic.chars().count() > NAME_CHARS_MAX {
                return Err(ProgramError::Topic(topic.chars().take(NAME_CHARS_MAX).collect()));
            }
        }
        for text in self.components.iter().chain(&self.prefer) {
            if text.chars().count() > TEXT_CHARS_MAX {
                return Err(ProgramError::Long("a component or a preferred host"));
            }
        }
        if !(1..=100).contains(&self.share_percent) {
            return Err(ProgramError::Share(self.share_percent));
        }
        if !(MEMORY_BYTES_MIN..=MEMORY_BYTES_MAX).contains(&self.memory_bytes) {
            return Err(ProgramError::Memory(self.memory_bytes));
        }
        Ok(())
    }

    /// May it publish on this topic?
    #[must_use]
    pub fn may_publish(&self, topic: &str) -> bool {
        self.publishes.iter().any(|granted| covers(granted, topic))
    }

    /// May it listen to this topic?
    #[must_use]
    pub fn may_listen(&self, topic: &str) -> bool {
        self.listens.iter().any(|granted| covers(granted, topic))
    }

    /// The points that it may write.
    pub fn written(&self) -> impl Iterator<Item = &PointId> {
        self.grants
            .values()
            .filter(|grant| grant.write)
            .map(|grant| &grant.point)
    }
}

fn covers(granted: &str, topic: &str) -> bool {
    match granted.strip_suffix('*') {
        Some(beginning) => topic.starts_with(beginning),
        None => granted == topic,
    }
}

/// Who runs a program: of two that believe it is theirs, the one with the greater term. Kept by the home, and by it alone.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fence {
    /// The owner.
    pub owner: HostId,
    /// Number of the ownership; only grows.
    pub term: u64,
}

impl Fence {
    /// May this host act for the program under this term?
    #[must_use]
    pub fn admits(&self, host: &HostId, term: u64) -> bool {
        self.owner == *host && self.term == term
    }

    /// The next ownership.
    #[must_use]
    pub fn given_to(&self, owner: HostId) -> Self {
        Self {
            owner,
            term: self.term + 1,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    fn grant(point: &str, write: bool) -> Grant {
        Grant {
            point: PointId::new(point).unwrap(),
            write,
            raw: Some((70.0, 500.0)),
            range: (0.0, 100.0),
            unit: "%".into(),
        }
    }

    fn spec() -> ProgramSpec {
        ProgramSpec {
            id: ProgramId::new("level").unwrap(),
            revision: 1,
            digest: Digest::of(b"lua3c"),
            home: HostId::new("plant").unwrap(),
            grants: BTreeMap::from([
                ("ain-0".into(), grant("tank.level", false)),
                ("aout-2".into(), grant("tank.pump", true)),
            ]),
            publishes: vec!["n3c.*".into()],
            listens: vec!["n3c.10".into()],
            components: vec![],
            share_percent: 25,
            memory_bytes: 4 << 20,
            prefer: vec![],
            wanted: Wanted::Running,
        }
    }

    #[test]
    fn a_good_specification_passes_and_each_bad_part_is_named() {
        assert_eq!(spec().check(), Ok(()));
        type Spoil = fn(&mut ProgramSpec);
        let table: [(Spoil, &str); 7] = [
            (
                |s| drop(s.grants.insert("A".into(), grant("x", false))),
                "the grant \"A\"",
            ),
            (
                |s| drop(s.grants.insert("b".into(), grant("tank.pump", true))),
                "granted for writing twice",
            ),
            (
                |s| s.grants.values_mut().for_each(|g| g.raw = Some((1.0, 1.0))),
                "two different finite ends",
            ),
            (|s| s.publishes = vec![String::new()], "topic \"\""),
            (
                |s| s.listens = vec!["x".into(); TOPICS_MAX + 1],
                "33 topics to listen to",
            ),
            (|s| s.share_percent = 0, "share_percent = 0"),
            (|s| s.memory_bytes = 1, "memory_bytes = 1"),
        ];
        for (spoil, part) in table {
            let mut bad = spec();
            spoil(&mut bad);
            let error = bad.check().expect_err(part).to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
    }

    #[test]
    fn raw_scales_go_both_ways_and_end_at_the_range() {
        let grant = grant("tank.level", true);
        assert_eq!((grant.to_program(50.0), grant.to_point(285.0)), (285.0, 50.0));
        assert_eq!((grant.to_point(9_999.0), grant.to_point(-1.0)), (100.0, 0.0));
    }

    #[test]
    fn topics_and_fences_let_through_what_they_name() {
        let spec = spec();
        assert!(spec.may_publish("n3c.7") && !spec.may_publish("n3") && !spec.may_listen("n3c.7"));
        let (a, b) = (HostId::new("a").unwrap(), HostId::new("b").unwrap());
        let first = Fence {
            owner: a.clone(),
            term: 3,
        };
        let second = first.given_to(b.clone());
        assert!(first.admits(&a, 3) && second.admits(&b, 4));
        assert!(!second.admits(&a, 3) && !second.admits(&a, 4) && !second.admits(&b, 3));
    }
}
