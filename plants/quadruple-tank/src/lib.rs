//! The plant `quadruple-tank`: two pumps, four tanks, and a zero that two valves put on either side of the axis.
//!
//! ```text
//!   A1·h1' = −a1·√(2g·h1) + a3·√(2g·h3) + γ1·k1·v1          A3·h3' = −a3·√(2g·h3) + (1 − γ2)·k2·v2
//!   A2·h2' = −a2·√(2g·h2) + a4·√(2g·h4) + γ2·k2·v2          A4·h4' = −a4·√(2g·h4) + (1 − γ1)·k1·v1
//! ```
//! K. H. Johansson, "The quadruple-tank process: a multivariable laboratory process with an adjustable zero", IEEE
//! Transactions on Control Systems Technology 8(3), 2000. With 1 < γ1 + γ2 < 2 it has minimum phase (the constants'
//! defaults: γ = 0.70, 0.60, k = 3.33, 3.35); with 0 < γ1 + γ2 < 1 one zero lies in the right half plane (γ = 0.43, 0.34,
//! k = 3.14, 3.29, start voltages 3.15). Units: cm, s, V.
//!
//! Never: a level below 0; a full tank is not modelled.

use bumpless_sdk::plant::prelude::*;

/// Longest step of the integration, in s: a 200th of the shortest time constant is 0.1 s.
const STEP_S: f64 = 0.1;
/// Gravity, in cm/s².
const G: f64 = 981.0;

/// The signals.
pub const SIGNALS: &[SignalSpec] = &[
    SignalSpec::measures("h1", "cm", (0.0, 40.0), "Level of tank 1, below on the left"),
    SignalSpec::measures("h2", "cm", (0.0, 40.0), "Level of tank 2, below on the right"),
    SignalSpec::measures("h3", "cm", (0.0, 40.0), "Level of tank 3, above tank 1"),
    SignalSpec::measures("h4", "cm", (0.0, 40.0), "Level of tank 4, above tank 2"),
    SignalSpec::sets("v1", "V", (0.0, 10.0), 3.0, "Pump 1, to tanks 1 and 4"),
    SignalSpec::sets("v2", "V", (0.0, 10.0), 3.0, "Pump 2, to tanks 2 and 3"),
    SignalSpec::disturbs("leak1", "cm3/s", (0.0, 20.0), 0.0, "Leak of tank 1"),
    SignalSpec::disturbs("leak2", "cm3/s", (0.0, 20.0), 0.0, "Leak of tank 2"),
];
const LEVELS: [Signal; 4] = [
    Signal::of(SIGNALS, "h1"),
    Signal::of(SIGNALS, "h2"),
    Signal::of(SIGNALS, "h3"),
    Signal::of(SIGNALS, "h4"),
];
const V: [Signal; 2] = [Signal::of(SIGNALS, "v1"), Signal::of(SIGNALS, "v2")];
const LEAKS: [Signal; 2] = [Signal::of(SIGNALS, "leak1"), Signal::of(SIGNALS, "leak2")];

/// The constants.
pub const CONSTANTS: &[ConstantSpec] = &[
    ConstantSpec::new("area1", "cm2", 28.0, 1.0, 1e4, "Cross section of tanks 1 and 3"),
    ConstantSpec::new("area2", "cm2", 32.0, 1.0, 1e4, "Cross section of tanks 2 and 4"),
    ConstantSpec::new("hole1", "cm2", 0.071, 1e-4, 10.0, "Outlet of tanks 1 and 3"),
    ConstantSpec::new("hole2", "cm2", 0.057, 1e-4, 10.0, "Outlet of tanks 2 and 4"),
    ConstantSpec::new("k1", "cm3/(V s)", 3.33, 0.01, 100.0, "Flow of pump 1 per volt"),
    ConstantSpec::new("k2", "cm3/(V s)", 3.35, 0.01, 100.0, "Flow of pump 2 per volt"),
    ConstantSpec::new(
        "gamma1",
        "",
        0.70,
        0.01,
        0.99,
        "Part of pump 1's flow that goes to tank 1",
    ),
    ConstantSpec::new(
        "gamma2",
        "",
        0.60,
        0.01,
        0.99,
        "Part of pump 2's flow that goes to tank 2",
    ),
    ConstantSpec::new(
        "start-v1",
        "V",
        3.0,
        0.0,
        10.0,
        "Voltage of pump 1 whose steady state is the start",
    ),
    ConstantSpec::new(
        "start-v2",
        "V",
        3.0,
        0.0,
        10.0,
        "Voltage of pump 2 whose steady state is the start",
    ),
    ConstantSpec::new(
        "noise",
        "cm",
        0.0,
        0.0,
        10.0,
        "Standard deviation of the instruments' noise",
    ),
];

