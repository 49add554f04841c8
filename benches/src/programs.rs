//! `programs`: the published experiments of the 3C platform, 4.5.1 to 4.5.3, on this machine; and thousands of programs that sleep.
//!
//! Published, on a Cortex-M3 of 50 MHz: 37.8 kHz from a script against 922 kHz native, 24.39 times less; 0.577 ms for a PID
//! cycle; 53 µs of jitter without allocations, 1,400 µs with them. The ratio can be compared; the times are of other machines.

use std::{
    collections::BTreeMap,
    hint::black_box,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use bumpless_core::{
    Digest, Fault, Grant, HostId, Message, PointId, ProgramId, ProgramSpec, Reading,
    program::{Status, Wanted},
};
use bumpless_engine::{Answer, Config, Engine, Later, PreparedProgram, Question, Reply, Script, Sight, wrap};
use bumpless_programs::{Order, Reach, Runner};
use parking_lot::Mutex;
use rustix::time::{ClockId, clock_gettime};

use crate::{
    Options,
    error::Error,
    report::{Bound, Report},
    spread::Spread,
    stall::Watch,
};

/// What was published.
const PUBLISHED_RATIO: f64 = 24.39;
/// Longest wait for a run's end.
const PATIENCE: Duration = Duration::from_secs(120);
/// The published central script, with its own `while true do` and pauses.
const LEVEL: &str = include_str!("../../programs/lua3c/scripts/level.lua");

/// A pin board: counts what is read and written, and when.
#[derive(Default)]
struct Board {
    reads: AtomicU64,
    writes: AtomicU64,
    /// Of single runs: when each write came, in ns since the start.
    at_ns: Option<Mutex<Vec<u64>>>,
    /// Of many: how far each write is from its period.
    late: Option<Mutex<Spread>>,
    last_ns: AtomicU64,
    started: Option<Instant>,
}

impl Board {
    fn timed() -> Self {
        Self {
            at_ns: Some(Mutex::default()),
            started: Some(Instant::now()),
            ..Self::default()
        }
    }

    fn now_ns(&self) -> u64 {
        let since = self.started.map(|started| started.elapsed().as_nanos());
        since.map_or(0, |ns| u64::try_from(ns).unwrap_or(u64::MAX))
    }
}

impl Reach for Board {
    fn read(&self, slot: usize) -> Answer<'_, Sight> {
        let reads = self.reads.fetch_add(1, Ordering::Relaxed);
        // A level that moves, so that the law has something to do; the setpoint stands.
        let value = if slot == 0 { 300.0 + (reads % 7) as f64 } else { 512.0 };
        Answer::Now(Sight {
            reading: Reading::good(value, 1),
            age_ns: 0,
        })
    }

    fn write(&self, _: usize, value: f64) -> Answer<'_, Result<(), String>> {
        black_box(value);
        self.writes.fetch_add(1, Ordering::Relaxed);
        if let Some(at_ns) = &self.at_ns {
            at_ns.lock().push(self.now_ns());
        }
        if let Some(late) = &self.late {
            let now_ns = self.now_ns();
            let last_ns = self.last_ns.swap(now_ns, Ordering::Relaxed);
            if last_ns > 0 {
                late.lock().add((now_ns - last_ns).abs_diff(PERIOD_NS));
            }
        }
        Answer::Now(Ok(()))
    }

    fn publish(&self, _: Message) -> Result<(), String> {
        Ok(())
    }

    fn step(&self, _: Question) -> Later<'_, Result<Reply, Fault>> {
        Box::pin(std::future::ready(Err(Fault::Failed("there is no cell".to_owned()))))
    }

    fn save(&self, _: Vec<u8>) -> Later<'_, Result<(), String>> {
        Box::pin(std::future::ready(Ok(())))
    }
}

/// Period of the sleeping programs, and of the published loop, in ns.
const PERIOD_NS: u64 = 50_000_000;

struct Stand {
    engine: Engine,
    runner: Runner,
    lua: Vec<u8>,
    guest: Vec<u8>,
    // So that the interpreter is compiled once.
    kept: Mutex<Vec<Arc<PreparedProgram>>>,
}

