//! The state of a small cell, and what each event does to it.
//!
//! ```text
//! Deadline, Overdue ─► desk ─► Sample on its way ─► Deliver ─► host: seat ─► Commit on its way ─► Deliver ─► desk: check, take
//!                                                                                                  └─► actuator, Record to all
//!                                   a member ─► Held ─► the outcomes up to it are told   (or the disk, where it is quick)
//! Lose, Repeat: a message.  Crash, Return: a host.  Gone, Back: what the home believes of it.  Restart: the home.
//! ```
//! Never: judges (that is `rules`), or decides anything that the product's core decides.

use std::{
    collections::BTreeSet,
    fmt::Write as _,
    hash::{DefaultHasher, Hash, Hasher},
    sync::Arc,
};

use bumpless_core::{
    Command, CommandBody, CommandId, Event, HostId, Outcome, Record, Redundancy,
    desk::{Desk, Dispatch, TERMS_SKIPPED_AT_RESTART},
    protocol::{Answer, Refusal, Sample},
    seat::{self, Base, Conclusion, Stepped},
    swap,
};

use crate::{
    law::{self, Law, PERIOD_NS, REVISIONS},
    rules::Broken,
};

/// How much may happen in one course.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// Hosts that may own the loop.
    pub hosts: usize,
    /// Deadlines.
    pub cycles: u64,
    /// Messages that are lost.
    pub losses: u8,
    /// Messages that come twice.
    pub repeats: u8,
    /// Deaths of hosts.
    pub crashes: u8,
    /// Deaths of the home.
    pub restarts: u8,
    /// Commands by number in the order in which they are given: 0 and 1 are setpoints, 2 is another revision.
    pub commands: &'static [usize],
    /// The home's disk is behind by one record when it dies, as a disk that is written behind the cycle may be.
    pub lazy_disk: bool,
}

/// What can happen.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Action {
    /// The next deadline comes.
    Deadline,
    /// The commit that is waited for is overdue.
    Overdue,
    /// A message arrives.
    Deliver(usize),
    /// A message arrives and will arrive again.
    Repeat(usize),
    /// A message is lost.
    Lose(usize),
    /// Somebody asks for something.
    Ask,
    /// A host dies with all that it knew.
    Crash(usize),
    /// It is there again, knowing nothing.
    Return(usize),
    /// The home hears that a host is gone.
    Gone(usize),
    /// The home hears that it is there.
    Back(usize),
    /// The home dies and comes back with what its disk and the hosts know.
    Restart,
}

/// A message on its way.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Message {
    /// Home to a host.
    Sample(Box<Sample>),
    /// A host to the home.
    Answer(Box<Answer>),
    /// Home to a host.
    Record(usize, Arc<Record>),
}

/// What one host knows.
#[derive(Debug, Clone, Default)]
pub(crate) struct Host {
    pub(crate) dead: bool,
    last: Option<Arc<Record>>,
    inflight: Option<Arc<Record>>,
}

/// One write of the actuator, by whom and for which cycle it was made.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Write {
    pub(crate) by: HostId,
    pub(crate) owner_then: Option<HostId>,
    pub(crate) position: (u64, u64),
    pub(crate) value: f64,
    pub(crate) count: u64,
    /// The home died since the write before.
    pub(crate) after_restart: bool,
}

/// The whole.
#[derive(Debug, Clone)]
pub struct State {
    pub(crate) now_ns: u64,
    pub(crate) desk: Desk,
    pub(crate) hosts: Vec<Host>,
    pub(crate) net: Vec<Message>,
    pub(crate) writes: Vec<Write>,
    pub(crate) held: f64,
    /// What the home's disk knows beside the last record, when it is behind.
    before_last: Option<Arc<Record>>,
    pub(crate) asked: usize,
    /// Commands that somebody was told are done.
    pub(crate) acknowledged: BTreeSet<CommandId>,
    pub(crate) cycles: u64,
    losses: u8,
    repeats: u8,
    crashes: u8,
    restarts: u8,
    restarted: bool,
    key: u128,
}

