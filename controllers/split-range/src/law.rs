//! One output for two actuators that take turns: pure, without ports, clocks or bytes.
//!
//! ```text
//!   A  a-low ╲                 ╱ b-high  B        u: the PID's output, 0 to 100 %
//!             ╲               ╱                   the gap is where neither moves; a negative one is where both do
//!      a-split ╲____ gap ____╱  b-split
//!              0   split       100  u
//! ```
//! Backwards: where B has left its resting value, it says what u is; else A, where it has left its own; else u is in the gap.
//! So the integral of the PID follows what the actuators hold. Source: Shinskey, *Process Control Systems* (1996), ch. 2.
//! Never: the PID itself; that is the ISA block's.

use bumpless_sdk::{
    Fault,
    blocks::{Balance, curve, limit},
};
use serde::{Deserialize, Serialize};

/// Least and greatest value of u.
const RANGE: (f64, f64) = (0.0, 100.0);
/// Part of an actuator's travel within which it counts as resting.
const REST: f64 = 1e-9;

/// The two curves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Curves {
    /// Where A ends and B begins, in % of u.
    pub split: f64,
    /// Width of the gap around it, in %; negative for an overlap.
    pub gap: f64,
    /// A at u = 0 and at its end of the gap.
    pub a: (f64, f64),
    /// B at its end of the gap and at u = 100 %.
    pub b: (f64, f64),
}

impl Curves {
    /// The rules between them; [`Fault::BadParameter`] where one is broken.
    pub fn check(&self) -> Result<(), Fault> {
        let (a_end, b_end) = self.ends();
        if a_end <= RANGE.0 || b_end >= RANGE.1 {
            return Err(Fault::bad_parameter(
                "split and gap leave an actuator no part of the range: split − gap/2 must be above 0, split + gap/2 below 100",
            ));
        }
        if self.a.0 == self.a.1 || self.b.0 == self.b.1 {
            return Err(Fault::bad_parameter(
                "a-low and a-split must differ, and so must b-split and b-high",
            ));
        }
        Ok(())
    }

    /// u where A rests, and where B begins.
    const fn ends(&self) -> (f64, f64) {
        (self.split - 0.5 * self.gap, self.split + 0.5 * self.gap)
    }

    /// What both actuators should hold.
    #[must_use]
    pub fn both(&self, u: f64) -> [f64; 2] {
        let (a_end, b_end) = self.ends();
        [
            curve(&[(RANGE.0, self.a.0), (a_end, self.a.1)], u),
            curve(&[(b_end, self.b.0), (RANGE.1, self.b.1)], u),
        ]
    }

    /// What u is by what both hold; `last` where that leaves it open.
    #[must_use]
    pub fn back(&self, held: [f64; 2], last: f64) -> f64 {
        let (a_end, b_end) = self.ends();
        let [a, b] = held;
        let part = |value: f64, (from, to): (f64, f64)| limit((value - from) / (to - from), 0.0, 1.0);
        let (of_a, of_b) = (part(a, self.a), part(b, self.b));
        if of_b > REST {
            b_end + of_b * (RANGE.1 - b_end)
        } else if of_a < 1.0 - REST {
            RANGE.0 + of_a * (a_end - RANGE.0)
        } else if a_end < b_end {
            limit(last, a_end, b_end)
        } else {
            limit(last, b_end, a_end)
        }
    }
}

/// What is left of the difference between the curves and the actuators, one each.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Actuators {
    balances: [Balance; 2],
    /// What both were sent last.
    sent: [f64; 2],
    /// What is left of the differences in them.
    left: [f64; 2],
}

impl Actuators {
    /// Starts from what both hold.
    #[must_use]
    pub fn new(track: [f64; 2]) -> Self {
        Self {
            sent: track,
            ..Self::default()
        }
    }

    /// What both hold; what was sent stands in for one that cannot be read.
    #[must_use]
    pub fn held(&self, read: [Option<f64>; 2]) -> [f64; 2] {
        [read[0].unwrap_or(self.sent[0]), read[1].unwrap_or(self.sent[1])]
    }

    /// What both hold as the curves mean it: without what is left of the differences.
    #[must_use]
    pub const fn meant(&self, held: [f64; 2]) -> [f64; 2] {
        [held[0] - self.left[0], held[1] - self.left[1]]
    }

    /// What to send for u in automatic: first what is held, then the curves.
    pub fn send(&mut self, curves: &Curves, u: f64, held: [f64; 2], balance_s: f64, dt_s: f64) -> [f64; 2] {
        let natural = curves.both(u);
        for i in 0..2 {
            let sent = self.balances[i].release(natural[i], held[i], balance_s, dt_s);
            (self.sent[i], self.left[i]) = (sent, sent - natural[i]);
        }
        self.sent
    }

    /// Somebody else decides what both hold.
    pub fn follow(&mut self, curves: &Curves, u: f64, held: [f64; 2]) -> [f64; 2] {
        let natural = curves.both(u);
        for i in 0..2 {
            self.sent[i] = self.balances[i].follow(natural[i], held[i]);
            self.left[i] = 0.0;
        }
        self.sent
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const HEAT_AND_COOL: Curves = Curves {
        split: 50.0,
        gap: 10.0,
        a: (100.0, 0.0),
        b: (0.0, 100.0),
    };

    #[test]
    fn actuators_take_turns() {
        for (u, both) in [
            (-5.0, [100.0, 0.0]),
            (0.0, [100.0, 0.0]),
            (22.5, [50.0, 0.0]),
            (45.0, [0.0, 0.0]),
            (50.0, [0.0, 0.0]),
            (55.0, [0.0, 0.0]),
            (77.5, [0.0, 50.0]),
            (100.0, [0.0, 100.0]),
        ] {
            assert_eq!(HEAT_AND_COOL.both(u), both, "{u}");
        }
        assert_eq!(
            HEAT_AND_COOL.back([0.0, 0.0], 48.0),
            48.0,
            "within the gap it is the last"
        );
        assert_eq!(HEAT_AND_COOL.back([0.0, 0.0], 90.0), 55.0);
    }

    #[test]
    fn curves_that_cannot_be_are_refused() {
        for (curves, part) in [
            (
                Curves {
                    split: 4.0,
                    ..HEAT_AND_COOL
                },
                "no part of the range",
            ),
            (
                Curves {
                    a: (5.0, 5.0),
                    ..HEAT_AND_COOL
                },
                "must differ",
            ),
        ] {
            assert!(matches!(curves.check(), Err(Fault::BadParameter(text)) if text.contains(part)));
        }
    }

    proptest! {
        #[test]
        fn back_finds_what_both_came_from(u in 0.0..100.0f64, split in 20.0..80.0f64, gap in -10.0..10.0f64) {
            let curves = Curves { split, gap, ..HEAT_AND_COOL };
            let found = curves.back(curves.both(u), u);
            prop_assert!((found - u).abs() < 1e-6, "{found}");
        }
    }
}
