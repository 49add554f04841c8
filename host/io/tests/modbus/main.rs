//! The Modbus driver against a device that misbehaves on demand.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests"
)]

mod errands;
mod losses;
mod peer;
mod scan;
mod transports;

use std::{
    net::SocketAddr,
    time::{Duration, Instant},
};

use bumpless_core::{LoopId, NoData, PointId, Quality, Reading};
use bumpless_io::{BusStatus, Clock, Config, Error, IoServer, PointIndex, WriteStamp};
use peer::{Manner, Peer, Reserved, Seen};
use tokio::runtime::Runtime;

/// How long a test waits for something that must come; reached only when it fails.
const LONGEST: Duration = Duration::from_secs(20);

struct Bench {
    server: IoServer,
    peer: Peer,
    /// Ends after the server.
    runtime: Runtime,
}

fn runtime() -> Runtime {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap()
}

fn open(runtime: &Runtime, address: SocketAddr, bus: &str, points: &str) -> IoServer {
    let text = format!(
        "[[bus]]\nid = \"line\"\ndriver = \"modbus-tcp\"\naddress = \"{address}\"\nperiod_ms = 5\ntimeout_ms = 1000\n\
         backoff_ms_min = 10\nbackoff_ms_max = 40\n{bus}\n{points}"
    );
    let config: Config = toml::from_str(&text).unwrap_or_else(|e| panic!("{text}\n{e}"));
    IoServer::open(&config, Clock::start(), runtime.handle()).unwrap()
}

impl Bench {
    fn start(bus: &str, points: &str) -> Self {
        let peer = Peer::start();
        Self::start_with(peer, bus, points)
    }

    fn start_with(peer: Peer, bus: &str, points: &str) -> Self {
        let runtime = runtime();
        Self {
            server: open(&runtime, peer.address, bus, points),
            peer,
            runtime,
        }
    }

    /// The host starts and loses patience with an address at which nobody listens, `before` happens, and then the device
    /// comes to life.
    fn start_without_device(bus: &str, points: &str, point: &str, before: impl FnOnce(&IoServer)) -> Self {
        let (runtime, reserved) = (runtime(), Reserved::new());
        let server = open(&runtime, reserved.address, bus, points);
        let index = server.index(&PointId::new(point).unwrap()).expect(point);
        eventually(
            || (server.read_one(index, 0).value == Err(NoData::CommsLost)).then_some(()),
            || format!("{:?}", server.status()),
        );
        before(&server);
        Self {
            server,
            peer: reserved.listen(&runtime),
            runtime,
        }
    }

    fn index(&self, point: &str) -> PointIndex {
        self.server.index(&PointId::new(point).unwrap()).expect(point)
    }

    fn read(&self, point: &str) -> Reading {
        self.server.read_one(self.index(point), self.server.clock().now_ns())
    }

    fn write(&self, writes: &[(&str, f64)]) -> Result<(), Error> {
        write(&self.server, writes)
    }

    fn status(&self) -> BusStatus {
        self.server.status().remove(0)
    }

    /// Waits until the point reads so.
    fn until(&self, point: &str, value: Result<f64, NoData>) -> Reading {
        self.eventually(&format!("{point} = {value:?}"), || {
            let reading = self.read(point);
            (reading.value == value).then_some(reading)
        })
    }

    fn eventually<T>(&self, what: &str, seen: impl FnMut() -> Option<T>) -> T {
        eventually(seen, || format!("{what}; {:?}", self.status()))
    }

    fn next_write(&self) -> Seen {
        self.peer
            .writes
            .recv_timeout(LONGEST)
            .unwrap_or_else(|_| panic!("no write came; {:?}", self.status()))
    }
}

fn write(server: &IoServer, writes: &[(&str, f64)]) -> Result<(), Error> {
    let index = |point: &str| server.index(&PointId::new(point).unwrap()).expect(point);
    let writes: Vec<_> = writes.iter().map(|(point, value)| (index(point), *value)).collect();
    let stamp = WriteStamp {
        loop_id: LoopId::new("x").unwrap(),
        term: 1,
        seq: 1,
    };
    server.write(&writes, &stamp, server.clock().now_ns())
}

