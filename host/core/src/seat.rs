//! The owner's side of one cycle: what it goes on from, which commands it applies, whom it asks, and what it commits.
//!
//! Pure: the shell (crate `loops`) calls components and the network between these functions. Never: keeps anything from
//! one cycle to the next except through the record.
//!
//! ```text
//! sample ─► base (the last record) ─► settle (mode, setpoint, commands) ─► [revise] ─► attempts (whom to ask, when next)
//!        ─► conclude: guard, policy ─► record to commit
//! ```

use std::{collections::VecDeque, sync::Arc};

use crate::{
    frame::{Cycle, Effects, Fault, Frame},
    guard,
    limits::{DT_PERIODS_MAX, OUTCOMES_REMEMBERED_MAX},
    name::HostId,
    protocol::Sample,
    reading::{Quality, Reading},
    record::{Applied, CommandBody, CommandId, Event, Outcome, Record},
    redundancy::Redundancy,
    spec::{LoopSpec, Mode, OnFault},
    wiring::Wiring,
};

/// What the owner goes on from.
#[derive(Debug, Clone, PartialEq)]
pub enum Base {
    /// The loop never ran.
    First,
    /// This record.
    On(Arc<Record>),
    /// The owner does not hold the record that the arbiter names.
    Unknown,
}

/// Finds the record that the sample goes on from among those that the owner holds.
#[must_use]
pub fn base<'a>(sample: &'a Sample, held: impl IntoIterator<Item = &'a Arc<Record>>) -> Base {
    if sample.last == (0, 0) {
        return Base::First;
    }
    held.into_iter()
        .chain(&sample.resume)
        .find(|r| r.position() == sample.last)
        .map_or(Base::Unknown, |r| Base::On(Arc::clone(r)))
}

/// What the operator's side of the loop is in this cycle, after the commands.
#[derive(Debug, Clone, PartialEq)]
pub struct Standing {
    /// Who decides the output.
    pub mode: Mode,
    /// Wanted value.
    pub setpoint: f64,
    /// The operator's outputs.
    pub manual: Vec<f64>,
    /// Outcomes so far, oldest first.
    pub applied: Vec<Applied>,
    /// A change of revision that is asked for in this cycle; its outcome is still open.
    pub revise: Option<(CommandId, u64)>,
}

/// Applies the sample's commands to what the base says. `held` is what the actuators hold, one value per output.
#[must_use]
pub fn settle(base: Option<&Record>, spec: &LoopSpec, sample: &Sample, held: &[f64]) -> Standing {
    let mut s = match base {
        Some(r) => Standing {
            mode: r.mode,
            setpoint: r.setpoint,
            manual: if r.mode == Mode::Manual && r.manual.len() == held.len() {
                r.manual.clone()
            } else {
                held.to_vec()
            },
            applied: r.applied.clone(),
            revise: None,
        },
        None => Standing {
            mode: spec.mode,
            setpoint: spec.setpoint,
            manual: held.to_vec(),
            applied: Vec::new(),
            revise: None,
        },
    };
    let (low, high) = spec.setpoint_range;
    for command in &sample.commands {
        if s.applied.iter().any(|a| a.id == command.id) {
            continue;
        }
        let outcome = match &command.body {
            CommandBody::Setpoint(value) if (low..=high).contains(value) => {
                s.setpoint = *value;
                Outcome::Done
            }
            CommandBody::Setpoint(value) => {
                Outcome::Refused(format!("setpoint {value} is outside the loop's range {low} to {high}"))
            }
            CommandBody::Mode(mode) => {
                if *mode == Mode::Manual && s.mode != Mode::Manual {
                    s.manual = held.to_vec();
                }
                s.mode = *mode;
                Outcome::Done
            }
            CommandBody::Output(_) if s.mode != Mode::Manual => {
                Outcome::Refused("the loop is automatic: put it in manual before its output is set".to_owned())
            }
            CommandBody::Output(values) if values.len() != held.len() => Outcome::Refused(format!(
                "{} output values were given; the component has {}",
                values.len(),
                held.len()
            )),
            CommandBody::Output(values) if !values.iter().all(|v| v.is_finite()) => {
                Outcome::Refused("an output value is not a finite number".to_owned())
            }
            CommandBody::Output(values) => {
                s.manual.clone_from(values);
                Outcome::Done
            }
            // One change of revision per cycle; the next one rides on in the following sample.
            CommandBody::Revise(_) if s.revise.is_some() => continue,
            CommandBody::Revise(revision) => {
                s.revise = Some((command.id, *revision));
                continue;
            }
        };
        s.remember(command.id, outcome);
    }
    s
}

