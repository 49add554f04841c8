//! The server with simulated buses, and what it says of bad configurations and bad writes.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use bumpless_core::{NoData, Quality};

use super::*;
use crate::sim::{FopdtSettings, NoModels, SimConfig};

mod by_hand;

const MS: u64 = 1_000_000;

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap()
}

fn open(text: &str) -> Result<IoServer, Error> {
    let config: Config = toml::from_str(text).expect("the test's TOML");
    IoServer::open(&config, Clock::start(), runtime().handle())
}

fn stamp() -> WriteStamp {
    WriteStamp {
        loop_id: LoopId::new("pressure").unwrap(),
        term: 2,
        seq: 9,
    }
}

fn index(server: &IoServer, point: &str) -> PointIndex {
    server.index(&PointId::new(point).unwrap()).expect(point)
}

const PLANT: &str = "[[bus]]\nid = \"plant\"\ndriver = \"sim\"\nplant = { noise = 0.0, adc_bits = 16 }\n";

#[test]
fn the_plant_is_a_table_of_points() {
    let server = open(PLANT).unwrap();
    let names: Vec<&str> = server.points().iter().map(|p| p.id.as_str()).collect();
    assert!(names.starts_with(&[
        "plant.pit118",
        "plant.pit129",
        "plant.fit116",
        "plant.lit125",
        "plant.tit127",
        "plant.lsl110"
    ]));
    let pit118 = server.info(index(&server, "plant.pit118")).unwrap();
    assert_eq!(
        (pit118.unit.as_str(), pit118.low, pit118.high, pit118.writable),
        ("bar", 0.0, 2.5, false)
    );
    assert_eq!(
        server.info(index(&server, "plant.lsl110")).unwrap().kind,
        PortKind::Digital
    );
    for (position, point) in server.points().iter().enumerate() {
        assert_eq!(server.index(&point.id).unwrap().position(), position);
    }
    assert_eq!(server.index(&PointId::new("plant.nothing").unwrap()), None);
}

#[test]
fn writes_act_readings_follow_and_a_broken_wire_is_seen() {
    let server = open(PLANT).unwrap();
    let start_ns = server.clock().now_ns();
    let (pit118, p2, wire) = (
        index(&server, "plant.pit118"),
        index(&server, "plant.p2"),
        index(&server, "plant.pit118.break"),
    );
    let mut readings = vec![Reading::unconnected(); 7];
    server.read(&[Some(pit118), None, Some(p2)], start_ns, &mut readings);
    assert_eq!(readings.len(), 3);
    assert!(readings[0].value.unwrap().abs() < 0.001 && readings[0].fresh && readings[0].quality == Quality::Good);
    assert_eq!(readings[1], Reading::unconnected());
    assert_eq!(readings[2].value, Ok(0.0));

    server.write(&[(p2, 8.0)], &stamp(), start_ns).unwrap();
    let later_ns = start_ns + 10_000 * MS;
    server.read(&[Some(pit118), Some(p2)], later_ns, &mut readings);
    assert!(readings[0].value.unwrap() > 0.7, "{readings:?}");
    assert_eq!(readings[1].value, Ok(8.0));
    assert!(readings[0].at_ns <= later_ns && later_ns - readings[0].at_ns <= MS);

    let held = readings[0].value.unwrap();
    server.write(&[(wire, 1.0)], &stamp(), later_ns).unwrap();
    server.read(&[Some(pit118)], later_ns, &mut readings);
    assert_eq!(
        (readings[0].value, readings[0].quality, readings[0].fresh),
        (Err(NoData::OutOfRange), Quality::Bad, false)
    );
    assert!((readings[0].last_good - held).abs() < 0.01);
}

