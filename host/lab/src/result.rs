//! What came out of runs: per run, and over seeds.
//!
//! Owns: mean and confidence interval, and what is kept between two runs of the lab. Never: a time of day; the same
//! experiment gives the same bytes.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{
    meter::{FIGURES, Figures, Row},
    variant::Setting,
};

/// Something that happened in a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Note {
    /// Virtual time, in s.
    pub at_s: f64,
    /// In words.
    pub text: String,
}

/// One loop in one run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LoopResult {
    /// The loop.
    pub name: String,
    /// Its figures by key; see [`FIGURES`].
    pub figures: Figures,
    /// Its curves; empty where they were not kept.
    pub trace: Vec<Row>,
}

/// One run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunResult {
    /// The seed.
    pub seed: u64,
    /// The loops, in the experiment's order.
    pub loops: Vec<LoopResult>,
    /// What happened.
    pub notes: Vec<Note>,
    /// Notes beyond the limit.
    pub notes_dropped: u64,
    /// Hosts by number, as the curves name them.
    pub hosts: Vec<String>,
    /// Why the run did not reach its end; its figures are then of no use.
    pub failed: Option<String>,
}

/// A figure over all seeds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Runs that have the figure.
    pub n: usize,
    /// Mean.
    pub mean: f64,
    /// Half of the 95 % confidence interval of the mean (Student's t); none with one run.
    pub half_95: Option<f64>,
    /// Least.
    pub least: f64,
    /// Greatest.
    pub most: f64,
    /// Quartiles: lower, median, upper.
    pub quartiles: [f64; 3],
}

/// All runs of one case at one point of the sweeps.
#[derive(Debug, Clone, PartialEq)]
pub struct VariantResult {
    /// The case.
    pub case: String,
    /// Where in the sweeps.
    pub at: Vec<Setting>,
    /// The controller of the first loop.
    pub component: String,
    /// One run per seed.
    pub runs: Vec<RunResult>,
}

/// All of an experiment.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Name of the experiment.
    pub name: String,
    /// What it is about.
    pub text: String,
    /// Names of the loops.
    pub loops: Vec<String>,
    /// Units of measurement and output of each loop.
    pub units: Vec<(String, String)>,
    /// Cases within sweep points.
    pub variants: Vec<VariantResult>,
    /// Virtual time of one run, in s.
    pub duration_s: f64,
}

/// Two-sided 95 % quantiles of Student's t by degrees of freedom 1 to 30 (any statistics table).
const T_95: [f64; 30] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120,
    2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
];

/// The quantile for so many degrees of freedom; beyond the table by 1.96 + 2.4/ν, right to three digits.
fn t_95(freedom: usize) -> f64 {
    freedom
        .checked_sub(1)
        .and_then(|i| T_95.get(i).copied())
        .unwrap_or(1.96 + 2.4 / freedom.max(1) as f64)
}

impl Summary {
    /// Of some values; none of none.
    #[must_use]
    pub fn of(values: &[f64]) -> Option<Self> {
        let mut sorted: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len();
        let (least, most) = (*sorted.first()?, *sorted.last()?);
        let mean = sorted.iter().sum::<f64>() / n as f64;
        let half_95 = (n > 1).then(|| {
            let variance = sorted.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1) as f64;
            t_95(n - 1) * (variance / n as f64).sqrt()
        });
        // Quantiles by linear interpolation between order statistics (Hyndman and Fan 1996, type 7).
        let quantile = |part: f64| {
            let place = part * (n - 1) as f64;
            let low = sorted.get(place.floor() as usize).copied().unwrap_or(most);
            let high = sorted.get(place.ceil() as usize).copied().unwrap_or(most);
            low + (high - low) * place.fract()
        };
        Some(Self {
            n,
            mean,
            half_95,
            least,
            most,
            quartiles: [quantile(0.25), quantile(0.5), quantile(0.75)],
        })
    }
}

impl VariantResult {
    /// Case and sweep point, for people.
    #[must_use]
    pub fn title(&self) -> String {
        let at: Vec<String> = self.at.iter().map(|s| format!("{} = {}", s.title, s.label)).collect();
        if at.is_empty() {
            self.case.clone()
        } else {
            format!("{}, {}", self.case, at.join(", "))
        }
    }

    /// The values of one figure of one loop, one per run that reached its end and has it.
    #[must_use]
    pub fn values(&self, loop_number: usize, key: &str) -> Vec<f64> {
        self.runs
            .iter()
            .filter(|run| run.failed.is_none())
            .filter_map(|run| run.loops.get(loop_number)?.figures.get(key).copied())
            .collect()
    }

    /// One figure of one loop over the seeds.
    #[must_use]
    pub fn summary(&self, loop_number: usize, key: &str) -> Option<Summary> {
        Summary::of(&self.values(loop_number, key))
    }

    /// The figures of one loop, in the order of [`FIGURES`], by key.
    #[must_use]
    pub fn summaries(&self, loop_number: usize) -> BTreeMap<&'static str, Summary> {
        FIGURES
            .iter()
            .filter_map(|f| Some((f.key, self.summary(loop_number, f.key)?)))
            .collect()
    }
}

impl Outcome {
    /// The case with the least mean of a figure of the first loop, over all points of the sweeps; none where no run ended.
    #[must_use]
    pub fn winner(&self, key: &str) -> Option<&VariantResult> {
        let score = |v: &&VariantResult| v.summary(0, key).map(|s| s.mean);
        self.variants
            .iter()
            .filter(|v| v.runs.iter().all(|r| r.failed.is_none()))
            .filter(|v| score(v).is_some())
            .min_by(|a, b| score(a).unwrap_or(f64::MAX).total_cmp(&score(b).unwrap_or(f64::MAX)))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn a_summary_is_what_statistics_say() {
        let s = Summary::of(&[4.0, 1.0, 3.0, 2.0, 5.0]).unwrap();
        assert_eq!((s.n, s.mean, s.least, s.most), (5, 3.0, 1.0, 5.0));
        assert_eq!(s.quartiles, [2.0, 3.0, 4.0]);
        // t(4) = 2.776, deviation √2.5, √5 runs.
        assert!((s.half_95.unwrap() - 2.776 * (2.5_f64 / 5.0).sqrt()).abs() < 1e-12);
        assert_eq!(Summary::of(&[7.0]).unwrap().half_95, None);
        assert_eq!(Summary::of(&[f64::NAN]), None);
        assert!((t_95(60) - 2.000).abs() < 0.002 && (t_95(120) - 1.980).abs() < 0.001);
    }
}
