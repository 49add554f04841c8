//! Over TLS, over a serial line, and over several connections: the same driver, the same server.

use std::{
    net::SocketAddr,
    os::fd::OwnedFd,
    path::{Path, PathBuf},
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use bumpless_core::NoData;
use bumpless_io::{
    Clock, Config, IoServer,
    modbus::{
        Exception, ServerTls, Table,
        frame::with_checksum,
        server::{Client, Identity, Registers, ServerCounts, ServerOptions, Write, Writing, serve},
    },
};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use tokio::{runtime::Runtime, sync::watch};

use crate::{
    Bench, HUNDRED, eventually,
    peer::{Manner, Peer},
    point, runtime,
};

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/modbus/tls")
        .join(name)
}

/// Every register is its own address.
struct Counting(Identity);

impl Registers for Counting {
    fn unit(&self, _: u8) -> Result<(), Exception> {
        Ok(())
    }
    fn bits(&self, _: Table, _: u16, count: u16) -> Result<Vec<bool>, Exception> {
        Ok(vec![true; usize::from(count)])
    }
    fn words(&self, _: Table, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        Ok((start..).take(usize::from(count)).collect())
    }
    fn write(&self, client: &Client, _: Write) -> Writing {
        let end = match client.role.as_deref() {
            Some("operator") => Ok(()),
            _ => Err(Exception::FUNCTION),
        };
        Box::pin(std::future::ready(end))
    }
    fn admits(&self, client: &Client) -> Result<(), Exception> {
        match client.role.as_deref() {
            Some("stranger") => Err(Exception::FUNCTION),
            _ => Ok(()),
        }
    }
    fn identity(&self) -> &Identity {
        &self.0
    }
}

struct Secured {
    runtime: Runtime,
    address: SocketAddr,
    counts: Arc<ServerCounts>,
    _stop: watch::Sender<bool>,
}

fn secured() -> Secured {
    let runtime = runtime();
    let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
    let address = listener.local_addr().unwrap();
    let tls = ServerTls {
        certificate: file("device.pem"),
        key: file("device.key"),
        client_ca: file("plant.pem"),
    };
    let (stop, stopping) = watch::channel(false);
    let counts = Arc::new(ServerCounts::default());
    let options = ServerOptions {
        name: "secured".to_owned(),
        connections_max: 4,
        idle: Duration::from_secs(5),
        tls: Some(tls.open("the test").unwrap()),
    };
    let registers = Arc::new(Counting(Identity::new([""; 7])));
    runtime.spawn(serve(listener, options, registers, counts.clone(), stopping));
    Secured {
        runtime,
        address,
        counts,
        _stop: stop,
    }
}

fn over_tls(address: SocketAddr, tls: &str) -> String {
    format!(
        "[[bus]]\nid = \"line\"\ndriver = \"modbus-tcp\"\naddress = \"{address}\"\nperiod_ms = 5\nbackoff_ms_min = 10\n\
         backoff_ms_max = 40\n[bus.tls]\n{tls}\n{}",
        point("a", "input", 42, "low = 0.0\nhigh = 100.0\n")
    )
}

fn keys(ca: &str, own: &str) -> String {
    let (ca, certificate, key) = (file(ca), file(&format!("{own}.pem")), file(&format!("{own}.key")));
    format!("ca = {ca:?}\ncertificate = {certificate:?}\nkey = {key:?}")
}

fn open(runtime: &Runtime, text: &str) -> IoServer {
    let config: Config = toml::from_str(text).unwrap_or_else(|error| panic!("{text}\n{error}"));
    IoServer::open(&config, Clock::start(), runtime.handle()).unwrap()
}

fn read(server: &IoServer) -> Result<f64, NoData> {
    let index = server.index(&bumpless_core::PointId::new("a").unwrap()).unwrap();
    server.read_one(index, server.clock().now_ns()).value
}

