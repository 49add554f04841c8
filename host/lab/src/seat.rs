//! The owner's side of a cycle in a run: `core::seat` with virtual time around it, as `loops` puts real time around it.
//!
//! ```text
//! sample ─► base ─► settle ─► [revise: both components on one frame] ─► attempts: replica, the next, here ─► conclude ─► commit
//! ```
//! Steps are real: the component runs in the sandbox. What it takes in virtual time is the experiment's to say.
//! Never: probation and rollback; a swap shows its bump, and a fault is the policy's.

use std::{collections::HashMap, sync::Arc};

use bumpless_core::{
    Effects, Event, Fault, Frame, HostId, LoopSpec, Reading, Record, Redundancy, Wiring,
    protocol::{Answer, Sample},
    seat::{self, Ask, Attempts, Base, Conclusion, Standing, Stepped},
    select::{self, Candidate, Health},
    vote::{Ballot, Judged},
};
use bumpless_engine::{Instance, Origin};

use crate::{
    error::Error,
    experiment::HostPlan,
    limits::CALL_NS_MAX,
    network::{Delay, Dice},
    vote::{self, Late},
    world::{What, World},
};

/// The owner steps itself when this part of the time until the commit is overdue has passed; as a live host does.
const HERE_PART: f64 = 0.6;
/// A replica is given at least this long, in ns; as on a live host.
const HEDGE_NS_MIN: u64 = 1_500_000;
/// A replica is given this multiple of its smoothed latency; as on a live host.
const HEDGE_LATENCIES: u64 = 8;

/// A revision of a loop, ready to step. One instance serves all hosts, for a component keeps nothing between calls.
pub(crate) struct Revision {
    pub(crate) spec: Arc<LoopSpec>,
    pub(crate) wiring: Wiring,
    pub(crate) instance: Instance,
}

impl Revision {
    pub(crate) fn origin(&self) -> Origin {
        let d = self.instance.prepared().descriptor();
        Origin {
            name: d.name.clone(),
            version: d.version.clone(),
            state_layout: d.state_layout,
        }
    }

    /// What the actuators hold, with the safe value where that is not known.
    pub(crate) fn track(&self, readings: &[Reading]) -> Vec<f64> {
        let held = self.wiring.held(readings);
        held.iter()
            .zip(&self.wiring.limits)
            .map(|(v, l)| if v.is_finite() { *v } else { l.safe })
            .collect()
    }

    /// A first state, or one taken over.
    pub(crate) fn take_over(
        &mut self,
        from: Option<(&Origin, &[u8])>,
        track: &[f64],
    ) -> Result<(Vec<u8>, &'static str), Fault> {
        let parameters = &self.wiring.parameters;
        if let Some((origin, state)) = from.filter(|(_, state)| !state.is_empty())
            && let Ok(state) = self.instance.migrate(origin, state, parameters, track, CALL_NS_MAX)
        {
            return Ok((state, "migrate"));
        }
        self.instance
            .start(parameters, track, CALL_NS_MAX)
            .map(|state| (state, "start"))
    }
}

/// What a host holds of one loop.
#[derive(Default)]
pub(crate) struct Seat {
    pub(crate) last: Option<Arc<Record>>,
    inflight: Option<Arc<Record>>,
    pub(crate) running: Option<Running>,
    /// What the last vote decided, while answers may still come.
    pub(crate) late: Option<Late>,
    /// Answers that came after their vote; they count in the next one.
    pub(crate) judged: Vec<Judged>,
}

/// One host.
pub(crate) struct Host {
    pub(crate) id: HostId,
    pub(crate) on: bool,
    pub(crate) paused_until_ns: u64,
    pub(crate) cpu: f32,
    pub(crate) step: Delay,
    dice: Dice,
    choices: Dice,
    pub(crate) seats: Vec<Seat>,
    pub(crate) health: HashMap<usize, Health>,
    /// Until when its steps are off in their first output, and by how much.
    pub(crate) wrong: Option<(u64, f64)>,
}

