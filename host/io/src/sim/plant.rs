//! The pilot plant as equations: two pumps, a tank above, a pressure vessel, a tank below, one loop of water.
//!
//! ```text
//!             ┌── FIT116 ── PIT118 ── LV122 ──► TQ01 38 L, LIT125 ── HV123 ──┐
//!   P2 ───────┘                                                              │
//!   TQ02 83 L, heater, TIT127, LSL110 ◄──────────────────────────────────────┤
//!   P1 ────────────► check valve ──► R01 15 L of air and water, PIT129 ── HV131 ┘
//! ```
//!
//! Equipment, volumes, instruments, ranges and signals are those of the pilot plant in the PID 4.0 work (UNESP Sorocaba,
//! 2023): Dancor CP-4R pumps (4.24 m³/h) on CFW300 drives, a motorised ½" valve, 4–20 mA in, 0–10 V out. It gives no
//! pipe lengths or time constants; those here are engineering estimates for ½" pipe. The heater and the leak are ours:
//! they give the thermometer and the low-level switch something to do.
//!
//! Units inside: litres, seconds, bar (gauge), °C, kW. Fixed step of 1 ms, semi-implicit Euler: friction is taken
//! implicitly, so that even a shut valve, which is a very stiff resistance, stays stable.
//!
//! Never: reads a clock. Same settings, commands and steps: same state, bit for bit.

use serde::{Deserialize, Serialize};

use crate::{
    scaling::{MEASURED_HIGH_MA, MEASURED_LOW_MA, current_ma, quantised},
    sim::noise,
};

/// One step, in ns.
pub const STEP_NS: u64 = 1_000_000;
const DT_S: f64 = 0.001;

/// Head of a pump at full speed and no flow, in bar (22 m of water).
const PUMP_SHUT_OFF_BAR: f64 = 2.2;
/// Flow of a pump at full speed and no head: 4.24 m³/h.
const PUMP_FLOW_MAX_L_S: f64 = 4.24 / 3.6;
/// What 8 m of ½" pipe resist a change of flow with: ρ·l/A = 42 kPa per L/s².
const INERTIA_BAR_S2_L: f64 = 0.42;
/// Heights of the tank above and of the vessel over the tank below: 1.2 m and 1 m of water.
const TQ01_HEAD_BAR: f64 = 0.118;
const R01_HEAD_BAR: f64 = 0.098;
/// Turbulent friction, in bar per (L/s)²: before the pressure tap (orifice included), after it, and to the vessel.
const FRICTION_BEFORE: f64 = 0.45;
const FRICTION_AFTER: f64 = 0.25;
const FRICTION_R01: f64 = 0.8;
/// Flow of LV122, fully open, at 1 bar: Kv = 3 m³/h. Equal percentage with a rangeability of 50.
const LV122_KV_L_S: f64 = 3.0 / 3.6;
const RANGEABILITY: f64 = 50.0;
/// Flow of HV131, fully open, at 1 bar.
const HV131_KV_L_S: f64 = 0.5;
/// Flow of HV123, fully open, at a full tank above (0.5 m of water): Torricelli scales it with the root of the level.
const HV123_FULL_L_S: f64 = 0.9;
/// Flow of the leak, fully open, at a full tank below.
const HV114_FULL_L_S: f64 = 0.5;
/// Flow of the tap that refills the tank below.
const REFILL_L_S: f64 = 10.0 / 60.0;
/// Volumes, in litres.
const TQ01_L: f64 = 38.0;
const TQ02_L: f64 = 83.0;
const R01_L: f64 = 15.0;
/// Polytropic exponent of the vessel's air: between isothermal (1) and adiabatic (1.4), near the former for a wet wall.
const AIR_EXPONENT: f64 = 1.1;
const ATMOSPHERE_BAR: f64 = 1.013;
/// The low-level switch stops the pumps below the first volume and lets them go again above the second, in litres.
const LSL110_TRIP_L: f64 = 8.0;
const LSL110_RESET_L: f64 = 11.0;
/// Heat: full power of the heater in kW, of a litre of water in kJ/(L·K), losses in kW/K, room in °C.
const HEATER_KW: f64 = 3.0;
const WATER_KJ_L_K: f64 = 4.186;
const TQ02_LOSS_KW_K: f64 = 0.012;
const TQ01_LOSS_KW_K: f64 = 0.006;
const ROOM_C: f64 = 22.0;
/// Steel and acrylic count as this much water, in litres; so an empty tank has a temperature too.
const WALL_L: f64 = 1.5;
/// Dead times of drive, valve and thermometer (pipe to its well), in steps of 1 ms.
const DRIVE_DEAD_STEPS: usize = 150;
const VALVE_DEAD_STEPS: usize = 400;
const TIT127_DEAD_STEPS: usize = 2000;
/// The drives ramp 0 to 100 % in 2 s; below 5 % they stop. Motor and pump follow with this time constant, in s.
const DRIVE_RAMP_PER_S: f64 = 0.5;
const DRIVE_MIN: f64 = 0.05;
const MOTOR_TAU_S: f64 = 0.12;
/// The valve's motor needs 8 s for its stroke and does not move for less than 0.4 % of it.
const VALVE_RATE_PER_S: f64 = 0.125;
const VALVE_DEADBAND: f64 = 0.004;
/// The drives' and the valve's inputs convert 0–10 V with 12 bits.
const DAC_BITS: u32 = 12;

