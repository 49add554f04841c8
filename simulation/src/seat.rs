//! The holder's side in the simulation: what the product's loops do around `core::seat`, `core::select` and `core::vote`.
//!
//! Never: decides what the core decides.

use std::sync::Arc;

use bumpless_core::{
    Effects, Event as CycleEvent, Fault, HostId, Outcome, Record, Redundancy, Strategy,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
    seat::{self, Ask, Attempts, Base, Conclusion, Stepped},
    select::{self, Candidate},
    swap,
    vote::{self, Ballot, Cast, Verdict},
};

use crate::{
    event::{Event, Message},
    host::{Asked, Running},
    law::{self, host_id, host_number},
    plan::Broken,
    world::World,
};

/// As in the product's loops: the owner steps itself when this part of its time has passed.
const HERE_PART: f64 = 0.6;
/// A replica is given at least this long, in ns.
const HEDGE_NS_MIN: u64 = 1_500_000;
/// A replica is given this multiple of its smoothed latency.
const HEDGE_LATENCIES: u64 = 8;
/// Time of a step, in ns.
const STEP_NS: u64 = 80_000;
/// How much slower a slow host is.
const SLOW: u64 = 20;

impl World {
    fn step_ns(&self, host: u32) -> u64 {
        match self.host(host).slow {
            0 => STEP_NS,
            _ => STEP_NS * SLOW,
        }
    }

    /// A step of the law on a host; one that errs gives another number now and then, where its loop votes.
    fn step_on(&mut self, host: u32, state: &[u8], votes: bool) -> Effects {
        let mut effects = law::step(state);
        if votes && self.host(host).bits > 0 && self.random.chance(0.3) {
            let noise = self.random.next() >> 12 | 1;
            if let Some((_, value)) = effects.writes.first_mut() {
                *value = f64::from_bits(value.to_bits() ^ noise);
            }
            self.counts.flipped += 1;
        }
        effects
    }

