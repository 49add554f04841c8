//! `io`: 1,000 points on ten Modbus devices at 10 Hz.
//!
//! First the I/O room alone, in this process, with the devices in another: how many requests a round of polls takes against
//! the least possible, how old a reading is when a cycle would freeze it, and how much processor time it costs. Then the same
//! with one device that answers after two seconds: the readings of the other nine must be as fresh. At last a whole cell with a
//! loop on its simulated bus and the ten devices beside it, with and without the slow one: no cycle may be lost.

use std::{
    fmt::Write as _,
    io::{BufRead as _, BufReader, Write as _},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use bumpless_core::PointId;
use bumpless_io::{Clock, Config, IoServer, PointIndex};
use bumpless_tests::{Cell, CellOptions, first_order_loop};

use crate::{
    Options,
    error::Error,
    history::{History, Tally},
    report::{Bound, Report},
    spread::Spread,
    stall::Watch,
};

const DEVICES: u16 = 10;
const POINTS_PER_DEVICE: usize = 100;
const PERIOD_MS: u64 = 100;
/// What the slow device takes.
const SLOW_MS: u64 = 2_000;
/// Requests of one device in one round: coils, discrete inputs, holding registers, input registers.
const REQUESTS_LEAST: f64 = 4.0;
/// Time between two looks at all points, as a fast loop would take them.
const LOOK: Duration = Duration::from_millis(10);

/// The devices' process.
struct Devices {
    child: Child,
    ports: Vec<u16>,
}

impl Devices {
    fn start() -> Result<Self, Error> {
        let program = std::env::current_exe().map_err(Error::io("this program cannot find itself"))?;
        let mut child = Command::new(program)
            .args(["io-devices", &DEVICES.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(Error::io("the devices cannot be started"))?;
        let mut line = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout)
                .read_line(&mut line)
                .map_err(Error::io("the devices do not say their ports"))?;
        }
        let ports = serde_json::from_str(&line).map_err(|_| Error::Said {
            who: "the devices' process".to_owned(),
            said: line.chars().take(100).collect(),
            expected: "the ports of its devices",
        })?;
        Ok(Self { child, ports })
    }

    fn slow(&mut self, ms: u64) -> Result<(), Error> {
        let said = self.child.stdin.as_mut().map_or_else(
            || Err(std::io::ErrorKind::BrokenPipe.into()),
            |stdin| writeln!(stdin, "slow {ms}").and_then(|()| stdin.flush()),
        );
        said.map_err(Error::io("the devices do not listen"))
    }
}

impl Drop for Devices {
    fn drop(&mut self) {
        let _gone = self.child.kill().and_then(|()| self.child.wait());
    }
}

/// The buses as TOML. The slow device gets the time that it needs, so that it is slow and not lost.
fn buses(ports: &[u16]) -> String {
    let mut text = String::new();
    for (device, port) in ports.iter().enumerate() {
        let _infallible = write!(
            text,
            "[[bus]]\nid = \"d{device}\"\ndriver = \"modbus-tcp\"\naddress = \"127.0.0.1:{port}\"\nperiod_ms = {PERIOD_MS}\n\
             timeout_ms = {}\n",
            2 * SLOW_MS
        );
        let mut point = |number: usize, table: &str, address: usize, rest: &str| {
            let _infallible = write!(
                text,
                "[[bus.point]]\nid = \"d{device}.{number}\"\ntable = \"{table}\"\naddress = {address}\n{rest}\n"
            );
        };
        let range = "low = 0.0\nhigh = 1000.0";
        for n in 0..40 {
            point(n, "input", n, range);
        }
        // Floats with a register between two of them, as devices have them.
        for n in 0..20 {
            point(40 + n, "holding", 3 * n, &format!("type = \"u32\"\n{range}"));
        }
        for n in 0..30 {
            point(60 + n, "coil", n, "");
        }
        for n in 0..10 {
            point(90 + n, "discrete", n, "");
        }
    }
    text
}

/// What a run of the I/O room came to.
struct Run {
    /// Ages of the readings of all devices but the first.
    others: Spread,
    requests: u64,
    /// Rounds of polls of one device in the time.
    rounds: f64,
    cpu_percent: f64,
    late: u64,
}

fn run_room(ports: &[u16], lasts: Duration) -> Result<Run, Error> {
    let config: Config = toml::from_str(&buses(ports)).map_err(|error| Error::Said {
        who: "the configuration of the buses".to_owned(),
        said: error.to_string(),
        expected: "nothing",
    })?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(Error::io("the runtime cannot be started"))?;
    let server = IoServer::open(&config, Clock::start(), runtime.handle()).map_err(Error::Plant)?;
    let mut others: Vec<PointIndex> = Vec::new();
    for device in 1..ports.len() {
        for number in 0..POINTS_PER_DEVICE {
            others.extend(server.index(&PointId::new(format!("d{device}.{number}"))?));
        }
    }
    let all_read = || {
        others
            .iter()
            .all(|index| server.read_one(*index, server.clock().now_ns()).value.is_ok())
    };
    let started = Instant::now();
    while !all_read() {
        if started.elapsed() > Duration::from_secs(20) {
            return Err(Error::Waited {
                what: "a first reading of every point".to_owned(),
                seconds: 20,
            });
        }
        std::thread::sleep(LOOK);
    }
    let requests = || {
        server
            .status()
            .iter()
            .skip(1)
            .map(|status| status.requests)
            .sum::<u64>()
    };
    let late = || {
        server
            .status()
            .iter()
            .skip(1)
            .map(|status| status.polls_late)
            .sum::<u64>()
    };
    let (requests_before, late_before, cpu_before, began) = (requests(), late(), cpu_ms(), Instant::now());
    let mut ages = Spread::new();
    while began.elapsed() < lasts {
        std::thread::sleep(LOOK);
        let now_ns = server.clock().now_ns();
        for index in &others {
            ages.add(now_ns.saturating_sub(server.read_one(*index, now_ns).at_ns));
        }
    }
    let seconds = began.elapsed().as_secs_f64();
    let run = Run {
        others: ages,
        requests: requests() - requests_before,
        rounds: seconds * 1000.0 / PERIOD_MS as f64,
        cpu_percent: (cpu_ms() - cpu_before) as f64 / seconds / 10.0,
        late: late() - late_before,
    };
    server.close();
    Ok(run)
}

/// Processor time of this process so far, in ms. Source: proc(5), `/proc/self/stat`, fields 14 and 15, in 10 ms.
fn cpu_ms() -> u64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let behind = stat.rsplit_once(')').map_or("", |(_, rest)| rest);
    let fields = behind.split_whitespace().skip(11).take(2);
    10 * fields.filter_map(|field| field.parse::<u64>().ok()).sum::<u64>()
}