/// Settings of the plant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlantSettings {
    /// Bits of the 4–20 mA inputs over 0 to 20 mA: 12 for the original's card, 16 for a good one.
    pub adc_bits: u32,
    /// All water, in litres; 18 of them start in the tank above.
    pub water_l: f64,
    /// Noise of the instruments; 1 is that of real ones, 0 none.
    pub noise: f64,
}

impl Default for PlantSettings {
    fn default() -> Self {
        Self {
            adc_bits: 12,
            water_l: 60.0,
            noise: 1.0,
        }
    }
}

impl PlantSettings {
    /// Checks the numbers.
    ///
    /// # Errors
    /// In words, where one makes no sense.
    pub fn check(&self) -> Result<(), String> {
        let wrong = |problem: &str| Err(problem.to_owned());
        if !(8..=24).contains(&self.adc_bits) {
            return wrong("plant.adc_bits must be 8 to 24");
        }
        if !(20.0..=80.0).contains(&self.water_l) {
            return wrong("plant.water_l must be 20 to 80 litres: the tank below holds 83");
        }
        if !(0.0..=10.0).contains(&self.noise) {
            return wrong("plant.noise must be 0 to 10; 1 is the noise of real instruments");
        }
        Ok(())
    }
}

/// Everything that can be set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Speed of the pump to the vessel, in V of 10.
    P1,
    /// Speed of the pump to the tank above, in V of 10.
    P2,
    /// Opening of the valve to the tank above, in V of 10.
    Lv122,
    /// Power of the heater in the tank below, in V of 10.
    Heater,
    /// Hand valve out of the tank above, in %.
    Hv123,
    /// Hand valve out of the vessel, in %.
    Hv131,
    /// Leak of the tank below, in %.
    Hv114,
    /// Tap into the tank below, 0 or 1; shuts itself at a full tank.
    Refill,
}

/// How many commands there are.
pub const COMMANDS: usize = 8;

/// Everything that sends 4–20 mA.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Instrument {
    /// Line pressure, 0 to 2.5 bar.
    Pit118,
    /// Vessel pressure, 0 to 2.5 bar.
    Pit129,
    /// Flow to the tank above by an orifice plate, 0 to 5 m³/h.
    Fit116,
    /// Level of the tank above, 0 to 100 %.
    Lit125,
    /// Temperature of the tank below, 0 to 100 °C.
    Tit127,
}

/// How many instruments there are.
pub const INSTRUMENTS: usize = 5;

impl Instrument {
    /// Range in engineering units.
    #[must_use]
    pub const fn range(self) -> (f64, f64) {
        match self {
            Self::Pit118 | Self::Pit129 => (0.0, 2.5),
            Self::Fit116 => (0.0, 5.0),
            Self::Lit125 | Self::Tit127 => (0.0, 100.0),
        }
    }

    /// Damping, in s.
    const fn tau_s(self) -> f64 {
        match self {
            Self::Pit118 | Self::Pit129 => 0.1,
            Self::Fit116 => 0.4,
            Self::Lit125 => 0.6,
            Self::Tit127 => 6.0,
        }
    }

