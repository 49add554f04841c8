//! Our client, at other people's servers. Each has 2,048 bits and 300 registers of each kind, all 0 at first.

use std::{
    fmt::Write as _,
    time::{Duration, Instant},
};

use bumpless_core::{LoopId, NoData, PointId};
use bumpless_io::{Clock, Config, IoServer, PointIndex, WriteStamp};

use crate::{
    Row, Verdict,
    relay::{Relay, Spoil},
    tools::{Process, Tool, certificates},
};

/// How long something may take that must come.
const LONGEST: Duration = Duration::from_secs(20);

struct Ours {
    server: IoServer,
    _runtime: tokio::runtime::Runtime,
}

impl Ours {
    fn open(port: u16, bus: &str) -> Self {
        let mut text = format!(
            "[[bus]]\nid = \"line\"\ndriver = \"modbus-tcp\"\naddress = \"127.0.0.1:{port}\"\nperiod_ms = 20\n\
             timeout_ms = 2000\nverify = true\n{bus}\n"
        );
        let mut point = |id: String, table: &str, address: usize, rest: &str| {
            let _infallible = write!(
                text,
                "[[bus.point]]\nid = \"{id}\"\ntable = \"{table}\"\naddress = {address}\n{rest}\n"
            );
        };
        let number = "low = 0.0\nhigh = 65535.0";
        for n in 0..125 {
            point(format!("h{n}"), "holding", n, &format!("{number}\nwritable = true"));
        }
        for n in 0..2000 {
            point(format!("c{n}"), "coil", n, "writable = true");
        }
        let wide = "low = -1e6\nhigh = 1e6\nwritable = true";
        point("f32".to_owned(), "holding", 200, &format!("type = \"f32\"\n{wide}"));
        let swapped = format!("type = \"i32\"\nword_order = \"low-first\"\n{wide}");
        point("i32".to_owned(), "holding", 202, &swapped);
        point("bit".to_owned(), "holding", 210, "bit = 3\nwritable = true");
        let field = "bits = [8, 4]\nlow = 0.0\nhigh = 15.0\nwritable = true";
        point("field".to_owned(), "holding", 210, field);
        point("discrete".to_owned(), "discrete", 2000, "");
        point("input".to_owned(), "input", 299, number);
        point("beyond".to_owned(), "input", 400, number);
        let config: Config = toml::from_str(&text).unwrap();
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let server = IoServer::open(&config, Clock::start(), runtime.handle()).unwrap();
        Self {
            server,
            _runtime: runtime,
        }
    }

    fn index(&self, point: &str) -> PointIndex {
        self.server.index(&PointId::new(point).unwrap()).expect("a point")
    }

    fn value(&self, point: &str) -> Result<f64, NoData> {
        self.server
            .read_one(self.index(point), self.server.clock().now_ns())
            .value
    }

    fn state(&self) -> String {
        format!("{:?}", self.server.status())
    }

    /// Waits until it is so; tells what there is instead where it never is.
    fn until(&self, what: &str, mut is_so: impl FnMut() -> bool) -> Verdict {
        let started = Instant::now();
        while !is_so() {
            if started.elapsed() > LONGEST {
                return Verdict::Bad(format!("{what} never came; {}", self.state()));
            }
            std::thread::park_timeout(Duration::from_millis(5));
        }
        Verdict::Good
    }

    /// Writes, and waits until polls of later than the write have seen all of it.
    fn write(&self, values: &[(String, f64)]) -> Verdict {
        self.write_unless(values, || false).expect("nothing ends it")
    }

