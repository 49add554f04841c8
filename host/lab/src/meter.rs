//! What is measured in a run: indices, step responses, travel, delays, and the curves.
//!
//! Owns the figures' names and units ([`FIGURES`]). Never: a figure that a run did not earn: what cannot be told is left out.

use std::collections::BTreeMap;

use bumpless_core::indices::{Indices, Rule, StepResponse, TotalVariation};
use serde::{Deserialize, Serialize};

use crate::{
    experiment::{MeasurePlan, RuleWord, SetpointMove},
    limits::TRACE_ROWS_MAX,
};

/// One figure: key, name, unit, and what it says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Figure {
    /// Key in files.
    pub key: &'static str,
    /// Name in tables.
    pub name: &'static str,
    /// Unit, with `u` for the measurement's and `o` for the output's.
    pub unit: &'static str,
    /// One line for people.
    pub text: &'static str,
}

const fn figure(key: &'static str, name: &'static str, unit: &'static str, text: &'static str) -> Figure {
    Figure { key, name, unit, text }
}

/// Every figure, in the order of tables.
pub const FIGURES: [Figure; 28] = [
    figure("iae", "IAE", "u s", "integral of the absolute error"),
    figure("ise", "ISE", "u² s", "integral of the squared error"),
    figure("itae", "ITAE", "u s²", "integral of time times absolute error"),
    figure("itse", "ITSE", "u² s²", "integral of time times squared error"),
    figure("ie", "IE", "u s", "integral of the error with its sign"),
    figure("id", "Id", "%", "IAE over the integral of the setpoint"),
    figure("mae", "mean |e|", "u", "mean absolute error"),
    figure("peak", "peak |e|", "u", "greatest absolute error"),
    figure(
        "overshoot",
        "overshoot",
        "%",
        "farthest way beyond the setpoint, in % of its step; the worst step",
    ),
    figure(
        "rise",
        "rise time",
        "s",
        "from 10 % to 90 % of a step of the setpoint; mean of the steps",
    ),
    figure(
        "settling",
        "settling time",
        "s",
        "until the band is not left again; mean of the steps that settled",
    ),
    figure(
        "unsettled",
        "not settled",
        "",
        "steps of the setpoint that did not settle before the next",
    ),
    figure("tv", "TV", "o", "how far the output travelled"),
    figure(
        "effort",
        "effort",
        "o² s",
        "integral of the squared output's distance from its start",
    ),
    figure(
        "ms",
        "Ms",
        "",
        "greatest sensitivity, where process and law are linear and known; 1.2 to 2 is usual",
    ),
    figure(
        "delay",
        "Td",
        "ms",
        "from the reading of the device to the actuator, mean",
    ),
    figure("jitter", "jitter", "ms", "standard deviation of Td"),
    figure("worst", "worst Td", "ms", "longest Td"),
    figure(
        "gap",
        "control gap",
        "ms",
        "longest time between two writes that reached the actuator",
    ),
    figure(
        "messages-lost",
        "messages lost",
        "",
        "readings and writes that did not arrive",
    ),
    figure("cycles", "cycles", "", "cycles whose commit was taken"),
    figure("cycles-lost", "cycles lost", "", "cycles without a commit"),
    figure(
        "takeovers",
        "takeovers",
        "",
        "changes of ownership after a silence or a death",
    ),
    figure(
        "hedged",
        "hedged",
        "",
        "replicas that were silent, so that the next one was asked",
    ),
    figure("faults", "faults", "", "cycles without a good step"),
    figure("dissents", "dissents", "", "answers against the majority of a vote"),
    figure(
        "bump",
        "bump",
        "%",
        "step of the output at a swap beyond what the old controller did, in % of span; the worst",
    ),
    figure("limited", "at a limit", "", "cycles in which the output met a limit"),
];

/// The figures of one loop in one run, by key.
pub type Figures = BTreeMap<String, f64>;

/// One row of the curves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Virtual time, in s.
    pub t_s: f64,
    /// Wanted value.
    pub setpoint: f64,
    /// What the plant does.
    pub truth: f64,
    /// What the controller was told.
    pub measured: f64,
    /// What the actuator holds.
    pub output: f64,
    /// Number of the host that stepped last; 0 is the home.
    pub by: u8,
}

