//! A server's registers against a cell that exists only in memory.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests"
)]

use std::sync::Arc;

use bumpless_core::{Digest, HostId, LoopId, NoData, PointId, Record};
use bumpless_io::modbus::server::{Masks, answer};
use parking_lot::Mutex;

use super::*;
use crate::{config::ModbusServerConfig, plant::Later};

/// `here` is a point of this host, `there` one of another; the loop `x` has two outputs.
struct Memory {
    here: Mutex<Reading>,
    there: Mutex<Option<Reading>>,
    record: Arc<Record>,
    age: Mutex<Duration>,
    commands: Mutex<Vec<(LoopId, CommandBody)>>,
    writes: Mutex<Vec<(PointId, f64, String)>>,
    refused: Mutex<Vec<(String, String)>>,
    refusal: Mutex<Option<Error>>,
}

fn record() -> Record {
    let host = HostId::new("h").unwrap();
    Record {
        loop_id: LoopId::new("x").unwrap(),
        term: 1,
        seq: 5,
        after: (1, 4),
        revision: 1,
        digest: Digest::of(b"component"),
        owner: host.clone(),
        home: host.clone(),
        stepped_by: host,
        redundancy: bumpless_core::redundancy::Redundancy::default(),
        at_ns: 10,
        dt_ns: 100_000_000,
        mode: Mode::Automatic,
        setpoint: 40.0,
        manual: vec![1.0, 2.0],
        readings: Vec::new(),
        heard: Vec::new(),
        wanted: vec![11.0, 12.0],
        outputs: vec![11.0, 12.0],
        state: Arc::from([]),
        faults_in_row: 0,
        probation: None,
        applied: Vec::new(),
        events: Vec::new(),
        alarms: Vec::new(),
        messages: Vec::new(),
        log: Vec::new(),
        step_ns: 0,
        cycle_ns: 0,
        committed_after_ns: 0,
    }
}

impl Plant for Memory {
    fn point_here(&self, point: &PointId) -> Option<Aged> {
        (point.as_str() == "here").then(|| (*self.here.lock(), Duration::from_millis(30)))
    }

    fn last(&self, id: &LoopId) -> Option<(Arc<Record>, Duration)> {
        (id.as_str() == "x").then(|| (Arc::clone(&self.record), *self.age.lock()))
    }

    fn points_elsewhere(&self, points: Vec<PointId>) -> Later<Vec<Option<Aged>>> {
        let there = *self.there.lock();
        let one = |point: PointId| there.filter(|_| point.as_str() == "there").map(|r| (r, Duration::ZERO));
        let answer = points.into_iter().map(one).collect();
        Box::pin(std::future::ready(answer))
    }

    fn command(&self, id: LoopId, body: CommandBody, _client: String) -> Later<Result<(), Error>> {
        self.commands.lock().push((id, body));
        let end = self.refusal.lock().clone().map_or(Ok(()), Err);
        Box::pin(std::future::ready(end))
    }

    fn write_point(&self, point: PointId, value: f64, client: String) -> Later<Result<(), Error>> {
        self.writes.lock().push((point, value, client));
        Box::pin(std::future::ready(Ok(())))
    }

    fn refused(&self, _server: String, asked: String, reason: String, _client: String) -> Later<()> {
        self.refused.lock().push((asked, reason));
        Box::pin(std::future::ready(()))
    }
}

const MAP: &str = r#"
listen = "127.0.0.1:0"
unit_ids = [1]
[[map]]
table = "input"
address = 0
point = "here"
[[map]]
table = "input"
address = 1
point = "here"
item = "quality"
[[map]]
table = "input"
address = 2
point = "here"
item = "age-ms"
[[map]]
table = "input"
address = 3
point = "there"
[[map]]
table = "input"
address = 4
point = "nowhere"
item = "quality"
[[map]]
table = "holding"
address = 0
loop = "x"
writable = true
[[map]]
table = "holding"
address = 1
loop = "x"
item = "mode"
writable = true
[[map]]
table = "holding"
address = 2
loop = "x"
item = "output"
output = 1
writable = true
[[map]]
table = "holding"
address = 3
point = "here"
writable = true
[[map]]
table = "holding"
address = 4
loop = "gone"
writable = true
"#;

struct Bench {
    plant: Arc<Memory>,
    face: Face,
    runtime: tokio::runtime::Runtime,
}

impl Bench {
    fn new() -> Self {
        let config: ModbusServerConfig = toml::from_str(MAP).unwrap();
        let plant = Arc::new(Memory {
            here: Mutex::new(Reading::good(7.0, 1)),
            there: Mutex::new(Some(Reading::good(9.0, 1))),
            record: Arc::new(record()),
            age: Mutex::new(Duration::from_millis(20)),
            commands: Mutex::default(),
            writes: Mutex::default(),
            refused: Mutex::default(),
            refusal: Mutex::default(),
        });
        let identity = Identity::new(["maker", "code", "1", "", "", "", ""]);
        let map = Map::new(&config).unwrap();
        let face = Face::new("test".into(), map, plant.clone(), identity, Duration::from_millis(50));
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .unwrap();
        Self { plant, face, runtime }
    }

