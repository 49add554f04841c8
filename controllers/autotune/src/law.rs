//! Experiments that find a tuning: pure, without ports, clocks or bytes.
//!
//! ```text
//!   Relay  out: base ± amplitude, turned where pv leaves ref ± noise      pv swings with Tu and amplitude a
//!          Ku = 4·amplitude / (π·√(a² − noise²)),  three swings alike ──► rule ──► k, ti, td
//!   Step   out: base, until pv is quiet ──► base + amplitude, until it is quiet again
//!          with Δ the change of pv:  S = ∫(1 − y/Δ)dt = L + T,  E = ∫t·(1 − y/Δ)dt = (S² + T²)/2
//!          K = Δ/amplitude,  T = √(2E − S²),  L = S − T ──► SIMC ──► k, ti
//!   either: time-max over, or pv too far from where it began ──► failed
//! ```
//! Sources: Åström and Hägglund, *Automatic tuning of simple regulators with specifications on phase and amplitude margins*
//! (Automatica 20, 1984) for the relay, *Advanced PID Control* (2006), ch. 2 for the moments; Tyreus and Luyben (Ind. Eng.
//! Chem. Res. 31, 1992); Skogestad, *Simple analytic rules for model reduction and PID controller tuning* (J. Process Control
//! 13, 2003). Never: an output beyond base ± amplitude; a curve that is kept.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

/// Swings of the relay that must be alike.
const ALIKE: usize = 3;
/// By which part their periods may differ from their mean.
const LIKENESS: f64 = 0.1;
/// By how many times the noise a step must show to be seen.
const SEEN: f64 = 3.0;

/// What an experiment may do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Greatest distance of the output from where it began.
    pub amplitude: f64,
    /// Half width of what the measurement does by itself.
    pub noise: f64,
    /// Greatest distance of the measurement from where it began.
    pub pv_span: f64,
    /// Longest time, s.
    pub time_max_s: f64,
    /// How long the measurement must be within its noise to be quiet, s; for the step.
    pub quiet_s: f64,
    /// Does a rising measurement call for a rising output?
    pub direct: bool,
}

/// Rules from the relay to a tuning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rule {
    /// Tyreus and Luyben, PI: calm.
    TyreusLuybenPi,
    /// Tyreus and Luyben, PID.
    TyreusLuybenPid,
    /// Ziegler and Nichols, PI: brisk, little damped.
    ZieglerNicholsPi,
    /// Ziegler and Nichols, PID.
    ZieglerNicholsPid,
}

impl Rule {
    /// Gain without its sign, integral and derivative time, s.
    #[must_use]
    pub fn gains(self, ku: f64, tu_s: f64) -> [f64; 3] {
        match self {
            Self::TyreusLuybenPi => [ku / 3.2, 2.2 * tu_s, 0.0],
            Self::TyreusLuybenPid => [ku / 2.2, 2.2 * tu_s, tu_s / 6.3],
            Self::ZieglerNicholsPi => [0.45 * ku, tu_s / 1.2, 0.0],
            Self::ZieglerNicholsPid => [0.6 * ku, 0.5 * tu_s, 0.125 * tu_s],
        }
    }
}

/// SIMC for first order with dead time; `tight` is τc as a part of the dead time: 1 is the usual, greater is calmer.
#[must_use]
pub fn simc(gain: f64, lag_s: f64, delay_s: f64, tight: f64) -> [f64; 3] {
    let both_s = (1.0 + tight) * delay_s;
    // Without a lag SIMC is an integral alone; k and ti keep its k/ti = 1/(K·(τc + L)).
    let lag_s = lag_s.max(1e-3 * both_s);
    [lag_s / (gain.abs() * both_s), lag_s.min(4.0 * both_s), 0.0]
}

/// What an experiment found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Finding {
    /// Ultimate gain and period (s).
    Ultimate {
        /// Ku, without a sign.
        ku: f64,
        /// Tu, s.
        tu_s: f64,
    },
    /// First order with dead time.
    Process {
        /// K, with its sign.
        gain: f64,
        /// T, s.
        lag_s: f64,
        /// L, s.
        delay_s: f64,
    },
}

