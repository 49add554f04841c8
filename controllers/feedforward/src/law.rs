//! The way of a measured disturbance to the output: dead time, then lead-lag. Pure, without ports, clocks or bytes.
//!
//! ```text
//!   ff ─► e^(−delay·s) ─► (1 + lead·s) / (1 + lag·s) ─► · ff-gain ─► added to the PID's output
//!   New ── first value: everything at rest with it ──► Running
//! ```
//! With the process G from the output and Gd from the disturbance, both of first order with dead time, the ideal is
//! `ff-gain = −Kd/K`, `lead = T`, `lag = Td`, `delay = Ld − L`. Source: Åström and Hägglund, *Advanced PID Control* (2006),
//! ch. 5. Never: the feedback; that is the ISA block's.

use bumpless_sdk::blocks::{Delay, LeadLag};
use serde::{Deserialize, Serialize};

/// The parameters; the table has their texts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dynamics {
    /// Time constant of the numerator, s.
    pub lead_s: f64,
    /// Time constant of the denominator, s.
    pub lag_s: f64,
    /// Dead time, s.
    pub delay_s: f64,
}

/// The state, once there was a value.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Path {
    under_way: Option<UnderWay>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct UnderWay {
    last: f64,
    delay: Delay,
    filter: LeadLag,
}

impl Path {
    /// One step of `dt_s` with a disturbance, or, where it cannot be read, with the last one. Gives what is to be added,
    /// before its gain; 0 where there never was a value.
    pub fn step(&mut self, d: &Dynamics, value: Option<f64>, dt_s: f64) -> f64 {
        let Some(way) = &mut self.under_way else {
            let Some(value) = value else { return 0.0 };
            self.under_way = Some(UnderWay {
                last: value,
                delay: Delay::holding(value, d.delay_s),
                filter: LeadLag::resting(value),
            });
            return value;
        };
        // What held until now was the value of the step before.
        let UnderWay { last, delay, filter } = way;
        delay.shift(dt_s, *last, |piece| filter.advance(piece.value, d.lag_s, piece.for_s));
        *last = value.unwrap_or(*last);
        filter.set(if d.delay_s > 0.0 { delay.oldest() } else { *last });
        filter.output(d.lead_s, d.lag_s)
    }

    /// Another dead time.
    pub fn retune(&mut self, d: &Dynamics) {
        if let Some(way) = &mut self.under_way {
            way.delay.stretch(d.delay_s);
        }
    }

    /// What the last step gave.
    #[must_use]
    pub fn output(&self, d: &Dynamics) -> f64 {
        let way = self.under_way.as_ref();
        way.map_or(0.0, |way| way.filter.output(d.lead_s, d.lag_s))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_comes_late_and_with_its_lead() {
        let d = Dynamics {
            lead_s: 4.0,
            lag_s: 2.0,
            delay_s: 1.0,
        };
        let mut path = Path::default();
        assert_eq!(path.step(&d, None, 0.25), 0.0);
        assert_eq!(path.step(&d, Some(3.0), 0.25), 3.0, "at rest with the first value");
        for i in 0..4 {
            assert!((path.step(&d, Some(4.0), 0.25) - 3.0).abs() < 1e-12, "{i}");
        }
        assert!(
            (path.step(&d, Some(4.0), 0.25) - 5.0).abs() < 1e-12,
            "a second later, twice"
        );
        for i in 1..20 {
            let expected = 4.0 + (-0.125 * f64::from(i)).exp();
            assert!((path.step(&d, None, 0.25) - expected).abs() < 1e-9, "{i}");
        }
    }
}