fn spec(name: &str) -> Result<ProgramSpec, Error> {
    let grant = |point: &str, write| -> Result<Grant, Error> {
        Ok(Grant {
            point: PointId::new(point)?,
            write,
            raw: None,
            range: (0.0, 1024.0),
            unit: String::new(),
        })
    };
    Ok(ProgramSpec {
        id: ProgramId::new(name)?,
        revision: 1,
        digest: Digest::of(name.as_bytes()),
        home: HostId::new("bench")?,
        // In order of their names: the level, the setpoint, the pump, the pin.
        grants: BTreeMap::from([
            ("ain-0".to_owned(), grant("p.level", false)?),
            ("ain-2".to_owned(), grant("p.setpoint", false)?),
            ("aout-2".to_owned(), grant("p.pump", true)?),
            ("dout-17".to_owned(), grant("p.pin", true)?),
        ]),
        publishes: vec![],
        listens: vec![],
        components: vec![],
        share_percent: 100,
        memory_bytes: 8 << 20,
        prefer: vec![],
        wanted: Wanted::Running,
    })
}

impl Stand {
    fn new() -> Result<Self, Error> {
        let folder = xtask::components::build().map_err(Error::Components)?;
        let read = |file: &str| {
            let path = folder.join(file);
            std::fs::read(&path).map_err(|_| Error::Missing(path))
        };
        let refused = |source| Error::Engine {
            what: "its own configuration".to_owned(),
            source,
        };
        Ok(Self {
            engine: Engine::new(Config::default()).map_err(refused)?,
            runner: Runner::start().map_err(|error| Error::Wish(error.to_string()))?,
            lua: read("programs/lua3c.wasm")?,
            guest: read("guests/free-runs.wasm")?,
            kept: Mutex::default(),
        })
    }

    fn prepared(&self, code: &[u8], text: &str) -> Result<Arc<PreparedProgram>, Error> {
        let refused = |source| Error::Engine {
            what: "a program".to_owned(),
            source,
        };
        let script = Script {
            name: "bench".to_owned(),
            version: "1.0.0".to_owned(),
            text: text.as_bytes().to_vec(),
        };
        let bytes = wrap(code, &script).map_err(refused)?;
        let (prepared, _) = self.engine.programs().open(&bytes).map_err(refused)?;
        self.kept.lock().push(Arc::clone(&prepared));
        Ok(prepared)
    }

    fn start(&self, name: &str, prepared: Arc<PreparedProgram>, board: &Arc<Board>) -> Result<ProgramId, Error> {
        let spec = spec(name)?;
        let id = spec.id.clone();
        let order = Order {
            spec,
            term: 1,
            prepared,
            checkpoint: None,
            reach: Arc::clone(board) as Arc<dyn Reach>,
            paused: false,
        };
        self.runner.run(order).map_err(|error| Error::Wish(error.to_string()))?;
        Ok(id)
    }

    /// Runs to the end; gives its processor time in s.
    fn whole(&self, prepared: Arc<PreparedProgram>, board: &Arc<Board>) -> Result<f64, Error> {
        let id = self.start("whole", prepared, board)?;
        let until = Instant::now() + PATIENCE;
        loop {
            let view = self
                .runner
                .view(&id)
                .ok_or_else(|| Error::Wish("the run is gone".to_owned()))?;
            match view.status {
                Status::Stopped => {
                    self.runner.forget(&id, 1);
                    return Ok(view.used_ns as f64 / 1e9);
                }
                Status::Fault => return Err(Error::Wish(format!("a program is in fault: {}", view.reason))),
                _ if Instant::now() > until => {
                    return Err(Error::Waited {
                        what: "the end of a program".to_owned(),
                        seconds: PATIENCE.as_secs(),
                    });
                }
                _ => std::thread::sleep(Duration::from_millis(2)),
            }
        }
    }
}

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let watch = Watch::start();
    let stand = Stand::new()?;
    square(options, report, &stand)?;
    pid(options, report, &stand)?;
    jitter(options, report, &stand)?;
    sleepers(options, report, &stand)?;
    stand.runner.close();
    watch.finish().tell(report, "programs");
    Ok(())
}

