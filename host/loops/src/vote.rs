//! The owner's shell around `core::vote`: asks everyone at once, steps here, and ends the cycle as soon as a majority is there.
//!
//! ```text
//! open ─► step requests to voters and to those aside ─► step here ─► count ◄── answer
//!                                                                     │  ▲
//!                             hedge time: spares for the silent ──────┼──┘
//!                             a majority ─► conclude                  │
//!                             none possible, or time is up ───────────┴─► the loop's policy
//! ```
//! In the cycle of a change the ballot is about the new component's first step, state handed over and all (`revise`).
//! A dissenter is never waited for: what comes after the decision is judged then, and counts in the next cycle.
//! Never: asks twice, or waits longer than a cycle without a vote would.

use bumpless_core::{
    Event as CycleEvent, Fault, HostId, LoopId, LoopSpec, Record, Redundancy,
    limits::REPLICAS_MAX,
    seat::Stepped,
    select::{self, Candidate},
    spec::Strategy,
    vote::{self, Ballot, Cast, Verdict},
};

use crate::{
    seat::{Asked, Running, Seat},
    worker::Worker,
};

/// Judgements that may wait for the next cycle: every replica of two cycles.
pub(crate) const JUDGED_MAX: usize = 2 * REPLICAS_MAX;

/// What a vote decided, for answers that come after it.
pub(crate) struct Late {
    decided: Cast,
    /// The requests that were not answered in time.
    correlations: Vec<u64>,
}

/// What the cycle can count on, and its ballot where the strategy is a vote. Where a cycle is not voted on, the ballot is
/// dropped, and who has no vote stays as it was.
pub(crate) fn redundancy(
    spec: &LoopSpec,
    candidates: &[Candidate],
    here: &HostId,
    base: Option<&Record>,
    ballot: &mut Option<Ballot>,
) -> Redundancy {
    let count = |n: usize| u8::try_from(n).unwrap_or(u8::MAX);
    let able = |c: &&Candidate| c.ready && c.closed;
    let Strategy::Vote(n) = spec.strategy else {
        return Redundancy {
            have: count(candidates.iter().filter(able).count()),
            want: spec.replicas,
            vote: None,
        };
    };
    let mut standing = base.and_then(|r| r.redundancy.vote.clone()).unwrap_or_default();
    // Members in the order of the loop's name, this host first: a vote is not about who is fastest.
    let order = select::select(spec.strategy, candidates, &spec.id, 0, 0);
    let order = order.into_iter().filter_map(|i| candidates.get(i)).filter(able);
    let others = order.map(|c| c.host.clone()).filter(|h| h != here);
    let able = std::iter::once(here.clone()).chain(others);
    let opened = Ballot::new(n, able, &standing.aside, spec.policy.on_fewer);
    let have = count(opened.have()).min(n);
    *ballot = Some(opened);
    (standing.answers, standing.agreed, standing.needed) = (0, 0, 0);
    Redundancy {
        have,
        want: n,
        vote: Some(standing),
    }
}

impl Seat {
    /// An answer that came after its cycle had ended.
    pub(crate) fn judge_late(&mut self, asked: &Asked, result: Result<bumpless_core::Effects, Fault>) {
        let Some(late) = self.late.as_mut() else { return };
        let Some(i) = late.correlations.iter().position(|c| *c == asked.correlation) else {
            return;
        };
        late.correlations.swap_remove(i);
        let cast = Cast::of(result);
        if cast != Cast::Nothing && self.judged.len() < JUDGED_MAX {
            self.judged.push((asked.host.clone(), cast.same(&late.decided)));
        }
    }
}

impl Worker {
    /// Asks everyone who votes or steps along, steps here, and looks how it stands.
    pub(crate) fn open_ballot(&mut self, id: &LoopId, running: Running, ballot: Ballot) {
        let Some(running) = self.ask_voters(id, running, ballot) else {
            return;
        };
        let Some((step, step_ns)) = self.step_here(id, &running) else {
            return;
        };
        if let (Err(fault), Some(seat)) = (&step, self.seats.get_mut(id)) {
            seat.remember_fault(&running, fault, step_ns);
        }
        self.voted_here(id, running, step);
    }

    /// The same where this host has stepped already.
    pub(crate) fn open_ballot_with(
        &mut self,
        id: &LoopId,
        running: Running,
        ballot: Ballot,
        step: Result<bumpless_core::Effects, Fault>,
    ) {
        if let Some(running) = self.ask_voters(id, running, ballot) {
            self.voted_here(id, running, step);
        }
    }

    fn ask_voters(&mut self, id: &LoopId, mut running: Running, ballot: Ballot) -> Option<Running> {
        let now_ns = self.shared.now_ns();
        let mut request = self.request(id, &running)?;
        let here = self.shared.here.clone();
        let others: Vec<HostId> = ballot.asked().filter(|h| **h != here).cloned().collect();
        for host in others {
            self.ask(&mut running, &mut request, host, now_ns);
        }
        running.next_at_ns = now_ns + running.hedge_ns;
        running.ballot = Some(ballot);
        Some(running)
    }

    fn voted_here(&mut self, id: &LoopId, running: Running, step: Result<bumpless_core::Effects, Fault>) {
        let (here, until_ns) = (self.shared.here.clone(), running.next_at_ns);
        self.at(until_ns, crate::worker::Timer::Seat(id.clone()));
        self.voted(id, running, &here, step);
    }