/// Why there is none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Failure {
    /// It took longer than it may.
    Time,
    /// The measurement went too far.
    Span,
    /// The measurement went the wrong way: the action is wrong.
    Direction,
    /// The output could not go as far as it was to.
    Room,
    /// Somebody else took the output.
    Taken,
}

/// How a step of an experiment ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Course {
    /// The output now.
    Goes(f64),
    /// It is over.
    Ends(Result<Finding, Failure>),
}

/// One swing.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Swing {
    period_s: f64,
    height: f64,
}

/// The relay under way.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Relay {
    base: f64,
    reference: f64,
    time_s: f64,
    high: bool,
    /// When it turned up last; none before the first time.
    turned_s: Option<f64>,
    low: f64,
    peak: f64,
    swings: [Swing; ALIKE],
    count: u8,
}

impl Relay {
    /// Begins from an output and a measurement.
    #[must_use]
    pub const fn new(base: f64, pv: f64) -> Self {
        Self {
            base,
            reference: pv,
            time_s: 0.0,
            high: true,
            turned_s: None,
            low: pv,
            peak: pv,
            swings: [Swing {
                period_s: 0.0,
                height: 0.0,
            }; ALIKE],
            count: 0,
        }
    }

    /// One step of `dt_s`.
    pub fn step(&mut self, b: &Bounds, pv: f64, dt_s: f64) -> Course {
        self.time_s += dt_s;
        if self.time_s > b.time_max_s {
            return Course::Ends(Err(Failure::Time));
        }
        if (pv - self.reference).abs() > b.pv_span {
            return Course::Ends(Err(Failure::Span));
        }
        self.low = self.low.min(pv);
        self.peak = self.peak.max(pv);
        let above = if b.direct {
            self.reference - pv
        } else {
            pv - self.reference
        };
        if self.high && above > b.noise {
            self.high = false;
        } else if !self.high && above < -b.noise {
            self.high = true;
            if let Some(finding) = self.turn(b, pv) {
                return Course::Ends(Ok(finding));
            }
        }
        Course::Goes(self.base + if self.high { b.amplitude } else { -b.amplitude })
    }

    /// It turns up: a swing is over.
    fn turn(&mut self, b: &Bounds, pv: f64) -> Option<Finding> {
        if let Some(turned_s) = self.turned_s {
            self.swings.rotate_left(1);
            if let Some(last) = self.swings.last_mut() {
                *last = Swing {
                    period_s: self.time_s - turned_s,
                    height: self.peak - self.low,
                };
            }
            self.count = self.count.saturating_add(1);
        }
        self.turned_s = Some(self.time_s);
        (self.low, self.peak) = (pv, pv);
        let mean = |of: fn(&Swing) -> f64| self.swings.iter().map(of).sum::<f64>() / ALIKE as f64;
        let (tu_s, height) = (mean(|s| s.period_s), mean(|s| s.height));
        let alike = |s: &Swing| (s.period_s - tu_s).abs() <= LIKENESS * tu_s;
        if usize::from(self.count) < ALIKE || !self.swings.iter().all(alike) {
            return None;
        }
        let inside = (0.25 * height * height - b.noise * b.noise).max(0.0).sqrt();
        // A swing no greater than the noise is none.
        (inside > 0.0).then(|| Finding::Ultimate {
            ku: 4.0 * b.amplitude / (PI * inside),
            tu_s,
        })
    }
}

/// A stretch of time in which the measurement stays within its noise.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Quiet {
    for_s: f64,
    low: f64,
    high: f64,
    area: f64,
}

impl Quiet {
    const fn new(pv: f64) -> Self {
        Self {
            for_s: 0.0,
            low: pv,
            high: pv,
            area: 0.0,
        }
    }

    /// The mean, once it has been quiet for long enough.
    fn step(&mut self, b: &Bounds, pv: f64, dt_s: f64) -> Option<f64> {
        self.low = self.low.min(pv);
        self.high = self.high.max(pv);
        if self.high - self.low > 2.0 * b.noise {
            *self = Self::new(pv);
            return None;
        }
        self.for_s += dt_s;
        self.area += pv * dt_s;
        (self.for_s >= b.quiet_s).then(|| self.area / self.for_s)
    }
}

