//! The plant `cstr`: a stirred tank with a first-order exothermic reaction A → B and a cooling jacket, which runs away when it
//! is left alone.
//!
//! ```text
//!   c' = q/V·(cf − c) − k(T)·c                                                   k(T) = k0·e^(−E/(R·T))
//!   T' = q/V·(Tf − T) + ΔH/(ρ·Cp)·k(T)·c − UA/(V·ρ·Cp)·(T − Tc)
//! ```
//! D. E. Seborg, T. F. Edgar, D. A. Mellichamp, "Process Dynamics and Control", Wiley, example of the nonlinear reactor: q =
//! 100 L/min, V = 100 L, ρ = 1000 g/L, Cp = 0.239 J/(g K), ΔH = 5·10⁴ J/mol, E/R = 8750 K, k0 = 7.2·10¹⁰ 1/min, UA = 5·10⁴
//! J/(min K), cf = 1 mol/L, Tf = 350 K; at Tc = 300 K it rests, unstably, at c = 0.5 mol/L and T = 350 K. The jacket
//! follows its command with a lag of its own, which the book leaves out; 0 takes it away.
//!
//! Never: minutes inside; everything here is in seconds.

use bumpless_sdk::plant::prelude::*;

/// Longest step of the integration, in s: the reaction's own time at 400 K is about 3 s.
const STEP_S: f64 = 0.05;
const S_PER_MIN: f64 = 60.0;

/// The signals.
pub const SIGNALS: &[SignalSpec] = &[
    SignalSpec::measures("temperature", "K", (250.0, 550.0), "Temperature of the reactor"),
    SignalSpec::measures(
        "concentration",
        "mol/L",
        (0.0, 2.0),
        "Concentration of A in the reactor",
    ),
    SignalSpec::sets("coolant", "K", (250.0, 350.0), 300.0, "Temperature of the jacket"),
    SignalSpec::disturbs(
        "feed-temperature",
        "K",
        (300.0, 400.0),
        350.0,
        "Temperature of the feed",
    ),
    SignalSpec::disturbs(
        "feed-concentration",
        "mol/L",
        (0.0, 2.0),
        1.0,
        "Concentration of A in the feed",
    ),
];
const TEMPERATURE: Signal = Signal::of(SIGNALS, "temperature");
const CONCENTRATION: Signal = Signal::of(SIGNALS, "concentration");
const COOLANT: Signal = Signal::of(SIGNALS, "coolant");
const FEED_TEMPERATURE: Signal = Signal::of(SIGNALS, "feed-temperature");
const FEED_CONCENTRATION: Signal = Signal::of(SIGNALS, "feed-concentration");

/// The constants.
pub const CONSTANTS: &[ConstantSpec] = &[
    ConstantSpec::new("flow", "L/min", 100.0, 0.1, 1e4, "Flow through the reactor"),
    ConstantSpec::new("volume", "L", 100.0, 0.1, 1e5, "Volume of the reactor"),
    ConstantSpec::new("density", "g/L", 1000.0, 1.0, 1e4, "Density"),
    ConstantSpec::new("heat-capacity", "J/(g K)", 0.239, 0.01, 10.0, "Heat capacity"),
    ConstantSpec::new("reaction-heat", "J/mol", 5e4, 0.0, 1e6, "Heat that a mole gives off"),
    ConstantSpec::new(
        "activation",
        "K",
        8750.0,
        0.0,
        1e5,
        "Activation energy over the gas constant",
    ),
    ConstantSpec::new(
        "rate",
        "1/min",
        7.2e10,
        0.0,
        1e20,
        "Rate constant at infinite temperature",
    ),
    ConstantSpec::new(
        "heat-transfer",
        "J/(min K)",
        5e4,
        0.0,
        1e8,
        "Heat transfer to the jacket",
    ),
    ConstantSpec::new("jacket-lag", "s", 0.0, 0.0, 600.0, "Time constant of the jacket"),
    ConstantSpec::new(
        "start-temperature",
        "K",
        350.0,
        250.0,
        550.0,
        "Temperature at the start",
    ),
    ConstantSpec::new(
        "start-concentration",
        "mol/L",
        0.5,
        0.0,
        2.0,
        "Concentration at the start",
    ),
    ConstantSpec::new(
        "noise",
        "K",
        0.0,
        0.0,
        10.0,
        "Standard deviation of the thermometer's noise",
    ),
];