/// Runs the bench.
pub(crate) fn run(options: Options, report: &mut Report) -> Result<(), Error> {
    let lasts = Duration::from_secs(options.count(30, 5));
    let mut devices = Devices::start()?;
    let watch = Watch::start();
    report.progress("1,000 points on ten devices at 10 Hz, in this process");
    let even = run_room(&devices.ports, lasts)?;
    report.progress("the same, with one device that answers after two seconds");
    devices.slow(SLOW_MS)?;
    let uneven = run_room(&devices.ports, lasts)?;
    for (name, run) in [("even", &even), ("one_slow", &uneven)] {
        let nine = f64::from(DEVICES - 1);
        let least = run.rounds * REQUESTS_LEAST * nine;
        report.figure(
            &format!("io.{name}.requests_per_least"),
            run.requests as f64 / least,
            "",
            Bound::AtMost(1.02),
        );
        run.others.tell(report, &format!("io.{name}.staleness"));
        // A reading is at most a period old when the next one is asked for, and some milliseconds more until it is there.
        report.figure(
            &format!("io.{name}.staleness_p99"),
            run.others.us(0.99) / 1000.0,
            "ms",
            Bound::AtMost(PERIOD_MS as f64 + 15.0),
        );
        report.told(&format!("io.{name}.polls_late"), run.late as f64, "polls");
        // With 900 reads of the image each 10 ms, as a fast loop would make them.
        report.told(&format!("io.{name}.cpu"), run.cpu_percent, "% of a core");
    }
    report.figure(
        "io.slow_device_adds",
        (uneven.others.us(0.99) - even.others.us(0.99)) / 1000.0,
        "ms at p99",
        Bound::AtMost(10.0),
    );
    devices.slow(0)?;
    loops(report, &mut devices, lasts)?;
    watch.finish().tell(report, "io");
    Ok(())
}

/// A loop beside the devices, in a cell of processes.
fn loops(report: &mut Report, devices: &mut Devices, lasts: Duration) -> Result<(), Error> {
    report.progress("a cell with a loop at 50 Hz and the ten devices beside it");
    let mut cell_options =
        CellOptions::first_order("{ count = 1, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.002 }")
            .controllers(1);
    cell_options.bus.push_str(&buses(&devices.ports));
    let cell = Cell::start(cell_options)?;
    let api = cell.plant.api();
    api.upload_stock(&["pid"])?;
    let draft = first_order_loop(0, "pid", 20.0);
    api.apply(&draft)?;
    let name = "loop-0";
    let history = History::follow(&api, &[name])?;
    history.wait_steps(&[name], "a", 0)?;
    for (figure, ms) in [("even", 0), ("one_slow", SLOW_MS)] {
        devices.slow(ms)?;
        std::thread::sleep(Duration::from_secs(1));
        let before = Tally::ask(&api, name)?;
        std::thread::sleep(lasts);
        let after = Tally::ask(&api, name)?;
        report.figure(
            &format!("io.{figure}.loop.cycles_lost"),
            after.lost.saturating_sub(before.lost) as f64,
            "cycles",
            Bound::AtMost(0.0),
        );
        after.tell_since(before, report, &format!("io.{figure}.loop"));
    }
    Ok(())
}