#[test]
fn tls_both_ways_lets_in_who_shows_a_certificate() {
    let server = secured();
    let good = open(&server.runtime, &over_tls(server.address, &keys("plant.pem", "host")));
    eventually(
        || (read(&good) == Ok(42.0)).then_some(()),
        || format!("{:?}", good.status()),
    );
    // The name in the certificate may be another than the address.
    let named = format!("{}\nserver_name = \"device.example\"", keys("plant.pem", "host"));
    let named = open(&server.runtime, &over_tls(server.address, &named));
    eventually(
        || (read(&named) == Ok(42.0)).then_some(()),
        || format!("{:?}", named.status()),
    );
    let requests = server.counts.requests.load(Ordering::Relaxed);
    assert!(requests >= 2);
    // A stranger, nobody at all, a device of another authority, a device of another name, and no TLS at all.
    let plain = over_tls(server.address, "").replace("[bus.tls]\n\n", "");
    for (text, part) in [
        (over_tls(server.address, &keys("plant.pem", "stranger")), ""),
        (over_tls(server.address, &format!("ca = {:?}", file("plant.pem"))), ""),
        (
            over_tls(server.address, &keys("elsewhere.pem", "host")),
            "TLS: invalid peer certificate: UnknownIssuer; check tls.ca",
        ),
        (
            over_tls(
                server.address,
                &format!("{}\nserver_name = \"other\"", keys("plant.pem", "host")),
            ),
            "TLS: invalid peer certificate",
        ),
        (plain, ""),
    ] {
        let refused = open(&server.runtime, &text);
        let said = eventually(
            || refused.status()[0].last_error.clone(),
            || format!("{text}\n{:?}", refused.status()),
        );
        assert!(said.contains(part), "{part}: {said}");
        assert_ne!(read(&refused), Ok(42.0), "{text}");
    }
    assert!(server.counts.malformed.load(Ordering::Relaxed) >= 3);
    assert_eq!(read(&good), Ok(42.0), "the others were not disturbed");
}

#[test]
fn the_role_in_a_certificate_says_who_may_write() {
    let server = secured();
    for (name, said) in [
        ("operator", None),
        ("viewer", Some("exception 1, illegal function")),
        ("host", Some("exception 1, illegal function")),
    ] {
        let text = over_tls(server.address, &keys("plant.pem", name)) + &point("b", "holding", 7, HUNDRED);
        let ours = open(&server.runtime, &text);
        eventually(
            || (read(&ours) == Ok(42.0)).then_some(()),
            || format!("{name}: {:?}", ours.status()),
        );
        crate::write(&ours, &[("b", 33.0)]).unwrap();
        let ended = eventually(
            || {
                let status = ours.status().remove(0);
                (status.writes == 1 || status.last_error.is_some()).then_some(status)
            },
            || format!("{name}: {:?}", ours.status()),
        );
        match said {
            None => assert_eq!((ended.writes, ended.last_error), (1, None), "{name}"),
            Some(part) => {
                let error = ended.last_error.unwrap_or_default();
                assert!(error.contains(part) && ended.writes == 0, "{name}: {error}");
            }
        }
    }
}

#[test]
fn files_of_tls_are_named_with_their_cure() {
    let runtime = runtime();
    let address: SocketAddr = ([127, 0, 0, 1], 802).into();
    let ca = format!("ca = {:?}", file("plant.pem"));
    let missing = file("nowhere.pem");
    for (tls, parts) in [
        (format!("ca = {missing:?}"), ["tls.ca", "cannot be read"]),
        (
            format!("ca = {:?}", file("device.key")),
            ["tls.ca", "BEGIN CERTIFICATE"],
        ),
        (
            format!("{ca}\ncertificate = {:?}", file("host.pem")),
            ["tls.certificate and tls.key", "give both or none"],
        ),
        (
            format!(
                "{ca}\ncertificate = {:?}\nkey = {:?}",
                file("host.pem"),
                file("host.pem")
            ),
            ["tls.key", "unencrypted PRIVATE KEY"],
        ),
        (
            format!(
                "{ca}\ncertificate = {:?}\nkey = {:?}",
                file("host.pem"),
                file("device.key")
            ),
            ["tls.key", "use the key that"],
        ),
        (
            format!("{ca}\nserver_name = \"a b\""),
            ["\"a b\"", "set tls.server_name"],
        ),
    ] {
        let config: Config = toml::from_str(&over_tls(address, &tls)).unwrap();
        let error = IoServer::open(&config, Clock::start(), runtime.handle())
            .unwrap_err()
            .to_string();
        assert!(parts.iter().all(|part| error.contains(part)), "{parts:?}: {error}");
        assert!(error.starts_with("bus \"line\": "), "{error}");
    }
}

