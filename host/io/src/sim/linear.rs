//! A linear process with one input, solved exactly between the changes of its input.
//!
//! ```text
//!   Y(s)       gain · Π (1 + lead·s)
//!   ──── = ───────────────────────────── · e^(−dead time·s)        U = output + load
//!   U(s)     s^integrators · Π (1 + lag·s)
//! ```
//! The states are those of a chain of first-order parts; the response to a held input over a time h is one matrix,
//! made once per h with the matrix exponential (scaling and squaring of its series: Moler and Van Loan, "Nineteen dubious
//! ways to compute the exponential of a matrix", SIAM Review 45, 2003, method 3) and kept.
//!
//! Never: takes a step that is not exact. However long nobody looks, the next look costs the changes in between.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::model::{Halted, Model, Signal, SignalRole, signal};
use crate::limits::DEAD_TIME_S_MAX;

/// Lags and integrators of a process: beyond it a chain says nothing that fewer with dead time do not.
const ORDER_MAX: usize = 8;
/// Responses that are kept, one per length of step. A loop with one period and one dead time needs two or three.
const KEPT_MAX: usize = 16;
/// Changes on their way through the dead time; beyond it the latest is replaced.
const CHANGES_MAX: usize = 1 << 20;

/// Constants of a linear process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LinearSettings {
    /// Measurement per output; with integrators, per output and second.
    pub gain: f64,
    /// Time constants of the lags, in s, each greater than 0.
    pub lags_s: Vec<f64>,
    /// Time constants of the leads, in s; negative for a zero in the right half plane. Fewer than lags and integrators.
    pub leads_s: Vec<f64>,
    /// How often it integrates: 0, 1 or 2.
    pub integrators: u8,
    /// Dead time, in s.
    pub dead_time_s: f64,
    /// Range of output and measurement.
    pub span: (f64, f64),
}

impl Default for LinearSettings {
    fn default() -> Self {
        Self {
            gain: 1.0,
            lags_s: vec![1.0],
            leads_s: Vec::new(),
            integrators: 0,
            dead_time_s: 0.0,
            span: (-1e9, 1e9),
        }
    }
}

impl LinearSettings {
    /// Checks the numbers.
    ///
    /// # Errors
    /// In words, where one makes no sense.
    pub fn check(&self) -> Result<(), String> {
        let order = self.lags_s.len() + usize::from(self.integrators);
        if !(1..=ORDER_MAX).contains(&order) || self.integrators > 2 {
            return Err(format!(
                "linear: lags_s and integrators must be 1 to {ORDER_MAX} together, with at most 2 integrators"
            ));
        }
        if self.leads_s.len() >= order {
            return Err("linear: there must be fewer leads_s than lags_s and integrators".to_owned());
        }
        if !(self.gain.is_finite() && self.gain != 0.0) {
            return Err("linear: gain must be a number other than 0".to_owned());
        }
        if !self.lags_s.iter().all(|lag| lag.is_finite() && *lag > 0.0) {
            return Err("linear: each of lags_s must be greater than 0 seconds".to_owned());
        }
        if !self.leads_s.iter().all(|lead| lead.is_finite()) {
            return Err("linear: leads_s must be finite".to_owned());
        }
        if !(0.0..=DEAD_TIME_S_MAX).contains(&self.dead_time_s) {
            return Err(format!("linear: dead_time_s must be 0 to {DEAD_TIME_S_MAX} seconds"));
        }
        if !(self.span.0.is_finite() && self.span.1.is_finite() && self.span.0 < self.span.1) {
            return Err("linear: span must be two finite numbers in order".to_owned());
        }
        Ok(())
    }
}

/// A square matrix with the input as the last state, row by row.
type Matrix = Vec<Vec<f64>>;

/// The process. Signals: `pv`, `out`, `load`.
#[derive(Debug, Clone)]
pub struct Linear {
    signals: Vec<Signal>,
    /// d/dt of states and input.
    motion: Matrix,
    /// The measurement from the states.
    row: Vec<f64>,
    kept: Vec<(u64, Matrix)>,
    states: Vec<f64>,
    at_ns: u64,
    dead_ns: u64,
    output: f64,
    load: f64,
    acting: f64,
    waiting: VecDeque<(u64, f64)>,
}

impl Linear {
    /// At rest with everything at 0.
    ///
    /// # Errors
    /// As [`LinearSettings::check`].
    pub fn new(settings: &LinearSettings) -> Result<Self, String> {
        settings.check()?;
        let (motion, row) = chain(settings);
        let signals = vec![
            signal("pv", SignalRole::Measures, "", settings.span, "measurement"),
            signal("out", SignalRole::Sets, "", settings.span, "output"),
            signal(
                "load",
                SignalRole::Disturbs,
                "",
                settings.span,
                "load, added to the output at the process's input",
            ),
        ];
        Ok(Self {
            signals,
            states: vec![0.0; row.len()],
            motion,
            row,
            kept: Vec::new(),
            at_ns: 0,
            dead_ns: (settings.dead_time_s * 1e9).round() as u64,
            output: 0.0,
            load: 0.0,
            acting: 0.0,
            waiting: VecDeque::new(),
        })
    }

