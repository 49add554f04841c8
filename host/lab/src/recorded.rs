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
    outputs: BTreeMap<String, Option<f64>>,
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
                measurement: number(row.measurement),
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
        let good: Vec<&Moment> = self
            .moments
            .iter()
            .filter(|m| m.measurement.is_finite() && m.output.is_finite())
            .collect();
        let n = good.len();
        // Dead times up to a quarter of the window, in steps of a cycle, at most 200.
        let most = (n / 4).min(200);
        (0..=most)
            .filter_map(|dead| fit_at(&good, dead, h))
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

/// y(k+1) = a·y(k) + b·u(k−dead) + c by least squares; 0 < a < 1 is a first-order lag.
fn fit_at(m: &[&Moment], dead: usize, h: f64) -> Option<Fit> {
    let mut normal = [[0.0; 4]; 3];
    for k in dead..m.len().saturating_sub(1) {
        let x = [m.get(k)?.measurement, m.get(k - dead)?.output, 1.0];
        let y = m.get(k + 1)?.measurement;
        for (row, a) in normal.iter_mut().zip(x) {
            for (cell, b) in row.iter_mut().zip(x.into_iter().chain([y])) {
                *cell += a * b;
            }
        }
    }
    let [a, b, c] = solve(normal)?;
    if !(a > 0.0 && a < 1.0 - 1e-9 && b != 0.0) {
        return None;
    }
    let mean = m.iter().map(|x| x.measurement).sum::<f64>() / m.len() as f64;
    let (mut y, mut missed, mut all) = (m.get(dead)?.measurement, 0.0, 0.0);
    for k in dead..m.len().saturating_sub(1) {
        y = a * y + b * m.get(k - dead)?.output + c;
        let truth = m.get(k + 1)?.measurement;
        missed += (truth - y).powi(2);
        all += (truth - mean).powi(2);
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
            {"at_unix_us":1500000,"setpoint":1.0,"measurement":null,"outputs":{"out":2.5}},
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
