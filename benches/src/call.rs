//! `call`: a remote step over loopback TCP between two processes: one after the other, and 64 on their way.
//!
//! ```text
//! caller ─► worker ─► bus ═══ TCP ═══ bus ─► worker: step ─► bus ═══ TCP ═══ bus ─► worker ─► caller
//! ```
//! Beside it, in the same run, what bare TCP takes for messages of that size: the floor; then the same through the REST API.

use std::{
    io::{BufRead, BufReader, Read, Write},
    net::TcpStream,
    process::{Child, Command, Stdio},
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_cell::{Arrival, Roles, Vitals};
use bumpless_core::{Digest, Frame, HostId, Strategy};
use bumpless_engine::Engine;
use bumpless_loops::{CallEnd, Loops};
use crossbeam_channel::{Receiver, Sender, bounded};

use crate::{
    Options,
    error::Error,
    law,
    peer::{self, ECHO_BYTES, PEER, Ready},
    report::Report,
    rest,
    spread::Spread,
    stall::Watch,
};

/// Longest step, in ns.
const LIMIT_NS: u64 = 10_000_000;
/// Longest wait for one answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// Calls before those that count.
const WARM_UP: u64 = 2_000;
/// Calls on their way at once, in the second part.
const IN_FLIGHT: u64 = 64;

/// The other process. It never outlives the bench.
struct Other {
    child: Child,
    ready: Ready,
}

impl Other {
    fn start(component: &std::path::Path) -> Result<Self, Error> {
        let program = std::env::current_exe().map_err(Error::io("this program has no path"))?;
        let mut child = Command::new(program)
            .arg("call-peer")
            .arg(component)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(Error::io("the other process cannot be started"))?;
        let mut said = String::new();
        if let Some(output) = child.stdout.take() {
            BufReader::new(output)
                .read_line(&mut said)
                .map_err(Error::io("the other process cannot be read"))?;
        }
        match serde_json::from_str(&said) {
            Ok(ready) => Ok(Self { child, ready }),
            Err(_) => {
                end(&mut child);
                Err(Error::Said {
                    who: "the other process".to_owned(),
                    said: said.chars().take(200).collect(),
                    expected: "where it listens",
                })
            }
        }
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        end(&mut self.child);
    }
}

fn end(child: &mut Child) {
    // It may have ended before.
    let _ = child.kill();
    let _ = child.wait();
}

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let component = law::component_path("pid")?;
    let other = Other::start(&component)?;
    let watch = Watch::start();
    let runtime = tokio::runtime::Runtime::new().map_err(Error::io("a runtime cannot be started"))?;
    report.progress("bare TCP, one message after the other");
    bare_tcp(&other.ready.echo, options.count(50_000, 5_000))?.tell(report, "call.bare_tcp");

    // Nothing is prepared in this engine, so only the other process can step.
    let engine = engine()?;
    let (sender, arrivals) = bounded(64);
    let seen = move |arrival| {
        if let Arrival::HostUp(host) = arrival {
            // Full only if hosts come and go all the time.
            let _ = sender.try_send(host);
        }
    };
    let connect = vec![other.ready.endpoint.clone()];
    let (session, loops) = runtime.block_on(peer::join("caller", connect, &engine, seen))?;
    let waited = || Error::Waited {
        what: "the other process on the bus".to_owned(),
        seconds: PATIENCE.as_secs(),
    };
    while arrivals.recv_timeout(PATIENCE).map_err(|_| waited())?.as_str() != PEER {}

    // The law's frame and first state, made by an engine of its own, so that the caller's stays empty.
    let prepared = law::prepare(&self::engine()?, "pid")?;
    let frames = law::frames(&prepared);
    let mut instance = prepared.instantiate().map_err(|source| Error::Engine {
        what: "pid".to_owned(),
        source,
    })?;
    let state: Arc<[u8]> = law::first_state(&mut instance, LIMIT_NS)?.into();
    let digest = *prepared.digest();
    loops.set_host(&vitals(HostId::new(PEER)?, digest));
    let mut caller = Caller::new(&loops, digest, frames, state);

    report.progress("remote steps, one after the other");
    caller.run(WARM_UP, 1)?;
    let one = caller.run(options.count(50_000, 5_000), 1)?;
    one.seen.tell(report, "call.sequential");
    one.at_worker.tell(report, "call.sequential.between_workers");
    report.told("call.sequential.rate", one.rate, "calls/s");

    report.progress("remote steps, 64 on their way");
    caller.run(WARM_UP, IN_FLIGHT)?;
    let (own, others) = (cpu_s("self"), cpu_s(&other.child.id().to_string()));
    let many = caller.run(options.count(500_000, 50_000), IN_FLIGHT)?;
    let cpu = cpu_s("self") - own + cpu_s(&other.child.id().to_string()) - others;
    many.seen.tell(report, "call.in_flight_64");
    report.told("call.in_flight_64.rate", many.rate, "calls/s");
    report.told("call.in_flight_64.cpu_per_call", cpu * 1e6 / many.calls as f64, "µs");
    // No other replica could step, so a silence of the one is told and not hedged away.
    report.told("call.silent_for_60_ms", (one.failed + many.failed) as f64, "calls");
    runtime.block_on(session.close());
    loops.stop();
    drop(other);
    rest::run(options, report)?;
    watch.finish().tell(report, "call");
    Ok(())
}