fn eventually<T>(mut seen: impl FnMut() -> Option<T>, what: impl Fn() -> String) -> T {
    let started = Instant::now();
    loop {
        if let Some(found) = seen() {
            return found;
        }
        assert!(started.elapsed() < LONGEST, "it never came: {}", what());
        std::thread::park_timeout(Duration::from_millis(1));
    }
}

fn point(id: &str, table: &str, address: u16, rest: &str) -> String {
    format!("[[bus.point]]\nid = \"{id}\"\ntable = \"{table}\"\naddress = {address}\n{rest}\n")
}

const WIDE: &str = "low = -1e6\nhigh = 1e6\n";
const HUNDRED: &str = "low = 0.0\nhigh = 100.0\nwritable = true\n";

#[test]
fn every_type_and_table_is_read() {
    let points = [
        point("u16", "input", 0, WIDE),
        point(
            "i16",
            "input",
            1,
            &format!("type = \"i16\"\nscale = 0.1\noffset = 5.0\n{WIDE}"),
        ),
        point("f32", "holding", 2, &format!("type = \"f32\"\n{WIDE}")),
        point(
            "swapped",
            "holding",
            4,
            &format!("type = \"i32\"\nword_order = \"low-first\"\n{WIDE}"),
        ),
        point(
            "ma",
            "input",
            6,
            "raw = [4000.0, 20000.0]\nsignal = \"4-20ma\"\nlow = 0.0\nhigh = 2.5\n",
        ),
        point(
            "broken",
            "input",
            7,
            "raw = [4000.0, 20000.0]\nsignal = \"4-20ma\"\nlow = 0.0\nhigh = 2.5\n",
        ),
        point("nan", "holding", 8, &format!("type = \"f32\"\n{WIDE}")),
        point("coil", "coil", 9, ""),
        point("discrete", "discrete", 20, ""),
        point("far", "input", 900, "low = 0.0\nhigh = 10.0\n"),
    ]
    .concat();
    let peer = Peer::start();
    peer.set_words(
        0,
        &[1234, 0xFFF6, 0x42F6, 0xE979, 0xFFFE, 0xFFFF, 12_000, 100, 0x7FC0, 0],
    );
    peer.set_words(900, &[77]);
    peer.device.lock().unwrap().bits[9] = true;
    let bench = Bench::start_with(peer, "", &points);
    for (point, value) in [
        ("u16", Ok(1234.0)),
        ("i16", Ok(4.0)),
        ("f32", Ok(f64::from(123.456_f32))),
        ("swapped", Ok(-2.0)),
        ("ma", Ok(1.25)),
        ("broken", Err(NoData::OutOfRange)),
        ("nan", Err(NoData::NotFinite)),
        ("coil", Ok(1.0)),
        ("discrete", Ok(0.0)),
    ] {
        bench.until(point, value);
    }
    // Beyond its range, but all we know.
    assert_eq!(bench.until("far", Ok(77.0)).quality, Quality::Uncertain);
    let first = bench.until("u16", Ok(1234.0));
    assert!(first.fresh && first.quality == Quality::Good && first.at_ns <= bench.server.clock().now_ns());
    bench.eventually("a newer sample", || {
        (bench.read("u16").at_ns > first.at_ns).then_some(())
    });
    let status = bench.status();
    assert!(
        status.connected && status.polls >= 4 && status.connections == 1,
        "{status:?}"
    );
}

