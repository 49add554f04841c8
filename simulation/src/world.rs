//! The whole: hosts, loops, links and time, and what a fault does to them.
//!
//! ```text
//! queue ─► the next event ─► its host: dead? lost. still? waits. else ─► home or seat ─► messages, times ─► queue
//! ```
//! Owns the order of everything. Never: decides what the core decides, or reads a clock of this machine.

use std::{collections::VecDeque, sync::Arc};

use bumpless_core::{
    LoopSpec, Wiring,
    desk::{Tally, terms_passed_over},
    place,
};

use crate::{
    Error,
    counts::Counts,
    event::{Event, Message, Queue},
    home::{GATHER_NS, Loop, SYNC_NS},
    host::{Clock, Host, INBOX_MAX, Seat},
    law::{self, HOLDERS, host_id, loop_id},
    network::Network,
    plan::{Broken, Fault, FaultKind, Plan},
    random::Random,
    rules::{Actuator, RULES, Violation},
};

/// Lines of a trace; the oldest go.
const TRACE_LINES_MAX: usize = 400;
/// A link that is silent for so long is given up, in ns: the lease of the bus.
const LEASE_NS: u64 = 10_000_000_000;
/// What happens so long after the end of a fault may still be its doing, in ns: a silent host is passed over for up to a
/// minute, and a cell that lost a link needs its lease and some seconds to get ready again.
const BLAME_NS: u64 = 75_000_000_000;
/// The true time at which a simulation starts, in ns since 1970: a day of 2025, for clocks show dates.
const EPOCH_NS: u64 = 1_750_000_000_000_000_000;
/// At the end every loop must have written within so many periods, but at least this time, in ns.
const GOES_ON: (u64, u64) = (5, 3_000_000_000);

/// A cell in simulated time.
pub struct World {
    pub(crate) plan: Plan,
    pub(crate) now_ns: u64,
    pub(crate) queue: Queue,
    pub(crate) random: Random,
    pub(crate) network: Network,
    pub(crate) hosts: Vec<Host>,
    pub(crate) loops: Vec<Loop>,
    pub(crate) wiring: Wiring,
    pub(crate) counts: Counts,
    faults: Vec<Fault>,
    violation: Option<Violation>,
    trace: VecDeque<String>,
}

impl World {
    /// A cell that has just started.
    ///
    /// # Errors
    /// What [`Plan::check`] says.
    pub fn new(plan: Plan) -> Result<Self, Error> {
        plan.check()?;
        let mut random = Random::new(plan.seed, "world");
        let clock = |random: &mut Random| {
            let hours = random.between(0, 13) as i64 - 6;
            Clock {
                local_ns: shifted(EPOCH_NS, hours * 3_600_000_000_000),
                since_ns: 0,
                ppm: random.between(0, 401) as i64 - 200,
            }
        };
        let hosts: Vec<Host> = (0..plan.hosts).map(|_| Host::new(clock(&mut random))).collect();
        let mut world = Self {
            network: Network::new(plan.seed, plan.hosts),
            faults: plan.faults(),
            now_ns: 0,
            queue: Queue::default(),
            random,
            hosts,
            loops: Vec::with_capacity(plan.loops as usize),
            wiring: law::wiring(),
            counts: Counts::default(),
            violation: None,
            trace: VecDeque::new(),
            plan,
        };
        world.people();
        Ok(world)
    }

