//! One cycle's vote: who has a vote, when a majority is there, who stood against it, and who gets a vote again.
//!
//! ```text
//! able replicas ─► the first n that are not aside vote ─┐            ┌─ a majority is bit-equal ─► that step counts
//!                  those aside step along               ├─► answers ─┤
//!                  the rest stand in for silent ones ───┘            └─ none can be any more ─► no step: the loop's policy
//!
//! votes ── one answer against a majority ──► aside ── k answers in a row with it ──► votes
//! ```
//! Answers are compared to the bit: the sandbox is deterministic, so two sound machines that step the same component from the
//! same state on the same frame cannot differ. Never: waits, or remembers anything from one cycle to the next except through
//! [`Standing`], which rides in the record.

use std::collections::VecDeque;

use crate::{
    frame::{Effects, Fault},
    limits::REPLICAS_MAX,
    name::HostId,
    record::Event,
    redundancy::{Aside, Standing},
    spec::OnFewer,
};

/// Steps in a row that a replica must agree in before it votes again: a machine that errs once a second at 10 Hz does not
/// get through, and a sound one is back within seconds.
pub const CLEAN_STEPS: u32 = 20;

/// What a replica made of the step.
#[derive(Debug, Clone, PartialEq)]
pub enum Cast {
    /// It stepped.
    Effects(Effects),
    /// Its component failed, which is an answer as well: where all fail alike, no machine is to blame.
    Fault(Fault),
    /// It gave no answer that says anything about its machine: not ready, or too slow.
    Nothing,
}

impl Cast {
    /// From a step's result.
    #[must_use]
    pub fn of(result: Result<Effects, Fault>) -> Self {
        match result {
            Ok(effects) => Self::Effects(effects),
            // Time is no matter of bits: a crowded machine is slow, not wrong.
            Err(Fault::NotReady { .. } | Fault::Overrun { .. }) => Self::Nothing,
            Err(fault) => Self::Fault(fault),
        }
    }

    /// The same to the last bit? Faults are the same where their kind is; their texts may name addresses.
    #[must_use]
    pub fn same(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Effects(a), Self::Effects(b)) => {
                let bits = |effects: &Effects| -> Vec<(u8, u64)> {
                    effects
                        .writes
                        .iter()
                        .map(|(port, value)| (*port, value.to_bits()))
                        .collect()
                };
                a.state == b.state
                    && a.writes.len() == b.writes.len()
                    && bits(a) == bits(b)
                    && a.messages == b.messages
                    && a.alarms == b.alarms
                    && a.log == b.log
            }
            (Self::Fault(a), Self::Fault(b)) => std::mem::discriminant(a) == std::mem::discriminant(b),
            _ => false,
        }
    }
}

/// Equal answers that a majority of `votes` needs.
#[must_use]
pub const fn majority(votes: usize) -> usize {
    votes / 2 + 1
}

/// How a vote stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Not decided yet.
    Open,
    /// A majority agrees; this answer is one of theirs.
    Agreed {
        /// Its number, for [`Ballot::close`].
        answer: usize,
    },
    /// No majority can come about any more.
    Split,
}

/// Whether a replica stood with the majority.
pub type Judged = (HostId, bool);

/// The vote of one cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Ballot {
    voters: Vec<HostId>,
    shadows: Vec<HostId>,
    spares: VecDeque<HostId>,
    answers: Vec<(HostId, Cast)>,
    needed: usize,
    have: usize,
}

/// A vote that has ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Closed {
    /// What was decided.
    pub decided: Cast,
    /// Who stood where, as far as they answered.
    pub judged: Vec<Judged>,
    /// Answers that counted.
    pub answers: u8,
    /// Of these, equal to what was decided.
    pub agreed: u8,
    /// Equal answers that were needed.
    pub needed: u8,
    /// Who was asked and has not answered yet, with a vote or without.
    pub silent: Vec<HostId>,
}

impl Ballot {
    /// `able` are the replicas that can step now, the best first; at most 16 of them are looked at. `aside` are those without
    /// a vote.
    #[must_use]
    pub fn new(n: u8, able: impl IntoIterator<Item = HostId>, aside: &[Aside], on_fewer: OnFewer) -> Self {
        let is_aside = |host: &HostId| aside.iter().any(|a| a.host == *host);
        let (shadows, mut voters): (Vec<HostId>, Vec<HostId>) = able.into_iter().take(REPLICAS_MAX).partition(is_aside);
        let have = voters.len();
        let n = usize::from(n);
        let spares = voters.split_off(n.min(have)).into();
        let needed = match on_fewer {
            OnFewer::GoOn => majority(voters.len().min(n)),
            OnFewer::Fault => majority(n),
        };
        Self {
            answers: Vec::with_capacity(voters.len() + shadows.len()),
            voters,
            shadows,
            spares,
            needed,
            have,
        }
    }

    /// Whom to ask: those with a vote first, then those who step along.
    pub fn asked(&self) -> impl Iterator<Item = &HostId> {
        self.voters.iter().chain(&self.shadows)
    }

    /// Replicas with a vote that could step when the ballot was opened, spares among them.
    #[must_use]
    pub const fn have(&self) -> usize {
        self.have
    }