#[test]
fn writes_use_the_right_function_and_join_neighbours() {
    let points = [
        point("a", "holding", 0, &format!("scale = 0.01\n{HUNDRED}")),
        point("b", "holding", 1, &format!("scale = 0.01\n{HUNDRED}")),
        point("c", "holding", 2, &format!("type = \"f32\"\n{HUNDRED}")),
        point("d", "holding", 10, &format!("type = \"i16\"\n{HUNDRED}")),
        point("e", "coil", 5, "writable = true\n"),
        point("f", "coil", 6, "writable = true\n"),
    ]
    .concat();
    let bench = Bench::start("", &points);
    bench.until("a", Ok(0.0));
    bench.write(&[("d", 42.0)]).unwrap();
    assert_eq!(bench.next_write(), (1, vec![6, 0, 10, 0, 42]));
    bench.until("d", Ok(42.0));
    bench.write(&[("e", 1.0)]).unwrap();
    assert_eq!(bench.next_write(), (1, vec![5, 0, 5, 0xFF, 0]));
    bench.write(&[("c", 1.0)]).unwrap();
    assert_eq!(bench.next_write(), (1, vec![16, 0, 2, 0, 2, 4, 0x3F, 0x80, 0, 0]));
    // What the device holds is not sent again; what changes is.
    bench.until("c", Ok(1.0));
    bench.write(&[("d", 42.0), ("c", 2.0)]).unwrap();
    assert_eq!(bench.next_write(), (1, vec![16, 0, 2, 0, 2, 4, 0x40, 0, 0, 0]));
    bench.until("c", Ok(2.0));
    bench.eventually("the count", || (bench.status().writes == 4).then_some(()));
    let refused = bench.write(&[("a", 50.0), ("b", 100.5)]).unwrap_err().to_string();
    assert_eq!(refused, "point b: 100.5 is outside 0 to 100; nothing was written");
    assert_eq!(bench.read("a").value, Ok(0.0));
}

#[test]
fn a_device_that_forgets_is_told_again() {
    let bench = Bench::start("", &point("a", "holding", 0, HUNDRED));
    bench.until("a", Ok(0.0));
    bench.write(&[("a", 30.0)]).unwrap();
    assert_eq!(bench.next_write().1, [6, 0, 0, 0, 30]);
    bench.until("a", Ok(30.0));
    // It starts again, or somebody turns the knob: the loop's next write goes out though its value is the same.
    bench.peer.set_words(0, &[0]);
    bench.until("a", Ok(0.0));
    bench.write(&[("a", 30.0)]).unwrap();
    assert_eq!(bench.next_write().1, [6, 0, 0, 0, 30]);
}

#[test]
fn values_that_wait_together_go_together() {
    let points = [
        point("a", "holding", 0, HUNDRED),
        point("b", "holding", 1, HUNDRED),
        point("c", "holding", 3, HUNDRED),
        point("e", "coil", 5, "writable = true\n"),
        point("f", "coil", 6, "writable = true\n"),
    ]
    .concat();
    // Nobody answers at first, so that all of it waits; the expiry is far.
    let peer = Peer::start();
    peer.behave(Manner::Closes);
    let bench = Bench::start_with(peer, "write_expiry_ms = 60000", &points);
    bench.until("a", Err(NoData::CommsLost));
    bench
        .write(&[("a", 1.0), ("b", 2.0), ("c", 3.0), ("e", 1.0), ("f", 1.0)])
        .unwrap();
    bench.write(&[("a", 10.0)]).unwrap();
    bench.peer.behave(Manner::Good);
    let mut seen = [bench.next_write().1, bench.next_write().1, bench.next_write().1];
    seen.sort();
    // The latest value of each: coils 5 and 6 by function 15, registers 0 and 1 by 16, register 3 by 6.
    assert_eq!(
        seen,
        [
            vec![6, 0, 3, 0, 3],
            vec![15, 0, 5, 0, 2, 1, 0b11],
            vec![16, 0, 0, 0, 2, 4, 0, 10, 0, 2]
        ]
    );
    bench.until("a", Ok(10.0));
}