    /// As [`Ours::write`]; none where `over` comes first.
    fn write_unless(&self, values: &[(String, f64)], over: impl Fn() -> bool) -> Option<Verdict> {
        let stamp = WriteStamp {
            loop_id: LoopId::new("x").unwrap(),
            term: 1,
            seq: 1,
        };
        let list: Vec<_> = values
            .iter()
            .map(|(point, value)| (self.index(point), *value))
            .collect();
        self.server.write(&list, &stamp, self.server.clock().now_ns()).unwrap();
        // A value that the device holds already is not sent again, so writes cannot be counted.
        let held = || {
            list.iter()
                .all(|(index, value)| self.server.read_one(*index, self.server.clock().now_ns()).value == Ok(*value))
        };
        let taken = self.until("the device's confirmation", || over() || held());
        if over() {
            return None;
        }
        if taken != Verdict::Good {
            return Some(taken);
        }
        let after_ns = self.server.clock().now_ns();
        Some(self.until("what was written", || {
            list.iter().all(|(index, value)| {
                let reading = self.server.read_one(*index, self.server.clock().now_ns());
                reading.at_ns > after_ns && reading.value == Ok(*value)
            })
        }))
    }
}

fn named(pairs: &[(&str, f64)]) -> Vec<(String, f64)> {
    pairs.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect()
}

/// Good where the function went out and was answered well since; missing where the peer refused it each time.
fn by(relay: &Relay, function: u8, before: (u32, u32), verdict: Verdict) -> Verdict {
    if verdict != Verdict::Good {
        return verdict;
    }
    let (well, refused) = relay.seen(function);
    if well > before.0 {
        Verdict::Good
    } else if refused > before.1 {
        Verdict::Missing
    } else {
        Verdict::Bad(format!("the values came, but not by function {function}"))
    }
}

/// Our client against a peer's server.
pub(crate) fn against(tool: &Tool) -> Row {
    let mut row = Row::new(format!("ours → {}", tool.name));
    let (_process, port) = Process::server(tool);
    let relay = Relay::start(port);
    for mode in ["auto", "multiple", "single"] {
        let ours = Ours::open(relay.port, &format!("write_with = \"{mode}\""));
        for (column, point, function) in [
            ("1", "c0", 1),
            ("2", "discrete", 2),
            ("3", "h124", 3),
            ("4", "input", 4),
        ] {
            // Polled since it was opened, so any answer of the function is this one's.
            let came = ours.until(point, || ours.value(point).is_ok());
            row.add(column, by(&relay, function, (0, 0), came));
        }
        let beyond = ours.until("exception 2", || ours.value("beyond") == Err(NoData::DeviceError(2)));
        row.add("exceptions", beyond);
        let mut write = |column: &str, function: u8, values: &[(String, f64)]| {
            let before = relay.seen(function);
            let verdict = ours.write(values);
            row.add(column, by(&relay, function, before, verdict));
        };
        // Another value in each mode, so that each really writes.
        let v = mode.len() as f64;
        let (bit, register) = if mode == "multiple" { ("15", "16") } else { ("5", "6") };
        let number = |column: &str| column.parse().expect("a function");
        write(bit, number(bit), &named(&[("c7", 1.0)]));
        write(bit, number(bit), &named(&[("c7", 0.0)]));
        write(register, number(register), &named(&[("h10", 40_000.0 + v)]));
        write("16", 16, &named(&[("f32", -2.5 - v), ("i32", -70_000.0 - v)]));
        // A unit without function 22 is asked once; then its registers are written whole.
        write("22", 22, &named(&[("bit", 1.0), ("field", v)]));
        if mode != "single" {
            let registers: Vec<_> = (0..125).map(|n| (format!("h{n}"), 100.0 * v + f64::from(n))).collect();
            write("limits", 16, &registers);
            let coils: Vec<_> = (0..2000)
                .map(|n| (format!("c{n}"), f64::from(u8::from((n + mode.len()) % 3 == 0))))
                .collect();
            write("limits", 15, &coils);
            // Only what differs is sent, so three neighbours are turned over.
            let turned: Vec<_> = coils[1..4]
                .iter()
                .map(|(name, value)| (name.clone(), 1.0 - value))
                .collect();
            write("15", 15, &turned);
        }
    }
    {
        let ours = Ours::open(relay.port, "write_with = \"read-write\"");
        ours.until("h0", || ours.value("h0").is_ok());
        let before = relay.seen(23);
        // Where the server has no function 23, nothing comes of it, and the client says so in words.
        let refused = || relay.seen(23).1 > before.1;
        let values = named(&[("h20", 7.0), ("h21", 8.0), ("f32", 99.5)]);
        let verdict = ours.write_unless(&values, refused).unwrap_or(Verdict::Good);
        row.add("23", by(&relay, 23, before, verdict));
    }
    row.add("malformed", spoiled(&relay));
    row.add("unit", stranger(relay.port));
    row
}

