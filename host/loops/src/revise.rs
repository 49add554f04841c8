//! Going on with another revision inside a cycle: forwards when a command asks for it, backwards when probation fails.
//!
//! Both components step on the same frame here, on the owner, so the bump is measured and not guessed. Where the loop votes, the
//! replicas repeat the change, and the majority's first step is the one that counts:
//!
//! ```text
//! old step, state handed over, new step, bump: here ─► no vote ─────────────────────────────────────► taken, or refused
//!                                                  └─► ballot: replicas hand over and step ─► majority ─► taken, its bump measured
//!                                                                                        └─► none ─► refused, the cycle holds
//! ```
//! Never: goes on from a state that one machine alone has made, where the loop votes; but for the way back in probation.

use std::sync::Arc;

use bumpless_core::{
    CommandId, Effects, Event as CycleEvent, Fault, Frame, LoopId, Mode, OnBump, Outcome, OutputLimit, Reading, guard,
    protocol::Switch,
    seat::Stepped,
    swap,
    vote::{Ballot, Cast},
};
use bumpless_engine::Origin;

use crate::{
    event::HeldRevision,
    seat::{Running, Seat},
    worker::Worker,
};

/// A first state, or one taken over: `migrate`, and `start` from what the actuators hold where that is declined.
pub(crate) fn take_over(
    held: &mut HeldRevision,
    from: Option<(&Origin, &[u8])>,
    track: &[f64],
    limit_ns: u64,
) -> Result<(Vec<u8>, &'static str), Fault> {
    if let Some((origin, state)) = from.filter(|(_, state)| !state.is_empty())
        && let Ok(state) = held
            .instance
            .migrate(origin, state, &held.wiring.parameters, track, limit_ns)
    {
        return Ok((state, "migrate"));
    }
    held.instance
        .start(&held.wiring.parameters, track, limit_ns)
        .map(|state| (state, "start"))
}

/// The state to hand to `migrate`, where it speaks of the same points.
fn carried<'a>(hand_over: swap::HandOver, from: &'a Origin, state: &'a [u8]) -> Option<(&'a Origin, &'a [u8])> {
    (hand_over != swap::HandOver::Start).then_some((from, state))
}

/// What the actuators hold, with the safe value where that is not known.
pub(crate) fn track(held: &HeldRevision, readings: &[Reading]) -> Vec<f64> {
    let values = held.wiring.held(readings);
    values
        .iter()
        .zip(&held.wiring.limits)
        .map(|(v, l)| if v.is_finite() { *v } else { l.safe })
        .collect()
}

fn origin(held: &HeldRevision) -> Origin {
    Origin {
        name: held.descriptor.name.clone(),
        version: held.descriptor.version.clone(),
        state_layout: held.descriptor.state_layout,
    }
}

pub(crate) fn missing_input(held: &HeldRevision, port: u8) -> Fault {
    let name = held
        .descriptor
        .ports
        .get(usize::from(port))
        .map_or_else(|| port.to_string(), |p| p.name.clone());
    Fault::BadInput(format!("{name} has no usable value"))
}