#[test]
fn old_wishes_are_given_up() {
    let bench = Bench::start_without_device(
        "write_expiry_ms = 0",
        &point("a", "holding", 0, HUNDRED),
        "a",
        |server| {
            write(server, &[("a", 66.0)]).unwrap();
        },
    );
    bench.until("a", Ok(0.0));
    assert!(bench.peer.writes.try_recv().is_err());
    assert!(bench.status().last_error.unwrap().contains("given up"));
}

#[test]
fn exceptions_are_named_and_end() {
    let points = point("a", "holding", 0, HUNDRED);
    let bench = Bench::start("", &points);
    bench.until("a", Ok(0.0));
    bench.peer.behave(Manner::Exception(4));
    let reading = bench.until("a", Err(NoData::DeviceError(4)));
    assert_eq!((reading.quality, reading.last_good), (Quality::Bad, 0.0));
    let status = bench.status();
    assert!(status.connected, "an exception is an answer");
    assert_eq!(
        status.last_error.unwrap(),
        "unit 1, holding registers 0 to 0: exception 4, server device failure"
    );
    bench.peer.behave(Manner::Good);
    bench.until("a", Ok(0.0));

    bench.peer.behave(Manner::WriteException(3));
    bench.write(&[("a", 5.0)]).unwrap();
    assert_eq!(bench.next_write().1, [6, 0, 0, 0, 5]);
    bench.eventually("the refused write", || {
        let text = bench.status().last_error.unwrap_or_default();
        (text == "write to point a, unit 1, holding registers 0: exception 3, illegal data value").then_some(())
    });
    // The same value is tried again when the loop writes it again: the device does not hold it.
    bench.peer.behave(Manner::Good);
    bench.write(&[("a", 5.0)]).unwrap();
    assert_eq!(bench.next_write().1, [6, 0, 0, 0, 5]);
    bench.until("a", Ok(5.0));
    assert_eq!(bench.status().connections, 1);
}

#[test]
fn a_device_that_fails_is_lost_and_found_again() {
    let bench = Bench::start("", &point("a", "input", 0, "type = \"u32\"\nlow = 0.0\nhigh = 100.0\n"));
    bench.peer.set_words(0, &[0, 7]);
    for (manner, part) in [
        (Manner::Silent, "no answer within 1000 ms"),
        (Manner::Closes, "closed the connection"),
        (Manner::WrongTransaction, "no answer within 1000 ms"),
        (Manner::Short, "another length"),
        (
            Manner::Garbage,
            "unit 1, input registers 0 to 1: the stream is no Modbus",
        ),
    ] {
        bench.until("a", Ok(7.0));
        bench.peer.behave(manner);
        let lost = bench.until("a", Err(NoData::CommsLost));
        assert_eq!(
            (lost.last_good, lost.quality, lost.fresh),
            (7.0, Quality::Bad, false),
            "{manner:?}"
        );
        let status = bench.eventually("the status", || Some(bench.status()).filter(|s| !s.connected));
        assert!(
            status.last_error.as_ref().unwrap().contains(part),
            "{manner:?}: {status:?}"
        );
        bench.peer.behave(Manner::Good);
    }
    bench.until("a", Ok(7.0));
    bench.peer.behave(Manner::Dribbling);
    let before = bench.read("a").at_ns;
    bench.eventually("a sample in pieces", || {
        (bench.read("a").at_ns > before + 50_000_000).then_some(())
    });
    bench.until("a", Ok(7.0));
    assert!(bench.status().errors >= 5);
}

#[test]
fn a_silent_unit_leaves_its_neighbours_in_peace() {
    let points = [
        point("one", "input", 0, "unit_id = 1\nlow = 0.0\nhigh = 100.0\n"),
        point("two", "input", 0, "unit_id = 2\nlow = 0.0\nhigh = 100.0\n"),
    ]
    .concat();
    let peer = Peer::start();
    peer.set_words(0, &[9]);
    let bench = Bench::start_with(peer, "", &points);
    bench.until("two", Ok(9.0));
    bench.peer.behave(Manner::SilentUnit(2));
    bench.until("two", Err(NoData::CommsLost));
    let before = bench.read("one").at_ns;
    // The neighbour goes on being read, time-out after time-out of the other.
    bench.eventually("ten more samples", || {
        (bench.read("one").at_ns > before + 1_000_000_000).then_some(())
    });
    bench.until("one", Ok(9.0));
    assert_eq!(bench.read("two").value, Err(NoData::CommsLost));
    bench.peer.behave(Manner::Good);
    bench.until("two", Ok(9.0));
}

