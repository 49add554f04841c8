//! One run: plant, network, home and hosts in virtual time, around the very functions that a live host calls.
//!
//! ```text
//! plant ── poll ──► reads ──► image ── deadline: Desk ── Sample ──► seat (see `seat`) ── Commit ──► Desk ── writes ──► plant
//! ```
//! Owns the queue of events and the plant's side. What is due at one moment happens in the order of [`What::class`]: first the
//! world, then messages, then deadlines, then looks. Never: a thread, a clock, or a number that does not follow from the seed.

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashMap},
    sync::Arc,
};

use bumpless_core::{
    Command, CommandBody, CommandId, Effects, Fault, HostId, NoData, Reading, Record, desk::Desk, protocol::Sample,
};
use bumpless_io::sim::{Model, SignalRole};

use crate::{
    error::Error,
    experiment::Experiment,
    limits::{MESSAGES_MAX, NOTES_MAX},
    meter::{Figures, Meter, setpoint_at},
    network::{Dice, Line},
    result::{LoopResult, Note},
    seat::{Host, Revision, Running},
};

/// What the event queue holds.
#[derive(Debug)]
pub(crate) enum What {
    /// A disturbance, by number.
    Disturb(usize),
    /// An event, by number.
    Happen(usize),
    /// A host is on again.
    Back(usize),
    /// The home hears whether a host is there.
    News,
    /// The devices of a loop are read.
    Poll(usize),
    /// Readings arrive at the home: signal, value, when it was read.
    Readings(Vec<(usize, f64, u64)>),
    /// Writes arrive at the actuators.
    Writes {
        of: usize,
        values: Vec<(usize, f64)>,
        read_ns: Option<u64>,
    },
    /// A sample arrives at its owner.
    Sample(usize, Box<Sample>),
    /// A replica is asked for a step.
    Asked {
        of: usize,
        owner: usize,
        host: usize,
        term: u64,
        seq: u64,
    },
    /// A step's answer arrives at the owner.
    Answered {
        of: usize,
        owner: usize,
        host: usize,
        term: u64,
        seq: u64,
        result: Box<Result<Effects, Fault>>,
    },
    /// A commit arrives at the home.
    Commit(usize, Box<Record>),
    /// The owner has waited long enough for a replica.
    SeatDue { of: usize, owner: usize, at_ns: u64 },
    /// A deadline of a loop.
    Deadline(usize),
    /// A commit may be overdue.
    Overdue(usize),
    /// Time to look.
    Look(usize),
}

impl What {
    /// The order of what is due at one moment.
    const fn class(&self) -> u8 {
        match self {
            Self::Disturb(_) | Self::Happen(_) | Self::Back(_) => 0,
            Self::News | Self::Poll(_) => 1,
            Self::Readings(_) => 2,
            Self::Writes { .. } => 3,
            Self::Sample(..) | Self::Asked { .. } | Self::Answered { .. } | Self::Commit(..) => 4,
            Self::Deadline(_) => 5,
            Self::SeatDue { .. } | Self::Overdue(_) => 6,
            Self::Look(_) => 7,
        }
    }
}

#[derive(Debug)]
struct Due {
    at_ns: u64,
    class: u8,
    number: u64,
    what: What,
}

impl PartialEq for Due {
    fn eq(&self, other: &Self) -> bool {
        self.number == other.number
    }
}
impl Eq for Due {}
impl PartialOrd for Due {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Due {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.at_ns, self.class, self.number).cmp(&(other.at_ns, other.class, other.number))
    }
}

/// A signal as the home knows it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Known {
    pub(crate) reading: Reading,
    /// What was sent last, of a signal that is set.
    pub(crate) sent: Option<f64>,
}

/// What an instrument does to a signal.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Instrument {
    pub(crate) noise: f64,
    pub(crate) steps: Option<f64>,
    pub(crate) range: Option<(f64, f64)>,
}

/// One loop.
pub(crate) struct LoopRun {
    pub(crate) desk: Desk,
    pub(crate) held: Vec<Revision>,
    /// Signal of each point of the loop, by its name.
    pub(crate) signals: HashMap<String, usize>,
    /// Signals that are read for it.
    pub(crate) inputs: Vec<usize>,
    pub(crate) measured: usize,
    pub(crate) output: Option<usize>,
    pub(crate) period_ns: u64,
    pub(crate) poll_ns: u64,
    pub(crate) look_ns: u64,
    pub(crate) meter: Meter,
    pub(crate) wanted: f64,
    pub(crate) commands: u128,
    pub(crate) by: u8,
    pub(crate) jitter: Dice,
}

