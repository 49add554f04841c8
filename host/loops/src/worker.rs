//! One worker thread: an inbox, a heap of absolute times, and the loops that live on it.
//!
//! Never: waits for anything but its inbox and its next deadline; never touches tokio, the disk or the network's waiting
//! sends. Times are the host's steady clock; a home's deadlines are absolute, so lateness does not add up.

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashMap},
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use bumpless_core::{
    LoopId,
    chatter::PROBE_NS,
    protocol::{Sample, StepRequest},
};

use crate::{
    calls::{Calls, is_call},
    event::Event,
    home::Home,
    inbox::{Nothing, Receiver},
    seat::Seat,
    shared::Shared,
};

/// Longest sleep, in ns: a worker with nothing to do looks around this often.
const NAP_NS_MAX: u64 = 1_000_000_000;
/// Events handled before timers are looked at again.
const EVENTS_BEFORE_TIMERS_MAX: usize = 64;

/// What a time in the heap is about. A time that was replaced by a later one is passed over when it comes.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Timer {
    Home(LoopId),
    Seat(LoopId),
    Call(u64),
    Probe,
}

pub(crate) struct Worker {
    pub(crate) index: usize,
    pub(crate) shared: Arc<Shared>,
    pub(crate) homes: HashMap<LoopId, Home>,
    pub(crate) seats: HashMap<LoopId, Seat>,
    pub(crate) calls: Calls,
    inbox: Receiver<Event>,
    timers: BinaryHeap<Reverse<(u64, Timer)>>,
    random: u64,
    correlations: u64,
}

impl Worker {
    pub(crate) fn new(index: usize, shared: Arc<Shared>, inbox: Receiver<Event>) -> Self {
        let random = shared.now_ns() ^ (index as u64) << 32;
        Self {
            index,
            shared,
            homes: HashMap::new(),
            seats: HashMap::new(),
            calls: Calls::default(),
            inbox,
            timers: BinaryHeap::new(),
            random,
            correlations: 0,
        }
    }