impl Host {
    pub(crate) fn home(id: HostId, seed: u64, loops: usize) -> Self {
        Self {
            dice: Dice::new(seed, &format!("steps {id}")),
            choices: Dice::new(seed, &format!("choices {id}")),
            id,
            on: true,
            paused_until_ns: 0,
            cpu: 0.0,
            step: Delay::default(),
            seats: (0..loops).map(|_| Seat::default()).collect(),
            health: HashMap::new(),
            wrong: None,
        }
    }

    pub(crate) fn of(plan: &HostPlan, seed: u64, loops: usize) -> Result<Self, Error> {
        let id = HostId::new(plan.name.as_str()).map_err(|e| Error::at("cell.host", e.to_string()))?;
        Ok(Self {
            on: !plan.off,
            cpu: plan.cpu,
            step: plan.step,
            ..Self::home(id, seed, loops)
        })
    }

    /// A host that goes takes everything that it held along.
    pub(crate) fn switch(&mut self, on: bool) {
        self.on = on;
        self.paused_until_ns = 0;
        self.health.clear();
        for seat in &mut self.seats {
            *seat = Seat::default();
        }
    }
}

/// A cycle on its way at its owner.
pub(crate) struct Running {
    pub(crate) sample: Box<Sample>,
    pub(crate) base: Option<Arc<Record>>,
    pub(crate) frame: Frame,
    pub(crate) state: Arc<[u8]>,
    pub(crate) standing: Standing,
    pub(crate) events: Vec<Event>,
    pub(crate) attempts: Attempts,
    pub(crate) ballot: Option<Ballot>,
    pub(crate) redundancy: Redundancy,
    pub(crate) hedge_ns: u64,
    pub(crate) asked: Vec<(usize, u64)>,
    pub(crate) fault: Option<Fault>,
    pub(crate) revision: usize,
    pub(crate) started_ns: u64,
    pub(crate) next_at_ns: u64,
    pub(crate) give_up_at_ns: u64,
}

impl Running {
    pub(crate) const fn cycle(&self) -> (u64, u64) {
        (self.sample.term, self.sample.seq)
    }
}

