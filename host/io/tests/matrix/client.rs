//! Our client, at other people's servers. Each has 2,048 bits and 300 registers of each kind, all 0 at first.

use std::{
    fmt::Write as _,
    time::{Duration, Instant},
};

use bumpless_core::{LoopId, NoData, PointId};
use bumpless_io::{Clock, Config, IoServer, PointIndex, WriteStamp};

use crate::{
    Row, Verdict,
    tools::{Process, Tool},
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
        let taken = self.until("the device's confirmation", held);
        if taken != Verdict::Good {
            return taken;
        }
        let after_ns = self.server.clock().now_ns();
        self.until("what was written", || {
            list.iter().all(|(index, value)| {
                let reading = self.server.read_one(*index, self.server.clock().now_ns());
                reading.at_ns > after_ns && reading.value == Ok(*value)
            })
        })
    }
}

fn named(pairs: &[(&str, f64)]) -> Vec<(String, f64)> {
    pairs.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect()
}

/// Our client against a peer's server.
pub(crate) fn against(tool: &Tool) -> Row {
    let mut row = Row::new(format!("ours → {}", tool.name));
    let (_process, port) = Process::server(tool);
    for mode in ["auto", "multiple", "single"] {
        let ours = Ours::open(port, &format!("write_with = \"{mode}\""));
        for (column, point) in [("1", "c0"), ("2", "discrete"), ("3", "h124"), ("4", "input")] {
            let came = ours.until(point, || ours.value(point).is_ok());
            row.add(column, came);
        }
        let beyond = ours.until("exception 2", || ours.value("beyond") == Err(NoData::DeviceError(2)));
        row.add("exceptions", beyond);
        // Another value in each mode, so that each really writes.
        let v = mode.len() as f64;
        let (bit, register) = if mode == "multiple" { ("15", "16") } else { ("5", "6") };
        row.add(bit, ours.write(&named(&[("c7", 1.0)])));
        row.add(bit, ours.write(&named(&[("c7", 0.0)])));
        row.add(register, ours.write(&named(&[("h10", 40_000.0 + v)])));
        row.add("16", ours.write(&named(&[("f32", -2.5 - v), ("i32", -70_000.0 - v)])));
        row.add("22", ours.write(&named(&[("bit", 1.0), ("field", v)])));
        row.add("22", ours.write(&named(&[("bit", 0.0)])));
        if mode != "single" {
            let registers: Vec<_> = (0..125).map(|n| (format!("h{n}"), 100.0 * v + f64::from(n))).collect();
            row.add("limits", ours.write(&registers));
            let coils: Vec<_> = (0..2000)
                .map(|n| (format!("c{n}"), f64::from(u8::from((n + mode.len()) % 3 == 0))))
                .collect();
            row.add("limits", ours.write(&coils));
            row.add("15", ours.write(&named(&[("c1", 1.0), ("c2", 1.0), ("c3", 0.0)])));
        }
    }
    let ours = Ours::open(port, "write_with = \"read-write\"");
    ours.until("h0", || ours.value("h0").is_ok());
    // Node's server has no function 23; the client says so in words.
    if tool.name == "modbus-serial" {
        row.add("23", Verdict::Missing);
    } else {
        row.add("23", ours.write(&named(&[("h20", 7.0), ("h21", 8.0), ("f32", 99.5)])));
    }
    row
}