    fn changed(&mut self) {
        let (at_ns, input) = (self.at_ns + self.dead_ns, self.output + self.load);
        if self.dead_ns == 0 {
            self.acting = input;
            return;
        }
        let full = self.waiting.len() >= CHANGES_MAX;
        match self.waiting.back_mut() {
            Some(last) if last.0 == at_ns || full => last.1 = input,
            _ => self.waiting.push_back((at_ns, input)),
        }
    }

    fn pass(&mut self, h_ns: u64) {
        if h_ns == 0 {
            return;
        }
        let place = match self.kept.iter().position(|(h, _)| *h == h_ns) {
            Some(place) => place,
            None => {
                if self.kept.len() >= KEPT_MAX {
                    self.kept.remove(0);
                }
                self.kept.push((h_ns, exponential(&self.motion, h_ns as f64 * 1e-9)));
                self.kept.len() - 1
            }
        };
        let Some((_, response)) = self.kept.get(place) else {
            return;
        };
        let next: Vec<f64> = response
            .iter()
            .take(self.states.len())
            .map(|row| {
                let inner: f64 = row.iter().zip(&self.states).map(|(a, x)| a * x).sum();
                inner + row.last().copied().unwrap_or(0.0) * self.acting
            })
            .collect();
        self.states = next;
        self.at_ns += h_ns;
    }
}

impl Model for Linear {
    fn signals(&self) -> &[Signal] {
        &self.signals
    }

    fn advance(&mut self, to_ns: u64) -> Result<(), Halted> {
        while let Some((at_ns, input)) = self.waiting.front().copied().filter(|(at_ns, _)| *at_ns <= to_ns) {
            self.waiting.pop_front();
            self.pass(at_ns.saturating_sub(self.at_ns));
            self.acting = input;
        }
        self.pass(to_ns.saturating_sub(self.at_ns));
        if self.states.iter().all(|x| x.is_finite()) {
            Ok(())
        } else {
            Err(Halted(
                "the linear process left the range of numbers; the loop is unstable".to_owned(),
            ))
        }
    }

    fn truth(&self, signal: usize) -> f64 {
        match signal {
            0 => self.row.iter().zip(&self.states).map(|(c, x)| c * x).sum(),
            1 => self.output,
            2 => self.load,
            _ => f64::NAN,
        }
    }

    fn set(&mut self, signal: usize, value: f64) {
        match signal {
            1 => self.output = value,
            2 => self.load = value,
            _ => return,
        }
        self.changed();
    }
}

/// The chain as equations. Each part is `x' = (input − x)/lag`, or `x' = input` for an integrator; a lead on a lag makes its
/// part's output `x + lead·x'`, on an integrator the same, so it feeds the part's input through to the next part.
fn chain(settings: &LinearSettings) -> (Matrix, Vec<f64>) {
    // Integrators come first, so that leads, which are assigned from the front, never stand on the last part alone.
    let integrators = usize::from(settings.integrators);
    let n = integrators + settings.lags_s.len();
    let mut motion = vec![vec![0.0; n + 1]; n + 1];
    // The present part's input as a row over states and process input.
    let mut input = vec![0.0; n + 1];
    if let Some(last) = input.last_mut() {
        *last = settings.gain;
    }
    for part in 0..n {
        let lag = part.checked_sub(integrators).and_then(|i| settings.lags_s.get(i));
        // d/dt of this part's state, as a row.
        let mut rate = input.clone();
        if let Some(lag) = lag {
            if let Some(own) = rate.get_mut(part) {
                *own -= 1.0;
            }
            for value in &mut rate {
                *value /= lag;
            }
        }
        let lead = settings.leads_s.get(part).copied().unwrap_or(0.0);
        input = rate.iter().map(|value| lead * value).collect();
        if let Some(own) = input.get_mut(part) {
            *own += 1.0;
        }
        if let Some(row) = motion.get_mut(part) {
            *row = rate;
        }
    }
    // Strictly proper: the last part has no lead, so nothing of the process's input reaches the measurement at once.
    input.truncate(n);
    (motion, input)
}

fn times(a: &Matrix, b: &Matrix) -> Matrix {
    a.iter()
        .map(|row| {
            let mut sum = vec![0.0; row.len()];
            for (factor, other) in row.iter().zip(b) {
                for (s, value) in sum.iter_mut().zip(other) {
                    *s += factor * value;
                }
            }
            sum
        })
        .collect()
}