    /// Has it been asked, and not answered yet?
    #[must_use]
    pub fn waits_for(&self, host: &HostId) -> bool {
        self.asked().any(|h| h == host) && !self.answers.iter().any(|(h, _)| h == host)
    }

    /// Those with a vote who have not answered yet.
    #[must_use]
    pub fn silent_voters(&self) -> Vec<HostId> {
        self.voters.iter().filter(|h| self.waits_for(h)).cloned().collect()
    }

    /// Takes an answer; a second one of the same host, or one of somebody who was not asked, is passed over.
    pub fn cast(&mut self, host: &HostId, cast: Cast) {
        if self.waits_for(host) {
            self.answers.push((host.clone(), cast));
        }
    }

    /// Somebody with a vote was silent for too long: another replica gets its vote, if there is one, and is to be asked. What
    /// the silent one may still say is judged, and does not count.
    pub fn stand_in(&mut self, silent: &HostId) -> Option<HostId> {
        let place = self.voters.iter().position(|h| h == silent && self.waits_for(h))?;
        let spare = self.spares.pop_front()?;
        let silent = std::mem::replace(self.voters.get_mut(place)?, spare.clone());
        self.shadows.push(silent);
        Some(spare)
    }

    fn of_voters(&self) -> impl Iterator<Item = (usize, &Cast)> {
        let answers = self.answers.iter().enumerate();
        answers
            .filter(|(_, (h, _))| self.voters.contains(h))
            .map(|(i, (_, cast))| (i, cast))
    }

    fn equal_to(&self, cast: &Cast) -> usize {
        self.of_voters().filter(|(_, other)| cast.same(other)).count()
    }

    /// How it stands.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        let (mut most, mut silent) = (0, 0);
        for host in &self.voters {
            silent += usize::from(self.waits_for(host));
        }
        for (answer, cast) in self.of_voters() {
            let equal = self.equal_to(cast);
            if equal >= self.needed && *cast != Cast::Nothing {
                return Verdict::Agreed { answer };
            }
            most = most.max(equal);
        }
        if most + silent + self.spares.len().min(silent) < self.needed {
            return Verdict::Split;
        }
        Verdict::Open
    }

    /// Ends the vote with an answer that [`Ballot::verdict`] named, or with none.
    #[must_use]
    pub fn close(mut self, answer: Option<usize>) -> Closed {
        let silent: Vec<HostId> = self.asked().filter(|h| self.waits_for(h)).cloned().collect();
        let count = |n: usize| u8::try_from(n).unwrap_or(u8::MAX);
        let answers = count(self.of_voters().filter(|(_, cast)| **cast != Cast::Nothing).count());
        let most = self.of_voters().map(|(_, cast)| self.equal_to(cast)).max().unwrap_or(0);
        let mut closed = Closed {
            decided: Cast::Nothing,
            judged: Vec::new(),
            answers,
            agreed: count(most),
            needed: count(self.needed),
            silent,
        };
        let Some((_, decided)) = answer.and_then(|i| self.answers.get(i)) else {
            return closed;
        };
        closed.agreed = count(self.equal_to(decided));
        let judged = self.answers.iter().filter(|(_, cast)| *cast != Cast::Nothing);
        closed.judged = judged.map(|(host, cast)| (host.clone(), cast.same(decided))).collect();
        if let Some(i) = answer.filter(|i| *i < self.answers.len()) {
            closed.decided = self.answers.swap_remove(i).1;
        }
        closed
    }
}

/// The standing after a cycle: who was judged since the record before loses or gains a vote, and what is to be told.
#[must_use]
pub fn standing(before: Option<&Standing>, judged: &[Judged], members: &[HostId]) -> (Standing, Vec<Event>) {
    let mut standing = Standing {
        answers: 0,
        agreed: 0,
        needed: 0,
        ..before.cloned().unwrap_or_default()
    };
    let mut events = Vec::new();
    for (host, agreed) in judged {
        standing.dissents += u64::from(!agreed);
        let place = standing.aside.iter().position(|a| a.host == *host);
        match (place.and_then(|i| standing.aside.get_mut(i)), agreed) {
            (None, true) => {}
            (None, false) => {
                events.push(Event::Dissent { replica: host.clone() });
                standing.aside.push(Aside {
                    host: host.clone(),
                    clean: 0,
                    dissents: 1,
                });
            }
            (Some(aside), false) => {
                aside.clean = 0;
                aside.dissents = aside.dissents.saturating_add(1);
            }
            (Some(aside), true) => {
                aside.clean += 1;
                if aside.clean >= CLEAN_STEPS {
                    events.push(Event::Readmitted { replica: host.clone() });
                    standing.aside.retain(|a| a.host != *host);
                }
            }
        }
    }
    // Whoever left keeps no vote when it comes back, as long as there is room to remember it.
    while standing.aside.len() > REPLICAS_MAX {
        let gone = standing.aside.iter().position(|a| !members.contains(&a.host));
        standing.aside.remove(gone.unwrap_or(0));
    }
    (standing, events)
}

#[cfg(test)]
mod tests;
