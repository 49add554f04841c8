//! Pieces of several steps and several hosts made one history, and what it lacks.
//!
//! Never: adds up what two hosts kept of the same time; they saw the same cycles.

use super::Row;

/// Ranges that one look names at most; nearer ones are joined beyond that.
const RANGES_MAX: usize = 8;

/// One history out of pieces of any steps, from any number of hosts, in any order.
///
/// Of two pieces of the same step and time the one with more cycles counts. A coarser piece counts where it has more cycles than
/// the finer ones within it: there the finer are gone, or never were. One that reaches beyond the window, of which `rows` have
/// not all that is finer, counts only where nothing finer is. The pieces given back do not overlap, oldest first.
#[must_use]
pub fn overlay(mut rows: Vec<Row>, (from_ns, to_ns): (u64, u64)) -> Vec<Row> {
    rows.sort_by(|a, b| {
        (a.step_ns, a.start_ns())
            .cmp(&(b.step_ns, b.start_ns()))
            .then(b.bucket.cycles.cmp(&a.bucket.cycles))
    });
    rows.dedup_by(|later, kept| (later.step_ns, later.start_ns()) == (kept.step_ns, kept.start_ns()));
    let mut joined: Vec<Row> = Vec::new();
    let mut rows = rows.into_iter().peekable();
    while let Some(step_ns) = rows.peek().map(|row| row.step_ns) {
        let mut finer = std::mem::take(&mut joined).into_iter().peekable();
        while let Some(coarse) = rows.next_if(|row| row.step_ns == step_ns) {
            while let Some(row) = finer.next_if(|row| row.start_ns() < coarse.start_ns()) {
                joined.push(row);
            }
            let before = joined.len();
            let mut cycles = 0_u64;
            while let Some(row) = finer.next_if(|row| row.start_ns() < coarse.end_ns()) {
                cycles = cycles.saturating_add(row.bucket.cycles);
                joined.push(row);
            }
            let whole = coarse.start_ns() >= from_ns && coarse.end_ns() <= to_ns;
            if if whole {
                coarse.bucket.cycles > cycles
            } else {
                joined.len() == before
            } {
                joined.truncate(before);
                joined.push(coarse);
            }
        }
        joined.extend(finer);
    }
    joined
}

/// Pieces of `width_ns` each, that begin at multiples of it. What is as coarse already stays as it is. `rows` are in order.
#[must_use]
pub fn thin(rows: Vec<Row>, width_ns: u64) -> Vec<Row> {
    if width_ns == 0 {
        return rows;
    }
    let mut thinned: Vec<Row> = Vec::new();
    for mut row in rows {
        if row.step_ns >= width_ns {
            thinned.push(row);
            continue;
        }
        let start_ns = row.start_ns() / width_ns * width_ns;
        match thinned.last_mut() {
            Some(last) if last.start_ns() == start_ns && last.step_ns == width_ns => last.merge(&row),
            _ => {
                row.bucket.start_ns = start_ns;
                row.step_ns = width_ns;
                thinned.push(row);
            }
        }
    }
    thinned
}

/// Stretches of a window without any piece, oldest first. `rows` are in order. A slow loop's time between two cycles is none.
#[must_use]
pub fn gaps(rows: &[Row], from_ns: u64, to_ns: u64) -> Vec<(u64, u64)> {
    let mut found = Vec::new();
    let mut at_ns = from_ns;
    let mut patience_ns = None;
    for row in rows.iter().filter(|row| row.end_ns() >= from_ns) {
        if row.start_ns() >= to_ns {
            break;
        }
        let here_ns = row.patience_ns();
        if row.start_ns().saturating_sub(at_ns) >= patience_ns.map_or(here_ns, |before: u64| before.min(here_ns)) {
            found.push((at_ns, row.start_ns()));
        }
        patience_ns = Some(here_ns);
        at_ns = at_ns.max(row.end_ns());
    }
    if to_ns.saturating_sub(at_ns) >= patience_ns.unwrap_or(1) {
        found.push((at_ns, to_ns));
    }
    found
}