/// Curves of bounded length: where they are full, every second row goes, and from then on only every second is taken.
#[derive(Debug, Clone)]
struct Trace {
    rows: Vec<Row>,
    every: u64,
    seen: u64,
}

impl Trace {
    fn push(&mut self, row: Row) {
        if self.seen.is_multiple_of(self.every) {
            if self.rows.len() >= TRACE_ROWS_MAX {
                let mut n = 0_u64;
                self.rows.retain(|_| {
                    n += 1;
                    n % 2 == 1
                });
                self.every *= 2;
            }
            if self.seen.is_multiple_of(self.every) {
                self.rows.push(row);
            }
        }
        self.seen += 1;
    }
}

/// Mean, spread and greatest of a stream (Welford 1962).
#[derive(Debug, Clone, Copy, Default)]
struct Spread {
    n: u64,
    mean: f64,
    squares: f64,
    most: f64,
}

impl Spread {
    fn add(&mut self, x: f64) {
        self.n += 1;
        let d = x - self.mean;
        self.mean += d / self.n as f64;
        self.squares += d * (x - self.mean);
        self.most = self.most.max(x);
    }
}

/// One step of the setpoint on its way.
#[derive(Debug, Clone)]
struct Step {
    response: StepResponse,
    at_s: f64,
    from: f64,
    to: f64,
    tenth_s: Option<f64>,
    ninety_s: Option<f64>,
}

/// Meters of one loop.
#[derive(Debug, Clone)]
pub(crate) struct Meter {
    plan: MeasurePlan,
    indices: Indices,
    peak: f64,
    tv: TotalVariation,
    effort: f64,
    output: Option<(f64, f64, f64)>,
    delays: Spread,
    gap: Spread,
    last_write_s: Option<f64>,
    step: Option<Step>,
    overshoot: Option<f64>,
    rises: Spread,
    settlings: Spread,
    steps: u64,
    last: Option<(f64, f64)>,
    trace: Option<Trace>,
    pub(crate) hedged: u64,
    pub(crate) faults: u64,
    pub(crate) dissents: u64,
    pub(crate) limited: u64,
    pub(crate) bump_percent: Option<f64>,
}

/// The setpoint at a time.
pub(crate) fn setpoint_at(moves: &[SetpointMove], t_s: f64) -> f64 {
    let mut value = moves.first().map_or(0.0, |m| m.to);
    for m in moves.iter().skip(1).take_while(|m| m.at_s <= t_s) {
        let part = if m.over_s > 0.0 {
            ((t_s - m.at_s) / m.over_s).min(1.0)
        } else {
            1.0
        };
        value += (m.to - value) * part;
    }
    value
}

impl Meter {
    /// `traced`: are the curves kept?
    pub(crate) fn new(plan: &MeasurePlan, traced: bool) -> Self {
        Self {
            indices: Indices::new(match plan.rule {
                RuleWord::Rectangle => Rule::Rectangle,
                RuleWord::Trapezoid => Rule::Trapezoid,
            }),
            plan: plan.clone(),
            peak: 0.0,
            tv: TotalVariation::default(),
            effort: 0.0,
            output: None,
            delays: Spread::default(),
            gap: Spread::default(),
            last_write_s: None,
            step: None,
            overshoot: None,
            rises: Spread::default(),
            settlings: Spread::default(),
            steps: 0,
            last: None,
            trace: traced.then(|| Trace {
                rows: Vec::new(),
                every: 1,
                seen: 0,
            }),
            hedged: 0,
            faults: 0,
            dissents: 0,
            limited: 0,
            bump_percent: None,
        }
    }

    fn counts(&self, t_s: f64) -> bool {
        t_s >= self.plan.from_s && self.plan.to_s.is_none_or(|to| t_s <= to)
    }