    /// Gives every loop its home and its holders, and puts the first events in.
    fn people(&mut self) {
        let all: Vec<_> = (0..self.plan.hosts).map(host_id).collect();
        for number in 0..self.plan.loops {
            let home = number % self.plan.hosts;
            let ranked = if law::is_alone(number) {
                vec![home]
            } else {
                let members = place::rank(&loop_id(number), &all);
                members.iter().take(HOLDERS).map(law::host_number).collect()
            };
            for (rank, host) in ranked.iter().enumerate() {
                let host = self.host_mut(*host);
                host.ranks.push((number, rank as u8));
                host.seats.insert(number, Seat::default());
            }
            self.host_mut(home).homes.push(number);
            self.loops.push(Loop {
                home,
                ranked,
                there: 0,
                ready: 0,
                preparing: 0,
                desk: None,
                before: Tally::default(),
                life: 0,
                timer_at_ns: 0,
                specs: vec![Arc::new(law::spec(number, 1))],
                disk: None,
                actuator: Actuator::default(),
                client: crate::home::Client::default(),
            });
            self.open(number);
            let ask_ns = self.random.between(0, 10_000_000_000);
            self.queue.put(ask_ns, Event::Ask { number });
        }
        for host in 0..self.plan.hosts {
            let first_ns = self.random.between(0, SYNC_NS);
            let sync = Event::Sync {
                host,
                life: 0,
                once: false,
            };
            self.queue.put(first_ns, sync);
        }
        for (fault, at_ms) in self.faults.iter().map(|f| f.at_ms).enumerate() {
            self.queue.put(at_ms * 1_000_000, Event::Strike { fault });
        }
    }

    /// Runs to the end, or to the first rule that does not hold. The faults are over before the calm seconds.
    pub fn run(&mut self) {
        let end_ns = (self.plan.seconds + self.plan.calm_seconds) * 1_000_000_000;
        while self.violation.is_none()
            && let Some((at_ns, event)) = self.queue.next(end_ns)
        {
            self.now_ns = at_ns;
            self.counts.events += 1;
            self.happen(event);
        }
        if self.violation.is_some() {
            return;
        }
        self.now_ns = end_ns;
        let stuck = self.loops.iter().enumerate().find_map(|(number, l)| {
            let period_ns = l.specs.first().map_or(0, |s| s.period_ns);
            let (periods, least_ns) = GOES_ON;
            let since_ns = end_ns - l.actuator.written_at_ns;
            (since_ns > (periods * period_ns).max(least_ns)).then_some((number as u32, since_ns))
        });
        if let Some((number, since_ns)) = stuck {
            let l = &self.loops[number as usize];
            let seen = format!(
                "nothing written for {} ms; home h{}, hosts {:?}, there {:b}, ready {:b}",
                since_ns / 1_000_000,
                l.home,
                l.ranked,
                l.there,
                l.ready
            );
            self.violated(RULES[5], number, seen);
        }
    }

    /// What was counted.
    #[must_use]
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// The plan.
    #[must_use]
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// The first rule that did not hold.
    #[must_use]
    pub const fn violation(&self) -> Option<&Violation> {
        self.violation.as_ref()
    }

    /// The last lines about the loop that the plan names.
    pub fn trace(&self) -> impl Iterator<Item = &str> {
        self.trace.iter().map(String::as_str)
    }

    pub(crate) const fn broken(&self) -> Option<Broken> {
        self.plan.broken
    }

    pub(crate) fn violated(&mut self, rule: &'static str, number: u32, seen: String) {
        self.note(number, || format!("{rule}: {seen}"));
        self.violation.get_or_insert(Violation {
            rule,
            number,
            at_ns: self.now_ns,
            seen,
        });
    }

    pub(crate) fn note(&mut self, number: u32, text: impl FnOnce() -> String) {
        if self.plan.trace != Some(number) {
            return;
        }
        if self.trace.len() == TRACE_LINES_MAX {
            self.trace.pop_front();
        }
        let line = format!("{:>12.6} s  {}", self.now_ns as f64 * 1e-9, text());
        self.trace.push_back(line);
    }

    // Numbers of hosts and loops are the simulation's own: made in `people`, never read from outside.
    #[allow(clippy::indexing_slicing, reason = "numbers of the simulation's own")]
    pub(crate) fn host(&self, host: u32) -> &Host {
        &self.hosts[host as usize]
    }

    #[allow(clippy::indexing_slicing, reason = "numbers of the simulation's own")]
    pub(crate) fn host_mut(&mut self, host: u32) -> &mut Host {
        &mut self.hosts[host as usize]
    }