/// One run.
pub(crate) struct World<'a> {
    pub(crate) plan: &'a Experiment,
    queue: BinaryHeap<Reverse<Due>>,
    pub(crate) count: u64,
    pub(crate) now_ns: u64,
    pub(crate) model: Box<dyn Model>,
    pub(crate) image: Vec<Known>,
    pub(crate) instruments: Vec<Instrument>,
    pub(crate) seed: u64,
    pub(crate) reads: [Line; 2],
    pub(crate) writes: [Line; 2],
    pub(crate) link: Line,
    pub(crate) hosts: Vec<Host>,
    pub(crate) loops: Vec<LoopRun>,
    /// Revisions that events bring, by event and loop.
    pub(crate) waiting: HashMap<(usize, usize), Revision>,
    pub(crate) notes: Vec<Note>,
    pub(crate) notes_dropped: u64,
    pub(crate) cancelled: &'a dyn Fn() -> bool,
}

/// What a loop is made of, resolved.
pub(crate) struct LoopParts {
    pub(crate) revision: Revision,
    pub(crate) signals: HashMap<String, usize>,
    pub(crate) measured: usize,
}

/// Everything that a run is made of.
pub(crate) struct Parts<'a> {
    pub(crate) plan: &'a Experiment,
    pub(crate) seed: u64,
    pub(crate) traced: bool,
    pub(crate) model: Box<dyn Model>,
    pub(crate) loops: Vec<LoopParts>,
    pub(crate) waiting: HashMap<(usize, usize), Revision>,
    pub(crate) cancelled: &'a dyn Fn() -> bool,
}

pub(crate) fn ns(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}

impl<'a> World<'a> {
    pub(crate) fn new(parts: Parts<'a>) -> Result<Self, Error> {
        let Parts {
            plan,
            seed,
            traced,
            mut model,
            loops,
            waiting,
            cancelled,
        } = parts;
        let number = |name: &str| model.signals().iter().position(|s| s.name == name);
        let unknown = |place: String, name: &str, model: &dyn Model| {
            let known: Vec<&str> = model.signals().iter().map(|s| s.name.as_str()).collect();
            Error::at(
                place,
                format!("the plant has no signal {name:?}; it has {}", known.join(", ")),
            )
        };
        for name in plan
            .disturbances
            .iter()
            .map(|d| &d.signal)
            .chain(plan.plant.initial.keys())
        {
            if number(name).is_none() {
                return Err(unknown("[[disturbance]] and plant.initial".to_owned(), name, &*model));
            }
        }
        let mut instruments = vec![
            Instrument {
                noise: 0.0,
                steps: None,
                range: None,
            };
            model.signals().len()
        ];
        for i in &plan.instruments {
            let place = number(&i.signal);
            let Some((slot, signal)) = place.and_then(|n| Some((instruments.get_mut(n)?, model.signals().get(n)?)))
            else {
                return Err(unknown(format!("instrument {:?}", i.signal), &i.signal, &*model));
            };
            slot.noise = i.noise;
            slot.steps = i.bits.map(|bits| f64::from(1_u32 << bits.min(24)));
            slot.range = i.range.or_else(|| i.bits.map(|_| (signal.low, signal.high)));
        }
        let initial: Vec<(usize, f64)> = plan
            .plant
            .initial
            .iter()
            .filter_map(|(name, value)| Some((number(name)?, *value)))
            .collect();
        for (signal, value) in initial {
            model.set(signal, value);
        }
        let home = HostId::new("home").map_err(|e| Error::at("cell", e.to_string()))?;
        let mut hosts = vec![Host::home(home.clone(), seed, loops.len())];
        for host in &plan.cell.hosts {
            hosts.push(Host::of(host, seed, loops.len())?);
        }
        let runs = loops
            .into_iter()
            .zip(&plan.loops)
            .map(|(parts, l)| {
                let period_ns = ns(l.period_ms * 1e-3);
                let spec = Arc::clone(&parts.revision.spec);
                let output = parts
                    .revision
                    .wiring
                    .outputs
                    .first()
                    .and_then(|port| parts.revision.wiring.points.get(usize::from(*port))?.as_ref())
                    .and_then(|point| parts.signals.get(point.as_str()).copied());
                let is_input = |signal: &usize| {
                    model
                        .signals()
                        .get(*signal)
                        .is_some_and(|s| s.role == SignalRole::Measures)
                };
                let mut inputs: Vec<usize> = parts.signals.values().copied().filter(is_input).collect();
                inputs.sort_unstable();
                inputs.dedup();
                LoopRun {
                    desk: Desk::new(home.clone(), spec, None, 0, ns(l.phase_ms * 1e-3)),
                    held: vec![parts.revision],
                    signals: parts.signals,
                    inputs,
                    measured: parts.measured,
                    output,
                    period_ns,
                    poll_ns: plan.network.poll_ms.map_or(period_ns, |ms| ns(ms * 1e-3)).max(1),
                    look_ns: plan.measure.every_ms.map_or(period_ns, |ms| ns(ms * 1e-3)).max(1),
                    meter: Meter::new(&plan.measure, traced),
                    wanted: setpoint_at(&l.setpoint, 0.0),
                    commands: 0,
                    by: 0,
                    jitter: Dice::new(seed, &format!("jitter {}", l.name)),
                }
            })
            .collect();
        let never = Known {
            reading: Reading::missing(NoData::NeverRead, 0.0, 0),
            sent: None,
        };
        let line = |channel, stream| Line::new(channel, seed, stream);
        Ok(Self {
            plan,
            queue: BinaryHeap::new(),
            count: 0,
            now_ns: 0,
            image: vec![never; model.signals().len()],
            model,
            instruments,
            seed,
            // One stream for what both suffer, so that outages come at the same time.
            reads: [line(&plan.network.both, "both"), line(&plan.network.reads, "reads")],
            writes: [line(&plan.network.both, "both"), line(&plan.network.writes, "writes")],
            link: line(&plan.cell.link, "link"),
            hosts,
            loops: runs,
            waiting,
            notes: Vec::new(),
            notes_dropped: 0,
            cancelled,
        })
    }

