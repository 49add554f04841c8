//! A candidate on recorded cycles: it sees what the loop's own controller saw, and moves nothing.
//!
//! Owns: the candidate's state from cycle to cycle, and the figures that make its report.
//! Never: touches a point, runs on a cycle's thread, or claims more than it can: the plant was moved by the recorded
//! controller, so a candidate that would have moved it elsewhere is seen only where it begins to.
//!
//! ```text
//! nothing ──first record──► anchored ──next record: state by "same", migrate or start──► following ──► each record: step
//!                              ▲                                                             │
//!                              └────────────── a record is missing before this one ──────────┘
//! ```

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{
    Cycle, Descriptor, Event, Fault, Frame, LoopId, LoopSpec, Reading, Record, Wiring, guard,
    indices::{Indices, Rule, TotalVariation},
    seat,
    swap::{self, HandOver},
};
use bumpless_engine::{Instance, Origin};
use bumpless_loops::HeldRevision;
use rustix::time::{ClockId, clock_gettime};

use crate::{
    curve::Curve,
    report::{CurvePoint, Finding, IndexReport, OutputReport, Skipped, TrialReport},
    verdict::{judged, times},
};

/// A candidate that spins is stopped after this time by the clock, in ns. The loop's own limit is held against the processor
/// time that a step used: at the lowest priority, the clock says more of the machine than of the candidate.
const STOP_NS: u64 = 100_000_000;

/// Different reasons for leaving cycles out that are told apart; the rest is one.
const REASONS_MAX: usize = 16;

/// A revision that recorded cycles ran under.
#[derive(Debug, Clone)]
pub(crate) struct Known {
    pub(crate) spec: Arc<LoopSpec>,
    pub(crate) wiring: Arc<Wiring>,
    pub(crate) descriptor: Arc<Descriptor>,
}

/// Finds a revision of the loop by its number.
pub(crate) type Finder = Box<dyn Fn(u64) -> Option<Known> + Send>;

/// What a trial is about.
pub(crate) struct Candidate {
    pub(crate) held: HeldRevision,
    /// `name@version`.
    pub(crate) title: String,
    pub(crate) dropped_parameters: Vec<String>,
    pub(crate) dropped_ports: Vec<String>,
}

/// Cycles that were left out, by reason.
#[derive(Debug, Default)]
pub(crate) struct Passed(BTreeMap<String, u64>);

impl Passed {
    pub(crate) fn note(&mut self, reason: &str) {
        let known = self.0.contains_key(reason) || self.0.len() < REASONS_MAX;
        let reason = if known { reason } else { "other reasons" };
        *self.0.entry(reason.to_owned()).or_default() += 1;
    }

    pub(crate) fn told(&self) -> Vec<Skipped> {
        let skipped = |(reason, cycles): (&String, &u64)| Skipped {
            reason: reason.clone(),
            cycles: *cycles,
        };
        self.0.iter().map(skipped).collect()
    }
}

/// What the actuators hold, one value per output, with the safe value where that is not known.
pub(crate) fn track(wiring: &Wiring, readings: &[Reading]) -> Vec<f64> {
    let held = wiring.held(readings);
    let known = |(value, limit): (&f64, &bumpless_core::OutputLimit)| {
        if value.is_finite() { *value } else { limit.safe }
    };
    held.iter().zip(&wiring.limits).map(known).collect()
}

/// What the step of a recorded cycle saw.
pub(crate) fn frame(record: &Record, readings: Vec<Reading>) -> Frame {
    Frame {
        cycle: Cycle {
            seq: record.seq,
            at_ns: record.at_ns,
            dt_ns: record.dt_ns,
            mode: record.mode,
            setpoint: record.setpoint,
        },
        readings,
        messages: record.heard.clone(),
    }
}

/// Did the policy decide this cycle's output?
pub(crate) fn held_by_policy(record: &Record) -> bool {
    record.events.iter().any(|event| matches!(event, Event::PolicyHeld))
}

/// One output that both drive.
#[derive(Debug, Default)]
struct Pair {
    /// Number among the candidate's outputs.
    output: usize,
    span: f64,
    max_percent: f64,
    max_at: (u64, u64),
    sum: f64,
    squares: f64,
    recorded_travel: TotalVariation,
    candidate_travel: TotalVariation,
}

