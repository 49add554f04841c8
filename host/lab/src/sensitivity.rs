//! How robust a loop is on paper: Ms, the greatest sensitivity, where process and law are linear and known.
//!
//! ```text
//!   Ms = max |1/(1 + P(iω)·C(iω))|        C = K·(1 + 1/(iω·Ti) + iω·Td/(1 + iω·Td/N))
//! ```
//! (Åström and Hägglund, "Advanced PID Control", ISA 2006, section 4.6.) A sampled loop with a held output is the continuous
//! one with a dead time of half a period more; what the network adds on average is added too. A controller that only acts
//! on fresh readings is no worse than that.
//!
//! Never: a number for a plant or law that is not linear.

use std::{collections::BTreeMap, f64::consts::PI};

use bumpless_io::sim::{FopdtSettings, LinearSettings};

use crate::experiment::{Experiment, LoopPlan, Value};

/// A complex number; what is needed of one.
#[derive(Debug, Clone, Copy)]
struct Complex {
    re: f64,
    im: f64,
}

impl Complex {
    const fn new(re: f64, im: f64) -> Self {
        Self { re, im }
    }

    fn times(self, o: Self) -> Self {
        Self::new(self.re * o.re - self.im * o.im, self.re * o.im + self.im * o.re)
    }

    fn over(self, o: Self) -> Self {
        let d = o.re * o.re + o.im * o.im;
        Self::new(
            (self.re * o.re + self.im * o.im) / d,
            (self.im * o.re - self.re * o.im) / d,
        )
    }

    fn plus(self, o: Self) -> Self {
        Self::new(self.re + o.re, self.im + o.im)
    }

    fn size(self) -> f64 {
        self.re.hypot(self.im)
    }

    fn turned(angle: f64) -> Self {
        Self::new(angle.cos(), angle.sin())
    }
}

/// P(iω).
fn process(p: &LinearSettings, w: f64, dead_s: f64) -> Complex {
    let mut value = Complex::new(p.gain, 0.0);
    for lead in &p.leads_s {
        value = value.times(Complex::new(1.0, w * lead));
    }
    for lag in &p.lags_s {
        value = value.over(Complex::new(1.0, w * lag));
    }
    for _ in 0..p.integrators {
        value = value.over(Complex::new(0.0, w));
    }
    value.times(Complex::turned(-w * dead_s))
}

/// Ms of a PID loop around a linear process, with so much more dead time. None where the loop is unstable, as far as the
/// frequencies looked at can tell: then the sensitivity has no meaning.
#[must_use]
pub fn sensitivity(p: &LinearSettings, gain: f64, ti_s: f64, td_s: f64, n: f64, more_s: f64) -> Option<f64> {
    let dead_s = p.dead_time_s + more_s;
    let slowest = p.lags_s.iter().copied().fold(dead_s, f64::max).max(ti_s).max(1e-6);
    let quickest = p
        .lags_s
        .iter()
        .copied()
        .filter(|l| *l > 0.0)
        .fold(f64::INFINITY, f64::min)
        .min(slowest);
    let (from, to) = (1e-4 / slowest, 1e3 / quickest.max(1e-6));
    let steps = 20_000_u32;
    let mut worst: f64 = 0.0;
    // Nyquist, counted: how far 1 + L turns around 0 from the lowest to the highest frequency.
    let (mut turned, mut last) = (0.0, None::<f64>);
    for k in 0..=steps {
        let w = from * (to / from).powf(f64::from(k) / f64::from(steps));
        let mut c = Complex::new(1.0, 0.0);
        if ti_s > 0.0 {
            c = c.plus(Complex::new(0.0, -1.0 / (w * ti_s)));
        }
        if td_s > 0.0 {
            c = c.plus(Complex::new(0.0, w * td_s).over(Complex::new(1.0, w * td_s / n)));
        }
        let l = process(p, w, dead_s).times(c).times(Complex::new(gain, 0.0));
        let one_plus = l.plus(Complex::new(1.0, 0.0));
        worst = worst.max(1.0 / one_plus.size());
        let angle = one_plus.im.atan2(one_plus.re);
        if let Some(last) = last {
            let mut step: f64 = angle - last;
            if step > PI {
                step -= 2.0 * PI;
            } else if step < -PI {
                step += 2.0 * PI;
            }
            turned += step;
        }
        last = Some(angle);
    }
    // With m integrators in the loop 1 + L begins at −90°·m, and a stable loop turns back by just that to 0.
    let integrators = f64::from(u32::from(p.integrators) + u32::from(ti_s > 0.0));
    let stable = (turned - integrators * PI / 2.0).abs() < PI / 2.0;
    (stable && worst.is_finite()).then_some(worst)
}