// Two states are the same if they are written the same; `Desk` has numbers and lists that have no hash of their own.
impl PartialEq for State {
    fn eq(&self, other: &Self) -> bool {
        self.key == other.key
    }
}

impl Eq for State {}

impl Hash for State {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        self.key.hash(hasher);
    }
}

/// The cell to be checked.
#[derive(Debug, Clone)]
pub struct Cell {
    /// How much may happen.
    pub bounds: Bounds,
    /// A rule that is broken on purpose.
    pub broken: Option<Broken>,
    laws: Vec<Law>,
}

/// A host by its number.
#[allow(clippy::expect_used, reason = "constants")]
pub(crate) fn host_id(number: usize) -> HostId {
    HostId::new(format!("h{number}")).expect("a valid name")
}

#[allow(clippy::expect_used, reason = "a constant")]
fn home_id() -> HostId {
    HostId::new("home").expect("a valid name")
}

/// The commands in the order in which they are given.
pub(crate) fn command(number: usize) -> Command {
    let body = match number {
        0 => CommandBody::Setpoint(10.0),
        1 => CommandBody::Setpoint(20.0),
        _ => CommandBody::Revise(REVISIONS[1]),
    };
    Command {
        id: CommandId(number as u128 + 1),
        body,
    }
}

impl Cell {
    /// A cell within bounds, with a rule broken or none.
    #[must_use]
    pub fn new(bounds: Bounds, broken: Option<Broken>) -> Self {
        Self {
            bounds,
            broken,
            laws: REVISIONS.map(law::law).to_vec(),
        }
    }

    fn law(&self, revision: u64) -> Option<&Law> {
        self.laws.iter().find(|law| law.spec.revision == revision)
    }

    pub(crate) fn first(&self) -> State {
        let mut desk = Desk::new(home_id(), Arc::clone(&self.laws[0].spec), None, 0, 0);
        // Nothing waits yet, so nothing is to be sent.
        let _nothing = desk.set_members(0, (0..self.bounds.hosts).map(host_id).collect());
        let mut state = State {
            now_ns: 0,
            desk,
            hosts: vec![Host::default(); self.bounds.hosts],
            net: Vec::new(),
            writes: Vec::new(),
            held: 0.0,
            before_last: None,
            asked: 0,
            acknowledged: BTreeSet::new(),
            cycles: 0,
            losses: 0,
            repeats: 0,
            crashes: 0,
            restarts: 0,
            restarted: false,
            key: 0,
        };
        state.settle();
        state
    }

    pub(crate) fn possible(&self, state: &State, actions: &mut Vec<Action>) {
        let b = &self.bounds;
        if state.cycles < b.cycles {
            actions.push(Action::Deadline);
        }
        if state.desk.due_at_ns() < state.desk.deadline_at_ns() {
            actions.push(Action::Overdue);
        }
        for number in 0..state.net.len() {
            actions.push(Action::Deliver(number));
            if state.repeats < b.repeats {
                actions.push(Action::Repeat(number));
            }
            if state.losses < b.losses {
                actions.push(Action::Lose(number));
            }
        }
        if state.asked < b.commands.len() {
            actions.push(Action::Ask);
        }
        for (number, host) in state.hosts.iter().enumerate() {
            let believed = state.desk.members().contains(&host_id(number));
            match host.dead {
                false if state.crashes < b.crashes => actions.push(Action::Crash(number)),
                true => actions.push(Action::Return(number)),
                false => {}
            }
            if host.dead && believed {
                actions.push(Action::Gone(number));
            }
            if !host.dead && !believed {
                actions.push(Action::Back(number));
            }
        }
        if state.restarts < b.restarts {
            actions.push(Action::Restart);
        }
    }

