//! Loops of several hosts in one process, joined by a switchboard instead of a network: owners and replicas that die or
//! fall silent, commands, swaps and rollbacks. Everything is checked on the records that the arbiter took.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    sync::{Arc, Mutex},
    time::Duration,
};

use bumpless_cell::{Arrival, Roles, Vitals};
use bumpless_core::{
    Command, CommandBody, CommandId, Digest, Event, HostId, LoopId, LoopSpec, Mode, Outcome, OutputLimit, PointId,
    Policy, Record, Strategy, Wiring,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};
use bumpless_engine::Engine;
use bumpless_io::{BusConfig, Clock, IoServer, sim::SimConfig};
use bumpless_loops::{CommandReply, Config, HeldRevision, HomeRevision, Loops, LoopsEvent, Wire};
use crossbeam_channel::{Receiver, Sender};

/// Nothing here takes longer unless something is broken.
const PATIENCE: Duration = Duration::from_secs(30);

fn host(name: &str) -> HostId {
    HostId::new(name).unwrap()
}

fn loop_id() -> LoopId {
    LoopId::new("l").unwrap()
}

/// Delivers messages between hosts, except to and from those that are cut off.
#[derive(Default)]
struct Switchboard {
    hosts: Mutex<HashMap<HostId, Loops>>,
    cut: Mutex<HashSet<HostId>>,
}

struct Port {
    here: HostId,
    board: Arc<Switchboard>,
}

impl Port {
    fn send(&self, to: &HostId, arrival: Arrival) {
        let cut = self.board.cut.lock().unwrap();
        if cut.contains(&self.here) || cut.contains(to) {
            return;
        }
        drop(cut);
        let loops = self.board.hosts.lock().unwrap().get(to).cloned();
        if let Some(loops) = loops {
            loops.arrive(arrival);
        }
    }
}

impl Wire for Port {
    fn send_sample(&self, to: &HostId, sample: &Sample) {
        self.send(to, Arrival::Sample(Box::new(sample.clone())));
    }
    fn send_answer(&self, to: &HostId, answer: &Answer) {
        self.send(
            to,
            Arrival::Answer {
                from: self.here.clone(),
                answer: Box::new(answer.clone()),
            },
        );
    }
    fn send_step(&self, to: &HostId, request: &StepRequest) {
        self.send(to, Arrival::StepRequest(Box::new(request.clone())));
    }
    fn send_step_answer(&self, to: &HostId, answer: &StepAnswer) {
        self.send(to, Arrival::StepAnswer(Box::new(answer.clone())));
    }
    fn publish_record(&self, record: &Record) {
        let others: Vec<HostId> = self
            .board
            .hosts
            .lock()
            .unwrap()
            .keys()
            .filter(|h| **h != self.here)
            .cloned()
            .collect();
        let record = Arc::new(record.clone());
        for other in others {
            self.send(&other, Arrival::Record(Arc::clone(&record)));
        }
    }
    fn ping(&self, to: &HostId, token: u64) {
        self.send(
            to,
            Arrival::Ping {
                from: self.here.clone(),
                token,
            },
        );
    }
    fn pong(&self, to: &HostId, token: u64) {
        self.send(
            to,
            Arrival::Pong {
                from: self.here.clone(),
                token,
            },
        );
    }
}

struct Bench {
    board: Arc<Switchboard>,
    engine: Engine,
    home: HostId,
    holders: Vec<HostId>,
    records: Receiver<Arc<Record>>,
    seen: Vec<Arc<Record>>,
    commands: u128,
    _runtime: tokio::runtime::Runtime,
}

fn component(name: &str) -> Vec<u8> {
    std::fs::read(xtask::components::build().unwrap().join(format!("{name}.wasm"))).unwrap()
}