impl Standing {
    /// Notes how a command ended; the oldest outcomes are forgotten.
    pub fn remember(&mut self, id: CommandId, outcome: Outcome) {
        if self.applied.len() >= OUTCOMES_REMEMBERED_MAX {
            let surplus = self.applied.len() + 1 - OUTCOMES_REMEMBERED_MAX;
            self.applied.drain(..surplus);
        }
        self.applied.push(Applied { id, outcome });
    }
}

/// The state that a step goes on from: the base's, unless that is another component's, or empty, or an output was held by a
/// person until the base and is not any more. In these cases the controller starts from what the actuators hold: what it
/// remembers belongs to where the output was before the force. It follows from the base and this cycle's readings alone, so
/// whoever repeats a recorded step decides the same.
#[must_use]
pub fn carried<'a>(
    base: Option<&'a Record>,
    spec: &LoopSpec,
    wiring: &Wiring,
    readings: &[Reading],
) -> Option<&'a Arc<[u8]>> {
    base.filter(|r| r.digest == spec.digest && !r.state.is_empty())
        .filter(|r| r.revision != spec.revision || !released(&r.readings, readings, wiring))
        .map(|r| &r.state)
}

/// Was an output held by a person in the readings before, and is no longer? Both in the order of `wiring`'s ports.
#[must_use]
pub fn released(before: &[Reading], now: &[Reading], wiring: &Wiring) -> bool {
    let forced = |readings: &[Reading], port: u8| {
        readings
            .get(usize::from(port))
            .is_some_and(|r| r.quality == Quality::Forced)
    };
    wiring
        .outputs
        .iter()
        .any(|&port| forced(before, port) && !forced(now, port))
}

/// The frame of a cycle.
#[must_use]
pub fn frame(
    base: Option<&Record>,
    spec: &LoopSpec,
    standing: &Standing,
    sample: &Sample,
    readings: Vec<Reading>,
) -> Frame {
    Frame {
        cycle: Cycle {
            seq: sample.seq,
            at_ns: sample.at_ns,
            dt_ns: dt_ns(base, spec, sample),
            mode: standing.mode,
            setpoint: standing.setpoint,
        },
        readings,
        messages: sample.messages.clone(),
    }
}

/// Time since the base's sample, in ns; the period for a first cycle. At least 1 and at most [`DT_PERIODS_MAX`] periods (or as
/// many times the cycle before, where the period was just changed): over its restart a home knows no time but the machine's
/// date, which may have been set, and a rate limit over an hour is none.
#[must_use]
pub fn dt_ns(base: Option<&Record>, spec: &LoopSpec, sample: &Sample) -> u64 {
    base.map_or(spec.period_ns, |r| {
        let longest_ns = spec.period_ns.max(r.dt_ns).saturating_mul(DT_PERIODS_MAX);
        sample.at_ns.saturating_sub(r.at_ns).clamp(1, longest_ns.max(1))
    })
}

/// Whom to ask for a step, and when to ask the next.
#[derive(Debug, Clone, PartialEq)]
pub struct Attempts {
    order: VecDeque<HostId>,
    here: HostId,
    here_done: bool,
    hedge_ns: u64,
    here_at_ns: u64,
}

/// What to do next.
#[derive(Debug, Clone, PartialEq)]
pub enum Ask {
    /// Ask this host; come back at this time if it is silent.
    Remote(HostId, u64),
    /// Step here, now.
    Here,
    /// Everyone was asked; only answers on their way can still help.
    Nobody,
}

