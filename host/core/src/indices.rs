//! How well a loop is controlled, in numbers: error integrals, output travel, and the figures of a step response.
//!
//! Owns: the formulas. All of them are streams: one sample at a time, a few numbers of memory. Never: keeps the samples,
//! or decides what is good.
//!
//! With e = setpoint − measurement, t in s from the first sample, and T the time of the last one:
//!
//! | index | formula | source |
//! |---|---|---|
//! | IE | ∫ e dt | Åström and Hägglund, "Advanced PID Control", ISA 2006, section 4.4 |
//! | IAE | ∫ \|e\| dt | Graham and Lathrop, "The synthesis of optimum transient response", AIEE Trans. 72, 1953 |
//! | ISE | ∫ e² dt | the same |
//! | ITAE | ∫ t \|e\| dt | the same |
//! | ITSE | ∫ t e² dt | the same |
//! | Id | 100 % · IAE / ∫ \|setpoint\| dt | the index of the PID 4.0 experiments; there without the bars, for setpoints above 0 |
//! | TV | Σ \|u(k+1) − u(k)\| | Skogestad, "Simple analytic rules for model reduction and PID controller tuning", JPC 13, 2003 |
//!
//! The published integrals are written for continuous time and leave the sampling rule open. Here the caller chooses it; to
//! compare two runs, use one rule for both. Sums are plain: after 10⁷ samples their rounding is about 10⁻⁹ of the sum.

/// How an integral is made from samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Rule {
    /// Each sample holds until the next: right for what a sampled controller and a held actuator see. The last sample adds
    /// nothing until the next one comes.
    Rectangle,
    /// The integrand goes straight from sample to sample: closer to a smooth signal. Where e changes its sign between two
    /// samples, |e| is taken as straight as well. A step of the setpoint is two samples at one time.
    Trapezoid,
}

/// Why a sample was not taken.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SampleError {
    /// Time went back.
    #[error("a sample at {t_s} s comes after one at {last_s} s: samples must come in the order of their times")]
    Order {
        /// The sample's time, in s.
        t_s: f64,
        /// The time of the sample before, in s.
        last_s: f64,
    },
    /// Not a number.
    #[error("a sample's time, setpoint or measurement is not a finite number: leave such samples out")]
    NotFinite,
}

/// One taken sample.
#[derive(Debug, Clone, Copy)]
struct Sample {
    t_s: f64,
    setpoint: f64,
    error: f64,
}

/// Error integrals of a run, as a stream.
///
/// ```
/// use bumpless_core::indices::{Indices, Rule};
/// let mut indices = Indices::new(Rule::Rectangle);
/// for (t_s, measurement) in [(0.0, 8.0), (1.0, 9.0), (2.0, 10.0)] {
///     indices.add(t_s, 10.0, measurement)?;
/// }
/// assert_eq!(indices.iae(), 3.0);
/// assert_eq!(indices.id_percent(), Some(15.0));
/// # Ok::<(), bumpless_core::indices::SampleError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Indices {
    rule: Rule,
    /// Time of the first sample, in the caller's time.
    start_s: f64,
    last: Option<Sample>,
    samples: u64,
    ie: f64,
    iae: f64,
    ise: f64,
    itae: f64,
    itse: f64,
    setpoint_area: f64,
}

impl Indices {
    /// Without a sample all indices are 0.
    #[must_use]
    pub const fn new(rule: Rule) -> Self {
        Self {
            rule,
            start_s: 0.0,
            last: None,
            samples: 0,
            ie: 0.0,
            iae: 0.0,
            ise: 0.0,
            itae: 0.0,
            itse: 0.0,
            setpoint_area: 0.0,
        }
    }

