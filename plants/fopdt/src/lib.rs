//! The plant `fopdt`: a first-order lag with dead time, solved exactly between the changes of its input.
//!
//! ```text
//!   tau · dy/dt + (y − y0) = gain · (u(t − dead-time) + load)         y0: value at rest
//! ```
//! Never: steps; the exact solution is used for each stretch in which nothing changes.

use std::collections::VecDeque;

use bumpless_sdk::plant::prelude::*;

/// Changes on their way; beyond it the latest is replaced. 100,000 changes at 10 ms reach through 1,000 s.
const CHANGES_MAX: usize = 100_000;

/// The signals.
pub const SIGNALS: &[SignalSpec] = &[
    SignalSpec::measures("pv", "", (-1e6, 1e6), "Measurement"),
    SignalSpec::sets("out", "", (-1e6, 1e6), 0.0, "Output of the controller"),
    SignalSpec::disturbs("load", "", (-1e6, 1e6), 0.0, "Load at the process's input"),
];
const PV: Signal = Signal::of(SIGNALS, "pv");
const OUT: Signal = Signal::of(SIGNALS, "out");
const LOAD: Signal = Signal::of(SIGNALS, "load");

/// The constants.
pub const CONSTANTS: &[ConstantSpec] = &[
    ConstantSpec::new("gain", "pv/out", 1.0, -1e6, 1e6, "Gain"),
    ConstantSpec::new("tau", "s", 1.0, 1e-3, 1e6, "Time constant"),
    ConstantSpec::new("dead-time", "s", 0.1, 0.0, 600.0, "Dead time"),
    ConstantSpec::new(
        "rest",
        "pv",
        0.0,
        -1e6,
        1e6,
        "Measurement at rest, without output and load",
    ),
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
const TAU: Constant = Constant::of(CONSTANTS, "tau");
const DEAD_TIME: Constant = Constant::of(CONSTANTS, "dead-time");
const REST: Constant = Constant::of(CONSTANTS, "rest");
const NOISE: Constant = Constant::of(CONSTANTS, "noise");

/// Inputs on their way through a dead time.
#[derive(Debug)]
struct Fopdt {
    gain: f64,
    tau_s: f64,
    dead_s: f64,
    rest: f64,
    noise: f64,
    seed: u64,
    now_s: f64,
    y: f64,
    last: f64,
    acting: f64,
    waiting: VecDeque<(f64, f64)>,
}

impl Fopdt {
    fn pass(&mut self, dt_s: f64) {
        let end = self.rest + self.gain * self.acting;
        self.y = end + (self.y - end) * (-dt_s / self.tau_s).exp();
    }
}

impl Plant for Fopdt {
    const DESCRIPTION: PlantDescription = PlantDescription {
        name: "fopdt",
        version: env!("CARGO_PKG_VERSION"),
        text: "First-order lag with dead time",
        signals: SIGNALS,
        constants: CONSTANTS,
    };

    fn begin(c: &Constants<'_>, seed: u64) -> Result<Self, Fault> {
        Ok(Self {
            gain: c.of(GAIN),
            tau_s: c.of(TAU),
            dead_s: c.of(DEAD_TIME),
            rest: c.of(REST),
            noise: c.of(NOISE),
            seed,
            now_s: 0.0,
            y: c.of(REST),
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
        // One value of noise per ms, so that to look twice shows the same.
        let moment = (self.now_s * 1e3).round() as u64;
        view.set_shown(PV, self.y, self.y + self.noise * noise(self.seed, 1, moment));
    }
}

bumpless_sdk::export_plant!(Fopdt);

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn a_step_shows_dead_time_gain_and_time_constant() {
        let mut plant = Running::<Fopdt>::begin(&[2.0, 4.0, 1.5, 10.0, 0.0], 0).unwrap();
        let inputs = [0.0, 5.0, 0.0];
        plant.advance(1_500_000_000, &inputs).unwrap();
        assert!((plant.truth()[0] - 10.0).abs() < 1e-9);
        plant.advance(4_000_000_000, &inputs).unwrap();
        assert!((plant.truth()[0] - 10.0 - 10.0 * (1.0 - (-1.0_f64).exp())).abs() < 1e-9);
        // In a thousand pieces it is the same.
        let mut pieces = Running::<Fopdt>::begin(&[2.0, 4.0, 1.5, 10.0, 0.0], 0).unwrap();
        for _ in 0..5500 {
            pieces.advance(1_000_000, &inputs).unwrap();
        }
        assert!((pieces.truth()[0] - plant.truth()[0]).abs() < 1e-6);
    }

    #[test]
    fn noise_depends_on_the_seed_and_not_on_who_looks() {
        let shown = |seed| {
            let mut plant = Running::<Fopdt>::begin(&[1.0, 1.0, 0.0, 0.0, 0.5], seed).unwrap();
            plant.advance(1_000_000_000, &[0.0; 3]).unwrap();
            plant.advance(0, &[0.0; 3]).unwrap();
            plant.shown()[0]
        };
        assert_eq!(shown(3).to_bits(), shown(3).to_bits());
        assert_ne!(shown(3).to_bits(), shown(4).to_bits());
    }
}
