//! The arithmetic of the ISA standard form: pure, without ports, clocks or bytes.
//!
//! With the error `e = r − y` (less the dead band), gain `K` (negative for direct action), `w = γr − y`:
//!
//! ```text
//!   U = P + I + D + F          P = K(βr − y)          D = K·d,  Tf·d' + d = Td·w',  Tf = Td/N
//!   Ti·I' = K·e + (H − U)      H = what the actuator holds          F = ff-gain · ff
//! ```
//! `H − U` is external reset: while the actuator does not hold what the law wants (a limit, a rate limit, a hand outside the
//! sandbox), the integral follows the actuator with time constant Ti, so it never winds up. For β = 1, without D and F, it is
//! the positive feedback of ISA-TR5.9-2023: the integral is the actuator's value through a first-order lag of time Ti,
//! `Ti·I' = H − I`. P, D and F are taken out of the feedback, so that the standard form stays non-interacting and a unit step
//! load costs exactly `∫e dt = Ti/K`.
//!
//! Between two samples the actuator holds its value, so the lag is advanced exactly (zero-order hold, [`lag_part`]):
//!
//! ```text
//!   I_k = I_(k−1) + (H_k − U_(k−1) + K·e_(k−1)) · (1 − e^(−ΔT/Ti))
//! ```
//! `H_k`, read at step k, is what the actuator has held since step k−1: it belongs to `U_(k−1)` and `e_(k−1)`.
//! d is advanced by backward difference ([`derivative`]). ΔT is the true time since the integral was advanced last;
//! it is not given for a step whose measurement does not count (PIDPlus), and then I, d and y stay.
//! Without integral action (Ti = 0) `I` is the bias: it returns to its parameter with time constant `balance-time` after a
//! bumpless transfer, as `BAL_TIME` of the Foundation Fieldbus PID block does.
//!
//! ```text
//!          manual, track-on                  automatic
//!   New ────────────────────► Following ─────────────────► Running ◄─┐
//!    │                           ▲  ▲ I = H − (P+D+F)       │  │     │ automatic: I as above
//!    │                           └──┘                       │  └─────┘
//!    │                           ▲      manual, track-on    │
//!    │                           └──────────────────────────┘
//!    └── automatic: y, d from this sample; I = H − (P+D+F) ──► Running
//!
//!   New, Following, Running ── bypass, automatic: I = H − r ──► Bypassed ── no bypass: as from Following ──► Running
//! ```
//! The first automatic step from `New` or `Following` gives exactly what the actuator holds, whatever the error, and D starts
//! from rest.
//! The setpoint r is the given one within its limits and, where it has a rate, on its way to it. When its source changes, the
//! integral takes what P would jump by. *Hold* leaves I as it is; *no rise* and *no fall* do so one way, and so does the output
//! beyond its anti-windup limits; *reset* puts another value in H's place. In *bypass* the output is the setpoint in the
//! output's place, and I is what is left of the difference at the transfer, which fades with `balance-time`.
//! Never: a panic; numbers out of range give a number out of range, which the glue refuses.

use bumpless_sdk::blocks::{dead_band, derivative, lag_part, limit, rate_limit};
use serde::{Deserialize, Serialize};

use crate::tuning::Tuning;

/// Where the law stands; see the picture above.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Phase {
    /// Has seen no measurement yet.
    New,
    /// Something else decides the output, and the law follows it.
    Following,
    /// The law decides.
    Running,
    /// The setpoint goes through to the output.
    Bypassed,
}

/// Who decides the output in a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Demand {
    /// The law.
    Automatic,
    /// Somebody else; the output is this value.
    Follow(f64),
}

/// What one step is about; [`Sample::automatic`] has the usual values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Measurement y.
    pub pv: f64,
    /// Setpoint r.
    pub setpoint: f64,
    /// Feedforward, before its gain; 0 for none.
    pub feedforward: f64,
    /// What the actuator holds, H; none where it cannot be read.
    pub held: Option<f64>,
    /// Who decides.
    pub demand: Demand,
    /// Time since the step before, s; greater than 0.
    pub dt_s: f64,
    /// ΔT, s: time since the last measurement that counted, where this one counts.
    pub elapsed_s: Option<f64>,
    /// Is the setpoint another block's?
    pub remote: bool,
    /// Does the integral stand still?
    pub hold: bool,
    /// May the integral not raise the output: would more of it be of no use?
    pub no_rise: bool,
    /// May it not lower the output?
    pub no_fall: bool,
    /// Does the setpoint go through to the output?
    pub bypass: bool,
    /// What the integral follows instead of the actuator, where that is told.
    pub reset: Option<f64>,
}