/// A candidate on its way through recorded cycles.
pub(crate) struct Rehearsal {
    loop_id: LoopId,
    candidate: Candidate,
    find: Finder,
    known: BTreeMap<u64, Option<Known>>,
    last: Option<Arc<Record>>,
    state: Option<Vec<u8>>,
    /// The next first state is made from the actuators, whatever the recorded one is.
    anew: bool,
    wanted: Vec<f64>,
    taken_over_by: Option<&'static str>,
    anchored_anew: u64,
    times_ns: (u64, u64),
    cycles: u64,
    compared: u64,
    equal: u64,
    held: u64,
    faults: u64,
    first_fault: Option<Finding>,
    passed: Passed,
    bump_percent: Option<f64>,
    pairs: Vec<Pair>,
    /// Processor time of each good step, in ns; longer than 4 s counts as that.
    steps_ns: Vec<u32>,
    measured: Option<usize>,
    indices: Indices,
    curve: Curve,
}

impl Rehearsal {
    /// A candidate that has seen nothing yet.
    pub(crate) fn new(candidate: Candidate, find: Finder) -> Self {
        let (wiring, descriptor) = (&candidate.held.wiring, &candidate.held.descriptor);
        let connected = |output: &usize| {
            let port = wiring.outputs.get(*output).copied().unwrap_or_default();
            wiring.points.get(usize::from(port)).is_some_and(Option::is_some)
        };
        let pair = |output| Pair {
            output,
            span: wiring.span(output),
            ..Pair::default()
        };
        Self {
            loop_id: candidate.held.spec.id.clone(),
            pairs: (0..wiring.outputs.len()).filter(connected).map(pair).collect(),
            measured: crate::plan::measured_port(descriptor)
                .and_then(|name| descriptor.ports.iter().position(|port| port.name == name)),
            candidate,
            find,
            known: BTreeMap::new(),
            last: None,
            state: None,
            anew: false,
            wanted: Vec::new(),
            taken_over_by: None,
            anchored_anew: 0,
            times_ns: (0, 0),
            cycles: 0,
            compared: 0,
            equal: 0,
            held: 0,
            faults: 0,
            first_fault: None,
            passed: Passed::default(),
            bump_percent: None,
            steps_ns: Vec::new(),
            indices: Indices::new(Rule::Rectangle),
            curve: Curve::default(),
        }
    }

    /// Cycles that the candidate saw.
    pub(crate) const fn cycles(&self) -> u64 {
        self.cycles
    }

    fn known(&mut self, record: &Record) -> Option<Known> {
        let find = &self.find;
        let known = self
            .known
            .entry(record.revision)
            .or_insert_with(|| find(record.revision));
        known.clone().filter(|known| known.spec.digest == record.digest)
    }

    /// Takes the next record. The first one, and the first after a gap, is only gone on from.
    pub(crate) fn take(&mut self, record: &Arc<Record>) {
        let before = self.last.replace(Arc::clone(record));
        let Some(base) = before else { return };
        if record.after != base.position() {
            self.state = None;
            self.anchored_anew += 1;
            self.passed.note("the record before it is missing");
            return;
        }
        let Some(recorded) = self.known(record) else {
            self.state = None;
            self.passed.note("its revision is no longer known");
            return;
        };
        if self.times_ns.0 == 0 {
            self.times_ns.0 = record.at_ns;
        }
        self.times_ns.1 = record.at_ns;
        self.cycles += 1;
        let readings = recorded.wiring.remap(&record.readings, &self.candidate.held.wiring);
        let measurement = self
            .measured
            .and_then(|port| readings.get(port))
            .map(Reading::value_or_last);
        if let Some(measurement) = measurement {
            // A clock that went back at a restart of the home: the index goes on after it.
            let _ = self
                .indices
                .add(record.at_ns as f64 * 1e-9, record.setpoint, measurement);
        }
        // As its own controller, the candidate starts from the actuator when a person lets go of it.
        let ours = &self.candidate.held.wiring;
        let released = base.revision == record.revision
            && seat::released(&recorded.wiring.remap(&base.readings, ours), &readings, ours);
        if released {
            self.state = None;
        }
        self.anew |= released;
        if ours.bad_input(&readings).is_some() {
            self.held += 1;
            return;
        }
        match self.step(&base, record, &recorded, readings) {
            Ok(first) => self.compare(record, &recorded, measurement.unwrap_or(f64::NAN), first),
            Err(fault) => {
                self.faults += 1;
                let text = fault.to_string();
                let position = record.position();
                self.first_fault.get_or_insert(Finding { position, text });
            }
        }
    }