    pub(crate) fn after(&self, before: &State, action: &Action) -> State {
        let mut state = before.clone();
        match *action {
            Action::Deadline => self.deadline(&mut state),
            Action::Overdue => {
                state.now_ns = state.now_ns.max(state.desk.due_at_ns());
                let dispatch = state.desk.overdue(state.now_ns);
                self.send(&mut state, dispatch);
            }
            Action::Deliver(number) => {
                let message = state.net.remove(number);
                self.deliver(&mut state, message);
            }
            Action::Repeat(number) => {
                state.repeats += 1;
                let message = state.net[number].clone();
                self.deliver(&mut state, message);
            }
            Action::Lose(number) => {
                state.losses += 1;
                state.net.remove(number);
            }
            Action::Ask => {
                // A full queue or a known outcome cannot be: there are three commands, each asked for once.
                let asked = self.bounds.commands.get(state.asked).copied().unwrap_or_default();
                let _queued = state.desk.command(command(asked));
                state.asked += 1;
            }
            Action::Crash(number) => {
                state.crashes += 1;
                state.hosts[number] = Host {
                    dead: true,
                    ..Host::default()
                };
            }
            Action::Return(number) => state.hosts[number].dead = false,
            Action::Gone(number) | Action::Back(number) => {
                let gone = matches!(action, Action::Gone(_));
                let believed = |n: &usize| state.desk.members().contains(&host_id(*n));
                let members = (0..state.hosts.len()).filter(|n| if *n == number { !gone } else { believed(n) });
                let members = members.map(host_id).collect();
                let dispatch = state.desk.set_members(state.now_ns, members);
                self.send(&mut state, dispatch);
            }
            Action::Restart => self.restart(&mut state),
        }
        state.settle();
        state
    }

    fn send(&self, state: &mut State, dispatch: Option<Dispatch>) {
        if let Some(Dispatch::Send(mut sample)) = dispatch {
            sample.resume.take_if(|_| self.broken == Some(Broken::NoResume));
            state.net.push(Message::Sample(sample));
        }
    }

    fn deadline(&self, state: &mut State) {
        state.cycles += 1;
        state.now_ns = state.desk.deadline_at_ns();
        let readings = law::readings(state.held, state.now_ns);
        let next = state
            .desk
            .waiting_revision()
            .map(|revision| (revision, readings.clone()));
        let fired = state.desk.deadline(state.now_ns, readings, next);
        self.send(state, fired.map(|(_, dispatch)| dispatch));
    }

    fn deliver(&self, state: &mut State, message: Message) {
        match message {
            Message::Sample(sample) => {
                let number = (0..state.hosts.len()).find(|n| host_id(*n) == sample.owner);
                if let Some(number) = number.filter(|n| !state.hosts[*n].dead)
                    && let Some(answer) = self.cycle(&mut state.hosts[number], number, &sample)
                {
                    state.net.push(Message::Answer(Box::new(answer)));
                }
            }
            Message::Record(number, record) => {
                let host = &mut state.hosts[number];
                let newer = host
                    .last
                    .as_ref()
                    .is_none_or(|last| last.position() < record.position());
                if newer && !host.dead {
                    // Where the disk is quick everything is told already, and what a member says changes nothing.
                    if self.bounds.lazy_disk && record.has_news_for(host.last.as_deref()) {
                        let held = Answer::Held {
                            loop_id: record.loop_id.clone(),
                            term: record.term,
                            seq: record.seq,
                            host: host_id(number),
                        };
                        state.net.push(Message::Answer(Box::new(held)));
                    }
                    host.last = Some(record);
                }
            }
            Message::Answer(answer) => match *answer {
                Answer::Commit(record) => self.commit(state, *record),
                Answer::Held { term, seq, .. } => state.told((term, seq)),
                Answer::NeedRecord { .. } if self.broken == Some(Broken::NoResume) => {}
                other => {
                    let dispatch = state.desk.answered(state.now_ns, &other);
                    self.send(state, dispatch);
                }
            },
        }
    }