impl Attempts {
    /// `order` is the strategy's; this host is asked last where the strategy did not place it. A silent replica is given
    /// `hedge_ns`; at `here_at_ns` at the latest this host steps itself, so that the commit is never late for a replica.
    #[must_use]
    pub fn new(order: impl IntoIterator<Item = HostId>, here: HostId, hedge_ns: u64, here_at_ns: u64) -> Self {
        Self {
            order: order.into_iter().collect(),
            here,
            here_done: false,
            hedge_ns,
            here_at_ns,
        }
    }

    /// The next host to ask, after a silence or a fault, or at the start.
    pub fn next(&mut self, now_ns: u64) -> Ask {
        let next = if now_ns >= self.here_at_ns && !self.here_done {
            None
        } else {
            self.order.pop_front()
        };
        match next {
            Some(host) if host != self.here => {
                Ask::Remote(host, (now_ns + self.hedge_ns).min(self.here_at_ns.max(now_ns)))
            }
            _ if self.here_done => Ask::Nobody,
            _ => {
                self.here_done = true;
                self.order.retain(|h| *h != self.here);
                Ask::Here
            }
        }
    }
}

/// A good step.
#[derive(Debug, Clone, PartialEq)]
pub struct Stepped {
    /// Its effects.
    pub effects: Effects,
    /// The host that stepped.
    pub by: HostId,
    /// Time of the step as the owner saw it, in ns.
    pub step_ns: u64,
}

/// Everything about a cycle that its conclusion needs.
#[derive(Debug)]
pub struct Conclusion<'a> {
    /// The host that runs the cycle.
    pub owner: &'a HostId,
    /// The cycle's sample.
    pub sample: &'a Sample,
    /// The record before.
    pub base: Option<&'a Record>,
    /// The revision that steps.
    pub spec: &'a LoopSpec,
    /// Its wiring.
    pub wiring: &'a Wiring,
    /// The readings in the wiring's order.
    pub readings: Vec<Reading>,
    /// The state before the step, where a fault leaves it as it was.
    pub state: Arc<[u8]>,
    /// The operator's side.
    pub standing: Standing,
    /// What the cycle met so far.
    pub events: Vec<Event>,
    /// Probation to carry; see [`crate::swap::probation_after`].
    pub probation: Option<(u64, u32)>,
    /// What the cycle could count on.
    pub redundancy: Redundancy,
    /// The step, or why there is none.
    pub step: Result<Stepped, Fault>,
    /// Time from the sample's arrival until now, in ns.
    pub cycle_ns: u64,
}