#[test]
fn one_bad_write_stops_all_and_says_why() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("writes.csv");
    let server = open(&format!("{PLANT}journal = {path:?}\n")).unwrap();
    let (p1, p2, pit118) = (
        index(&server, "plant.p1"),
        index(&server, "plant.p2"),
        index(&server, "plant.pit118"),
    );
    let cases: [(&[(PointIndex, f64)], &str); 6] = [
        (
            &[(p1, 5.0), (p2, 10.1)],
            "point plant.p2: 10.1 V is outside 0 to 10; nothing was written",
        ),
        (
            &[(p2, -0.1), (p1, 5.0)],
            "point plant.p2: -0.1 V is outside 0 to 10; nothing was written",
        ),
        (
            &[(p1, 5.0), (p2, f64::NAN)],
            "point plant.p2: NaN is no number to write; nothing was written",
        ),
        (
            &[(p1, f64::INFINITY)],
            "point plant.p1: inf is no number to write; nothing was written",
        ),
        (
            &[(p1, 5.0), (pit118, 1.0)],
            "point plant.pit118 is an input and cannot be written; connect the output port to a writable point",
        ),
        (
            &[(p1, 5.0), (PointIndex(999), 1.0)],
            "point number 999 does not exist on this host; ask for its index again",
        ),
    ];
    let now_ns = server.clock().now_ns();
    for (writes, message) in cases {
        let error = server.write(writes, &stamp(), now_ns).unwrap_err();
        assert_eq!(error.to_string(), message);
        assert_eq!(server.read_one(p1, now_ns).value, Ok(0.0), "{message}");
    }
    server
        .write(&[(p1, 1.0), (p2, 2.5), (p1, 3.0)], &stamp(), now_ns)
        .unwrap();
    assert_eq!(
        server.read_one(p1, now_ns).value,
        Ok(3.0),
        "the last value of a point counts"
    );
    server.close();
    assert_eq!(
        server.write(&[(p1, 1.0)], &stamp(), now_ns).unwrap_err().to_string(),
        "the I/O of this host is closed; nothing was written"
    );
    assert_eq!(server.read_one(p2, now_ns).value, Ok(2.5), "on_stop = hold");
    let status = server.status();
    assert_eq!(
        (status[0].writes, status[0].errors, status[0].journal_dropped),
        (3, 10, 0)
    );

    let text = std::fs::read_to_string(&path).unwrap();
    let taken: Vec<String> = text
        .lines()
        .filter(|l| !l.starts_with('#'))
        .skip(1)
        .map(str::to_owned)
        .collect();
    let expected =
        [("p1", "1"), ("p2", "2.5"), ("p1", "3")].map(|(p, v)| format!("{now_ns},plant.{p},{v},pressure,2,9"));
    assert_eq!(taken, expected);
    assert_eq!(text.lines().filter(|l| l.starts_with("#refused,")).count(), 10);
    assert_eq!(text.lines().last(), Some("#dropped,0"));
}

#[test]
fn close_can_bring_outputs_to_rest() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("writes.csv");
    let server = open(&format!("{PLANT}on_stop = \"safe\"\njournal = {path:?}\n")).unwrap();
    let (p2, hv123) = (index(&server, "plant.p2"), index(&server, "plant.hv123"));
    let now_ns = server.clock().now_ns();
    server.write(&[(p2, 7.0), (hv123, 33.0)], &stamp(), now_ns).unwrap();
    server.close();
    server.close();
    assert_eq!(server.read_one(p2, now_ns).value, Ok(0.0));
    assert_eq!(
        server.read_one(hv123, now_ns).value,
        Ok(33.0),
        "a disturbance is nobody's output"
    );
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains(",plant.p2,0,on-stop,0,0"), "{text}");
}

#[test]
fn same_seed_times_and_writes_give_the_same_readings() {
    let trace = |seed: u64| {
        let config = SimConfig {
            seed,
            ..SimConfig::pilot_plant(BusId::new("plant").unwrap())
        };
        let (driver, infos) = SimDriver::open(&config, 1_000, &NoModels).unwrap();
        let p2 = infos.iter().position(|p| p.id.as_str() == "plant.p2").unwrap();
        let mut values = Vec::new();
        for n in 0..300_u64 {
            let now_ns = 1_000 + n * 37 * MS;
            if n % 10 == 0 {
                driver.write(std::iter::once(Put::plain(p2, (n % 90) as f64 / 9.0)), &stamp(), now_ns);
            }
            values.extend((0..6).map(|point| driver.read(point, now_ns).value_or_last().to_bits()));
        }
        values
    };
    assert_eq!(trace(1), trace(1));
    assert_ne!(trace(1), trace(2));
}

#[test]
fn after_a_long_pause_the_plant_goes_on_from_where_it_stood() {
    let config = SimConfig::pilot_plant(BusId::new("plant").unwrap());
    let (driver, infos) = SimDriver::open(&config, 0, &NoModels).unwrap();
    let level = infos.iter().position(|p| p.id.as_str() == "plant.lit125").unwrap();
    let hour_ns = 3_600_000 * MS;
    let reading = driver.read(level, hour_ns);
    // The tank drained for 20 s, not for an hour; the time of validity is now.
    assert!(reading.value.unwrap() > 20.0, "{reading:?}");
    assert_eq!(reading.at_ns, hour_ns);
    // A time before the last one gives no reading from the future.
    assert_eq!(driver.read(level, hour_ns - 5 * MS).at_ns, hour_ns - 5 * MS);
}