    /// A host's cycle, as the product's seat runs it.
    fn cycle(&self, host: &mut Host, number: usize, sample: &Sample) -> Option<Answer> {
        let me = host_id(number);
        let base = match seat::base(sample, host.last.iter().chain(&host.inflight)) {
            Base::First => None,
            Base::On(record) => Some(record),
            Base::Unknown if self.broken == Some(Broken::AnyBase) => host.last.clone(),
            Base::Unknown => {
                return Some(Answer::NeedRecord {
                    loop_id: sample.loop_id.clone(),
                    term: sample.term,
                    seq: sample.seq,
                    owner: me,
                });
            }
        };
        let mut law = self.law(sample.revision)?;
        let held = law.wiring.held(&sample.readings);
        let mut standing = seat::settle(base.as_deref(), &law.spec, sample, &held);
        let state: Arc<[u8]> = base
            .as_ref()
            .map_or_else(|| Arc::from([]), |record| Arc::clone(&record.state));
        let mut events = Vec::new();
        let mut probation = swap::probation_after(base.as_deref());
        if let Some((command, revision)) = standing.revise {
            let next = self.law(revision)?;
            standing.remember(command, Outcome::Done);
            events.push(Event::Revised {
                from: law.spec.revision,
                from_digest: law.spec.digest,
                by: "migrate".to_owned(),
                bump_percent: 0.0,
            });
            probation = Some((law.spec.revision, 2));
            law = next;
        }
        let step = Stepped {
            effects: law::step(&state),
            by: me.clone(),
            step_ns: 0,
        };
        let record = seat::conclude(Conclusion {
            owner: &me,
            sample,
            base: base.as_deref(),
            spec: &law.spec,
            wiring: &law.wiring,
            readings: sample.readings.clone(),
            state,
            standing,
            events,
            probation,
            redundancy: Redundancy::default(),
            step: Ok(step),
            cycle_ns: 0,
        });
        host.inflight = Some(Arc::new(record.clone()));
        Some(Answer::Commit(Box::new(record)))
    }

    /// A commit at the home, as the product's home takes it.
    fn commit(&self, state: &mut State, record: Record) {
        let made = (
            record.owner.clone(),
            record.position(),
            record.outputs[0],
            law::count(&record.state),
        );
        let mut record = record;
        let refusal = state.desk.check(&record).err();
        match (refusal, self.broken) {
            (None, _) => {}
            // A rule that nobody looks at: the record passes as if it kept it.
            (Some(Refusal::OldTerm | Refusal::NotOwner), Some(Broken::NoTerms)) => {
                record.term = state.desk.term();
                let Some(owner) = state.desk.owner().cloned() else {
                    return;
                };
                record.owner = owner;
            }
            (Some(Refusal::WrongBase), Some(Broken::AnyBase)) => {
                record.after = state.desk.last().map_or((0, 0), |last| last.position());
            }
            (Some(_), _) => return,
        }
        if state.desk.check(&record).is_err() {
            return;
        }
        let owner_then = state.desk.owner().cloned();
        let (by, position, value, count) = made;
        let value = if self.broken == Some(Broken::OutputsApart) {
            state.held
        } else {
            value
        };
        state.held = value;
        state.writes.push(Write {
            by,
            owner_then,
            position,
            value,
            count,
            after_restart: std::mem::take(&mut state.restarted),
        });
        state.before_last = state.desk.last().cloned();
        let record = state.desk.take(state.now_ns, record);
        if record.revision != state.desk.spec().revision
            && let Some(law) = self.law(record.revision)
        {
            state.desk.revise(state.now_ns, Arc::clone(&law.spec), 0);
        }
        // A disk that is behind has the record before this one now.
        let kept = match (&state.before_last, self.bounds.lazy_disk) {
            (Some(before), true) if self.broken != Some(Broken::ToldTooSoon) => before.position(),
            (None, true) if self.broken != Some(Broken::ToldTooSoon) => (0, 0),
            _ => record.position(),
        };
        state.told(kept);
        for number in 0..state.hosts.len() {
            state.net.push(Message::Record(number, Arc::clone(&record)));
        }
    }