impl Sample {
    /// The law decides, the measurement counts, and nothing else is connected.
    #[must_use]
    pub const fn automatic(pv: f64, setpoint: f64, held: Option<f64>, dt_s: f64) -> Self {
        Self {
            pv,
            setpoint,
            feedforward: 0.0,
            held,
            demand: Demand::Automatic,
            dt_s,
            elapsed_s: Some(dt_s),
            remote: false,
            hold: false,
            no_rise: false,
            no_fall: false,
            bypass: false,
            reset: None,
        }
    }
}

/// The state in layout 1, before setpoints had limits and sources of their own.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Memory1 {
    /// As in [`Memory`]; so are the others.
    pub phase: Phase,
    /// Last output.
    pub output: f64,
    /// I.
    pub integral: f64,
    /// y.
    pub pv: f64,
    /// r.
    pub setpoint: f64,
    /// Feedforward.
    pub feedforward: f64,
    /// d.
    pub derivative: f64,
    /// r of d.
    pub derivative_setpoint: f64,
    /// Time waited, s.
    pub waited_s: f64,
}

impl From<Memory1> for Memory {
    fn from(old: Memory1) -> Self {
        Self {
            phase: old.phase,
            output: old.output,
            integral: old.integral,
            pv: old.pv,
            setpoint: old.setpoint,
            feedforward: old.feedforward,
            derivative: old.derivative,
            derivative_setpoint: old.derivative_setpoint,
            waited_s: old.waited_s,
            remote: false,
            alarms: 0,
        }
    }
}

/// The state: everything that lasts from step to step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    /// Where the law stands.
    pub phase: Phase,
    /// Last output; stands in for H where the actuator cannot be read.
    pub output: f64,
    /// I; the bias where Ti is 0.
    pub integral: f64,
    /// y after its filter.
    pub pv: f64,
    /// r of the last step, within its limits.
    pub setpoint: f64,
    /// Feedforward of the last step, before its gain.
    pub feedforward: f64,
    /// d, without the gain.
    pub derivative: f64,
    /// r when d was advanced last.
    pub derivative_setpoint: f64,
    /// Time since the last measurement that counted, s.
    pub waited_s: f64,
    /// Was the setpoint another block's in the last step?
    pub remote: bool,
    /// Alarms that are active, and whether mode and quality are told as out of the ordinary, one bit each; the glue's own.
    pub alarms: u8,
}

impl Memory {
    /// A first state that starts from what the actuator holds.
    #[must_use]
    pub const fn new(track: f64) -> Self {
        Self {
            phase: Phase::New,
            output: track,
            integral: track,
            pv: 0.0,
            setpoint: 0.0,
            feedforward: 0.0,
            derivative: 0.0,
            derivative_setpoint: 0.0,
            waited_s: 0.0,
            remote: false,
            alarms: 0,
        }
    }

    /// Are the numbers that last numbers? Infinite ones would never leave the state again.
    #[must_use]
    pub const fn is_sound(&self) -> bool {
        self.integral.is_finite() && self.derivative.is_finite() && self.pv.is_finite() && self.output.is_finite()
    }

    /// e, less the dead band.
    const fn error(&self, t: &Tuning) -> f64 {
        dead_band(self.setpoint - self.pv, t.dead_band)
    }

    /// P + D + F: everything but the integral.
    ///
    /// The dead band moves the measurement that P sees onto the setpoint, so that `r − y` is the banded error there too.
    const fn rest(&self, t: &Tuning) -> f64 {
        let banded_pv = self.setpoint - self.error(t);
        t.gain * (t.beta * self.setpoint - banded_pv + self.derivative) + t.ff_gain * self.feedforward
    }

    /// Computes one step and gives the output, within its limits; in [`Demand::Follow`] exactly the value followed.
    #[must_use]
    pub fn step(&mut self, t: &Tuning, sample: &Sample) -> f64 {
        let held = match sample.held {
            Some(value) => value,
            None => self.output,
        };
        if let (Phase::Running, Some(elapsed_s), false) = (self.phase, sample.elapsed_s, sample.hold) {
            // Uses the memory of the step before, to which `held` belongs: must come before `observe`.
            self.integrate(t, sample, sample.reset.unwrap_or(held), elapsed_s);
        }
        self.observe(t, sample);
        let rest = self.rest(t);
        self.output = match (sample.demand, self.phase) {
            (Demand::Follow(value), _) => {
                self.phase = Phase::Following;
                self.integral = value - rest;
                value
            }
            (Demand::Automatic, phase) if sample.bypass => {
                let natural = t.through(self.setpoint);
                if matches!(phase, Phase::Bypassed) {
                    self.integral -= self.integral * lag_part(t.balance_s, sample.dt_s);
                    let reached = rate_limit(natural + self.integral, held, t.out_rate_per_s, sample.dt_s);
                    limit(reached, t.out_low, t.out_high)
                } else {
                    self.phase = Phase::Bypassed;
                    self.integral = held - natural;
                    limit(held, t.out_low, t.out_high)
                }
            }
            (Demand::Automatic, Phase::Running) => {
                let wanted = self.integral + rest;
                let reached = rate_limit(wanted, held, t.out_rate_per_s, sample.dt_s);
                limit(reached, t.out_low, t.out_high)
            }
            (Demand::Automatic, Phase::New | Phase::Following | Phase::Bypassed) => {
                self.phase = Phase::Running;
                self.integral = held - rest;
                limit(held, t.out_low, t.out_high)
            }
        };
        self.output
    }