    /// Steps the candidate. Says what the actuators held where this was the first step after a take-over.
    fn step(
        &mut self,
        base: &Record,
        record: &Record,
        recorded: &Known,
        readings: Vec<Reading>,
    ) -> Result<Option<Vec<f64>>, Fault> {
        let held = track(&self.candidate.held.wiring, &readings);
        let (state, first) = match self.state.take() {
            Some(state) => (state, false),
            None => {
                let origin = if self.anew {
                    None
                } else if base.revision == record.revision {
                    Some(recorded.clone())
                } else {
                    self.known(base)
                };
                self.anew = false;
                let (state, by) = take_over(&mut self.candidate.held, origin.as_ref(), &base.state, &held)?;
                self.taken_over_by.get_or_insert(by);
                self.wanted.clone_from(&held);
                (state, true)
            }
        };
        let candidate = &mut self.candidate.held;
        let limit_ns = candidate.spec.step_limit_ns();
        let began_ns = processor_ns();
        let stepped = candidate
            .instance
            .step(&frame(record, readings), &state, STOP_NS.max(limit_ns));
        let used_ns = processor_ns().saturating_sub(began_ns);
        let in_time = |effects| match used_ns {
            used_ns if used_ns > limit_ns => Err(Fault::Overrun {
                limit_us: limit_ns / 1_000,
            }),
            _ => Ok(effects),
        };
        match stepped.and_then(in_time) {
            Ok(effects) => {
                self.steps_ns.push(u32::try_from(used_ns).unwrap_or(u32::MAX));
                self.wanted = candidate.wiring.wanted(&effects.writes, &self.wanted);
                self.state = Some(effects.state);
                Ok(first.then_some(held))
            }
            Err(fault) => {
                // As in a loop: the state stays as it was before the fault.
                self.state = Some(state);
                Err(fault)
            }
        }
    }

    fn compare(&mut self, record: &Record, recorded: &Known, measurement: f64, first: Option<Vec<f64>>) {
        let ours = &self.candidate.held.wiring;
        let theirs = &recorded.wiring;
        let same = |output: usize| ours.same_output(output, theirs);
        // Beyond the limits no difference reaches the actuator.
        let through = |wiring: &Wiring, values: &[f64], output: usize| {
            let (value, limit) = (values.get(output)?, wiring.limits.get(output)?);
            Some(value.max(limit.low).min(limit.high))
        };
        if let Some(held) = first
            && self.bump_percent.is_none()
        {
            let guarded = guard::guard(
                record.mode,
                &self.wanted,
                &record.manual,
                &held,
                &ours.limits,
                record.dt_ns,
            );
            let bumps = self.pairs.iter().filter_map(|pair| {
                let (new, old) = (
                    guarded.outputs.get(pair.output)?,
                    record.outputs.get(same(pair.output)?)?,
                );
                Some(swap::bump_percent(&[*old], &[*new], &[pair.span]))
            });
            self.bump_percent = Some(bumps.fold(0.0, f64::max));
        }
        if held_by_policy(record) {
            self.passed.note("the policy held the recorded output");
            return;
        }
        let (mut recorded_now, mut candidate_now, mut equal) = (Vec::new(), Vec::new(), true);
        let mut apart_percent: f64 = 0.0;
        for pair in &mut self.pairs {
            let theirs_now = same(pair.output).and_then(|other| through(theirs, &record.wanted, other));
            let (Some(old), Some(new)) = (theirs_now, through(ours, &self.wanted, pair.output)) else {
                recorded_now.push(f64::NAN);
                candidate_now.push(f64::NAN);
                equal = false;
                continue;
            };
            let percent = swap::bump_percent(&[old], &[new], &[pair.span]);
            equal &= old.to_bits() == new.to_bits();
            apart_percent = apart_percent.max(percent);
            if percent > pair.max_percent {
                (pair.max_percent, pair.max_at) = (percent, record.position());
            }
            pair.sum += percent;
            pair.squares += percent * percent;
            pair.recorded_travel.add(old);
            pair.candidate_travel.add(new);
            recorded_now.push(old);
            candidate_now.push(new);
        }
        self.compared += 1;
        self.equal += u64::from(equal);
        let point = CurvePoint {
            at_ns: record.at_ns,
            setpoint: record.setpoint,
            measurement,
            recorded: recorded_now,
            candidate: candidate_now,
        };
        self.curve.add(point, apart_percent);
    }