    /// Standard deviation of the noise, as a part of the range (FIT116: of the orifice's pressure drop).
    const fn noise(self) -> f64 {
        match self {
            Self::Pit118 | Self::Fit116 => 0.0015,
            Self::Pit129 | Self::Lit125 => 0.001,
            Self::Tit127 => 0.0003,
        }
    }
}

/// A value that arrives a set number of steps later.
#[derive(Debug, Clone)]
struct Delay {
    ring: Box<[f64]>,
    at: usize,
}

impl Delay {
    fn new(steps: usize, value: f64) -> Self {
        Self {
            ring: vec![value; steps.max(1)].into_boxed_slice(),
            at: 0,
        }
    }

    /// Puts one value in and takes the oldest out.
    fn pass(&mut self, value: f64) -> f64 {
        let oldest = match self.ring.get_mut(self.at) {
            Some(slot) => std::mem::replace(slot, value),
            None => value,
        };
        self.at = if self.at + 1 < self.ring.len() { self.at + 1 } else { 0 };
        oldest
    }
}

/// A pump on its drive: dead time, ramp, lag.
#[derive(Debug, Clone)]
struct Drive {
    wanted: Delay,
    ramp: f64,
    speed: f64,
}

impl Drive {
    fn new() -> Self {
        Self {
            wanted: Delay::new(DRIVE_DEAD_STEPS, 0.0),
            ramp: 0.0,
            speed: 0.0,
        }
    }

    /// One step towards `volts` of 10; `tripped` takes the torque away at once. Returns the head at no flow, in bar.
    fn step(&mut self, volts: f64, tripped: bool) -> f64 {
        let fraction = quantised(volts, 10.0, DAC_BITS) / 10.0;
        let wanted = self.wanted.pass(fraction);
        let wanted = if tripped || wanted < DRIVE_MIN { 0.0 } else { wanted };
        let most = DRIVE_RAMP_PER_S * DT_S;
        self.ramp = if tripped {
            0.0
        } else {
            self.ramp + (wanted - self.ramp).max(-most).min(most)
        };
        self.speed += (self.ramp - self.speed) * DT_S / MOTOR_TAU_S;
        // Affinity laws: head goes with the square of the speed.
        PUMP_SHUT_OFF_BAR * self.speed * self.speed
    }
}

/// Friction of a pump's inside, in bar per (L/s)²: its curve falls from the shut-off head to 0 at full flow.
const PUMP_FRICTION: f64 = PUMP_SHUT_OFF_BAR / (PUMP_FLOW_MAX_L_S * PUMP_FLOW_MAX_L_S);

/// The next flow of a pipe with inertia, in L/s: driving pressure explicit, friction implicit. A check valve keeps it ≥ 0.
fn next_flow(flow: f64, driving_bar: f64, friction: f64) -> f64 {
    let step = DT_S / INERTIA_BAR_S2_L;
    ((flow + step * driving_bar) / (1.0 + step * friction * flow)).max(0.0)
}

/// The plant at one moment.
#[derive(Debug, Clone)]
pub struct Plant {
    settings: PlantSettings,
    seed: u64,
    steps: u64,
    commands: [f64; COMMANDS],
    broken: [bool; INSTRUMENTS],
    p1: Drive,
    p2: Drive,
    valve_wanted: Delay,
    valve: f64,
    flow1: f64,
    flow2: f64,
    tq01: f64,
    tq02: f64,
    r01: f64,
    tq01_c: f64,
    tq02_c: f64,
    tit127: Delay,
    tripped: bool,
    measured: [f64; INSTRUMENTS],
}

impl Plant {
    /// At rest: pumps off, valve LV122 at 8 V, hand valves half and a third open, room temperature.
    #[must_use]
    pub fn new(settings: PlantSettings, seed: u64) -> Self {
        let tq01 = 18.0_f64.min(settings.water_l);
        let mut plant = Self {
            settings,
            seed,
            steps: 0,
            commands: [0.0, 0.0, 8.0, 0.0, 50.0, 30.0, 0.0, 0.0],
            broken: [false; INSTRUMENTS],
            p1: Drive::new(),
            p2: Drive::new(),
            valve_wanted: Delay::new(VALVE_DEAD_STEPS, 0.8),
            valve: 0.8,
            flow1: 0.0,
            flow2: 0.0,
            tq01,
            tq02: settings.water_l - tq01,
            r01: 0.0,
            tq01_c: ROOM_C,
            tq02_c: ROOM_C,
            tit127: Delay::new(TIT127_DEAD_STEPS, ROOM_C),
            tripped: false,
            measured: [0.0; INSTRUMENTS],
        };
        plant.tripped = plant.tq02 < LSL110_TRIP_L;
        plant.measured = plant.sensed(0.0, ROOM_C);
        plant
    }