    /// One look at the loop. `value` is what the indices are made of. Times only grow.
    pub(crate) fn look(&mut self, row: Row, value: f64) {
        let (t_s, setpoint) = (row.t_s, row.setpoint);
        if self.counts(t_s) && value.is_finite() {
            if let Some((_, before)) = self.last.filter(|(_, before)| *before != setpoint) {
                // A step is two samples at one time; whatever is refused here is no number and was filtered.
                let _ = self.indices.add(t_s, before, value);
                self.end_step(t_s);
                self.step = StepResponse::new(t_s, before, setpoint, self.plan.band_percent).map(|response| Step {
                    response,
                    at_s: t_s,
                    from: before,
                    to: setpoint,
                    tenth_s: None,
                    ninety_s: None,
                });
            }
            let _ = self.indices.add(t_s, setpoint, value);
            self.peak = self.peak.max((setpoint - value).abs());
            if let Some(step) = &mut self.step {
                let _ = step.response.add(t_s, value);
                let part = (value - step.from) / (step.to - step.from);
                if part >= 0.1 {
                    step.tenth_s.get_or_insert(t_s);
                }
                if part >= 0.9 {
                    step.ninety_s.get_or_insert(t_s);
                }
            }
        }
        self.last = Some((t_s, setpoint));
        if let Some(trace) = &mut self.trace {
            trace.push(row);
        }
    }

    fn end_step(&mut self, now_s: f64) {
        let Some(step) = self.step.take() else { return };
        // A ramp is many small steps; none of them is a step response.
        if now_s - step.at_s <= 0.0 {
            return;
        }
        self.steps += 1;
        let over = step.response.overshoot_percent();
        self.overshoot = Some(self.overshoot.map_or(over, |worst| worst.max(over)));
        if let (Some(tenth), Some(ninety)) = (step.tenth_s, step.ninety_s) {
            self.rises.add(ninety - tenth);
        }
        if let Some(settling) = step.response.settling_time_s() {
            self.settlings.add(settling);
        }
    }

    /// A write reached the actuator. `read_s` is when the device was read for it, where a reading stood behind it.
    pub(crate) fn wrote(&mut self, t_s: f64, value: f64, read_s: Option<f64>) {
        let start = self.output.map_or(value, |(.., start)| start);
        if let Some((at_s, held, start)) = self.output {
            let from = at_s.max(self.plan.from_s);
            let to = self.plan.to_s.map_or(t_s, |to| to.min(t_s));
            self.effort += (held - start).powi(2) * (to - from).max(0.0);
        }
        self.output = Some((t_s, value, start));
        if t_s < self.plan.from_s {
            // The travel within the window begins where the output stands at its start.
            self.tv = TotalVariation::default();
            self.tv.add(value);
        }
        if self.counts(t_s) {
            self.tv.add(value);
            if let Some(read_s) = read_s {
                self.delays.add((t_s - read_s) * 1e3);
            }
            if let Some(last_s) = self.last_write_s.replace(t_s) {
                self.gap.add((t_s - last_s) * 1e3);
            }
        }
    }