impl Worker {
    /// No good step. In probation, the old component gets this very cycle; else the loop's policy decides.
    pub(crate) fn without_a_step(&mut self, id: &LoopId, mut running: Running, fault: Fault) {
        // Too few replicas say nothing about the component, and the way back is one machine's work.
        let too_few = running.redundancy.vote.is_some() && matches!(fault, Fault::NotReady { .. });
        let back = running
            .base
            .as_ref()
            .and_then(|r| r.probation)
            .map(|(revision, _)| revision)
            .filter(|_| !too_few);
        let Some(seat) = self.seats.get_mut(id) else { return };
        let places = back.and_then(|back| {
            let new = seat
                .held
                .iter()
                .position(|h| h.spec.revision == running.sample.revision)?;
            let old = seat.held.iter().position(|h| h.spec.revision == back)?;
            Some((new, old))
        });
        let Some((new, old)) = places else {
            return self.conclude(id, running, Err(fault));
        };
        let readings = seat.held[new]
            .wiring
            .remap(&running.frame.readings, &seat.held[old].wiring);
        let (from, hand_over) = (
            origin(&seat.held[new]),
            swap::hand_over(&seat.held[new].spec, &seat.held[old].spec),
        );
        let actuators = track(&seat.held[old], &readings);
        let (left, back) = (&seat.held[new].wiring, &seat.held[old].wiring);
        running.standing.manual = back.outputs_from(&running.standing.manual, left, &actuators);
        let held = &mut seat.held[old];
        let limit_ns = held.spec.step_limit_ns();
        let frame = Frame {
            readings: readings.clone(),
            ..running.frame.clone()
        };
        let began_ns = self.shared.now_ns();
        let step = match held.wiring.bad_input(&readings) {
            Some(port) => Err(missing_input(held, port)),
            None => {
                let carried = carried(hand_over, &from, &running.state);
                let taken = take_over(held, carried, &actuators, limit_ns);
                taken.and_then(|(state, _)| {
                    running.state = Arc::from(state);
                    held.instance.step(&frame, &running.state, limit_ns)
                })
            }
        };
        let step_ns = self.shared.now_ns() - began_ns;
        running.events.push(CycleEvent::RolledBack {
            from: running.sample.revision,
            reason: fault.to_string(),
        });
        let by = self.shared.here.clone();
        let step = step.map(|effects| Stepped { effects, by, step_ns });
        self.conclude_with(id, running, step, old, readings, None);
    }

    /// In probation: why this step must not count, if so. The component before gives the measure: it steps here on the same
    /// frame, from the same state, and what it sends is what the loop would have had. Where it has no answer there is no
    /// measure, and the step counts.
    pub(crate) fn on_probation(&mut self, id: &LoopId, running: &Running, stepped: &Stepped) -> Option<Fault> {
        let (back, _) = running.base.as_ref()?.probation?;
        let seat = self.seats.get_mut(id)?;
        let place = |revision| seat.held.iter().position(|h| h.spec.revision == revision);
        let (new, old) = (place(running.sample.revision)?, place(back)?);
        let (now, policy) = (&seat.held[new], &seat.held[new].spec.policy);
        let actuators = track(now, &running.frame.readings);
        let wanted = now.wiring.wanted(&stepped.effects.writes, &actuators);
        let outside = |held: &HeldRevision, wanted: &[f64], output: usize| {
            let (value, limit) = (wanted.get(output), held.wiring.limits.get(output));
            value.zip(limit).is_some_and(|(v, l)| !(l.low..=l.high).contains(v))
        };
        let compared = policy.probation_deviation_percent.is_some();
        if running.standing.mode == Mode::Manual || !(compared || (0..wanted.len()).any(|i| outside(now, &wanted, i))) {
            return None;
        }
        let limit_percent = policy.probation_deviation_percent.unwrap_or(f64::INFINITY);
        let (from, hand_over) = (origin(now), swap::hand_over(&now.spec, &seat.held[old].spec));
        let readings = now.wiring.remap(&running.frame.readings, &seat.held[old].wiring);
        let before = &mut seat.held[old];
        let limit_ns = before.spec.step_limit_ns();
        let held = track(before, &readings);
        let (state, _) = take_over(before, carried(hand_over, &from, &running.state), &held, limit_ns).ok()?;
        let frame = Frame {
            readings,
            ..running.frame.clone()
        };
        let effects = before.instance.step(&frame, &state, limit_ns).ok()?;
        let before = &seat.held[old];
        let usual = before.wiring.wanted(&effects.writes, &held);
        let now = &seat.held[new];
        for (i, value) in wanted.iter().enumerate() {
            let name = || now.descriptor.ports[usize::from(now.wiring.outputs[i])].name.clone();
            let Some(j) = now.wiring.same_output(i, &before.wiring) else {
                continue;
            };
            if outside(now, &wanted, i) && !outside(before, &usual, j) {
                let OutputLimit { low, high, .. } = now.wiring.limits[i];
                return Some(Fault::Probation(format!(
                    "{} = {value} is outside its limits, {low} to {high}, and the component before stays within",
                    name()
                )));
            }
            // Both as the limits let them through: beyond them no difference reaches the actuator.
            let through = |held: &HeldRevision, value: f64, output: usize| {
                let limit = held.wiring.limits[output];
                value.clamp(limit.low, limit.high)
            };
            let apart = through(now, *value, i) - through(before, usual[j], j);
            let percent = swap::bump_percent(&[0.0], &[apart], &[now.wiring.span(i)]);
            if percent > limit_percent {
                return Some(Fault::Probation(format!(
                    "{} is {percent:.3} % of its span away from what the component before sends; the loop allows \
                     {limit_percent} % (policy.probation_deviation_percent)",
                    name()
                )));
            }
        }
        None
    }

