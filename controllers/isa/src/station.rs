//! What laws without an integral share: following, balance, limits, and their ports and parameters.
//!
//! ```text
//!   natural value ─► balance (bumpless) ─► rate limit ─► limits ─► output
//! ```
//! Owns the end of such a law's table; the law's own rows come first, and [`Handles`] finds the shared ones by name.
//! Never: what the natural value is.

use bumpless_sdk::{
    Cycle, Fault, Input, Io, Output, Parameter, ParameterSpec, Parameters, PortSpec,
    blocks::{Balance, limit, rate_limit},
};
use serde::{Deserialize, Serialize};

use crate::{block, law::Demand};

/// The shared ports.
pub const PORTS: &[PortSpec] = &[
    PortSpec::analog_output("out", "", "To the actuator; its reading is what the actuator holds").required(),
    PortSpec::analog_input("track", "", "Value that the output follows while track-on is on"),
    PortSpec::digital_input("track-on", "Makes the output follow the track input"),
];

/// The shared parameters.
pub const PARAMETERS: &[ParameterSpec] = &[
    ParameterSpec::number("out-low", "out", 0.0, -1e9, 1e9, "Least output"),
    ParameterSpec::number("out-high", "out", 100.0, -1e9, 1e9, "Greatest output"),
    ParameterSpec::number(
        "out-rate",
        "out/s",
        0.0,
        0.0,
        1e9,
        "Greatest change of the output per second; 0 for no limit",
    ),
    ParameterSpec::number(
        "balance-time",
        "s",
        10.0,
        0.0,
        1e6,
        "Time constant with which the output leaves what it started from",
    ),
];

/// The shared rows in a law's own tables.
#[derive(Debug, Clone, Copy)]
pub struct Handles {
    /// To the actuator.
    pub out: Output,
    track: Input,
    track_on: Input,
    low: Parameter,
    high: Parameter,
    rate: Parameter,
    balance: Parameter,
}

impl Handles {
    /// Looks them up; stops the build where one is missing.
    #[must_use]
    pub const fn of(ports: &[PortSpec], parameters: &[ParameterSpec]) -> Self {
        Self {
            out: Output::of(ports, "out"),
            track: Input::of(ports, "track"),
            track_on: Input::of(ports, "track-on"),
            low: Parameter::of(parameters, "out-low"),
            high: Parameter::of(parameters, "out-high"),
            rate: Parameter::of(parameters, "out-rate"),
            balance: Parameter::of(parameters, "balance-time"),
        }
    }

    /// The limits of the output.
    #[must_use]
    pub fn limits(&self, p: &Parameters<'_>) -> Limits {
        Limits {
            low: p.of(self.low),
            high: p.of(self.high),
            rate_per_s: p.of(self.rate),
            balance_s: p.of(self.balance),
        }
    }

    /// What the actuator holds, and who decides. `last` stands in for an actuator that cannot be read.
    #[must_use]
    pub fn demand(&self, last: f64, cycle: &Cycle, io: &Io<'_>) -> (f64, Demand) {
        let held = block::held(io, self.out);
        let demand = block::demand(last, cycle, io, held, (self.track, self.track_on));
        (held.unwrap_or(last), demand)
    }
}

/// Between what the output stays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Least output.
    pub low: f64,
    /// Greatest output.
    pub high: f64,
    /// Greatest change per second; 0 for none.
    pub rate_per_s: f64,
    /// Time constant with which the difference at a transfer fades, s.
    pub balance_s: f64,
}

impl Limits {
    /// The rule between them; [`Fault::BadParameter`] where it is broken.
    pub fn check(&self) -> Result<(), Fault> {
        if self.low < self.high {
            Ok(())
        } else {
            Err(Fault::bad_parameter("out-low must be less than out-high"))
        }
    }
}

/// The state of the station.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Station {
    balance: Balance,
    /// The natural value of the last step.
    natural: f64,
    /// The last output; stands in for an actuator that cannot be read.
    pub output: f64,
}

impl Station {
    /// Starts from what the actuator holds.
    #[must_use]
    pub fn new(track: f64) -> Self {
        Self {
            balance: Balance::default(),
            natural: track,
            output: track,
        }
    }

    /// One step: the output for a natural value. What is followed is followed exactly.
    pub fn step(&mut self, natural: f64, limits: &Limits, demand: Demand, held: f64, dt_s: f64) -> f64 {
        self.natural = natural;
        self.output = match demand {
            Demand::Follow(value) => self.balance.follow(natural, value),
            Demand::Automatic => {
                let wanted = self.balance.release(natural, held, limits.balance_s, dt_s);
                let reached = rate_limit(wanted, held, limits.rate_per_s, dt_s);
                limit(reached, limits.low, limits.high)
            }
        };
        self.output
    }

    /// Without an input there is no natural value: follows.
    pub fn follow_blind(&mut self, value: f64) {
        *self = Self::new(value);
    }

    /// The law would have said another natural value for the last inputs: the output goes on from where it was.
    pub const fn retune(&mut self, natural_now: f64) {
        self.balance.shift(self.natural, natural_now);
        self.natural = natural_now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits {
        low: 0.0,
        high: 100.0,
        rate_per_s: 0.0,
        balance_s: 10.0,
    };

    #[test]
    fn it_starts_from_what_is_held_follows_and_stays_within_its_limits() {
        let mut station = Station::new(40.0);
        assert_eq!(station.step(70.0, &LIMITS, Demand::Automatic, 40.0, 1.0), 40.0);
        let second = station.step(70.0, &LIMITS, Demand::Automatic, 40.0, 1.0);
        assert!((second - (70.0 - 30.0 * (-0.1f64).exp())).abs() < 1e-12);
        assert_eq!(station.step(70.0, &LIMITS, Demand::Follow(12.5), second, 1.0), 12.5);
        assert_eq!(station.step(500.0, &LIMITS, Demand::Automatic, 12.5, 1.0), 12.5);
        for _ in 0..200 {
            station.step(500.0, &LIMITS, Demand::Automatic, station.output, 1.0);
        }
        assert_eq!(station.output, 100.0);
        let slow = Limits {
            rate_per_s: 2.0,
            ..LIMITS
        };
        assert_eq!(station.step(0.0, &slow, Demand::Automatic, 100.0, 0.5), 99.0);
        assert!(
            Limits {
                low: 3.0,
                high: 3.0,
                ..LIMITS
            }
            .check()
            .is_err()
        );
    }

    #[test]
    fn another_natural_value_does_not_move_the_output() {
        let mut station = Station::new(40.0);
        for _ in 0..3 {
            station.step(70.0, &LIMITS, Demand::Automatic, station.output, 1.0);
        }
        let before = station.output;
        station.retune(20.0);
        let after = station.step(20.0, &LIMITS, Demand::Automatic, before, 1e-9);
        assert!((after - before).abs() < 1e-6);
    }
}