/// e^(matrix · time).
fn exponential(matrix: &Matrix, time: f64) -> Matrix {
    let size = matrix
        .iter()
        .map(|row| row.iter().map(|v| (v * time).abs()).sum::<f64>())
        .fold(0.0, f64::max);
    // Halved until small, then squared back; 60 halvings bring any finite span below a half.
    let halvings = if size > 0.5 {
        (size / 0.5).log2().ceil().clamp(0.0, 60.0) as i32
    } else {
        0
    };
    let scale = time * 0.5_f64.powi(halvings);
    let n = matrix.len();
    let one: Matrix = (0..n)
        .map(|i| (0..n).map(|j| f64::from(u8::from(i == j))).collect())
        .collect();
    let scaled: Matrix = matrix
        .iter()
        .map(|row| row.iter().map(|v| v * scale).collect())
        .collect();
    let (mut sum, mut term) = (one.clone(), one);
    // With a norm of at most a half, the 18th term is below 10⁻²⁰.
    for k in 1..=18 {
        term = times(&term, &scaled);
        for (row, add) in term.iter_mut().zip(&mut sum) {
            for (value, s) in row.iter_mut().zip(add) {
                *value /= f64::from(k);
                *s += *value;
            }
        }
    }
    for _ in 0..halvings {
        sum = times(&sum, &sum);
    }
    sum
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    const S: u64 = 1_000_000_000;

    fn step_response(settings: &LinearSettings, at_s: f64, pieces: u64) -> f64 {
        let mut process = Linear::new(settings).unwrap();
        process.set(1, 1.0);
        let end = (at_s * 1e9) as u64;
        for piece in 1..=pieces {
            process.advance(end / pieces * piece).unwrap();
        }
        process.truth(0)
    }

    #[test]
    fn step_responses_are_those_of_the_books() {
        let e = |x: f64| (-x).exp();
        let make = |lags: &[f64], leads: &[f64], integrators, dead_time_s| LinearSettings {
            lags_s: lags.to_vec(),
            leads_s: leads.to_vec(),
            integrators,
            dead_time_s,
            ..LinearSettings::default()
        };
        for (settings, t, expected) in [
            (make(&[2.0], &[], 0, 0.0), 3.0, 1.0 - e(1.5)),
            (make(&[1.0], &[], 0, 1.0), 3.0, 1.0 - e(2.0)),
            // Two lags: 1 − (T1·e^(−t/T1) − T2·e^(−t/T2))/(T1 − T2).
            (make(&[1.0, 0.2], &[], 0, 0.0), 0.7, 1.0 - (e(0.7) - 0.2 * e(3.5)) / 0.8),
            // Four equal lags: 1 − e^(−t)·(1 + t + t²/2 + t³/6).
            (
                make(&[1.0; 4], &[], 0, 0.0),
                2.0,
                1.0 - e(2.0) * (1.0 + 2.0 + 2.0 + 8.0 / 6.0),
            ),
            // (1 − s)/(1 + s)³: the three lags' response minus its derivative, t²/2·e^(−t).
            (make(&[1.0; 3], &[-1.0], 0, 0.0), 1.5, 1.0 - e(1.5) * (1.0 + 1.5 + 2.25)),
            (make(&[], &[], 1, 1.0), 4.0, 3.0),
            // An integrator and a lag: t − T·(1 − e^(−t/T)).
            (make(&[0.5], &[], 1, 0.0), 2.0, 2.0 - 0.5 * (1.0 - e(4.0))),
        ] {
            for pieces in [1, 7, 1000] {
                let got = step_response(&settings, t, pieces);
                assert!(
                    (got - expected).abs() < 1e-8,
                    "{settings:?} in {pieces}: {got} is not {expected}"
                );
            }
        }
    }

    #[test]
    fn a_load_acts_at_the_input_through_the_dead_time() {
        let mut process = Linear::new(&LinearSettings {
            dead_time_s: 1.0,
            ..LinearSettings::default()
        })
        .unwrap();
        process.set(2, -2.0);
        process.advance(S).unwrap();
        assert_eq!(process.truth(0), 0.0);
        process.set(1, 2.0);
        process.advance(40 * S).unwrap();
        assert!(process.truth(0).abs() < 1e-9);
    }

    #[test]
    fn nonsense_is_refused() {
        let good = LinearSettings::default();
        for (settings, part) in [
            (
                LinearSettings {
                    gain: 0.0,
                    ..good.clone()
                },
                "gain",
            ),
            (
                LinearSettings {
                    lags_s: vec![],
                    ..good.clone()
                },
                "1 to 8 together",
            ),
            (
                LinearSettings {
                    lags_s: vec![-1.0],
                    ..good.clone()
                },
                "lags_s",
            ),
            (
                LinearSettings {
                    leads_s: vec![1.0],
                    ..good.clone()
                },
                "fewer leads_s",
            ),
            (
                LinearSettings {
                    dead_time_s: -1.0,
                    ..good.clone()
                },
                "dead_time_s",
            ),
            (
                LinearSettings {
                    span: (1.0, 0.0),
                    ..good.clone()
                },
                "span",
            ),
        ] {
            let error = settings.check().unwrap_err();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn an_unstable_loop_ends_in_words() {
        let mut process = Linear::new(&LinearSettings {
            integrators: 2,
            lags_s: vec![],
            ..LinearSettings::default()
        })
        .unwrap();
        process.set(1, f64::MAX);
        assert!(process.advance(u64::MAX / 2).is_err());
    }
}