    /// Runs until it is told to stop or nobody can tell it any more.
    pub(crate) fn run(mut self) {
        // The default slack of 50 µs would be the greatest part of a wake-up's lateness. Refusal only costs precision.
        if let Err(error) = rustix::thread::set_current_timer_slack(std::num::NonZeroU64::new(1)) {
            tracing::debug!(%error, "timer slack stays at the system's default");
        }
        if self.index == 0 {
            self.at(self.shared.now_ns(), Timer::Probe);
        }
        'run: loop {
            // What has arrived goes before what is late: after a stall of the machine the commit that a timer would miss
            // lies in the inbox already, and a takeover for it would be noise. Bounded, so that timers get their turn.
            for _ in 0..EVENTS_BEFORE_TIMERS_MAX {
                match self.inbox.try_recv() {
                    Some(Event::Stop) => break 'run,
                    Some(event) => self.handle(event),
                    None => break,
                }
            }
            let now_ns = self.fire();
            if let Some(turn) = self.shared.turns.get(self.index) {
                turn.store(now_ns, Ordering::Relaxed);
            }
            let next_ns = self
                .timers
                .peek()
                .map_or(now_ns + NAP_NS_MAX, |Reverse((at_ns, _))| *at_ns);
            let wait = Duration::from_nanos(next_ns.saturating_sub(now_ns).min(NAP_NS_MAX));
            match self.inbox.recv_timeout(wait) {
                Ok(Event::Stop) | Err(Nothing::Disconnected) => break,
                Ok(event) => self.handle(event),
                Err(Nothing::Timeout) => {}
            }
        }
    }

    /// Wakes up at `at_ns` for this.
    pub(crate) fn at(&mut self, at_ns: u64, timer: Timer) {
        self.timers.push(Reverse((at_ns, timer)));
    }

    /// A fresh random number (SplitMix64; Steele, Lea, Flood 2014): selection needs evenness, not secrecy.
    pub(crate) fn random(&mut self) -> u64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number for a step request; its top byte brings the answer back to this worker.
    pub(crate) fn correlation(&mut self) -> u64 {
        self.correlations += 1;
        (self.index as u64) << 56 | (self.correlations & 0x00ff_ffff_ffff_ffff)
    }

    /// Handles every time that has come. Gives the time afterwards.
    fn fire(&mut self) -> u64 {
        loop {
            let now_ns = self.shared.now_ns();
            match self.timers.peek() {
                Some(Reverse((at_ns, _))) if *at_ns <= now_ns => {}
                _ => return now_ns,
            }
            let Some(Reverse((at_ns, timer))) = self.timers.pop() else {
                return now_ns;
            };
            match timer {
                Timer::Home(id) => self.home_due(&id, at_ns, now_ns),
                Timer::Seat(id) => self.seat_due(&id, at_ns, now_ns),
                Timer::Call(correlation) => self.call_due(correlation, now_ns),
                Timer::Probe => {
                    for (host, token) in self.shared.replicas.probes(&self.shared.here, now_ns) {
                        self.shared.wire.ping(&host, token);
                    }
                    self.at(now_ns + PROBE_NS, Timer::Probe);
                }
            }
        }
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Sample(sample) if self.is_stale(&sample) => {}
            Event::Sample(sample) => self.sample(sample),
            Event::Answer(answer) => self.answer(*answer),
            Event::Record(record) => self.remote_record(&record),
            Event::StepRequest(request) if self.is_overtaken(&request) => {}
            Event::StepRequest(request) => self.step_request(*request),
            Event::StepAnswer(answer) => self.step_answer(*answer),
            Event::Ping { from, token } => self.shared.wire.pong(&from, token),
            Event::HostGone(host) => self.host_gone(&host),
            Event::OpenHome(opening) => self.open_home(*opening),
            Event::AddHomeRevision(revision) => self.add_home_revision(*revision),
            Event::CloseHome(id) => self.close_home(&id),
            Event::Members(id, members) => self.members(&id, members),
            Event::Command(id, command, reply) => self.command(&id, *command, reply),
            Event::Kept(id, position) => self.acknowledge(&id, position),
            Event::Withdraw(id, command, reply) => reply(self.homes.get_mut(&id).is_some_and(|h| h.withdraw(command))),
            Event::MoveTo(id, host) => {
                if let Some(home) = self.homes.get_mut(&id) {
                    home.desk.move_to(host);
                }
            }
            Event::Hold(revision) => self.hold(*revision),
            Event::KeepRevisions(id, keep) => self.keep_revisions(&id, &keep),
            Event::Release(id) => self.release(&id),
            Event::Call(call) => self.call(*call),
            Event::Stop => {}
        }
    }

    /// A newer cycle of the loop waits behind this one: its time is over, and work on it would only make the next one late. So
    /// a host that was held up goes on with the present instead of working off its past.
    fn is_stale(&self, sample: &Sample) -> bool {
        let position = (sample.term, sample.seq);
        self.inbox.holds(|event| match event {
            Event::Sample(newer) => newer.loop_id == sample.loop_id && (newer.term, newer.seq) > position,
            _ => false,
        })
    }

    /// The same for a step: its owner has asked for a later cycle since. Calls have no cycles, so none overtakes another.
    fn is_overtaken(&self, request: &StepRequest) -> bool {
        !is_call(&request.loop_id)
            && self.inbox.holds(|event| match event {
                Event::StepRequest(newer) => {
                    newer.loop_id == request.loop_id
                        && newer.from == request.from
                        && newer.frame.cycle.seq > request.frame.cycle.seq
                }
                _ => false,
            })
    }

    /// A host is gone: homes look for another owner at once, seats and calls for another replica.
    fn host_gone(&mut self, host: &bumpless_core::HostId) {
        let now_ns = self.shared.now_ns();
        let homes: Vec<LoopId> = self
            .homes
            .iter()
            .filter(|(_, h)| h.desk.members().contains(host))
            .map(|(id, _)| id.clone())
            .collect();
        for id in homes {
            let members = self
                .homes
                .get(&id)
                .map(|h| h.desk.members().iter().filter(|m| *m != host).cloned().collect());
            if let Some(members) = members {
                self.members(&id, members);
            }
        }
        let waiting: Vec<LoopId> = self
            .seats
            .iter()
            .filter(|(_, s)| s.waits_for(host))
            .map(|(id, _)| id.clone())
            .collect();
        for id in waiting {
            self.replica_lost(&id, host, now_ns);
        }
    }
}
