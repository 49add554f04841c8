//! One loop of a rollout under observation: how well it was controlled before, and whether its new component holds. Pure.
//!
//! Owns: what counts as a failure of a watched loop. Never: asks or changes anything; it is shown records, in the order of
//! their positions, and says what they mean.
//!
//! Only cycles in automatic with a measurement count, for nothing else shows how a component controls, and only those whose
//! record arrived: one that was lost on the way makes the watch longer by a cycle, and no more.

use std::collections::{BTreeSet, VecDeque};

use bumpless_core::{Event, Fault, HostId, Mode, NoData, Priority, Record};

use super::course::Fall;

/// Parts that the window before the change is made of: it is as long as it must be, and at most a part longer.
const PARTS: u32 = 32;

/// Raised alarms of one loop that are remembered. More are as if they were new: a loop has a few.
const ALARMS_MAX: usize = 64;

/// The newest cycles before a change, in parts of equal length.
#[derive(Debug, Clone, Default)]
struct Window {
    /// Sum of the absolute errors and number of cycles, oldest part first.
    parts: VecDeque<(f64, u32)>,
    cycles: u32,
}

impl Window {
    fn add(&mut self, error: f64, wanted: u32) {
        let part_max = wanted.div_ceil(PARTS).max(1);
        match self.parts.back_mut() {
            Some((sum, cycles)) if *cycles < part_max => {
                *sum += error;
                *cycles += 1;
            }
            _ => self.parts.push_back((error, 1)),
        }
        self.cycles += 1;
        while let Some((_, oldest)) = self.parts.front().copied()
            && self.cycles - oldest >= wanted
        {
            self.parts.pop_front();
            self.cycles -= oldest;
        }
    }

    fn mean(&self) -> Option<f64> {
        let sum: f64 = self.parts.iter().map(|(sum, _)| sum).sum();
        (self.cycles > 0).then(|| sum / f64::from(self.cycles))
    }
}

/// The watch over a changed loop.
#[derive(Debug, Clone)]
struct Watch {
    revision: u64,
    /// The greatest mean absolute error; none where errors are not judged.
    limit: Option<f64>,
    before: Option<f64>,
    cycles: u32,
    /// Cycles with an error that is a number, and the sum of those.
    judged: u32,
    sum: f64,
    /// Did a record of this revision arrive, now or before a restart?
    arrived: bool,
}

/// What a record says of a watched loop.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Sight {
    /// Nothing new.
    GoesOn,
    /// It ran all its cycles well.
    Passed,
    /// It failed, and why.
    Fell(Fall, String),
}

/// The observation of one loop.
#[derive(Debug, Clone)]
pub(crate) struct Eye {
    cycles_wanted: u32,
    /// The revision before the change.
    before_revision: u64,
    before: Window,
    /// Alarms of high priority that stand.
    alarms: BTreeSet<String>,
    watch: Option<Watch>,
}

/// The absolute error of a cycle, NaN where its component measures nothing; none where the cycle shows nothing, in manual or
/// without a measurement that should be there.
fn error(record: &Record, measured: Option<usize>) -> Option<f64> {
    let reading = measured.and_then(|port| record.readings.get(port));
    let measurement = match reading.map(|reading| reading.value) {
        None | Some(Err(NoData::NotConnected)) => f64::NAN,
        Some(value) => value.ok()?,
    };
    (record.mode == Mode::Automatic).then(|| (record.setpoint - measurement).abs())
}

/// Is this the fault of a host that does not have the component ready? That says nothing of the component.
fn not_ready(replica: &HostId, fault: &str) -> bool {
    let told = Fault::NotReady {
        host: replica.to_string(),
        reason: String::new(),
    };
    fault.starts_with(&told.to_string())
}

impl Eye {
    /// Looks at a loop before its change, from `revision`.
    pub(crate) const fn new(cycles_wanted: u32, revision: u64) -> Self {
        Self {
            cycles_wanted,
            before_revision: revision,
            before: Window {
                parts: VecDeque::new(),
                cycles: 0,
            },
            alarms: BTreeSet::new(),
            watch: None,
        }
    }

    /// Cycles seen before the change, up to those wanted.
    pub(crate) fn cycles_before(&self) -> u32 {
        self.before.cycles.min(self.cycles_wanted)
    }

    /// Cycles seen since the change.
    pub(crate) fn cycles(&self) -> u32 {
        self.watch.as_ref().map_or(0, |watch| watch.cycles)
    }