    /// A revision of a loop, which every host has.
    pub(crate) fn spec(&self, number: u32, revision: u64) -> Option<Arc<LoopSpec>> {
        let l = self.loops.get(number as usize)?;
        let found = l.specs.iter().find(|spec| spec.revision == revision);
        // What a replica is asked about needs no more than the loop's own.
        found.or_else(|| l.specs.first().filter(|_| revision == 1)).cloned()
    }

    pub(crate) fn send(&mut self, from: u32, to: u32, message: Message) {
        self.counts.sent(&message);
        if to as usize >= self.hosts.len() {
            return;
        }
        let delay_ns = if self.host(from).slow > 0 { 1_000_000 } else { 0 };
        let [first, again] = self.network.ways(from, to, self.now_ns);
        if let Some(ns) = again {
            let message = message.clone();
            self.queue
                .put(self.now_ns + delay_ns + ns, Event::Arrive { to, message });
        }
        match first {
            Some(ns) => self
                .queue
                .put(self.now_ns + delay_ns + ns, Event::Arrive { to, message }),
            None => self.counts.undelivered += 1,
        }
    }

    /// The fault that may have cost this loop something: the latest that touched its home or its holders.
    pub(crate) fn blame(&self, number: u32) -> Option<FaultKind> {
        let l = &self.loops[number as usize];
        let touched = l.ranked.iter().chain([&l.home]).filter_map(|h| self.host(*h).fault);
        let latest = touched
            .filter(|(_, until_ns)| *until_ns >= self.now_ns)
            .max_by_key(|(_, until_ns)| *until_ns);
        latest.map(|(kind, _)| kind)
    }

    /// The host that an event happens on.
    fn place(&self, event: &Event) -> Option<u32> {
        match event {
            Event::Arrive { to, .. } => Some(*to),
            Event::Home { number, .. } | Event::Believe { number, .. } => Some(self.loops[*number as usize].home),
            Event::Seat { host, .. }
            | Event::Stepped { host, .. }
            | Event::Sync { host, .. }
            | Event::Reopen { host, .. } => Some(*host),
            Event::Ready { number, rank, .. } => self.loops[*number as usize].ranked.get(usize::from(*rank)).copied(),
            Event::Ask { .. } | Event::Strike { .. } | Event::End { .. } => None,
        }
    }

    fn happen(&mut self, event: Event) {
        if let Some(host) = self.place(&event) {
            let host = self.host_mut(host);
            if !host.alive {
                return;
            }
            if host.pauses > 0 {
                if host.inbox.len() < INBOX_MAX {
                    host.inbox.push_back(event);
                }
                return;
            }
        }
        match event {
            Event::Arrive { to, message } => self.arrive(to, message),
            Event::Home { number, life, at_ns } => {
                if self.loops[number as usize].life == life {
                    self.home_due(number, at_ns);
                }
            }
            Event::Seat { host, number, at_ns } => self.seat_due(host, number, at_ns),
            Event::Stepped { host, life, to, answer } => {
                if self.host(host).life == life {
                    self.send(host, to, Message::StepAnswer(answer));
                }
            }
            Event::Sync { host, life, once } => {
                if self.host(host).life == life {
                    self.sync(host, life, once);
                }
            }
            Event::Ask { number } => self.ask(number),
            Event::Believe { number, rank, there } => self.believe(number, rank, there),
            Event::Ready { number, rank, life } => self.ready(number, rank, life),
            Event::Strike { fault } => self.strike(fault),
            Event::End { fault } => self.end(fault),
            Event::Reopen { host, life } => {
                if self.host(host).life == life {
                    for number in self.host(host).homes.clone() {
                        self.open(number);
                    }
                }
            }
        }
    }

    fn arrive(&mut self, to: u32, message: Message) {
        match message {
            Message::Sample(sample) => self.sample(to, sample),
            Message::Answer(answer) => self.answer(to, *answer),
            Message::Record(record) => self.record(to, &record, true),
            Message::Step(request) => self.step_request(to, &request),
            Message::StepAnswer(answer) => self.step_answer(to, *answer),
        }
    }