    /// The figures at the end, and the curves.
    pub(crate) fn finish(mut self, end_s: f64) -> (Figures, Option<Vec<Row>>) {
        if let Some((_, held, _)) = self.output {
            // Closes the last stretch of the effort.
            let write = self.last_write_s;
            self.wrote(end_s, held, None);
            self.last_write_s = write;
        }
        let end_s = self.plan.to_s.map_or(end_s, |to| to.min(end_s));
        self.end_step(end_s);
        let mut figures = Figures::new();
        let mut put = |key: &str, value: Option<f64>| {
            if let Some(value) = value.filter(|v| v.is_finite()) {
                figures.insert(key.to_owned(), value);
            }
        };
        let i = &self.indices;
        put("iae", Some(i.iae()));
        put("ise", Some(i.ise()));
        put("itae", Some(i.itae()));
        put("itse", Some(i.itse()));
        put("ie", Some(i.ie()));
        put("id", i.id_percent());
        put("mae", i.mean_absolute_error());
        put("peak", Some(self.peak));
        put("overshoot", self.overshoot);
        put("rise", (self.rises.n > 0).then_some(self.rises.mean));
        put("settling", (self.settlings.n > 0).then_some(self.settlings.mean));
        put(
            "unsettled",
            (self.steps > 0).then_some((self.steps - self.settlings.n) as f64),
        );
        put("tv", Some(self.tv.value()));
        put("effort", Some(self.effort));
        if self.delays.n > 0 {
            put("delay", Some(self.delays.mean));
            put("jitter", Some((self.delays.squares / self.delays.n as f64).sqrt()));
            put("worst", Some(self.delays.most));
        }
        put("gap", (self.gap.n > 0).then_some(self.gap.most));
        put("hedged", Some(self.hedged as f64));
        put("faults", Some(self.faults as f64));
        put("dissents", (self.dissents > 0).then_some(self.dissents as f64));
        put("limited", Some(self.limited as f64));
        put("bump", self.bump_percent);
        (figures, self.trace.map(|t| t.rows))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(t_s: f64, setpoint: f64) -> Row {
        Row {
            t_s,
            setpoint,
            truth: 0.0,
            measured: 0.0,
            output: 0.0,
            by: 0,
        }
    }

    #[test]
    fn a_profile_steps_and_ramps() {
        let to = |at_s, to, over_s| SetpointMove { at_s, to, over_s };
        let moves = [to(0.0, 1.0, 0.0), to(10.0, 3.0, 0.0), to(20.0, 5.0, 10.0)];
        for (t, expected) in [
            (0.0, 1.0),
            (9.9, 1.0),
            (10.0, 3.0),
            (20.0, 3.0),
            (25.0, 4.0),
            (40.0, 5.0),
        ] {
            assert!((setpoint_at(&moves, t) - expected).abs() < 1e-12, "{t}");
        }
    }

    #[test]
    fn a_step_gives_its_figures() {
        let mut meter = Meter::new(&MeasurePlan::default(), true);
        for n in 0..=100_u32 {
            let t = f64::from(n) * 0.1;
            let setpoint = if t >= 1.0 { 2.0 } else { 0.0 };
            let value = if t < 1.0 { 0.0 } else { 2.0 * (1.0 - (-(t - 1.0)).exp()) };
            meter.look(row(t, setpoint), value);
            meter.wrote(t, if n < 10 { 0.0 } else { 3.0 }, Some(t - 0.01));
        }
        let (f, rows) = meter.finish(10.0);
        let near = |key: &str, expected: f64, by: f64| {
            let got = f.get(key).copied().unwrap_or(f64::NAN);
            assert!((got - expected).abs() < by, "{key} = {got}, not {expected}");
        };
        near("iae", 2.0, 0.15);
        near("rise", 9.0_f64.ln(), 0.15);
        near("settling", 3.0, 0.15);
        near("overshoot", 0.0, 1e-9);
        near("unsettled", 0.0, 1e-9);
        near("tv", 3.0, 1e-9);
        near("effort", 81.0, 1e-6);
        near("delay", 10.0, 1e-6);
        near("gap", 100.0, 1e-6);
        assert_eq!(rows.map(|r| r.len()), Some(101));
        assert!(f.keys().all(|key| FIGURES.iter().any(|figure| figure.key == key)));
    }

    #[test]
    fn only_the_window_counts() {
        let plan = MeasurePlan {
            from_s: 5.0,
            to_s: Some(8.0),
            ..MeasurePlan::default()
        };
        let mut meter = Meter::new(&plan, false);
        for n in 0..=10_u32 {
            meter.look(row(f64::from(n), 1.0), 0.0);
        }
        let (f, rows) = meter.finish(10.0);
        assert_eq!((f.get("iae"), rows), (Some(&3.0), None));
    }

    #[test]
    fn curves_are_bounded() {
        let mut meter = Meter::new(&MeasurePlan::default(), true);
        for n in 0..100_000_u32 {
            meter.look(row(f64::from(n), 1.0), 0.0);
        }
        let rows = meter.finish(1e5).1.unwrap_or_default();
        assert!(
            rows.len() > TRACE_ROWS_MAX / 2 && rows.len() <= TRACE_ROWS_MAX,
            "{}",
            rows.len()
        );
        assert!(rows.windows(2).all(|w| w[1].t_s - w[0].t_s == rows[1].t_s));
    }
}