impl Bench {
    /// A plant host with one first-order process, and holders (the plant host itself where its name is among them).
    fn new(holders: &[&str], spec: impl FnOnce(&mut LoopSpec)) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let sim: SimConfig = serde_json::from_value(serde_json::json!({
            "id": "plant", "seed": 1,
            "fopdt": { "count": 1, "gain": 1.0, "tau_s": 0.5, "dead_time_s": 0.02, "noise": 0.0 },
        }))
        .unwrap();
        let clock = Clock::start();
        let io = bumpless_io::Config {
            buses: vec![BusConfig::Sim(sim)],
        };
        let io = Arc::new(IoServer::open(&io, clock, runtime.handle()).unwrap());
        let engine = Engine::new(bumpless_engine::Config::default()).unwrap();
        let (board, home) = (Arc::new(Switchboard::default()), host("plant"));
        let (sender, records): (Sender<Arc<Record>>, _) = crossbeam_channel::bounded(100_000);
        let holders: Vec<HostId> = holders.iter().map(|h| host(h)).collect();
        let mut names = vec![home.clone()];
        names.extend(holders.iter().filter(|h| **h != home).cloned());
        for name in names {
            let io = (name == home).then(|| Arc::clone(&io));
            let port = Arc::new(Port {
                here: name.clone(),
                board: Arc::clone(&board),
            });
            let sender = sender.clone();
            let sink = Arc::new(move |event| {
                if let LoopsEvent::Record(record) = event {
                    sender.try_send(record).unwrap();
                }
            });
            let config = Config { workers: 2 };
            let loops = Loops::start(&config, name.clone(), clock, io, engine.clone(), port, sink).unwrap();
            board.hosts.lock().unwrap().insert(name, loops);
        }
        let bench = Self {
            board,
            engine,
            home,
            holders,
            records,
            seen: Vec::new(),
            commands: 0,
            _runtime: runtime,
        };
        let mut first = bench.spec("pid", 1, &[("k", 2.0), ("ti", 0.5)]);
        spec(&mut first);
        bench.hold(&first);
        bench.tell_of_hosts(&[first.digest]);
        let wiring = bench.wiring(&first);
        bench
            .at(&bench.home)
            .open_home(
                HomeRevision {
                    spec: Arc::new(first),
                    wiring,
                },
                None,
            )
            .unwrap();
        bench.set_members(&bench.holders.clone());
        bench
    }

    fn at(&self, name: &HostId) -> Loops {
        self.board.hosts.lock().unwrap()[name].clone()
    }

    fn digest(&self, component_name: &str) -> Digest {
        let bytes = component(component_name);
        self.engine.prepare(&bytes).unwrap();
        Digest::of(&bytes)
    }

    fn spec(&self, component_name: &str, revision: u64, parameters: &[(&str, f64)]) -> LoopSpec {
        let points = ["pv", "out"].map(|p| (p.to_owned(), PointId::new(format!("plant.0.{p}")).unwrap()));
        LoopSpec {
            id: loop_id(),
            revision,
            digest: self.digest(component_name),
            period_ns: 20_000_000,
            ports: BTreeMap::from(points),
            parameters: parameters.iter().map(|(n, v)| ((*n).to_owned(), *v)).collect(),
            setpoint: 40.0,
            setpoint_range: (0.0, 100.0),
            mode: Mode::Automatic,
            strategy: Strategy::RoundRobin,
            replicas: 3,
            limits: [(
                "out".to_owned(),
                OutputLimit {
                    low: 0.0,
                    high: 100.0,
                    rate_per_s: None,
                    safe: 0.0,
                },
            )]
            .into(),
            listens: vec![],
            fallback: None,
            policy: Policy {
                probation_cycles: 30,
                ..Policy::default()
            },
        }
    }

    fn wiring(&self, spec: &LoopSpec) -> Arc<Wiring> {
        Arc::new(Wiring::new(spec, self.engine.prepared(&spec.digest).unwrap().descriptor()).unwrap())
    }

    fn hold(&self, spec: &LoopSpec) {
        for name in &self.holders {
            let prepared = self.engine.prepared(&spec.digest).unwrap();
            self.at(name)
                .hold(HeldRevision {
                    spec: Arc::new(spec.clone()),
                    wiring: self.wiring(spec),
                    descriptor: Arc::new(prepared.descriptor().clone()),
                    instance: prepared.instantiate().unwrap(),
                })
                .unwrap();
        }
    }

    fn tell_of_hosts(&self, ready: &[Digest]) {
        for name in &self.holders {
            for of in &self.holders {
                self.at(name).set_host(&Vitals {
                    host: of.clone(),
                    seq: 1,
                    started_at_ms: 0,
                    roles: Roles {
                        io: false,
                        control: true,
                    },
                    api: None,
                    cpu: 0.1,
                    cpu_process: 0.1,
                    memory_bytes: 0,
                    ready: ready.to_vec(),
                    loops_owned: 0,
                    loops_held: 1,
                    draining: false,
                    version: String::new(),
                });
            }
        }
    }

    fn set_members(&self, members: &[HostId]) {
        self.at(&self.home).set_members(&loop_id(), members.to_vec()).unwrap();
    }

    /// The next record; each must go on from the one before.
    fn next(&mut self) -> Arc<Record> {
        let record = self.records.recv_timeout(PATIENCE).expect("no record came");
        let before = self.seen.last().map_or((0, 0), |r| r.position());
        assert_eq!(record.after, before, "records are one chain");
        assert!(record.position() > before && record.seq > before.1);
        assert!(record.outputs.iter().all(|o| (0.0..=100.0).contains(o)));
        self.seen.push(Arc::clone(&record));
        record
    }

    fn until(&mut self, what: &str, wanted: impl Fn(&Record) -> bool) -> Arc<Record> {
        for _ in 0..2000 {
            let record = self.next();
            if wanted(&record) {
                return record;
            }
        }
        panic!("{what}: not within 2000 cycles");
    }

    fn command(&mut self, body: CommandBody) -> (Outcome, Arc<Record>) {
        self.commands += 1;
        let (sender, reply) = crossbeam_channel::bounded(1);
        let command = Command {
            id: CommandId(self.commands),
            body,
        };
        let done = Box::new(move |reply| drop(sender.send(reply)));
        self.at(&self.home).command(&loop_id(), command, done).unwrap();
        match reply.recv_timeout(PATIENCE).unwrap() {
            CommandReply::Applied { applied, record } => (applied.outcome, record),
            other => panic!("{other:?}"),
        }
    }

    /// Makes a revision known everywhere and asks for it.
    fn revise(&mut self, spec: &LoopSpec) -> (Outcome, Arc<Record>) {
        self.hold(spec);
        self.tell_of_hosts(&[self.digest("pid"), spec.digest]);
        let revision = HomeRevision {
            spec: Arc::new(spec.clone()),
            wiring: self.wiring(spec),
        };
        self.at(&self.home).add_home_revision(revision).unwrap();
        self.command(CommandBody::Revise(spec.revision))
    }

    fn settled(&mut self) {
        self.until("the loop settles", |r| {
            (r.readings[0].value_or_last() - r.setpoint).abs() < 0.5
        });
    }
}

