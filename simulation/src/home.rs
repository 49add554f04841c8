//! The home's side in the simulation: what the product's loops and deployment do around `core::desk`.
//!
//! ```text
//! start ─► reopen, from the disk and from whoever can be reached ─► deadlines, commits, records, acknowledgements
//! ```
//! Never: decides what the core decides.

use std::sync::Arc;

use bumpless_core::{
    Applied, Command, CommandBody, CommandId, HostId, LoopSpec, Outcome, Record,
    desk::{Desk, Dispatch, Queued, Tally, terms_passed_over},
    place,
    protocol::{Answer, Refusal},
};

use crate::{
    event::{Event, Message},
    law::{self, host_id, host_number},
    plan::Broken,
    rules::{Actuator, Keeper, RULES, Write},
    world::World,
};

/// Mean time between two commands of a loop, in ns.
const ASK_NS: f64 = 10_000_000_000.0;
/// One in so many commands is a change of revision.
const REVISE_EVERY: u64 = 8;
/// From the start of a host to the opening of its homes, while it asks the others, in ns.
pub(crate) const GATHER_NS: u64 = 1_000_000_000;
/// Between two syncs of the disk, in ns.
pub(crate) const SYNC_NS: u64 = 1_000_000_000;
/// A sync that somebody waits for takes so long, in ns.
const SYNC_SOON_NS: u64 = 5_000_000;
/// From the loss of a link to the next one, in ns, where nothing is in its way.
const BACK_NS: (u64, u64) = (50_000_000, 500_000_000);
/// Revisions of a loop that are kept.
const SPECS_MAX: usize = 4;

/// What the loop's people asked for.
#[derive(Debug, Default)]
pub(crate) struct Client {
    asked: u64,
    outstanding: Option<CommandId>,
}

/// One loop, with its home's side and its actuator.
#[derive(Debug)]
pub(crate) struct Loop {
    pub(crate) home: u32,
    /// The hosts that may hold it, best first; at most `HOLDERS`.
    pub(crate) ranked: Vec<u32>,
    /// Bit i: the home believes that host i of the ranked is there.
    pub(crate) there: u8,
    /// Bit i: it told the home that it is ready.
    pub(crate) ready: u8,
    /// Bit i: it was told to get ready.
    pub(crate) preparing: u8,
    pub(crate) desk: Option<Desk>,
    /// Counts of desks before this one.
    pub(crate) before: Tally,
    pub(crate) life: u32,
    pub(crate) timer_at_ns: u64,
    /// Revisions, newest last; every host has them.
    pub(crate) specs: Vec<Arc<LoopSpec>>,
    /// What the home's disk has.
    pub(crate) disk: Option<Arc<Record>>,
    pub(crate) actuator: Actuator,
    pub(crate) client: Client,
}

impl World {
    /// Opens the home of a loop, from the best record that it can have.
    pub(crate) fn open(&mut self, number: u32) {
        let broken = self.broken();
        let home = self.loops[number as usize].home;
        let local_ns = self.host(home).clock.shows(self.now_ns);
        let told = self.loops[number as usize]
            .ranked
            .clone()
            .into_iter()
            .filter_map(|host| {
                let reached = host == home || !(self.network.is_cut(host, home) || self.network.is_cut(home, host));
                let other = self.host(host);
                let answers = other.runs() && reached;
                answers
                    .then(|| other.seats.get(&number).and_then(|seat| seat.last.clone()))
                    .flatten()
            });
        let told: Vec<Arc<Record>> = told.collect();
        let l = &mut self.loops[number as usize];
        let last = told
            .into_iter()
            .chain(l.disk.clone())
            .max_by_key(|record| record.position());
        l.life += 1;
        let revision = last.as_ref().map_or(1, |record| record.revision);
        let Some(spec) = l.specs.iter().find(|spec| spec.revision == revision).cloned() else {
            return;
        };
        let phase_ns = place::phase_ns(&spec.id, spec.period_ns);
        let begin = last.clone().filter(|_| broken != Some(Broken::TermsAgain));
        let mut desk = Desk::new(host_id(home), spec, begin, local_ns, phase_ns);
        if broken != Some(Broken::TermsAgain) {
            let ahead = last.as_ref().map_or(0, |record| terms_passed_over(0, record.term));
            let host = &mut self.hosts[home as usize];
            desk.raise_terms(host.terms_set_aside);
            host.terms_set_aside = host.terms_set_aside.max(ahead);
        }
        let l = &mut self.loops[number as usize];
        l.desk = Some(desk);
        l.client.outstanding = None;
        self.note(number, || {
            format!("home h{home} opens from {:?}", last.as_ref().map(|r| r.position()))
        });
        if !self.loops[number as usize]
            .actuator
            .holds_what_was_told(last.as_deref())
        {
            self.told_is_lost(number, last.as_deref());
        }
        let (there, ready) = self.looks_around(number);
        let l = &mut self.loops[number as usize];
        (l.there, l.ready, l.preparing) = (there, ready, 0);
        self.members(number);
        self.schedule(number);
    }

