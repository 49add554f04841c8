//! The holder's shell around `core::seat`: runs a cycle when a sample names this host, steps for others when asked.
//!
//! ```text
//! sample ─► base? ─ no ─► NeedRecord
//!            │ yes
//!            ▼
//!          settle ─► [revise: old and new component on the same frame, here] ─► conclude ─► commit
//!            │ no change
//!            ▼
//!          attempts: replica ─ answer ─► conclude ─► commit
//!                      │ silent for the hedge time, gone, or faulted: the next; this host at the latest
//!                      ▼
//!                    nobody left: in probation back to the old component in this same cycle, else the loop's policy
//! ```

use std::{collections::VecDeque, sync::Arc};

use bumpless_core::{
    Effects, Event as CycleEvent, Fault, Frame, HostId, LoopId, Outcome, Reading, Record,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
    seat::{self, Ask, Attempts, Base, Conclusion, Standing, Stepped},
    select, swap,
};
use bumpless_engine::Origin;

use crate::{
    event::HeldRevision,
    worker::{Timer, Worker},
};

/// Questions whose late answers still teach something about a replica's latency.
const RECENT_MAX: usize = 16;
/// The owner steps itself when this part of the time until the commit is overdue has passed.
const HERE_PART: f64 = 0.6;
/// A replica is given at least this long, in ns: below it, the scheduler's noise would look like silence.
const HEDGE_NS_MIN: u64 = 1_500_000;
/// A replica is given this multiple of its smoothed latency, where that is less than the policy's part of the period.
const HEDGE_LATENCIES: u64 = 8;

struct Asked {
    correlation: u64,
    host: HostId,
    at_ns: u64,
}

/// A cycle on its way.
struct Running {
    sample: Box<Sample>,
    base: Option<Arc<Record>>,
    frame: Frame,
    state: Arc<[u8]>,
    standing: Standing,
    events: Vec<CycleEvent>,
    attempts: Attempts,
    asked: Vec<Asked>,
    fault: Option<Fault>,
    started_ns: u64,
    next_at_ns: u64,
    give_up_at_ns: u64,
}

#[derive(Default)]
pub(crate) struct Seat {
    held: Vec<HeldRevision>,
    last: Option<Arc<Record>>,
    /// Our own commit that no record has confirmed yet.
    inflight: Option<Arc<Record>>,
    running: Option<Running>,
    recent: VecDeque<Asked>,
    owned: bool,
}

impl Seat {
    fn held(&mut self, revision: u64) -> Option<&mut HeldRevision> {
        self.held.iter_mut().find(|h| h.spec.revision == revision)
    }

    pub(crate) fn waits_for(&self, host: &HostId) -> bool {
        self.running
            .as_ref()
            .is_some_and(|r| r.asked.iter().any(|a| a.host == *host))
    }
}