    pub(crate) fn at(&mut self, at_ns: u64, what: What) {
        self.count += 1;
        self.queue.push(Reverse(Due {
            at_ns,
            class: what.class(),
            number: self.count,
            what,
        }));
    }

    pub(crate) fn note(&mut self, text: String) {
        if self.notes.len() < NOTES_MAX {
            self.notes.push(Note {
                at_s: self.now_ns as f64 * 1e-9,
                text,
            });
        } else {
            self.notes_dropped += 1;
        }
    }

    fn failed(&self, problem: impl Into<String>) -> Error {
        Error::Run {
            run: format!("{}, seed {}", self.plan.name, self.seed),
            at_s: self.now_ns as f64 * 1e-9,
            problem: problem.into(),
        }
    }

    /// Runs to the end.
    pub(crate) fn run(mut self) -> Result<(Vec<LoopResult>, Vec<Note>, u64), Error> {
        let end_ns = ns(self.plan.duration_s);
        for (n, d) in self.plan.disturbances.iter().enumerate() {
            self.at(ns(d.at_s), What::Disturb(n));
        }
        for (n, event) in self.plan.events.iter().enumerate() {
            self.at(ns(event.at_s()), What::Happen(n));
        }
        self.model
            .advance(0)
            .map_err(|halted| self.failed(halted.to_string()))?;
        for n in 0..self.loops.len() {
            self.members(n);
            let first_ns = self.loops.get(n).map_or(0, |l| l.desk.deadline_at_ns());
            self.at(0, What::Poll(n));
            self.at(0, What::Look(n));
            self.at(first_ns, What::Deadline(n));
            // Where the setpoint moves is looked at too, so that a step is a step in the figures.
            for m in self
                .plan
                .loops
                .get(n)
                .map_or(&[][..], |l| &l.setpoint[..])
                .iter()
                .skip(1)
            {
                self.at(ns(m.at_s), What::Look(usize::MAX - n));
            }
        }
        let mut turns = 0_u64;
        while let Some(Reverse(due)) = self.queue.pop() {
            if due.at_ns > end_ns {
                break;
            }
            turns += 1;
            if turns.is_multiple_of(4096) {
                if (self.cancelled)() {
                    return Err(Error::Stopped);
                }
                if self.queue.len() > MESSAGES_MAX {
                    return Err(self.failed("too many messages are on their way; shorten the delays"));
                }
            }
            if due.at_ns > self.now_ns {
                self.now_ns = due.at_ns;
                self.model
                    .advance(due.at_ns)
                    .map_err(|halted| self.failed(halted.to_string()))?;
            }
            self.turn(due.what);
        }
        self.now_ns = end_ns;
        Ok(self.end())
    }