    /// A sample names this host as owner.
    pub(crate) fn sample(&mut self, host: u32, sample: Box<Sample>) {
        let number = law::loop_number(&sample.loop_id);
        let me = host_id(host);
        if sample.owner != me {
            return;
        }
        let now_ns = self.now_ns;
        let home = host_number(&sample.home);
        let broken = self.broken();
        let decline = |reason: &str| Answer::Decline {
            loop_id: sample.loop_id.clone(),
            term: sample.term,
            seq: sample.seq,
            owner: me.clone(),
            reason: reason.to_owned(),
        };
        let Some(spec) = self.spec(number, sample.revision) else {
            return self.answer_to(host, home, decline("the revision is not known"));
        };
        let Some(seat) = self.host_mut(host).seats.get_mut(&number) else {
            return self.answer_to(host, home, decline("the loop is not held here"));
        };
        seat.running = None;
        let base = match seat::base(&sample, seat.last.iter().chain(&seat.inflight)) {
            Base::First => None,
            Base::On(record) => Some(record),
            Base::Unknown if broken == Some(Broken::AnyBase) => seat.last.clone(),
            Base::Unknown => {
                let answer = Answer::NeedRecord {
                    loop_id: sample.loop_id.clone(),
                    term: sample.term,
                    seq: sample.seq,
                    owner: me,
                };
                return self.answer_to(host, home, answer);
            }
        };
        let held = self.wiring.held(&sample.readings);
        let standing = seat::settle(base.as_deref(), &spec, &sample, &held);
        let frame = seat::frame(base.as_deref(), &spec, &standing, &sample, sample.readings.clone());
        let state: Arc<[u8]> = base.as_ref().map_or_else(|| Arc::from([]), |r| Arc::clone(&r.state));
        let candidates = self.candidates(host, &sample.members);
        let able = |c: &&Candidate| c.closed;
        let count = |n: usize| u8::try_from(n).unwrap_or(u8::MAX);
        let (redundancy, ballot) = match spec.strategy {
            Strategy::Vote(n) => {
                let mut before = base
                    .as_ref()
                    .and_then(|r| r.redundancy.vote.clone())
                    .unwrap_or_default();
                (before.answers, before.agreed, before.needed) = (0, 0, 0);
                let others = candidates
                    .iter()
                    .filter(able)
                    .map(|c| c.host.clone())
                    .filter(|h| *h != me);
                let able = std::iter::once(me.clone()).chain(others);
                let ballot = Ballot::new(n, able, &before.aside, spec.policy.on_fewer);
                let have = count(ballot.have()).min(n);
                let redundancy = Redundancy {
                    have,
                    want: n,
                    vote: Some(before),
                };
                (redundancy, Some(ballot))
            }
            _ => {
                let have = count(candidates.iter().filter(able).count());
                let redundancy = Redundancy {
                    have,
                    want: spec.replicas,
                    vote: None,
                };
                (redundancy, None)
            }
        };
        let hedge_ns = (spec.period_ns as f64 * spec.policy.hedge_part) as u64;
        let random = self.random.next();
        let order = match (standing.revise, &ballot) {
            (None, None) => select::select(spec.strategy, &candidates, &spec.id, sample.seq, random),
            _ => Vec::new(),
        };
        let order: Vec<&Candidate> = order.into_iter().filter_map(|i| candidates.get(i)).collect();
        let usual_ns = order
            .first()
            .and_then(|c| c.latency_ns)
            .map(|l| l.saturating_mul(HEDGE_LATENCIES));
        let hedge_ns = hedge_ns.min(usual_ns.unwrap_or(hedge_ns).max(HEDGE_NS_MIN));
        let here_at_ns = now_ns + (sample.left_ns as f64 * HERE_PART) as u64;
        let order: Vec<HostId> = order.into_iter().map(|c| c.host.clone()).collect();
        let running = Running {
            attempts: Attempts::new(order, me, hedge_ns, here_at_ns),
            give_up_at_ns: now_ns + sample.left_ns / 10 * 9,
            sample,
            spec,
            base,
            frame,
            state,
            standing,
            events: Vec::new(),
            ballot: None,
            redundancy,
            asked: Vec::new(),
            started_ns: now_ns,
            next_at_ns: 0,
            hedge_ns,
        };
        match (running.standing.revise, ballot) {
            (Some(_), None) => self.revise(host, number, running),
            // A change is voted on like any other step.
            (_, Some(ballot)) => self.open_ballot(host, number, running, ballot),
            (None, None) => self.advance(host, number, running),
        }
    }

    fn candidates(&self, host: u32, members: &[HostId]) -> Vec<Candidate> {
        let here = self.host(host);
        let one = |id: &HostId| {
            let other = host_number(id);
            let health = here.health.get(&other).filter(|_| other != host);
            Candidate {
                host: id.clone(),
                here: other == host,
                ready: true,
                closed: health.is_none_or(|h| h.closed(self.now_ns)),
                latency_ns: if other == host {
                    Some(0)
                } else {
                    health.and_then(select::Health::latency_ns)
                },
                // Some hosts have more to do than others.
                cpu: (other % 7) as f32 / 10.0,
            }
        };
        members.iter().map(one).collect()
    }

    /// A change of revision: both sides of it step here. The law is the same, so no output moves.
    fn revise(&mut self, host: u32, number: u32, mut running: Running) {
        self.go_over(number, &mut running);
        let effects = law::step(&running.state);
        self.conclude(host, number, running, Ok(effects), host);
    }

    /// Goes on under the revision that was asked for, if one was.
    fn go_over(&self, number: u32, running: &mut Running) {
        let Some((command, revision)) = running.standing.revise else {
            return;
        };
        match self.spec(number, revision) {
            Some(next) => {
                running.standing.remember(command, Outcome::Done);
                running.events.push(CycleEvent::Revised {
                    from: running.spec.revision,
                    from_digest: running.spec.digest,
                    by: "migrate".to_owned(),
                    bump_percent: 0.0,
                });
                running.spec = next;
            }
            None => running
                .standing
                .remember(command, Outcome::Refused("not known".to_owned())),
        }
    }