/// A device on the other end of a line that exists only in memory: register n holds n; the first answer of each ten is
/// damaged.
fn device_on_a_line() -> (OwnedFd, String) {
    let near = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&near).unwrap();
    unlockpt(&near).unwrap();
    let name = ptsname(&near, Vec::new()).unwrap().into_string().unwrap();
    (near, name)
}

fn serve_line(line: &OwnedFd, stop: &std::sync::atomic::AtomicBool) {
    let (mut buffer, mut piece, mut count) = (Vec::new(), [0; 256], 0);
    let mut words = [0_u16; 100];
    words[42] = 42;
    while !stop.load(Ordering::Acquire) {
        let mut ready = [rustix::event::PollFd::new(line, rustix::event::PollFlags::IN)];
        let tick = rustix::event::Timespec {
            tv_sec: 0,
            tv_nsec: 10_000_000,
        };
        if rustix::event::poll(&mut ready, Some(&tick)).unwrap_or(0) == 0 {
            continue;
        }
        // Nobody has the other end open yet, or no more.
        let Ok(read) = rustix::io::read(line, &mut piece) else {
            std::thread::park_timeout(Duration::from_millis(5));
            continue;
        };
        buffer.extend_from_slice(&piece[..read]);
        while buffer.len() >= 8 {
            let request: Vec<u8> = buffer.drain(..8).collect();
            let (start, value) = (usize::from(request[3]), u16::from_be_bytes([request[4], request[5]]));
            let pdu = match request[1] {
                6 => {
                    words[start] = value;
                    request[1..6].to_vec()
                }
                function => {
                    let data: Vec<u8> = words[start..start + usize::from(value)]
                        .iter()
                        .flat_map(|word| word.to_be_bytes())
                        .collect();
                    [&[function, data.len() as u8], data.as_slice()].concat()
                }
            };
            let mut frame = with_checksum(request[0], &pdu);
            count += 1;
            if count % 10 == 1 {
                frame[2] ^= 1;
            }
            let _ = rustix::io::write(line, &frame);
        }
    }
}

#[test]
fn a_serial_line_is_read_written_and_bears_noise() {
    let (line, name) = device_on_a_line();
    let stop = std::sync::atomic::AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| serve_line(&line, &stop));
        let runtime = runtime();
        let text = format!(
            "[[bus]]\nid = \"line\"\ndriver = \"modbus-rtu\"\ndevice = \"{name}\"\nbaud = 115200\nperiod_ms = 10\n\
             timeout_ms = 100\nretries = 2\n{}{}",
            point("a", "input", 42, "low = 0.0\nhigh = 100.0\n"),
            point("b", "holding", 7, HUNDRED)
        );
        let server = open(&runtime, &text);
        eventually(
            || (read(&server) == Ok(42.0)).then_some(()),
            || format!("{:?}", server.status()),
        );
        crate::write(&server, &[("b", 33.0)]).unwrap();
        let b = server.index(&bumpless_core::PointId::new("b").unwrap()).unwrap();
        let written =
            || server.read_one(b, server.clock().now_ns()).value == Ok(33.0) && server.status()[0].writes == 1;
        eventually(|| written().then_some(()), || format!("{:?}", server.status()));
        eventually(
            || (server.status()[0].polls > 60).then_some(()),
            || format!("{:?}", server.status()),
        );
        let status = server.status().remove(0);
        assert!(
            status.retries >= 5,
            "the damaged answers were asked for again: {status:?}"
        );
        assert_eq!(
            (status.errors, status.connections, status.driver),
            (0, 1, "modbus-rtu"),
            "{status:?}"
        );
        // The line belongs to one program.
        let second = open(&runtime, &text);
        let said = eventually(|| second.status()[0].last_error.clone(), || "no error".to_owned());
        assert!(said.contains("another program uses the line"), "{said}");
        second.close();
        server.close();
        stop.store(true, Ordering::Release);
    });
}