#[test]
fn one_host_alone_controls_its_plant() {
    let mut bench = Bench::new(&["plant"], |_| {});
    bench.settled();
    let record = bench.next();
    assert_eq!((record.owner.as_str(), record.stepped_by.as_str()), ("plant", "plant"));
}

#[test]
fn replicas_take_turns_and_a_silent_one_costs_no_cycle() {
    let mut bench = Bench::new(&["a", "b", "c"], |_| {});
    bench.settled();
    let by: HashSet<HostId> = (0..6).map(|_| bench.next().stepped_by.clone()).collect();
    assert_eq!(by.len(), 3, "round-robin");
    let owner = bench.next().owner.clone();
    let silent = bench.holders.iter().find(|h| **h != owner).unwrap().clone();
    bench.board.cut.lock().unwrap().insert(silent.clone());
    let hedged = bench.until("a silent replica is passed over", |r| {
        r.events.contains(&Event::Hedged {
            replica: silent.clone(),
        })
    });
    assert_ne!(hedged.stepped_by, silent);
    for _ in 0..20 {
        assert_ne!(bench.next().stepped_by, silent);
    }
    bench.board.cut.lock().unwrap().clear();
    bench.until("it comes back by probes", |r| r.stepped_by == silent);
}

#[test]
fn a_silent_owner_is_replaced_and_fenced_and_a_dead_one_too() {
    let mut bench = Bench::new(&["a", "b", "c"], |_| {});
    bench.settled();
    let first = bench.next();
    // Silent: alive for all that is known, but nothing comes from it.
    bench.board.cut.lock().unwrap().insert(first.owner.clone());
    let second = bench.until("a takeover", |r| r.owner != first.owner);
    assert!(second.term > first.term);
    assert!(second.events.contains(&Event::TookOver {
        from: Some(first.owner.clone())
    }));
    // It comes back; nothing that it sends counts, and it learns of its successor.
    bench.board.cut.lock().unwrap().clear();
    for _ in 0..20 {
        assert_ne!(bench.next().owner, first.owner);
    }
    // Dead: the bus says so.
    let owner = bench.next().owner.clone();
    bench.board.cut.lock().unwrap().insert(owner.clone());
    for name in bench.holders.iter().chain([&bench.home]).filter(|h| **h != owner) {
        bench.at(name).host_gone(&owner);
    }
    let third = bench.until("another takeover", |r| r.owner != owner);
    assert!(third.term > second.term);
    let settled = bench.seen.iter().rev().take(20).map(|r| r.outputs[0]);
    let (low, high) = settled.fold((f64::MAX, f64::MIN), |(l, h), o| (l.min(o), h.max(o)));
    assert!(high - low < 5.0, "the output does not feel it: {low} to {high}");
}