impl World<'_> {
    /// Is a host there for a message now? One that stands still gets it later.
    fn hears(&mut self, host: usize, what: impl FnOnce() -> What) -> bool {
        let Some(h) = self.hosts.get(host).filter(|h| h.on) else {
            return false;
        };
        if h.paused_until_ns > self.now_ns {
            let until_ns = h.paused_until_ns;
            self.at(until_ns, what());
            return false;
        }
        true
    }

    /// A sample names its owner: run the cycle.
    pub(crate) fn sample(&mut self, of: usize, sample: Box<Sample>) {
        let owner = self.host(&sample.owner);
        let again = sample.clone();
        if !self.hears(owner, || What::Sample(of, again)) {
            return;
        }
        let now_ns = self.now_ns;
        let Some(seat) = self.hosts.get_mut(owner).and_then(|h| h.seats.get_mut(of)) else {
            return;
        };
        seat.running = None;
        let base = match seat::base(&sample, seat.last.iter().chain(&seat.inflight)) {
            Base::First => None,
            Base::On(record) => Some(record),
            Base::Unknown => {
                let answer = Answer::NeedRecord {
                    loop_id: sample.loop_id.clone(),
                    term: sample.term,
                    seq: sample.seq,
                    owner: sample.owner.clone(),
                };
                // Back to the home and here again; two ways of the link at most, taken as one moment of the desk.
                let dispatch = self.loops.get_mut(of).and_then(|l| l.desk.answered(now_ns, &answer));
                return self.dispatch(of, dispatch);
            }
        };
        let random = self.hosts.get_mut(owner).map_or(0, |h| h.choices.bits());
        let candidates = self.candidates(owner, &sample.members);
        let Some(l) = self.loops.get_mut(of) else { return };
        let Some(revision) = l.held.iter().position(|h| h.spec.revision == sample.revision) else {
            return;
        };
        let held = &mut l.held[revision];
        let actuators = held.track(&sample.readings);
        let standing = seat::settle(base.as_deref(), &held.spec, &sample, &actuators);
        let frame = seat::frame(base.as_deref(), &held.spec, &standing, &sample, sample.readings.clone());
        let mut events = Vec::new();
        let bad_input = held.wiring.bad_input(&sample.readings);
        let carried = seat::carried(base.as_deref(), &held.spec, &held.wiring, &sample.readings);
        let state: Result<Arc<[u8]>, Fault> = match carried {
            Some(state) => Ok(Arc::clone(state)),
            None => held.take_over(None, &actuators).map(|(state, _)| Arc::from(state)),
        };
        let fault = match (&state, bad_input) {
            (_, Some(port)) => {
                events.push(Event::BadInput(port));
                Some(Fault::BadInput(format!("port {port} has no usable value")))
            }
            (Err(fault), None) => Some(fault.clone()),
            (Ok(_), None) => None,
        };
        let (period_ns, strategy) = (held.spec.period_ns, held.spec.strategy);
        let (redundancy, ballot) = vote::redundancy(&held.spec, &candidates, &sample.owner, base.as_deref());
        let here_at_ns = now_ns + (sample.left_ns as f64 * HERE_PART) as u64;
        let hedge_ns = (period_ns as f64 * held.spec.policy.hedge_part) as u64;
        let order: Vec<&Candidate> = if fault.is_some() || standing.revise.is_some() {
            Vec::new()
        } else {
            select::select(strategy, &candidates, &sample.loop_id, sample.seq, random)
                .into_iter()
                .filter_map(|i| candidates.get(i))
                .collect()
        };
        let usual_ns = order
            .first()
            .and_then(|c| c.latency_ns)
            .map_or(hedge_ns, |latency| latency.saturating_mul(HEDGE_LATENCIES));
        let hedge_ns = hedge_ns.min(usual_ns.max(HEDGE_NS_MIN));
        let running = Running {
            attempts: Attempts::new(
                order.into_iter().map(|c| c.host.clone()),
                sample.owner.clone(),
                hedge_ns,
                here_at_ns,
            ),
            ballot: None,
            redundancy,
            hedge_ns,
            state: state.unwrap_or_else(|_| Arc::from([])),
            give_up_at_ns: now_ns + sample.left_ns / 10 * 9,
            sample,
            base,
            frame,
            standing,
            events,
            asked: Vec::new(),
            fault: None,
            revision,
            started_ns: now_ns,
            next_at_ns: 0,
        };
        match (running.standing.revise, fault) {
            (_, Some(fault)) => self.conclude(of, owner, running, Err(fault)),
            (Some((command, revision)), None) => self.revise(of, owner, running, command, revision),
            (None, None) => match ballot {
                Some(ballot) => self.open_ballot(of, owner, running, ballot),
                None => self.advance(of, owner, running),
            },
        }
    }

    /// The replicas as an owner sees them.
    fn candidates(&self, owner: usize, members: &[HostId]) -> Vec<Candidate> {
        let health = self.hosts.get(owner).map(|h| &h.health);
        members
            .iter()
            .map(|id| {
                let host = self.host(id);
                let known = health.and_then(|h| h.get(&host));
                Candidate {
                    host: id.clone(),
                    here: host == owner,
                    ready: true,
                    closed: known.is_none_or(|h| h.closed(self.now_ns)),
                    latency_ns: if host == owner {
                        Some(0)
                    } else {
                        known.and_then(Health::latency_ns)
                    },
                    cpu: self.hosts.get(host).map_or(0.0, |h| h.cpu),
                }
            })
            .collect()
    }

    /// Asks the next replica, steps here, or ends the cycle.
    fn advance(&mut self, of: usize, owner: usize, mut running: Running) {
        let now_ns = self.now_ns;
        match running.attempts.next(now_ns) {
            Ask::Remote(id, until_ns) => {
                let host = self.host(&id);
                let (term, seq) = running.cycle();
                running.asked.push((host, now_ns));
                if let Some(at_ns) = self.passes(owner, host) {
                    self.at(
                        at_ns,
                        What::Asked {
                            of,
                            owner,
                            host,
                            term,
                            seq,
                        },
                    );
                }
                self.wait(of, owner, running, until_ns);
            }
            Ask::Here => {
                let (term, seq) = running.cycle();
                let result = self.step(of, owner, running.revision, &running.frame, &running.state);
                let took_ns = self.step_ns(owner);
                if took_ns == 0 {
                    return self.stepped(of, owner, owner, running, result);
                }
                self.at(
                    now_ns + took_ns,
                    What::Answered {
                        of,
                        owner,
                        host: owner,
                        term,
                        seq,
                        result: Box::new(result),
                    },
                );
                self.wait(of, owner, running, u64::MAX);
            }
            Ask::Nobody if running.asked.is_empty() || now_ns >= running.give_up_at_ns => {
                let fault = running.fault.take().unwrap_or_else(|| Fault::NotReady {
                    host: "any replica".to_owned(),
                    reason: "no replica answered in time".to_owned(),
                });
                self.conclude(of, owner, running, Err(fault));
            }
            Ask::Nobody => {
                let until_ns = running.give_up_at_ns;
                self.wait(of, owner, running, until_ns);
            }
        }
    }

    pub(crate) fn wait(&mut self, of: usize, owner: usize, mut running: Running, until_ns: u64) {
        running.next_at_ns = until_ns;
        if let Some(slot) = self.running(of, owner) {
            *slot = Some(running);
        }
        if until_ns < u64::MAX {
            self.at(
                until_ns,
                What::SeatDue {
                    of,
                    owner,
                    at_ns: until_ns,
                },
            );
        }
    }

    /// A replica's time is up.
    pub(crate) fn seat_due(&mut self, of: usize, owner: usize, at_ns: u64) {
        let now_ns = self.now_ns;
        if !self.hears(owner, || What::SeatDue { of, owner, at_ns }) {
            return;
        }
        let taken = self
            .running(of, owner)
            .and_then(|slot| slot.take_if(|r| r.next_at_ns == at_ns));
        let Some(mut running) = taken else { return };
        if running.ballot.is_some() {
            return self.ballot_due(of, owner, running);
        }
        if let Some(&(host, asked_ns)) = running.asked.last() {
            let replica = self.hosts.get(host).map(|h| h.id.clone());
            if let Some(h) = self.hosts.get_mut(owner) {
                h.health.entry(host).or_default().failed(now_ns, now_ns - asked_ns);
            }
            running.events.extend(replica.map(|replica| Event::Hedged { replica }));
        }
        self.advance(of, owner, running);
    }

    pub(crate) fn step_ns(&mut self, host: usize) -> u64 {
        self.hosts.get_mut(host).map_or(0, |h| h.step.draw_ns(&mut h.dice))
    }

    /// A step on a host. One whose steps go wrong does so in its first write.
    pub(crate) fn step(
        &mut self,
        of: usize,
        host: usize,
        revision: usize,
        frame: &Frame,
        state: &[u8],
    ) -> Result<Effects, Fault> {
        let held = self.loops.get_mut(of).and_then(|l| l.held.get_mut(revision));
        let held = held.ok_or_else(|| Fault::Failed("the revision is not held".to_owned()))?;
        let mut effects = held.instance.step(frame, state, CALL_NS_MAX)?;
        let wrong = self.hosts.get(host).and_then(|h| h.wrong);
        if let Some((_, by)) = wrong.filter(|(until_ns, _)| self.now_ns < *until_ns)
            && let Some((_, value)) = effects.writes.first_mut()
        {
            *value += by;
        }
        Ok(effects)
    }

    /// A replica is asked for a step. What it sees is the owner's running cycle: were that gone, nobody would want the answer.
    pub(crate) fn asked(&mut self, of: usize, owner: usize, host: usize, cycle: (u64, u64)) {
        let (term, seq) = cycle;
        if !self.hears(host, || What::Asked {
            of,
            owner,
            host,
            term,
            seq,
        }) {
            return;
        }
        let running = self.running(of, owner).and_then(|slot| slot.as_ref());
        let Some((revision, frame, state)) = running
            .filter(|r| r.cycle() == cycle)
            .map(|r| (r.revision, r.frame.clone(), Arc::clone(&r.state)))
        else {
            return;
        };
        let result = self.step(of, host, revision, &frame, &state);
        let done_ns = self.now_ns + self.step_ns(host);
        // The answer leaves when the step is done; its way is drawn now, which is the same in all but the order of dice.
        if let Some(at_ns) = self.passes(host, owner) {
            let at_ns = at_ns + (done_ns - self.now_ns);
            self.at(
                at_ns,
                What::Answered {
                    of,
                    owner,
                    host,
                    term,
                    seq,
                    result: Box::new(result),
                },
            );
        }
    }

    /// A step's answer is at the owner.
    pub(crate) fn answered(
        &mut self,
        of: usize,
        owner: usize,
        host: usize,
        cycle: (u64, u64),
        result: Result<Effects, Fault>,
    ) {
        let (term, seq) = cycle;
        let again = result.clone();
        let later = || What::Answered {
            of,
            owner,
            host,
            term,
            seq,
            result: Box::new(again),
        };
        if !self.hears(owner, later) {
            return;
        }
        let taken = self
            .running(of, owner)
            .and_then(|slot| slot.take_if(|r| r.cycle() == cycle));
        let Some(running) = taken else {
            return self.judge_late(of, owner, host, cycle, result);
        };
        let asked_ns = running.asked.iter().find(|(h, _)| *h == host).map(|(_, at_ns)| *at_ns);
        let now_ns = self.now_ns;
        if let (Some(asked_ns), Some(h)) = (asked_ns, self.hosts.get_mut(owner)) {
            h.health.entry(host).or_default().answered(now_ns - asked_ns);
        }
        if running.ballot.is_some() {
            return self.voted(of, owner, host, running, result);
        }
        self.stepped(of, owner, host, running, result);
    }

    fn stepped(&mut self, of: usize, owner: usize, host: usize, mut running: Running, result: Result<Effects, Fault>) {
        let Some(by) = self.hosts.get(host).map(|h| h.id.clone()) else {
            return;
        };
        match result {
            Ok(effects) => {
                let asked_ns = running.asked.iter().find(|(h, _)| *h == host).map(|(_, at_ns)| *at_ns);
                let step_ns = self.now_ns - asked_ns.unwrap_or(running.started_ns);
                self.conclude(of, owner, running, Ok(Stepped { effects, by, step_ns }));
            }
            Err(fault) => {
                running.events.push(Event::Faulted {
                    replica: by,
                    fault: fault.to_string(),
                });
                running.fault = Some(fault);
                self.advance(of, owner, running);
            }
        }
    }

    /// Guards the outputs, writes the record and sends it home.
    pub(crate) fn conclude(&mut self, of: usize, owner: usize, running: Running, step: Result<Stepped, Fault>) {
        let now_ns = self.now_ns;
        let Some(id) = self.hosts.get(owner).map(|h| h.id.clone()) else {
            return;
        };
        let Some(l) = self.loops.get_mut(of) else { return };
        let Some(held) = l.held.get(running.revision) else {
            return;
        };
        if step.is_err() {
            l.meter.faults += 1;
        }
        l.meter.hedged += running
            .events
            .iter()
            .filter(|e| matches!(e, Event::Hedged { .. }))
            .count() as u64;
        let record = seat::conclude(Conclusion {
            owner: &id,
            sample: &running.sample,
            base: running.base.as_deref(),
            spec: &held.spec,
            wiring: &held.wiring,
            readings: running.frame.readings,
            state: running.state,
            standing: running.standing,
            events: running.events,
            probation: None,
            redundancy: running.redundancy,
            step,
            cycle_ns: now_ns - running.started_ns,
        });
        if record.events.iter().any(|e| matches!(e, Event::Limited(_))) {
            l.meter.limited += 1;
        }
        if let Some(seat) = self.hosts.get_mut(owner).and_then(|h| h.seats.get_mut(of)) {
            seat.inflight = Some(Arc::new(record.clone()));
        }
        if let Some(at_ns) = self.passes(owner, 0) {
            if at_ns == now_ns {
                self.commit(of, record);
            } else {
                self.at(at_ns, What::Commit(of, Box::new(record)));
            }
        }
    }
}