    /// Was the loop seen long enough to be changed?
    pub(crate) const fn ready(&self) -> bool {
        self.before.cycles >= self.cycles_wanted
    }

    /// Mean absolute error before the change; none where nothing is measured.
    pub(crate) fn error_before(&self) -> Option<f64> {
        self.before.mean().filter(|mean| mean.is_finite())
    }

    /// Mean absolute error since the change.
    pub(crate) fn error(&self) -> Option<f64> {
        let watch = self.watch.as_ref()?;
        (watch.judged > 0).then(|| watch.sum / f64::from(watch.judged))
    }

    /// The loop runs `revision` now. Its mean absolute error may be `factor` times that of `before`, and always `floor`.
    /// `arrived` where records of it were seen before a restart.
    pub(crate) fn changed(&mut self, revision: u64, before: Option<f64>, factor: f64, floor: f64, arrived: bool) {
        self.watch = Some(Watch {
            revision,
            limit: before.map(|before| (before * factor).max(floor)),
            before,
            cycles: 0,
            judged: 0,
            sum: 0.0,
            arrived,
        });
    }

    /// A record of the loop. `measured` is the number of the port that its component measures.
    pub(crate) fn see(&mut self, record: &Record, measured: Option<usize>) -> Sight {
        let news = self.alarms_of(record);
        let Some(watch) = &mut self.watch else {
            if let Some(error) = error(record, measured)
                && record.revision == self.before_revision
            {
                self.before.add(error, self.cycles_wanted);
            }
            return Sight::GoesOn;
        };
        let went_back = record.events.iter().find_map(|event| match event {
            Event::RolledBack { from, reason } if *from == watch.revision => Some(reason),
            _ => None,
        });
        if let Some(reason) = went_back {
            return Sight::Fell(Fall::WentBack, reason.clone());
        }
        if record.revision != watch.revision {
            return match record.revision {
                // A record of the cycles before the change may still be on its way.
                before if before == self.before_revision && !watch.arrived => Sight::GoesOn,
                before if before == self.before_revision => {
                    Sight::Fell(Fall::WentBack, format!("it went back to revision {before} by itself"))
                }
                other => Sight::Fell(
                    Fall::Others,
                    format!("somebody changed it meanwhile: revision {other} is in force"),
                ),
            };
        }
        watch.arrived = true;
        let faulted = record.events.iter().find_map(|event| match event {
            Event::Faulted { replica, fault } if !not_ready(replica, fault) => Some((replica, fault)),
            _ => None,
        });
        if let Some((replica, fault)) = faulted {
            return Sight::Fell(
                Fall::Runs,
                format!("in cycle {} of its watch: {fault} (host {replica})", watch.cycles + 1),
            );
        }
        if let Some(alarm) = news {
            return Sight::Fell(Fall::Runs, format!("it raised a new alarm of high priority: {alarm}"));
        }
        let Some(error) = error(record, measured) else {
            return Sight::GoesOn;
        };
        watch.cycles += 1;
        if error.is_finite() {
            watch.judged += 1;
            watch.sum += error;
        }
        // Errors only add up, so what is beyond the limit now stays there.
        if let (Some(limit), Some(before)) = (watch.limit, watch.before)
            && watch.sum > limit * f64::from(self.cycles_wanted)
        {
            let mean = watch.sum / f64::from(watch.judged.max(1));
            return Sight::Fell(
                Fall::Runs,
                format!(
                    "its mean absolute error is {mean:.4} after {} of {} cycles; before the change it was {before:.4}",
                    watch.cycles, self.cycles_wanted
                ),
            );
        }
        if watch.cycles >= self.cycles_wanted {
            Sight::Passed
        } else {
            Sight::GoesOn
        }
    }

    /// Notes what a record raises and clears. Gives what is raised, stood not before, and is of high priority.
    fn alarms_of(&mut self, record: &Record) -> Option<String> {
        let mut news = None;
        for change in &record.alarms {
            match &change.raised {
                Some((Priority::High, text)) => {
                    let stood = self.alarms.contains(&change.name);
                    if !stood && self.alarms.len() < ALARMS_MAX {
                        self.alarms.insert(change.name.clone());
                    }
                    if !stood {
                        news.get_or_insert_with(|| format!("{} ({text})", change.name));
                    }
                }
                _ => {
                    self.alarms.remove(&change.name);
                }
            }
        }
        news
    }
}

#[cfg(test)]
mod tests;
