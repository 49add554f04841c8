//! Recorded steps made again by the component that made them: every one must come out equal to the last bit.
//!
//! Owns: the comparison. Never: repeats what was no step of a component: a cycle that the policy held, and a switch, in
//! which two components stepped and one was chosen.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use bumpless_core::{Effects, Event, LoopId, Record, Wiring, seat};
use bumpless_loops::HeldRevision;

use crate::{
    rehearsal::{Passed, frame, held_by_policy, track},
    report::{Finding, ReplayReport},
};

/// Longest time of one step, in ns: far beyond a loop's own limit, for a replay asks what comes out and not how fast.
const STEP_LIMIT_NS: u64 = 100_000_000;

/// A replay on its way.
pub(crate) struct Replay {
    loop_id: LoopId,
    /// What steps, by revision; or why there is nothing.
    steppers: BTreeMap<u64, Result<HeldRevision, String>>,
    last: Option<Arc<Record>>,
    times_ns: (u64, u64),
    compared: u64,
    equal: u64,
    passed: Passed,
    first_difference: Option<Finding>,
}

impl Replay {
    pub(crate) fn new(loop_id: LoopId) -> Self {
        Self {
            loop_id,
            steppers: BTreeMap::new(),
            last: None,
            times_ns: (0, 0),
            compared: 0,
            equal: 0,
            passed: Passed::default(),
            first_difference: None,
        }
    }

    /// Steps compared.
    pub(crate) const fn compared(&self) -> u64 {
        self.compared
    }

    /// Revisions of these records that were not provided yet.
    pub(crate) fn missing(&self, records: &[Arc<Record>]) -> BTreeSet<u64> {
        let revisions = records.iter().map(|record| record.revision);
        revisions
            .filter(|revision| !self.steppers.contains_key(revision))
            .collect()
    }

    /// What steps a revision, or why it cannot be stepped.
    pub(crate) fn provide(&mut self, revision: u64, stepper: Result<HeldRevision, String>) {
        self.steppers.insert(revision, stepper);
    }

    /// Takes the next record.
    pub(crate) fn take(&mut self, record: &Arc<Record>) {
        let before = self.last.replace(Arc::clone(record));
        let first_of_all = record.after == (0, 0);
        let base = before.filter(|base| base.position() == record.after);
        if base.is_none() && !first_of_all {
            // The first of the window is only gone on from; that is no gap.
            if self.times_ns.0 != 0 {
                self.passed.note("the record before it is missing");
            }
            self.times_ns.0 = self.times_ns.0.max(1);
            return;
        }
        if self.times_ns.0 <= 1 {
            self.times_ns.0 = record.at_ns;
        }
        self.times_ns.1 = record.at_ns;
        if held_by_policy(record) {
            return self.passed.note("the policy held the output, no step was taken");
        }
        let switch = |event: &Event| matches!(event, Event::Revised { .. } | Event::RolledBack { .. });
        if record.events.iter().any(switch) {
            return self.passed.note("a switch between two revisions");
        }
        let held = match self.steppers.get_mut(&record.revision) {
            Some(Ok(held)) if held.spec.digest == record.digest => held,
            Some(Err(reason)) => return self.passed.note(reason),
            Some(Ok(_)) | None => return self.passed.note("its revision is no longer known"),
        };
        if record.readings.len() != held.wiring.points.len() {
            return self.passed.note("its readings do not fit the component's ports");
        }
        self.compared += 1;
        match again(held, base.as_deref(), record) {
            Ok(()) => self.equal += 1,
            Err(text) => {
                let position = record.position();
                self.first_difference.get_or_insert(Finding { position, text });
            }
        }
    }

    /// What was found so far.
    pub(crate) fn report(&self) -> ReplayReport {
        ReplayReport {
            loop_id: self.loop_id.clone(),
            from_ns: if self.times_ns.1 == 0 { 0 } else { self.times_ns.0 },
            to_ns: self.times_ns.1,
            compared: self.compared,
            equal: self.equal,
            skipped: self.passed.told(),
            first_difference: self.first_difference.clone(),
            unread: 0,
            stopped_early: None,
        }
    }
}

/// Makes a recorded step again. Says in words what came out otherwise.
fn again(held: &mut HeldRevision, base: Option<&Record>, record: &Record) -> Result<(), String> {
    let actuators = held.wiring.held_since(&record.readings, base, held.spec.revision);
    let carried = seat::carried(base, &held.spec, &held.wiring, &record.readings);
    let state: Arc<[u8]> = match carried {
        Some(state) => Arc::clone(state),
        // As its owner did: a first state from what the actuators held.
        None => {
            let track = track(&held.wiring, &record.readings);
            let started = held.instance.start(&held.wiring.parameters, &track, STEP_LIMIT_NS);
            Arc::from(started.map_err(|fault| format!("the first state cannot be made: {fault}"))?)
        }
    };
    let effects = held
        .instance
        .step(&frame(record, record.readings.clone()), &state, STEP_LIMIT_NS)
        .map_err(|fault| format!("the step fails now: {fault}"))?;
    let before = held.wiring.wanted_since(base, &actuators, held.spec.revision);
    let names = |output: usize| {
        let port = held.wiring.outputs.get(output).copied().unwrap_or_default();
        let port = held.descriptor.ports.get(usize::from(port));
        port.map_or_else(|| output.to_string(), |port| port.name.clone())
    };
    difference(&held.wiring, &names, &before, &effects, record).map_or(Ok(()), Err)
}

fn difference(
    wiring: &Wiring,
    name: &dyn Fn(usize) -> String,
    before: &[f64],
    effects: &Effects,
    record: &Record,
) -> Option<String> {
    let wanted = wiring.wanted(&effects.writes, before);
    // As it was recorded: what is not finite became what was sent.
    let finite = wanted
        .iter()
        .zip(&record.outputs)
        .map(|(value, sent)| if value.is_finite() { *value } else { *sent });
    for (output, (now, then)) in finite.zip(&record.wanted).enumerate() {
        if now.to_bits() != then.to_bits() {
            return Some(format!("output {} was {then}, and is {now} now", name(output)));
        }
    }
    if wanted.len() != record.wanted.len() {
        return Some(format!(
            "{} outputs were recorded, and {} came now",
            record.wanted.len(),
            wanted.len()
        ));
    }
    if *effects.state != *record.state {
        let (then, now) = (record.state.len(), effects.state.len());
        let at = effects.state.iter().zip(record.state.iter()).position(|(a, b)| a != b);
        return Some(match at {
            Some(at) => format!("the state after it differs from byte {at} on"),
            None => format!("the state after it had {then} bytes, and has {now} now"),
        });
    }
    let parts = [
        ("messages", effects.messages == record.messages),
        ("alarms", effects.alarms == record.alarms),
        ("log lines", effects.log == record.log),
    ];
    let (what, _) = parts.iter().find(|(_, equal)| !equal)?;
    Some(format!("its {what} differ"))
}