/// 4.5.1: how many edges a second. The published loops never end, so theirs are counted here.
fn square(options: Options, report: &mut Report, stand: &Stand) -> Result<(), Error> {
    report.progress("the square wave of 4.5.1");
    let periods = options.count(500_000, 20_000);
    let native = native_square(periods * 20);
    report.told("programs.square.native", native / 1e3, "kHz");
    let mut rates = BTreeMap::new();
    for (name, code, text) in [
        (
            "lua",
            &stand.lua,
            format!("for i = 1, {periods} do h3c.dOut(17, 1) h3c.dOut(17, 0) end"),
        ),
        (
            "lua_fast",
            &stand.lua,
            format!("o=h3c.dOut for i = 1, {periods} do o(17, 1) o(17, 0) end"),
        ),
        ("rust", &stand.guest, format!("square {}", periods * 2)),
    ] {
        let prepared = stand.prepared(code, &text)?;
        let board = Arc::new(Board::default());
        let used_s = stand.whole(prepared, &board)?;
        let written = board.writes.load(Ordering::Relaxed);
        report.figure(
            &format!("programs.square.{name}.edges_missing"),
            (periods * 2).abs_diff(written) as f64,
            "",
            Bound::AtMost(0.0),
        );
        let rate = periods as f64 / used_s;
        rates.insert(name, rate);
        report.told(&format!("programs.square.{name}"), rate / 1e3, "kHz");
    }
    let ratio = |name: &str| rates.get(name).map_or(f64::NAN, |rate| native / rate);
    report.told("programs.square.published_ratio", PUBLISHED_RATIO, "×");
    report.told("programs.square.native_by_lua_fast", ratio("lua_fast"), "×");
    report.told("programs.square.native_by_rust", ratio("rust"), "×");
    let by_rust = rates
        .get("rust")
        .zip(rates.get("lua_fast"))
        .map_or(f64::NAN, |(rust, lua)| rust / lua);
    report.told("programs.square.rust_by_lua_fast", by_rust, "×");
    Ok(())
}

/// The same pin by a native loop: what the host's own part costs. Periods per second.
fn native_square(periods: u64) -> f64 {
    let board: Arc<dyn Reach> = black_box(Arc::new(Board::default()));
    let started = Instant::now();
    for _ in 0..periods {
        for value in [1.0, 0.0] {
            let Answer::Now(end) = board.write(3, value) else {
                continue;
            };
            black_box(end.is_ok());
        }
    }
    periods as f64 / started.elapsed().as_secs_f64()
}

/// 4.5.2: the published law without its pause, so many cycles.
fn pid(options: Options, report: &mut Report, stand: &Stand) -> Result<(), Error> {
    report.progress("the PID cycle of 4.5.2");
    let cycles = options.count(20_000, 2_000);
    // Changed as the published one was: the pause of the loop is taken out, and the cycles are counted.
    let text = LEVEL
        .replacen("while true do", &format!("for cycle = 1, {cycles} do"), 1)
        .replacen("    o3c.dms(50)\n    if (duty", "    if (duty", 1);
    let board = Arc::new(Board::default());
    let used_s = stand.whole(stand.prepared(&stand.lua, &text)?, &board)?;
    report.told("programs.pid.cycle", used_s * 1e6 / cycles as f64, "µs");
    report.told("programs.pid.published_cycle", 577.0, "µs");
    // Two readings in each cycle, and two before the first.
    let reads = board.reads.load(Ordering::Relaxed);
    report.figure(
        "programs.pid.readings_missing",
        (2 * cycles + 2).abs_diff(reads) as f64,
        "",
        Bound::AtMost(0.0),
    );
    Ok(())
}

