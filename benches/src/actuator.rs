//! What an actuator felt in a part of a run, judged from the journal: cycles that never reached it and pauses between two
//! writes, each as measured and without what the machine itself stalled.
//!
//! The machine's part, by [`Stalls`]:
//! - of a pause: the stalled time within it. What is left is the hosts'; it is never less than a period, which is no fault.
//! - of a lost cycle: it is the machine's where at least half a period per lost cycle was stalled within the pause, because
//!   a home looks for another owner after half a period, and a stall of that length can cost the cycle.

use bumpless_tests::Journal;

use crate::{
    report::{Bound, Report},
    spread::Spread,
    stall::Stalls,
};

/// What an actuator felt.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Felt {
    /// Writes in the part.
    pub(crate) writes: u64,
    /// Cycles without a write.
    pub(crate) lost_raw: u64,
    /// Those of them that the machine's stalls do not explain.
    pub(crate) lost: u64,
    /// Pauses of one and a half periods and more without a cycle lost, less the machine's stalls.
    pub(crate) late: u64,
    /// Longest pause between two writes, in periods.
    pub(crate) gap_raw: f64,
    /// The same without the machine's stalls.
    pub(crate) gap: f64,
    /// When that pause began and ended, in ns since 1970.
    pub(crate) worst_ns: (u64, u64),
}

/// What the actuator of `point` felt between the two times, in ns since 1970.
pub(crate) fn felt(
    journal: &Journal,
    point: &str,
    period_ns: u64,
    (from_ns, to_ns): (u64, u64),
    stalls: &Stalls,
) -> Felt {
    let mut felt = Felt {
        writes: journal.between(point, from_ns, to_ns).len() as u64,
        ..Felt::default()
    };
    // A pause belongs to the part in which it ended.
    for gap in journal
        .gaps(point, 0)
        .iter()
        .filter(|gap| (from_ns..to_ns).contains(&gap.to_ns))
    {
        let stalled_ns = stalls.within_ns(gap.from_ns, gap.to_ns);
        let own_ns = gap.ns().saturating_sub(stalled_ns).max(gap.ns().min(period_ns));
        let periods = |ns: u64| ns as f64 / period_ns as f64;
        felt.gap_raw = felt.gap_raw.max(periods(gap.ns()));
        if periods(own_ns) > felt.gap {
            felt.gap = periods(own_ns);
            felt.worst_ns = (gap.from_ns, gap.to_ns);
        }
        if gap.cycles_missing == 0 && periods(own_ns) >= 1.5 {
            felt.late += 1;
        }
        felt.lost_raw += gap.cycles_missing;
        if stalled_ns < gap.cycles_missing * (period_ns / 2) {
            felt.lost += gap.cycles_missing;
        }
    }
    felt
}

/// How far two writes of an actuator are from one period apart, in ns, in these times and without the machine's stalls; of all these
/// points with their periods in ns.
pub(crate) fn jitter(journal: &Journal, points: &[(String, u64)], spans: &[(u64, u64)], stalls: &Stalls) -> Spread {
    let mut spread = Spread::new();
    for (point, period_ns) in points {
        for gap in journal.gaps(point, 0) {
            let within = |(from_ns, to_ns): &(u64, u64)| (*from_ns..*to_ns).contains(&gap.to_ns);
            if spans.iter().any(within) && stalls.within_ns(gap.from_ns, gap.to_ns) == 0 {
                spread.add(gap.ns().abs_diff(*period_ns));
            }
        }
    }
    spread
}

/// A cycle that a kill cost was lost before the kill or this long after it, in ns: a cycle and its takeovers.
const CAUSED_NS: u64 = 50_000_000;

/// Cycles lost between the two times that neither the machine's stalls explain nor the takeovers: each kill may cost one cycle,
/// the one in which it came. Then those that takeovers explain.
pub(crate) fn lost_beyond_takeovers(
    journal: &Journal,
    point: &str,
    period_ns: u64,
    (from_ns, to_ns): (u64, u64),
    stalls: &Stalls,
    kills_ns: &[u64],
) -> (u64, u64) {
    let mut open = kills_ns.to_vec();
    let (mut beyond, mut by_takeover) = (0, 0);
    for gap in journal
        .gaps(point, 0)
        .iter()
        .filter(|gap| (from_ns..to_ns).contains(&gap.to_ns) && gap.cycles_missing > 0)
    {
        let stalled_ns = stalls.within_ns(gap.from_ns, gap.to_ns);
        if stalled_ns >= gap.cycles_missing * (period_ns / 2) {
            continue;
        }
        let killed = open
            .iter()
            .position(|at_ns| gap.to_ns > *at_ns && gap.from_ns < at_ns.saturating_add(CAUSED_NS));
        let excused = u64::from(killed.map(|place| open.swap_remove(place)).is_some());
        by_takeover += excused;
        beyond += gap.cycles_missing - excused;
    }
    (beyond, by_takeover)
}

impl Felt {
    /// Takes what another part, or another actuator, felt.
    pub(crate) const fn join(&mut self, other: &Self) {
        self.writes += other.writes;
        self.lost_raw += other.lost_raw;
        self.lost += other.lost;
        self.late += other.late;
        self.gap_raw = self.gap_raw.max(other.gap_raw);
        if other.gap > self.gap {
            self.gap = other.gap;
            self.worst_ns = other.worst_ns;
        }
    }

