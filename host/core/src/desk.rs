//! The home's side of one loop: when a cycle is due, who runs it, when its commit is overdue, and which commands wait.
//!
//! Owns the loop's [`Arbiter`], its schedule, its queue of commands, and which of their outcomes may be told: only those whose
//! record outlives this home, because it is on its disk or another host has it ([`Desk::kept`]). No cycle waits for that. Never: reads points, writes outputs or sends; it
//! says what is to be sent, and the shell around it (crate `loops`) does it.
//!
//! ```text
//!            deadline: open(k), send sample to owner
//!   idle ───────────────────────────────────────────► waiting(k, overdue at t_k + part·T)
//!    ▲                                                   │        │
//!    │ commit taken                                      │        │ overdue, owner gone, or declined:
//!    └───────────────────────────────────────────────────┘        │ appoint the next member, term+1,
//!    ▲                                                            │ same sample with the last record
//!    │ nobody left: outputs hold, cycle lost                      ▼
//!    └──────────────────────────────────────────────────── waiting(k, again)
//! ```

use std::{collections::VecDeque, sync::Arc};

use crate::{
    arbiter::Arbiter,
    frame::Message,
    limits::{COMMANDS_WAITING_MAX, MESSAGES_PER_STEP_MAX},
    name::HostId,
    protocol::{Answer, Refusal, Sample},
    reading::Reading,
    record::{Applied, Command, CommandBody, Record},
    spec::LoopSpec,
    tick::{Fired, Tick},
};

/// First time that a host which missed a commit is passed over, in ns: long enough to damp flapping.
const SUSPECT_NS_MIN: u64 = 1_000_000_000;
/// Longest time that it is passed over, in ns.
const SUSPECT_NS_MAX: u64 = 60_000_000_000;
/// Terms skipped when a home comes back from a restart. Records reach the disk within a second, so the terms given out in that
/// time may be unknown afterwards: at most two for each cycle of 1 ms, and as many again for a disk that is slow.
pub const TERMS_SKIPPED_AT_RESTART: u64 = 4096;

/// Terms up to this one are passed over by a home in a new life: `set_aside` is what the life before passed over, `found` the
/// greatest term of its records that is known. It must be set aside, durably, before the home opens: of two lives after each
/// other neither may have brought a record anywhere, and they must not give out the same terms.
#[must_use]
pub const fn terms_passed_over(set_aside: u64, found: u64) -> u64 {
    let known = if set_aside > found { set_aside } else { found };
    known.saturating_add(TERMS_SKIPPED_AT_RESTART)
}

/// Counts since the home started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tally {
    /// Cycles whose commit was taken.
    pub taken: u64,
    /// Cycles that began and ended without a commit.
    pub lost: u64,
    /// Cycles that this home itself came too late for.
    pub skipped: u64,
    /// Changes of ownership after a silence.
    pub takeovers: u64,
    /// Commits refused.
    pub refused: u64,
}

/// What the shell shall do after a deadline or a silence.
#[derive(Debug, Clone, PartialEq)]
pub enum Dispatch {
    /// Send this to the owner it names.
    Send(Box<Sample>),
    /// No host can run the cycle; the outputs hold.
    Nobody,
}

/// A host that missed a commit.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Suspect {
    host: HostId,
    until_ns: u64,
    strikes: u32,
}

/// The cycle that waits for its commit.
#[derive(Debug, Clone)]
struct Waiting {
    sample: Sample,
    overdue_at_ns: u64,
    deadline_ns: u64,
    tried: Vec<HostId>,
}

/// What became of a command that was handed in.
#[derive(Debug, Clone, PartialEq)]
pub enum Queued {
    /// It waits; its outcome comes with a record.
    Waits,
    /// It was handed in before, and this is how it ended.
    Ended(Applied),
    /// The queue is full; nothing was taken.
    Full,
}

