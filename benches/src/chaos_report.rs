//! What came of a run of `chaos`: what was broken (nothing may be), and what each kind of fault cost.
//!
//! Owns the judgement. Never: leaves out what the machine itself stalled; it is told apart (`raw`).

use std::collections::BTreeMap;

use bumpless_core::indices::{Indices, Rule};
use bumpless_tests::{Journal, Kind, Order, Outcome, Seen, Window, kept_commands};

use crate::{
    actuator::{self, Felt, felt},
    chaos::{LOOPS, PROFILE, loop_of},
    report::{Bound, Report},
    stall::Stalls,
};

/// A gap that began in a window ends at most this much later, in ns.
const AFTER_NS: u64 = 500_000_000;
/// Where every host was killed at once, what was acknowledged this shortly before, on the word of a member's memory, may not have
/// reached any disk, in ns: the home's writer puts an outcome to the disk with its next write, 100 ms later at most, and a sync
/// takes its time.
const FORGIVEN_NS: u64 = 300_000_000;

/// A whole run.
pub(crate) struct Course {
    /// Beginning and end of the undisturbed part, in ns since 1970.
    pub(crate) undisturbed: (u64, u64),
    pub(crate) ended_ns: u64,
    pub(crate) windows: Vec<Window>,
    /// Why the run ended early.
    pub(crate) broken: Option<String>,
    pub(crate) orders: Vec<Order>,
    pub(crate) records: Vec<Seen>,
    pub(crate) lost_records: u64,
    pub(crate) journal: Journal,
    pub(crate) stalls: Stalls,
}

/// The error of one loop over one whole period of the setpoint.
#[derive(Debug, Clone, Copy)]
struct Period {
    from_ns: u64,
    to_ns: u64,
    loop_number: usize,
    iae: f64,
}

/// Tells everything.
pub(crate) fn tell(course: &Course, report: &mut Report) {
    let of_loop: Vec<Journal> = (0..LOOPS).map(|n| course.journal.only(&loop_of(n).1)).collect();
    let periods = periods(course);
    let base = base(course, &periods);
    tell_part(
        course,
        report,
        "undisturbed",
        &[course.undisturbed],
        &of_loop,
        &periods,
        &base,
    );
    let mut kinds: BTreeMap<Kind, Vec<(u64, u64)>> = BTreeMap::new();
    for window in &course.windows {
        let span = (window.from_ns, window.to_ns + AFTER_NS);
        kinds.entry(window.kind).or_default().push(span);
    }
    for (kind, spans) in &kinds {
        tell_part(course, report, kind.name(), spans, &of_loop, &periods, &base);
    }
    tell_promises(course, report);
}

