//! Between the ports and the law: what every controller of the ISA form does with a frame.
//!
//! ```text
//!   take: ports ─► Sample, or what is followed blindly ─► (a law's own part) ─► conclude: step, alarms ─► output
//! ```
//! Never: arithmetic; that is the law's.

use bumpless_sdk::prelude::*;

use crate::{
    alarms,
    chain::{self, Links},
    law::{Demand, Memory, Memory1, Sample},
    mode::{self, Actual},
    table::{
        BLOCK_PARAMETERS, BLOCK_PORTS, BYPASS_ON, FF, HOLD, NO_FALL, NO_RISE, ON_UNCERTAIN, OOS, OUT, PV, REMOTE_ON,
        REMOTE_SP, RESET, TELL, TRACK, TRACK_ON,
    },
    tuning::Tuning,
};
use serde::{Deserialize, Serialize};

/// Layout of [`Block`] in the state bytes of the [`FAMILY`].
pub const STATE_LAYOUT: u32 = 3;

/// Controllers that read each other's state, in layouts 1 to [`STATE_LAYOUT`].
pub const FAMILY: [&str; 2] = ["pid", "pidplus"];

/// How many parameters layout 1 had: the first ones of today's table.
const PARAMETERS_1: usize = 15;
/// As many had layout 2.
const PARAMETERS_2: usize = 27;

/// The state of the block by itself.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Block {
    /// The law's.
    pub memory: Memory,
    /// The chain's.
    pub links: Links,
}

impl From<Memory> for Block {
    fn from(memory: Memory) -> Self {
        Self {
            memory,
            links: Links::default(),
        }
    }
}

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
        ports: BLOCK_PORTS,
        parameters: BLOCK_PARAMETERS,
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

/// Reads the ports that every law around the block has. `held` is what the actuator holds, in the law's units.
///
/// Fails with [`Fault::BadInput`] in automatic without a usable measurement, or where the setpoint is no number.
pub fn take(
    memory: &mut Memory,
    parameters: &Parameters<'_>,
    cycle: &Cycle,
    io: &Io<'_>,
    held: Option<f64>,
    timing: Timing,
) -> Result<Intake, Fault> {
    let demand = demand(memory.output, cycle, io, held, (TRACK, TRACK_ON));
    intake(memory, parameters, cycle, io, held, timing, (demand, false))
}

/// The measurement, and whether the integral may live on it. None where it is not usable, or counts as bad.
fn measurement(parameters: &Parameters<'_>, io: &Io<'_>) -> Option<(Reading, bool)> {
    let pv = io.read_usable(PV)?;
    match pv.quality {
        Quality::Uncertain => match parameters.choice(ON_UNCERTAIN) {
            0 => Some((pv, true)),
            1 => Some((pv, false)),
            _ => None,
        },
        _ => Some((pv, true)),
    }
}