    /// A change of revision: both components step on the same frame here, and the bump decides; then the replicas, where there is a
    /// ballot. `fault` is the old one's, where it need not be tried.
    pub(crate) fn revise(
        &mut self,
        id: &LoopId,
        mut running: Running,
        (command, revision): (CommandId, u64),
        fault: Option<Fault>,
        ballot: Option<Ballot>,
    ) {
        let Some(seat) = self.seats.get_mut(id) else { return };
        let Some(old_index) = place(seat, running.sample.revision) else {
            return;
        };
        let began_ns = self.shared.now_ns();
        // The old component first: whatever the new one does, this cycle has an answer.
        let old = &mut seat.held[old_index];
        let limit_ns = old.spec.step_limit_ns();
        let old_step = match fault {
            Some(fault) => Err(fault),
            None => old.instance.step(&running.frame, &running.state, limit_ns),
        };
        if let Err(fault) = &old_step {
            let spent_ns = self.shared.now_ns().saturating_sub(began_ns);
            seat.remember_fault(&running, fault, spent_ns);
        }
        let mut attempt = match place(seat, revision) {
            Some(new_index) if new_index != old_index => {
                try_revision(seat, old_index, new_index, &running, old_step.as_ref().ok())
            }
            Some(_) => Err(format!("revision {revision} is in force already")),
            None => Err(format!(
                "revision {revision} is not prepared on {}, the loop's owner",
                self.shared.here
            )),
        };
        let step_ns = self.shared.now_ns() - began_ns;
        if let Ok(tried) = &mut attempt {
            let mut own = Ok(std::mem::take(&mut tried.effects));
            self.shared.disturb(&mut own);
            tried.effects = own.unwrap_or_default();
        }
        match (attempt, ballot) {
            (Ok(tried), Some(ballot)) => {
                let own = Ok(tried.effects.clone());
                running.switch = Some(Box::new(Switching {
                    command,
                    tried,
                    old_effects: old_step.ok(),
                }));
                self.open_ballot_with(id, running, ballot, own);
            }
            (Ok(tried), None) => self.take_revision(id, running, command, tried, step_ns),
            (Err(reason), ballot) => {
                running.standing.remember(command, Outcome::Refused(reason));
                let by = self.shared.here.clone();
                match (old_step, ballot) {
                    (Ok(_), Some(ballot)) => self.open_ballot(id, running, ballot),
                    (Ok(effects), None) => self.conclude(id, running, Ok(Stepped { effects, by, step_ns })),
                    (Err(fault), _) => self.without_a_step(id, running, fault),
                }
            }
        }
    }

    /// Ends the cycle under the new revision.
    fn take_revision(&mut self, id: &LoopId, mut running: Running, command: CommandId, tried: Tried, step_ns: u64) {
        let Some(seat) = self.seats.get_mut(id) else { return };
        let Some((old_index, index)) = place(seat, running.sample.revision).zip(place(seat, tried.revision)) else {
            return;
        };
        running.events.push(CycleEvent::Revised {
            from: running.sample.revision,
            from_digest: seat.held[old_index].spec.digest,
            by: tried.by.to_owned(),
            bump_percent: tried.bump_percent,
        });
        if let Some(limit_percent) = tried.over_percent {
            running.events.push(CycleEvent::OverBump {
                bump_percent: tried.bump_percent,
                limit_percent,
            });
        }
        running.standing.remember(command, Outcome::Done);
        let spec = &seat.held[index].spec;
        let probation = (spec.policy.probation_cycles > 0 && tried.by != "same")
            .then_some((running.sample.revision, spec.policy.probation_cycles));
        running.standing.manual = tried.manual;
        running.state = tried.state;
        let step = Ok(Stepped {
            effects: tried.effects,
            by: self.shared.here.clone(),
            step_ns,
        });
        self.conclude_with(id, running, step, index, tried.readings, probation);
    }