#[test]
fn thousands_of_first_order_loops() {
    let settings = FopdtSettings {
        count: 2000,
        gain: 2.0,
        tau_s: 1.0,
        dead_time_s: 0.5,
        noise: 0.0,
    };
    let config = Config {
        buses: vec![BusConfig::Sim(SimConfig::first_order(
            BusId::new("bench").unwrap(),
            settings,
        ))],
    };
    let server = IoServer::open(&config, Clock::start(), runtime().handle()).unwrap();
    assert_eq!(server.points().len(), 6000);
    let now_ns = server.clock().now_ns();
    server
        .write(&[(index(&server, "bench.1999.out"), 10.0)], &stamp(), now_ns)
        .unwrap();
    let pv = |n: u32, ms: u64| {
        server
            .read_one(index(&server, &format!("bench.{n}.pv")), now_ns + ms * MS)
            .value
            .unwrap()
    };
    assert!(pv(1999, 500).abs() < 1e-9);
    assert!((pv(1999, 20_000) - 20.0).abs() < 1e-6);
    assert!(pv(1998, 20_000).abs() < 1e-9);
    server
        .write(
            &[(index(&server, "bench.1999.load"), -5.0)],
            &stamp(),
            now_ns + 20_000 * MS,
        )
        .unwrap();
    assert!((pv(1999, 60_000) - 15.0).abs() < 1e-6);
}

#[test]
fn bad_configurations_are_refused_with_place_and_cure() {
    let point = "[[bus.point]]\nid = \"l.x\"\n";
    let modbus = |bus: &str, rest: &str| {
        format!("[[bus]]\nid = \"l\"\ndriver = \"modbus-tcp\"\naddress = \"127.0.0.1:502\"\n{bus}{point}{rest}")
    };
    let range = "low = 0.0\nhigh = 1.0\n";
    let cases = [
        (format!("{PLANT}{PLANT}"), r#"bus "plant": two buses have this id"#),
        (format!("{PLANT}fopdt = {{}}\n"), "exclude each other"),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"sim\"\nplant = { adc_bits = 2 }\n".into(),
            "adc_bits must be 8 to 24",
        ),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"sim\"\nplant = { water_l = 200.0 }\n".into(),
            "20 to 80 litres",
        ),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"sim\"\nfopdt = { count = 0 }\n".into(),
            "fopdt.count must be 1 to",
        ),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"sim\"\nfopdt = { tau_s = 0.0 }\n".into(),
            "fopdt.tau_s must be greater than 0",
        ),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"sim\"\nfopdt = { dead_time_s = -1.0 }\n".into(),
            "fopdt.dead_time_s must be 0 to 600",
        ),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"sim\"\nfopdt = { gain = nan }\n".into(),
            "fopdt.gain must be",
        ),
        (
            format!("[[bus]]\nid = \"{}\"\ndriver = \"sim\"\n", "p".repeat(60)),
            "shorten the bus's id",
        ),
        (
            "[[bus]]\nid = \"l\"\ndriver = \"modbus-tcp\"\naddress = \"127.0.0.1:502\"\n".into(),
            "has no points",
        ),
        (
            "[[bus]]\nid = \"l\"\ndriver = \"modbus-tcp\"\naddress = \"127.0.0.1\"\n".into(),
            r#"bus "l": address "127.0.0.1" must be host:port"#,
        ),
        (
            modbus("timeout_ms = 5\n", "table = \"input\"\naddress = 0\n"),
            "timeout_ms = 5 must be 10 to 60000",
        ),
        (
            modbus("backoff_ms_min = 9000\n", "table = \"input\"\naddress = 0\n"),
            "backoff_ms_min = 9000 <= backoff_ms_max = 5000",
        ),
        (
            modbus("gap_max = 500\n", "table = \"input\"\naddress = 0\n"),
            "gap_max = 500 must be at most 125",
        ),
        (
            modbus("period_ms = 1\n", &format!("table = \"input\"\naddress = 0\n{range}")),
            "period_ms = 1 must be 5 to",
        ),
        (
            modbus("", "table = \"input\"\naddress = 0\n"),
            r#"bus "l", point "l.x": low and high are needed"#,
        ),
        (
            modbus("", "table = \"input\"\naddress = 0\nlow = 1.0\nhigh = 1.0\n"),
            "low < high",
        ),
        (
            modbus("", "table = \"coil\"\naddress = 0\nlow = 0.0\nhigh = 5.0\n"),
            "a bool's range is 0 to 1",
        ),
        (
            modbus("", "table = \"coil\"\naddress = 0\ntype = \"u16\"\n"),
            "coils are bits; use type = \"bool\"",
        ),
        (
            modbus("", "table = \"coil\"\naddress = 0\nscale = 2.0\n"),
            "a bool has no scaling",
        ),
        (
            modbus(
                "",
                &format!("table = \"input\"\naddress = 65535\ntype = \"f32\"\n{range}"),
            ),
            "no room for 2 registers",
        ),
        (
            modbus("", &format!("table = \"input\"\naddress = 0\nwritable = true\n{range}")),
            "input registers cannot be written",
        ),
        (
            modbus("", &format!("table = \"input\"\naddress = 0\nscale = 0.0\n{range}")),
            "scale must not be 0",
        ),
        (
            modbus(
                "",
                &format!("table = \"input\"\naddress = 0\nraw = [3.0, 3.0]\n{range}"),
            ),
            "two different numbers",
        ),
        (
            modbus(
                "",
                &format!("table = \"input\"\naddress = 0\nraw = [0.0, 1.0]\nscale = 1.0\n{range}"),
            ),
            "exclude each other",
        ),
        (
            modbus(
                "",
                &format!("table = \"input\"\naddress = 0\nsignal = \"4-20ma\"\n{range}"),
            ),
            "signal needs raw =",
        ),
        (
            modbus(
                "",
                "table = \"holding\"\naddress = 0\nwritable = true\nscale = 0.001\nlow = 0.0\nhigh = 100.0\n",
            ),
            "becomes raw 0 to 100000, which type U16 cannot hold",
        ),
        (
            modbus(
                "",
                &format!("table = \"holding\"\naddress = 0\nwritable = true\nsafe = 2.0\n{range}"),
            ),
            "safe = 2 must lie in 0 to 1",
        ),
        (
            modbus(
                "on_stop = \"safe\"\n",
                &format!("table = \"holding\"\naddress = 0\nwritable = true\n{range}"),
            ),
            "give each writable point its safe value",
        ),
        (
            modbus(
                "",
                &format!("table = \"input\"\naddress = 0\n{range}{point}table = \"input\"\naddress = 1\n{range}"),
            ),
            r#"point "l.x": bus "l" has a point of this id"#,
        ),
    ];
    for (text, part) in cases {
        let error = open(&text).expect_err(&text).to_string();
        assert!(error.contains(part), "{text}\nsays {error:?}\nwanted {part:?}");
        assert!(!error.ends_with('.'), "{error}");
    }
}

