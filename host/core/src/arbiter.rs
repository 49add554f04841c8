//! Who may write a loop's outputs now: one writer, terms and cycle numbers that only grow.
//!
//! Owns the term and the position of the last record taken. Never: writes an output itself (the I/O server does, between
//! `check` and `take`), and never decides who shall own the loop (`desk` does).
//!
//! ```text
//! appoint(host) ─► term+1, owner = host          (every change of ownership)
//! open(seq)     ─► one cycle is outstanding      (every deadline)
//! check(commit) ─► ok only for: current term, its owner, the outstanding cycle, going on from the last record
//! take(commit)  ─► last = (term, seq), nothing outstanding
//! ```

use crate::{name::HostId, protocol::Refusal, record::Record};

/// Orders one loop's records and fences its writers.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Arbiter {
    term: u64,
    owner: Option<HostId>,
    last: (u64, u64),
    outstanding: Option<u64>,
}

impl Arbiter {
    /// Goes on after the record at `last`, (0, 0) for a loop that never ran. The first term given out is greater than
    /// `term_floor` and than the last record's term.
    #[must_use]
    pub fn new(last: (u64, u64), term_floor: u64) -> Self {
        Self {
            term: last.0.max(term_floor),
            owner: None,
            last,
            outstanding: None,
        }
    }

    /// The next term is greater than `floor`. Nobody owns the loop then, if somebody did under a lesser one.
    pub fn raise_terms(&mut self, floor: u64) {
        if floor > self.term {
            self.term = floor;
            self.owner = None;
        }
    }

    /// Gives the ownership to `host` under a new term. Whatever the owner before still sends is refused from now on.
    pub fn appoint(&mut self, host: HostId) -> u64 {
        self.term += 1;
        self.owner = Some(host);
        self.term
    }

    /// Takes the ownership away; nobody may write until the next appointment.
    pub fn dismiss(&mut self) {
        self.term += 1;
        self.owner = None;
    }

    /// Opens cycle `seq`, which must be greater than the last one taken; an open one before it is closed for good.
    pub fn open(&mut self, seq: u64) {
        debug_assert!(seq > self.last.1, "cycle numbers only grow");
        self.outstanding = Some(seq);
    }

    /// The current term.
    #[must_use]
    pub const fn term(&self) -> u64 {
        self.term
    }

    /// The current owner.
    #[must_use]
    pub const fn owner(&self) -> Option<&HostId> {
        self.owner.as_ref()
    }

    /// Position of the last record taken; (0, 0) for none.
    #[must_use]
    pub const fn last(&self) -> (u64, u64) {
        self.last
    }

    /// The cycle that waits for its commit.
    #[must_use]
    pub const fn outstanding(&self) -> Option<u64> {
        self.outstanding
    }

    /// May this record be taken? Nothing changes.
    pub fn check(&self, record: &Record) -> Result<(), Refusal> {
        if record.term < self.term {
            return Err(Refusal::OldTerm);
        }
        if record.term > self.term {
            return Err(Refusal::NeverGiven);
        }
        if self.owner.as_ref() != Some(&record.owner) {
            return Err(Refusal::NotOwner);
        }
        match self.outstanding {
            Some(seq) if seq == record.seq => {}
            Some(seq) if record.seq > seq => return Err(Refusal::NeverGiven),
            _ => return Err(Refusal::OldSeq),
        }
        if record.after != self.last {
            return Err(Refusal::WrongBase);
        }
        Ok(())
    }

    /// Takes the record: call only after `check` said yes and the outputs were written.
    pub fn take(&mut self, record: &Record) {
        debug_assert!(self.check(record).is_ok(), "take follows a good check");
        self.last = record.position();
        self.outstanding = None;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::record::test_record;

    fn host(n: u8) -> HostId {
        HostId::new(format!("h{n}")).expect("valid")
    }

    #[derive(Debug, Clone)]
    enum Move {
        Appoint(u8),
        Dismiss,
        Open,
        Commit {
            owner: u8,
            term_back: u64,
            seq_back: u64,
            right_base: bool,
        },
    }

    fn moves() -> impl Strategy<Value = Vec<Move>> {
        prop::collection::vec(
            prop_oneof![
                (0u8..3).prop_map(Move::Appoint),
                Just(Move::Dismiss),
                Just(Move::Open),
                (0u8..3, 0u64..3, 0u64..3, any::<bool>()).prop_map(|(owner, term_back, seq_back, right_base)| {
                    Move::Commit {
                        owner,
                        term_back,
                        seq_back,
                        right_base,
                    }
                }),
            ],
            1..200,
        )
    }

    proptest! {
        /// Whatever hosts send in whatever order: positions taken only grow, each from the current owner, each on the last.
        #[test]
        fn one_writer_and_only_forwards(moves in moves()) {
            let mut arbiter = Arbiter::new((0, 0), 0);
            let (mut seq, mut taken, mut owners) = (0, vec![(0, 0)], vec![(0, None)]);
            for m in moves {
                match m {
                    Move::Appoint(n) => { let term = arbiter.appoint(host(n)); owners.push((term, Some(host(n)))); }
                    Move::Dismiss => { arbiter.dismiss(); owners.push((arbiter.term(), None)); }
                    Move::Open => { seq += 1; arbiter.open(seq); }
                    Move::Commit { owner, term_back, seq_back, right_base } => {
                        let mut record = test_record();
                        record.term = arbiter.term().saturating_sub(term_back);
                        record.seq = seq.saturating_sub(seq_back);
                        record.owner = host(owner);
                        record.after = if right_base { arbiter.last() } else { (99, 99) };
                        if arbiter.check(&record).is_ok() {
                            arbiter.take(&record);
                            let before = *taken.last().expect("never empty");
                            prop_assert!(record.position() > before && record.seq > before.1);
                            prop_assert_eq!(record.after, before);
                            let (term, current) = owners.last().expect("never empty");
                            prop_assert_eq!(record.term, *term);
                            prop_assert_eq!(Some(&record.owner), current.as_ref());
                            taken.push(record.position());
                            prop_assert!(arbiter.check(&record).is_err(), "no record is taken twice");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn a_raised_floor_fences_whoever_was_before() {
        let mut arbiter = Arbiter::new((4, 90), 0);
        let mut old = test_record();
        (old.term, old.owner, old.seq, old.after) = (arbiter.appoint(host(1)), host(1), 91, (4, 90));
        arbiter.open(91);
        arbiter.raise_terms(3_000);
        assert_eq!(arbiter.check(&old), Err(Refusal::OldTerm));
        arbiter.raise_terms(7);
        assert_eq!(arbiter.appoint(host(2)), 3_001);
    }

    #[test]
    fn a_paused_owner_is_fenced() {
        let mut arbiter = Arbiter::new((4, 90), 0);
        let mut old = test_record();
        (old.term, old.owner, old.seq, old.after) = (arbiter.appoint(host(1)), host(1), 91, (4, 90));
        arbiter.open(91);
        assert_eq!(arbiter.check(&old), Ok(()));
        arbiter.appoint(host(2));
        assert_eq!(arbiter.check(&old), Err(Refusal::OldTerm));
        old.term += 1;
        assert_eq!(arbiter.check(&old), Err(Refusal::NotOwner));
        old.term += 1;
        assert_eq!(arbiter.check(&old), Err(Refusal::NeverGiven));
    }
}
