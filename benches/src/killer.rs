//! Kills of a loop's owner while the loop is changed again and again: when, by a seed, and in which phase of a change each was.
//!
//! ```text
//!   asked ──► the switch's record ──► told ──► … ──► the end of the probation ──► asked …
//!     preparing        switched       on probation                  in service
//! ```
//! The phase of a kill is found afterwards, from the times of questions and answers and from the records, so nothing is asked
//! of the cell between the choice of the moment and the kill. Never: judges.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use bumpless_tests::{Cell, Kind, Schedule, unix_ns};

use crate::{
    error::Error,
    history::{History, Seen},
};

/// Between the return of a killed host and the next kill, at most, in ms; the seed spreads the moment over it.
const SPREAD_MS: u64 = 400;

/// One change of the loop, as its asker saw it; times in ns since 1970.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Asked {
    /// When it was asked for.
    pub(crate) from_ns: u64,
    /// When the answer came.
    pub(crate) to_ns: u64,
}

/// Where in the course of a change a kill hit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Phase {
    /// Asked for, and no record of the new revision yet.
    Preparing,
    /// In force, and not told.
    Switched,
    /// Told, and on probation.
    Probation,
    /// No change under way.
    InService,
}

impl Phase {
    /// All of them, in order.
    pub(crate) const ALL: [Self; 4] = [Self::Preparing, Self::Switched, Self::Probation, Self::InService];

    /// Its name in a figure.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Preparing => "preparing",
            Self::Switched => "switched",
            Self::Probation => "on_probation",
            Self::InService => "in_service",
        }
    }

    /// The phase at a time. `seen` are the loop's records in order, `asked` the changes in order.
    pub(crate) fn at(at_ns: u64, seen: &[Seen], asked: &[Asked]) -> Self {
        let open = asked.iter().find(|a| (a.from_ns..a.to_ns).contains(&at_ns));
        let before = seen.partition_point(|record| record.at_ns <= at_ns);
        let before = seen.get(..before).unwrap_or_default();
        if let Some(open) = open {
            let switched = before
                .iter()
                .rev()
                .take_while(|record| record.at_ns >= open.from_ns)
                .any(|record| record.bump_percent.is_some());
            return if switched { Self::Switched } else { Self::Preparing };
        }
        match before.last() {
            Some(record) if record.on_probation => Self::Probation,
            _ => Self::InService,
        }
    }
}

/// Has the cell while the loop is changed, and kills the loop's owner again and again, if it is to.
pub(crate) struct Killer {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Result<(Cell, Vec<u64>), Error>>,
}

impl Killer {
    /// Begins; no kills without a seed.
    pub(crate) fn start(
        mut cell: Cell,
        seed: Option<u64>,
        loop_name: &'static str,
        history: Arc<History>,
    ) -> Result<Self, Error> {
        let stop = Arc::new(AtomicBool::new(false));
        let stop_there = Arc::clone(&stop);
        let thread = std::thread::Builder::new()
            .name("killer".to_owned())
            .spawn(move || {
                let moments = seed.map(|seed| Schedule::new(seed, &[Kind::Kill], 1, (0, SPREAD_MS)));
                let mut killed_ns = Vec::new();
                for moment in moments.into_iter().flatten() {
                    std::thread::sleep(Duration::from_millis(moment.quiet_ms));
                    if stop_there.load(Ordering::Relaxed) {
                        break;
                    }
                    let Some(owner) = history.last(loop_name).map(|record| record.owner) else {
                        continue;
                    };
                    let place = history.place();
                    killed_ns.push(unix_ns());
                    cell.host(&owner)?.kill9();
                    history.wait("another owner", place, |record| record.owner != owner)?;
                    cell.restart(&owner)?;
                    cell.wait_joined()?;
                }
                Ok((cell, killed_ns))
            })
            .map_err(Error::io("the killer's thread cannot be started"))?;
        Ok(Self { stop, thread })
    }

    /// Ends it; gives the cell back, and when each kill was, in ns since 1970.
    pub(crate) fn finish(self) -> Result<(Cell, Vec<u64>), Error> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_else(|_| {
            Err(Error::Waited {
                what: "the end of the kills".to_owned(),
                seconds: 0,
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_phase_of_a_moment_is_told_by_the_answers_and_the_records() {
        let record = |at_ns: u64, switched: bool, on_probation: bool| Seen {
            bump_percent: switched.then_some(0.0),
            on_probation,
            ..Seen::of_cycle(at_ns)
        };
        let seen = [
            record(10, false, false),
            record(20, false, false),
            record(30, true, true),
            record(40, false, true),
            record(50, false, true),
            record(60, false, false),
            record(80, true, true),
        ];
        let asked = [Asked { from_ns: 15, to_ns: 45 }, Asked { from_ns: 62, to_ns: 70 }];
        for (at_ns, phase) in [
            (12, Phase::InService),
            (16, Phase::Preparing),
            (29, Phase::Preparing),
            (31, Phase::Switched),
            (44, Phase::Switched),
            (46, Phase::Probation),
            (61, Phase::InService),
            (65, Phase::Preparing),
            (75, Phase::InService),
            (90, Phase::Probation),
        ] {
            assert_eq!(Phase::at(at_ns, &seen, &asked), phase, "at {at_ns}");
        }
    }
}