/// One kind of fault, or the undisturbed part.
fn tell_part(
    course: &Course,
    report: &mut Report,
    name: &str,
    spans: &[(u64, u64)],
    of_loop: &[Journal],
    periods: &[Period],
    base: &BTreeMap<usize, f64>,
) {
    let prefix = format!("chaos.{}", name.replace('-', "_"));
    report.told(&format!("{prefix}.windows"), spans.len() as f64, "times");
    let mut all = Felt::default();
    // The longest pause of each loop in each window, in periods and in ms.
    let (mut gaps, mut longest_ms, mut most_lost) = (Vec::new(), 0_f64, 0);
    for span in spans {
        for (number, journal) in of_loop.iter().enumerate() {
            let (_, point, period_ns) = loop_of(number);
            let part = felt(journal, &point, period_ns, *span, &course.stalls);
            if part.writes > 0 {
                gaps.push(part.gap);
                longest_ms = longest_ms.max(part.gap_raw * period_ns as f64 / 1e6);
            }
            most_lost = most_lost.max(part.lost);
            all.join(&part);
        }
    }
    let within = |at_ns: u64| spans.iter().any(|(from, to)| (*from..*to).contains(&at_ns));
    let records: Vec<&Seen> = course.records.iter().filter(|record| within(record.at_ns)).collect();
    let (bound, at_once) = match name {
        // In good order nothing may be lost, and a date is nobody's business.
        "drain" | "stop" | "date" | "clock-step" => (Bound::AtMost(0.0), Bound::None),
        // An owner's death costs its loops one cycle at most.
        "kill" => (Bound::None, Bound::AtMost(1.0)),
        _ => (Bound::None, Bound::None),
    };
    report.told(&format!("{prefix}.cycles"), all.writes as f64, "cycles");
    report.figure(&format!("{prefix}.cycles_lost"), all.lost as f64, "cycles", bound);
    let name_at_once = format!("{prefix}.cycles_lost_at_once");
    report.figure(&name_at_once, most_lost as f64, "cycles of one loop", at_once);
    report.told(&format!("{prefix}.cycles_lost_raw"), all.lost_raw as f64, "cycles");
    report.told(&format!("{prefix}.cycles_late"), all.late as f64, "cycles");
    let takeovers = records.iter().filter(|record| record.took_over).count();
    report.told(&format!("{prefix}.ownerships"), takeovers as f64, "times");
    let hedged = records.iter().filter(|record| record.hedged).count();
    report.told(&format!("{prefix}.cycles_hedged"), hedged as f64, "cycles");
    gaps.sort_by(f64::total_cmp);
    for (part, text) in [(0.5, "p50"), (0.99, "p99"), (1.0, "max")] {
        report.told(&format!("{prefix}.gap.{text}"), quantile(&gaps, part), "periods");
    }
    report.told(&format!("{prefix}.gap_ms.max_raw"), longest_ms, "ms");
    report.told(&format!("{prefix}.iae_change"), change(periods, spans, base), "%");
}

/// Promises that hold whatever happens.
fn tell_promises(course: &Course, report: &mut Report) {
    if let Some(why) = &course.broken {
        report.progress(&format!("the run ended early: {why}"));
    }
    let names: Vec<String> = (0..LOOPS).map(|n| loop_of(n).0).collect();
    let deaths: Vec<u64> = course
        .windows
        .iter()
        // The home may die together with the one that has the outcome.
        .filter(|window| matches!(window.kind, Kind::AllDead | Kind::Together))
        .map(|window| window.from_ns)
        .collect();
    let forgiven = |order: &Order| {
        let before = |death: &u64| order.answered_ns <= *death && order.answered_ns + FORGIVEN_NS >= *death;
        deaths.iter().any(before)
    };
    let breaches = kept_commands(&course.orders, &course.records, &names, &forgiven);
    for breach in breaches.iter().take(10) {
        report.progress(&breach.to_string());
    }
    let count = |is: &dyn Fn(&Order) -> bool| course.orders.iter().filter(|order| is(order)).count() as f64;
    actuator::tell_writers(report, "chaos", &course.journal);
    report.figure(
        "chaos.commands_lost",
        breaches.len() as f64,
        "commands",
        Bound::AtMost(0.0),
    );
    report.told("chaos.commands", course.orders.len() as f64, "commands");
    report.told(
        "chaos.commands_acknowledged",
        count(&|o| o.outcome != Outcome::Unknown),
        "commands",
    );
    report.told(
        "chaos.commands_unknown",
        count(&|o| o.outcome == Outcome::Unknown),
        "commands",
    );
    report.told("chaos.commands_asked_again", count(&|o| o.tries > 1), "commands");
    report.told("chaos.commands_before_all_died", count(&forgiven), "commands");
    report.figure(
        "chaos.not_recovered",
        f64::from(u8::from(course.broken.is_some())),
        "times",
        Bound::AtMost(0.0),
    );
    report.told("chaos.faults", course.windows.len() as f64, "faults");
    report.told("chaos.records_seen", course.records.len() as f64, "records");
    report.told("chaos.feed_records_lost", course.lost_records as f64, "records");
    report.told(
        "chaos.minutes",
        (course.ended_ns - course.undisturbed.0) as f64 / 6e10,
        "min",
    );
    course.stalls.tell(report, "chaos");
}