    /// What was told is not in the best record that the home found: a second failure, or the rule is broken.
    fn told_is_lost(&mut self, number: u32, last: Option<&Record>) {
        let l = &self.loops[number as usize];
        let home = l.home;
        let excused = match l.actuator.keeper {
            Keeper::Disk | Keeper::Nobody => false,
            // The one other host that had it died, stands still, or cannot be reached.
            Keeper::Member { host, life } => {
                let other = self.host(host);
                !other.runs()
                    || other.life != life
                    || self.network.is_cut(host, home)
                    || self.network.is_cut(home, host)
            }
        };
        let seen = format!(
            "kept by {:?}, told were setpoint {} and revision {}; the home goes on from {:?}",
            l.actuator.keeper,
            l.actuator.setpoint_told,
            l.actuator.revision_told,
            last.map(|r| (r.position(), r.setpoint, r.revision))
        );
        if !excused {
            return self.violated(RULES[4], number, seen);
        }
        self.note(number, || format!("a second failure: {seen}"));
        self.counts.told_lost_to_two += 1;
        let actuator = &mut self.loops[number as usize].actuator;
        actuator.setpoint_told = last.map_or(0.0, |r| r.setpoint);
        actuator.revision_told = last.map_or(1, |r| r.revision);
    }

    /// Who of the loop's hosts is there and holds it, as a home that starts hears it.
    fn looks_around(&self, number: u32) -> (u8, u8) {
        let l = &self.loops[number as usize];
        let (mut there, mut ready) = (0, 0);
        for (rank, host) in l.ranked.iter().enumerate() {
            let other = self.host(*host);
            let reached = !(self.network.is_cut(*host, l.home) || self.network.is_cut(l.home, *host));
            if other.runs() && reached {
                there |= 1 << rank;
                ready |= u8::from(other.seats.contains_key(&number)) << rank;
            }
        }
        (there, ready)
    }

    /// Tells the desk its members, and hosts that should hold the loop to get ready.
    pub(crate) fn members(&mut self, number: u32) {
        let replicas = if law::is_alone(number) { 1 } else { law::REPLICAS };
        let l = &mut self.loops[number as usize];
        let home = l.home;
        let both = |rank: &usize| l.there & l.ready & 1 << rank != 0;
        let chosen = (0..l.ranked.len()).filter(both).take(usize::from(replicas));
        let chosen: Vec<HostId> = chosen.map(|rank| host_id(l.ranked[rank])).collect();
        let wanted = (0..l.ranked.len())
            .filter(|rank| l.there & 1 << rank != 0)
            .take(usize::from(replicas));
        let absent: Vec<usize> = wanted.filter(|rank| (l.ready | l.preparing) & 1 << rank == 0).collect();
        for rank in absent {
            l.preparing |= 1 << rank;
            let (life, rank_byte) = (self.hosts[l.ranked[rank] as usize].life, rank as u8);
            let at_ns = self.now_ns + self.random.between(300_000_000, 2_000_000_000);
            let ready = Event::Ready {
                number,
                rank: rank_byte,
                life,
            };
            self.queue.put(at_ns, ready);
        }
        let local_ns = self.hosts[home as usize].clock.shows(self.now_ns);
        if let Some(desk) = l.desk.as_mut().filter(|desk| desk.members() != chosen) {
            let before = desk.tally();
            let dispatch = desk.set_members(local_ns, chosen);
            self.tallied(number, before);
            self.dispatch(number, dispatch);
            self.schedule(number);
        }
    }