    /// Steps since the start.
    #[must_use]
    pub const fn steps(&self) -> u64 {
        self.steps
    }

    /// What a command holds.
    #[must_use]
    pub fn command(&self, command: Command) -> f64 {
        self.commands.get(command as usize).copied().unwrap_or(0.0)
    }

    /// Sets a command; it acts from the next step on. The caller keeps it in its range.
    pub fn set_command(&mut self, command: Command, value: f64) {
        if let Some(slot) = self.commands.get_mut(command as usize) {
            *slot = value;
        }
    }

    /// Breaks the wire of an instrument, or mends it.
    pub fn set_broken(&mut self, instrument: Instrument, broken: bool) {
        if let Some(slot) = self.broken.get_mut(instrument as usize) {
            *slot = broken;
        }
    }

    /// Is the wire of an instrument broken?
    #[must_use]
    pub fn is_broken(&self, instrument: Instrument) -> bool {
        self.broken.get(instrument as usize).copied().unwrap_or(false)
    }

    /// Has the low-level switch stopped the pumps?
    #[must_use]
    pub const fn tripped(&self) -> bool {
        self.tripped
    }

    /// All water in the plant, in litres; only leak and tap change it.
    #[must_use]
    pub fn water_l(&self) -> f64 {
        self.tq01 + self.tq02 + self.r01
    }

    /// What an instrument would show without noise and conversion, in its unit.
    #[must_use]
    pub fn true_value(&self, instrument: Instrument) -> f64 {
        self.measured.get(instrument as usize).copied().unwrap_or(0.0)
    }

    /// What the input card converts for an instrument now, in mA: damped, noisy, saturated, in steps of the converter.
    /// A broken wire gives 0.
    #[must_use]
    pub fn current_ma(&self, instrument: Instrument) -> f64 {
        if self.is_broken(instrument) {
            return 0.0;
        }
        let (low, high) = instrument.range();
        let noise = instrument.noise() * self.settings.noise * noise::normal(self.seed, instrument as u64, self.steps);
        let fraction = (self.true_value(instrument) - low) / (high - low);
        let fraction = if instrument == Instrument::Fit116 {
            // The transmitter measures a pressure drop and takes its root; below 0.6 % of it, it says 0.
            let drop = fraction * fraction + noise;
            if drop < 0.006 { 0.0 } else { drop.sqrt() }
        } else {
            fraction + noise
        };
        // A sound transmitter saturates at 3.8 and 20.5 mA (NAMUR NE 43).
        let ma = current_ma(fraction).clamp(MEASURED_LOW_MA, MEASURED_HIGH_MA);
        // The card's full scale lies above 20 mA, so that it can see a failure upwards.
        quantised(ma, 22.0, self.settings.adc_bits)
    }

