//! Between the ports and the law: what both controllers do with a frame.
//!
//! Never: arithmetic; that is the law's.

use bumpless_sdk::prelude::*;

use crate::{
    law::{Demand, Memory, Sample},
    table::{FF, OUT, PARAMETERS, PORTS, PV, TRACK, TRACK_ON},
    tuning::Tuning,
};

/// Layout of [`Memory`] in the state bytes, the same for every ISA-form controller.
pub const STATE_LAYOUT: u32 = 1;

/// Controllers that read each other's state, in layout [`STATE_LAYOUT`].
pub const FAMILY: [&str; 2] = ["pid", "pidplus"];

/// When a measurement counts. Given: the time waited since the last one that did (s, to be kept up to date), the time since
/// the step before (s) and whether a new sample arrived. Gives ΔT (s) if this one counts.
pub type Timing = fn(waited_s: &mut f64, dt_s: f64, fresh: bool) -> Option<f64>;

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

/// One cycle. Without a usable measurement: a [`Fault::BadInput`] in automatic, following in manual and while tracking.
pub fn step(
    memory: &mut Memory,
    parameters: &Parameters<'_>,
    cycle: &Cycle,
    io: &mut Io<'_>,
    timing: Timing,
) -> Result<(), Fault> {
    let held = Some(io.held(OUT)).filter(Reading::is_usable).map(|r| r.value);
    let demand = demand(memory, cycle, io, held);
    let Some(pv) = io.read_usable(PV) else {
        let Demand::Follow(value) = demand else {
            return Err(Fault::bad_input("pv has no usable value"));
        };
        memory.follow_blind(value);
        io.write(OUT, value);
        return Ok(());
    };
    if !cycle.setpoint.is_finite() {
        return Err(Fault::bad_input("the setpoint is not a finite number"));
    }
    let dt_s = cycle.dt_s();
    let sample = Sample {
        pv: pv.value,
        setpoint: cycle.setpoint,
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
    };
    let output = memory.step(&Tuning::of(parameters), &sample);
    if !output.is_finite() {
        return Err(Fault::failed(
            "the output is not a finite number; check the gains against the range of pv",
        ));
    }
    io.write(OUT, output);
    Ok(())
}

/// In manual the law follows the actuator; with track-on it follows the track input, or, where that fails, the actuator.
fn demand(memory: &Memory, cycle: &Cycle, io: &Io<'_>, held: Option<f64>) -> Demand {
    let held = held.unwrap_or(memory.output);
    if matches!(cycle.mode, Mode::Manual) {
        Demand::Follow(held)
    } else if io.read_usable(TRACK_ON).is_some_and(|r| r.value != 0.0) {
        Demand::Follow(io.read_usable(TRACK).map_or(held, |r| r.value))
    } else {
        Demand::Automatic
    }
}

/// New parameters: the output goes on without a bump.
pub fn retune(memory: &mut Memory, old: &Parameters<'_>, new: &Parameters<'_>) -> Result<(), Fault> {
    let new = Tuning::of(new);
    new.check()?;
    memory.retune(&Tuning::of(old), &new);
    Ok(())
}

/// Takes over the state of another controller of the [`FAMILY`], with whatever parameters it ran.
pub fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>) -> Result<Option<Memory>, Fault> {
    if !FAMILY.contains(&from.name) || from.state_layout != STATE_LAYOUT {
        return Ok(None);
    }
    let old = from.open()?;
    if old.parameters.count() != PARAMETERS.len() {
        return Ok(None);
    }
    let mut memory: Memory = old.law()?;
    retune(&mut memory, &old.parameters, parameters)?;
    Ok(Some(memory))
}