#[test]
fn a_device_that_refuses_gaps_is_read_without_them() {
    let points = [
        point("a", "input", 0, "low = 0.0\nhigh = 100.0\n"),
        point("b", "input", 5, "low = 0.0\nhigh = 100.0\n"),
        point("c", "input", 6, "low = 0.0\nhigh = 100.0\n"),
    ]
    .concat();
    let peer = Peer::start();
    peer.set_words(0, &[1, 0, 0, 0, 0, 2, 3]);
    peer.behave(Manner::RefusesGaps);
    let bench = Bench::start_with(peer, "", &points);
    for (point, value) in [("a", 1.0), ("b", 2.0), ("c", 3.0)] {
        bench.until(point, Ok(value));
    }
    assert_eq!((bench.status().errors, bench.status().connections), (0, 1));
}

#[test]
fn close_sends_what_waits_and_then_the_safe_values() {
    let points = [
        point("a", "holding", 0, &format!("safe = 12.0\n{HUNDRED}")),
        point("e", "coil", 5, "writable = true\nsafe = 0.0\n"),
    ]
    .concat();
    let bench = Bench::start("on_stop = \"safe\"", &points);
    bench.until("a", Ok(0.0));
    bench.write(&[("a", 90.0), ("e", 1.0)]).unwrap();
    bench.until("a", Ok(90.0));
    bench.until("e", Ok(1.0));
    bench.server.close();
    let device = bench.peer.device.lock().unwrap();
    assert_eq!((device.words[0], device.bits[5]), (12, false));
    drop(device);
    assert!(!bench.status().connected);
    assert_eq!(
        bench.write(&[("a", 1.0)]).unwrap_err().to_string(),
        "the I/O of this host is closed; nothing was written"
    );
}

#[test]
fn close_can_hold() {
    let bench = Bench::start("", &point("a", "holding", 0, HUNDRED));
    bench.until("a", Ok(0.0));
    bench.write(&[("a", 90.0)]).unwrap();
    bench.server.close();
    assert_eq!(
        bench.peer.device.lock().unwrap().words[0],
        90,
        "what waited was sent before the end"
    );
}

#[test]
fn nobody_at_the_address_is_no_error_of_the_host() {
    let (runtime, reserved) = (runtime(), Reserved::new());
    let address = reserved.address;
    let text = format!(
        "[[bus]]\nid = \"plant\"\ndriver = \"sim\"\n[[bus]]\nid = \"line\"\ndriver = \"modbus-tcp\"\naddress = \"{address}\"\n{}",
        point("a", "holding", 0, HUNDRED)
    );
    let config: Config = toml::from_str(&text).unwrap();
    let server = IoServer::open(&config, Clock::start(), runtime.handle()).unwrap();
    let a = server.index(&PointId::new("a").unwrap()).unwrap();
    let seen = || match server.read_one(a, server.clock().now_ns()).value {
        Err(NoData::NeverRead) => None,
        value => Some(value),
    };
    assert_eq!(
        eventually(seen, || format!("{:?}", server.status())),
        Err(NoData::CommsLost)
    );
    let level = server.index(&PointId::new("plant.lit125").unwrap()).unwrap();
    assert!(server.read_one(level, server.clock().now_ns()).value.is_ok());
    let status = server.status();
    assert!(status[0].connected && !status[1].connected);
    assert!(
        status[1]
            .last_error
            .as_ref()
            .unwrap()
            .starts_with(&format!("{address}: ")),
        "{status:?}"
    );
    server.close();
}