/// The step under way.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Step {
    base: f64,
    began: f64,
    time_s: f64,
    quiet: Quiet,
    /// From when the output has been up; none while waiting for quiet.
    up: Option<Up>,
}

/// The part of a step after it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Up {
    /// Where the measurement was.
    from: f64,
    time_s: f64,
    /// y of the step before, less `from`.
    y: f64,
    /// ∫y dt and ∫t·y dt.
    area: f64,
    moment: f64,
}

impl Step {
    /// Begins from an output and a measurement.
    #[must_use]
    pub const fn new(base: f64, pv: f64) -> Self {
        Self {
            base,
            began: pv,
            time_s: 0.0,
            quiet: Quiet::new(pv),
            up: None,
        }
    }

    /// One step of `dt_s`.
    pub fn step(&mut self, b: &Bounds, pv: f64, dt_s: f64) -> Course {
        self.time_s += dt_s;
        if self.time_s > b.time_max_s {
            return Course::Ends(Err(Failure::Time));
        }
        if (pv - self.began).abs() > b.pv_span {
            return Course::Ends(Err(Failure::Span));
        }
        let mean = self.quiet.step(b, pv, dt_s);
        let Some(up) = &mut self.up else {
            if let Some(mean) = mean {
                self.quiet = Quiet::new(pv);
                self.up = Some(Up {
                    from: mean,
                    time_s: 0.0,
                    y: 0.0,
                    area: 0.0,
                    moment: 0.0,
                });
                return Course::Goes(self.base + b.amplitude);
            }
            return Course::Goes(self.base);
        };
        let (t0, y0) = (up.time_s, up.y);
        up.time_s += dt_s;
        up.y = pv - up.from;
        // Trapezoids.
        up.area += 0.5 * (y0 + up.y) * dt_s;
        up.moment += 0.5 * (t0 * y0 + up.time_s * up.y) * dt_s;
        match mean.map(|mean| mean - up.from) {
            Some(change) if change.abs() > SEEN * b.noise => Course::Ends(up.finding(b, change)),
            _ => Course::Goes(self.base + b.amplitude),
        }
    }
}

