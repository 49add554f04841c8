//! What is simulated: the cell's size, how long, which faults, and when each of them strikes.
//!
//! Owns the schedule of faults, from the seed or from a file. Never: acts on it.
//!
//! ```toml
//! [[fault]]
//! kind = "pause"       # kill, pause, partition, loss, saturation, clock, disk, slow, bits
//! at_ms = 2000
//! for_ms = 500
//! hosts = [3]          # for a partition: those on one side
//! one_way = false      # a partition that lets through what comes from them
//! ```

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use crate::{Error, random::Random};

/// Hosts of one simulation: numbers and rankings are kept for each.
pub const HOSTS_MAX: u32 = 10_000;
/// Loops of one simulation: some kilobytes each.
pub const LOOPS_MAX: u32 = 500_000;
/// Faults of one schedule.
pub const FAULTS_MAX: usize = 100_000;
/// Simulated time in seconds.
pub const SECONDS_MAX: u64 = 86_400;

const MS: u64 = 1_000_000;

/// What can go wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// A host dies with all that its disk does not have, and starts again.
    Kill,
    /// A host stands still and goes on, as under SIGSTOP or on a stalled machine.
    Pause,
    /// Some hosts and the others do not hear each other, in one or both directions.
    Partition,
    /// A host's links lose, repeat and delay messages.
    Loss,
    /// A host's links carry few messages: they queue, and what finds no room is dropped.
    Saturation,
    /// A host restarts with a clock that is hours away from what it was.
    Clock,
    /// A host's disk takes no more writes.
    Disk,
    /// A host is twenty times slower.
    Slow,
    /// A host's steps come out wrong now and then; only loops that vote are stepped so.
    Bits,
}

impl FaultKind {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::Kill,
        Self::Pause,
        Self::Partition,
        Self::Loss,
        Self::Saturation,
        Self::Clock,
        Self::Disk,
        Self::Slow,
        Self::Bits,
    ];

    /// The word for it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Kill => "kill",
            Self::Pause => "pause",
            Self::Partition => "partition",
            Self::Loss => "loss",
            Self::Saturation => "saturation",
            Self::Clock => "clock",
            Self::Disk => "disk",
            Self::Slow => "slow",
            Self::Bits => "bits",
        }
    }
}

impl fmt::Display for FaultKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for FaultKind {
    type Err = Error;
    fn from_str(text: &str) -> Result<Self, Error> {
        let known = Self::ALL.map(Self::name).join(", ");
        Self::ALL
            .into_iter()
            .find(|kind| kind.name() == text)
            .ok_or_else(|| Error::Fault {
                found: text.chars().take(40).collect(),
                known,
            })
    }
}

/// One fault.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// What goes wrong.
    pub kind: FaultKind,
    /// When, in ms since the start.
    pub at_ms: u64,
    /// For how long, in ms. A kill: until the host starts again.
    pub for_ms: u64,
    /// The hosts, by number from 0.
    pub hosts: Vec<u32>,
    /// A partition that lets through what comes from these hosts.
    #[serde(default)]
    pub one_way: bool,
}

/// A file of faults.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Schedule {
    /// In any order.
    #[serde(default)]
    pub fault: Vec<Fault>,
}

impl Schedule {
    /// Reads the text of a file.
    ///
    /// # Errors
    /// [`Error::Schedule`].
    pub fn parse(text: &str) -> Result<Self, Error> {
        toml::from_str(text).map_err(|error| Error::Schedule(error.to_string()))
    }
}

/// A rule of the product, taken away, to see that the simulation notices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Broken {
    /// The home takes commits of owners before.
    NoTerms,
    /// Owners go on from any record, and the home does not look.
    AnyBase,
    /// The state is taken without its output.
    OutputsApart,
    /// A home that restarts begins its terms anew.
    TermsAgain,
    /// A command is acknowledged when its record is taken, whoever has it.
    ToldTooSoon,
    /// A vote takes the first answer.
    FirstAnswer,
    /// Whoever asks for the last record, or takes over, does not get it.
    NoResume,
    /// Owners do not say which record theirs goes on from, and the home does not ask.
    Unchained,
}

impl Broken {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::NoTerms,
        Self::AnyBase,
        Self::OutputsApart,
        Self::TermsAgain,
        Self::ToldTooSoon,
        Self::FirstAnswer,
        Self::NoResume,
        Self::Unchained,
    ];

    /// The word for it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::NoTerms => "no-terms",
            Self::AnyBase => "any-base",
            Self::OutputsApart => "outputs-apart",
            Self::TermsAgain => "terms-again",
            Self::ToldTooSoon => "told-too-soon",
            Self::FirstAnswer => "first-answer",
            Self::NoResume => "no-resume",
            Self::Unchained => "unchained",
        }
    }
}

