//! `vote(n)` in a run: the ballot of `core::vote` with virtual time around it, as `loops` puts real time around it.
//!
//! ```text
//! open ─► asks voters and those aside, steps here ─► count ◄── answer
//!                                                     │  ▲
//!                   hedge time: spares for the silent ┼──┘
//!                   a majority ─► conclude            │
//!                   none possible, or time is up ─────┴─► the loop's policy
//! ```
//! Never: a wrong answer of its own; steps go wrong where the experiment says so (`do = "wrong"`).

use bumpless_core::{
    Effects, Event, Fault, HostId, LoopSpec, Record, Redundancy, Strategy,
    seat::Stepped,
    select::{self, Candidate},
    vote::{self, Ballot, Cast, Verdict},
};

use crate::{
    seat::Running,
    world::{What, World},
};

/// What a vote decided, for answers that come after it.
pub(crate) struct Late {
    decided: Cast,
    /// Term and number of the cycle.
    cycle: (u64, u64),
    /// Who has not answered yet.
    silent: Vec<HostId>,
}

/// What the cycle can count on, and its ballot where the strategy is a vote.
pub(crate) fn redundancy(
    spec: &LoopSpec,
    candidates: &[Candidate],
    here: &HostId,
    base: Option<&Record>,
) -> (Redundancy, Option<Ballot>) {
    let Strategy::Vote(n) = spec.strategy else {
        return (Redundancy::default(), None);
    };
    let mut standing = base.and_then(|r| r.redundancy.vote.clone()).unwrap_or_default();
    let order = select::select(spec.strategy, candidates, &spec.id, 0, 0);
    let order = order.into_iter().filter_map(|i| candidates.get(i));
    let others = order
        .filter(|c| c.ready && c.closed && c.host != *here)
        .map(|c| c.host.clone());
    let able = std::iter::once(here.clone()).chain(others);
    let ballot = Ballot::new(n, able, &standing.aside, spec.policy.on_fewer);
    (standing.answers, standing.agreed, standing.needed) = (0, 0, 0);
    let have = u8::try_from(ballot.have()).unwrap_or(u8::MAX).min(n);
    let redundancy = Redundancy {
        have,
        want: n,
        vote: Some(standing),
    };
    (redundancy, Some(ballot))
}