/// One loop at its home.
#[derive(Debug, Clone)]
pub struct Desk {
    home: HostId,
    spec: Arc<LoopSpec>,
    arbiter: Arbiter,
    tick: Tick,
    members: Vec<HostId>,
    suspects: Vec<Suspect>,
    waiting: Option<Waiting>,
    last: Option<Arc<Record>>,
    commands: VecDeque<Command>,
    /// Outcomes whose record only this process has, as far as it knows; with `commands` at most [`COMMANDS_WAITING_MAX`].
    unkept: VecDeque<(Applied, Arc<Record>)>,
    messages: VecDeque<Message>,
    wanted_owner: Option<HostId>,
    tally: Tally,
}

impl Desk {
    /// A desk that goes on from `last`, or starts afresh. `phase_ns` spreads loops over their period.
    #[must_use]
    pub fn new(home: HostId, spec: Arc<LoopSpec>, last: Option<Arc<Record>>, now_ns: u64, phase_ns: u64) -> Self {
        let position = last.as_ref().map_or((0, 0), |r| r.position());
        let floor = if last.is_some() {
            position.0 + TERMS_SKIPPED_AT_RESTART
        } else {
            0
        };
        Self {
            home,
            arbiter: Arbiter::new(position, floor),
            tick: Tick::start(now_ns, spec.period_ns, phase_ns, position.1 + 1),
            spec,
            members: Vec::new(),
            suspects: Vec::new(),
            waiting: None,
            last,
            commands: VecDeque::new(),
            unkept: VecDeque::new(),
            messages: VecDeque::new(),
            wanted_owner: None,
            tally: Tally::default(),
        }
    }

    /// Gives only greater terms than `floor` from now on. For a home that another host had before: see [`crate::lease`].
    pub fn raise_terms(&mut self, floor: u64) {
        self.arbiter.raise_terms(floor);
    }

    /// The specification in force.
    #[must_use]
    pub const fn spec(&self) -> &Arc<LoopSpec> {
        &self.spec
    }

    /// The last record taken.
    #[must_use]
    pub const fn last(&self) -> Option<&Arc<Record>> {
        self.last.as_ref()
    }

    /// The host that owns the loop now.
    #[must_use]
    pub const fn owner(&self) -> Option<&HostId> {
        self.arbiter.owner()
    }

    /// The current term.
    #[must_use]
    pub const fn term(&self) -> u64 {
        self.arbiter.term()
    }

    /// Counts since the start.
    #[must_use]
    pub const fn tally(&self) -> Tally {
        self.tally
    }

    /// Live members in rank order.
    #[must_use]
    pub fn members(&self) -> &[HostId] {
        &self.members
    }

    /// When the desk wants to be called next: the next deadline, or the moment when the waiting commit is overdue.
    #[must_use]
    pub fn due_at_ns(&self) -> u64 {
        let deadline = self.tick.next_at_ns();
        self.waiting
            .as_ref()
            .map_or(deadline, |w| w.overdue_at_ns.min(deadline))
    }

    /// Is a deadline due, or only a silence?
    #[must_use]
    pub const fn deadline_at_ns(&self) -> u64 {
        self.tick.next_at_ns()
    }

    /// The hosts that hold the loop and are believed alive, best first. An owner that is no longer among them has lost
    /// the ownership; what it still waits for goes to the next, at once.
    pub fn set_members(&mut self, now_ns: u64, members: Vec<HostId>) -> Option<Dispatch> {
        self.members = members;
        // Who was not silent again within the longest time begins anew; so nobody who left for good is remembered for good.
        self.suspects
            .retain(|s| now_ns < s.until_ns.saturating_add(SUSPECT_NS_MAX));
        let gone = self.arbiter.owner().is_some_and(|owner| !self.members.contains(owner));
        if !gone {
            return None;
        }
        self.arbiter.dismiss();
        self.tally.takeovers += 1;
        self.waiting.is_some().then(|| self.redispatch(now_ns))
    }

    /// Hands the ownership to `host` at the next deadline, between two cycles, if it is a member then.
    pub fn move_to(&mut self, host: HostId) {
        self.wanted_owner = Some(host);
    }

