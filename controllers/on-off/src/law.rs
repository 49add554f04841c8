//! The arithmetic of a two-position controller: pure, without ports, clocks or bytes.
//!
//! ```text
//!               pv < sp − h/2, after min-off
//!        Off ────────────────────────────────► On          reverse action; direct action mirrors pv about sp
//!            ◄────────────────────────────────
//!               pv > sp + h/2, after min-on
//! ```
//! h is the hysteresis. In between nothing changes. The first step after a start, or after somebody else moved the output,
//! keeps the position, so that a transfer does not switch.
//! Never: an output between the two positions.

use serde::{Deserialize, Serialize};

/// The parameters; the table has their texts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tuning {
    /// Whole width of the band around the setpoint, in units of the measurement.
    pub hysteresis: f64,
    /// Output when on.
    pub on_value: f64,
    /// Output when off.
    pub off_value: f64,
    /// Does a high measurement switch on (cooling), not off (heating)?
    pub direct: bool,
    /// Shortest time on, s.
    pub on_min_s: f64,
    /// Shortest time off, s.
    pub off_min_s: f64,
}

impl Tuning {
    /// The output of a position.
    #[must_use]
    pub const fn value(&self, on: bool) -> f64 {
        if on { self.on_value } else { self.off_value }
    }

    /// The position whose output is nearer; on where both are equally near.
    #[must_use]
    pub const fn nearer(&self, output: f64) -> bool {
        (output - self.on_value).abs() <= (output - self.off_value).abs()
    }
}

/// The state: everything that lasts from step to step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    /// The position.
    pub on: bool,
    /// Time in it, s. Counted from the start: how long the actuator stood there before is not known.
    pub since_s: f64,
    /// Has the law decided at least one step since it took over?
    pub settled: bool,
}

impl Memory {
    /// A first state: the position nearest to what the actuator holds.
    #[must_use]
    pub const fn new(t: &Tuning, track: f64) -> Self {
        Self {
            on: t.nearer(track),
            since_s: 0.0,
            settled: false,
        }
    }

    /// Computes one step and gives the output.
    #[must_use]
    pub const fn step(&mut self, t: &Tuning, pv: f64, setpoint: f64, dt_s: f64) -> f64 {
        self.since_s += dt_s;
        let above = if t.direct { setpoint - pv } else { pv - setpoint };
        let switch = if self.on {
            above > 0.5 * t.hysteresis && self.since_s >= t.on_min_s
        } else {
            above < -0.5 * t.hysteresis && self.since_s >= t.off_min_s
        };
        if switch && self.settled {
            self.on = !self.on;
            self.since_s = 0.0;
        }
        self.settled = true;
        t.value(self.on)
    }

    /// Somebody else decides the output: the position follows.
    pub const fn follow(&mut self, t: &Tuning, output: f64, dt_s: f64) {
        let on = t.nearer(output);
        self.since_s = if on == self.on { self.since_s + dt_s } else { 0.0 };
        self.on = on;
        self.settled = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEATER: Tuning = Tuning {
        hysteresis: 2.0,
        on_value: 100.0,
        off_value: 0.0,
        direct: false,
        on_min_s: 0.0,
        off_min_s: 0.0,
    };

    /// Outputs for a list of measurements, setpoint 20, 1 s apart.
    fn outputs(t: &Tuning, track: f64, pvs: &[f64]) -> Vec<f64> {
        let mut memory = Memory::new(t, track);
        pvs.iter().map(|&pv| memory.step(t, pv, 20.0, 1.0)).collect()
    }

    #[test]
    fn switches_at_the_edges_of_the_band() {
        let pvs = [20.0, 19.1, 18.9, 20.0, 21.0, 21.1, 19.0, 18.9];
        assert_eq!(
            outputs(&HEATER, 0.0, &pvs),
            [0.0, 0.0, 100.0, 100.0, 100.0, 0.0, 0.0, 100.0]
        );
    }

    #[test]
    fn direct_action_is_the_mirror() {
        let cooler = Tuning { direct: true, ..HEATER };
        let pvs = [20.0, 21.1, 18.9, 21.1];
        assert_eq!(outputs(&cooler, 0.0, &pvs), [0.0, 100.0, 0.0, 100.0]);
    }

    #[test]
    fn the_first_step_keeps_the_position() {
        assert_eq!(outputs(&HEATER, 0.0, &[10.0, 10.0]), [0.0, 100.0]);
        assert_eq!(outputs(&HEATER, 100.0, &[30.0, 30.0]), [100.0, 0.0]);
        assert_eq!(outputs(&HEATER, 60.0, &[30.0]), [100.0], "the nearer position");
    }

    #[test]
    fn minimum_times_are_kept() {
        let slow = Tuning {
            on_min_s: 3.0,
            off_min_s: 5.0,
            ..HEATER
        };
        let cold_then_hot: Vec<f64> = [vec![10.0; 6], vec![30.0; 6]].concat();
        let on = outputs(&slow, 0.0, &cold_then_hot)
            .iter()
            .map(|v| *v > 0.0)
            .collect::<Vec<_>>();
        // Off for 5 s from the start, then on for at least 3 s although it is hot from the 7th sample on.
        let expected = [vec![false; 4], vec![true; 3], vec![false; 5]].concat();
        assert_eq!(on, expected);
    }

    #[test]
    fn follows_a_hand_and_takes_over_where_it_left() {
        let mut memory = Memory::new(&HEATER, 0.0);
        memory.follow(&HEATER, 100.0, 1.0);
        assert_eq!(
            memory.step(&HEATER, 30.0, 20.0, 1.0),
            100.0,
            "no switch at the transfer"
        );
        assert_eq!(memory.step(&HEATER, 30.0, 20.0, 1.0), 0.0);
    }
}