impl World<'_> {
    /// Asks everyone who votes or steps along, and steps here.
    pub(crate) fn open_ballot(&mut self, of: usize, owner: usize, mut running: Running, ballot: Ballot) {
        let Some(here) = self.hosts.get(owner).map(|h| h.id.clone()) else {
            return;
        };
        let others: Vec<HostId> = ballot.asked().filter(|h| **h != here).cloned().collect();
        for host in others {
            self.ask_vote(of, owner, &mut running, &host);
        }
        running.ballot = Some(ballot);
        let (term, seq) = running.cycle();
        let result = self.step(of, owner, running.revision, &running.frame, &running.state);
        let at_ns = self.now_ns + self.step_ns(owner);
        let result = Box::new(result);
        self.at(
            at_ns,
            What::Answered {
                of,
                owner,
                host: owner,
                term,
                seq,
                result,
            },
        );
        let until_ns = self.now_ns + running.hedge_ns;
        self.wait(of, owner, running, until_ns);
    }

    fn ask_vote(&mut self, of: usize, owner: usize, running: &mut Running, id: &HostId) {
        let host = self.host(id);
        let (term, seq) = running.cycle();
        running.asked.push((host, self.now_ns));
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
    }

    /// Somebody answered.
    pub(crate) fn voted(
        &mut self,
        of: usize,
        owner: usize,
        host: usize,
        mut running: Running,
        result: Result<Effects, Fault>,
    ) {
        let Some(id) = self.hosts.get(host).map(|h| h.id.clone()) else {
            return;
        };
        if let Err(fault) = &result {
            running.events.push(Event::Faulted {
                replica: id.clone(),
                fault: fault.to_string(),
            });
        }
        if let Some(ballot) = running.ballot.as_mut() {
            ballot.cast(&id, Cast::of(result));
        }
        match running.ballot.as_ref().map(Ballot::verdict) {
            Some(Verdict::Agreed { answer }) => self.decide(of, owner, running, Some(answer)),
            Some(Verdict::Split) => self.decide(of, owner, running, None),
            // The timer that runs already goes on.
            Some(Verdict::Open) => {
                if let Some(slot) = self.running(of, owner) {
                    *slot = Some(running);
                }
            }
            None => {}
        }
    }

    /// An answer that came after its cycle had ended.
    pub(crate) fn judge_late(
        &mut self,
        of: usize,
        owner: usize,
        host: usize,
        cycle: (u64, u64),
        result: Result<Effects, Fault>,
    ) {
        let Some(id) = self.hosts.get(host).map(|h| h.id.clone()) else {
            return;
        };
        let Some(seat) = self.hosts.get_mut(owner).and_then(|h| h.seats.get_mut(of)) else {
            return;
        };
        let Some(late) = seat.late.as_mut().filter(|late| late.cycle == cycle) else {
            return;
        };
        let Some(i) = late.silent.iter().position(|h| *h == id) else {
            return;
        };
        late.silent.swap_remove(i);
        let cast = Cast::of(result);
        if cast != Cast::Nothing {
            let agreed = cast.same(&late.decided);
            seat.judged.push((id, agreed));
        }
    }

    /// The hedge time is over: silent voters are stood in for, where somebody is left. Or the whole time is.
    pub(crate) fn ballot_due(&mut self, of: usize, owner: usize, mut running: Running) {
        let now_ns = self.now_ns;
        if now_ns >= running.give_up_at_ns {
            return self.decide(of, owner, running, None);
        }
        let silent = running.ballot.as_ref().map(Ballot::silent_voters).unwrap_or_default();
        for id in silent {
            let host = self.host(&id);
            if let Some(asked_ns) = running.asked.iter().find(|(h, _)| *h == host).map(|(_, at)| *at)
                && let Some(h) = self.hosts.get_mut(owner)
            {
                h.health.entry(host).or_default().failed(now_ns, now_ns - asked_ns);
            }
            running.events.push(Event::Hedged { replica: id.clone() });
            if let Some(spare) = running.ballot.as_mut().and_then(|ballot| ballot.stand_in(&id)) {
                self.ask_vote(of, owner, &mut running, &spare);
            }
        }
        let until_ns = running.give_up_at_ns;
        self.wait(of, owner, running, until_ns);
    }

    /// The vote is over: judges those who answered, remembers the decision for those who did not, and ends the cycle.
    fn decide(&mut self, of: usize, owner: usize, mut running: Running, answer: Option<usize>) {
        let Some(ballot) = running.ballot.take() else { return };
        let (now_ns, name) = (self.now_ns, self.loop_name(of).to_owned());
        let Some(host) = self.hosts.get_mut(owner) else { return };
        let by = host.id.clone();
        let Some(seat) = host.seats.get_mut(of) else { return };
        let closed = ballot.close(answer);
        let mut judged = std::mem::take(&mut seat.judged);
        judged.extend(closed.judged);
        let (mut standing, news) = vote::standing(running.redundancy.vote.as_ref(), &judged, &running.sample.members);
        (standing.answers, standing.agreed, standing.needed) = (closed.answers, closed.agreed, closed.needed);
        running.redundancy.vote = Some(standing);
        seat.late = (answer.is_some() && !closed.silent.is_empty()).then(|| Late {
            decided: closed.decided.clone(),
            cycle: running.cycle(),
            silent: closed.silent,
        });
        let dissents = judged.iter().filter(|(_, agreed)| !agreed).count() as u64;
        if let Some(l) = self.loops.get_mut(of) {
            l.meter.dissents += dissents;
        }
        for event in &news {
            match event {
                Event::Dissent { replica } => self.note(format!("{name}: {replica} stood against the majority")),
                Event::Readmitted { replica } => self.note(format!("{name}: {replica} votes again")),
                _ => {}
            }
        }
        running.events.extend(news);
        let step = match closed.decided {
            Cast::Effects(effects) => Ok(Stepped {
                effects,
                by,
                step_ns: now_ns - running.started_ns,
            }),
            Cast::Fault(fault) => Err(fault),
            Cast::Nothing => {
                running.events.push(Event::NoMajority {
                    answers: closed.answers,
                    agreed: closed.agreed,
                    needed: closed.needed,
                });
                Err(Fault::NotReady {
                    host: "a majority".to_owned(),
                    reason: format!(
                        "{} of {} answers agree, {} are needed",
                        closed.agreed, closed.answers, closed.needed
                    ),
                })
            }
        };
        self.conclude(of, owner, running, step);
    }
}
