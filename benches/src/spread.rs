//! How measured times spread: a histogram of nanoseconds, told in microseconds.

use hdrhistogram::Histogram;

use crate::report::Report;

/// Longest time that is told apart, in ns; longer ones count as this.
const LONGEST_NS: u64 = 100_000_000_000;

/// Times, in ns, to three digits.
#[derive(Debug, Clone)]
pub(crate) struct Spread(Histogram<u64>);

impl Default for Spread {
    fn default() -> Self {
        Self::new()
    }
}

impl Spread {
    /// Nothing measured yet.
    pub(crate) fn new() -> Self {
        let histogram = Histogram::new_with_bounds(1, LONGEST_NS, 3);
        #[allow(
            clippy::expect_used,
            reason = "constants, checked by a test: 2 · low <= high, 0 to 5 digits"
        )]
        Self(histogram.expect("bounds that make sense"))
    }

    /// Takes a time.
    pub(crate) fn add(&mut self, ns: u64) {
        self.0.saturating_record(ns.max(1));
    }

    /// Takes the times of another.
    pub(crate) fn join(&mut self, other: &Self) {
        // Of the same bounds and digits, so nothing can be out of range.
        let _ = self.0.add(&other.0);
    }

    /// How many times were taken.
    pub(crate) fn count(&self) -> u64 {
        self.0.len()
    }

    /// The time that this part of all times does not exceed, in µs.
    pub(crate) fn us(&self, part: f64) -> f64 {
        self.0.value_at_quantile(part) as f64 / 1000.0
    }

    /// The longest, in µs.
    pub(crate) fn max_us(&self) -> f64 {
        self.0.max() as f64 / 1000.0
    }

    /// Tells p50, p99, p99.9 and the longest as figures under `name`.
    pub(crate) fn tell(&self, report: &mut Report, name: &str) {
        for (part, text) in [(0.5, "p50"), (0.99, "p99"), (0.999, "p99_9")] {
            report.told(&format!("{name}.{text}"), self.us(part), "µs");
        }
        report.told(&format!("{name}.max"), self.max_us(), "µs");
    }
}

/// The median of some figures; NaN of none.
pub(crate) fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_told_in_microseconds() {
        let mut spread = Spread::new();
        for us in 1..=1000 {
            spread.add(us * 1000);
        }
        spread.add(u64::MAX);
        assert_eq!(spread.count(), 1001);
        assert!((spread.us(0.5) - 501.0).abs() < 1.0);
        assert!(
            (spread.max_us() - 1e8).abs() < 1e5,
            "longer than the longest counts as the longest"
        );
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert!(median(&[]).is_nan());
    }
}
