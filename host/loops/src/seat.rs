//! The holder's shell around `core::seat`: runs a cycle when a sample names this host, steps for others when asked.
//!
//! ```text
//! sample ─► base? ─ no ─► NeedRecord
//!            │ yes
//!            ▼
//!          settle ─► [revise: old and new component on the same frame, here; a vote on it] ─► conclude ─► commit
//!            │ no change
//!            ▼
//!          attempts: replica ─ answer ─► conclude ─► commit
//!                      │ silent for the hedge time, gone, or faulted: the next; this host at the latest
//!                      ▼
//!                    nobody left: in probation back to the old component in this same cycle, else the loop's policy
//! ```
//! Under `vote(n)` the attempts are a ballot: see `vote`.

use std::{collections::VecDeque, sync::Arc};

use crate::{
    event::HeldRevision,
    revise::{Switching, missing_input, take_over, track},
    vote::{Late, redundancy},
    worker::{Timer, Worker},
};
use bumpless_core::{
    Event as CycleEvent, Fault, Frame, HostId, LoopId, Reading, Record, Redundancy,
    patience::Patience,
    protocol::{Answer, Sample, StepAnswer},
    seat::{self, Ask, Attempts, Base, Conclusion, Standing, Stepped},
    select, swap,
    vote::{Ballot, Judged},
};

/// Questions whose late answers still teach something about a replica's latency.
const RECENT_MAX: usize = 16;
/// The owner steps itself when this part of the time until the commit is overdue has passed.
const HERE_PART: f64 = 0.6;
/// A replica is given at least this long, in ns: below it, the scheduler's noise would look like silence.
const HEDGE_NS_MIN: u64 = 1_500_000;
/// A replica is given this multiple of its smoothed latency, where that is less than the policy's part of the period.
const HEDGE_LATENCIES: u64 = 8;

pub(crate) struct Asked {
    pub(crate) correlation: u64,
    pub(crate) host: HostId,
    pub(crate) at_ns: u64,
}

/// A cycle on its way.
pub(crate) struct Running {
    pub(crate) sample: Box<Sample>,
    pub(crate) base: Option<Arc<Record>>,
    pub(crate) frame: Frame,
    pub(crate) state: Arc<[u8]>,
    pub(crate) standing: Standing,
    pub(crate) events: Vec<CycleEvent>,
    pub(crate) attempts: Attempts,
    /// Instead of the attempts, where the strategy is a vote.
    pub(crate) ballot: Option<Ballot>,
    /// The change of revision that the ballot is about, where it is about one.
    pub(crate) switch: Option<Box<Switching>>,
    pub(crate) redundancy: Redundancy,
    pub(crate) hedge_ns: u64,
    pub(crate) asked: Vec<Asked>,
    pub(crate) fault: Option<Fault>,
    pub(crate) started_ns: u64,
    pub(crate) next_at_ns: u64,
    pub(crate) give_up_at_ns: u64,
}

#[derive(Default)]
pub(crate) struct Seat {
    pub(crate) held: Vec<HeldRevision>,
    last: Option<Arc<Record>>,
    /// Our own commit that no record has confirmed yet.
    inflight: Option<Arc<Record>>,
    pub(crate) running: Option<Running>,
    /// What the latest vote decided, for answers that come after it.
    pub(crate) late: Option<Late>,
    /// Answers that were judged after their cycle; they count in the next one. At most [`JUDGED_MAX`].
    pub(crate) judged: Vec<Judged>,
    /// A step here or for us that ran past its limit: revision, the record that it went on from, and the fault.
    overran: Option<(u64, (u64, u64), Fault)>,
    /// What dear faults of its component have cost so far.
    patience: Patience,
    recent: VecDeque<Asked>,
    owned: bool,
}

impl Seat {
    pub(crate) fn held(&mut self, revision: u64) -> Option<&mut HeldRevision> {
        self.held.iter_mut().find(|h| h.spec.revision == revision)
    }