    /// The replicas have voted on a change: what a majority made of it, or why there is none.
    pub(crate) fn switched(
        &mut self,
        id: &LoopId,
        mut running: Running,
        decided: Result<Effects, String>,
        step_ns: u64,
    ) {
        let Some(switching) = running.switch.take() else { return };
        let Switching {
            command,
            mut tried,
            old_effects,
        } = *switching;
        let Some(seat) = self.seats.get_mut(id) else { return };
        let taken = decided.and_then(|effects| {
            if !Cast::Effects(effects.clone()).same(&Cast::Effects(tried.effects.clone())) {
                // This host was outvoted, so what it measured was not what will be sent.
                tried.effects = effects;
                let places = place(seat, running.sample.revision).zip(place(seat, tried.revision));
                let (old, new) = places.ok_or_else(|| format!("revision {} was released meanwhile", tried.revision))?;
                tried.bump_percent = bump_percent(
                    seat,
                    (old, new),
                    &running,
                    &tried.readings,
                    old_effects.as_ref(),
                    &tried.effects,
                );
                tried.over_percent = over_percent(&seat.held[new], tried.bump_percent)?;
            }
            Ok(tried)
        });
        match taken {
            Ok(tried) => self.take_revision(id, running, command, tried, step_ns),
            Err(reason) => {
                running.standing.remember(command, Outcome::Refused(reason.clone()));
                let fault = Fault::NotReady {
                    host: "a majority".to_owned(),
                    reason,
                };
                self.without_a_step(id, running, fault);
            }
        }
    }
}

/// A new revision that may take over.
pub(crate) struct Tried {
    revision: u64,
    readings: Vec<Reading>,
    /// The operator's outputs, in its order.
    manual: Vec<f64>,
    state: Arc<[u8]>,
    effects: Effects,
    by: &'static str,
    bump_percent: f64,
    /// The loop's limit, where the bump is beyond it and the policy lets it pass.
    over_percent: Option<f64>,
}

/// A change that waits for the votes of other hosts.
pub(crate) struct Switching {
    command: CommandId,
    tried: Tried,
    /// What the old component would have sent; none where it failed.
    old_effects: Option<Effects>,
}

impl Switching {
    /// The revision that comes in.
    pub(crate) const fn to(&self) -> u64 {
        self.tried.revision
    }

    /// One reading per port of its component.
    pub(crate) fn readings(&self) -> &[Reading] {
        &self.tried.readings
    }
}

fn place(seat: &Seat, revision: u64) -> Option<usize> {
    seat.held.iter().position(|h| h.spec.revision == revision)
}

/// The new component's first step, from the state of the old one.
struct Entered {
    state: Arc<[u8]>,
    by: &'static str,
    effects: Effects,
}

/// Hands the state over and steps the new component. An error says what failed, and how.
fn enter(
    seat: &mut Seat,
    (old, new): (usize, usize),
    frame: &Frame,
    state: &Arc<[u8]>,
) -> Result<Entered, (&'static str, Fault)> {
    let (from, hand_over) = (
        origin(&seat.held[old]),
        swap::hand_over(&seat.held[old].spec, &seat.held[new].spec),
    );
    let new = &mut seat.held[new];
    let limit_ns = new.spec.step_limit_ns();
    let actuators = track(new, &frame.readings);
    let (state, by): (Arc<[u8]>, _) = match hand_over {
        swap::HandOver::Same => (Arc::clone(state), "same"),
        other => take_over(new, carried(other, &from, state), &actuators, limit_ns)
            .map(|(state, by)| (Arc::from(state), by))
            .map_err(|fault| ("no state could be made for the new component", fault))?,
    };
    let effects = new
        .instance
        .step(frame, &state, limit_ns)
        .map_err(|fault| ("its first step failed", fault))?;
    Ok(Entered { state, by, effects })
}

