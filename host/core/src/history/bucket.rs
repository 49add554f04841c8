//! One piece of time: spreads and counts that can be taken together without loss.
//!
//! Never: keeps a mean; it keeps sums and numbers of values, so that the mean of joined pieces is that of their cycles.

use serde::{Deserialize, Serialize};

use crate::{reading::Quality, record::Record, spec::Mode};

/// Least, greatest and sum of some values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// The least; `+∞` where there is none.
    pub min: f64,
    /// The greatest; `-∞` where there is none.
    pub max: f64,
    /// Their sum.
    pub sum: f64,
    /// How many.
    pub count: u64,
}

impl Default for Spread {
    fn default() -> Self {
        Self {
            min: f64::INFINITY,
            max: f64::NEG_INFINITY,
            sum: 0.0,
            count: 0,
        }
    }
}

impl Spread {
    /// Takes a value; one that is not finite is none.
    pub fn take(&mut self, value: f64) {
        if value.is_finite() {
            self.min = self.min.min(value);
            self.max = self.max.max(value);
            self.sum += value;
            self.count += 1;
        }
    }

    /// Takes all values of another.
    pub fn merge(&mut self, other: &Self) {
        self.min = self.min.min(other.min);
        self.max = self.max.max(other.max);
        self.sum += other.sum;
        self.count = self.count.saturating_add(other.count);
    }

    /// The mean, within the values also where the sum was rounded or too great; none of nothing.
    #[must_use]
    pub fn mean(&self) -> Option<f64> {
        let mean = self.sum / self.count as f64;
        (self.count > 0).then(|| mean.max(self.min).min(self.max))
    }

    /// The least, where there is one.
    #[must_use]
    pub fn least(&self) -> Option<f64> {
        (self.count > 0).then_some(self.min)
    }

    /// The greatest, where there is one.
    #[must_use]
    pub fn greatest(&self) -> Option<f64> {
        (self.count > 0).then_some(self.max)
    }
}

/// What the cycles of one piece of time say together.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Bucket {
    /// When it begins, in ns since 1970 by the clock of the loop's home.
    pub start_ns: u64,
    /// Cycles in it.
    pub cycles: u64,
    /// Cycles that ended without a commit.
    pub lost: u64,
    /// Cycles whose outputs were written later than half a period after the deadline.
    pub late: u64,
    /// Cycles whose measurement was bad.
    pub bad: u64,
    /// Cycles in manual.
    pub manual: u64,
    /// How often the mode changed.
    pub mode_changes: u64,
    /// Wanted values.
    pub setpoint: Spread,
    /// Measured values; of a bad one the last good value counts, as the controller saw it.
    pub measurement: Spread,
    /// Outputs, by their number in the layout.
    pub outputs: Vec<Spread>,
    /// Times of the steps, in ns.
    pub step_ns: Spread,
}

/// One cycle, as far as history needs it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Seen<'a> {
    /// When its sample was frozen, in ns since 1970 by the clock of the loop's home.
    pub at_ns: u64,
    /// Wanted value.
    pub setpoint: f64,
    /// Measured value, if a port is measured.
    pub measurement: Option<f64>,
    /// Is the measurement bad?
    pub bad: bool,
    /// What was written, by output port.
    pub outputs: &'a [f64],
    /// Cycles before it, since the record that it goes on from, that ended without a commit.
    pub lost: u64,
    /// Written later than half a period after its deadline?
    pub late: bool,
    /// Did the operator decide?
    pub manual: bool,
    /// Is the mode another than in the record that it goes on from?
    pub mode_changed: bool,
    /// Time of the step, in ns.
    pub step_ns: Option<u64>,
}

impl<'a> Seen<'a> {
    /// What a record says. `measured` is the number of the measured port, `period_ns` the time from cycle to cycle, `before` the
    /// position and mode of the record that was seen before it.
    #[must_use]
    pub fn of(record: &'a Record, measured: Option<usize>, period_ns: u64, before: Option<((u64, u64), Mode)>) -> Self {
        let reading = measured.and_then(|port| record.readings.get(port));
        // Where a home began anew the numbers say nothing.
        let lost = if record.after == (0, 0) || record.after.0 > record.term {
            0
        } else {
            record.seq.saturating_sub(record.after.1).saturating_sub(1)
        };
        Self {
            at_ns: record.at_ns,
            setpoint: record.setpoint,
            measurement: reading.map(super::super::reading::Reading::value_or_last),
            bad: reading.is_some_and(|reading| reading.quality == Quality::Bad),
            outputs: &record.outputs,
            lost,
            late: period_ns > 0 && record.committed_after_ns > period_ns / 2,
            manual: record.mode == Mode::Manual,
            mode_changed: before.is_some_and(|(position, mode)| position == record.after && mode != record.mode),
            step_ns: Some(record.step_ns),
        }
    }
}

impl Bucket {
    /// An empty piece that begins here.
    #[must_use]
    pub fn at(start_ns: u64) -> Self {
        Self {
            start_ns,
            ..Self::default()
        }
    }

    /// Takes a cycle.
    pub fn take(&mut self, seen: &Seen<'_>) {
        self.cycles += 1;
        self.lost = self.lost.saturating_add(seen.lost);
        self.late += u64::from(seen.late);
        self.bad += u64::from(seen.bad);
        self.manual += u64::from(seen.manual);
        self.mode_changes += u64::from(seen.mode_changed);
        self.setpoint.take(seen.setpoint);
        if let Some(measurement) = seen.measurement {
            self.measurement.take(measurement);
        }
        if self.outputs.len() < seen.outputs.len() {
            self.outputs.resize(seen.outputs.len(), Spread::default());
        }
        for (spread, value) in self.outputs.iter_mut().zip(seen.outputs) {
            spread.take(*value);
        }
        if let Some(step_ns) = seen.step_ns {
            self.step_ns.take(step_ns as f64);
        }
    }