impl FromStr for Broken {
    type Err = Error;
    fn from_str(text: &str) -> Result<Self, Error> {
        Self::ALL
            .into_iter()
            .find(|broken| broken.name() == text)
            .ok_or_else(|| Error::Rule {
                found: text.chars().take(40).collect(),
                known: Self::ALL.map(Self::name).join(", "),
            })
    }
}

/// What is simulated. Two simulations of one plan are the same to the last event.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Everything random follows from it.
    pub seed: u64,
    /// Hosts, 1 to [`HOSTS_MAX`]. Each serves points and runs controllers.
    pub hosts: u32,
    /// Loops, 1 to [`LOOPS_MAX`], their homes spread evenly.
    pub loops: u32,
    /// Time during which faults strike, in s.
    pub seconds: u64,
    /// Time after the last fault in which every loop must find its way, in s.
    pub calm_seconds: u64,
    /// Faults that strike; none for a calm cell.
    pub kinds: Vec<FaultKind>,
    /// Faults per host and minute, on the mean.
    pub faults_per_host_minute: f64,
    /// Instead of faults drawn from the seed.
    pub schedule: Option<Schedule>,
    /// A rule that is broken on purpose.
    pub broken: Option<Broken>,
    /// Events of this loop, and of its hosts, are written down.
    pub trace: Option<u32>,
}

impl Default for Plan {
    fn default() -> Self {
        Self {
            seed: 1,
            hosts: 10,
            loops: 100,
            seconds: 60,
            calm_seconds: 30,
            kinds: FaultKind::ALL.to_vec(),
            faults_per_host_minute: 1.0,
            schedule: None,
            broken: None,
            trace: None,
        }
    }
}