    /// What was found so far.
    pub(crate) fn report(&self) -> TrialReport {
        let held = &self.candidate.held;
        let port = |number: usize| held.descriptor.ports.get(number);
        let n = (self.compared as f64).max(1.0);
        let output = |pair: &Pair| {
            let number = held.wiring.outputs.get(pair.output).copied().unwrap_or_default();
            let face = port(usize::from(number));
            OutputReport {
                port: face.map_or_else(|| number.to_string(), |port| port.name.clone()),
                unit: face.map(|port| port.unit.clone()).unwrap_or_default(),
                span: pair.span,
                max_percent: pair.max_percent,
                max_at: pair.max_at,
                mean_percent: pair.sum / n,
                rms_percent: (pair.squares / n).sqrt(),
                recorded_travel: pair.recorded_travel.value(),
                candidate_travel: pair.candidate_travel.value(),
            }
        };
        let mut report = TrialReport {
            loop_id: self.loop_id.clone(),
            component: self.candidate.title.clone(),
            digest: held.spec.digest,
            parameters: held.spec.parameters.clone(),
            dropped_parameters: self.candidate.dropped_parameters.clone(),
            dropped_ports: self.candidate.dropped_ports.clone(),
            taken_over_by: self.taken_over_by.map(str::to_owned),
            anchored_anew: self.anchored_anew,
            from_ns: self.times_ns.0,
            to_ns: self.times_ns.1,
            cycles: self.cycles,
            compared: self.compared,
            equal: self.equal,
            held: self.held,
            faults: self.faults,
            first_fault: self.first_fault.clone(),
            skipped: self.passed.told(),
            bump_percent: self.bump_percent,
            bump_limit_percent: held.spec.policy.bump_limit_percent,
            outputs: self.pairs.iter().map(output).collect(),
            steps: times(&self.steps_ns),
            indices: IndexReport {
                duration_s: self.indices.duration_s(),
                ie: self.indices.ie(),
                iae: self.indices.iae(),
                ise: self.indices.ise(),
                itae: self.indices.itae(),
                id_percent: self.indices.id_percent(),
            },
            verdict: None,
            reason: String::new(),
            measured_port: self.measured.and_then(port).map(|port| port.name.clone()),
            measured_unit: self
                .measured
                .and_then(port)
                .map(|port| port.unit.clone())
                .unwrap_or_default(),
            cycles_per_point: self.curve.cycles_per_point(),
            points: self.curve.points(),
            unread: 0,
            stopped_early: None,
        };
        (report.verdict, report.reason) = judged(&report);
        report
    }
}

/// The candidate's first state, as a swap would make it.
fn take_over(
    held: &mut HeldRevision,
    from: Option<&Known>,
    state: &[u8],
    track: &[f64],
) -> Result<(Vec<u8>, &'static str), Fault> {
    let limit_ns = STOP_NS.max(held.spec.step_limit_ns());
    let (instance, parameters): (&mut Instance, _) = (&mut held.instance, &held.wiring.parameters);
    if let Some(from) = from.filter(|_| !state.is_empty()) {
        if swap::hand_over(&from.spec, &held.spec) == HandOver::Same {
            return Ok((state.to_vec(), "same"));
        }
        let origin = Origin {
            name: from.descriptor.name.clone(),
            version: from.descriptor.version.clone(),
            state_layout: from.descriptor.state_layout,
        };
        if let Ok(state) = instance.migrate(&origin, state, parameters, track, limit_ns) {
            return Ok((state, "migrate"));
        }
    }
    instance
        .start(parameters, track, limit_ns)
        .map(|state| (state, "start"))
}

/// Processor time of this thread so far, in ns.
fn processor_ns() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    let part = |value: i64| u64::try_from(value).unwrap_or_default();
    part(time.tv_sec)
        .saturating_mul(1_000_000_000)
        .saturating_add(part(time.tv_nsec))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_are_counted_and_their_number_is_bounded() {
        let mut passed = Passed::default();
        for i in 0..100 {
            passed.note(&format!("reason {}", i % 30));
        }
        let told = passed.told();
        assert_eq!(told.len(), REASONS_MAX + 1);
        assert_eq!(told.iter().map(|skipped| skipped.cycles).sum::<u64>(), 100);
        assert!(told.iter().any(|skipped| skipped.reason == "other reasons"));
    }
}