/// The process of a stock model, if it is linear.
fn linear(experiment: &Experiment) -> Option<LinearSettings> {
    let p = &experiment.plant;
    let get = |key: &str, default: f64| p.constants.get(key).copied().unwrap_or(default);
    match p.model.as_str() {
        "linear" => Some(p.linear.clone().unwrap_or_default()),
        "fopdt" => {
            let FopdtSettings {
                gain,
                tau_s,
                dead_time_s,
                ..
            } = p.fopdt.unwrap_or_default();
            Some(LinearSettings {
                gain,
                lags_s: vec![tau_s],
                dead_time_s,
                ..LinearSettings::default()
            })
        }
        "component:fopdt" => Some(LinearSettings {
            gain: get("gain", 1.0),
            lags_s: vec![get("tau", 1.0)],
            dead_time_s: get("dead-time", 0.1),
            ..LinearSettings::default()
        }),
        "component:integrating" => Some(LinearSettings {
            gain: get("gain", 1.0),
            lags_s: Vec::new(),
            integrators: 1,
            dead_time_s: get("dead-time", 0.1),
            ..LinearSettings::default()
        }),
        _ => None,
    }
}

/// Ms of a loop of an experiment, where it is known.
pub(crate) fn of_loop(experiment: &Experiment, plan: &LoopPlan) -> Option<f64> {
    let process = linear(experiment).filter(|_| experiment.loops.len() == 1)?;
    let controller = experiment.controller_of(plan)?;
    if !["pid", "pidplus"].contains(&controller.component.as_str()) {
        return None;
    }
    let get = |parameters: &BTreeMap<String, Value>, key: &str, default: f64| match parameters.get(key) {
        Some(Value::Number(number)) => *number,
        _ => default,
    };
    let p = &controller.parameters;
    let direct = matches!(p.get("action"), Some(Value::Word(word)) if word == "direct");
    let gain = get(p, "k", 1.0) * if direct { -1.0 } else { 1.0 };
    let network = [
        &experiment.network.reads,
        &experiment.network.writes,
        &experiment.network.both,
        &experiment.network.both,
    ];
    let more_s = plan.period_ms * 5e-4 + plan.phase_ms * 1e-3 + network.iter().map(|c| c.delay.mean_s()).sum::<f64>();
    sensitivity(
        &process,
        gain,
        get(p, "ti", 60.0),
        get(p, "td", 0.0),
        get(p, "n", 10.0),
        more_s,
    )
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn ms_is_that_of_the_table() {
        let lags = |lags: &[f64], leads: &[f64], integrators, dead_time_s| LinearSettings {
            lags_s: lags.to_vec(),
            leads_s: leads.to_vec(),
            integrators,
            dead_time_s,
            ..LinearSettings::default()
        };
        for (p, k, ti, ms) in [
            (lags(&[1.0, 0.2], &[], 0, 0.0), 5.5, 0.8, 1.560),
            (lags(&[1.0], &[], 0, 1.0), 0.5, 1.0, 1.590),
            (lags(&[4.0], &[], 0, 1.0), 2.0, 4.0, 1.590),
            (lags(&[0.1], &[], 0, 1.0), 0.05, 0.1, 1.590),
            (lags(&[1.0; 4], &[], 0, 0.0), 0.3, 1.5, 1.463),
            (lags(&[1.0; 3], &[-1.0], 0, 0.0), 0.3, 1.5, 1.572),
            (lags(&[], &[], 1, 1.0), 0.5, 8.0, 1.704),
        ] {
            let got = sensitivity(&p, k, ti, 0.0, 10.0, 0.0).unwrap();
            assert!((got - ms).abs() < 0.001, "{p:?}: {got} is not {ms}");
        }
    }

    #[test]
    fn an_unstable_loop_has_none() {
        let p = LinearSettings {
            dead_time_s: 1.0,
            ..LinearSettings::default()
        };
        assert!(sensitivity(&p, 5.0, 1.0, 0.0, 10.0, 0.0).is_none());
        assert!(sensitivity(&p, -0.5, 1.0, 0.0, 10.0, 0.0).is_none());
    }
}
