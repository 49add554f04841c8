//! How soon a component whose faults are dear is tried again: a fault that used up its time took it from all loops of its thread.
//!
//! ```text
//! trusted ──dear fault──► twice in a row ──► rests 2, 4, 8 … cycles, at most 10 s, one try after each ──good step──► trusted
//!                                              └── another revision, or a command of a person ──► tried at once
//! ```
//! While it rests, a cycle ends as after the fault: the loop's policy holds the output, and faults go on being counted.
//! Never: keeps a component from being tried for good; judges faults that cost nothing.

use crate::frame::Fault;

/// Own time from which on a fault is dear, in ns: some times the longest good step of a stock law, and a fiftieth of a period of
/// 50 Hz.
pub const DEAR_NS: u64 = 400_000;
/// Dear faults in a row that are tried again at once: one may have been the machine's doing.
const FREE: u32 = 2;
/// Longest rest, in ns: an operator who mends the cause waits no longer than that.
const REST_NS_MAX: u64 = 10_000_000_000;

/// What the owner of a loop remembers of dear faults.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Patience(Option<Spent>);

#[derive(Debug, Clone, PartialEq)]
struct Spent {
    revision: u64,
    in_a_row: u32,
    /// The cycle of the last one.
    seq: u64,
    next_seq: u64,
    fault: Fault,
}

impl Patience {
    /// A step of this revision in this cycle ended in a fault, after so much time of its own, in ns. An overrun is always dear.
    pub fn faulted(&mut self, revision: u64, seq: u64, period_ns: u64, fault: &Fault, step_ns: u64) {
        if step_ns < DEAR_NS && !matches!(fault, Fault::Overrun { .. }) {
            return;
        }
        let before = self.0.take().filter(|spent| spent.revision == revision);
        // Several replicas that overrun in one cycle are one fault.
        let in_a_row = match &before {
            Some(spent) if spent.seq == seq => spent.in_a_row,
            Some(spent) => spent.in_a_row.saturating_add(1),
            None => 1,
        };
        let rest = match in_a_row.checked_sub(FREE) {
            None => 0,
            Some(times) => (2_u64 << times.min(32)).min((REST_NS_MAX / period_ns.max(1)).max(1)),
        };
        self.0 = Some(Spent {
            revision,
            in_a_row,
            seq,
            next_seq: seq.saturating_add(1).saturating_add(rest),
            fault: fault.clone(),
        });
    }

    /// A step was good.
    pub fn good(&mut self) {
        self.0 = None;
    }

    /// A person commands: whatever was wrong may be mended.
    pub fn commanded(&mut self) {
        if let Some(spent) = &mut self.0 {
            spent.in_a_row = spent.in_a_row.min(FREE - 1);
            spent.next_seq = 0;
        }
    }

    /// The fault that this cycle ends with unless it is tried, and the cycle in which it is tried next; none where it is tried now.
    #[must_use]
    pub fn rests(&self, revision: u64, seq: u64) -> Option<(&Fault, u64)> {
        let spent = self.0.as_ref()?;
        (spent.revision == revision && seq < spent.next_seq).then_some((&spent.fault, spent.next_seq))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    const PERIOD_NS: u64 = 10_000_000;

    fn overrun() -> Fault {
        Fault::Overrun { limit_us: 2500 }
    }

    /// The cycles of so many in which a component that always overruns is tried.
    fn tries(cycles: u64, period_ns: u64) -> Vec<u64> {
        let mut patience = Patience::default();
        (0..cycles)
            .filter(|&seq| {
                let tried = patience.rests(1, seq).is_none();
                if tried {
                    patience.faulted(1, seq, period_ns, &overrun(), 0);
                }
                tried
            })
            .collect()
    }

    #[test]
    fn what_spins_for_ever_is_tried_ever_less_often_but_never_given_up() {
        assert_eq!(tries(40, PERIOD_NS), [0, 1, 4, 9, 18, 35]);
        let long = tries(10_000, PERIOD_NS);
        let last = long.len() - 1;
        assert_eq!(long[last] - long[last - 1], 1001, "ten seconds and a cycle");
        assert!(long.len() < 20, "{long:?}");
        // Where ten seconds are less than a cycle, every second one.
        assert_eq!(tries(6, 60_000_000_000), [0, 1, 3, 5]);
    }

    #[test]
    fn one_good_step_one_command_another_revision_and_it_is_tried_at_once() {
        let mut patience = Patience::default();
        for seq in 0..4 {
            patience.faulted(1, seq, PERIOD_NS, &overrun(), 0);
        }
        assert_eq!(patience.rests(1, 5).unwrap(), (&overrun(), 12));
        assert_eq!(patience.rests(2, 5), None);
        let mut commanded = patience.clone();
        commanded.commanded();
        assert_eq!(commanded.rests(1, 5), None);
        commanded.faulted(1, 5, PERIOD_NS, &overrun(), 0);
        assert!(commanded.rests(1, 6).is_some(), "once more, and it rests again");
        patience.faulted(2, 6, PERIOD_NS, &overrun(), 0);
        patience.faulted(2, 6, PERIOD_NS, &overrun(), 0);
        assert_eq!(patience.rests(2, 7), None, "another revision begins anew");
        patience.good();
        assert_eq!(patience, Patience::default());
    }

    #[test]
    fn faults_that_cost_nothing_are_tried_in_each_cycle() {
        let mut patience = Patience::default();
        let trap = Fault::Trap("t".to_owned());
        for seq in 0..9 {
            patience.faulted(1, seq, PERIOD_NS, &trap, DEAR_NS - 1);
            assert_eq!(patience.rests(1, seq + 1), None);
        }
        for seq in 9..12 {
            patience.faulted(1, seq, PERIOD_NS, &trap, DEAR_NS);
        }
        assert!(patience.rests(1, 12).is_some());
    }
}