#[test]
fn commands_take_effect_with_a_record() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    let (outcome, record) = bench.command(CommandBody::Setpoint(55.0));
    assert_eq!((outcome, record.setpoint), (Outcome::Done, 55.0));
    let (outcome, _) = bench.command(CommandBody::Setpoint(500.0));
    assert!(matches!(outcome, Outcome::Refused(why) if why.contains("0 to 100")));
    let (_, record) = bench.command(CommandBody::Mode(Mode::Manual));
    assert_eq!(record.mode, Mode::Manual);
    let (outcome, record) = bench.command(CommandBody::Output(vec![33.0]));
    assert_eq!((outcome, &record.outputs), (Outcome::Done, &vec![33.0]));
    let held = bench.until("the actuator holds it", |r| {
        r.outputs[0] == 33.0 && (r.readings[4].value_or_last() - 33.0).abs() < 0.01
    });
    let (_, record) = bench.command(CommandBody::Mode(Mode::Automatic));
    assert!(
        (record.outputs[0] - held.outputs[0]).abs() < 0.01,
        "back to automatic without a bump: {}",
        record.outputs[0]
    );
}

#[test]
fn a_swap_goes_without_a_bump_and_the_takeover_after_it_knows() {
    let mut bench = Bench::new(&["a", "b", "c"], |_| {});
    bench.settled();
    let tuning = [("k", 2.0), ("ti", 0.5)];
    let (outcome, record) = bench.revise(&bench.spec("pidplus", 2, &tuning));
    assert_eq!((outcome, record.revision), (Outcome::Done, 2));
    let Some(Event::Revised { bump_percent, .. }) = record.events.iter().find(|e| matches!(e, Event::Revised { .. }))
    else {
        panic!("{:?}", record.events)
    };
    assert!(*bump_percent < 0.1, "{bump_percent}");
    assert_eq!(record.probation, Some((1, 30)));
    bench.board.cut.lock().unwrap().insert(record.owner.clone());
    // By term, for records from before the swap are still to be read.
    let after = bench.until("a takeover", |r| r.term > record.term);
    assert_ne!(after.owner, record.owner);
    assert_eq!((after.revision, after.digest), (2, bench.digest("pidplus")));
    bench.until("the probation ends", |r| r.probation.is_none());
}