/// A change that another host votes on, repeated here. None where one of the two revisions is not held.
pub(crate) fn repeat(
    seat: &mut Seat,
    switch: Switch,
    frame: &Frame,
    state: &Arc<[u8]>,
) -> Option<Result<Effects, Fault>> {
    let (old, new) = place(seat, switch.from).zip(place(seat, switch.to))?;
    if frame.readings.len() != seat.held[new].wiring.points.len() {
        return None;
    }
    let entered = enter(seat, (old, new), frame, state);
    Some(entered.map(|entered| entered.effects).map_err(|(_, fault)| fault))
}

/// By how much the outputs of the new component differ from what the old one would have sent, in % of their spans.
fn bump_percent(
    seat: &Seat,
    (old, new): (usize, usize),
    running: &Running,
    readings: &[Reading],
    old_effects: Option<&Effects>,
    new_effects: &Effects,
) -> f64 {
    let (old, new) = (&seat.held[old], &seat.held[new]);
    let dt_ns = running.frame.cycle.dt_ns;
    let mode = running.standing.mode;
    let actuators_old = track(old, &running.frame.readings);
    // What the old controller would have sent; where it has no answer, it would have held.
    let old_outputs = old_effects.map_or_else(
        || actuators_old.clone(),
        |effects| {
            let wanted = old.wiring.wanted(&effects.writes, &actuators_old);
            let manual = &running.standing.manual;
            guard::guard(mode, &wanted, manual, &actuators_old, &old.wiring.limits, dt_ns).outputs
        },
    );
    let actuators = track(new, readings);
    let wanted = new.wiring.wanted(&new_effects.writes, &actuators);
    let manual = new
        .wiring
        .outputs_from(&running.standing.manual, &old.wiring, &actuators);
    let new_outputs = guard::guard(mode, &wanted, &manual, &actuators, &new.wiring.limits, dt_ns).outputs;
    swap::bump_between((&old.wiring, &old_outputs), (&new.wiring, &new_outputs), &actuators)
}

/// The loop's limit, where a bump is beyond it and the policy lets it pass; in words where it does not.
fn over_percent(new: &HeldRevision, bump_percent: f64) -> Result<Option<f64>, String> {
    let limit = new.spec.policy.bump_limit_percent;
    let over = (bump_percent > limit).then_some(limit);
    if over.is_some() && new.spec.policy.on_bump == OnBump::Refuse {
        return Err(format!(
            "the output would step by {bump_percent:.3} % of its span beyond what the old controller does; \
             the loop allows {limit} % (policy.bump_limit_percent)"
        ));
    }
    Ok(over)
}

/// Hands the state over, steps the new component on the same frame and measures the bump. Says in words why not.
fn try_revision(
    seat: &mut Seat,
    old_index: usize,
    new_index: usize,
    running: &Running,
    old_effects: Option<&Effects>,
) -> Result<Tried, String> {
    let revision = seat.held[new_index].spec.revision;
    let readings = match &running.sample.next_readings {
        Some((of, readings)) if *of == revision => readings.clone(),
        _ => {
            let old = &seat.held[old_index];
            old.wiring.remap(&running.frame.readings, &seat.held[new_index].wiring)
        }
    };
    let new = &mut seat.held[new_index];
    if readings.len() != new.wiring.points.len() {
        return Err("the sample's readings do not fit the new component's ports".to_owned());
    }
    if let Some(port) = new.wiring.bad_input(&readings) {
        return Err(missing_input(new, port).to_string());
    }
    let frame = Frame {
        readings: readings.clone(),
        ..running.frame.clone()
    };
    let places = (old_index, new_index);
    let Entered { state, by, effects } =
        enter(seat, places, &frame, &running.state).map_err(|(what, fault)| format!("{what}: {fault}"))?;
    let bump_percent = bump_percent(seat, places, running, &readings, old_effects, &effects);
    let (old, new) = (&seat.held[old_index], &seat.held[new_index]);
    let over_percent = over_percent(new, bump_percent)?;
    let manual = new
        .wiring
        .outputs_from(&running.standing.manual, &old.wiring, &track(new, &readings));
    Ok(Tried {
        revision,
        readings,
        manual,
        state,
        effects,
        by,
        bump_percent,
        over_percent,
    })
}