    /// A time of the home came.
    pub(crate) fn home_due(&mut self, number: u32, at_ns: u64) {
        let home = self.loops[number as usize].home;
        let local_ns = self.host(home).clock.shows(self.now_ns);
        let l = &mut self.loops[number as usize];
        if l.timer_at_ns != at_ns {
            return;
        }
        let held = l.actuator.value;
        let Some(desk) = l.desk.as_mut() else { return };
        let before = desk.tally();
        let overdue = desk.overdue(local_ns);
        self.tallied(number, before);
        self.dispatch(number, overdue);
        let l = &mut self.loops[number as usize];
        if let Some(desk) = l.desk.as_mut().filter(|desk| local_ns >= desk.deadline_at_ns()) {
            let before = desk.tally();
            let readings = law::readings(held, local_ns);
            let next = desk.waiting_revision().map(|revision| (revision, readings.clone()));
            let fired = desk.deadline(local_ns, readings, next);
            self.tallied(number, before);
            self.dispatch(number, fired.map(|(_, dispatch)| dispatch));
        }
        self.schedule(number);
    }

    pub(crate) fn schedule(&mut self, number: u32) {
        let l = &mut self.loops[number as usize];
        let Some(desk) = l.desk.as_ref() else { return };
        let at_ns = desk.due_at_ns();
        if l.timer_at_ns != at_ns {
            l.timer_at_ns = at_ns;
            let life = l.life;
            let when_ns = self.hosts[l.home as usize].clock.reaches(at_ns).max(self.now_ns);
            self.queue.put(when_ns, Event::Home { number, life, at_ns });
        }
    }

    /// Notes what a call of the desk counted, beside the fault that may have done it.
    fn tallied(&mut self, number: u32, before: Tally) {
        let Some(now) = self.loops[number as usize].desk.as_ref().map(Desk::tally) else {
            return;
        };
        let missed = now.lost - before.lost + now.skipped - before.skipped;
        self.counts.takeovers += now.takeovers - before.takeovers;
        if missed > 0 {
            let blamed = self.blame(number);
            self.counts.missed(blamed, missed);
            self.note(number, || format!("{missed} cycles missed, {blamed:?}"));
        }
    }

    fn dispatch(&mut self, number: u32, dispatch: Option<Dispatch>) {
        let Some(Dispatch::Send(mut sample)) = dispatch else {
            return;
        };
        sample.resume.take_if(|_| self.broken() == Some(Broken::NoResume));
        let (home, owner) = (self.loops[number as usize].home, host_number(&sample.owner));
        if home == owner {
            self.sample(home, sample);
        } else {
            self.send(home, owner, Message::Sample(sample));
        }
    }

    /// An owner or a member says something.
    pub(crate) fn answer(&mut self, host: u32, answer: Answer) {
        let (number, broken) = (law::loop_number(answer.loop_id()), self.broken());
        let local_ns = self.host(host).clock.shows(self.now_ns);
        let Some(l) = self.loops.get_mut(number as usize).filter(|l| l.home == host) else {
            return;
        };
        match answer {
            Answer::Commit(record) => self.commit(number, &record),
            Answer::Held {
                term, seq, host: by, ..
            } => {
                let by = host_number(&by);
                let life = self.host(by).life;
                self.kept(number, (term, seq), Keeper::Member { host: by, life });
            }
            Answer::NeedRecord { .. } if broken == Some(Broken::NoResume) => {}
            other => {
                let Some(desk) = l.desk.as_mut() else { return };
                let before = desk.tally();
                let dispatch = desk.answered(local_ns, &other);
                self.tallied(number, before);
                self.dispatch(number, dispatch);
                self.schedule(number);
            }
        }
    }

