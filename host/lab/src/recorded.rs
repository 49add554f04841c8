//! A window of a live loop as a plant: what was measured comes again, whatever the outputs are now.
//!
//! So several controllers meet the same afternoon. Like a backtest, it shows what each would have sent, not where that would
//! have led; for that, fit a model to the window ([`Window::fit`]) and close the loop around it.
//!
//! Never: asks a cell; the file holds what `GET /v1/loops/{l}/cycles` gave.

use std::{collections::BTreeMap, fs, path::Path};

use bumpless_io::sim::{Halted, Model, Signal, SignalRole};
use serde::{Deserialize, Serialize};

use crate::{error::Error, limits::RECORDED_BYTES_MAX};

/// The file's form: as much of the API's answer as is needed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct File {
    records: Vec<Row>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Row {
    at_unix_us: u64,
    setpoint: Option<f64>,
    measurement: Option<f64>,
    #[serde(default)]
    readings: Vec<Seen>,
    #[serde(default)]
    outputs: BTreeMap<String, Option<f64>>,
}

/// What the step saw of one port.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Seen {
    port: String,
    quality: String,
}

impl Row {
    /// What was measured. Where the reading of `pv` (else of the first port) was bad, the row has the last good value, which
    /// is none of that moment.
    fn measured(&self) -> Option<f64> {
        let seen = self.readings.iter().find(|r| r.port == "pv");
        let seen = seen.or_else(|| self.readings.first());
        self.measurement.filter(|_| seen.is_none_or(|r| r.quality != "bad"))
    }
}

/// One recorded cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// Time since the first, in s.
    pub t_s: f64,
    /// Wanted value.
    pub setpoint: f64,
    /// Measured value; NaN where there was none.
    pub measurement: f64,
    /// The first output; NaN where there was none.
    pub output: f64,
}

/// Recorded cycles, oldest first.
#[derive(Debug, Clone, PartialEq)]
pub struct Window {
    /// The cycles.
    pub moments: Vec<Moment>,
}

/// A first-order process with dead time that was fitted to a window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    /// Measurement per output.
    pub gain: f64,
    /// Time constant, in s.
    pub tau_s: f64,
    /// Dead time, in s.
    pub dead_time_s: f64,
    /// Measurement at rest.
    pub rest: f64,
    /// Part of the measurement's variance that the model explains in a free run, 1 at best.
    pub explained: f64,
}

impl Window {
    /// Reads a file.
    ///
    /// # Errors
    /// [`Error::File`], and [`Error::Experiment`] where it holds no cycles.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let size = fs::metadata(path).map_err(Error::file("reading", path))?.len();
        if size > RECORDED_BYTES_MAX {
            let problem =
                format!("the file has {size} bytes; at most {RECORDED_BYTES_MAX} are read: take a shorter window");
            return Err(Error::at(path.display().to_string(), problem));
        }
        let bytes = fs::read(path).map_err(Error::file("reading", path))?;
        Self::parse(&bytes, &path.display().to_string())
    }

    fn parse(bytes: &[u8], place: &str) -> Result<Self, Error> {
        let file: File = serde_json::from_slice(bytes)
            .map_err(|e| Error::at(place, format!("these are no recorded cycles: {e}")))?;
        let start = file.records.first().map_or(0, |r| r.at_unix_us);
        let mut moments: Vec<Moment> = Vec::with_capacity(file.records.len());
        for row in &file.records {
            let t_s = row.at_unix_us.saturating_sub(start) as f64 * 1e-6;
            if moments.last().is_some_and(|last| last.t_s >= t_s) {
                continue;
            }
            let number = |v: Option<f64>| v.unwrap_or(f64::NAN);
            moments.push(Moment {
                t_s,
                setpoint: number(row.setpoint),
                measurement: number(row.measured()),
                output: number(row.outputs.values().next().copied().flatten()),
            });
        }
        if moments.len() < 2 {
            return Err(Error::at(
                place,
                "at least two recorded cycles are needed; take a longer window",
            ));
        }
        Ok(Self { moments })
    }

    /// Length, in s.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.moments.last().map_or(0.0, |m| m.t_s)
    }

    /// Median time between two cycles, in s.
    #[must_use]
    pub fn period_s(&self) -> f64 {
        let mut steps: Vec<f64> = self.moments.windows(2).map(|w| w[1].t_s - w[0].t_s).collect();
        steps.sort_by(f64::total_cmp);
        steps.get(steps.len() / 2).copied().unwrap_or(1.0)
    }

    /// Fits a first-order process with dead time: least squares of the one-step prediction for each dead time, the best of
    /// them by the error of a free run. None where the window does not move enough to tell.
    #[must_use]
    pub fn fit(&self) -> Option<Fit> {
        let h = self.period_s();
        let grid = Grid::of(&self.moments, h);
        // Dead times up to a quarter of the window, in steps of a cycle, at most 200.
        let most = (grid.slots.len() / 4).min(DEAD_MAX);
        (0..=most)
            .filter_map(|dead| fit_at(&grid, dead, h))
            // Where a longer dead time says no more (an input that repeats itself), the shorter one is meant.
            .reduce(|best, next| {
                if next.explained > best.explained + 1e-6 {
                    next
                } else {
                    best
                }
            })
            .filter(|fit| fit.explained > 0.0)
    }
}