    /// Takes a command in. Asking twice with one id does it once.
    pub fn command(&mut self, command: Command) -> Queued {
        if self.unkept.iter().any(|(a, _)| a.id == command.id) {
            return Queued::Waits;
        }
        if let Some(applied) = self
            .last
            .as_ref()
            .and_then(|r| r.applied.iter().find(|a| a.id == command.id).cloned())
        {
            return Queued::Ended(applied);
        }
        if self.commands.iter().any(|c| c.id == command.id) {
            return Queued::Waits;
        }
        if self.commands.len() + self.unkept.len() >= COMMANDS_WAITING_MAX {
            return Queued::Full;
        }
        self.commands.push_back(command);
        Queued::Waits
    }

    /// Takes a command back that no record holds yet, for example because its sender stopped waiting. False where it
    /// may have been taken already: it rides in the sample that is out.
    pub fn withdraw(&mut self, id: crate::record::CommandId) -> bool {
        let riding = self
            .waiting
            .as_ref()
            .is_some_and(|w| w.sample.commands.iter().any(|c| c.id == id));
        if riding {
            return false;
        }
        let before = self.commands.len();
        self.commands.retain(|c| c.id != id);
        self.commands.len() < before
    }

    /// The revision that the oldest waiting change asks for: its readings shall ride along.
    #[must_use]
    pub fn waiting_revision(&self) -> Option<u64> {
        self.commands.iter().find_map(|c| match c.body {
            CommandBody::Revise(revision) => Some(revision),
            _ => None,
        })
    }

    /// A message for the loop; the oldest goes where too many wait, for a controller wants the newest.
    pub fn message(&mut self, message: Message) {
        if self.messages.len() >= MESSAGES_PER_STEP_MAX {
            self.messages.pop_front();
        }
        self.messages.push_back(message);
    }

    /// A deadline came: closes the cycle that still waits, opens the next one with these readings (one per port), and
    /// those of a revision that waits. None where no deadline is due.
    pub fn deadline(
        &mut self,
        now_ns: u64,
        mut readings: Vec<Reading>,
        next_readings: Option<(u64, Vec<Reading>)>,
    ) -> Option<(Fired, Dispatch)> {
        let fired = self.tick.fire(now_ns)?;
        self.tally.skipped += fired.skipped;
        if let Some(waiting) = self.waiting.take() {
            self.tally.lost += 1;
            // Every host tried in that cycle and silent until its end is passed over for a while.
            for host in waiting.tried {
                self.strike(now_ns, &host);
            }
        }
        if let Some(last) = self.last.as_ref().filter(|r| r.revision == self.spec.revision) {
            for (reading, before) in readings.iter_mut().zip(&last.readings) {
                reading.fresh = reading.value.is_ok() && reading.at_ns > before.at_ns;
            }
        }
        let mut resume = false;
        if let Some(wanted) = self.wanted_owner.take_if(|w| self.members.contains(w))
            && self.arbiter.owner() != Some(&wanted)
        {
            // Whoever asks for a move knows better than an old silence.
            self.suspects.retain(|s| s.host != wanted);
            self.arbiter.appoint(wanted);
            resume = true;
        }
        if self.arbiter.owner().is_none() || self.owner_is_suspect(now_ns) {
            let Some(next) = self.next_owner(now_ns, &[]) else {
                self.tally.lost += 1;
                return Some((fired, Dispatch::Nobody));
            };
            if self.arbiter.owner() != Some(&next) {
                self.arbiter.appoint(next);
                resume = true;
            }
        }
        let Some(owner) = self.arbiter.owner().cloned() else {
            self.tally.lost += 1;
            return Some((fired, Dispatch::Nobody));
        };
        self.arbiter.open(fired.seq);
        let deadline_ns = self.tick.next_at_ns();
        let overdue_at_ns = now_ns + self.part_ns(deadline_ns.saturating_sub(now_ns));
        let sample = Sample {
            loop_id: self.spec.id.clone(),
            term: self.arbiter.term(),
            seq: fired.seq,
            owner: owner.clone(),
            home: self.home.clone(),
            at_ns: now_ns,
            left_ns: overdue_at_ns - now_ns,
            revision: self.spec.revision,
            readings,
            next_readings,
            members: self.members.clone(),
            commands: self.commands.iter().cloned().collect(),
            messages: self.messages.iter().cloned().collect(),
            last: self.arbiter.last(),
            resume: if resume { self.last.clone() } else { None },
        };
        self.waiting = Some(Waiting {
            sample: sample.clone(),
            overdue_at_ns,
            deadline_ns,
            tried: vec![owner],
        });
        Some((fired, Dispatch::Send(Box::new(sample))))
    }

