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

/// A law of an experiment: a case with the points of those sweeps that set its controller, in all circumstances.
#[derive(Debug, Clone, PartialEq)]
pub struct Contender<'a> {
    /// Its results, one per point of the sweeps that set no controller.
    pub results: Vec<&'a VariantResult>,
    /// Mean of the figure over them, each with the same weight.
    pub score: f64,
}

impl Contender<'_> {
    /// The case with the law's own sweep points, for people.
    #[must_use]
    pub fn title(&self) -> String {
        self.results.first().map_or_else(String::new, |v| {
            let own = v.at.iter().filter(|s| s.of_law);
            let own: Vec<String> = own.map(|s| format!("{} = {}", s.title, s.label)).collect();
            if own.is_empty() {
                v.case.clone()
            } else {
                format!("{}, {}", v.case, own.join(", "))
            }
        })
    }
}

impl Outcome {
    /// The law with the least mean of a figure of the first loop. Each law counts with all circumstances that the sweeps put
    /// it in, so that none wins by the easiest of them; one with a run that failed, or without the figure somewhere, counts
    /// not at all. With a `case` only that one's laws count. None where nothing is left.
    #[must_use]
    pub fn winner(&self, key: &str, case: Option<&str>) -> Option<Contender<'_>> {
        let same_law = |a: &VariantResult, b: &VariantResult| {
            let own = |v: &VariantResult| v.at.iter().filter(|s| s.of_law).cloned().collect::<Vec<_>>();
            a.case == b.case && own(a) == own(b)
        };
        let mut laws: Vec<Vec<&VariantResult>> = Vec::new();
        for v in self.variants.iter().filter(|v| case.is_none_or(|case| v.case == case)) {
            match laws.iter_mut().find(|law| law.iter().any(|other| same_law(other, v))) {
                Some(law) => law.push(v),
                None => laws.push(vec![v]),
            }
        }
        let scored = laws.into_iter().filter_map(|results| {
            let means = results.iter().map(|v| {
                let ended = v.runs.iter().all(|r| r.failed.is_none());
                v.summary(0, key).filter(|_| ended).map(|s| s.mean)
            });
            let means = means.collect::<Option<Vec<f64>>>()?;
            let score = means.iter().sum::<f64>() / means.len() as f64;
            Some(Contender { results, score })
        });
        scored.min_by(|a, b| a.score.total_cmp(&b.score))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    fn variant(case: &str, at: &[(&str, &str, bool)], iae: &[Option<f64>]) -> VariantResult {
        let settings = at.iter().map(|(title, label, of_law)| Setting {
            title: (*title).to_owned(),
            label: (*label).to_owned(),
            number: None,
            of_law: *of_law,
        });
        let runs = (1..).zip(iae).map(|(seed, iae)| RunResult {
            seed,
            loops: vec![LoopResult {
                name: "l".to_owned(),
                figures: iae.iter().map(|iae| ("iae".to_owned(), *iae)).collect(),
                trace: Vec::new(),
            }],
            notes: Vec::new(),
            notes_dropped: 0,
            hosts: Vec::new(),
            failed: iae.is_none().then(|| "it stopped".to_owned()),
        });
        VariantResult {
            case: case.to_owned(),
            at: settings.collect(),
            component: case.to_owned(),
            runs: runs.collect(),
        }
    }

    fn outcome(variants: Vec<VariantResult>) -> Outcome {
        Outcome {
            name: "t".to_owned(),
            text: String::new(),
            loops: vec!["l".to_owned()],
            units: Vec::new(),
            variants,
            duration_s: 1.0,
        }
    }

    #[test]
    fn the_best_law_wins_and_not_the_easiest_point() {
        let (none, much) = (("loss", "none", false), ("loss", "half", false));
        let both = outcome(vec![
            variant("pid", &[none], &[Some(1.0), Some(1.2)]),
            variant("pidplus", &[none], &[Some(1.5), Some(1.5)]),
            variant("pid", &[much], &[Some(9.0), Some(11.0)]),
            variant("pidplus", &[much], &[Some(2.0), Some(2.0)]),
        ]);
        let winner = both.winner("iae", None).unwrap();
        assert_eq!((winner.title().as_str(), winner.results.len()), ("pidplus", 2));
        assert!((winner.score - 1.75).abs() < 1e-12);
        assert_eq!(both.winner("iae", Some("pid")).unwrap().title(), "pid");
        assert_eq!(both.winner("iae", Some("nobody")), None);
        assert_eq!(both.winner("settling", None), None);
    }

    #[test]
    fn a_sweep_over_a_parameter_makes_laws_of_its_own_and_a_failed_run_counts_a_law_out() {
        let ti = |label| ("controller.parameters.ti", label, true);
        let (none, much) = (("loss", "none", false), ("loss", "half", false));
        let tuned = outcome(vec![
            variant("pid", &[ti("1"), none], &[Some(1.0)]),
            variant("pid", &[ti("1"), much], &[Some(8.0)]),
            variant("pid", &[ti("2"), none], &[Some(2.0)]),
            variant("pid", &[ti("2"), much], &[Some(3.0)]),
            variant("pid", &[ti("3"), none], &[Some(0.1)]),
            variant("pid", &[ti("3"), much], &[None]),
        ]);
        let winner = tuned.winner("iae", None).unwrap();
        assert_eq!(winner.title(), "pid, controller.parameters.ti = 2");
    }

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