/// Longest dead time that is tried, in cycles.
const DEAD_MAX: usize = 200;
/// A longer gap in the record, in cycles, is a break: what the actuator held meanwhile is not known.
const GAP_MAX: usize = 20;

/// One period of the window: what was measured and what the actuator held, as far as they are known.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Slot {
    measurement: Option<f64>,
    output: Option<f64>,
}

/// The window on an even grid of its period. A cycle that was lost leaves a slot without a measurement; its actuator held on.
#[derive(Debug, Clone, PartialEq)]
struct Grid {
    slots: Vec<Slot>,
}

impl Grid {
    fn of(moments: &[Moment], h: f64) -> Self {
        let number = |v: f64| Some(v).filter(|v| v.is_finite());
        let mut slots: Vec<Slot> = Vec::with_capacity(moments.len());
        let mut last_s: Option<f64> = None;
        for m in moments {
            let steps = last_s.map_or(1, |last_s| ((m.t_s - last_s) / h).round() as usize);
            last_s = Some(m.t_s);
            if steps == 0 {
                // Two cycles within half a period: the later one says what the actuator holds.
                if let Some(slot) = slots.last_mut() {
                    slot.output = number(m.output).or(slot.output);
                    slot.measurement = slot.measurement.or(number(m.measurement));
                }
                continue;
            }
            let held = slots.last().and_then(|slot| slot.output);
            let (missing, between) = if steps <= GAP_MAX {
                (steps - 1, held)
            } else {
                (DEAD_MAX + 1, None)
            };
            slots.extend(std::iter::repeat_n(
                Slot {
                    measurement: None,
                    output: between,
                },
                missing,
            ));
            let held = if steps <= GAP_MAX { held } else { None };
            slots.push(Slot {
                measurement: number(m.measurement),
                output: number(m.output).or(held),
            });
        }
        Self { slots }
    }

    fn measurement(&self, k: usize) -> Option<f64> {
        self.slots.get(k)?.measurement
    }

    fn output(&self, k: usize) -> Option<f64> {
        self.slots.get(k)?.output
    }
}

