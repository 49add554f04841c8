//! The arithmetic of the example law, PI(D) with clamping: pure, without ports, clocks or bytes. The same law stands in C,
//! JavaScript, TypeScript and Python in the folders beside this one, operation for operation.
//!
//! ```text
//!   e = r − y                         K gain      Ti, Td times of I and D, s      Tf filter of D, s
//!   d = (Tf·d' + Td·(y' − y)) / (Tf + Δt)         x' is x of the step before
//!   I = I' + K·e·Δt/Ti                not where Ti = 0, nor where u is beyond a limit and this would lead further
//!   u = I + K·(e + d)                 within its limits
//! ```
//! Only `+ − × ÷` and comparisons are used, in a fixed order: IEEE 754 then gives the same bits in every language. Backward
//! differences: Åström and Hägglund, Advanced PID Control (ISA, 2006), ch. 13; clamping: the same, sec. 3.5.
//!
//! ```text
//!   following (somebody else decides the output) ── automatic: I = held − K·e, d = 0 ──► running
//!              ▲                                                                            │
//!              └──────────────────────────────── manual ────────────────────────────────────┘
//! ```
//! The first automatic step gives what the actuator holds, within the limits, whatever the error.
//! Never: a panic.

use serde::{Deserialize, Serialize};

/// The parameters; the table has their texts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// K, in units of the output per unit of the measurement.
    pub gain: f64,
    /// Ti, s; 0 for none.
    pub ti_s: f64,
    /// Td, s; 0 for none.
    pub td_s: f64,
    /// Tf, s.
    pub td_filter_s: f64,
    /// Least output.
    pub out_low: f64,
    /// Greatest output.
    pub out_high: f64,
}

/// The state. In bytes: one for `running`, then five numbers of 8 bytes, little endian.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    /// Does the law decide the output?
    pub running: bool,
    /// I.
    pub integral: f64,
    /// d, without the gain.
    pub derivative: f64,
    /// y of the last step.
    pub pv: f64,
    /// r of the last step.
    pub setpoint: f64,
    /// u; stands in for what the actuator holds where that cannot be read.
    pub output: f64,
}

impl Tuning {
    const fn limited(&self, value: f64) -> f64 {
        if value > self.out_high {
            self.out_high
        } else if value < self.out_low {
            self.out_low
        } else {
            value
        }
    }
}

impl Memory {
    /// A first state: the actuator holds `track`.
    #[must_use]
    pub const fn new(track: f64) -> Self {
        Self {
            running: false,
            integral: track,
            derivative: 0.0,
            pv: 0.0,
            setpoint: 0.0,
            output: track,
        }
    }

    /// Computes one automatic step and gives the output. `held` is what the actuator holds; `dt_s` is greater than 0.
    #[must_use]
    pub const fn step(&mut self, t: &Tuning, pv: f64, setpoint: f64, held: f64, dt_s: f64) -> f64 {
        let error = setpoint - pv;
        if self.running {
            self.derivative = (t.td_filter_s * self.derivative + t.td_s * (self.pv - pv)) / (t.td_filter_s + dt_s);
            let change = if t.ti_s > 0.0 {
                t.gain * error * dt_s / t.ti_s
            } else {
                0.0
            };
            let rest = t.gain * (error + self.derivative);
            let wanted = self.integral + change + rest;
            let further = (wanted > t.out_high && change > 0.0) || (wanted < t.out_low && change < 0.0);
            if !further {
                self.integral += change;
            }
            self.output = t.limited(self.integral + rest);
        } else {
            self.running = true;
            self.derivative = 0.0;
            self.integral = held - t.gain * error;
            self.output = t.limited(held);
        }
        self.pv = pv;
        self.setpoint = setpoint;
        self.output
    }

    /// Somebody else decides the output, and it is `held`.
    pub const fn follow(&mut self, held: f64) {
        self.running = false;
        self.output = held;
    }

    /// Other parameters: moves I so that the output for the last sample stays what it was. The same ones change nothing, not
    /// even in the last bit.
    pub fn retune(&mut self, old: &Tuning, new: &Tuning) {
        if old == new {
            return;
        }
        let error = self.setpoint - self.pv;
        let before = old.gain * (error + self.derivative);
        if new.td_s == 0.0 {
            self.derivative = 0.0;
        }
        self.integral = self.integral + before - new.gain * (error + self.derivative);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PI: Tuning = Tuning {
        gain: 2.0,
        ti_s: 10.0,
        td_s: 0.0,
        td_filter_s: 1.0,
        out_low: 0.0,
        out_high: 100.0,
    };

    #[test]
    fn starts_where_the_actuator_is_and_integrates_from_there() {
        let mut memory = Memory::new(30.0);
        assert_eq!(memory.step(&PI, 40.0, 50.0, 30.0, 0.5), 30.0);
        // K·e·Δt/Ti = 2·10·0.5/10 = 1 per step.
        assert_eq!(memory.step(&PI, 40.0, 50.0, 30.0, 0.5), 31.0);
        assert_eq!(memory.step(&PI, 40.0, 50.0, 31.0, 0.5), 32.0);
    }

    #[test]
    fn does_not_wind_up_at_a_limit_and_leaves_it_at_once() {
        let mut memory = Memory::new(100.0);
        for _ in 0..1000 {
            assert_eq!(memory.step(&PI, 40.0, 50.0, 100.0, 0.5), 100.0);
        }
        let integral = memory.integral;
        assert!(integral <= 100.0, "{integral}");
        assert!(memory.step(&PI, 51.0, 50.0, 100.0, 0.5) < 100.0);
    }

    #[test]
    fn the_derivative_sees_the_measurement_alone_and_fades() {
        let pd = Tuning {
            ti_s: 0.0,
            td_s: 4.0,
            ..PI
        };
        let mut memory = Memory::new(50.0);
        let first = memory.step(&pd, 50.0, 50.0, 50.0, 1.0);
        assert_eq!(
            memory.step(&pd, 50.0, 60.0, 50.0, 1.0) - first,
            20.0,
            "P of the new setpoint, no D"
        );
        let kicked = memory.step(&pd, 49.0, 60.0, 50.0, 1.0);
        assert_eq!(kicked, 50.0 + 2.0 * (11.0 + 2.0));
        let faded = memory.step(&pd, 49.0, 60.0, 50.0, 1.0);
        assert_eq!(faded, 50.0 + 2.0 * (11.0 + 1.0));
    }

    #[test]
    fn other_parameters_leave_the_output_for_the_last_sample() {
        let mut memory = Memory::new(50.0);
        for pv in [44.0, 45.0, 45.5] {
            let _ = memory.step(&PI, pv, 47.0, 50.0, 0.1);
        }
        let before = memory.output;
        let new = Tuning { gain: 5.0, ..PI };
        memory.retune(&PI, &new);
        let error = memory.setpoint - memory.pv;
        assert!((memory.integral + new.gain * error - before).abs() < 1e-12);
        let same = memory;
        memory.retune(&new, &new);
        assert_eq!(memory, same);
    }
}
