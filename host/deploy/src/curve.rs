//! Curves of any length in a bounded number of points, made as the cycles come.
//!
//! ```text
//! one cycle a point ── more than POINTS_MAX ──► pairs are merged: two cycles a point ──► four ──► …
//! ```
//! Of the cycles that a point stands for, it shows the one in which the outputs differ most: a mean would hide what matters.
//! Never: keeps more than [`POINTS_MAX`] points.

use crate::report::{CurvePoint, POINTS_MAX};

/// Points at which pairs are merged: even, and with room for the one that is being gathered.
const FULL: usize = POINTS_MAX - 2;

/// The curves so far.
#[derive(Debug)]
pub(crate) struct Curve {
    per_point: u64,
    points: Vec<(CurvePoint, f64)>,
    gathered: Option<(CurvePoint, f64)>,
    /// Cycles in `gathered`.
    count: u64,
}

impl Default for Curve {
    fn default() -> Self {
        Self {
            per_point: 1,
            points: Vec::new(),
            gathered: None,
            count: 0,
        }
    }
}

impl Curve {
    /// Takes a cycle. `weight` says how much it matters to be seen; NaN counts as nothing.
    pub(crate) fn add(&mut self, point: CurvePoint, weight: f64) {
        if self.gathered.as_ref().is_none_or(|(_, most)| weight > *most) {
            self.gathered = Some((point, weight));
        }
        self.count += 1;
        if self.count < self.per_point {
            return;
        }
        self.count = 0;
        if self.points.len() == FULL {
            self.halve();
            // The point in hand is half of one now.
            self.count = self.per_point / 2;
            return;
        }
        self.points.extend(self.gathered.take());
    }

    fn halve(&mut self) {
        self.per_point *= 2;
        let mut kept = Vec::with_capacity(POINTS_MAX);
        let mut all = std::mem::take(&mut self.points).into_iter();
        while let Some(a) = all.next() {
            kept.push(match all.next() {
                Some(b) if b.1 > a.1 => b,
                _ => a,
            });
        }
        self.points = kept;
    }

    /// Cycles that a point stands for.
    pub(crate) const fn cycles_per_point(&self) -> u64 {
        self.per_point
    }

    /// The points, oldest first, with the one that is being gathered.
    pub(crate) fn points(&self) -> Vec<CurvePoint> {
        self.points
            .iter()
            .chain(&self.gathered)
            .map(|(point, _)| point.clone())
            .collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn point(at_ns: u64) -> CurvePoint {
        CurvePoint {
            at_ns,
            setpoint: 0.0,
            measurement: 0.0,
            recorded: vec![],
            candidate: vec![],
        }
    }

    #[test]
    fn few_cycles_are_all_there() {
        let mut curve = Curve::default();
        (0..FULL as u64).for_each(|at| curve.add(point(at), 0.0));
        let times: Vec<u64> = curve.points().iter().map(|p| p.at_ns).collect();
        assert_eq!(times, (0..FULL as u64).collect::<Vec<_>>());
        assert_eq!(curve.cycles_per_point(), 1);
    }

    #[test]
    fn many_cycles_fit_and_the_peak_is_seen() {
        for total in [2_001_u64, 4_000, 10_007, 123_456] {
            for peak in [0, 1, total / 3, total - 2, total - 1] {
                let mut curve = Curve::default();
                for at in 0..total {
                    curve.add(point(at), if at == peak { 5.0 } else { 1.0 });
                }
                let points = curve.points();
                assert!(
                    points.len() <= POINTS_MAX && points.len() >= FULL / 2,
                    "{}",
                    points.len()
                );
                assert!(points.windows(2).all(|pair| pair[0].at_ns < pair[1].at_ns), "in order");
                assert!(points.iter().any(|p| p.at_ns == peak), "{peak} of {total}");
                assert!(curve.cycles_per_point() * POINTS_MAX as u64 >= total);
            }
        }
    }
}