    /// Somebody answered.
    pub(crate) fn voted(
        &mut self,
        id: &LoopId,
        mut running: Running,
        host: &HostId,
        result: Result<bumpless_core::Effects, Fault>,
    ) {
        if let Err(fault) = &result {
            running.events.push(CycleEvent::Faulted {
                replica: host.clone(),
                fault: fault.to_string(),
            });
        }
        if let Some(ballot) = running.ballot.as_mut() {
            ballot.cast(host, Cast::of(result));
        }
        self.count(id, running);
    }

    /// Ends the vote where it can be ended; else the timer that runs already goes on.
    fn count(&mut self, id: &LoopId, running: Running) {
        match running.ballot.as_ref().map(Ballot::verdict) {
            Some(Verdict::Agreed { answer }) => self.decide(id, running, Some(answer)),
            Some(Verdict::Split) => self.decide(id, running, None),
            Some(Verdict::Open) => {
                if let Some(seat) = self.seats.get_mut(id) {
                    seat.running = Some(running);
                }
            }
            None => {}
        }
    }

    /// The hedge time is over: silent voters are stood in for, where somebody is left. Or the whole time is.
    pub(crate) fn ballot_due(&mut self, id: &LoopId, mut running: Running, now_ns: u64) {
        if now_ns >= running.give_up_at_ns {
            return self.decide(id, running, None);
        }
        let silent = running.ballot.as_ref().map(Ballot::silent_voters).unwrap_or_default();
        for host in silent {
            if let Some(asked) = running.asked.iter().find(|a| a.host == host) {
                let waited_ns = now_ns.saturating_sub(asked.at_ns);
                self.shared.replicas.silent(&host, now_ns, waited_ns);
            }
            self.stand_in(id, &mut running, &host, now_ns);
        }
        let until_ns = running.give_up_at_ns;
        self.wait(id, running, until_ns);
    }

    fn stand_in(&mut self, id: &LoopId, running: &mut Running, silent: &HostId, now_ns: u64) {
        running.events.push(CycleEvent::Hedged {
            replica: silent.clone(),
        });
        let spare = running.ballot.as_mut().and_then(|ballot| ballot.stand_in(silent));
        if let (Some(spare), Some(mut request)) = (spare, self.request(id, running)) {
            self.ask(running, &mut request, spare, now_ns);
        }
    }

    /// A replica that the vote may wait for is gone.
    pub(crate) fn voter_lost(&mut self, id: &LoopId, mut running: Running, host: &HostId) {
        running.asked.retain(|a| a.host != *host);
        if running.ballot.as_ref().is_some_and(|ballot| ballot.waits_for(host)) {
            let now_ns = self.shared.now_ns();
            self.stand_in(id, &mut running, host, now_ns);
            if let Some(ballot) = running.ballot.as_mut() {
                ballot.cast(host, Cast::Nothing);
            }
        }
        self.count(id, running);
    }

    /// The vote is over: judges those who answered, remembers the decision for those who did not, and ends the cycle.
    fn decide(&mut self, id: &LoopId, mut running: Running, answer: Option<usize>) {
        let Some(ballot) = running.ballot.take() else { return };
        let Some(seat) = self.seats.get_mut(id) else { return };
        let closed = ballot.close(answer);
        let mut judged = std::mem::take(&mut seat.judged);
        judged.extend(closed.judged);
        let (mut standing, news) = vote::standing(running.redundancy.vote.as_ref(), &judged, &running.sample.members);
        (standing.answers, standing.agreed, standing.needed) = (closed.answers, closed.agreed, closed.needed);
        running.redundancy.vote = Some(standing);
        running.events.extend(news);
        let silent = running.asked.iter().filter(|a| closed.silent.contains(&a.host));
        let correlations: Vec<u64> = silent.map(|a| a.correlation).collect();
        seat.late = (answer.is_some() && !correlations.is_empty()).then(|| Late {
            decided: closed.decided.clone(),
            correlations,
        });
        let step_ns = self.shared.now_ns().saturating_sub(running.started_ns);
        match closed.decided {
            Cast::Effects(effects) if running.switch.is_some() => self.switched(id, running, Ok(effects), step_ns),
            Cast::Fault(fault) if running.switch.is_some() => {
                self.switched(id, running, Err(format!("its first step failed: {fault}")), step_ns);
            }
            Cast::Effects(effects) => {
                let by = self.shared.here.clone();
                self.conclude(id, running, Ok(Stepped { effects, by, step_ns }));
            }
            Cast::Fault(fault) => self.without_a_step(id, running, fault),
            Cast::Nothing => {
                running.events.push(CycleEvent::NoMajority {
                    answers: closed.answers,
                    agreed: closed.agreed,
                    needed: closed.needed,
                });
                let reason = format!(
                    "{} of {} answers agree, {} are needed",
                    closed.agreed, closed.answers, closed.needed
                );
                if running.switch.is_some() {
                    let words = format!("replicas did not agree on its first step: {reason}");
                    return self.switched(id, running, Err(words), step_ns);
                }
                let fault = Fault::NotReady {
                    host: "a majority".to_owned(),
                    reason,
                };
                self.without_a_step(id, running, fault);
            }
        }
    }
}
