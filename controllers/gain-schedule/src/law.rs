//! Gain, integral and derivative time as curves over another value: pure, without ports, clocks or bytes.
//!
//! ```text
//!   k    ▲      ●───────            straight lines between up to four points, level beyond them;
//!        │    ╱                     between two steps the integral takes up what the change of gains would move the output by
//!        │ ──●
//!        └───x1──x2──────► value that the gains follow
//! ```
//! Source: Åström and Hägglund, *Advanced PID Control* (2006), ch. 9; Foundation Fieldbus blocks' gain tables.
//! Never: the PID itself; that is the ISA block's.

use bumpless_isa::{Memory, Sample, Tuning};
use bumpless_sdk::{Fault, blocks::place};
use serde::{Deserialize, Serialize};

/// Points of the curve at most.
pub const POINTS_MAX: usize = 4;

/// The curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    /// Value of each point, rising.
    pub at: [f64; POINTS_MAX],
    /// Gain, integral time (s) and derivative time (s) at each point.
    pub gains: [[f64; 3]; POINTS_MAX],
    /// How many points count, 1 to [`POINTS_MAX`].
    pub count: usize,
}

impl Schedule {
    /// The rules between points; [`Fault::BadParameter`] where one is broken.
    pub fn check(&self) -> Result<(), Fault> {
        let used = || self.at.iter().zip(&self.gains).take(self.count);
        if used().zip(used().skip(1)).any(|((a, _), (b, _))| a >= b) {
            return Err(Fault::bad_parameter(
                "x1 < x2 < x3 < x4 must hold for the points that count",
            ));
        }
        let integrating = used().filter(|(_, [_, ti, _])| *ti > 0.0).count();
        if integrating == 0 || integrating == self.count {
            Ok(())
        } else {
            Err(Fault::bad_parameter(
                "ti must be 0 at all points or at none: there is no way between an integral and none",
            ))
        }
    }

    /// Gain, integral and derivative time at a value.
    #[must_use]
    pub fn gains(&self, value: f64) -> [f64; 3] {
        let mut points = [(0.0, 0.0); POINTS_MAX];
        for (point, at) in points.iter_mut().zip(self.at) {
            point.0 = at;
        }
        let (part, at) = place(points.get(..self.count).unwrap_or(&points), value);
        let gains = |i: usize| self.gains.get(i).copied().unwrap_or([f64::NAN; 3]);
        let from = gains(at);
        if part <= 0.0 {
            return from;
        }
        let to = gains(at + 1);
        std::array::from_fn(|i| from[i] + part * (to[i] - from[i]))
    }
}

/// The state: the block's, and the value that its gains followed last.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scheduled {
    /// The block.
    pub pid: Memory,
    /// The value; none before the first step.
    pub value: Option<f64>,
}

impl Scheduled {
    /// The gains move from where they were to where `value` puts them, and the output does not.
    pub fn follow(&mut self, value: f64, before: &Tuning, now: &Tuning) {
        self.pid.retune(before, now);
        self.value = Some(value);
    }

    /// One step with the gains of now.
    #[must_use]
    pub fn step(&mut self, now: &Tuning, sample: &Sample) -> f64 {
        self.pid.step(now, sample)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCHEDULE: Schedule = Schedule {
        at: [0.0, 10.0, 20.0, 0.0],
        gains: [[1.0, 20.0, 0.0], [3.0, 10.0, 2.0], [3.0, 5.0, 2.0], [0.0; 3]],
        count: 3,
    };

    #[test]
    fn gains_are_straight_between_points_and_level_beyond() {
        for (value, expected) in [
            (-5.0, [1.0, 20.0, 0.0]),
            (0.0, [1.0, 20.0, 0.0]),
            (5.0, [2.0, 15.0, 1.0]),
            (10.0, [3.0, 10.0, 2.0]),
            (17.5, [3.0, 6.25, 2.0]),
            (99.0, [3.0, 5.0, 2.0]),
        ] {
            assert_eq!(SCHEDULE.gains(value), expected, "{value}");
        }
    }

    #[test]
    fn points_out_of_order_and_half_an_integral_are_refused() {
        assert!(SCHEDULE.check().is_ok());
        let same = Schedule {
            at: [0.0, 0.0, 20.0, 0.0],
            ..SCHEDULE
        };
        assert!(matches!(same.check(), Err(Fault::BadParameter(text)) if text.contains("x1 < x2")));
        let mut half = SCHEDULE;
        half.gains[1][1] = 0.0;
        assert!(matches!(half.check(), Err(Fault::BadParameter(text)) if text.contains("ti must be 0")));
        assert!(Schedule { count: 1, ..half }.check().is_ok());
    }
}