    /// The waiting commit is overdue: the owner loses the loop, the next member gets the same sample.
    /// None where nothing is overdue.
    pub fn overdue(&mut self, now_ns: u64) -> Option<Dispatch> {
        let waiting = self.waiting.as_ref()?;
        // At the next deadline the cycle is lost in any case; `deadline` closes it and passes the owner over.
        if now_ns < waiting.overdue_at_ns || now_ns >= waiting.deadline_ns {
            return None;
        }
        if let Some(owner) = self.arbiter.owner().cloned() {
            self.strike(now_ns, &owner);
        }
        self.tally.takeovers += 1;
        Some(self.redispatch(now_ns))
    }

    /// The owner asks for the last record, or declines. None where the answer is not for the cycle that waits.
    pub fn answered(&mut self, now_ns: u64, answer: &Answer) -> Option<Dispatch> {
        let (term, seq, from) = match answer {
            Answer::NeedRecord { term, seq, owner, .. } | Answer::Decline { term, seq, owner, .. } => {
                (*term, *seq, owner)
            }
            Answer::Commit(_) | Answer::Held { .. } => return None,
        };
        let waiting = self.waiting.as_mut()?;
        if (term, seq) != (self.arbiter.term(), waiting.sample.seq) || self.arbiter.owner() != Some(from) {
            return None;
        }
        match answer {
            Answer::NeedRecord { .. } => {
                let mut sample = waiting.sample.clone();
                sample.resume = self.last.clone();
                sample.left_ns = waiting.overdue_at_ns.saturating_sub(now_ns);
                Some(Dispatch::Send(Box::new(sample)))
            }
            _ => {
                let from = from.clone();
                self.strike(now_ns, &from);
                self.tally.takeovers += 1;
                Some(self.redispatch(now_ns))
            }
        }
    }

    /// May this record be taken? Nothing changes but the count of refusals.
    pub fn check(&mut self, record: &Record) -> Result<(), Refusal> {
        self.arbiter.check(record).inspect_err(|_| self.tally.refused += 1)
    }

    /// Counts a commit that was refused outside, because an output was impossible.
    pub fn refuse(&mut self) {
        self.tally.refused += 1;
    }

    /// Takes the record after its outputs were written. Gives it back complete, for everyone.
    pub fn take(&mut self, now_ns: u64, mut record: Record) -> Arc<Record> {
        record.committed_after_ns = now_ns.saturating_sub(record.at_ns);
        self.arbiter.take(&record);
        self.tally.taken += 1;
        let outcomes = record
            .applied
            .iter()
            .filter(|a| self.commands.iter().any(|c| c.id == a.id));
        let outcomes: Vec<Applied> = outcomes.cloned().collect();
        if !outcomes.is_empty() {
            self.commands.retain(|c| !outcomes.iter().any(|a| a.id == c.id));
        }
        if let Some(waiting) = self.waiting.take() {
            let seen = waiting.sample.messages.len().min(self.messages.len());
            self.messages.drain(..seen);
        }
        self.suspects.retain(|s| s.host != record.owner);
        let record = Arc::new(record);
        self.unkept
            .extend(outcomes.into_iter().map(|a| (a, Arc::clone(&record))));
        self.last = Some(Arc::clone(&record));
        record
    }