    fn request(&mut self, host: u32, number: u32, running: &mut Running, to: u32) {
        let me = self.host_mut(host);
        me.correlations += 1;
        let correlation = me.correlations;
        running.asked.push(Asked {
            correlation,
            host: to,
            at_ns: self.now_ns,
        });
        let request = StepRequest {
            from: host_id(host),
            correlation,
            loop_id: law::loop_id(number),
            digest: running.spec.digest,
            limit_ns: running.spec.step_limit_ns(),
            frame: running.frame.clone(),
            state: Arc::clone(&running.state),
            // The law is the same on both sides of a change.
            switch: None,
        };
        self.send(host, to, Message::Step(Box::new(request)));
    }

    fn wait(&mut self, host: u32, number: u32, mut running: Running, until_ns: u64) {
        running.next_at_ns = until_ns;
        if let Some(seat) = self.host_mut(host).seats.get_mut(&number) {
            seat.running = Some(Box::new(running));
            let at_ns = until_ns;
            self.queue
                .put(at_ns.max(self.now_ns), Event::Seat { host, number, at_ns });
        }
    }

    /// Asks the next replica, steps here, or ends the cycle.
    fn advance(&mut self, host: u32, number: u32, mut running: Running) {
        match running.attempts.next(self.now_ns) {
            Ask::Remote(to, until_ns) => {
                self.request(host, number, &mut running, host_number(&to));
                self.wait(host, number, running, until_ns);
            }
            Ask::Here => {
                let effects = self.step_on(host, &running.state, false);
                self.conclude(host, number, running, Ok(effects), host);
            }
            Ask::Nobody if running.asked.is_empty() || self.now_ns >= running.give_up_at_ns => {
                self.without_a_step(host, number, running, "no replica answered in time");
            }
            Ask::Nobody => {
                let until_ns = running.give_up_at_ns;
                self.wait(host, number, running, until_ns);
            }
        }
    }

    fn without_a_step(&mut self, host: u32, number: u32, running: Running, reason: &str) {
        let fault = Fault::NotReady {
            host: "any replica".to_owned(),
            reason: reason.to_owned(),
        };
        self.conclude(host, number, running, Err(fault), host);
    }

    /// A replica's time is up.
    pub(crate) fn seat_due(&mut self, host: u32, number: u32, at_ns: u64) {
        let now_ns = self.now_ns;
        let Some(seat) = self.host_mut(host).seats.get_mut(&number) else {
            return;
        };
        let Some(mut running) = seat.running.take_if(|r| r.next_at_ns == at_ns) else {
            return;
        };
        if running.ballot.is_some() {
            return self.ballot_due(host, number, *running);
        }
        if let Some(asked) = running.asked.last().copied() {
            self.silent(host, asked, now_ns);
            running.events.push(CycleEvent::Hedged {
                replica: host_id(asked.host),
            });
        }
        self.advance(host, number, *running);
    }

    fn silent(&mut self, host: u32, asked: Asked, now_ns: u64) {
        let health = self.host_mut(host).health.entry(asked.host).or_default();
        health.failed(now_ns, now_ns.saturating_sub(asked.at_ns));
    }

    /// A step for another host.
    pub(crate) fn step_request(&mut self, host: u32, request: &StepRequest) {
        let number = law::loop_number(&request.loop_id);
        let votes = self
            .spec(number, 1)
            .is_some_and(|s| matches!(s.strategy, Strategy::Vote(_)));
        let result = if self.host(host).seats.contains_key(&number) {
            Ok(self.step_on(host, &request.state, votes))
        } else {
            Err(Fault::NotReady {
                host: host_id(host).to_string(),
                reason: "the loop is not held here".to_owned(),
            })
        };
        let step_ns = self.step_ns(host);
        let answer = Box::new(StepAnswer {
            from: host_id(host),
            correlation: request.correlation,
            loop_id: request.loop_id.clone(),
            result,
            step_ns,
        });
        let (life, to) = (self.host(host).life, host_number(&request.from));
        self.queue
            .put(self.now_ns + step_ns, Event::Stepped { host, life, to, answer });
    }

