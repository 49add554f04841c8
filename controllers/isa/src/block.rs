//! Between the ports and the law: what every controller of the ISA form does with a frame.
//!
//! ```text
//!   take: ports ─► Sample, or what is followed blindly ─► (a law's own part) ─► conclude: step, alarms ─► output
//! ```
//! Never: arithmetic; that is the law's.

use bumpless_sdk::prelude::*;

use crate::{
    alarms,
    law::{Demand, Memory, Memory1, Sample},
    table::{FF, HOLD, OUT, PARAMETERS, PORTS, PV, REMOTE_ON, REMOTE_SP, RESET, TRACK, TRACK_ON},
    tuning::Tuning,
};

/// Layout of [`Memory`] in the state bytes, the same for every ISA-form controller.
pub const STATE_LAYOUT: u32 = 2;

/// Controllers that read each other's state, in layouts 1 and [`STATE_LAYOUT`].
pub const FAMILY: [&str; 2] = ["pid", "pidplus"];

/// How many parameters layout 1 had: the first ones of today's table.
const PARAMETERS_1: usize = 15;

/// When a measurement counts. Given: the time waited since the last one that did (s, to be kept up to date), the time since
/// the step before (s) and whether a new sample arrived. Gives ΔT (s) if this one counts.
pub type Timing = fn(waited_s: &mut f64, dt_s: f64, fresh: bool) -> Option<f64>;

/// Every measurement counts, fresh or not.
pub const fn always(waited_s: &mut f64, dt_s: f64, _fresh: bool) -> Option<f64> {
    // Nothing is ever waited for; kept at 0, so that a law that waits finds the truth when it takes over.
    *waited_s = 0.0;
    Some(dt_s)
}

/// Describes an ISA-form controller.
#[must_use]
pub const fn description(name: &'static str, version: &'static str, text: &'static str) -> Description {
    Description {
        name,
        version,
        text,
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout: STATE_LAYOUT,
    }
}

/// A first state: the first automatic output is what the actuator holds.
pub fn start(parameters: &Parameters<'_>, track: &Track<'_>) -> Result<Memory, Fault> {
    Tuning::of(parameters).check()?;
    Ok(Memory::new(track.of(OUT)))
}

/// What a frame holds for the law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Intake {
    /// There is no measurement, and something else decides: the output is this.
    Blind(f64),
    /// A sample, and whether its measurement is a new one.
    Seen(Sample, bool),
}

/// What the actuator of an output holds, where that can be read.
#[must_use]
pub fn held(io: &Io<'_>, output: Output) -> Option<f64> {
    Some(io.held(output)).filter(Reading::is_usable).map(|r| r.value)
}

/// Reads the ports of the block. `held` is what the actuator holds, in the law's units.
///
/// Fails with [`Fault::BadInput`] in automatic without a usable measurement, or where the setpoint is no number.
pub fn take(
    memory: &mut Memory,
    cycle: &Cycle,
    io: &Io<'_>,
    held: Option<f64>,
    timing: Timing,
) -> Result<Intake, Fault> {
    let demand = demand(memory.output, cycle, io, held, (TRACK, TRACK_ON));
    let Some(pv) = io.read_usable(PV) else {
        let Demand::Follow(value) = demand else {
            return Err(Fault::bad_input("pv has no usable value"));
        };
        memory.follow_blind(value);
        return Ok(Intake::Blind(value));
    };
    let remote = is_on(io, REMOTE_ON);
    let setpoint = if remote {
        // Another block that fails leaves its last wish.
        io.read_usable(REMOTE_SP).map_or(memory.setpoint, |r| r.value)
    } else {
        cycle.setpoint
    };
    if !setpoint.is_finite() {
        return Err(Fault::bad_input("the setpoint is not a finite number"));
    }
    let dt_s = cycle.dt_s();
    let sample = Sample {
        pv: pv.value,
        setpoint,
        // A feedforward that fails stays where it was: to drop it would bump the output.
        feedforward: if io.is_connected(FF) {
            io.read_usable(FF).map_or(memory.feedforward, |r| r.value)
        } else {
            0.0
        },
        held,
        demand,
        dt_s,
        elapsed_s: timing(&mut memory.waited_s, dt_s, pv.fresh),
        remote,
        hold: is_on(io, HOLD),
        reset: io.read_usable(RESET).map(|r| r.value),
    };
    Ok(Intake::Seen(sample, pv.fresh))
}

/// Steps the law and tells alarms about what was `measured`. Gives the output.
///
/// Fails with [`Fault::Failed`] where a number that must last is none; the state is then to be left as it was.
pub fn conclude(
    memory: &mut Memory,
    tuning: &Tuning,
    parameters: &Parameters<'_>,
    sample: &Sample,
    measured: f64,
    io: &mut Io<'_>,
) -> Result<f64, Fault> {
    let output = memory.step(tuning, sample);
    if !(output.is_finite() && memory.is_sound()) {
        return Err(Fault::failed(
            "the output is not a finite number; check the gains against the range of pv",
        ));
    }
    memory.alarms = alarms::tell(memory.alarms, parameters, measured, memory.setpoint, io);
    Ok(output)
}

/// One cycle of the block alone. Without a usable measurement: a [`Fault::BadInput`] in automatic, following in manual and
/// while tracking.
pub fn step(
    memory: &mut Memory,
    parameters: &Parameters<'_>,
    cycle: &Cycle,
    io: &mut Io<'_>,
    timing: Timing,
) -> Result<(), Fault> {
    let held = held(io, OUT);
    let output = match take(memory, cycle, io, held, timing)? {
        Intake::Blind(value) => value,
        Intake::Seen(sample, _) => conclude(memory, &Tuning::of(parameters), parameters, &sample, sample.pv, io)?,
    };
    io.write(OUT, output);
    Ok(())
}

/// Is a digital input connected, usable and on?
#[must_use]
pub fn is_on(io: &Io<'_>, input: Input) -> bool {
    io.read_usable(input).is_some_and(|r| r.value != 0.0)
}

/// In manual the law follows the actuator; with track-on it follows the track input, or, where that fails, the actuator.
/// `last` stands in for an actuator that cannot be read.
#[must_use]
pub fn demand(last: f64, cycle: &Cycle, io: &Io<'_>, held: Option<f64>, (track, track_on): (Input, Input)) -> Demand {
    let held = held.unwrap_or(last);
    if matches!(cycle.mode, Mode::Manual) {
        Demand::Follow(held)
    } else if is_on(io, track_on) {
        Demand::Follow(io.read_usable(track).map_or(held, |r| r.value))
    } else {
        Demand::Automatic
    }
}

/// New parameters: the output goes on without a bump.
pub fn retune(memory: &mut Memory, old: &Parameters<'_>, new: &Parameters<'_>) -> Result<(), Fault> {
    let tuning = Tuning::of(new);
    tuning.check()?;
    memory.retune(&Tuning::of(old), &tuning);
    Ok(())
}

/// Takes over the state of another controller of the [`FAMILY`], or of an older layout, with whatever parameters it ran.
pub fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>) -> Result<Option<Memory>, Fault> {
    if !FAMILY.contains(&from.name) {
        return Ok(None);
    }
    let old = from.open()?;
    let mut memory: Memory = match (from.state_layout, old.parameters.count()) {
        (1, PARAMETERS_1) => old.law::<Memory1>()?.into(),
        (STATE_LAYOUT, count) if count == PARAMETERS.len() => old.law()?,
        _ => return Ok(None),
    };
    retune(&mut memory, &old.parameters, parameters)?;
    Ok(Some(memory))
}