#[test]
fn a_swap_that_bumps_or_fails_at_once_is_refused() {
    let mut bench = Bench::new(&["a", "b"], |spec| spec.policy.bump_limit_percent = 2.0);
    bench.settled();
    for (component, parameters, part) in [
        ("guests/traps", vec![], "first step failed"),
        ("guests/returns-nan", vec![], "first step failed"),
        ("guests/spins", vec![], "limit"),
        (
            "guests/jumps",
            vec![("by", 30.0)],
            "beyond what the old controller does",
        ),
    ] {
        let mut spec = bench.spec(component, 2, &parameters);
        spec.policy.bump_limit_percent = 2.0;
        let (outcome, record) = bench.revise(&spec);
        assert!(
            matches!(&outcome, Outcome::Refused(why) if why.contains(part)),
            "{component}: {outcome:?}"
        );
        assert_eq!(
            (record.revision, record.faults_in_row),
            (1, 0),
            "{component}: the old one has the cycle"
        );
    }
}

#[test]
fn a_fault_on_probation_rolls_back_in_the_same_cycle() {
    let mut bench = Bench::new(&["a", "b"], |_| {});
    bench.settled();
    for (revision, component) in [(2, "guests/traps"), (3, "guests/spins"), (4, "guests/returns-nan")] {
        let (outcome, _) = bench.revise(&bench.spec(component, revision, &[("after", 5.0)]));
        assert_eq!(outcome, Outcome::Done, "{component}");
        let back = bench.until("a rollback", |r| {
            r.events.iter().any(|e| matches!(e, Event::RolledBack { .. }))
        });
        assert_eq!(
            (back.revision, back.probation, back.faults_in_row),
            (1, None, 0),
            "{component}"
        );
        assert!(
            !back.events.contains(&Event::PolicyHeld),
            "{component}: the old one has this very cycle"
        );
        assert_eq!(bench.next().revision, 1);
    }
}

#[test]
fn calls_are_stepped_where_the_strategy_says_and_only_where_the_component_is_ready() {
    let bench = Bench::new(&["a", "b", "c"], |_| {});
    let digest = bench.digest("pid");
    let prepared = bench.engine.prepared(&digest).unwrap();
    let defaults: Vec<f64> = prepared.descriptor().parameters.iter().map(|p| p.default).collect();
    let state: Arc<[u8]> = prepared
        .instantiate()
        .unwrap()
        .start(&defaults, &[20.0], 10_000_000)
        .unwrap()
        .into();
    let ports = prepared.descriptor().ports.len();
    let call = |digest, seq| {
        let readings = (0..ports).map(|_| bumpless_core::Reading::good(20.0, 1)).collect();
        let cycle = bumpless_core::Cycle {
            seq,
            at_ns: 2,
            dt_ns: 100_000_000,
            mode: Mode::Automatic,
            setpoint: 20.0,
        };
        let (sender, reply) = crossbeam_channel::bounded(1);
        let frame = bumpless_core::Frame {
            cycle,
            readings,
            messages: vec![],
        };
        let done = Box::new(move |reply| drop(sender.send(reply)));
        bench
            .at(&host("a"))
            .call(
                digest,
                Strategy::RoundRobin,
                frame,
                Arc::clone(&state),
                10_000_000,
                done,
            )
            .unwrap();
        reply.recv_timeout(PATIENCE).unwrap()
    };
    let by: HashSet<HostId> = (0..3).map(|seq| call(digest, seq).unwrap().answer.from).collect();
    assert_eq!(by.len(), 3);
    assert!(
        call(Digest::of(b"nothing"), 0)
            .unwrap_err()
            .to_string()
            .contains("not compiled here")
    );
}