#[test]
fn frames_of_a_line_pass_through_tcp() {
    let peer = Peer::start();
    peer.behave(Manner::Rtu);
    peer.set_words(0, &[5]);
    let bench = Bench::start_with(peer, "framing = \"rtu\"", &point("a", "holding", 0, HUNDRED));
    bench.until("a", Ok(5.0));
    bench.write(&[("a", 50.0)]).unwrap();
    assert_eq!(bench.next_write(), (1, vec![6, 0, 0, 0, 50]));
    bench.until("a", Ok(50.0));
    assert_eq!(bench.status().connections, 1);
}

#[test]
fn units_share_connections_and_a_silent_one_holds_up_only_its_own() {
    let unit = |n: u8| {
        point(
            &format!("u{n}"),
            "input",
            0,
            &format!("unit_id = {n}\nlow = 0.0\nhigh = 100.0\n"),
        )
    };
    let points: String = (1..=4).map(unit).collect();
    let peer = Peer::start();
    peer.set_words(0, &[9]);
    let bench = Bench::start_with(peer, "connections = 2", &points);
    for n in 1..=4 {
        bench.until(&format!("u{n}"), Ok(9.0));
    }
    assert_eq!(bench.status().connections, 2);
    bench.peer.behave(Manner::SilentUnit(2));
    bench.until("u2", Err(NoData::CommsLost));
    // Units 1 and 3 have the other connection: while unit 2 is waited for, they are read on, many times per time-out.
    let before = bench.status().polls;
    bench.eventually("forty polls more", || {
        (bench.status().polls > before + 40).then_some(())
    });
    assert_eq!(bench.read("u1").value, Ok(9.0));
    assert!(bench.status().connected);
}

#[test]
fn bits_of_a_register_are_written_alone_with_or_without_function_22() {
    let points = [
        point("flag", "holding", 3, "bit = 15\nwritable = true\n"),
        point(
            "speed",
            "holding",
            3,
            "bits = [4, 3]\nlow = 0.0\nhigh = 7.0\nwritable = true\n",
        ),
    ]
    .concat();
    for with_mask in [true, false] {
        let peer = Peer::start();
        peer.set_words(3, &[0x0F0F]);
        peer.behave(if with_mask { Manner::Good } else { Manner::WithoutMask });
        let bench = Bench::start_with(peer, "verify = true", &points);
        bench.until("speed", Ok(0.0));
        bench.write(&[("flag", 1.0), ("speed", 5.0)]).unwrap();
        bench.eventually("both", || (bench.status().writes == 2).then_some(()));
        assert_eq!(bench.peer.device.lock().unwrap().words[3], 0x8F5F);
        let function = bench.next_write().1[0];
        assert_eq!(function, if with_mask { 22 } else { 6 });
        bench.until("flag", Ok(1.0));
        assert_eq!(bench.status().errors, 0);
    }
}

#[test]
fn a_device_that_confirms_and_forgets_is_found_out() {
    let peer = Peer::start();
    peer.behave(Manner::Forgets);
    let bench = Bench::start_with(peer, "verify = true", &point("a", "holding", 0, HUNDRED));
    bench.until("a", Ok(0.0));
    bench.write(&[("a", 30.0)]).unwrap();
    bench.eventually("the error", || {
        let said = bench.status().last_error?;
        said.contains("the device holds [0] after it confirmed").then_some(())
    });
    assert_eq!(bench.status().writes, 0);
    // It mends its ways; the same value is sent again, for nobody took it as known.
    bench.peer.behave(Manner::Good);
    bench.write(&[("a", 30.0)]).unwrap();
    bench.until("a", Ok(30.0));
    bench.eventually("the write", || (bench.status().writes == 1).then_some(()));
}
