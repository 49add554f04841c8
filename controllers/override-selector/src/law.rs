//! Two PID blocks for one actuator, of which the lower or the higher wish counts: pure, without ports, clocks or bytes.
//!
//! ```text
//!   pv ───────► main ────┐
//!                        ├─► least, or greatest ─► output ─► actuator ─┐
//!   limit-pv ─► limit ───┘                                             │
//!        both integrals follow what the actuator holds (external reset) ◄┘
//! ```
//! The one that is not taken follows the actuator by its integral, so it is ready: when its measurement comes to its setpoint,
//! its wish meets the actuator's value, and the change is without a bump. Source: Shinskey, *Process Control Systems* (1996),
//! ch. 6; ISA-TR5.9-2023, external-reset feedback. Never: more than two.

use bumpless_isa::{Memory, Sample, Tuning};
use serde::{Deserialize, Serialize};

/// Which wish counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Select {
    /// The lower one.
    Low,
    /// The higher one.
    High,
}

/// The state: both blocks, and which one was taken.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pair {
    /// The block of the loop's own setpoint.
    pub main: Memory,
    /// The block that keeps the limit.
    pub limit: Memory,
    /// Was the limit's wish taken?
    pub limited: bool,
}

impl Pair {
    /// Starts from what the actuator holds.
    #[must_use]
    pub const fn new(track: f64) -> Self {
        Self {
            main: Memory::new(track),
            limit: Memory::new(track),
            limited: false,
        }
    }

    /// Takes one of two wishes; main's, where they are the same. Gives the output.
    pub const fn take(&mut self, select: Select, main: f64, limit: f64) -> f64 {
        self.limited = match select {
            Select::Low => limit < main,
            Select::High => limit > main,
        };
        let taken = if self.limited { limit } else { main };
        // Where the actuator cannot be read, both have sent what was taken.
        self.main.output = taken;
        self.limit.output = taken;
        taken
    }

    /// One step of both. Gives the output.
    #[must_use]
    pub fn step(
        &mut self,
        select: Select,
        (main, main_sample): (&Tuning, &Sample),
        (limit, limit_sample): (&Tuning, &Sample),
    ) -> f64 {
        let wish = self.main.step(main, main_sample);
        let other = self.limit.step(limit, limit_sample);
        self.take(select, wish, other)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lower_or_the_higher_wish_counts() {
        for (select, main, limit, taken, limited) in [
            (Select::Low, 10.0, 20.0, 10.0, false),
            (Select::Low, 20.0, 10.0, 10.0, true),
            (Select::High, 10.0, 20.0, 20.0, true),
            (Select::High, 20.0, 10.0, 20.0, false),
            (Select::High, 20.0, 20.0, 20.0, false),
        ] {
            let mut pair = Pair::new(0.0);
            assert_eq!(pair.take(select, main, limit), taken);
            assert_eq!(
                (pair.limited, pair.main.output, pair.limit.output),
                (limited, taken, taken)
            );
        }
    }

    #[test]
    fn a_limit_is_kept_and_left_again_without_windup() {
        // Two lags of the same actuator: pv of 10 s, limit-pv = 2·out of 2 s, which may be 100 at most.
        let (main, limit) = (Tuning::pi(2.0, 10.0, 0.0, 100.0), Tuning::pi(0.5, 2.0, 0.0, 100.0));
        let mut pair = Pair::new(20.0);
        let (mut y, mut x, mut out, mut worst) = (20.0, 40.0, 20.0, 0.0_f64);
        let mut run = |setpoint: f64, seconds: u32| {
            let mut limited = false;
            for _ in 0..seconds * 10 {
                let main_sample = Sample::automatic(y, setpoint, Some(out), 0.1);
                let limit_sample = Sample::automatic(x, 100.0, Some(out), 0.1);
                out = pair.step(Select::Low, (&main, &main_sample), (&limit, &limit_sample));
                y += (out - y) * 0.1 / 10.0;
                x += (2.0 * out - x) * 0.1 / 2.0;
                worst = worst.max(x);
                limited = pair.limited;
            }
            (y, limited, worst)
        };
        let (y, limited, worst) = run(80.0, 600);
        assert!((y - 50.0).abs() < 0.1 && limited, "held at the limit: {y}");
        assert!(worst < 104.0, "{worst}");
        let (y, limited, _) = run(30.0, 120);
        assert!((y - 30.0).abs() < 0.1 && !limited, "and free again: {y}");
    }
}