impl Up {
    fn finding(&self, b: &Bounds, change: f64) -> Result<Finding, Failure> {
        if (change < 0.0) != b.direct {
            return Err(Failure::Direction);
        }
        let t = self.time_s;
        let residence_s = t - self.area / change;
        let second = 0.5 * t * t - self.moment / change;
        let lag_s = (2.0 * second - residence_s * residence_s)
            .max(0.0)
            .sqrt()
            .min(residence_s.max(0.0));
        Ok(Finding::Process {
            gain: change / b.amplitude,
            lag_s,
            delay_s: (residence_s - lag_s).max(0.0),
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::panic, reason = "tests")]

    use std::collections::VecDeque;

    use super::*;

    const DT_S: f64 = 0.05;
    const BOUNDS: Bounds = Bounds {
        amplitude: 5.0,
        noise: 0.05,
        pv_span: 50.0,
        time_max_s: 2000.0,
        quiet_s: 30.0,
        direct: false,
    };

    /// K·e^(−L·s)/(T·s + 1).
    struct Process {
        gain: f64,
        lag_s: f64,
        y: f64,
        under_way: VecDeque<f64>,
    }

    impl Process {
        fn new(gain: f64, lag_s: f64, delay_s: f64) -> Self {
            Self {
                gain,
                lag_s,
                y: gain * 40.0,
                under_way: vec![40.0; (delay_s / DT_S).round() as usize].into(),
            }
        }

        fn advance(&mut self, u: f64) {
            self.under_way.push_back(u);
            let u = self.under_way.pop_front().unwrap_or(u);
            self.y += (self.gain * u - self.y) * -(-DT_S / self.lag_s).exp_m1();
        }
    }

    fn run(mut course: impl FnMut(f64) -> Course, process: &mut Process, amplitude: f64) -> Result<Finding, Failure> {
        for _ in 0..200_000 {
            match course(process.y) {
                Course::Goes(out) => {
                    assert!((out - 40.0).abs() <= amplitude, "{out}");
                    process.advance(out);
                }
                Course::Ends(end) => return end,
            }
        }
        panic!("an experiment has an end");
    }

    #[test]
    fn a_step_finds_gain_lag_and_dead_time() {
        for (gain, lag_s, delay_s) in [(2.0, 10.0, 3.0), (0.5, 20.0, 1.0), (1.0, 4.0, 8.0)] {
            let mut process = Process::new(gain, lag_s, delay_s);
            let mut step = Step::new(40.0, process.y);
            let bounds = Bounds { noise: 0.002, ..BOUNDS };
            let found = run(|pv| step.step(&bounds, pv, DT_S), &mut process, 5.0);
            let Ok(Finding::Process {
                gain: k,
                lag_s: t,
                delay_s: l,
            }) = found
            else {
                panic!("{found:?}");
            };
            assert!((k - gain).abs() < 0.02 * gain, "{k}");
            assert!(
                (t - lag_s).abs() < 0.1 * lag_s && (l - delay_s).abs() < 0.1 * (lag_s + delay_s),
                "{t} {l}"
            );
        }
    }

    #[test]
    fn a_relay_finds_the_ultimate_gain_and_period() {
        // e^-3s/(10s+1): ω with atan(10ω) + 3ω = π, Ku = √(1 + 100ω²).
        let mut omega = 0.5_f64;
        for _ in 0..200 {
            omega -= ((10.0 * omega).atan() + 3.0 * omega - PI) / (10.0 / (1.0 + 100.0 * omega * omega) + 3.0);
        }
        let (ku, tu) = ((1.0 + 100.0 * omega * omega).sqrt(), 2.0 * PI / omega);
        let mut process = Process::new(1.0, 10.0, 3.0);
        let mut relay = Relay::new(40.0, process.y);
        let found = run(|pv| relay.step(&BOUNDS, pv, DT_S), &mut process, 5.0);
        let Ok(Finding::Ultimate { ku: k, tu_s: t }) = found else {
            panic!("{found:?}");
        };
        // A relay's swing is no pure sine: the describing function is good to some 15 % on a lag with dead time.
        assert!((k - ku).abs() < 0.2 * ku, "{k} and {ku}");
        assert!((t - tu).abs() < 0.1 * tu, "{t} and {tu}");
    }

    #[test]
    fn an_experiment_ends_when_it_must() {
        let mut process = Process::new(2.0, 10.0, 3.0);
        let mut relay = Relay::new(40.0, process.y);
        let short = Bounds {
            time_max_s: 5.0,
            ..BOUNDS
        };
        assert_eq!(
            run(|pv| relay.step(&short, pv, DT_S), &mut process, 5.0),
            Err(Failure::Time)
        );
        let mut process = Process::new(2.0, 10.0, 3.0);
        let mut step = Step::new(40.0, process.y);
        let narrow = Bounds { pv_span: 4.0, ..BOUNDS };
        assert_eq!(
            run(|pv| step.step(&narrow, pv, DT_S), &mut process, 5.0),
            Err(Failure::Span)
        );
        let mut process = Process::new(-2.0, 10.0, 3.0);
        let mut step = Step::new(40.0, process.y);
        assert_eq!(
            run(|pv| step.step(&BOUNDS, pv, DT_S), &mut process, 5.0),
            Err(Failure::Direction)
        );
    }

    #[test]
    fn rules_are_the_published_ones() {
        assert_eq!(Rule::ZieglerNicholsPid.gains(10.0, 8.0), [6.0, 4.0, 1.0]);
        assert_eq!(Rule::TyreusLuybenPi.gains(3.2, 10.0), [1.0, 22.0, 0.0]);
        // SIMC with τc = L: K = T/(2·k·L), Ti = least of T and 8L.
        assert_eq!(simc(2.0, 8.0, 2.0, 1.0), [1.0, 8.0, 0.0]);
        assert_eq!(simc(-1.0, 100.0, 1.0, 1.0), [50.0, 8.0, 0.0]);
    }
}