    /// The owner's record: checked, written, taken, told to everyone who holds the loop.
    fn commit(&mut self, number: u32, made: &Record) {
        let broken = self.broken();
        let now_ns = self.now_ns;
        let home = self.loops[number as usize].home;
        let local_ns = self.host(home).clock.shows(now_ns);
        let l = &mut self.loops[number as usize];
        let Some(desk) = l.desk.as_mut() else { return };
        let mut record = made.clone();
        match (desk.check(&record).err(), broken) {
            (None, _) => {}
            // A rule that nobody looks at: the record passes as if it kept it.
            (Some(Refusal::OldTerm | Refusal::NotOwner), Some(Broken::NoTerms)) => {
                let Some(owner) = desk.owner().cloned() else { return };
                (record.term, record.owner) = (desk.term(), owner);
            }
            (Some(Refusal::WrongBase), Some(Broken::AnyBase | Broken::Unchained)) => {
                record.after = desk.last().map_or((0, 0), |last| last.position());
            }
            (Some(_), _) => return,
        }
        if desk.check(&record).is_err() {
            return;
        }
        let value = match broken {
            Some(Broken::OutputsApart) => l.actuator.value,
            _ => record.outputs.first().copied().unwrap_or(f64::NAN),
        };
        let write = Write {
            made,
            value,
            owner_then: desk.owner(),
            base: desk.last().map(AsRef::as_ref),
        };
        if let Err((rule, seen)) = l.actuator.write(&write, now_ns) {
            return self.violated(rule, number, seen);
        }
        let record = desk.take(local_ns, record);
        let outcome = desk.unkept() == Some(record.position());
        if record.revision != desk.spec().revision
            && let Some(spec) = l.specs.iter().find(|spec| spec.revision == record.revision)
        {
            desk.revise(local_ns, Arc::clone(spec), place::phase_ns(&spec.id, spec.period_ns));
        }
        let alone = desk.members().iter().all(|member| host_number(member) == home);
        let period_ns = desk.spec().period_ns;
        self.counts.taken += 1;
        if record.committed_after_ns > period_ns / 2 {
            let blamed = self.blame(number);
            self.counts.late(blamed);
        }
        self.note(number, || {
            format!(
                "{:?} taken from {}, state {}",
                record.position(),
                record.owner,
                law::count(&record.state)
            )
        });
        let holders: Vec<u32> = self.loops[number as usize]
            .ranked
            .iter()
            .copied()
            .filter(|h| *h != home)
            .collect();
        self.counts.feed_copies += u64::from(self.plan.hosts).saturating_sub(1 + holders.len() as u64);
        for holder in holders {
            self.send(home, holder, Message::Record(Arc::clone(&record)));
        }
        self.record(home, &record, false);
        if broken == Some(Broken::ToldTooSoon) {
            self.kept(number, record.position(), Keeper::Nobody);
        } else if outcome && alone && !self.host(home).syncing {
            let life = self.host(home).life;
            self.host_mut(home).syncing = true;
            let sync = Event::Sync {
                host: home,
                life,
                once: true,
            };
            self.queue.put(now_ns + SYNC_SOON_NS, sync);
        }
        self.schedule(number);
    }

    /// The record at this position, or a later one, outlives the home: people are told of outcomes up to it.
    fn kept(&mut self, number: u32, position: (u64, u64), keeper: Keeper) {
        let Some(desk) = self.loops[number as usize].desk.as_mut() else {
            return;
        };
        for (applied, record) in desk.kept(position) {
            let Applied { id, outcome } = applied;
            let l = &mut self.loops[number as usize];
            l.client.outstanding.take_if(|waiting| *waiting == id);
            if outcome == Outcome::Done {
                l.actuator.setpoint_told = l.actuator.setpoint_told.max(record.setpoint);
                l.actuator.revision_told = l.actuator.revision_told.max(record.revision);
                l.actuator.keeper = keeper;
                self.counts.told += 1;
            } else {
                self.counts.refused += 1;
            }
            self.note(number, || {
                format!("told of {id:?} in {:?}, kept by {keeper:?}", record.position())
            });
        }
    }