/// Spoils answers in each way, until it shows; then all must be well again by itself.
fn spoiled(relay: &Relay) -> Verdict {
    let ours = Ours::open(relay.port, "backoff_ms_min = 10\nbackoff_ms_max = 50");
    let well = |what: &str| {
        let after_ns = ours.server.clock().now_ns();
        ours.until(what, || {
            let reading = ours.server.read_one(ours.index("h0"), ours.server.clock().now_ns());
            reading.value.is_ok() && reading.at_ns > after_ns
        })
    };
    let mut verdict = well("a value");
    for spoil in [Spoil::Pieces, Spoil::Number, Spoil::Half, Spoil::Nonsense] {
        if verdict != Verdict::Good {
            break;
        }
        let before = relay.spoiled();
        relay.spoil(spoil);
        verdict = ours.until("a spoiled answer", || relay.spoiled() > before + 2);
        if spoil == Spoil::Pieces && verdict == Verdict::Good {
            verdict = well("a value in pieces");
        } else if verdict == Verdict::Good {
            verdict = ours.until("the loss", || ours.value("h0") == Err(NoData::CommsLost));
        }
        relay.spoil(Spoil::Nothing);
        if verdict == Verdict::Good {
            verdict = well(&format!("a value after {spoil:?}"));
        }
    }
    verdict
}

/// A unit that the peer does not have, beside one that it has: its point is bad with a reason, and the other is well.
fn stranger(port: u16) -> Verdict {
    let away =
        "[[bus.point]]\nid = \"away\"\ntable = \"holding\"\naddress = 0\nunit_id = 9\nlow = 0.0\nhigh = 65535.0\n";
    let ours = Ours::open(port, away);
    let came = ours.until("h0", || ours.value("h0").is_ok());
    if came != Verdict::Good {
        return came;
    }
    let mut said = Err(NoData::NeverRead);
    let ended = ours.until("the other unit's end", || {
        said = ours.value("away");
        !matches!(said, Err(NoData::NeverRead))
    });
    match (ended, said) {
        // Gateway codes by the standard; pymodbus calls it a failure of the device.
        (Verdict::Good, Err(NoData::CommsLost | NoData::DeviceError(4 | 10 | 11))) => {
            let after_ns = ours.server.clock().now_ns();
            ours.until("the unit beside it", || {
                let reading = ours.server.read_one(ours.index("h0"), ours.server.clock().now_ns());
                reading.value.is_ok() && reading.at_ns > after_ns
            })
        }
        (Verdict::Good, Ok(_)) => Verdict::Missing,
        (Verdict::Good, Err(other)) => Verdict::Bad(format!("unit 9: {other}")),
        (bad, _) => bad,
    }
}

/// Our client against a peer's server, over TLS.
pub(crate) fn against_over_tls(tool: &Tool) -> Row {
    let mut row = Row::new(format!("ours → {}, TLS", tool.name));
    let (_process, port) = Process::server_over_tls(tool);
    let folder = certificates();
    let tls = format!(
        "[bus.tls]\nca = \"{folder}/plant.pem\"\ncertificate = \"{folder}/host.pem\"\nkey = \"{folder}/host.key\"\n"
    );
    let ours = Ours::open(port, &tls);
    row.add("3", ours.until("h124", || ours.value("h124").is_ok()));
    row.add(
        "exceptions",
        ours.until("exception 2", || ours.value("beyond") == Err(NoData::DeviceError(2))),
    );
    row.add("6", ours.write(&named(&[("h10", 4_711.0)])));
    row.add("16", ours.write(&named(&[("f32", -2.5), ("i32", -70_000.0)])));
    row
}