    /// Takes a sample at `t_s`, in s on any clock that does not go back. Setpoint and measurement have one unit.
    ///
    /// # Errors
    /// [`SampleError`]; the indices are then as before.
    pub fn add(&mut self, t_s: f64, setpoint: f64, measurement: f64) -> Result<(), SampleError> {
        if !(t_s.is_finite() && setpoint.is_finite() && measurement.is_finite()) {
            return Err(SampleError::NotFinite);
        }
        let error = setpoint - measurement;
        match self.last {
            None => {
                self.start_s = t_s;
                self.last = Some(Sample {
                    t_s: 0.0,
                    setpoint,
                    error,
                });
            }
            Some(last) => {
                let last_s = last.t_s + self.start_s;
                let now = Sample {
                    t_s: t_s - self.start_s,
                    setpoint,
                    error,
                };
                if now.t_s < last.t_s {
                    return Err(SampleError::Order { t_s, last_s });
                }
                self.integrate(last, now);
                self.last = Some(now);
            }
        }
        self.samples += 1;
        Ok(())
    }

    fn integrate(&mut self, a: Sample, b: Sample) {
        let dt = b.t_s - a.t_s;
        let area = |f: fn(Sample) -> f64| match self.rule {
            Rule::Rectangle => f(a) * dt,
            Rule::Trapezoid => 0.5 * (f(a) + f(b)) * dt,
        };
        let ie = area(|s| s.error);
        let iae = area(|s| s.error.abs());
        let ise = area(|s| s.error * s.error);
        let itae = area(|s| s.t_s * s.error.abs());
        let itse = area(|s| s.t_s * s.error * s.error);
        let setpoint_area = area(|s| s.setpoint.abs());
        self.ie += ie;
        self.iae += iae;
        self.ise += ise;
        self.itae += itae;
        self.itse += itse;
        self.setpoint_area += setpoint_area;
    }

    /// Samples taken.
    #[must_use]
    pub const fn samples(&self) -> u64 {
        self.samples
    }

    /// Time from the first to the last sample, in s.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.last.map_or(0.0, |last| last.t_s)
    }

    /// Integral of the error, in unit·s. For a stable PI loop a unit step load at the process input gives Ti/K, whatever
    /// the process: a check on the whole chain.
    #[must_use]
    pub const fn ie(&self) -> f64 {
        self.ie
    }

    /// Integral of the absolute error, in unit·s.
    #[must_use]
    pub const fn iae(&self) -> f64 {
        self.iae
    }

    /// Integral of the squared error, in unit²·s.
    #[must_use]
    pub const fn ise(&self) -> f64 {
        self.ise
    }

    /// Integral of the absolute error times time, in unit·s².
    #[must_use]
    pub const fn itae(&self) -> f64 {
        self.itae
    }

    /// Integral of the squared error times time, in unit²·s².
    #[must_use]
    pub const fn itse(&self) -> f64 {
        self.itse
    }

    /// Mean absolute error, in units: IAE over the duration. None where no time has passed.
    #[must_use]
    pub fn mean_absolute_error(&self) -> Option<f64> {
        let duration = self.duration_s();
        (duration > 0.0).then(|| self.iae / duration)
    }

    /// IAE in % of the integral of |setpoint|; none where that integral is 0.
    #[must_use]
    pub fn id_percent(&self) -> Option<f64> {
        (self.setpoint_area > 0.0).then(|| 100.0 * self.iae / self.setpoint_area)
    }
}

/// Total variation of an output: how far the actuator travelled, in the output's unit. It is what good control costs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TotalVariation {
    last: Option<f64>,
    sum: f64,
}

impl TotalVariation {
    /// Takes the next output; one that is not finite moved nothing and is passed over.
    pub fn add(&mut self, output: f64) {
        if output.is_finite() {
            self.sum += self.last.map_or(0.0, |last| (output - last).abs());
            self.last = Some(output);
        }
    }

    /// The travel so far.
    #[must_use]
    pub const fn value(&self) -> f64 {
        self.sum
    }
}

/// The figures of one step of the setpoint, as a stream of measurements after it.
///
/// Overshoot and settling time as in Ogata, "Modern Control Engineering", 5th edition, section 5.3: overshoot is how far the
/// measurement went beyond the new setpoint, in % of the step; settling time is when it entered the band around the new
/// setpoint for good.
#[derive(Debug, Clone)]
pub struct StepResponse {
    start_s: f64,
    from: f64,
    to: f64,
    /// Half of the band, in units.
    band: f64,
    last_s: Option<f64>,
    /// Greatest way beyond `to`, in units and in the step's direction.
    beyond: f64,
    peak_s: f64,
    /// When the measurement last came into the band; none while it is outside.
    inside_since_s: Option<f64>,
}