    fn ask(&self, pdu: &[u8]) -> Vec<u8> {
        let client = Client {
            address: ([192, 0, 2, 9], 4711).into(),
            role: None,
        };
        self.runtime
            .block_on(answer(&self.face, &Masks::default(), &client, 1, pdu))
    }
}

#[test]
fn points_here_and_there_are_read_with_quality_and_age() {
    let bench = Bench::new();
    assert_eq!(bench.ask(&[4, 0, 0, 0, 3]), [4, 6, 0, 7, 0, 2, 0, 30]);
    // Another host's point is not known until it was looked at.
    assert_eq!(bench.ask(&[4, 0, 3, 0, 1]), [0x84, 4]);
    bench.runtime.block_on(bench.face.refresh());
    assert_eq!(bench.ask(&[4, 0, 3, 0, 1]), [4, 2, 0, 9]);
    assert_eq!(
        bench.ask(&[4, 0, 4, 0, 1]),
        [4, 2, 0, 0],
        "a point that nobody has is bad"
    );
    *bench.plant.here.lock() = Reading::missing(NoData::CommsLost, 7.0, 1);
    assert_eq!(
        bench.ask(&[4, 0, 0, 0, 1]),
        [0x84, 4],
        "nothing is passed off as a measurement"
    );
    assert_eq!(bench.ask(&[4, 0, 1, 0, 1]), [4, 2, 0, 0]);
    // The other host falls silent: its copy is kept for a while, and then lost.
    *bench.plant.there.lock() = None;
    bench.runtime.block_on(bench.face.refresh());
    assert_eq!(bench.ask(&[4, 0, 3, 0, 1]), [4, 2, 0, 9]);
    for copy in bench.face.copies.write().iter_mut().flatten() {
        copy.at -= Duration::from_secs(60);
    }
    assert_eq!(bench.ask(&[4, 0, 3, 0, 1]), [0x84, 4]);
}

#[test]
fn loops_are_read_and_commanded() {
    let bench = Bench::new();
    assert_eq!(bench.ask(&[3, 0, 0, 0, 3]), [3, 6, 0, 40, 0, 1, 0, 12]);
    assert_eq!(bench.ask(&[16, 0, 0, 0, 3, 6, 0, 55, 0, 0, 0, 77]), [16, 0, 0, 0, 3]);
    let x = LoopId::new("x").unwrap();
    assert_eq!(
        *bench.plant.commands.lock(),
        [
            (x.clone(), CommandBody::Setpoint(55.0)),
            (x.clone(), CommandBody::Mode(Mode::Manual)),
            // The other output stays where the operator has put it.
            (x, CommandBody::Output(vec![1.0, 77.0])),
        ]
    );
    assert_eq!(bench.ask(&[6, 0, 3, 0, 33]), [6, 0, 3, 0, 33]);
    let by = "192.0.2.9:4711".to_owned();
    assert_eq!(*bench.plant.writes.lock(), [(PointId::new("here").unwrap(), 33.0, by)]);
    // Silence of the loop is not its last setpoint.
    *bench.plant.age.lock() = Duration::from_secs(60);
    assert_eq!(bench.ask(&[3, 0, 0, 0, 1]), [0x83, 4]);
    assert_eq!(bench.ask(&[3, 0, 4, 0, 1]), [0x83, 4]);
}

#[test]
fn refusals_of_the_cell_become_exceptions() {
    let bench = Bench::new();
    for (error, code) in [
        (Error::invalid("x", ""), 3),
        (Error::refused("x", ""), 4),
        (Error::not_found("x", ""), 4),
        (Error::busy("x", ""), 6),
        (Error::unreachable("x", ""), 11),
        (Error::timeout("x", ""), 11),
    ] {
        *bench.plant.refusal.lock() = Some(error);
        assert_eq!(bench.ask(&[6, 0, 0, 0, 5]), [0x86, code]);
    }
    assert!(
        bench.plant.refused.lock().is_empty(),
        "the cell writes down what it refuses itself"
    );
    // What is refused before the cell is asked does nothing of a longer write.
    bench.plant.commands.lock().clear();
    assert_eq!(bench.ask(&[16, 0, 0, 0, 2, 4, 0, 5, 0, 9]), [0x90, 3]);
    assert!(bench.plant.commands.lock().is_empty());
    let refused = bench.plant.refused.lock();
    assert!(refused.len() == 1 && refused[0].0.contains("Registers"), "{refused:?}");
}