    /// A replica answered.
    pub(crate) fn step_answer(&mut self, host: u32, answer: StepAnswer) {
        let now_ns = self.now_ns;
        let number = law::loop_number(&answer.loop_id);
        let from = host_number(&answer.from);
        let of_this = |a: &Asked| a.correlation == answer.correlation && a.host == from;
        let Some(seat) = self.host_mut(host).seats.get_mut(&number) else {
            return;
        };
        let Some(mut running) = seat.running.take_if(|r| r.asked.iter().any(of_this)) else {
            if let Some((decided, correlations)) = seat.late.as_mut()
                && let Some(i) = correlations.iter().position(|c| *c == answer.correlation)
            {
                correlations.swap_remove(i);
                let cast = Cast::of(answer.result);
                if cast != Cast::Nothing {
                    seat.judged.push((answer.from, cast.same(decided)));
                }
            }
            return;
        };
        let asked = running.asked.iter().position(of_this).map(|i| running.asked.remove(i));
        let latency_ns = asked.map_or(0, |a| now_ns.saturating_sub(a.at_ns));
        self.host_mut(host).health.entry(from).or_default().answered(latency_ns);
        if running.ballot.is_some() {
            return self.voted(host, number, *running, &answer.from, answer.result);
        }
        match answer.result {
            Ok(effects) => self.conclude(host, number, *running, Ok(effects), from),
            Err(_) => self.advance(host, number, *running),
        }
    }

    fn open_ballot(&mut self, host: u32, number: u32, mut running: Running, ballot: Ballot) {
        let me = host_id(host);
        let others: Vec<u32> = ballot.asked().filter(|h| **h != me).map(host_number).collect();
        for to in others {
            self.request(host, number, &mut running, to);
        }
        running.next_at_ns = self.now_ns + running.hedge_ns;
        running.ballot = Some(ballot);
        let at_ns = running.next_at_ns;
        self.queue.put(at_ns, Event::Seat { host, number, at_ns });
        let effects = self.step_on(host, &running.state, true);
        self.voted(host, number, running, &me, Ok(effects));
    }

    fn voted(&mut self, host: u32, number: u32, mut running: Running, by: &HostId, result: Result<Effects, Fault>) {
        if let Some(ballot) = running.ballot.as_mut() {
            ballot.cast(by, Cast::of(result));
        }
        let mut verdict = running.ballot.as_ref().map_or(Verdict::Split, Ballot::verdict);
        if self.broken() == Some(Broken::FirstAnswer) && verdict == Verdict::Open {
            verdict = Verdict::Agreed { answer: 0 };
        }
        match verdict {
            Verdict::Agreed { answer } => self.decide(host, number, running, Some(answer)),
            Verdict::Split => self.decide(host, number, running, None),
            Verdict::Open => {
                if let Some(seat) = self.host_mut(host).seats.get_mut(&number) {
                    seat.running = Some(Box::new(running));
                }
            }
        }
    }

    fn ballot_due(&mut self, host: u32, number: u32, mut running: Running) {
        let now_ns = self.now_ns;
        if now_ns >= running.give_up_at_ns {
            return self.decide(host, number, running, None);
        }
        let silent = running.ballot.as_ref().map(Ballot::silent_voters).unwrap_or_default();
        for id in silent {
            if let Some(asked) = running.asked.iter().find(|a| a.host == host_number(&id)).copied() {
                self.silent(host, asked, now_ns);
            }
            running.events.push(CycleEvent::Hedged { replica: id.clone() });
            if let Some(spare) = running.ballot.as_mut().and_then(|ballot| ballot.stand_in(&id)) {
                self.request(host, number, &mut running, host_number(&spare));
            }
        }
        let until_ns = running.give_up_at_ns;
        self.wait(host, number, running, until_ns);
    }