    /// 1 ms passes.
    pub fn step(&mut self) {
        let [p1_v, p2_v, lv122_v, heater_v, hv123, hv131, hv114, refill] = self.commands;
        self.steps += 1;

        // Interlock: wired to the drives, past any controller.
        if self.tq02 < LSL110_TRIP_L {
            self.tripped = true;
        } else if self.tq02 > LSL110_RESET_L {
            self.tripped = false;
        }
        let head1 = self.p1.step(p1_v, self.tripped);
        let head2 = self.p2.step(p2_v, self.tripped);

        // Valve: dead time, dead band, constant speed.
        let wanted = self.valve_wanted.pass(quantised(lv122_v, 10.0, DAC_BITS) / 10.0);
        let error = wanted - self.valve;
        if error.abs() > VALVE_DEADBAND {
            let most = VALVE_RATE_PER_S * DT_S;
            self.valve += error.max(-most).min(most);
        }
        // Equal percentage above 2 % of the stroke, shut (with a trace of leakage) below.
        let opening = if self.valve < 0.02 {
            1e-4
        } else {
            RANGEABILITY.powf(self.valve - 1.0)
        };
        let kv = LV122_KV_L_S * opening;
        let valve_friction = 1.0 / (kv * kv);

        // Flows.
        let friction2 = PUMP_FRICTION + FRICTION_BEFORE + FRICTION_AFTER + valve_friction;
        let flow2_before = self.flow2;
        self.flow2 = next_flow(self.flow2, head2 - TQ01_HEAD_BAR, friction2);
        let r01_bar = self.r01_bar();
        self.flow1 = next_flow(self.flow1, head1 - R01_HEAD_BAR - r01_bar, PUMP_FRICTION + FRICTION_R01);

        // Four fifths of the pipe lie before the pressure tap, and so does their inertia.
        let flow2_rate = (self.flow2 - flow2_before) / DT_S;
        let before_tap = (PUMP_FRICTION + FRICTION_BEFORE) * self.flow2 * self.flow2;
        let line_bar = (head2 - before_tap - 0.8 * INERTIA_BAR_S2_L * flow2_rate).max(0.0);

        // Water. What leaves a vessel in a step is never more than it holds.
        let tq01_full = (self.tq01 / TQ01_L).max(0.0);
        let out01 = (HV123_FULL_L_S * hv123 / 100.0 * tq01_full.sqrt()).min(self.tq01 / DT_S);
        let out_r01 = (HV131_KV_L_S * hv131 / 100.0 * r01_bar.sqrt()).min(self.r01 / DT_S);
        let leak = HV114_FULL_L_S * hv114 / 100.0 * (self.tq02 / TQ02_L).max(0.0).sqrt();
        let tap = if refill > 0.5 && self.tq02 < 0.9 * TQ02_L {
            REFILL_L_S
        } else {
            0.0
        };
        let overflow = ((self.tq01 - TQ01_L) / DT_S).max(0.0);
        let to_tq02 = out01 + overflow;
        self.tq01 = (self.tq01 + (self.flow2 - to_tq02) * DT_S).max(0.0);
        self.r01 = (self.r01 + (self.flow1 - out_r01) * DT_S).max(0.0);
        self.tq02 = (self.tq02 + (to_tq02 + out_r01 - self.flow1 - self.flow2 + tap - leak) * DT_S).max(0.0);

        // Heat. The vessel's water comes from the tank below and returns soon, so it counts as that tank's.
        let heater_kw = HEATER_KW * heater_v / 10.0;
        let tq01_kw = self.flow2 * WATER_KJ_L_K * (self.tq02_c - self.tq01_c) - TQ01_LOSS_KW_K * (self.tq01_c - ROOM_C);
        let tq02_kw = heater_kw
            + to_tq02 * WATER_KJ_L_K * (self.tq01_c - self.tq02_c)
            + tap * WATER_KJ_L_K * (ROOM_C - self.tq02_c)
            - TQ02_LOSS_KW_K * (self.tq02_c - ROOM_C);
        self.tq01_c += tq01_kw * DT_S / (WATER_KJ_L_K * (self.tq01 + WALL_L));
        // Boiling ends the story; the model has no steam.
        self.tq02_c = (self.tq02_c + tq02_kw * DT_S / (WATER_KJ_L_K * (self.tq02 + self.r01 + WALL_L))).min(100.0);

        // Instruments.
        let at_well_c = self.tit127.pass(self.tq02_c);
        let sensed = self.sensed(line_bar, at_well_c);
        let taus = [
            Instrument::Pit118,
            Instrument::Pit129,
            Instrument::Fit116,
            Instrument::Lit125,
            Instrument::Tit127,
        ];
        for ((shown, now), instrument) in self.measured.iter_mut().zip(sensed).zip(taus) {
            *shown += (now - *shown) * DT_S / instrument.tau_s();
        }
    }

    /// Pressure of the vessel's air, in bar.
    fn r01_bar(&self) -> f64 {
        // The last half litre of air cannot be pressed out, whatever the pump.
        let air = (R01_L - self.r01).max(0.5);
        ATMOSPHERE_BAR * ((R01_L / air).powf(AIR_EXPONENT) - 1.0)
    }

    /// What the process shows to its instruments, in the order of `Instrument`.
    fn sensed(&self, line_bar: f64, at_well_c: f64) -> [f64; INSTRUMENTS] {
        [
            line_bar,
            self.r01_bar(),
            self.flow2 * 3.6,
            100.0 * self.tq01 / TQ01_L,
            at_well_c,
        ]
    }
}

#[cfg(test)]
mod tests;