/// A first state, or one taken over: `migrate`, and `start` from what the actuators hold where that is declined.
fn take_over(
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

/// What the actuators hold, with the safe value where that is not known.
fn track(held: &HeldRevision, readings: &[Reading]) -> Vec<f64> {
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

fn missing_input(held: &HeldRevision, port: u8) -> Fault {
    let name = held
        .descriptor
        .ports
        .get(usize::from(port))
        .map_or_else(|| port.to_string(), |p| p.name.clone());
    Fault::BadInput(format!("{name} has no usable value"))
}

impl Worker {
    pub(crate) fn hold(&mut self, revision: HeldRevision) {
        let id = revision.spec.id.clone();
        if !self.seats.contains_key(&id) {
            self.shared.count_held(1);
        }
        let seat = self.seats.entry(id).or_default();
        if let Some(i) = seat.held.iter().position(|h| h.spec.revision == revision.spec.revision) {
            let old = std::mem::replace(&mut seat.held[i], revision);
            self.shared.bury(old.instance);
        } else {
            seat.held.push(revision);
        }
    }

    pub(crate) fn keep_revisions(&mut self, id: &LoopId, keep: &[u64]) {
        let Some(seat) = self.seats.get_mut(id) else { return };
        // What a cycle needs now, or a probation may need, stays whatever is asked.
        let in_force = seat
            .last
            .as_ref()
            .map(|r| (r.revision, r.probation.map(|(revision, _)| revision)));
        let (stay, go): (Vec<_>, Vec<_>) = std::mem::take(&mut seat.held).into_iter().partition(|h| {
            let n = h.spec.revision;
            keep.contains(&n) || in_force.is_some_and(|(now, back)| n == now || Some(n) == back)
        });
        seat.held = stay;
        for held in go {
            self.shared.bury(held.instance);
        }
    }

    pub(crate) fn release(&mut self, id: &LoopId) {
        if let Some(seat) = self.seats.remove(id) {
            self.shared.count_held(-1);
            if seat.owned {
                self.shared.count_owned(-1);
            }
            for held in seat.held {
                self.shared.bury(held.instance);
            }
        }
    }

    /// A record was taken, here or elsewhere.
    pub(crate) fn record(&mut self, record: &Arc<Record>) {
        let Some(seat) = self.seats.get_mut(&record.loop_id) else {
            return;
        };
        if seat
            .last
            .as_ref()
            .is_some_and(|last| last.position() >= record.position())
        {
            return;
        }
        if seat
            .inflight
            .as_ref()
            .is_some_and(|r| r.position() <= record.position())
        {
            seat.inflight = None;
        }
        if seat
            .running
            .as_ref()
            .is_some_and(|r| (r.sample.term, r.sample.seq) <= record.position())
        {
            seat.running = None;
        }
        let owned = record.owner == self.shared.here;
        if owned != seat.owned {
            self.shared.count_owned(if owned { 1 } else { -1 });
            seat.owned = owned;
        }
        seat.last = Some(Arc::clone(record));
    }

    pub(crate) fn remote_record(&mut self, record: &Arc<Record>) {
        self.record(record);
        self.deliver(record);
    }

    fn reply(&mut self, home: &HostId, answer: Answer) {
        if *home == self.shared.here {
            self.answer(answer);
        } else {
            self.shared.wire.send_answer(home, &answer);
        }
    }

    fn decline(&mut self, sample: &Sample, reason: &str) {
        let answer = Answer::Decline {
            loop_id: sample.loop_id.clone(),
            term: sample.term,
            seq: sample.seq,
            owner: self.shared.here.clone(),
            reason: reason.to_owned(),
        };
        self.reply(&sample.home.clone(), answer);
    }

    /// A sample names this host as owner: run the cycle.
    pub(crate) fn sample(&mut self, sample: Box<Sample>) {
        if sample.owner != self.shared.here {
            return;
        }
        let started_ns = self.shared.now_ns();
        let id = sample.loop_id.clone();
        let Some(seat) = self.seats.get_mut(&id) else {
            return self.decline(&sample, "the loop is not held here");
        };
        seat.running = None;
        let base = match seat::base(&sample, seat.last.iter().chain(&seat.inflight)) {
            Base::First => None,
            Base::On(record) => Some(record),
            Base::Unknown => {
                let answer = Answer::NeedRecord {
                    loop_id: id,
                    term: sample.term,
                    seq: sample.seq,
                    owner: self.shared.here.clone(),
                };
                return self.reply(&sample.home.clone(), answer);
            }
        };
        let Some(index) = seat.held.iter().position(|h| h.spec.revision == sample.revision) else {
            return self.decline(&sample, "the revision in force is not prepared here yet");
        };
        let held = &mut seat.held[index];
        if sample.readings.len() != held.wiring.points.len() {
            return self.decline(&sample, "the sample's readings do not fit the component's ports");
        }
        let limit_ns = held.spec.step_limit_ns();
        let actuators = track(held, &sample.readings);
        let standing = seat::settle(base.as_deref(), &held.spec, &sample, &actuators);
        let frame = seat::frame(base.as_deref(), &held.spec, &standing, &sample, sample.readings.clone());
        let mut events = Vec::new();
        let bad_input = held.wiring.bad_input(&sample.readings);
        let carried = base
            .as_ref()
            .filter(|r| r.digest == held.spec.digest && !r.state.is_empty());
        let state: Result<Arc<[u8]>, Fault> = match carried {
            Some(record) => Ok(Arc::clone(&record.state)),
            None => take_over(held, None, &actuators, limit_ns).map(|(state, _)| Arc::from(state)),
        };
        let fault = match (&state, bad_input) {
            (_, Some(port)) => {
                events.push(CycleEvent::BadInput(port));
                Some(missing_input(held, port))
            }
            (Err(fault), None) => {
                events.push(CycleEvent::Faulted {
                    replica: self.shared.here.clone(),
                    fault: fault.to_string(),
                });
                Some(fault.clone())
            }
            (Ok(_), None) => None,
        };
        let left_ns = sample.left_ns;
        let here_at_ns = started_ns + (left_ns as f64 * HERE_PART) as u64;
        let hedge_ns = (held.spec.period_ns as f64 * held.spec.policy.hedge_part) as u64;
        let (strategy, digest, period_seq) = (held.spec.strategy, held.spec.digest, sample.seq);
        // A fault that is known already needs no replica; neither does a change of revision, which steps both here.
        let order = if fault.is_some() || standing.revise.is_some() {
            Vec::new()
        } else {
            let candidates = self
                .shared
                .replicas
                .candidates(&sample.members, &self.shared.here, &digest, started_ns);
            let random = self.random();
            select::select(strategy, &candidates, &id, period_seq, random)
                .into_iter()
                .filter_map(|i| candidates.get(i))
                .map(|c| (c.host.clone(), c.latency_ns))
                .collect()
        };
        let usual_ns = order
            .first()
            .and_then(|(_, l)| *l)
            .map_or(hedge_ns, |l| l.saturating_mul(HEDGE_LATENCIES));
        let hedge_ns = hedge_ns.min(usual_ns.max(HEDGE_NS_MIN));
        let order = order.into_iter().map(|(host, _)| host);
        let running = Running {
            attempts: Attempts::new(order, self.shared.here.clone(), hedge_ns, here_at_ns),
            state: state.unwrap_or_else(|_| Arc::from([])),
            sample,
            base,
            frame,
            standing,
            events,
            asked: Vec::new(),
            fault: None,
            started_ns,
            next_at_ns: 0,
            give_up_at_ns: started_ns + left_ns / 10 * 9,
        };
        if let Some(fault) = fault {
            return self.conclude(&id, running, Err(fault));
        }
        match running.standing.revise {
            Some((command, revision)) => self.revise(&id, running, command, revision),
            None => self.advance(&id, running),
        }
    }

    /// Asks the next replica, steps here, or ends the cycle.
    fn advance(&mut self, id: &LoopId, mut running: Running) {
        loop {
            let now_ns = self.shared.now_ns();
            match running.attempts.next(now_ns) {
                Ask::Remote(host, until_ns) => {
                    let Some(seat) = self.seats.get(id) else { return };
                    let Some(held) = seat.held.iter().find(|h| h.spec.revision == running.sample.revision) else {
                        return;
                    };
                    let (digest, limit_ns) = (held.spec.digest, held.spec.step_limit_ns());
                    let correlation = self.correlation();
                    let request = StepRequest {
                        from: self.shared.here.clone(),
                        correlation,
                        loop_id: id.clone(),
                        digest,
                        limit_ns,
                        frame: running.frame.clone(),
                        state: Arc::clone(&running.state),
                    };
                    self.shared.wire.send_step(&host, &request);
                    running.asked.push(Asked {
                        correlation,
                        host,
                        at_ns: now_ns,
                    });
                    return self.wait(id, running, until_ns);
                }
                Ask::Here => {
                    let Some(held) = self.seats.get_mut(id).and_then(|s| s.held(running.sample.revision)) else {
                        return;
                    };
                    let limit_ns = held.spec.step_limit_ns();
                    let began_ns = self.shared.now_ns();
                    match held.instance.step(&running.frame, &running.state, limit_ns) {
                        Ok(effects) => {
                            let step_ns = self.shared.now_ns() - began_ns;
                            let by = self.shared.here.clone();
                            return self.conclude(id, running, Ok(Stepped { effects, by, step_ns }));
                        }
                        Err(fault) => {
                            let replica = self.shared.here.clone();
                            running.events.push(CycleEvent::Faulted {
                                replica,
                                fault: fault.to_string(),
                            });
                            running.fault = Some(fault);
                        }
                    }
                }
                Ask::Nobody if running.asked.is_empty() || now_ns >= running.give_up_at_ns => {
                    let fault = running.fault.take().unwrap_or_else(|| Fault::NotReady {
                        host: "any replica".to_owned(),
                        reason: "no replica answered in time".to_owned(),
                    });
                    return self.without_a_step(id, running, fault);
                }
                Ask::Nobody => {
                    let until_ns = running.give_up_at_ns;
                    return self.wait(id, running, until_ns);
                }
            }
        }
    }

    fn wait(&mut self, id: &LoopId, mut running: Running, until_ns: u64) {
        running.next_at_ns = until_ns;
        let Some(seat) = self.seats.get_mut(id) else { return };
        seat.running = Some(running);
        self.at(until_ns, Timer::Seat(id.clone()));
    }

    /// A replica's time is up.
    pub(crate) fn seat_due(&mut self, id: &LoopId, at_ns: u64, now_ns: u64) {
        let Some(seat) = self.seats.get_mut(id) else { return };
        let Some(mut running) = seat.running.take_if(|r| r.next_at_ns == at_ns) else {
            return;
        };
        if let Some(asked) = running.asked.last() {
            self.shared
                .replicas
                .silent(&asked.host, now_ns, now_ns.saturating_sub(asked.at_ns));
            running.events.push(CycleEvent::Hedged {
                replica: asked.host.clone(),
            });
        }
        self.advance(id, running);
    }

    /// A replica that a cycle waits for is gone: no need to wait for its time.
    pub(crate) fn replica_lost(&mut self, id: &LoopId, host: &HostId, _now_ns: u64) {
        let Some(seat) = self.seats.get_mut(id) else { return };
        let Some(mut running) = seat.running.take() else { return };
        let latest = running.asked.last().is_some_and(|a| a.host == *host);
        running.asked.retain(|a| a.host != *host);
        if latest {
            running.events.push(CycleEvent::Hedged { replica: host.clone() });
            self.advance(id, running);
        } else {
            seat.running = Some(running);
        }
    }

    /// A replica answered, for a cycle that runs, or late.
    pub(crate) fn step_answer(&mut self, answer: StepAnswer) {
        let now_ns = self.shared.now_ns();
        let id = answer.loop_id.clone();
        let Some(seat) = self.seats.get_mut(&id) else {
            return self.call_answer(answer);
        };
        let of_this = |a: &Asked| a.correlation == answer.correlation && a.host == answer.from;
        let Some(mut running) = seat.running.take_if(|r| r.asked.iter().any(of_this)) else {
            if let Some(i) = seat.recent.iter().position(of_this)
                && let Some(asked) = seat.recent.remove(i)
            {
                self.shared
                    .replicas
                    .answered(&asked.host, now_ns.saturating_sub(asked.at_ns));
            }
            return;
        };
        let Some(i) = running.asked.iter().position(of_this) else {
            return;
        };
        let asked = running.asked.remove(i);
        let latency_ns = now_ns.saturating_sub(asked.at_ns);
        match answer.result {
            Ok(effects) => {
                self.shared.replicas.answered(&asked.host, latency_ns);
                self.conclude(
                    &id,
                    running,
                    Ok(Stepped {
                        effects,
                        by: asked.host,
                        step_ns: latency_ns,
                    }),
                );
            }
            Err(fault) => {
                // A host that is not ready is no worse for it, only of no use now; a fault is the component's.
                self.shared.replicas.answered(&asked.host, latency_ns);
                running.events.push(CycleEvent::Faulted {
                    replica: asked.host,
                    fault: fault.to_string(),
                });
                if !matches!(fault, Fault::NotReady { .. }) {
                    running.fault = Some(fault);
                }
                self.advance(&id, running);
            }
        }
    }

    /// A step for another host.
    pub(crate) fn step_request(&mut self, request: StepRequest) {
        let StepRequest {
            from,
            correlation,
            loop_id,
            digest,
            limit_ns,
            frame,
            state,
        } = request;
        let began_ns = self.shared.now_ns();
        let here = self.shared.here.clone();
        let not_ready = |reason: &str| Fault::NotReady {
            host: here.to_string(),
            reason: reason.to_owned(),
        };
        let held = self
            .seats
            .get_mut(&loop_id)
            .and_then(|s| s.held.iter_mut().find(|h| h.spec.digest == digest));
        let result = match held {
            Some(held) => held.instance.step(&frame, &state, limit_ns),
            None if crate::calls::is_call(&loop_id) => self.step_for_call(&digest, &frame, &state, limit_ns),
            None => Err(not_ready("the loop is not held here")),
        };
        let step_ns = self.shared.now_ns() - began_ns;
        let answer = StepAnswer {
            from: self.shared.here.clone(),
            correlation,
            loop_id,
            result,
            step_ns,
        };
        self.shared.wire.send_step_answer(&from, &answer);
    }

    /// No good step. In probation, the old component gets this very cycle; else the loop's policy decides.
    fn without_a_step(&mut self, id: &LoopId, mut running: Running, fault: Fault) {
        let back = running
            .base
            .as_ref()
            .and_then(|r| r.probation)
            .map(|(revision, _)| revision);
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
        let from = origin(&seat.held[new]);
        let held = &mut seat.held[old];
        let limit_ns = held.spec.step_limit_ns();
        let actuators = track(held, &readings);
        let frame = Frame {
            readings: readings.clone(),
            ..running.frame.clone()
        };
        let began_ns = self.shared.now_ns();
        let step = match held.wiring.bad_input(&readings) {
            Some(port) => Err(missing_input(held, port)),
            None => take_over(held, Some((&from, &running.state)), &actuators, limit_ns).and_then(|(state, _)| {
                running.state = Arc::from(state);
                held.instance.step(&frame, &running.state, limit_ns)
            }),
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

    /// A change of revision: both components step on the same frame here, and the bump decides.
    fn revise(&mut self, id: &LoopId, mut running: Running, command: bumpless_core::CommandId, revision: u64) {
        let Some(seat) = self.seats.get_mut(id) else { return };
        let Some(old_index) = seat
            .held
            .iter()
            .position(|h| h.spec.revision == running.sample.revision)
        else {
            return;
        };
        let began_ns = self.shared.now_ns();
        // The old component first: whatever the new one does, this cycle has an answer.
        let old = &mut seat.held[old_index];
        let limit_ns = old.spec.step_limit_ns();
        let old_step = old.instance.step(&running.frame, &running.state, limit_ns);
        let attempt = match seat.held.iter().position(|h| h.spec.revision == revision) {
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
        let by = self.shared.here.clone();
        match attempt {
            Ok(tried) => {
                running.events.push(CycleEvent::Revised {
                    from: running.sample.revision,
                    from_digest: seat.held[old_index].spec.digest,
                    by: tried.by.to_owned(),
                    bump_percent: tried.bump_percent,
                });
                running.standing.remember(command, Outcome::Done);
                let spec = &seat.held[tried.index].spec;
                let probation = (spec.policy.probation_cycles > 0 && tried.by != "same")
                    .then_some((running.sample.revision, spec.policy.probation_cycles));
                if running.standing.manual.len() != spec_outputs(&seat.held[tried.index]) {
                    running.standing.manual = track(&seat.held[tried.index], &tried.readings);
                }
                running.state = tried.state;
                let step = Ok(Stepped {
                    effects: tried.effects,
                    by,
                    step_ns,
                });
                self.conclude_with(id, running, step, tried.index, tried.readings, probation);
            }
            Err(reason) => {
                running.standing.remember(command, Outcome::Refused(reason));
                match old_step {
                    Ok(effects) => self.conclude(id, running, Ok(Stepped { effects, by, step_ns })),
                    Err(fault) => self.without_a_step(id, running, fault),
                }
            }
        }
    }

    /// Ends the cycle under the revision in force.
    fn conclude(&mut self, id: &LoopId, running: Running, step: Result<Stepped, Fault>) {
        let Some(seat) = self.seats.get(id) else { return };
        let Some(index) = seat
            .held
            .iter()
            .position(|h| h.spec.revision == running.sample.revision)
        else {
            return;
        };
        let readings = running.frame.readings.clone();
        let probation = swap::probation_after(running.base.as_deref());
        self.conclude_with(id, running, step, index, readings, probation);
    }

    fn conclude_with(
        &mut self,
        id: &LoopId,
        running: Running,
        step: Result<Stepped, Fault>,
        index: usize,
        readings: Vec<Reading>,
        probation: Option<(u64, u32)>,
    ) {
        let now_ns = self.shared.now_ns();
        let Some(seat) = self.seats.get_mut(id) else { return };
        let Some(held) = seat.held.get(index) else { return };
        for asked in running.asked {
            if seat.recent.len() == RECENT_MAX {
                seat.recent.pop_front();
            }
            seat.recent.push_back(asked);
        }
        let record = seat::conclude(Conclusion {
            owner: &self.shared.here,
            sample: &running.sample,
            base: running.base.as_deref(),
            spec: &held.spec,
            wiring: &held.wiring,
            readings,
            state: running.state,
            standing: running.standing,
            events: running.events,
            probation,
            step,
            cycle_ns: now_ns.saturating_sub(running.started_ns),
        });
        let home = running.sample.home.clone();
        if home == self.shared.here {
            self.answer(Answer::Commit(Box::new(record)));
        } else {
            let record = Arc::new(record);
            seat.inflight = Some(Arc::clone(&record));
            self.shared
                .wire
                .send_answer(&home, &Answer::Commit(Box::new(Arc::unwrap_or_clone(record))));
        }
    }
}

/// A new revision that may take over.
struct Tried {
    index: usize,
    readings: Vec<Reading>,
    state: Arc<[u8]>,
    effects: Effects,
    by: &'static str,
    bump_percent: f64,
}

fn spec_outputs(held: &HeldRevision) -> usize {
    held.wiring.outputs.len()
}

/// Hands the state over, steps the new component on the same frame and measures the bump. Says in words why not.
fn try_revision(
    seat: &mut Seat,
    old_index: usize,
    new_index: usize,
    running: &Running,
    old_effects: Option<&Effects>,
) -> Result<Tried, String> {
    let old = &seat.held[old_index];
    let readings = match &running.sample.next_readings {
        Some((revision, readings)) if *revision == seat.held[new_index].spec.revision => readings.clone(),
        _ => old.wiring.remap(&running.frame.readings, &seat.held[new_index].wiring),
    };
    let (from, hand_over) = (origin(old), swap::hand_over(&old.spec, &seat.held[new_index].spec));
    let dt_ns = running.frame.cycle.dt_ns;
    let mode = running.standing.mode;
    let actuators_old = track(old, &running.frame.readings);
    // What the old controller would have sent; where it has no answer, it would have held.
    let old_outputs = old_effects.map_or_else(
        || actuators_old.clone(),
        |effects| {
            let wanted = old.wiring.wanted(&effects.writes, &actuators_old);
            let manual = &running.standing.manual;
            bumpless_core::guard::guard(mode, &wanted, manual, &actuators_old, &old.wiring.limits, dt_ns).outputs
        },
    );
    let new = &mut seat.held[new_index];
    if readings.len() != new.wiring.points.len() {
        return Err("the sample's readings do not fit the new component's ports".to_owned());
    }
    if let Some(port) = new.wiring.bad_input(&readings) {
        return Err(missing_input(new, port).to_string());
    }
    let limit_ns = new.spec.step_limit_ns();
    let actuators = track(new, &readings);
    let (state, by): (Arc<[u8]>, _) = match hand_over {
        swap::HandOver::Same => (Arc::clone(&running.state), "same"),
        swap::HandOver::Migrate => take_over(new, Some((&from, &running.state)), &actuators, limit_ns)
            .map(|(state, by)| (Arc::from(state), by))
            .map_err(|fault| format!("no state could be made for the new component: {fault}"))?,
    };
    let frame = Frame {
        readings: readings.clone(),
        ..running.frame.clone()
    };
    let effects = new
        .instance
        .step(&frame, &state, limit_ns)
        .map_err(|fault| format!("its first step failed: {fault}"))?;
    let wanted = new.wiring.wanted(&effects.writes, &actuators);
    let manual = if running.standing.manual.len() == actuators.len() {
        &running.standing.manual
    } else {
        &actuators
    };
    let new_outputs = bumpless_core::guard::guard(mode, &wanted, manual, &actuators, &new.wiring.limits, dt_ns).outputs;
    let spans: Vec<f64> = (0..new_outputs.len()).map(|i| new.wiring.span(i)).collect();
    // Outputs that the old component did not drive are compared with what their actuators hold.
    let same_ports = old_outputs.len() == new_outputs.len();
    let compared = if same_ports { &old_outputs } else { &actuators };
    let bump_percent = swap::bump_percent(compared, &new_outputs, &spans);
    let limit = new.spec.policy.bump_limit_percent;
    if bump_percent > limit {
        return Err(format!(
            "the output would step by {bump_percent:.3} % of its span beyond what the old controller does; \
             the loop allows {limit} % (policy.bump_limit_percent)"
        ));
    }
    Ok(Tried {
        index: new_index,
        readings,
        state,
        effects,
        by,
        bump_percent,
    })
}