    fn strike(&mut self, number: usize) {
        let Some(fault) = self.faults.get(number).cloned() else {
            return;
        };
        self.counts.struck(fault.kind);
        let until_ns = self.now_ns + fault.for_ms * 1_000_000;
        self.queue.put(until_ns, Event::End { fault: number });
        for host in &fault.hosts {
            self.host_mut(*host).fault = Some((fault.kind, until_ns + BLAME_NS));
            match fault.kind {
                FaultKind::Kill => self.kill(*host),
                FaultKind::Clock => {
                    let hours = self.random.between(0, 49) as i64 - 24;
                    self.host_mut(*host).clock_next = Some(hours * 3_600_000_000_000);
                    self.kill(*host);
                }
                FaultKind::Pause => {
                    self.host_mut(*host).pauses += 1;
                    if until_ns - self.now_ns > LEASE_NS {
                        self.believed(*host, false, LEASE_NS, LEASE_NS + 1_000_000_000);
                    }
                }
                FaultKind::Loss => self.network.spoil(*host, true),
                FaultKind::Saturation => self.network.saturate(*host, true),
                FaultKind::Disk => self.host_mut(*host).disk_full += 1,
                FaultKind::Slow => self.host_mut(*host).slow += 1,
                FaultKind::Bits => self.host_mut(*host).bits += 1,
                FaultKind::Partition => {}
            }
        }
        if fault.kind == FaultKind::Partition {
            self.network.cut(number, &fault);
            if until_ns - self.now_ns > LEASE_NS {
                self.parted(&fault, false, LEASE_NS);
            }
        }
        if let Some(traced) = self.plan.trace
            && self.concerns(&fault, traced)
        {
            self.note(traced, || {
                format!("{} of {:?} for {} ms", fault.kind, fault.hosts, fault.for_ms)
            });
        }
    }

    fn end(&mut self, number: usize) {
        let Some(fault) = self.faults.get(number).cloned() else {
            return;
        };
        for host in &fault.hosts {
            match fault.kind {
                FaultKind::Kill | FaultKind::Clock => self.start(*host),
                FaultKind::Pause => self.go_on(*host),
                FaultKind::Loss => self.network.spoil(*host, false),
                FaultKind::Saturation => self.network.saturate(*host, false),
                FaultKind::Disk => self.host_mut(*host).disk_full -= 1,
                FaultKind::Slow => self.host_mut(*host).slow -= 1,
                FaultKind::Bits => self.host_mut(*host).bits -= 1,
                FaultKind::Partition => {}
            }
        }
        if fault.kind == FaultKind::Partition {
            self.network.mend(number);
            // However short it was: a home may have started meanwhile, and looked around.
            self.parted(&fault, true, 100_000_000);
        }
        if let Some(traced) = self.plan.trace
            && self.concerns(&fault, traced)
        {
            self.note(traced, || format!("end of {} of {:?}", fault.kind, fault.hosts));
        }
    }

    fn concerns(&self, fault: &Fault, number: u32) -> bool {
        let l = &self.loops[number as usize];
        fault.hosts.iter().any(|h| *h == l.home || l.ranked.contains(h))
    }

    /// A host dies: what it knew is gone, what it sent still arrives.
    fn kill(&mut self, number: u32) {
        let host = self.host_mut(number);
        if !host.alive {
            return;
        }
        host.alive = false;
        host.life += 1;
        host.seats.clear();
        host.health.clear();
        host.inbox.clear();
        host.syncing = false;
        for home in host.homes.clone() {
            let blamed = self.blame(home);
            let l = &mut self.loops[home as usize];
            if let Some(desk) = l.desk.take() {
                let (now, before) = (desk.tally(), l.before);
                l.before.taken = before.taken + now.taken;
                // Cycles that never began are counted when the home is there again.
                l.life += 1;
                l.timer_at_ns = 0;
            }
            l.actuator.home_died = true;
            self.counts.homes_lost(blamed);
            self.note(home, || format!("home h{number} dies"));
        }
        self.believed(number, false, 2_000_000, 50_000_000);
    }

