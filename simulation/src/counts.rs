//! What a simulation counts.
//!
//! Never: judges.

use std::collections::BTreeMap;

use crate::{event::Message, plan::FaultKind};

/// What a kind of fault did to cycles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Harm {
    /// How often it struck.
    pub struck: u64,
    /// Cycles without a write, because of it or beside it.
    pub lost: u64,
    /// Cycles whose write came in the second half of their period.
    pub late: u64,
    /// Loops whose home died of it; their outputs held until it was there again.
    pub homes: u64,
}

/// Messages that a cycle sends, by what they are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Messages {
    /// Home to owner.
    pub samples: u64,
    /// Owner, or a member that has an outcome, to home.
    pub answers: u64,
    /// Home to those who hold the loop.
    pub records: u64,
    /// Owner to replicas, and back.
    pub steps: u64,
}

impl Messages {
    /// All of them.
    #[must_use]
    pub const fn all(&self) -> u64 {
        self.samples + self.answers + self.records + self.steps
    }
}

/// Counts of one simulation.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Counts {
    /// Events that happened.
    pub events: u64,
    /// Cycles whose commit was taken.
    pub taken: u64,
    /// Changes of ownership after a silence.
    pub takeovers: u64,
    /// By the latest fault that touched the loop's hosts; none where no fault did.
    pub harm: BTreeMap<Option<FaultKind>, Harm>,
    /// Commands asked for.
    pub asked: u64,
    /// Commands that somebody was told are done.
    pub told: u64,
    /// Commands that were refused.
    pub refused: u64,
    /// Loops that lost what somebody was told, because the home died while its disk was behind, and the other host that had it
    /// was lost as well.
    pub told_lost_to_two: u64,
    /// Steps that came out wrong.
    pub flipped: u64,
    /// Replicas that lost their vote.
    pub dissents: u64,
    /// Replicas that got it back.
    pub readmitted: u64,
    /// Cycles without a majority.
    pub no_majority: u64,
    /// Messages of cycles.
    pub messages: Messages,
    /// Messages that never arrived.
    pub undelivered: u64,
    /// Further copies of records: the bus hands each to every host, for the live feed. No cycle waits for them.
    pub feed_copies: u64,
}

impl Counts {
    fn of(&mut self, kind: Option<FaultKind>) -> &mut Harm {
        self.harm.entry(kind).or_default()
    }

    pub(crate) fn struck(&mut self, kind: FaultKind) {
        self.of(Some(kind)).struck += 1;
    }

    pub(crate) fn missed(&mut self, kind: Option<FaultKind>, cycles: u64) {
        self.of(kind).lost += cycles;
    }

    pub(crate) fn late(&mut self, kind: Option<FaultKind>) {
        self.of(kind).late += 1;
    }

    pub(crate) fn homes_lost(&mut self, kind: Option<FaultKind>) {
        self.of(kind).homes += 1;
    }

    pub(crate) const fn sent(&mut self, message: &Message) {
        let messages = &mut self.messages;
        match message {
            Message::Sample(_) => messages.samples += 1,
            Message::Answer(_) => messages.answers += 1,
            Message::Record(_) => messages.records += 1,
            Message::Step(_) | Message::StepAnswer(_) => messages.steps += 1,
        }
    }

    /// Cycles lost, whatever did it.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.harm.values().map(|harm| harm.lost).sum()
    }
}