/// The value that this part of the sorted values does not exceed.
fn quantile(sorted: &[f64], part: f64) -> f64 {
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a place in a list"
    )]
    let place = ((sorted.len().saturating_sub(1)) as f64 * part).ceil() as usize;
    sorted.get(place).copied().unwrap_or(f64::NAN)
}

/// The error of every loop over every whole period of the setpoint.
fn periods(course: &Course) -> Vec<Period> {
    let length_ns = u64::try_from(PROFILE.half.as_nanos()).unwrap_or(u64::MAX) * 2;
    let mut of_loop: BTreeMap<usize, Vec<&Seen>> = BTreeMap::new();
    for record in &course.records {
        of_loop.entry(record.loop_number).or_default().push(record);
    }
    let mut periods = Vec::new();
    for (loop_number, mut records) in of_loop {
        records.sort_by_key(|record| record.at_ns);
        let mut from_ns = course.undisturbed.0;
        let mut rest = records.as_slice();
        while from_ns + length_ns <= course.ended_ns {
            let to_ns = from_ns + length_ns;
            let first = rest.partition_point(|record| record.at_ns < from_ns);
            let (_, after) = rest.split_at(first.min(rest.len()));
            let count = after.partition_point(|record| record.at_ns < to_ns);
            let (within, after) = after.split_at(count.min(after.len()));
            let mut indices = Indices::new(Rule::Trapezoid);
            for record in within {
                let t_s = (record.at_ns - from_ns) as f64 / 1e9;
                // What is not finite, or out of order, is no sample of an error.
                let _ = indices.add(t_s, record.setpoint, record.measurement);
            }
            if !within.is_empty() {
                periods.push(Period {
                    from_ns,
                    to_ns,
                    loop_number,
                    iae: indices.iae(),
                });
            }
            rest = after;
            from_ns = to_ns;
        }
    }
    periods
}

/// Each loop's error in an undisturbed period, on average.
fn base(course: &Course, periods: &[Period]) -> BTreeMap<usize, f64> {
    let (from_ns, to_ns) = course.undisturbed;
    let mut sums: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
    for period in periods.iter().filter(|p| p.from_ns >= from_ns && p.to_ns <= to_ns) {
        let sum = sums.entry(period.loop_number).or_default();
        sum.0 += period.iae;
        sum.1 += 1.0;
    }
    sums.into_iter().map(|(n, (sum, count))| (n, sum / count)).collect()
}

/// By how much the error of the periods that these spans touch differs from the undisturbed one, in %.
fn change(periods: &[Period], spans: &[(u64, u64)], base: &BTreeMap<usize, f64>) -> f64 {
    let touched = |period: &&Period| {
        spans
            .iter()
            .any(|(from, to)| period.from_ns < *to && *from < period.to_ns)
    };
    let (mut with, mut without) = (0.0, 0.0);
    for period in periods.iter().filter(touched) {
        if let Some(base) = base.get(&period.loop_number) {
            with += period.iae;
            without += base;
        }
    }
    100.0 * (with - without).abs() / without
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_that_were_seen() {
        let values = [1.0, 2.0, 3.0, 4.0];
        assert_eq!(
            [0.0, 0.5, 0.99, 1.0].map(|part| quantile(&values, part)),
            [1.0, 3.0, 4.0, 4.0]
        );
        assert!(quantile(&[], 0.5).is_nan());
    }

    #[test]
    fn the_change_is_of_the_periods_that_were_touched() {
        let period = |from_ns, iae| Period {
            from_ns,
            to_ns: from_ns + 10,
            loop_number: 0,
            iae,
        };
        let periods = [period(0, 2.0), period(10, 2.0), period(20, 3.0), period(30, 50.0)];
        let base = BTreeMap::from([(0, 2.0)]);
        assert!((change(&periods, &[(12, 25)], &base) - 25.0).abs() < 1e-9);
        assert!(change(&periods, &[(100, 110)], &base).is_nan(), "none was touched");
    }
}