    /// A record at `position`, or a later one, is on this home's disk, or at another host: the outcomes up to it, each with
    /// the record that holds it, may be told now. A position that was never taken counts for nothing.
    pub fn kept(&mut self, position: (u64, u64)) -> Vec<(Applied, Arc<Record>)> {
        if position > self.arbiter.last() {
            return Vec::new();
        }
        let n = self.unkept.iter().take_while(|(_, r)| r.position() <= position).count();
        self.unkept.drain(..n).collect()
    }

    /// Position of the latest record with an outcome that may not be told yet.
    #[must_use]
    pub fn unkept(&self) -> Option<(u64, u64)> {
        self.unkept.back().map(|(_, r)| r.position())
    }

    /// Goes on under another revision, after a record that carries it was taken.
    pub fn revise(&mut self, now_ns: u64, spec: Arc<LoopSpec>, phase_ns: u64) {
        if spec.period_ns != self.spec.period_ns {
            self.tick.set_period(now_ns, spec.period_ns, phase_ns);
        }
        self.spec = spec;
    }

    /// The part of the time left after which a silence counts.
    fn part_ns(&self, left_ns: u64) -> u64 {
        ((left_ns as f64 * self.spec.policy.takeover_part) as u64).max(1)
    }

    fn owner_is_suspect(&self, now_ns: u64) -> bool {
        self.arbiter
            .owner()
            .is_some_and(|o| self.suspects.iter().any(|s| s.host == *o && s.until_ns > now_ns))
    }

    fn strike(&mut self, now_ns: u64, host: &HostId) {
        let strikes = match self.suspects.iter_mut().find(|s| s.host == *host) {
            // One silence counts once, however often it is looked at.
            Some(s) if s.until_ns > now_ns => return,
            Some(s) => {
                s.strikes = (s.strikes + 1).min(16);
                s.strikes
            }
            None => {
                self.suspects.push(Suspect {
                    host: host.clone(),
                    until_ns: 0,
                    strikes: 1,
                });
                1
            }
        };
        let until_ns = now_ns + (SUSPECT_NS_MIN << (strikes - 1)).min(SUSPECT_NS_MAX);
        if let Some(s) = self.suspects.iter_mut().find(|s| s.host == *host) {
            s.until_ns = until_ns;
        }
    }

    /// The best member that is neither tried nor suspect; a suspect one where no other is left.
    fn next_owner(&self, now_ns: u64, tried: &[HostId]) -> Option<HostId> {
        let suspect = |h: &HostId| self.suspects.iter().any(|s| s.host == *h && s.until_ns > now_ns);
        let mut left = self.members.iter().filter(|h| !tried.contains(h));
        left.clone().find(|h| !suspect(h)).or_else(|| left.next()).cloned()
    }

    fn redispatch(&mut self, now_ns: u64) -> Dispatch {
        let Some(mut waiting) = self.waiting.take() else {
            return Dispatch::Nobody;
        };
        let Some(next) = self.next_owner(now_ns, &waiting.tried) else {
            self.arbiter.dismiss();
            self.tally.lost += 1;
            for host in waiting.tried {
                self.strike(now_ns, &host);
            }
            return Dispatch::Nobody;
        };
        waiting.tried.push(next.clone());
        waiting.sample.term = self.arbiter.appoint(next.clone());
        waiting.sample.owner = next;
        waiting.sample.members = self.members.clone();
        waiting.sample.resume = self.last.clone();
        waiting.overdue_at_ns = now_ns + self.part_ns(waiting.deadline_ns.saturating_sub(now_ns));
        waiting.sample.left_ns = waiting.overdue_at_ns - now_ns;
        let sample = waiting.sample.clone();
        self.waiting = Some(waiting);
        Dispatch::Send(Box::new(sample))
    }
}

#[cfg(test)]
mod tests;