    fn integrate(&mut self, t: &Tuning, sample: &Sample, held: f64, elapsed_s: f64) {
        if t.ti_s > 0.0 {
            let missing = held - (self.integral + self.rest(t));
            let change = (missing + t.gain * self.error(t)) * lag_part(t.ti_s, elapsed_s);
            let barred = if change > 0.0 {
                sample.no_rise || self.output > t.arw_high
            } else {
                sample.no_fall || self.output < t.arw_low
            };
            if !barred {
                self.integral += change;
            }
        } else {
            self.integral += (t.bias - self.integral) * lag_part(t.balance_s, elapsed_s);
        }
    }

    /// The setpoint that the law follows in this step: within its limits, and at most so fast.
    fn wanted_setpoint(&self, t: &Tuning, sample: &Sample) -> f64 {
        let target = limit(sample.setpoint, t.sp_low, t.sp_high);
        if self.phase == Phase::New {
            target
        } else {
            rate_limit(target, self.setpoint, t.sp_rate_per_s, sample.dt_s)
        }
    }

    /// Takes the sample in: filter, derivative, setpoint, feedforward.
    fn observe(&mut self, t: &Tuning, sample: &Sample) {
        // With setpoint tracking the law takes over at the measurement, and goes to the setpoint at its rate.
        let follows = t.sp_track && matches!(sample.demand, Demand::Follow(_));
        let setpoint = if follows {
            limit(sample.pv, t.sp_low, t.sp_high)
        } else {
            self.wanted_setpoint(t, sample)
        };
        if self.phase == Phase::Running && sample.remote != self.remote {
            // Another source is no wish for another output: the integral takes what P would jump by.
            let before = self.rest(t);
            self.setpoint = setpoint;
            self.integral += before - self.rest(t);
            self.derivative_setpoint = setpoint;
        } else if self.phase == Phase::Bypassed && sample.remote != self.remote {
            self.integral += t.through(self.setpoint) - t.through(setpoint);
        }
        self.remote = sample.remote;
        // In bypass the measurement may have been missing for long: nothing of an old one is to be filtered on.
        if matches!(self.phase, Phase::New | Phase::Bypassed) {
            self.pv = sample.pv;
            self.derivative = 0.0;
            self.derivative_setpoint = setpoint;
        } else if let Some(elapsed_s) = sample.elapsed_s {
            let pv = self.pv + (sample.pv - self.pv) * lag_part(t.pv_filter_s, elapsed_s);
            let change = t.gamma * (setpoint - self.derivative_setpoint) - (pv - self.pv);
            self.derivative = match self.phase {
                Phase::Running => derivative(self.derivative, change, t.td_s, t.td_filter_s, elapsed_s),
                // Starts from rest: a D that was balanced at the transfer would fade after it and pull the output along.
                _ => 0.0,
            };
            self.derivative_setpoint = setpoint;
            self.pv = pv;
        }
        self.setpoint = setpoint;
        self.feedforward = sample.feedforward;
    }

    /// Something else decides the output and there is no measurement: follows, and forgets the measurement, so that the law
    /// starts anew from the first good one.
    pub const fn follow_blind(&mut self, value: f64) {
        *self = Self {
            remote: self.remote,
            alarms: self.alarms,
            ..Self::new(value)
        };
    }

    /// Moves the integral so that the output under the new tuning is, for the last sample, what it was under the old.
    ///
    /// D keeps its size, and fades or grows to its new one with its filter; where it is switched off, the integral takes it.
    pub fn retune(&mut self, old: &Tuning, new: &Tuning) {
        // The way through the output rounds; without a change nothing may differ, not even in the last bit.
        if old == new {
            return;
        }
        if self.phase == Phase::Bypassed {
            self.integral += old.through(self.setpoint) - new.through(self.setpoint);
            return;
        }
        let wanted = self.integral + self.rest(old);
        let has_derivative = new.td_s > 0.0 && new.gain != 0.0;
        self.derivative = if has_derivative {
            self.derivative * (old.gain / new.gain)
        } else {
            0.0
        };
        self.integral = wanted - self.rest(new);
    }
}