/// Guards the outputs, or applies the policy where there is no good step, and writes the record to commit.
#[must_use]
pub fn conclude(c: Conclusion<'_>) -> Record {
    let Conclusion {
        owner,
        sample,
        base,
        spec,
        wiring,
        readings,
        state,
        mut standing,
        mut events,
        probation,
        redundancy,
        step,
        cycle_ns,
    } = c;
    let dt_ns = dt_ns(base, spec, sample);
    let held = wiring.held_since(&readings, base, spec.revision);
    tell_forces(&readings, base, spec, &mut events);
    let faults_before = base.map_or(0, |r| r.faults_in_row);
    let wanted_before = wiring.wanted_since(base, &held, spec.revision);
    let (faults_in_row, wanted, outputs, effects, by, step_ns) = match step {
        Ok(Stepped { effects, by, step_ns }) => {
            let wanted = wiring.wanted(&effects.writes, &wanted_before);
            let g = guard::guard(standing.mode, &wanted, &standing.manual, &held, &wiring.limits, dt_ns);
            for i in (0..g.outputs.len()).filter(|i| g.limited >> (i % 64) & 1 == 1) {
                events.push(Event::Limited(wiring.outputs[i]));
            }
            (0, wanted, g.outputs, effects, by, step_ns)
        }
        Err(fault) => {
            let bad_input = matches!(fault, Fault::BadInput(_));
            let faults = faults_before.saturating_add(1);
            let action = match (bad_input, faults > spec.policy.faults_tolerated) {
                (true, _) => spec.policy.on_bad_input,
                (false, true) => spec.policy.on_fault,
                (false, false) => OnFault::Hold,
            };
            events.push(Event::PolicyHeld);
            let outputs = match (standing.mode, action) {
                (Mode::Manual, _) => {
                    guard::guard(
                        Mode::Manual,
                        &wanted_before,
                        &standing.manual,
                        &held,
                        &wiring.limits,
                        dt_ns,
                    )
                    .outputs
                }
                (Mode::Automatic, OnFault::SafeValue) => guard::towards_safe(&held, &wiring.limits, dt_ns),
                (Mode::Automatic, OnFault::Hold) => guard::hold(&held, &wiring.limits),
                (Mode::Automatic, OnFault::Manual) => {
                    standing.mode = Mode::Manual;
                    standing.manual = guard::hold(&held, &wiring.limits);
                    standing.manual.clone()
                }
            };
            // Where the policy moved an output away under a component that saw nothing, what the component remembers belongs to
            // where the output was; where it saw nothing for more than a cycle, to a process that has moved since. It begins
            // anew from the actuator when it sees again, so that the way back has no bump.
            let moved = outputs.iter().zip(&held).any(|(o, h)| o.to_bits() != h.to_bits());
            let again = base.is_some_and(|r| r.events.contains(&Event::PolicyHeld));
            let effects = Effects {
                state: if bad_input && (moved || again) {
                    Vec::new()
                } else {
                    state.to_vec()
                },
                ..Effects::default()
            };
            (
                if bad_input { faults_before } else { faults },
                wanted_before,
                outputs,
                effects,
                owner.clone(),
                0,
            )
        }
    };
    events.extend(redundancy.news(base.map(|r| &r.redundancy)));
    let finite = |values: Vec<f64>, or: &[f64]| -> Vec<f64> {
        values
            .into_iter()
            .zip(or)
            .map(|(v, or)| if v.is_finite() { v } else { *or })
            .collect()
    };
    if let Some(before) = base.filter(|r| r.term != sample.term && r.owner != *owner) {
        events.insert(
            0,
            Event::TookOver {
                from: Some(before.owner.clone()),
            },
        );
    } else if base.is_none() {
        events.insert(0, Event::TookOver { from: None });
    }
    Record {
        loop_id: sample.loop_id.clone(),
        term: sample.term,
        seq: sample.seq,
        after: sample.last,
        revision: spec.revision,
        digest: spec.digest,
        home: sample.home.clone(),
        owner: owner.clone(),
        stepped_by: by,
        at_ns: sample.at_ns,
        dt_ns,
        mode: standing.mode,
        setpoint: standing.setpoint,
        manual: match standing.mode {
            Mode::Manual => finite(standing.manual, &outputs),
            Mode::Automatic => outputs.clone(),
        },
        readings,
        heard: sample.messages.clone(),
        wanted: finite(wanted, &outputs),
        outputs,
        state: Arc::from(effects.state),
        faults_in_row,
        probation,
        redundancy,
        applied: standing.applied,
        events,
        alarms: effects.alarms,
        messages: effects.messages,
        log: effects.log,
        step_ns,
        cycle_ns,
        committed_after_ns: 0,
    }
}

/// Says which points a person began or ceased to hold since the record before.
fn tell_forces(readings: &[Reading], base: Option<&Record>, spec: &LoopSpec, events: &mut Vec<Event>) {
    let before = base
        .filter(|r| r.revision == spec.revision)
        .map_or(&[][..], |r| &r.readings);
    for (port, reading) in (0..=u8::MAX).zip(readings) {
        let was = before
            .get(usize::from(port))
            .is_some_and(|r| r.quality == Quality::Forced);
        match (was, reading.quality == Quality::Forced) {
            (false, true) => events.push(Event::Forced(port)),
            (true, false) => events.push(Event::Unforced(port)),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests;