    /// A step that runs past its limit may end too late for its cycle; then the next one must not try it again, or nobody
    /// would ever hear of it: no record, no policy, no way back, and no other revision either.
    /// What is dear besides is tried less often, for it takes its time from the other loops of this thread.
    pub(crate) fn remember_fault(&mut self, running: &Running, fault: &Fault, step_ns: u64) {
        let (revision, seq) = (running.sample.revision, running.sample.seq);
        let period_ns = self.held(revision).map_or(0, |held| held.spec.period_ns);
        self.patience.faulted(revision, seq, period_ns, fault, step_ns);
        if matches!(fault, Fault::Overrun { .. }) {
            self.overran = Some((running.sample.revision, running.sample.last, fault.clone()));
        }
    }

    /// The fault that the sample's cycle ends with because its component rests, and when that is tried again.
    fn rests(&self, sample: &Sample) -> Option<(Fault, u64)> {
        let (fault, next) = self.patience.rests(sample.revision, sample.seq)?;
        Some((fault.clone(), next))
    }

    pub(crate) fn waits_for(&self, host: &HostId) -> bool {
        self.running
            .as_ref()
            .is_some_and(|r| r.asked.iter().any(|a| a.host == *host))
    }
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
        // A member that sees an outcome for the first time says so: from now on the outcome outlives its home.
        let news = self
            .seats
            .get(&record.loop_id)
            .is_some_and(|seat| record.has_news_for(seat.last.as_deref()));
        if news && record.home != self.shared.here {
            let answer = Answer::Held {
                loop_id: record.loop_id.clone(),
                term: record.term,
                seq: record.seq,
                host: self.shared.here.clone(),
            };
            self.shared.wire.send_answer(&record.home, &answer);
        }
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
        let held = &seat.held[index];
        if sample.readings.len() != held.wiring.points.len() {
            return self.decline(&sample, "the sample's readings do not fit the component's ports");
        }
        if !sample.commands.is_empty() {
            seat.patience.commanded();
        }
        let rests = seat.rests(&sample);
        let held = &mut seat.held[index];
        let limit_ns = held.spec.step_limit_ns();
        let actuators = track(held, &sample.readings);
        let standing = seat::settle(base.as_deref(), &held.spec, &sample, &actuators);
        let frame = seat::frame(base.as_deref(), &held.spec, &standing, &sample, sample.readings.clone());
        let mut events = Vec::new();
        let bad_input = held.wiring.bad_input(&sample.readings);
        let carried = seat::carried(base.as_deref(), &held.spec, &held.wiring, &sample.readings);
        let state: Result<Arc<[u8]>, Fault> = match (carried, &rests) {
            (Some(state), _) => Ok(Arc::clone(state)),
            (None, Some((fault, _))) => Err(fault.clone()),
            (None, None) => {
                let taken = take_over(held, None, &actuators, limit_ns).map(|(state, _)| Arc::from(state));
                if let Err(fault) = &taken {
                    let spent_ns = self.shared.now_ns().saturating_sub(started_ns);
                    let period_ns = held.spec.period_ns;
                    seat.patience
                        .faulted(sample.revision, sample.seq, period_ns, fault, spent_ns);
                }
                taken
            }
        };
        // The same cycle in all but its number: last time its end came too late for its commit, and no record says so yet.
        let again = seat
            .overran
            .as_ref()
            .filter(|(revision, after, _)| (*revision, *after) == (sample.revision, sample.last))
            .map(|(.., fault)| (fault.clone(), fault.to_string()));
        let rests = rests.map(|(fault, next)| {
            let text = format!("{fault}; it is not tried again before cycle {next}");
            (fault, text)
        });
        let fault = match (state.as_ref().err(), bad_input, rests.or(again)) {
            (_, Some(port), _) => {
                events.push(CycleEvent::BadInput(port));
                Some(missing_input(held, port))
            }
            (failed, None, known) => known
                .or_else(|| failed.map(|fault| (fault.clone(), fault.to_string())))
                .map(|(fault, text)| {
                    events.push(CycleEvent::Faulted {
                        replica: self.shared.here.clone(),
                        fault: text,
                    });
                    fault
                }),
        };
        let left_ns = sample.left_ns;
        let here_at_ns = started_ns + (left_ns as f64 * HERE_PART) as u64;
        let hedge_ns = (held.spec.period_ns as f64 * held.spec.policy.hedge_part) as u64;
        let (spec, digest, seq) = (Arc::clone(&held.spec), held.spec.digest, sample.seq);
        let here = self.shared.here.clone();
        let candidates = self
            .shared
            .replicas
            .candidates(&sample.members, &here, &digest, started_ns);
        let mut ballot = None;
        let redundancy = redundancy(&spec, &candidates, &here, base.as_deref(), &mut ballot);
        // A fault that is known already needs no replica; neither does a change of revision, which steps both here.
        let order = if fault.is_some() || standing.revise.is_some() {
            Vec::new()
        } else {
            let random = self.random();
            select::select(spec.strategy, &candidates, &id, seq, random)
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
            attempts: Attempts::new(order, here, hedge_ns, here_at_ns),
            ballot: None,
            switch: None,
            redundancy,
            hedge_ns,
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
        match (running.standing.revise, fault) {
            // Another component would not see any better.
            (_, Some(fault)) if bad_input.is_some() => self.conclude(&id, running, Err(fault)),
            (Some((command, revision)), fault) => self.revise(&id, running, (command, revision), fault, ballot),
            (None, Some(fault)) => self.without_a_step(&id, running, fault),
            (None, None) => match ballot {
                Some(ballot) => self.open_ballot(&id, running, ballot),
                None => self.advance(&id, running),
            },
        }
    }