fn engine() -> Result<Engine, Error> {
    Engine::new(bumpless_engine::Config::default()).map_err(|source| Error::Engine {
        what: "its own configuration".to_owned(),
        source,
    })
}

/// Processor time of a process so far, in s. Source: proc(5), `/proc/[pid]/stat`, fields 14 and 15, in hundredths.
fn cpu_s(pid: &str) -> f64 {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    // The name in brackets may hold blanks; the fields are counted after it.
    let fields = text.rsplit(')').next().unwrap_or_default().split_whitespace();
    fields
        .skip(11)
        .take(2)
        .filter_map(|field| field.parse::<f64>().ok())
        .sum::<f64>()
        / 100.0
}

fn bare_tcp(echo: &str, rounds: u64) -> Result<Spread, Error> {
    let failed = || Error::io("the echo does not answer");
    let mut stream = TcpStream::connect(echo).map_err(failed())?;
    stream.set_nodelay(true).map_err(failed())?;
    stream.set_read_timeout(Some(PATIENCE)).map_err(failed())?;
    let mut spread = Spread::new();
    let mut bytes = [0; ECHO_BYTES];
    for round in 0..rounds + WARM_UP {
        let started = Instant::now();
        stream.write_all(&bytes).map_err(failed())?;
        stream.read_exact(&mut bytes).map_err(failed())?;
        if round >= WARM_UP {
            spread.add(u64::try_from(started.elapsed().as_nanos()).unwrap_or(u64::MAX));
        }
    }
    Ok(spread)
}

fn vitals(host: HostId, ready: Digest) -> Vitals {
    Vitals {
        host,
        seq: 1,
        started_at_ms: 0,
        roles: Roles {
            io: false,
            control: true,
        },
        api: None,
        cpu: 0.0,
        cpu_process: 0.0,
        memory_bytes: 0,
        ready: vec![ready],
        loops_owned: 0,
        loops_held: 0,
        draining: false,
        drain_kept: false,
        unix_ms: 0,
        labels: vec![],
        version: String::new(),
    }
}

/// What one part measured.
struct Part {
    calls: u64,
    failed: u64,
    /// As the caller saw it: two hand-overs between threads more than a loop's cycle has.
    seen: Spread,
    /// As the worker that asked saw it: what a loop's cycle waits for.
    at_worker: Spread,
    /// Calls per second.
    rate: f64,
}

type Answered = (Instant, Result<CallEnd, bumpless_core::Fault>);

/// Asks for steps.
struct Caller<'a> {
    loops: &'a Loops,
    digest: Digest,
    frames: Vec<Frame>,
    state: Arc<[u8]>,
    sender: Sender<Answered>,
    answers: Receiver<Answered>,
    turn: usize,
}

impl<'a> Caller<'a> {
    fn new(loops: &'a Loops, digest: Digest, frames: Vec<Frame>, state: Arc<[u8]>) -> Self {
        let (sender, answers) = bounded(usize::try_from(IN_FLIGHT).unwrap_or(1));
        Self {
            loops,
            digest,
            frames,
            state,
            sender,
            answers,
            turn: 0,
        }
    }

    fn ask(&mut self) -> Result<(), Error> {
        self.turn = (self.turn + 1) % self.frames.len().max(1);
        let Some(frame) = self.frames.get(self.turn).cloned() else {
            return Ok(());
        };
        let (sender, asked) = (self.sender.clone(), Instant::now());
        // There is a place for every call on its way.
        let reply = Box::new(move |end| drop(sender.try_send((asked, end))));
        let state = Arc::clone(&self.state);
        Ok(self
            .loops
            .call(self.digest, Strategy::Latency, frame, state, LIMIT_NS, reply)?)
    }

    fn run(&mut self, calls: u64, in_flight: u64) -> Result<Part, Error> {
        let mut part = Part {
            calls,
            failed: 0,
            seen: Spread::new(),
            at_worker: Spread::new(),
            rate: 0.0,
        };
        let started = Instant::now();
        for _ in 0..in_flight {
            self.ask()?;
        }
        for number in 0..calls {
            let (asked, end) = self.answers.recv_timeout(PATIENCE).map_err(|_| Error::Waited {
                what: "the answer to a call".to_owned(),
                seconds: PATIENCE.as_secs(),
            })?;
            if number + in_flight < calls {
                self.ask()?;
            }
            match end {
                Ok(end) if end.answer.from.as_str() == PEER => {
                    part.seen
                        .add(u64::try_from(asked.elapsed().as_nanos()).unwrap_or(u64::MAX));
                    part.at_worker.add(end.total_ns);
                }
                _ => part.failed += 1,
            }
        }
        part.rate = calls as f64 / started.elapsed().as_secs_f64();
        Ok(part)
    }
}
