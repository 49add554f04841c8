//! The plant `integrating`: what flows in stays, as in a tank whose outflow is pumped; with dead time.
//!
//! ```text
//!   dy/dt = gain · (u(t − dead-time) + load)         y stays within low and high, as a vessel does
//! ```
//! Never: steps; the exact solution is used for each stretch in which nothing changes.

use std::collections::VecDeque;

use bumpless_sdk::plant::prelude::*;

/// Changes on their way; beyond it the latest is replaced.
const CHANGES_MAX: usize = 100_000;

/// The signals.
pub const SIGNALS: &[SignalSpec] = &[
    SignalSpec::measures("pv", "", (-1e6, 1e6), "Measurement, for example a level"),
    SignalSpec::sets("out", "", (-1e6, 1e6), 0.0, "Output of the controller"),
    SignalSpec::disturbs("load", "", (-1e6, 1e6), 0.0, "Load at the process's input"),
];
const PV: Signal = Signal::of(SIGNALS, "pv");
const OUT: Signal = Signal::of(SIGNALS, "out");
const LOAD: Signal = Signal::of(SIGNALS, "load");

/// The constants.
pub const CONSTANTS: &[ConstantSpec] = &[
    ConstantSpec::new(
        "gain",
        "pv/(out s)",
        1.0,
        -1e6,
        1e6,
        "Rate of the measurement per unit of the input",
    ),
    ConstantSpec::new("dead-time", "s", 0.1, 0.0, 600.0, "Dead time"),
    ConstantSpec::new("start", "pv", 0.0, -1e6, 1e6, "Measurement at the start"),
    ConstantSpec::new("low", "pv", -1e6, -1e6, 1e6, "Least measurement: empty"),
    ConstantSpec::new("high", "pv", 1e6, -1e6, 1e6, "Greatest measurement: full"),
    ConstantSpec::new(
        "noise",
        "pv",
        0.0,
        0.0,
        1e6,
        "Standard deviation of the instrument's noise",
    ),
];
const GAIN: Constant = Constant::of(CONSTANTS, "gain");
const DEAD_TIME: Constant = Constant::of(CONSTANTS, "dead-time");
const START: Constant = Constant::of(CONSTANTS, "start");
const LOW: Constant = Constant::of(CONSTANTS, "low");
const HIGH: Constant = Constant::of(CONSTANTS, "high");
const NOISE: Constant = Constant::of(CONSTANTS, "noise");

/// A vessel.
#[derive(Debug)]
struct Integrating {
    gain: f64,
    dead_s: f64,
    low: f64,
    high: f64,
    noise: f64,
    seed: u64,
    now_s: f64,
    y: f64,
    last: f64,
    acting: f64,
    waiting: VecDeque<(f64, f64)>,
}

impl Integrating {
    fn pass(&mut self, dt_s: f64) {
        self.y = (self.y + self.gain * self.acting * dt_s).max(self.low).min(self.high);
    }
}

impl Plant for Integrating {
    const DESCRIPTION: PlantDescription = PlantDescription {
        name: "integrating",
        version: env!("CARGO_PKG_VERSION"),
        text: "Integrating process with dead time",
        signals: SIGNALS,
        constants: CONSTANTS,
    };

    fn begin(c: &Constants<'_>, seed: u64) -> Result<Self, Fault> {
        let (low, high) = (c.of(LOW), c.of(HIGH));
        if low >= high {
            return Err(Fault::bad_parameter("low must be less than high"));
        }
        Ok(Self {
            gain: c.of(GAIN),
            dead_s: c.of(DEAD_TIME),
            low,
            high,
            noise: c.of(NOISE),
            seed,
            now_s: 0.0,
            y: c.of(START).max(low).min(high),
            last: 0.0,
            acting: 0.0,
            waiting: VecDeque::new(),
        })
    }

    fn advance(&mut self, dt_s: f64, inputs: &Inputs<'_>) -> Result<(), Fault> {
        let input = inputs.of(OUT) + inputs.of(LOAD);
        // Bits, on purpose: whatever is set anew is a change.
        if input.to_bits() != self.last.to_bits() {
            self.last = input;
            let full = self.waiting.len() >= CHANGES_MAX;
            match self.waiting.back_mut() {
                Some(last) if full => last.1 = input,
                _ => self.waiting.push_back((self.now_s + self.dead_s, input)),
            }
        }
        let end_s = self.now_s + dt_s;
        while let Some((at_s, value)) = self.waiting.front().copied().filter(|(at_s, _)| *at_s <= end_s) {
            self.waiting.pop_front();
            let dt_s = (at_s - self.now_s).max(0.0);
            self.pass(dt_s);
            self.now_s += dt_s;
            self.acting = value;
        }
        self.pass((end_s - self.now_s).max(0.0));
        self.now_s = end_s;
        Ok(())
    }

    fn show(&self, view: &mut View<'_>) {
        let moment = (self.now_s * 1e3).round() as u64;
        view.set_shown(PV, self.y, self.y + self.noise * noise(self.seed, 1, moment));
    }
}

bumpless_sdk::export_plant!(Integrating);

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn it_ramps_after_its_dead_time_and_stops_at_full() {
        let mut plant = Running::<Integrating>::begin(&[2.0, 1.0, 3.0, 0.0, 10.0, 0.0], 0).unwrap();
        let inputs = [0.0, 0.5, 0.0];
        plant.advance(1_000_000_000, &inputs).unwrap();
        assert!((plant.truth()[0] - 3.0).abs() < 1e-9);
        plant.advance(2_000_000_000, &inputs).unwrap();
        assert!((plant.truth()[0] - 5.0).abs() < 1e-9);
        plant.advance(60_000_000_000, &inputs).unwrap();
        assert!((plant.truth()[0] - 10.0).abs() < 1e-9);
    }

    #[test]
    fn a_vessel_without_room_is_refused() {
        assert!(Running::<Integrating>::begin(&[1.0, 0.0, 0.0, 5.0, 5.0, 0.0], 0).is_err());
    }
}