fn intake(
    memory: &mut Memory,
    parameters: &Parameters<'_>,
    cycle: &Cycle,
    io: &Io<'_>,
    held: Option<f64>,
    timing: Timing,
    (demand, bypass): (Demand, bool),
) -> Result<Intake, Fault> {
    let seen = measurement(parameters, io);
    if seen.is_none() {
        match demand {
            Demand::Follow(value) => {
                memory.follow_blind(value);
                return Ok(Intake::Blind(value));
            }
            // What goes through needs no measurement.
            Demand::Automatic if bypass => {}
            Demand::Automatic => return Err(Fault::bad_input("pv has no usable value")),
        }
    }
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
    let (pv, fresh, feeds) = seen.map_or((memory.pv, false, false), |(pv, feeds)| (pv.value, pv.fresh, feeds));
    let elapsed_s = timing(&mut memory.waited_s, dt_s, fresh);
    let sample = Sample {
        pv,
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
        elapsed_s: elapsed_s.filter(|_| seen.is_some()),
        remote,
        hold: !feeds || is_on(io, HOLD),
        no_rise: is_on(io, NO_RISE),
        no_fall: is_on(io, NO_FALL),
        bypass,
        reset: io.read_usable(RESET).map(|r| r.value),
    };
    Ok(Intake::Seen(sample, fresh))
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

/// One cycle of the block by itself. Without a usable measurement: a [`Fault::BadInput`] in automatic, following in manual and
/// while tracking.
pub fn step(
    block: &mut Block,
    parameters: &Parameters<'_>,
    cycle: &Cycle,
    io: &mut Io<'_>,
    timing: Timing,
) -> Result<(), Fault> {
    let Block { memory, links } = block;
    let held = held(io, OUT);
    let out_of_service = is_on(io, OOS);
    // A loop below that says nothing is one that does not take the output.
    let initialises = links.hear(parameters, io) && links.below.is_none_or(|report| report.has(chain::INITIALISE));
    let actual = Actual::of(cycle, io, out_of_service, initialises);
    let mut demand = demand(memory.output, cycle, io, held, (TRACK, TRACK_ON));
    let stays = held.unwrap_or(memory.output);
    match actual {
        Actual::OutOfService => demand = Demand::Follow(stays),
        Actual::Initialisation => {
            let below = links.below.filter(|report| !report.has(chain::NO_VALUE));
            demand = Demand::Follow(below.map_or(stays, |report| report.value));
        }
        _ => {}
    }
    let tuning = Tuning::of(parameters);
    let output = if out_of_service {
        memory.alarms = alarms::clear(memory.alarms, io);
        memory.follow_blind(stays);
        stays
    } else {
        let bypass = is_on(io, BYPASS_ON);
        match intake(memory, parameters, cycle, io, held, timing, (demand, bypass))? {
            Intake::Blind(value) => value,
            Intake::Seen(mut sample, _) => {
                if let Some(report) = links.below {
                    sample.no_rise |= report.has(chain::NO_RISE);
                    sample.no_fall |= report.has(chain::NO_FALL);
                    let value = (!report.has(chain::NO_VALUE)).then_some(report.value);
                    sample.reset = sample.reset.or(value);
                }
                conclude(memory, &tuning, parameters, &sample, sample.pv, io)?
            }
        }
    };
    links.report(memory, &tuning, parameters, actual == Actual::Cascade, io);
    let told = parameters.choice(TELL);
    if told != 0 || memory.alarms & (alarms::MODE | alarms::QUALITY) != 0 {
        let shed = actual.shed(cycle, io).filter(|_| told & 1 != 0);
        memory.alarms = mode::tell(memory.alarms, alarms::MODE, "mode", shed, io);
        let doubtful = told & 2 != 0 && !out_of_service && mode::is_doubtful(io);
        let text = doubtful.then_some("the output rests on an input that is uncertain, or failed and was replaced");
        memory.alarms = mode::tell(memory.alarms, alarms::QUALITY, "quality", text, io);
    }
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
pub fn adopt_block(from: &Origin<'_>, parameters: &Parameters<'_>) -> Result<Option<Block>, Fault> {
    if !FAMILY.contains(&from.name) {
        return Ok(None);
    }
    let old = from.open()?;
    let mut block: Block = match (from.state_layout, old.parameters.count()) {
        (1, PARAMETERS_1) => Memory::from(old.law::<Memory1>()?).into(),
        (2, PARAMETERS_2) => old.law::<Memory>()?.into(),
        (STATE_LAYOUT, count) if count == BLOCK_PARAMETERS.len() => old.law()?,
        _ => return Ok(None),
    };
    retune(&mut block.memory, &old.parameters, parameters)?;
    Ok(Some(block))
}

/// As [`adopt_block`], for a law around the block.
pub fn adopt(from: &Origin<'_>, parameters: &Parameters<'_>) -> Result<Option<Memory>, Fault> {
    Ok(adopt_block(from, parameters)?.map(|block| block.memory))
}