/// 4.5.3: how much longer one turn of the law takes than another, with and without lines that change.
fn jitter(options: Options, report: &mut Report, stand: &Stand) -> Result<(), Error> {
    report.progress("the jitter of 4.5.3");
    let seconds = options.count(20, 2);
    let calm = "";
    let prints = "print(pid.sp .. ' ' .. pid.pv .. ' ' .. pid.out .. ' ' .. n) n = n + 0.37";
    for (name, line, published_us) in [("calm", calm, 53.0), ("prints", prints, 1_400.0)] {
        // The pin is low while the loop pauses, and high while it works.
        let turned = format!("    h3c.dOut(17, 0)\n    o3c.dms(50)\n    h3c.dOut(17, 1)\n    {line}\n    if (duty");
        let silent = LEVEL.replacen("    if outputprint == 3 then", "    if false then", 1);
        let text = format!(
            "n = 0\n{}",
            silent.replacen("    o3c.dms(50)\n    if (duty", &turned, 1)
        );
        // Only the pin's edges are timed: the pump has a board of its own in the grants' order, and is not written at rest.
        let text = text.replacen(
            "        h3c.aOut(2, duty)\n    end\n    outputprint",
            "    end\n    outputprint",
            1,
        );
        let board = Arc::new(Board::timed());
        let id = stand.start(name, stand.prepared(&stand.lua, &text)?, &board)?;
        std::thread::sleep(Duration::from_secs(seconds));
        let view = stand.runner.view(&id);
        stand.runner.forget(&id, 1);
        if let Some(view) = view.filter(|view| view.status == Status::Fault) {
            return Err(Error::Wish(format!("a program is in fault: {}", view.reason)));
        }
        let at_ns = board
            .at_ns
            .as_ref()
            .map(|at_ns| std::mem::take(&mut *at_ns.lock()))
            .unwrap_or_default();
        // The first write is the pump's; then low, high, low, high …
        let edges = at_ns.get(1..).unwrap_or_default();
        let (mut work, mut pause) = (Spread::new(), Spread::new());
        let mut widths = (u64::MAX, 0);
        for pair in edges.windows(2).enumerate() {
            let (number, &[from, to]) = pair else { continue };
            if number % 2 == 0 {
                pause.add((to - from).abs_diff(PERIOD_NS));
            } else {
                work.add(to - from);
                widths = (widths.0.min(to - from), widths.1.max(to - from));
            }
        }
        work.tell(report, &format!("programs.jitter.{name}.work"));
        report.told(
            &format!("programs.jitter.{name}.work.span"),
            widths.1.saturating_sub(widths.0) as f64 / 1e3,
            "µs",
        );
        report.told(&format!("programs.jitter.{name}.published_span"), published_us, "µs");
        pause.tell(report, &format!("programs.jitter.{name}.pause_late"));
    }
    Ok(())
}

fn process_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 / 1e9
}

fn resident_bytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    kib.map_or(f64::NAN, |kib| kib * 1024.0)
}

/// Thousands of programs that write once in 50 ms: Rust programs, then scripts.
fn sleepers(options: Options, report: &mut Report, stand: &Stand) -> Result<(), Error> {
    let (count, seconds) = (options.count(5_000, 500), options.count(20, 3));
    let rust = ("rust", stand.prepared(&stand.guest, "beat 50")?);
    let lua = (
        "lua",
        stand.prepared(
            &stand.lua,
            "local on = 0 while true do on = 1 - on h3c.dOut(17, on) o3c.dms(50) end",
        )?,
    );
    for (name, prepared) in [rust, lua] {
        report.progress(&format!("{count} sleeping programs, {name}"));
        let before_bytes = resident_bytes();
        let boards: Vec<Arc<Board>> = (0..count)
            .map(|_| {
                Arc::new(Board {
                    late: Some(Mutex::new(Spread::new())),
                    started: Some(Instant::now()),
                    ..Board::default()
                })
            })
            .collect();
        let mut ids = Vec::new();
        for (number, board) in boards.iter().enumerate() {
            ids.push(stand.start(&format!("{name}-{number}"), Arc::clone(&prepared), board)?);
            // Spread over their period, as programs of different people are.
            if number % 100 == 99 {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        // Until all have begun.
        std::thread::sleep(Duration::from_secs(3));
        for board in &boards {
            if let Some(late) = &board.late {
                *late.lock() = Spread::new();
            }
        }
        let writes = || {
            boards
                .iter()
                .map(|board| board.writes.load(Ordering::Relaxed))
                .sum::<u64>()
        };
        let (started, from_s, from_writes) = (Instant::now(), process_s(), writes());
        std::thread::sleep(Duration::from_secs(seconds));
        let (elapsed_s, used_s, written) = (
            started.elapsed().as_secs_f64(),
            process_s() - from_s,
            writes() - from_writes,
        );
        let bytes = resident_bytes() - before_bytes;
        let faults = ids
            .iter()
            .filter(|id| stand.runner.view(id).is_none_or(|view| view.status != Status::Running))
            .count();
        let mut late = Spread::new();
        for board in &boards {
            if let Some(own) = &board.late {
                late.join(&own.lock());
            }
        }
        ids.iter().for_each(|id| stand.runner.forget(id, 1));
        let figure = |what: &str| format!("programs.sleepers.{name}.{what}");
        report.told(&figure("count"), count as f64, "");
        report.figure(&figure("not_running"), faults as f64, "", Bound::AtMost(0.0));
        report.told(&figure("processor"), used_s / elapsed_s * 100.0, "% of a core");
        report.told(&figure("beats"), written as f64 / elapsed_s, "/s");
        report.told(&figure("memory_each"), bytes / count as f64 / 1024.0, "KiB");
        late.tell(report, &figure("off_by"));
    }
    Ok(())
}