    /// Asks the next replica, steps here, or ends the cycle.
    fn advance(&mut self, id: &LoopId, mut running: Running) {
        loop {
            let now_ns = self.shared.now_ns();
            match running.attempts.next(now_ns) {
                Ask::Remote(host, until_ns) => {
                    let Some(mut request) = self.request(id, &running) else {
                        return;
                    };
                    self.ask(&mut running, &mut request, host, now_ns);
                    return self.wait(id, running, until_ns);
                }
                Ask::Here => {
                    let Some((step, step_ns)) = self.step_here(id, &running) else {
                        return;
                    };
                    match step {
                        Ok(effects) => {
                            let by = self.shared.here.clone();
                            return self.conclude(id, running, Ok(Stepped { effects, by, step_ns }));
                        }
                        Err(fault) => {
                            let replica = self.shared.here.clone();
                            if let Some(seat) = self.seats.get_mut(id) {
                                seat.remember_fault(&running, &fault, step_ns);
                            }
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

    pub(crate) fn wait(&mut self, id: &LoopId, mut running: Running, until_ns: u64) {
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
        if running.ballot.is_some() {
            return self.ballot_due(id, running, now_ns);
        }
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
        if running.ballot.is_some() {
            return self.voter_lost(id, running, host);
        }
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
                seat.judge_late(&asked, answer.result);
            }
            return;
        };
        let Some(i) = running.asked.iter().position(of_this) else {
            return;
        };
        let asked = running.asked.remove(i);
        let latency_ns = now_ns.saturating_sub(asked.at_ns);
        if running.ballot.is_some() {
            self.shared.replicas.answered(&asked.host, latency_ns);
            return self.voted(&id, running, &asked.host, answer.result);
        }
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
                if let Some(seat) = self.seats.get_mut(&id) {
                    seat.remember_fault(&running, &fault, answer.step_ns);
                }
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

    /// Ends the cycle under the revision in force.
    pub(crate) fn conclude(&mut self, id: &LoopId, mut running: Running, step: Result<Stepped, Fault>) {
        if let Ok(stepped) = &step
            && let Some(fault) = self.on_probation(id, &running, stepped)
        {
            running.events.push(CycleEvent::Faulted {
                replica: stepped.by.clone(),
                fault: fault.to_string(),
            });
            return self.without_a_step(id, running, fault);
        }
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

    pub(crate) fn conclude_with(
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
        if step.is_ok() {
            seat.patience.good();
        }
        for asked in running.asked {
            if seat.recent.len() == RECENT_MAX {
                seat.recent.pop_front();
            }
            seat.recent.push_back(asked);
        }
        let Some(held) = seat.held.get(index) else { return };
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
            redundancy: running.redundancy,
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