impl StepResponse {
    /// A step at `start_s` from `from` to `to`. `band_percent` is half of the band's width in % of the step: 2 and 5 are usual.
    /// None where there is no step or a number is not finite or the band is negative.
    #[must_use]
    pub fn new(start_s: f64, from: f64, to: f64, band_percent: f64) -> Option<Self> {
        let finite = start_s.is_finite() && from.is_finite() && to.is_finite() && band_percent.is_finite();
        let step = to - from;
        if !finite || step == 0.0 || !step.is_finite() || band_percent < 0.0 {
            return None;
        }
        let band = step.abs() * band_percent / 100.0;
        let (last_s, inside_since_s) = (None, None);
        Some(Self {
            start_s,
            from,
            to,
            band,
            last_s,
            beyond: 0.0,
            peak_s: start_s,
            inside_since_s,
        })
    }

    /// Takes a measurement at `t_s`, on the clock of `start_s`.
    ///
    /// # Errors
    /// [`SampleError`], also for a sample before the step; the figures are then as before.
    pub fn add(&mut self, t_s: f64, measurement: f64) -> Result<(), SampleError> {
        if !(t_s.is_finite() && measurement.is_finite()) {
            return Err(SampleError::NotFinite);
        }
        let last_s = self.last_s.unwrap_or(self.start_s);
        if t_s < last_s {
            return Err(SampleError::Order { t_s, last_s });
        }
        self.last_s = Some(t_s);
        let beyond = (measurement - self.to) * (self.to - self.from).signum();
        if beyond > self.beyond {
            self.beyond = beyond;
            self.peak_s = t_s;
        }
        let inside = (measurement - self.to).abs() <= self.band;
        self.inside_since_s = if inside {
            self.inside_since_s.or(Some(t_s))
        } else {
            None
        };
        Ok(())
    }

    /// How far the measurement went beyond the new setpoint, in % of the step; 0 where it did not.
    #[must_use]
    pub fn overshoot_percent(&self) -> f64 {
        100.0 * self.beyond / (self.to - self.from).abs()
    }

    /// Time from the step to the farthest point beyond the setpoint, in s; none without overshoot.
    #[must_use]
    pub fn peak_time_s(&self) -> Option<f64> {
        (self.beyond > 0.0).then_some(self.peak_s - self.start_s)
    }