    fn turn(&mut self, what: What) {
        match what {
            What::Disturb(n) => {
                if let Some(d) = self.plan.disturbances.get(n)
                    && let Some(signal) = self.model.signals().iter().position(|s| s.name == d.signal)
                {
                    self.model.set(signal, d.to);
                    self.note(format!("{} = {}", d.signal, d.to));
                }
            }
            What::Happen(n) => self.happen(n),
            What::Back(host) => self.switch(host, true),
            What::News => {
                for n in 0..self.loops.len() {
                    self.members(n);
                }
            }
            What::Poll(n) => self.poll(n),
            What::Readings(values) => self.arrived(&values),
            What::Writes { of, values, read_ns } => self.written(of, &values, read_ns),
            What::Sample(of, sample) => self.sample(of, sample),
            What::Asked {
                of,
                owner,
                host,
                term,
                seq,
            } => self.asked(of, owner, host, (term, seq)),
            What::Answered {
                of,
                owner,
                host,
                term,
                seq,
                result,
            } => self.answered(of, owner, host, (term, seq), *result),
            What::Commit(of, record) => self.commit(of, *record),
            What::SeatDue { of, owner, at_ns } => self.seat_due(of, owner, at_ns),
            What::Deadline(n) => self.deadline(n),
            What::Overdue(n) => {
                let now_ns = self.now_ns;
                let dispatch = self.loops.get_mut(n).and_then(|l| l.desk.overdue(now_ns));
                self.dispatch(n, dispatch);
            }
            What::Look(n) if n >= self.loops.len() => self.look(usize::MAX - n),
            What::Look(n) => {
                self.look(n);
                if let Some(every_ns) = self.loops.get(n).map(|l| l.look_ns) {
                    self.at(self.now_ns + every_ns, What::Look(n));
                }
            }
        }
    }

    pub(crate) fn loop_name(&self, n: usize) -> &str {
        self.plan.loops.get(n).map_or("", |l| l.name.as_str())
    }

    /// When a message between two hosts arrives; within one host it is there at once.
    pub(crate) fn passes(&mut self, from: usize, to: usize) -> Option<u64> {
        if from == to {
            Some(self.now_ns)
        } else {
            self.link.send(self.now_ns)
        }
    }

    pub(crate) fn host(&self, id: &HostId) -> usize {
        self.hosts.iter().position(|h| h.id == *id).unwrap_or(0)
    }

    pub(crate) fn command(&mut self, n: usize, body: CommandBody) {
        if let Some(l) = self.loops.get_mut(n) {
            l.commands += 1;
            let id = CommandId(l.commands);
            // A full queue means that nobody has taken a command for dozens of cycles; the loop has other troubles then.
            let _ = l.desk.command(Command { id, body });
        }
    }

    fn end(self) -> (Vec<LoopResult>, Vec<Note>, u64) {
        let lost = [&self.reads, &self.writes]
            .iter()
            .flat_map(|lines| lines.iter())
            .map(|l| l.lost)
            .sum::<u64>();
        let results = self
            .loops
            .into_iter()
            .zip(&self.plan.loops)
            .map(|(l, plan)| {
                let tally = l.desk.tally();
                let (mut figures, trace): (Figures, _) = l.meter.finish(self.plan.duration_s);
                for (key, count) in [
                    ("messages-lost", lost),
                    ("cycles", tally.taken),
                    ("cycles-lost", tally.lost + tally.skipped),
                    ("takeovers", tally.takeovers),
                ] {
                    figures.insert(key.to_owned(), count as f64);
                }
                LoopResult {
                    name: plan.name.clone(),
                    figures,
                    trace: trace.unwrap_or_default(),
                }
            })
            .collect();
        (results, self.notes, self.notes_dropped)
    }

    /// The cycle that a host runs for a loop.
    pub(crate) fn running(&mut self, of: usize, owner: usize) -> Option<&mut Option<Running>> {
        self.hosts
            .get_mut(owner)?
            .seats
            .get_mut(of)
            .map(|seat| &mut seat.running)
    }
}