macro_rules! handles {
    ($($handle:ident = $name:literal;)*) => {
        $(const $handle: Constant = Constant::of(CONSTANTS, $name);)*
    };
}
handles! {
    AREA1 = "area1";
    AREA2 = "area2";
    HOLE1 = "hole1";
    HOLE2 = "hole2";
    K1 = "k1";
    K2 = "k2";
    GAMMA1 = "gamma1";
    GAMMA2 = "gamma2";
    START_V1 = "start-v1";
    START_V2 = "start-v2";
    NOISE = "noise";
}

/// The tanks.
#[derive(Debug)]
pub struct QuadrupleTank {
    area: [f64; 4],
    hole: [f64; 4],
    k: [f64; 2],
    gamma: [f64; 2],
    noise: f64,
    seed: u64,
    now_s: f64,
    levels: [f64; 4],
}

impl QuadrupleTank {
    /// What pumps at `v`, in V, bring to each tank, in cm³/s.
    fn inflow(&self, v: [f64; 2]) -> [f64; 4] {
        let [q1, q2] = [self.k[0] * v[0], self.k[1] * v[1]];
        let [g1, g2] = self.gamma;
        [g1 * q1, g2 * q2, (1.0 - g2) * q2, (1.0 - g1) * q1]
    }

    /// h', in cm/s, at levels `h` (cm), voltages `v` and leaks (cm³/s).
    fn rate(&self, h: &[f64; 4], v: [f64; 2], leaks: [f64; 2]) -> [f64; 4] {
        let mut out = [0.0; 4];
        for (i, q) in out.iter_mut().enumerate() {
            *q = self.hole[i] * (2.0 * G * h[i].max(0.0)).sqrt();
        }
        let inflow = self.inflow(v);
        let leak = |i: usize| if h[i] > 0.0 { leaks[i] } else { 0.0 };
        [
            (inflow[0] + out[2] - out[0] - leak(0)) / self.area[0],
            (inflow[1] + out[3] - out[1] - leak(1)) / self.area[1],
            (inflow[2] - out[2]) / self.area[2],
            (inflow[3] - out[3]) / self.area[3],
        ]
    }

    /// Levels at which nothing moves, for voltages `v`.
    fn steady(&self, v: [f64; 2]) -> [f64; 4] {
        let q = self.inflow(v);
        // All that comes into the upper tanks goes on to the lower ones.
        let through = [q[0] + q[2], q[1] + q[3], q[2], q[3]];
        let mut h = [0.0; 4];
        for (i, level) in h.iter_mut().enumerate() {
            *level = (through[i] / self.hole[i]).powi(2) / (2.0 * G);
        }
        h
    }
}

impl Plant for QuadrupleTank {
    const DESCRIPTION: PlantDescription = PlantDescription {
        name: "quadruple-tank",
        version: env!("CARGO_PKG_VERSION"),
        text: "Johansson's four tanks with an adjustable zero",
        signals: SIGNALS,
        constants: CONSTANTS,
    };

    fn begin(c: &Constants<'_>, seed: u64) -> Result<Self, Fault> {
        let (area, hole) = ([c.of(AREA1), c.of(AREA2)], [c.of(HOLE1), c.of(HOLE2)]);
        let mut tanks = Self {
            area: [area[0], area[1], area[0], area[1]],
            hole: [hole[0], hole[1], hole[0], hole[1]],
            k: [c.of(K1), c.of(K2)],
            gamma: [c.of(GAMMA1), c.of(GAMMA2)],
            noise: c.of(NOISE),
            seed,
            now_s: 0.0,
            levels: [0.0; 4],
        };
        tanks.levels = tanks.steady([c.of(START_V1), c.of(START_V2)]);
        Ok(tanks)
    }

    fn advance(&mut self, dt_s: f64, inputs: &Inputs<'_>) -> Result<(), Fault> {
        let v = V.map(|signal| inputs.of(signal));
        let leaks = LEAKS.map(|signal| inputs.of(signal));
        let mut levels = self.levels;
        runge_kutta(&mut levels, dt_s, STEP_S, |h| self.rate(h, v, leaks));
        self.levels = levels.map(|h| h.max(0.0));
        self.now_s += dt_s;
        Ok(())
    }

    fn show(&self, view: &mut View<'_>) {
        let moment = (self.now_s * 1e3).round() as u64;
        for (n, (signal, h)) in LEVELS.into_iter().zip(self.levels).enumerate() {
            view.set_shown(signal, h, h + self.noise * noise(self.seed, n as u64, moment));
        }
    }
}

bumpless_sdk::export_plant!(QuadrupleTank);

#[cfg(test)]
mod tests;