    /// A host starts again, with what its disk has, and asks the others for better.
    fn start(&mut self, number: u32) {
        let now_ns = self.now_ns;
        let host = self.host_mut(number);
        if host.alive {
            return;
        }
        host.alive = true;
        let shift_ns = host.clock_next.take().unwrap_or_default();
        host.clock.local_ns = shifted(EPOCH_NS + now_ns, shift_ns);
        host.clock.since_ns = now_ns;
        let (life, homes) = (host.life, host.homes.clone());
        let on_disk = homes
            .iter()
            .filter_map(|number| self.loops[*number as usize].disk.as_ref());
        let found = on_disk.map(|record| record.term).max().unwrap_or(0);
        let host = self.host_mut(number);
        host.terms_set_aside = terms_passed_over(host.terms_set_aside, found);
        self.queue.put(now_ns + GATHER_NS, Event::Reopen { host: number, life });
        let sync = Event::Sync {
            host: number,
            life,
            once: false,
        };
        self.queue.put(now_ns + SYNC_NS, sync);
        self.believed(number, true, 50_000_000, 500_000_000);
    }

    /// A paused host goes on: what has arrived goes before what is late, and of each loop's samples only the newest counts.
    fn go_on(&mut self, number: u32) {
        let host = self.host_mut(number);
        host.pauses = host.pauses.saturating_sub(1);
        if host.pauses > 0 || !host.alive {
            return;
        }
        let waiting = std::mem::take(&mut host.inbox);
        let (arrived, late): (Vec<Event>, Vec<Event>) =
            waiting.into_iter().partition(|e| matches!(e, Event::Arrive { .. }));
        let mut newest = std::collections::HashMap::new();
        for event in &arrived {
            if let Event::Arrive {
                message: Message::Sample(sample),
                ..
            } = event
            {
                let best = newest.entry(sample.loop_id.clone()).or_insert((0, 0));
                *best = (sample.term, sample.seq).max(*best);
            }
        }
        for event in arrived.into_iter().chain(late) {
            let stale = match &event {
                Event::Arrive {
                    message: Message::Sample(sample),
                    ..
                } => newest
                    .get(&sample.loop_id)
                    .is_some_and(|best| (sample.term, sample.seq) < *best),
                _ => false,
            };
            if !stale {
                self.queue.put(self.now_ns, event);
            }
        }
        self.believed(number, true, 100_000_000, 1_000_000_000);
    }

    /// The homes of the loops that a host may hold hear that it is there, or gone.
    fn believed(&mut self, host: u32, there: bool, low_ns: u64, high_ns: u64) {
        for (number, rank) in self.host(host).ranks.clone() {
            let at_ns = self.now_ns + self.random.between(low_ns, high_ns);
            self.queue.put(at_ns, Event::Believe { number, rank, there });
        }
    }

    /// The same for homes and holders on different sides.
    fn parted(&mut self, fault: &Fault, there: bool, after_ns: u64) {
        let inside = |host: &u32| fault.hosts.contains(host);
        let mut events = Vec::new();
        for (number, l) in self.loops.iter().enumerate() {
            for (rank, host) in l
                .ranked
                .iter()
                .enumerate()
                .filter(|(_, host)| inside(host) != inside(&l.home))
            {
                if self.host(*host).alive {
                    events.push((number as u32, rank as u8));
                }
            }
        }
        for (number, rank) in events {
            let at_ns = self.now_ns + after_ns + self.random.between(0, 1_000_000_000);
            self.queue.put(at_ns, Event::Believe { number, rank, there });
        }
    }
}

const fn shifted(ns: u64, by_ns: i64) -> u64 {
    ns.saturating_add_signed(by_ns)
}