    /// Tells the figures under `name`, each with what the machine's stalls do not explain first, and judges those.
    pub(crate) fn tell(&self, report: &mut Report, name: &str, lost: Bound, gap: Bound) {
        report.told(&format!("{name}.cycles"), self.writes as f64, "cycles");
        report.figure(&format!("{name}.cycles_lost"), self.lost as f64, "cycles", lost);
        report.told(&format!("{name}.cycles_lost_raw"), self.lost_raw as f64, "cycles");
        report.figure(&format!("{name}.gap_ratio"), self.gap, "periods", gap);
        report.told(&format!("{name}.gap_ratio_raw"), self.gap_raw, "periods");
    }
}

/// Breaks of the promise of one writer in the whole journal, and lines that the journal itself lost.
pub(crate) fn tell_writers(report: &mut Report, bench: &str, journal: &Journal) {
    let violations = journal.check_one_writer();
    for violation in violations.iter().take(10) {
        report.progress(&violation.to_string());
    }
    report.figure(
        &format!("{bench}.double_writes"),
        violations.len() as f64,
        "writes",
        Bound::AtMost(0.0),
    );
    report.told(
        &format!("{bench}.refused_writes"),
        journal.refused.len() as f64,
        "writes",
    );
    report.figure(
        &format!("{bench}.journal_lines_dropped"),
        journal.dropped as f64,
        "lines",
        Bound::AtMost(0.0),
    );
}

#[cfg(test)]
mod tests {
    use bumpless_tests::Write;

    use super::*;

    fn journal(writes: &[(u64, u64)]) -> Journal {
        let write = |&(at_ns, seq): &(u64, u64)| Write {
            at_ns,
            point: "p".to_owned(),
            value: 1.0,
            loop_name: "l".to_owned(),
            term: 1,
            seq,
        };
        let mut journal = Journal::default();
        journal.writes = writes.iter().map(write).collect();
        journal
    }

    #[test]
    fn a_kill_explains_one_cycle_and_only_its_own() {
        // A period of 10 ms; the cycles 3, and 6 and 7, and 20 are missing.
        let ms = |ms: u64| ms * 1_000_000;
        let journal = journal(&[
            (ms(10), 1),
            (ms(20), 2),
            (ms(40), 4),
            (ms(50), 5),
            (ms(80), 8),
            (ms(190), 19),
            (ms(210), 21),
        ]);
        let lost = |stalls: &[(u64, u64)], kills_ns: &[u64]| {
            let times: Vec<_> = stalls.iter().map(|(from, to)| (ms(*from), ms(*to))).collect();
            let kills: Vec<_> = kills_ns.iter().map(|at| ms(*at)).collect();
            let stalls = Stalls::of_times(&times);
            lost_beyond_takeovers(&journal, "p", ms(10), (0, ms(1000)), &stalls, &kills)
        };
        // From 8 to 19 eleven cycles would be due and ten are missing as well.
        assert_eq!(lost(&[(80, 190)], &[]), (4, 0));
        assert_eq!(lost(&[(80, 190)], &[25]), (3, 1), "the first one is the kill's");
        assert_eq!(
            lost(&[(80, 190)], &[25, 55]),
            (2, 2),
            "of two lost cycles a kill explains one"
        );
        assert_eq!(
            lost(&[(80, 190)], &[500]),
            (4, 0),
            "a kill after it all explains nothing"
        );
        assert_eq!(lost(&[(80, 190)], &[100]), (4, 0), "nor one long before the last");
        assert_eq!(
            lost(&[(50, 190), (25, 35)], &[55]),
            (1, 0),
            "what the machine explains needs no kill"
        );
    }

    #[test]
    fn a_stall_explains_what_it_can_and_no_more() {
        // A period of 100; the cycle 3 is missing, and 5 comes late.
        let journal = journal(&[(100, 1), (200, 2), (400, 4), (570, 5), (600, 6)]);
        let quiet = Stalls::of_times(&[]);
        let all = felt(&journal, "p", 100, (0, 1000), &quiet);
        assert_eq!(
            all,
            Felt {
                writes: 5,
                lost_raw: 1,
                lost: 1,
                late: 1,
                gap_raw: 2.0,
                gap: 2.0,
                worst_ns: (200, 400)
            }
        );
        let short = Stalls::of_times(&[(300, 340)]);
        let some = felt(&journal, "p", 100, (0, 1000), &short);
        assert_eq!((some.lost_raw, some.lost, some.gap_raw), (1, 1, 2.0));
        assert!(
            (some.gap - 1.7).abs() < 1e-9,
            "the late one is the longest now: {}",
            some.gap
        );
        let long = Stalls::of_times(&[(210, 390), (400, 490)]);
        assert_eq!(
            felt(&journal, "p", 100, (0, 1000), &long),
            Felt {
                writes: 5,
                lost_raw: 1,
                lost: 0,
                late: 0,
                gap_raw: 2.0,
                gap: 1.0,
                worst_ns: (100, 200)
            }
        );
        assert_eq!(felt(&journal, "p", 100, (580, 1000), &quiet).gap_raw, 0.3);
    }
}