    /// The last records of a host's loops go to its disk.
    pub(crate) fn sync(&mut self, host: u32, life: u32, once: bool) {
        if once {
            self.host_mut(host).syncing = false;
        } else {
            let again = Event::Sync { host, life, once };
            self.queue.put(self.now_ns + SYNC_NS, again);
        }
        if self.host(host).disk_full > 0 {
            return;
        }
        for number in self.host(host).homes.clone() {
            let l = &mut self.loops[number as usize];
            let Some(last) = l.desk.as_ref().and_then(|desk| desk.last().cloned()) else {
                continue;
            };
            let position = last.position();
            l.disk = Some(last);
            l.actuator.keeper = Keeper::Disk;
            self.kept(number, position, Keeper::Disk);
        }
    }

    /// Somebody wants something of a loop.
    pub(crate) fn ask(&mut self, number: u32) {
        let again_ns = self.random.exponential(ASK_NS);
        self.queue.put(self.now_ns + again_ns, Event::Ask { number });
        let l = &mut self.loops[number as usize];
        if !self.hosts[l.home as usize].runs() || l.client.outstanding.is_some() {
            return;
        }
        let Some(desk) = l.desk.as_mut() else { return };
        l.client.asked += 1;
        let body = if l.client.asked.is_multiple_of(REVISE_EVERY) {
            let newest = l.specs.last().map_or(1, |spec| spec.revision);
            let spec = law::spec(number, newest + 1);
            l.specs.push(Arc::new(spec));
            if l.specs.len() > SPECS_MAX {
                let in_force = desk.spec().revision;
                if let Some(oldest) = l.specs.iter().position(|s| s.revision < in_force) {
                    l.specs.remove(oldest);
                }
            }
            CommandBody::Revise(newest + 1)
        } else {
            CommandBody::Setpoint(l.client.asked as f64)
        };
        let id = CommandId(u128::from(number) << 64 | u128::from(l.client.asked));
        match desk.command(Command { id, body: body.clone() }) {
            Queued::Waits => {
                l.client.outstanding = Some(id);
                self.counts.asked += 1;
            }
            Queued::Ended(_) | Queued::Full => {}
        }
        self.note(number, || format!("asked for {body:?}"));
    }

    /// A host of a loop is there, or gone, for all that its home knows.
    pub(crate) fn believe(&mut self, number: u32, rank: u8, there: bool) {
        let l = &self.loops[number as usize];
        let (home, host) = (l.home, l.ranked.get(usize::from(rank)).copied().unwrap_or(l.home));
        let cut = self.network.is_cut(home, host) || self.network.is_cut(host, home);
        if there && (cut || !self.host(host).runs()) {
            // Another fault holds it; the end of that one brings the news again.
            return;
        }
        if !there && !cut && self.host(host).runs() {
            // The loss of a link that is whole again: it is noticed late, and the next link brings the host back.
            let at_ns = self.now_ns + self.random.between(BACK_NS.0, BACK_NS.1);
            self.queue.put(
                at_ns,
                Event::Believe {
                    number,
                    rank,
                    there: true,
                },
            );
        }
        let l = &mut self.loops[number as usize];
        let bit = 1 << rank;
        if there {
            l.there |= bit;
        } else {
            l.there &= !bit;
        }
        // A new life of a host holds nothing, and tells so.
        let holds = l
            .ranked
            .get(usize::from(rank))
            .is_some_and(|h| self.hosts[*h as usize].seats.contains_key(&number));
        if !(there && holds) {
            l.ready &= !bit;
            l.preparing &= !bit;
        } else {
            l.ready |= bit;
        }
        self.note(number, || {
            format!("rank {rank} is {}", if there { "there" } else { "gone" })
        });
        self.members(number);
    }

    /// A host has made a loop ready, and its home hears of it.
    pub(crate) fn ready(&mut self, number: u32, rank: u8, life: u32) {
        let Some(host) = self.loops[number as usize].ranked.get(usize::from(rank)).copied() else {
            return;
        };
        let other = self.host_mut(host);
        if !other.alive || other.life != life {
            return;
        }
        other.seats.entry(number).or_default();
        let l = &mut self.loops[number as usize];
        l.preparing &= !(1 << rank);
        if l.there & 1 << rank != 0 {
            l.ready |= 1 << rank;
            self.note(number, || format!("h{host} holds it"));
            self.members(number);
        }
    }
}