macro_rules! handles {
    ($($handle:ident = $name:literal;)*) => {
        $(const $handle: Constant = Constant::of(CONSTANTS, $name);)*
    };
}
handles! {
    FLOW = "flow";
    VOLUME = "volume";
    DENSITY = "density";
    HEAT_CAPACITY = "heat-capacity";
    REACTION_HEAT = "reaction-heat";
    ACTIVATION = "activation";
    RATE = "rate";
    HEAT_TRANSFER = "heat-transfer";
    JACKET_LAG = "jacket-lag";
    START_TEMPERATURE = "start-temperature";
    START_CONCENTRATION = "start-concentration";
    NOISE = "noise";
}

/// The reactor.
#[derive(Debug)]
pub struct Cstr {
    /// q/V, in 1/s.
    flow_s: f64,
    /// k0, in 1/s.
    rate_s: f64,
    activation_k: f64,
    /// ΔH/(ρ·Cp), in K·L/mol.
    rise_k: f64,
    /// UA/(V·ρ·Cp), in 1/s.
    cooling_s: f64,
    jacket_lag_s: f64,
    noise_k: f64,
    seed: u64,
    now_s: f64,
    /// Concentration, temperature, jacket.
    state: [f64; 3],
}

impl Cstr {
    /// Rates of concentration and temperature, per s.
    fn rate(&self, [c, t]: [f64; 2], jacket: f64, feed_c: f64, feed_t: f64) -> [f64; 2] {
        let reaction = self.rate_s * (-self.activation_k / t).exp() * c;
        [
            self.flow_s * (feed_c - c) - reaction,
            self.flow_s * (feed_t - t) + self.rise_k * reaction - self.cooling_s * (t - jacket),
        ]
    }
}

impl Plant for Cstr {
    const DESCRIPTION: PlantDescription = PlantDescription {
        name: "cstr",
        version: env!("CARGO_PKG_VERSION"),
        text: "Stirred tank reactor with an exothermic reaction",
        signals: SIGNALS,
        constants: CONSTANTS,
    };

    fn begin(c: &Constants<'_>, seed: u64) -> Result<Self, Fault> {
        let heat = c.of(DENSITY) * c.of(HEAT_CAPACITY);
        Ok(Self {
            flow_s: c.of(FLOW) / c.of(VOLUME) / S_PER_MIN,
            rate_s: c.of(RATE) / S_PER_MIN,
            activation_k: c.of(ACTIVATION),
            rise_k: c.of(REACTION_HEAT) / heat,
            cooling_s: c.of(HEAT_TRANSFER) / (c.of(VOLUME) * heat) / S_PER_MIN,
            jacket_lag_s: c.of(JACKET_LAG),
            noise_k: c.of(NOISE),
            seed,
            now_s: 0.0,
            state: [c.of(START_CONCENTRATION), c.of(START_TEMPERATURE), 300.0],
        })
    }

    fn advance(&mut self, dt_s: f64, inputs: &Inputs<'_>) -> Result<(), Fault> {
        let (feed_t, feed_c) = (inputs.of(FEED_TEMPERATURE), inputs.of(FEED_CONCENTRATION));
        let (coolant, lag_s) = (inputs.of(COOLANT), self.jacket_lag_s);
        let mut state = self.state;
        if lag_s <= 0.0 {
            state[2] = coolant;
        }
        // A jacket quicker than the step would need steps of its own.
        let step_s = if lag_s > 0.0 { STEP_S.min(lag_s / 4.0) } else { STEP_S };
        runge_kutta(&mut state, dt_s, step_s, |&[c, t, jacket]| {
            let [dc, dt] = self.rate([c, t], jacket, feed_c, feed_t);
            let dj = if lag_s > 0.0 { (coolant - jacket) / lag_s } else { 0.0 };
            [dc, dt, dj]
        });
        self.state = state;
        self.now_s += dt_s;
        if state.iter().all(|x| x.is_finite()) {
            Ok(())
        } else {
            Err(Fault::failed(
                "the reactor left the range of numbers; check its constants",
            ))
        }
    }