/// y(k+1) = a·y(k) + b·u(k−dead) + c by least squares over all k where the three are known; 0 < a < 1 is a first-order lag.
fn fit_at(grid: &Grid, dead: usize, h: f64) -> Option<Fit> {
    let mut normal = [[0.0; 4]; 3];
    let last = grid.slots.len().saturating_sub(1);
    for k in dead..last {
        let known = (grid.measurement(k), grid.output(k - dead), grid.measurement(k + 1));
        let (Some(y), Some(u), Some(next)) = known else {
            continue;
        };
        let x = [y, u, 1.0];
        for (row, a) in normal.iter_mut().zip(x) {
            for (cell, b) in row.iter_mut().zip(x.into_iter().chain([next])) {
                *cell += a * b;
            }
        }
    }
    let [a, b, c] = solve(normal)?;
    if !(a > 0.0 && a < 1.0 - 1e-9 && b != 0.0) {
        return None;
    }
    let measured = || grid.slots.iter().filter_map(|s| s.measurement);
    let mean = measured().sum::<f64>() / measured().count() as f64;
    // A free run from the first measurement on; after a break it begins anew.
    let (mut y, mut missed, mut all) = (None, 0.0, 0.0);
    for k in dead..last {
        y = match (y.or(grid.measurement(k)), grid.output(k - dead)) {
            (Some(y), Some(u)) => Some(a * y + b * u + c),
            _ => None,
        };
        if let (Some(y), Some(truth)) = (y, grid.measurement(k + 1)) {
            missed += (truth - y).powi(2);
            all += (truth - mean).powi(2);
        }
    }
    (all > 0.0).then(|| Fit {
        gain: b / (1.0 - a),
        tau_s: -h / a.ln(),
        dead_time_s: dead as f64 * h,
        rest: c / (1.0 - a),
        explained: 1.0 - missed / all,
    })
}

/// Gauss with pivots, three unknowns.
fn solve(mut rows: [[f64; 4]; 3]) -> Option<[f64; 3]> {
    for column in 0..3 {
        let best = (column..3).max_by(|&i, &j| rows[i][column].abs().total_cmp(&rows[j][column].abs()))?;
        rows.swap(column, best);
        let pivot = rows[column];
        if pivot[column].abs() < 1e-12 {
            return None;
        }
        for (i, row) in rows.iter_mut().enumerate() {
            if i != column {
                let factor = row[column] / pivot[column];
                for (cell, p) in row.iter_mut().zip(pivot) {
                    *cell -= factor * p;
                }
            }
        }
    }
    Some([0, 1, 2].map(|i: usize| rows[i][3] / rows[i][i]))
}

/// The window as a model. Signals: `pv`, `out`, `recorded-out`, `recorded-setpoint`.
#[derive(Debug)]
pub(crate) struct RecordedModel {
    signals: Vec<Signal>,
    moments: Vec<Moment>,
    at: usize,
    output: f64,
}

impl RecordedModel {
    pub(crate) fn new(window: &Window) -> Self {
        let signal = |name: &str, role, text: &str| Signal {
            name: name.to_owned(),
            role,
            unit: String::new(),
            low: -1e9,
            high: 1e9,
            digital: false,
            text: text.to_owned(),
        };
        Self {
            signals: vec![
                signal("pv", SignalRole::Measures, "what was measured"),
                signal("out", SignalRole::Sets, "goes nowhere"),
                signal(
                    "recorded-out",
                    SignalRole::Measures,
                    "what the recorded controller sent",
                ),
                signal("recorded-setpoint", SignalRole::Measures, "what was wanted"),
            ],
            output: window.moments.first().map_or(0.0, |m| m.output),
            moments: window.moments.clone(),
            at: 0,
        }
    }
}

impl Model for RecordedModel {
    fn signals(&self) -> &[Signal] {
        &self.signals
    }

    fn advance(&mut self, to_ns: u64) -> Result<(), Halted> {
        // Half a µs of grace: the file's times are whole µs.
        let to_s = to_ns as f64 * 1e-9 + 5e-7;
        while self.moments.get(self.at + 1).is_some_and(|next| next.t_s <= to_s) {
            self.at += 1;
        }
        Ok(())
    }

    fn truth(&self, signal: usize) -> f64 {
        let Some(m) = self.moments.get(self.at) else {
            return f64::NAN;
        };
        match signal {
            0 => m.measurement,
            1 => self.output,
            2 => m.output,
            3 => m.setpoint,
            _ => f64::NAN,
        }
    }