    /// Time from the step to the first sample of those that stayed in the band up to now, in s; none while it is outside.
    /// True only to one sampling period, and only if the run is long enough for nothing to leave the band again.
    #[must_use]
    pub fn settling_time_s(&self) -> Option<f64> {
        self.inside_since_s.map(|since| since - self.start_s)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn near(a: f64, b: f64, tolerance: f64) {
        assert!((a - b).abs() <= tolerance, "{a} is not {b} within {tolerance}");
    }

    fn run(rule: Rule, samples: &[(f64, f64, f64)]) -> Indices {
        let mut indices = Indices::new(rule);
        for &(t, setpoint, measurement) in samples {
            indices.add(t, setpoint, measurement).unwrap();
        }
        indices
    }

    /// Errors 4, −2, 1 at 0, 1 and 3 s; setpoints 10, 10, 20; the clock starts at 100 s.
    const HAND: [(f64, f64, f64); 3] = [(100.0, 10.0, 6.0), (101.0, 10.0, 12.0), (103.0, 20.0, 19.0)];

    #[test]
    fn the_rectangle_rule_by_hand() {
        let i = run(Rule::Rectangle, &HAND);
        assert_eq!(i.ie(), 4.0 - 2.0 * 2.0);
        assert_eq!(i.iae(), 4.0 + 2.0 * 2.0);
        assert_eq!(i.ise(), 16.0 + 4.0 * 2.0);
        assert_eq!(i.itae(), 0.0 + 1.0 * 2.0 * 2.0);
        assert_eq!(i.itse(), 0.0 + 1.0 * 4.0 * 2.0);
        assert_eq!(i.id_percent(), Some(100.0 * 8.0 / (10.0 + 20.0)));
        assert_eq!(i.mean_absolute_error(), Some(8.0 / 3.0));
        assert_eq!((i.samples(), i.duration_s()), (3, 3.0));
    }

    #[test]
    fn the_trapezoid_rule_by_hand() {
        let i = run(Rule::Trapezoid, &HAND);
        assert_eq!(i.ie(), 0.5 * (4.0 - 2.0) + 0.5 * (-2.0 + 1.0) * 2.0);
        assert_eq!(i.iae(), 0.5 * (4.0 + 2.0) + 0.5 * (2.0 + 1.0) * 2.0);
        assert_eq!(i.ise(), 0.5 * (16.0 + 4.0) + 0.5 * (4.0 + 1.0) * 2.0);
        assert_eq!(i.itae(), 0.5 * (0.0 + 2.0) + 0.5 * (2.0 + 3.0) * 2.0);
        assert_eq!(i.itse(), 0.5 * (0.0 + 4.0) + 0.5 * (4.0 + 3.0) * 2.0);
        assert_eq!(i.id_percent(), Some(100.0 * 6.0 / (10.0 + 30.0)));
    }

    #[test]
    fn a_decaying_error_has_the_integrals_of_the_formula() {
        // e = exp(−t/τ): IAE = IE = τ, ISE = τ/2, ITAE = τ², ITSE = τ²/4.
        let tau = 3.0;
        for (rule, tolerance) in [(Rule::Rectangle, 1.0e-2), (Rule::Trapezoid, 1.0e-5)] {
            let mut i = Indices::new(rule);
            for k in 0..12_000 {
                let t = f64::from(k) * 0.01;
                i.add(t, 1.0, 1.0 - (-t / tau).exp()).unwrap();
            }
            near(i.ie(), tau, tolerance);
            near(i.iae(), tau, tolerance);
            near(i.ise(), tau / 2.0, tolerance);
            near(i.itae(), tau * tau, tolerance);
            near(i.itse(), tau * tau / 4.0, tolerance);
        }
    }

    #[test]
    fn a_pi_loop_under_a_load_step_has_the_published_integrals() {
        // Process 1/((s+1)(0.2s+1)), K = 5.5, Ti = 0.8, unit step load at the process input. IE = Ti/K exactly; there is no
        // overshoot, so IAE is the same. SIMC tuning; Skogestad 2003, table of process E1, prints IAE 0.15 and TV 1.55.
        let (gain, ti, dt) = (5.5, 0.8, 1.0e-4);
        let (mut x, mut y, mut integral) = (0.0_f64, 0.0_f64, 0.0_f64);
        let mut i = Indices::new(Rule::Trapezoid);
        let mut travel = TotalVariation::default();
        for k in 0..200_000 {
            i.add(f64::from(k) * dt, 0.0, y).unwrap();
            let error = -y;
            integral += gain / ti * error * dt;
            let u = gain * error + integral;
            travel.add(u);
            x += (u + 1.0 - x) / 0.2 * dt;
            y += (x - y) * dt;
        }
        near(i.ie(), -ti / gain, 1.0e-4);
        near(i.iae(), 0.1455, 1.0e-4);
        near(travel.value(), 1.55, 0.01);
    }

    #[test]
    fn bad_samples_are_refused_and_change_nothing() {
        let mut i = run(Rule::Trapezoid, &HAND);
        let before = format!("{i:?}");
        let table = [
            ((102.9, 0.0, 0.0), "102.9 s comes after one at 103 s"),
            ((f64::NAN, 0.0, 0.0), "finite"),
            ((104.0, f64::INFINITY, 0.0), "finite"),
            ((104.0, 0.0, f64::NAN), "finite"),
        ];
        for ((t, setpoint, measurement), part) in table {
            let error = i.add(t, setpoint, measurement).unwrap_err().to_string();
            assert!(error.contains(part), "{part}: {error}");
        }
        assert_eq!(format!("{i:?}"), before);
        // Two samples at one time are a step of the setpoint: it has no width.
        i.add(103.0, 900.0, 0.0).unwrap();
        assert_eq!(i.iae(), 6.0);
    }

    #[test]
    fn nothing_sampled_has_no_indices() {
        let i = Indices::new(Rule::Rectangle);
        assert_eq!((i.iae(), i.id_percent(), i.mean_absolute_error()), (0.0, None, None));
        let i = run(Rule::Rectangle, &[(0.0, 0.0, 1.0), (1.0, 0.0, 1.0)]);
        assert_eq!((i.iae(), i.id_percent()), (1.0, None));
        let i = run(Rule::Rectangle, &[(0.0, -10.0, -9.0), (1.0, -10.0, -9.0)]);
        assert_eq!(i.id_percent(), Some(10.0));
    }

    #[test]
    fn travel_counts_every_way() {
        let mut travel = TotalVariation::default();
        assert_eq!(travel.value(), 0.0);
        for output in [10.0, 15.0, f64::NAN, 12.0, 12.0, -3.0] {
            travel.add(output);
        }
        assert_eq!(travel.value(), 5.0 + 3.0 + 0.0 + 15.0);
    }

    #[test]
    fn a_second_order_step_has_the_overshoot_and_peak_of_the_formula() {
        // Damping ζ = 0.5, ω = 2 rad/s: overshoot exp(−πζ/√(1−ζ²)) = 16.303 %, peak at π/(ω√(1−ζ²)) = 1.8138 s.
        let (zeta, omega) = (0.5_f64, 2.0_f64);
        let damped = omega * (1.0 - zeta * zeta).sqrt();
        for (from, to) in [(20.0, 60.0), (60.0, 20.0)] {
            let mut response = StepResponse::new(5.0, from, to, 2.0).unwrap();
            let mut left_at = 0.0;
            for k in 0..20_000 {
                let t = f64::from(k) * 1.0e-3;
                let decay = (-zeta * omega * t).exp();
                let y = 1.0 - decay * ((damped * t).cos() + zeta * omega / damped * (damped * t).sin());
                response.add(5.0 + t, from + (to - from) * y).unwrap();
                if (y - 1.0).abs() > 0.02 {
                    left_at = t;
                }
            }
            near(response.overshoot_percent(), 16.303, 1.0e-3);
            near(response.peak_time_s().unwrap(), 1.8138, 1.0e-3);
            near(response.settling_time_s().unwrap(), left_at, 1.5e-3);
        }
    }

    #[test]
    fn settling_starts_again_when_the_measurement_leaves_the_band() {
        let mut response = StepResponse::new(0.0, 0.0, 10.0, 5.0).unwrap();
        let mut settled = Vec::new();
        for (t, y) in [(0.0, 0.0), (1.0, 9.6), (2.0, 10.4), (3.0, 9.4), (4.0, 9.5), (5.0, 10.0)] {
            response.add(t, y).unwrap();
            settled.push(response.settling_time_s());
        }
        assert_eq!(settled, [None, Some(1.0), Some(1.0), None, Some(4.0), Some(4.0)]);
        near(response.overshoot_percent(), 4.0, 1.0e-9);
        assert!(response.add(4.9, 10.0).is_err() && response.add(6.0, f64::NAN).is_err());
        assert!(StepResponse::new(0.0, 1.0, 2.0, 5.0).unwrap().add(-1.0, 0.0).is_err());
        for (from, to, band) in [
            (1.0, 1.0, 5.0),
            (f64::NAN, 1.0, 5.0),
            (0.0, 1.0, -1.0),
            (f64::MIN, f64::MAX, 5.0),
        ] {
            assert!(StepResponse::new(0.0, from, to, band).is_none());
        }
        let mut slow = StepResponse::new(0.0, 0.0, 10.0, 5.0).unwrap();
        slow.add(1.0, 3.0).unwrap();
        assert_eq!(
            (slow.overshoot_percent(), slow.peak_time_s(), slow.settling_time_s()),
            (0.0, None, None)
        );
    }
}