impl Plan {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Plan`], naming the number and its range.
    pub fn check(&self) -> Result<(), Error> {
        let wrong = |what: &str, found: u64, low: u64, high: u64| {
            Error::Plan(format!("{what} is {found}; use {low} to {high}"))
        };
        let within = |what: &str, found: u64, low: u64, high: u64| {
            if (low..=high).contains(&found) {
                Ok(())
            } else {
                Err(wrong(what, found, low, high))
            }
        };
        within("hosts", u64::from(self.hosts), 1, u64::from(HOSTS_MAX))?;
        within("loops", u64::from(self.loops), 1, u64::from(LOOPS_MAX))?;
        within("seconds", self.seconds, 1, SECONDS_MAX)?;
        within("calm seconds", self.calm_seconds, 1, SECONDS_MAX)?;
        if !(0.0..=600.0).contains(&self.faults_per_host_minute) {
            return Err(Error::Plan(format!(
                "faults per host and minute is {}; use 0 to 600",
                self.faults_per_host_minute
            )));
        }
        for fault in self.schedule.iter().flat_map(|s| &s.fault) {
            if let Some(host) = fault.hosts.iter().find(|h| **h >= self.hosts) {
                return Err(Error::Plan(format!(
                    "a {} names host {host}; there are hosts 0 to {}",
                    fault.kind,
                    self.hosts - 1
                )));
            }
            let end_ms = fault.at_ms.saturating_add(fault.for_ms);
            if fault.hosts.is_empty() || end_ms > self.seconds * 1000 {
                return Err(Error::Plan(format!(
                    "a {} at {} ms for {} ms: it must name a host and end within {} s",
                    fault.kind, fault.at_ms, fault.for_ms, self.seconds
                )));
            }
        }
        let faults = self
            .schedule
            .as_ref()
            .map_or(self.drawn_faults(), |s| s.fault.len() as f64);
        if faults > FAULTS_MAX as f64 {
            return Err(Error::Plan(format!(
                "{faults} faults; at most {FAULTS_MAX} are possible"
            )));
        }
        Ok(())
    }

    fn drawn_faults(&self) -> f64 {
        f64::from(self.hosts) * self.faults_per_host_minute * self.seconds as f64 / 60.0
    }

    /// The faults in the order in which they strike.
    #[must_use]
    pub fn faults(&self) -> Vec<Fault> {
        let mut faults = match &self.schedule {
            Some(schedule) => schedule.fault.clone(),
            None => self.draw(),
        };
        faults.sort_by_key(|fault| fault.at_ms);
        faults
    }

    fn draw(&self) -> Vec<Fault> {
        let mut random = Random::new(self.seed, "faults");
        if self.kinds.is_empty() {
            return Vec::new();
        }
        let count = self.drawn_faults().ceil().min(FAULTS_MAX as f64) as usize;
        let end_ms = self.seconds * 1000;
        let one = |random: &mut Random| {
            let kind = self.kinds[(random.next() % self.kinds.len() as u64) as usize];
            // The first half second is the cell's own.
            let at_ms = random.between(500, end_ms);
            let for_ms = match kind {
                FaultKind::Pause => random.spread(MS, 60_000 * MS) / MS,
                FaultKind::Kill | FaultKind::Clock => random.spread(50, 20_000),
                FaultKind::Partition => random.spread(20, 30_000),
                FaultKind::Loss | FaultKind::Saturation | FaultKind::Disk | FaultKind::Slow | FaultKind::Bits => {
                    random.spread(100, 20_000)
                }
            };
            let host = random.between(0, u64::from(self.hosts)) as u32;
            let mut hosts = vec![host];
            if kind == FaultKind::Partition && self.hosts > 3 {
                let more = random.between(0, u64::from(self.hosts.min(10)) / 2);
                hosts.extend((0..more).map(|_| random.between(0, u64::from(self.hosts)) as u32));
                hosts.sort_unstable();
                hosts.dedup();
            }
            Fault {
                kind,
                at_ms,
                for_ms: for_ms.max(1).min(end_ms - at_ms.min(end_ms)),
                hosts,
                one_way: kind == FaultKind::Partition && random.chance(0.4),
            }
        };
        (0..count).map(|_| one(&mut random)).collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn faults_follow_from_the_seed_and_end_in_time() {
        let plan = Plan::default();
        let faults = plan.faults();
        assert_eq!(faults, plan.faults());
        assert_ne!(
            faults,
            Plan {
                seed: 2,
                ..plan.clone()
            }
            .faults()
        );
        assert_eq!(faults.len(), 10);
        assert!(faults.iter().all(|f| f.at_ms + f.for_ms <= 60_000 && f.for_ms > 0));
    }

    #[test]
    fn a_file_of_faults_is_taken_as_it_stands_and_bad_ones_say_why() {
        let text = "[[fault]]\nkind = \"kill\"\nat_ms = 10\nfor_ms = 5\nhosts = [3]\n";
        let schedule = Schedule::parse(text).unwrap();
        let plan = |schedule| Plan {
            schedule: Some(schedule),
            ..Plan::default()
        };
        assert!(plan(schedule.clone()).check().is_ok());
        assert_eq!(plan(schedule.clone()).faults(), schedule.fault);
        for (text, part) in [
            ("[[fault]]\nkind = \"flood\"", "unknown variant `flood`"),
            ("[[faults]]\n", "unknown field `faults`"),
            ("[[fault]]\nkind = \"kill\"\nat_ms = -1", "at_ms"),
        ] {
            let error = Schedule::parse(text).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
        for (from, to, part) in [
            ("[3]", "[10]", "names host 10; there are hosts 0 to 9"),
            ("[3]", "[]", "must name a host"),
            ("at_ms = 10", "at_ms = 59999", "end within 60 s"),
        ] {
            let error = plan(Schedule::parse(&text.replace(from, to)).unwrap())
                .check()
                .unwrap_err();
            assert!(error.to_string().contains(part), "{error}");
        }
    }

    #[test]
    fn numbers_out_of_range_are_refused_by_name() {
        let good = Plan::default();
        for (plan, part) in [
            (
                Plan {
                    hosts: 0,
                    ..good.clone()
                },
                "hosts is 0; use 1 to 10000",
            ),
            (
                Plan {
                    loops: 0,
                    ..good.clone()
                },
                "loops is 0",
            ),
            (
                Plan {
                    seconds: 0,
                    ..good.clone()
                },
                "seconds is 0",
            ),
            (
                Plan {
                    faults_per_host_minute: f64::NAN,
                    ..good.clone()
                },
                "use 0 to 600",
            ),
        ] {
            let error = plan.check().unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
        assert!(
            "flood"
                .parse::<FaultKind>()
                .unwrap_err()
                .to_string()
                .contains("kill, pause")
        );
        assert!("none".parse::<Broken>().unwrap_err().to_string().contains("no-terms"));
    }
}