    fn decide(&mut self, host: u32, number: u32, mut running: Running, answer: Option<usize>) {
        let Some(ballot) = running.ballot.take() else { return };
        let Some(seat) = self.host_mut(host).seats.get_mut(&number) else {
            return;
        };
        let closed = ballot.close(answer);
        let mut judged = std::mem::take(&mut seat.judged);
        judged.extend(closed.judged);
        let silent = running
            .asked
            .iter()
            .filter(|a| closed.silent.contains(&host_id(a.host)));
        let correlations: Vec<u64> = silent.map(|a| a.correlation).collect();
        seat.late = (answer.is_some() && !correlations.is_empty()).then(|| (closed.decided.clone(), correlations));
        let (mut standing, news) = vote::standing(running.redundancy.vote.as_ref(), &judged, &running.sample.members);
        (standing.answers, standing.agreed, standing.needed) = (closed.answers, closed.agreed, closed.needed);
        for event in &news {
            self.counts.dissents += u64::from(matches!(event, CycleEvent::Dissent { .. }));
            self.counts.readmitted += u64::from(matches!(event, CycleEvent::Readmitted { .. }));
        }
        running.redundancy.vote = Some(standing);
        running.events.extend(news);
        match closed.decided {
            Cast::Effects(effects) => {
                self.go_over(number, &mut running);
                self.conclude(host, number, running, Ok(effects), host);
            }
            _ => {
                self.counts.no_majority += 1;
                if let Some((command, _)) = running.standing.revise {
                    let refused = Outcome::Refused("no majority".to_owned());
                    running.standing.remember(command, refused);
                }
                self.without_a_step(host, number, running, "no majority");
            }
        }
    }

    fn conclude(&mut self, host: u32, number: u32, running: Running, step: Result<Effects, Fault>, by: u32) {
        let now_ns = self.now_ns;
        let me = host_id(host);
        let step_ns = self.step_ns(host);
        let probation = swap::probation_after(running.base.as_deref());
        let home = host_number(&running.sample.home);
        let mut record = seat::conclude(Conclusion {
            owner: &me,
            sample: &running.sample,
            base: running.base.as_deref(),
            spec: &running.spec,
            wiring: &self.wiring,
            readings: running.sample.readings.clone(),
            state: running.state,
            standing: running.standing,
            events: running.events,
            probation,
            redundancy: running.redundancy,
            step: step.map(|effects| Stepped {
                effects,
                by: host_id(by),
                step_ns,
            }),
            cycle_ns: now_ns.saturating_sub(running.started_ns),
        });
        if self.broken() == Some(Broken::Unchained) {
            record.after = (0, 0);
        }
        if home != host
            && let Some(seat) = self.host_mut(host).seats.get_mut(&number)
        {
            seat.inflight = Some(Arc::new(record.clone()));
        }
        self.answer_to(host, home, Answer::Commit(Box::new(record)));
    }

    fn answer_to(&mut self, host: u32, home: u32, answer: Answer) {
        if home == host {
            self.answer(host, answer);
        } else {
            self.send(host, home, Message::Answer(Box::new(answer)));
        }
    }

    /// A record that was taken; `remote` where it came over the network.
    pub(crate) fn record(&mut self, host: u32, record: &Arc<Record>, remote: bool) {
        let number = law::loop_number(&record.loop_id);
        let Some(seat) = self.host_mut(host).seats.get_mut(&number) else {
            return;
        };
        let news = remote && record.has_news_for(seat.last.as_deref());
        if seat
            .last
            .as_ref()
            .is_none_or(|last| last.position() < record.position())
        {
            seat.inflight.take_if(|r| r.position() <= record.position());
            seat.running
                .take_if(|r| (r.sample.term, r.sample.seq) <= record.position());
            seat.last = Some(Arc::clone(record));
        }
        if news {
            let held = Answer::Held {
                loop_id: record.loop_id.clone(),
                term: record.term,
                seq: record.seq,
                host: host_id(host),
            };
            self.send(host, host_number(&record.home), Message::Answer(Box::new(held)));
        }
    }
}