/// Stretches of a window of which another host may know more: gaps, pieces coarser than `step_ns`, and pieces with fewer cycles
/// than there should have been. Those that end after `now_ns` are still being filled. At most eight, oldest first.
#[must_use]
pub fn doubtful(rows: &[Row], (from_ns, to_ns): (u64, u64), step_ns: u64, now_ns: u64) -> Vec<(u64, u64)> {
    let mut found = gaps(rows, from_ns, to_ns.min(now_ns));
    for row in rows.iter().filter(|row| row.end_ns() <= now_ns) {
        let expected = row.step_ns.checked_div(row.layout.period_ns).unwrap_or(0);
        let there = row.bucket.cycles.saturating_add(row.bucket.lost);
        if row.step_ns > step_ns || there.saturating_mul(10) < expected.saturating_mul(9) {
            found.push((row.start_ns().max(from_ns), row.end_ns().min(to_ns)));
        }
    }
    found.retain(|(from, to)| from < to);
    found.sort_unstable();
    let mut joined: Vec<(u64, u64)> = Vec::new();
    for (from, to) in found {
        match joined.last_mut() {
            Some(last) if from <= last.1 => last.1 = last.1.max(to),
            _ => joined.push((from, to)),
        }
    }
    while joined.len() > RANGES_MAX {
        let nearest = (1..joined.len())
            .filter_map(|i| Some((joined.get(i)?.0 - joined.get(i - 1)?.1, i)))
            .min();
        let Some((_, i)) = nearest else { break };
        let (_, to) = joined.remove(i);
        if let Some(before) = joined.get_mut(i - 1) {
            before.1 = to;
        }
    }
    joined
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::history::{Bucket, Layout, STEPS_NS, Seen};

    const S: u64 = 1_000_000_000;

    /// A piece of some cycles, 100 ms apart.
    fn row(step_ns: u64, start_ns: u64, cycles: u64) -> Row {
        let mut bucket = Bucket::at(start_ns);
        for i in 0..cycles {
            bucket.take(&Seen {
                at_ns: start_ns + i,
                setpoint: 1.0,
                measurement: Some((start_ns / S + i) as f64),
                ..Seen::default()
            });
        }
        let layout = Arc::new(Layout {
            outputs: vec![],
            period_ns: S / 10,
        });
        Row {
            step_ns,
            layout,
            bucket,
        }
    }

    fn places(rows: &[Row]) -> Vec<(u64, u64, u64)> {
        rows.iter()
            .map(|row| (row.step_ns / S, row.start_ns() / S, row.bucket.cycles))
            .collect()
    }

    #[test]
    fn the_finest_counts_where_it_is_whole_and_more_cycles_win() {
        let rows = vec![
            // The fine ones begin in the middle of the second coarse one.
            row(10 * S, 0, 100),
            row(10 * S, 10 * S, 100),
            row(10 * S, 20 * S, 30),
            row(S, 15 * S, 10),
            row(S, 20 * S, 10),
            row(S, 21 * S, 10),
            // Another host has the whole of a second that this one has half of.
            row(S, 22 * S, 4),
            row(S, 22 * S, 10),
        ];
        assert_eq!(
            places(&overlay(rows, (0, 30 * S))),
            [(10, 0, 100), (10, 10, 100), (1, 20, 10), (1, 21, 10), (1, 22, 10)]
        );
        // At the edge of a window the coarse one has cycles from beyond it.
        let rows = vec![row(10 * S, 10 * S, 100), row(10 * S, 20 * S, 100), row(S, 15 * S, 10)];
        assert_eq!(places(&overlay(rows, (15 * S, 25 * S))), [(1, 15, 10), (10, 20, 100)]);
    }

    #[test]
    fn gaps_are_told_and_slow_loops_have_none() {
        let rows = [row(S, 0, 10), row(S, S, 10), row(S, 5 * S, 10)];
        assert_eq!(gaps(&rows, 0, 8 * S), [(2 * S, 5 * S), (6 * S, 8 * S)]);
        assert_eq!(gaps(&[], 3, 8), [(3, 8)]);
        let slow = |start_ns| {
            let mut row = row(S, start_ns, 1);
            row.layout = Arc::new(Layout {
                outputs: vec![],
                period_ns: 5 * S,
            });
            row
        };
        assert_eq!(gaps(&[slow(0), slow(5 * S), slow(10 * S)], 0, 14 * S), []);
        assert_eq!(gaps(&[slow(0), slow(20 * S)], 0, 21 * S), [(S, 20 * S)]);
    }

    #[test]
    fn what_others_may_know_better_is_named_and_bounded() {
        let rows = [row(S, 0, 10), row(S, S, 7), row(10 * S, 10 * S, 100), row(S, 20 * S, 3)];
        let found = doubtful(&rows, (0, 30 * S), S, 20 * S);
        // The short second, the gap and the coarse piece touch; the last second is still being filled.
        assert_eq!(found, [(S, 20 * S)]);
        let holed: Vec<Row> = (0..40).map(|i| row(S, i * 3 * S, 10)).collect();
        let found = doubtful(&holed, (0, 118 * S), S, 1_000 * S);
        assert_eq!(found.len(), RANGES_MAX);
        assert_eq!((found[0].0, found.last().map(|range| range.1)), (S, Some(117 * S)));
    }

    proptest! {
        /// Thinned step by step or at once: the same pieces with the same counts, least and greatest, and nothing is lost.
        #[test]
        fn thinning_in_steps_is_thinning_at_once(seconds in prop::collection::btree_set(0_u64..4_000, 1..300)) {
            let rows: Vec<Row> = seconds.iter().map(|&s| row(S, s * S, 1 + s % 7)).collect();
            let at_once = thin(rows.clone(), STEPS_NS[3]);
            let mut by_steps = rows.clone();
            for width in &STEPS_NS[1..] {
                by_steps = thin(by_steps, *width);
            }
            prop_assert_eq!(places(&by_steps), places(&at_once));
            for (a, b) in by_steps.iter().zip(&at_once) {
                prop_assert_eq!(a.bucket.measurement.min, b.bucket.measurement.min);
                prop_assert_eq!(a.bucket.measurement.max, b.bucket.measurement.max);
                prop_assert!((a.bucket.measurement.sum - b.bucket.measurement.sum).abs() < 1e-6);
            }
            let total = |rows: &[Row]| rows.iter().map(|row| row.bucket.cycles).sum::<u64>();
            prop_assert_eq!(total(&by_steps), total(&rows));
        }

        /// Two hosts that each lost something: every second that one of them had whole is in the joined history, once.
        #[test]
        fn what_one_host_lacks_another_fills(
            a in prop::collection::btree_set(0_u64..200, 0..150), b in prop::collection::btree_set(0_u64..200, 0..150),
        ) {
            let of = |seconds: &std::collections::BTreeSet<u64>| {
                let fine: Vec<Row> = seconds.iter().map(|&s| row(S, s * S, 10)).collect();
                let mut all = thin(fine.clone(), 10 * S);
                all.extend(fine);
                all
            };
            let joined = overlay([of(&a), of(&b)].concat(), (0, 200 * S));
            let mut seen = std::collections::BTreeSet::new();
            for row in &joined {
                // A coarse piece never wins over the fine ones that it was made of.
                prop_assert_eq!(row.step_ns, S);
                prop_assert!(seen.insert(row.start_ns() / S), "twice");
            }
            prop_assert_eq!(seen, a.union(&b).copied().collect());
        }
    }
}