    fn set(&mut self, signal: usize, value: f64) {
        if signal == 1 {
            self.output = value;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    /// A window of a first-order process with gain 2, 5 s and a dead time of 1 s, at 0.5 s.
    fn window() -> Window {
        let (h, a) = (0.5, (-0.1_f64).exp());
        let mut y = 3.0;
        let u = |k: usize| if (k / 20).is_multiple_of(2) { 1.0 } else { 4.0 };
        let mut moments = Vec::new();
        for k in 0..200_usize {
            moments.push(Moment {
                t_s: k as f64 * h,
                setpoint: 0.0,
                measurement: y,
                output: u(k),
            });
            y = a * y + (1.0 - a) * (2.0 * u(k.saturating_sub(2)) + 1.0);
        }
        Window { moments }
    }

    #[test]
    fn a_fit_finds_the_process_behind_a_window() {
        let fit = window().fit().unwrap();
        assert!((fit.gain - 2.0).abs() < 1e-6, "{fit:?}");
        assert!((fit.tau_s - 5.0).abs() < 1e-6, "{fit:?}");
        assert!((fit.dead_time_s - 1.0).abs() < 1e-9, "{fit:?}");
        assert!((fit.rest - 1.0).abs() < 1e-6 && fit.explained > 0.999, "{fit:?}");
    }

    #[test]
    fn cycles_that_are_missing_or_late_do_not_bend_the_fit() {
        let near = |fit: Fit| {
            assert!(
                (fit.gain - 2.0).abs() < 1e-6 && (fit.tau_s - 5.0).abs() < 1e-6,
                "{fit:?}"
            );
            assert!((fit.dead_time_s - 1.0).abs() < 1e-9 && fit.explained > 0.999, "{fit:?}");
        };
        // Every fifth measurement is bad; every seventh cycle was lost, while the actuator held.
        let mut gaps = window();
        let mut n = 0;
        gaps.moments.retain_mut(|m| {
            n += 1;
            if n % 5 == 0 {
                m.measurement = f64::NAN;
            }
            n % 7 != 0 || (n - 1) % 20 == 0
        });
        near(gaps.fit().unwrap());
        // The clock of the record trembles.
        let mut late = window();
        for (i, m) in late.moments.iter_mut().enumerate() {
            m.t_s += if i % 3 == 0 { 0.08 } else { 0.0 };
        }
        near(late.fit().unwrap());
        // Nobody knows what happened in an hour without a record.
        let mut hour = window();
        for m in hour.moments.iter_mut().skip(100) {
            m.t_s += 3600.0;
        }
        near(hour.fit().unwrap());
    }

    #[test]
    fn a_window_that_does_not_move_fits_nothing() {
        let mut still = window();
        for m in &mut still.moments {
            (m.measurement, m.output) = (1.0, 1.0);
        }
        assert_eq!(still.fit(), None);
    }

    #[test]
    fn what_was_measured_comes_again() {
        let json = br#"{"loop":"l","records":[
            {"at_unix_us":1000000,"setpoint":1.0,"measurement":5.0,"outputs":{"out":2.0}},
            {"at_unix_us":1500000,"setpoint":1.0,"measurement":5.0,"outputs":{"out":2.5},
             "readings":[{"port":"pv","quality":"bad","value":5.0},{"port":"out","quality":"good","value":2.0}]},
            {"at_unix_us":2000000,"setpoint":1.0,"measurement":7.0,"outputs":{"out":3.0}}],"more":false,"unread":0}"#;
        let window = Window::parse(json, "x").unwrap();
        assert!((window.duration_s() - 1.0).abs() < 1e-9 && (window.period_s() - 0.5).abs() < 1e-9);
        let mut model = RecordedModel::new(&window);
        assert_eq!((model.truth(0), model.truth(1)), (5.0, 2.0));
        model.set(1, 9.0);
        model.advance(500_000_000).unwrap();
        assert!(model.truth(0).is_nan());
        model.advance(3_000_000_000).unwrap();
        assert_eq!((model.truth(0), model.truth(1), model.truth(2)), (7.0, 9.0, 3.0));
        for bad in ["[]", "{\"records\":[]}", "x"] {
            assert!(Window::parse(bad.as_bytes(), "x").is_err(), "{bad}");
        }
    }
}
