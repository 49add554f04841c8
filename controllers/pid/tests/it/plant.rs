//! Simulated processes: lags in a row behind a dead time, integrated by the classical Runge-Kutta method.
//!
//! Never: anything of the code under test.

use std::collections::VecDeque;

/// What stands behind the dead time.
#[derive(Debug, Clone)]
pub(crate) enum Kind {
    /// 1 / ((T1·s + 1)(T2·s + 1)…).
    Lags(Vec<f64>),
    /// (1 − s) / (s + 1)³: the output first goes the wrong way.
    Inverse,
    /// 1 / s.
    Integrator,
}

/// A process with its dead time.
#[derive(Debug, Clone)]
pub(crate) struct Plant {
    kind: Kind,
    state: Vec<f64>,
    /// Inputs under way, oldest first; their number is the dead time in steps.
    under_way: VecDeque<f64>,
    dt_s: f64,
}

impl Plant {
    pub(crate) fn new(kind: Kind, dead_time_s: f64, dt_s: f64) -> Self {
        let order = match &kind {
            Kind::Lags(times) => times.len(),
            Kind::Inverse => 3,
            Kind::Integrator => 1,
        };
        let steps = (dead_time_s / dt_s).round() as usize;
        Self {
            kind,
            state: vec![0.0; order],
            under_way: vec![0.0; steps].into(),
            dt_s,
        }
    }

    fn slope(&self, x: &[f64], u: f64) -> Vec<f64> {
        let inputs = std::iter::once(&u).chain(x);
        match &self.kind {
            Kind::Lags(times) => x.iter().zip(inputs).zip(times).map(|((x, i), t)| (i - x) / t).collect(),
            Kind::Inverse => x.iter().zip(inputs).map(|(x, i)| i - x).collect(),
            Kind::Integrator => vec![u],
        }
    }

    /// Applies an input for one step and gives the output after it.
    pub(crate) fn step(&mut self, input: f64) -> f64 {
        self.under_way.push_back(input);
        let u = self.under_way.pop_front().unwrap_or(input);
        let moved =
            |x: &[f64], k: &[f64], part: f64| -> Vec<f64> { x.iter().zip(k).map(|(x, k)| x + k * part).collect() };
        let (x, h) = (self.state.clone(), self.dt_s);
        let k1 = self.slope(&x, u);
        let k2 = self.slope(&moved(&x, &k1, h / 2.0), u);
        let k3 = self.slope(&moved(&x, &k2, h / 2.0), u);
        let k4 = self.slope(&moved(&x, &k3, h), u);
        for (i, x) in self.state.iter_mut().enumerate() {
            *x += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
        self.output()
    }

    pub(crate) fn output(&self) -> f64 {
        match self.kind {
            Kind::Inverse => 2.0 * self.state[2] - self.state[1],
            Kind::Lags(_) | Kind::Integrator => self.state[self.state.len() - 1],
        }
    }
}