    /// The home dies. What it had to say is said by nobody; what was on its way to others still arrives.
    fn restart(&self, state: &mut State) {
        state.restarts += 1;
        state.restarted = true;
        let disk = if self.bounds.lazy_disk {
            state.before_last.clone()
        } else {
            state.desk.last().cloned()
        };
        // Asked for when it comes back: the newest that anybody has.
        let told = state
            .hosts
            .iter()
            .filter(|host| !host.dead)
            .filter_map(|host| host.last.clone());
        let last = told.chain(disk).max_by_key(|record| record.position());
        let known = last.as_ref().filter(|_| self.broken != Some(Broken::RevisionForgotten));
        let revision = known.map_or(REVISIONS[0], |record| record.revision);
        let Some(law) = self.law(revision) else { return };
        let floor = last.clone().filter(|_| self.broken != Some(Broken::TermsAgain));
        let members = state.desk.members().to_vec();
        state.desk = Desk::new(home_id(), Arc::clone(&law.spec), floor, state.now_ns, 0);
        if self.broken != Some(Broken::TermsAgain) {
            // A home that comes back knows the loop from its disk, even where it left no record.
            state.desk.raise_terms(TERMS_SKIPPED_AT_RESTART);
        }
        let _nothing = state.desk.set_members(state.now_ns, members);
    }

    /// From here on nothing goes wrong and everybody is there: does the loop run again? Gives the cycles it took.
    pub(crate) fn runs_again(&self, state: &State) -> bool {
        let mut calm = state.clone();
        for host in &mut calm.hosts {
            host.dead = false;
        }
        let everyone = (0..calm.hosts.len()).map(host_id).collect();
        let dispatch = calm.desk.set_members(calm.now_ns, everyone);
        self.send(&mut calm, dispatch);
        let before = calm.writes.len();
        for _ in 0..4 {
            while !calm.net.is_empty() {
                let message = calm.net.remove(0);
                self.deliver(&mut calm, message);
            }
            self.deadline(&mut calm);
        }
        while !calm.net.is_empty() {
            let message = calm.net.remove(0);
            self.deliver(&mut calm, message);
        }
        calm.writes.len() > before
    }
}

impl State {
    /// Outcomes up to this position outlive the home: somebody is told of them.
    fn told(&mut self, position: (u64, u64)) {
        let told = self.desk.kept(position).into_iter().map(|(applied, _)| applied);
        let done = told.filter(|applied| applied.outcome == Outcome::Done);
        self.acknowledged.extend(done.map(|applied| applied.id));
    }

    /// Brings the state into the one form that it is known by.
    fn settle(&mut self) {
        // The order of messages on their way means nothing: any may be next.
        self.net.sort_by_cached_key(|message| format!("{message:?}"));
        let mut text = String::new();
        let _infallible = write!(
            text,
            "{:?}{:?}{:?}{:?}{:?}{:?}{:?}",
            self.now_ns, self.desk, self.hosts, self.net, self.held, self.acknowledged, self.asked
        );
        // Counts of the past decide nothing.
        if let Some(from) = text.find("tally: Tally {")
            && let Some(length) = text[from..].find('}')
        {
            text.replace_range(from..=from + length, "");
        }
        let _infallible = write!(
            text,
            "{:?}{:?}{:?}",
            self.writes.last(),
            self.before_last,
            (
                self.cycles,
                self.losses,
                self.repeats,
                self.crashes,
                self.restarts,
                self.restarted
            )
        );
        let half = |salt: u8| {
            let mut hasher = DefaultHasher::new();
            (salt, &text).hash(&mut hasher);
            u128::from(hasher.finish())
        };
        self.key = half(0) << 64 | half(1);
    }
}

/// Deadlines are seconds apart, so a course's times stay readable.
const _: () = assert!(PERIOD_NS == 1_000_000_000);
