//! Hosts in one process, joined by a switchboard: the harness of these tests. Never: judges.

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    num::NonZeroU64,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use bumpless_cell::{Arrival, Roles, Vitals};
use bumpless_core::{
    Command, CommandBody, CommandId, Digest, HostId, LoopId, LoopSpec, Mode, Outcome, OutputLimit, PointId, Policy,
    Record, Strategy, Wiring,
    protocol::{Answer, Sample, StepAnswer, StepRequest},
};
use bumpless_engine::Engine;
use bumpless_io::{BusConfig, Clock, IoServer, sim::SimConfig};
use bumpless_loops::{CommandReply, Config, HeldRevision, HomeRevision, Loops, LoopsEvent, Wire};
use crossbeam_channel::{Receiver, Sender};

/// Nothing here takes longer unless something is broken.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);

pub(crate) fn host(name: &str) -> HostId {
    HostId::new(name).unwrap()
}

pub(crate) fn loop_id() -> LoopId {
    LoopId::new("l").unwrap()
}

/// Delivers messages between hosts, except to and from those that are cut off.
#[derive(Default)]
pub(crate) struct Switchboard {
    hosts: Mutex<HashMap<HostId, Loops>>,
    pub(crate) cut: Mutex<HashSet<HostId>>,
    /// Every so-manieth message is lost; none where 0.
    pub(crate) lost_every: AtomicU64,
    messages: AtomicU64,
    /// Records reach nobody.
    pub(crate) records_lost: AtomicBool,
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
        let (number, every) = (
            self.board.messages.fetch_add(1, Ordering::Relaxed),
            self.board.lost_every.load(Ordering::Relaxed),
        );
        if every > 0 && number % every == 0 {
            return;
        }
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
        if self.board.records_lost.load(Ordering::Relaxed) {
            return;
        }
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

pub(crate) struct Bench {
    pub(crate) board: Arc<Switchboard>,
    pub(crate) engine: Engine,
    pub(crate) home: HostId,
    pub(crate) holders: Vec<HostId>,
    records: Receiver<Arc<Record>>,
    /// Records with an outcome that somebody waits for, and whether the home is alone with them.
    pub(crate) outcomes: Receiver<(Arc<Record>, bool)>,
    pub(crate) seen: Vec<Arc<Record>>,
    commands: u128,
    _runtime: tokio::runtime::Runtime,
}

pub(crate) fn component(name: &str) -> Vec<u8> {
    std::fs::read(xtask::components::build().unwrap().join(format!("{name}.wasm"))).unwrap()
}

impl Bench {
    /// A plant host with two first-order processes (the loop has the first), and holders (the plant host itself where its name is among them).
    pub(crate) fn new(holders: &[&str], spec: impl FnOnce(&mut LoopSpec)) -> Self {
        Self::with_errors(holders, &[], spec)
    }

    /// The same, with hosts whose steps come out wrong every so often.
    pub(crate) fn with_errors(holders: &[&str], errs: &[(&str, u64)], spec: impl FnOnce(&mut LoopSpec)) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let sim: SimConfig = serde_json::from_value(serde_json::json!({
            "id": "plant", "seed": 1,
            "fopdt": { "count": 2, "gain": 1.0, "tau_s": 0.5, "dead_time_s": 0.02, "noise": 0.0 },
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
        let (outcomes_to, outcomes) = crossbeam_channel::bounded(1000);
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
            let outcomes_to = outcomes_to.clone();
            let sink = Arc::new(move |event| match event {
                LoopsEvent::Record(record) => sender.try_send(record).unwrap(),
                LoopsEvent::Outcome { record, alone } => outcomes_to.try_send((record, alone)).unwrap(),
                LoopsEvent::Revised { .. } => {}
            });
            let every = errs
                .iter()
                .find(|(host, _)| *host == name.as_str())
                .map(|(_, every)| *every);
            let config = Config {
                workers: 2,
                flip_bits_every: every.and_then(NonZeroU64::new),
            };
            let loops = Loops::start(&config, name.clone(), clock, io, engine.clone(), port, sink).unwrap();
            board.hosts.lock().unwrap().insert(name, loops);
        }
        let bench = Self {
            board,
            engine,
            home,
            holders,
            records,
            outcomes,
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
                    term_floor: 0,
                },
                None,
            )
            .unwrap();
        bench.set_members(&bench.holders.clone());
        bench
    }

    pub(crate) fn at(&self, name: &HostId) -> Loops {
        self.board.hosts.lock().unwrap()[name].clone()
    }

    pub(crate) fn digest(&self, component_name: &str) -> Digest {
        let bytes = component(component_name);
        self.engine.prepare(&bytes).unwrap();
        Digest::of(&bytes)
    }

    pub(crate) fn spec(&self, component_name: &str, revision: u64, parameters: &[(&str, f64)]) -> LoopSpec {
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
            fallback_parameters: BTreeMap::new(),
            prefer: vec![],
            policy: Policy {
                probation_cycles: 30,
                ..Policy::default()
            },
        }
    }

    pub(crate) fn wiring(&self, spec: &LoopSpec) -> Arc<Wiring> {
        Arc::new(Wiring::new(spec, self.engine.prepared(&spec.digest).unwrap().descriptor()).unwrap())
    }

    pub(crate) fn hold(&self, spec: &LoopSpec) {
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

    pub(crate) fn tell_of_hosts(&self, ready: &[Digest]) {
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
                    drain_kept: false,
                    unix_ms: 0,
                    labels: vec![],
                    version: String::new(),
                });
            }
        }
    }

    pub(crate) fn set_members(&self, members: &[HostId]) {
        self.at(&self.home).set_members(&loop_id(), members.to_vec()).unwrap();
    }

    /// The next record; each must go on from the one before.
    pub(crate) fn next(&mut self) -> Arc<Record> {
        let record = self.records.recv_timeout(PATIENCE).expect("no record came");
        let before = self.seen.last().map_or((0, 0), |r| r.position());
        assert_eq!(record.after, before, "records are one chain");
        assert!(record.position() > before && record.seq > before.1);
        assert!(record.outputs.iter().all(|o| (0.0..=100.0).contains(o)));
        self.seen.push(Arc::clone(&record));
        record
    }

    pub(crate) fn until(&mut self, what: &str, wanted: impl Fn(&Record) -> bool) -> Arc<Record> {
        for _ in 0..2000 {
            let record = self.next();
            if wanted(&record) {
                return record;
            }
        }
        panic!("{what}: not within 2000 cycles");
    }

    pub(crate) fn command(&mut self, body: CommandBody) -> (Outcome, Arc<Record>) {
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
    pub(crate) fn revise(&mut self, spec: &LoopSpec) -> (Outcome, Arc<Record>) {
        self.hold(spec);
        self.tell_of_hosts(&[self.digest("pid"), spec.digest]);
        let revision = HomeRevision {
            spec: Arc::new(spec.clone()),
            wiring: self.wiring(spec),
            term_floor: 0,
        };
        self.at(&self.home).add_home_revision(revision).unwrap();
        self.command(CommandBody::Revise(spec.revision))
    }

    pub(crate) fn settled(&mut self) {
        self.until("the loop settles", |r| {
            (r.readings[0].value_or_last() - r.setpoint).abs() < 0.5
        });
    }
}