    fn show(&self, view: &mut View<'_>) {
        let moment = (self.now_s * 1e3).round() as u64;
        let [c, t, _] = self.state;
        view.set(CONCENTRATION, c);
        view.set_shown(TEMPERATURE, t, t + self.noise_k * noise(self.seed, 1, moment));
    }
}

bumpless_sdk::export_plant!(Cstr);

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    fn defaults() -> Vec<f64> {
        CONSTANTS.iter().map(|c| c.default).collect()
    }

    fn inputs(coolant: f64) -> [f64; 5] {
        [0.0, 0.0, coolant, 350.0, 1.0]
    }

    #[test]
    fn the_published_point_is_a_steady_state_and_an_unstable_one() {
        let reactor = Running::<Cstr>::begin(&defaults(), 0).unwrap();
        let plant = reactor.plant();
        let at = |c: f64, t: f64| plant.rate([c, t], 300.0, 1.0, 350.0);
        let [dc, dt] = at(0.5, 350.0);
        // k(350 K) is 1 per minute to four digits, no more; in units per minute:
        assert!((dc * 60.0).abs() < 1e-4 && (dt * 60.0).abs() < 0.02, "{dc} {dt}");
        let d = 1e-4;
        let column = |up: [f64; 2], down: [f64; 2]| [(up[0] - down[0]) / (2.0 * d), (up[1] - down[1]) / (2.0 * d)];
        let by_c = column(at(0.5 + d, 350.0), at(0.5 - d, 350.0));
        let by_t = column(at(0.5, 350.0 + d), at(0.5, 350.0 - d));
        let (trace, det) = (by_c[0] + by_t[1], by_c[0] * by_t[1] - by_t[0] * by_c[1]);
        // With Seborg's numbers: A = [−2, −0.0357; 209.2, 4.379] per minute.
        assert!((by_c[0] * 60.0 + 2.0).abs() < 1e-3 && (by_t[0] * 60.0 + 0.0357).abs() < 1e-3);
        assert!((by_c[1] * 60.0 - 209.2).abs() < 0.1 && (by_t[1] * 60.0 - 4.379).abs() < 0.01);
        assert!(trace > 0.0 || det < 0.0, "it would be stable: trace {trace}, det {det}");
    }

    #[test]
    fn left_alone_it_runs_away_or_dies_out() {
        let end = |coolant: f64| {
            let mut reactor = Running::<Cstr>::begin(&defaults(), 0).unwrap();
            reactor.advance(600_000_000_000, &inputs(coolant)).unwrap();
            reactor.truth()[0]
        };
        assert!(end(295.0) < 330.0, "{}", end(295.0));
        let mut hottest: f64 = 0.0;
        let mut reactor = Running::<Cstr>::begin(&defaults(), 0).unwrap();
        for _ in 0..600 {
            reactor.advance(1_000_000_000, &inputs(304.0)).unwrap();
            hottest = hottest.max(reactor.truth()[0]);
        }
        assert!(hottest > 370.0, "{hottest}");
    }

    #[test]
    fn a_jacket_with_a_lag_follows_slowly() {
        let mut constants = defaults();
        constants[8] = 30.0;
        let mut reactor = Running::<Cstr>::begin(&constants, 0).unwrap();
        reactor.advance(30_000_000_000, &inputs(290.0)).unwrap();
        let jacket = reactor.plant().state[2];
        assert!((jacket - (290.0 + 10.0 * (-1.0_f64).exp())).abs() < 1e-3, "{jacket}");
    }
}
