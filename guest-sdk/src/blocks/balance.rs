//! Bumpless transfer for laws without an integral: a difference that fades.
//!
//! ```text
//!            follow                     release
//!   Following ◄──── difference = held − natural ────► Released: natural + difference; the difference fades
//! ```
//! *Natural* is what the law itself would say. The first released value is exactly what was held; from then on the difference
//! goes to 0 with the balance time, as `BAL_TIME` of the Foundation Fieldbus blocks does. With a balance time of 0 it goes in
//! the step after. Never: limits; those come after it.

use serde::{Deserialize, Serialize};

use super::lag_part;

/// The difference, and who decides.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Balance {
    difference: f64,
    released: bool,
}

impl Balance {
    /// Somebody else decides: gives what is held.
    pub const fn follow(&mut self, natural: f64, held: f64) -> f64 {
        self.difference = held - natural;
        self.released = false;
        held
    }

    /// The law decides: what is held in the first step, then the natural value and what is left of the difference.
    /// `time_s` ≥ 0 is the balance time, `dt_s` > 0 the time since the step before.
    pub fn release(&mut self, natural: f64, held: f64, time_s: f64, dt_s: f64) -> f64 {
        if self.released {
            self.difference -= self.difference * lag_part(time_s, dt_s);
            natural + self.difference
        } else {
            self.released = true;
            self.difference = held - natural;
            held
        }
    }

    /// The law changed between two steps, and so did what it says: the output goes on.
    pub const fn shift(&mut self, natural_before: f64, natural_now: f64) {
        self.difference += natural_before - natural_now;
    }

    /// Does the law decide?
    #[must_use]
    pub const fn is_released(&self) -> bool {
        self.released
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_value_is_what_was_held_and_the_difference_fades() {
        let mut balance = Balance::default();
        assert_eq!(balance.follow(3.0, 40.0), 40.0);
        assert_eq!(balance.release(5.0, 41.0, 10.0, 1.0), 41.0);
        for i in 1..50 {
            let expected = 5.0 + 36.0 * (-f64::from(i) / 10.0).exp();
            assert!((balance.release(5.0, 0.0, 10.0, 1.0) - expected).abs() < 1e-9);
        }
        balance.shift(5.0, 9.0);
        let before = 5.0 + 36.0 * (-4.9f64).exp();
        let after = balance.release(9.0, 0.0, 10.0, 1.0);
        assert!((after - 9.0 - (before - 9.0) * (-0.1f64).exp()).abs() < 1e-9, "{after}");
    }

    #[test]
    fn without_a_balance_time_the_second_value_is_the_laws_own() {
        let mut balance = Balance::default();
        assert_eq!(balance.release(5.0, 41.0, 0.0, 1.0), 41.0);
        assert_eq!(balance.release(6.0, 41.0, 0.0, 1.0), 6.0);
        assert!(balance.is_released());
    }
}