    /// Takes all cycles of another piece with the same outputs. The beginning stays.
    pub fn merge(&mut self, other: &Self) {
        let counts = [
            (&mut self.cycles, other.cycles),
            (&mut self.lost, other.lost),
            (&mut self.late, other.late),
            (&mut self.bad, other.bad),
            (&mut self.manual, other.manual),
            (&mut self.mode_changes, other.mode_changes),
        ];
        for (mine, theirs) in counts {
            *mine = mine.saturating_add(theirs);
        }
        self.setpoint.merge(&other.setpoint);
        self.measurement.merge(&other.measurement);
        if self.outputs.len() < other.outputs.len() {
            self.outputs.resize(other.outputs.len(), Spread::default());
        }
        for (mine, theirs) in self.outputs.iter_mut().zip(&other.outputs) {
            mine.merge(theirs);
        }
        self.step_ns.merge(&other.step_ns);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use proptest::prelude::*;

    use super::*;
    use crate::{reading::Reading, record::test_record};

    #[test]
    fn a_record_is_seen() {
        let mut record = test_record();
        record.seq = 9;
        record.after = (1, 6);
        record.readings = vec![
            Reading::good(7.0, 1),
            Reading::missing(crate::NoData::CommsLost, 3.5, 1),
        ];
        record.committed_after_ns = 51;
        record.mode = Mode::Manual;
        let seen = Seen::of(&record, Some(1), 100, Some(((1, 6), Mode::Automatic)));
        assert_eq!((seen.measurement, seen.bad, seen.lost), (Some(3.5), true, 2));
        assert!(seen.late && seen.manual && seen.mode_changed);
        // What was seen before is not what it goes on from: nobody knows whether the mode changed in between.
        assert!(!Seen::of(&record, Some(0), 102, Some(((1, 5), Mode::Automatic))).mode_changed);
        assert!(!Seen::of(&record, Some(0), 102, None).late);
        record.after = (0, 0);
        assert_eq!(Seen::of(&record, None, 0, None).lost, 0);
    }

    #[test]
    fn what_is_not_finite_is_no_value_and_the_mean_stays_within() {
        let mut spread = Spread::default();
        assert_eq!((spread.mean(), spread.least(), spread.greatest()), (None, None, None));
        spread.take(f64::NAN);
        spread.take(f64::INFINITY);
        assert_eq!(spread, Spread::default());
        spread.take(1.7e308);
        spread.take(1.7e308);
        assert_eq!(spread.mean(), Some(1.7e308), "a sum that is too great");
    }

    proptest! {
        /// However cycles are cut into pieces and joined again, counts, least and greatest are equal, and the mean is.
        #[test]
        fn joined_pieces_say_what_their_cycles_say(
            rows in prop::collection::vec((-1e6..1e6_f64, -1e3..1e3_f64, any::<[bool; 4]>(), 0_u64..3), 1..200),
            cuts in prop::collection::vec(0_usize..200, 0..12),
        ) {
            let outputs: Vec<[f64; 2]> = rows.iter().map(|row| [row.1, -row.0]).collect();
            let cycle = |i: usize| Seen {
                at_ns: i as u64,
                setpoint: rows[i].1,
                measurement: rows[i].2[0].then_some(rows[i].0),
                bad: rows[i].2[1],
                outputs: &outputs[i],
                lost: rows[i].3,
                late: rows[i].2[2],
                manual: rows[i].2[3],
                mode_changed: rows[i].2[1] != rows[i].2[2],
                step_ns: Some(i as u64 * 7),
            };
            let mut whole = Bucket::at(0);
            let mut pieces = vec![Bucket::at(0)];
            for i in 0..rows.len() {
                whole.take(&cycle(i));
                if cuts.contains(&i) {
                    pieces.push(Bucket::at(i as u64));
                }
                pieces.last_mut().unwrap().take(&cycle(i));
            }
            // In any order, and by twos first: thinning goes step by step.
            let halves: Vec<Bucket> = pieces.chunks(2).map(|pair| {
                let mut joined = pair[0].clone();
                pair[1..].iter().for_each(|other| joined.merge(other));
                joined
            }).collect();
            let mut joined = Bucket::at(0);
            halves.iter().rev().for_each(|other| joined.merge(other));
            let counts = |b: &Bucket| (b.cycles, b.lost, b.late, b.bad, b.manual, b.mode_changes);
            prop_assert_eq!(counts(&joined), counts(&whole));
            let measured: Vec<f64> = (0..rows.len()).filter_map(|i| cycle(i).measurement).collect();
            prop_assert_eq!(joined.measurement.count, measured.len() as u64);
            prop_assert_eq!(joined.measurement.least(), measured.iter().copied().reduce(f64::min));
            prop_assert_eq!(joined.measurement.greatest(), measured.iter().copied().reduce(f64::max));
            let spreads = |b: &Bucket| [&[b.setpoint, b.measurement, b.step_ns][..], &b.outputs].concat();
            for (a, b) in spreads(&joined).iter().zip(&spreads(&whole)) {
                prop_assert_eq!((a.min, a.max, a.count), (b.min, b.max, b.count));
                if let (Some(a), Some(b)) = (a.mean(), b.mean()) {
                    prop_assert!((a - b).abs() <= 1e-9 * (1.0 + b.abs()), "{} {}", a, b);
                }
            }
            if !measured.is_empty() {
                let mean = measured.iter().sum::<f64>() / measured.len() as f64;
                prop_assert!((joined.measurement.mean().unwrap() - mean).abs() < 1e-6);
            }
        }
    }
}