#[test]
fn text_that_is_no_configuration_is_refused_by_its_keys() {
    let cases = [
        (
            "[[bus]]\nid = \"p\"\ndriver = \"sim\"\nsped = 1\n",
            "unknown field `sped`",
        ),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"profibus\"\n",
            "unknown variant `profibus`",
        ),
        ("[[bus]]\ndriver = \"sim\"\n", "missing field `id`"),
        ("[[bus]]\nid = \"P 1\"\ndriver = \"sim\"\n", "lower-case"),
        ("[[buss]]\nid = \"p\"\n", "unknown field `buss`"),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"sim\"\nfopdt = { cont = 1 }\n",
            "unknown field `cont`",
        ),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"modbus-tcp\"\naddress = \"a:1\"\n[[bus.point]]\nid = \"x\"\ntable = \"inputs\"\naddress = 1\n",
            "unknown variant `inputs`",
        ),
        (
            "[[bus]]\nid = \"p\"\ndriver = \"modbus-tcp\"\naddress = \"a:1\"\n[[bus.point]]\nid = \"x\"\ntable = \"input\"\naddress = 70000\n",
            "70000",
        ),
    ];
    for (text, part) in cases {
        let error = toml::from_str::<Config>(text).expect_err(text).to_string();
        assert!(error.contains(part), "{text}\nsays {error}");
    }
}

#[test]
fn configurations_that_are_shown_to_people_work() {
    // The rustdoc of a module, without its comment marks, from one fence to the next.
    let shown = |source: &str| -> Vec<String> {
        let text: String = source
            .lines()
            .filter_map(|line| {
                line.trim_start()
                    .strip_prefix("//!")
                    .or(line.trim_start().strip_prefix("///"))
            })
            .map(|line| format!("{}\n", line.strip_prefix(' ').unwrap_or(line)))
            .collect();
        text.split("```toml\n")
            .skip(1)
            .filter_map(|rest| rest.split("```").next().map(str::to_owned))
            .collect()
    };
    let folder = tempfile::tempdir().unwrap();
    let journal = folder.path().join("writes.csv");
    let mut texts = vec![include_str!("../../../../examples/modbus-plant/host.toml").to_owned()];
    for source in [
        include_str!("../config.rs"),
        include_str!("../sim.rs"),
        include_str!("../modbus.rs"),
    ] {
        texts.extend(shown(source));
    }
    assert_eq!(texts.len(), 7);
    for text in texts {
        let text = text.replace("\"writes.csv\"", &format!("{journal:?}"));
        match open(&text) {
            Ok(server) => assert!(!server.points().is_empty()),
            // All of it is understood; only who makes plants from components is not here.
            Err(error) if text.contains("plant = \"component:") => {
                assert!(error.to_string().contains("can be made here"), "{text}\n{error}");
            }
            Err(error) => panic!("{text}\n{error}"),
        }
    }
}
