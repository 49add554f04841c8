//! Our server, asked by other people's clients.

use std::{
    io::{Read as _, Write as _},
    net::{SocketAddr, TcpStream},
    path::PathBuf,
    sync::{Arc, Mutex},
    time::Duration,
};

use bumpless_io::modbus::{
    Exception, ServerTls, Table,
    server::{Client, Identity, Registers, ServerCounts, ServerOptions, Write, Writing, serve},
};
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::{
    Row, Verdict,
    tools::{Process, Tool, certificates, mbpoll, mbpoll_unit},
};

/// From here on, the address tells the exception that a read of it gets.
const EXCEPTIONS: u16 = 4000;
/// The unit that a gateway would not reach.
const AWAY: u8 = 7;

/// 3,000 addresses in each table.
struct Memory {
    bits: Mutex<[Vec<bool>; 2]>,
    words: Mutex<[Vec<u16>; 2]>,
    identity: Identity,
    /// Only clients with the role of an operator write.
    by_role: bool,
}

impl Memory {
    fn new(by_role: bool) -> Self {
        Self {
            by_role,
            bits: Mutex::new([
                (0..3000).map(|n| n % 3 == 0).collect(),
                (0..3000).map(|n| n % 2 == 0).collect(),
            ]),
            words: Mutex::new([(0..3000).collect(), (1000..4000).collect()]),
            identity: Identity::new(["maker", "code", "1", "", "", "", ""]),
        }
    }
}

fn cut<T: Clone>(all: &[T], start: u16, count: u16) -> Result<Vec<T>, Exception> {
    if start > EXCEPTIONS {
        return Err(Exception((start - EXCEPTIONS) as u8));
    }
    let start = usize::from(start);
    all.get(start..start + usize::from(count))
        .map(<[T]>::to_vec)
        .ok_or(Exception::ADDRESS)
}

impl Registers for Memory {
    fn unit(&self, unit: u8) -> Result<(), Exception> {
        if unit == AWAY { Err(Exception::TARGET) } else { Ok(()) }
    }

    fn bits(&self, table: Table, start: u16, count: u16) -> Result<Vec<bool>, Exception> {
        cut(
            &self.bits.lock().unwrap()[usize::from(table == Table::Discrete)],
            start,
            count,
        )
    }

    fn words(&self, table: Table, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        cut(
            &self.words.lock().unwrap()[usize::from(table == Table::Input)],
            start,
            count,
        )
    }

    fn write(&self, client: &Client, write: Write) -> Writing {
        if self.by_role && client.role.as_deref() != Some("operator") {
            return Box::pin(std::future::ready(Err(Exception::FUNCTION)));
        }
        let end = match write {
            Write::Coils { start, bits } => {
                let at = usize::from(start);
                let mut held = self.bits.lock().unwrap();
                held[0]
                    .get_mut(at..at + bits.len())
                    .map(|own| own.copy_from_slice(&bits))
            }
            Write::Registers { start, words } => {
                let at = usize::from(start);
                let mut held = self.words.lock().unwrap();
                held[0]
                    .get_mut(at..at + words.len())
                    .map(|own| own.copy_from_slice(&words))
            }
        };
        Box::pin(std::future::ready(end.ok_or(Exception::ADDRESS)))
    }

    fn identity(&self) -> &Identity {
        &self.identity
    }
}

/// A server at work.
struct Served {
    address: SocketAddr,
    stop: watch::Sender<bool>,
    _runtime: tokio::runtime::Runtime,
}

impl Served {
    fn start(tls: Option<ServerTls>) -> Self {
        let secured = tls.is_some();
        let tls = tls.map(|tls| tls.open("the matrix").unwrap());
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
        let address = listener.local_addr().unwrap();
        let (stop, stopping) = watch::channel(false);
        let options = ServerOptions {
            name: "matrix".to_owned(),
            connections_max: 8,
            idle: Duration::from_secs(60),
            tls,
        };
        runtime.spawn(serve(
            listener,
            options,
            Arc::new(Memory::new(secured)),
            Arc::new(ServerCounts::default()),
            stopping,
        ));
        Self {
            address,
            stop,
            _runtime: runtime,
        }
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        self.stop.send_replace(true);
    }
}

fn judged(got: &Value, wanted: &Value) -> Verdict {
    if got.get("missing").is_some() {
        Verdict::Missing
    } else if got == wanted {
        Verdict::Good
    } else {
        Verdict::Bad(format!("{got} instead of {wanted}"))
    }
}

/// Operations with their columns and what must come of them.
fn operations() -> Vec<(&'static str, Value, Value)> {
    let bits = |values: &[u8]| json!({ "values": values });
    let words = |values: &[u16]| json!({ "values": values });
    let done = || json!({ "done": true });
    let on = |n: usize| u16::from(n.is_multiple_of(3));
    let many: Vec<u16> = (0..2000).map(on).collect();
    let long: Vec<u16> = (0..1968).map(|n| u16::from(n % 5 == 0)).collect();
    let block: Vec<u16> = (0..123).map(|n| 60_000 + n).collect();
    vec![
        (
            "1",
            json!(["read", "coil", 0, 10]),
            bits(&[1, 0, 0, 1, 0, 0, 1, 0, 0, 1]),
        ),
        ("2", json!(["read", "discrete", 3, 3]), bits(&[0, 1, 0])),
        ("3", json!(["read", "holding", 5, 3]), words(&[5, 6, 7])),
        ("4", json!(["read", "input", 7, 2]), words(&[1007, 1008])),
        ("5", json!(["write-coil", 1, 1]), done()),
        ("5", json!(["write-coil", 0, 0]), done()),
        ("5", json!(["read", "coil", 0, 2]), bits(&[0, 1])),
        ("6", json!(["write-register", 100, 0xBEEF]), done()),
        ("6", json!(["read", "holding", 99, 3]), words(&[99, 0xBEEF, 101])),
        ("15", json!(["write-coils", 10, [1, 0, 1, 1, 0, 1, 1, 1, 1]]), done()),
        (
            "15",
            json!(["read", "coil", 9, 11]),
            bits(&[1, 1, 0, 1, 1, 0, 1, 1, 1, 1, 0]),
        ),
        ("16", json!(["write-registers", 110, [1, 2, 65535]]), done()),
        (
            "16",
            json!(["read", "holding", 109, 5]),
            words(&[109, 1, 2, 65535, 113]),
        ),
        ("22", json!(["mask", 120, 0xF2, 0x25]), done()),
        ("22", json!(["read", "holding", 120, 1]), words(&[0x75])),
        ("23", json!(["read-write", 130, 2, 131, [7]]), words(&[130, 7])),
        ("limits", json!(["write-coils", 0, many[..1968]]), done()),
        (
            "limits",
            json!(["read", "coil", 0, 1968]),
            json!({ "values": many[..1968] }),
        ),
        (
            "limits",
            json!(["read", "discrete", 1000, 2000]),
            json!({ "values": (0..2000).map(|n| u16::from(n % 2 == 0)).collect::<Vec<_>>() }),
        ),
        ("limits", json!(["write-coils", 1000, long]), done()),
        ("limits", json!(["read", "coil", 1000, 1968]), json!({ "values": long })),
        ("limits", json!(["write-registers", 300, block]), done()),
        (
            "limits",
            json!(["read", "holding", 300, 123]),
            json!({ "values": block }),
        ),
        (
            "limits",
            json!(["read", "input", 0, 125]),
            json!({ "values": (1000..1125).collect::<Vec<_>>() }),
        ),
        (
            "exceptions",
            json!(["read", "holding", 2999, 2]),
            json!({ "exception": 2 }),
        ),
        (
            "exceptions",
            json!(["write-register", 3000, 1]),
            json!({ "exception": 2 }),
        ),
        (
            "exceptions",
            json!(["write-coils", 2999, [1, 1]]),
            json!({ "exception": 2 }),
        ),
        (
            "exceptions",
            json!(["read", "input", EXCEPTIONS + 1, 1]),
            json!({ "exception": 1 }),
        ),
        (
            "exceptions",
            json!(["read", "input", EXCEPTIONS + 3, 1]),
            json!({ "exception": 3 }),
        ),
        (
            "exceptions",
            json!(["read", "coil", EXCEPTIONS + 4, 1]),
            json!({ "exception": 4 }),
        ),
        (
            "exceptions",
            json!(["read", "input", EXCEPTIONS + 5, 1]),
            json!({ "exception": 5 }),
        ),
        (
            "exceptions",
            json!(["read", "holding", EXCEPTIONS + 6, 1]),
            json!({ "exception": 6 }),
        ),
        (
            "exceptions",
            json!(["read", "input", EXCEPTIONS + 8, 1]),
            json!({ "exception": 8 }),
        ),
        (
            "exceptions",
            json!(["read", "input", EXCEPTIONS + 10, 1]),
            json!({ "exception": 10 }),
        ),
        (
            "exceptions",
            json!(["read", "discrete", EXCEPTIONS + 11, 1]),
            json!({ "exception": 11 }),
        ),
    ]
}

/// Nonsense from other connections, while the peer's own stays open.
fn nonsense(address: SocketAddr) {
    for bytes in [
        &b"GET / HTTP/1.1\r\n\r\n"[..],
        &[0, 1, 0, 0, 0xFF, 0xFF, 1, 3],
        &[0, 1, 0, 0, 0, 1, 1],
        &[0, 1, 0, 0, 0, 200, 1, 3, 0],
        &[0x80; 300],
    ] {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        let _ = stream.write_all(bytes);
        // Closed, or left waiting for the rest; both are right.
        let _ = stream.read(&mut [0; 16]);
    }
    // A request with a count that lies gets an exception, and the connection goes on.
    let mut stream = TcpStream::connect(address).unwrap();
    for _ in 0..2 {
        stream.write_all(&[0, 1, 0, 0, 0, 7, 1, 16, 0, 0, 0, 9, 2]).unwrap();
        let mut answer = [0; 9];
        stream.read_exact(&mut answer).unwrap();
        assert_eq!(answer[7..], [0x90, 3]);
    }
}

/// Requests one beyond each limit, and what a peer's client may call them.
fn over() -> Vec<(Value, Vec<u8>)> {
    let read = |function: u8, count: u16| {
        let [high, low] = count.to_be_bytes();
        vec![function, 0, 0, high, low]
    };
    let words: Vec<u16> = vec![1; 124];
    let bits: Vec<u16> = vec![1; 1969];
    // The bytes of 124 registers do not fit in a request, so they say that they are 248, and fewer come; those of 1,969 coils fit.
    let sixteen = [vec![16, 0, 0, 0, 124, 248], vec![0; 246]].concat();
    let fifteen = [vec![15, 0, 0, 0x07, 0xB1, 247], vec![0; 247]].concat();
    let both = [vec![23, 0, 0, 0, 126, 0, 0, 0, 1, 2], vec![0; 2]].concat();
    vec![
        (json!(["read", "coil", 0, 2001]), read(1, 2001)),
        (json!(["read", "discrete", 0, 2001]), read(2, 2001)),
        (json!(["read", "holding", 0, 126]), read(3, 126)),
        (json!(["read", "input", 0, 126]), read(4, 126)),
        (json!(["write-registers", 0, words]), sixteen),
        (json!(["write-coils", 0, bits]), fifteen),
        (json!(["read-write", 0, 126, 0, [7]]), both),
    ]
}

/// The answer to one request's bytes, on a connection of its own.
fn raw(address: SocketAddr, pdu: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(Duration::from_secs(5)))?;
    let [high, low] = (pdu.len() as u16 + 1).to_be_bytes();
    stream.write_all(&[&[0, 9, 0, 0, high, low, 1], pdu].concat())?;
    let mut answer = [0; 9];
    stream.read_exact(&mut answer)?;
    Ok(answer[7..].to_vec())
}

/// Beyond the limits: exception 3, from the peer's client where it sends such a thing, and from the bare bytes.
fn over_the_limits(client: &mut Process, address: SocketAddr) -> Verdict {
    for (operation, pdu) in over() {
        let told = client.ask(&operation);
        // Most clients count for themselves, and say so in their own words.
        if told.get("error").is_none() && told != json!({ "exception": 3 }) {
            let short: String = operation.to_string().chars().take(60).collect();
            return Verdict::Bad(format!("{short}: {told} instead of exception 3"));
        }
        match raw(address, &pdu) {
            Ok(answer) if answer == [pdu[0] | 0x80, 3] => {}
            other => return Verdict::Bad(format!("function {} over its limit: {other:?}", pdu[0])),
        }
    }
    Verdict::Good
}

fn asked(row: &mut Row, client: &mut Process) {
    for (column, operation, wanted) in operations() {
        let got = client.ask(&operation);
        let verdict = match judged(&got, &wanted) {
            Verdict::Bad(problem) => Verdict::Bad(format!("{operation}: {problem}").chars().take(300).collect()),
            other => other,
        };
        row.add(column, verdict);
    }
}

/// A peer's client against our server.
pub(crate) fn against(tool: &Tool) -> Row {
    let served = Served::start(None);
    let mut row = Row::new(format!("{} → ours", tool.name));
    let mut client = Process::client(tool, served.address.port(), 1);
    asked(&mut row, &mut client);
    let over = over_the_limits(&mut client, served.address);
    row.add("over", over);
    nonsense(served.address);
    // One that had to be told of its own mistakes may have closed its connection over them.
    let mut client = Process::client(tool, served.address.port(), 1);
    let got = client.ask(&json!(["read", "holding", 5, 1]));
    row.add("malformed", judged(&got, &json!({ "values": [5] })));
    let mut away = Process::client(tool, served.address.port(), AWAY);
    let got = away.ask(&json!(["read", "holding", 5, 1]));
    row.add("unit", judged(&got, &json!({ "exception": 11 })));
    row
}

/// A peer's client against our server, over TLS: with a role that may write, and with none.
pub(crate) fn against_over_tls(tool: &Tool) -> Row {
    let folder = PathBuf::from(certificates());
    let served = Served::start(Some(ServerTls {
        certificate: folder.join("device.pem"),
        key: folder.join("device.key"),
        client_ca: folder.join("plant.pem"),
    }));
    let mut row = Row::new(format!("{}, TLS → ours", tool.name));
    let port = served.address.port();
    asked(&mut row, &mut Process::client_over_tls(tool, port, 1, "operator"));
    let mut viewer = Process::client_over_tls(tool, port, 1, "viewer");
    let got = viewer.ask(&json!(["read", "holding", 5, 1]));
    row.add("3", judged(&got, &json!({ "values": [5] })));
    for write in [
        json!(["write-register", 5, 1]),
        json!(["write-coils", 5, [1, 1]]),
        json!(["mask", 5, 0, 1]),
        json!(["read-write", 5, 1, 5, [9]]),
    ] {
        let got = viewer.ask(&write);
        row.add("exceptions", judged(&got, &json!({ "exception": 1 })));
    }
    let got = viewer.ask(&json!(["read", "holding", 5, 1]));
    row.add("exceptions", judged(&got, &json!({ "values": [5] })));
    let mut away = Process::client_over_tls(tool, port, AWAY, "operator");
    let got = away.ask(&json!(["read", "holding", 5, 1]));
    row.add("unit", judged(&got, &json!({ "exception": 11 })));
    row
}

/// The usual command of engineers against our server.
pub(crate) fn against_mbpoll() -> Row {
    let served = Served::start(None);
    let port = served.address.port();
    let mut row = Row::new("mbpoll → ours".to_owned());
    let mut check = |column: &str, got: Result<Vec<i64>, String>, wanted: &[i64]| {
        let verdict = match got {
            Ok(values) if values == wanted => Verdict::Good,
            Ok(values) => Verdict::Bad(format!("{values:?} instead of {wanted:?}")),
            Err(problem) => Verdict::Bad(problem),
        };
        row.add(column, verdict);
    };
    check("1", mbpoll(port, "0", 0, 4, &[]), &[1, 0, 0, 1]);
    check("2", mbpoll(port, "1", 3, 3, &[]), &[0, 1, 0]);
    check("3", mbpoll(port, "4", 5, 3, &[]), &[5, 6, 7]);
    check("4", mbpoll(port, "3", 7, 2, &[]), &[1007, 1008]);
    check("5", mbpoll(port, "0", 1, 1, &["1"]), &[]);
    check("5", mbpoll(port, "0", 1, 1, &[]), &[1]);
    check("6", mbpoll(port, "4", 100, 1, &["4711"]), &[]);
    check("6", mbpoll(port, "4", 100, 1, &[]), &[4711]);
    check("15", mbpoll(port, "0", 10, 3, &["1", "1", "0"]), &[]);
    check("15", mbpoll(port, "0", 9, 5, &[]), &[1, 1, 1, 0, 0]);
    check("16", mbpoll(port, "4", 110, 3, &["1", "2", "3"]), &[]);
    check("16", mbpoll(port, "4", 109, 5, &[]), &[109, 1, 2, 3, 113]);
    check(
        "limits",
        mbpoll(port, "3", 0, 125, &[]),
        &(1000..1125).collect::<Vec<_>>(),
    );
    nonsense(served.address);
    check("malformed", mbpoll(port, "4", 5, 1, &[]), &[5]);
    let mut refused = |column: &str, got: Result<Vec<i64>, String>, words: &str| {
        let named = matches!(&got, Err(text) if text.contains(words));
        row.add(
            column,
            if named {
                Verdict::Good
            } else {
                Verdict::Bad(format!("{got:?}"))
            },
        );
    };
    refused("exceptions", mbpoll(port, "4", 2999, 2, &[]), "Illegal data address");
    refused(
        "unit",
        mbpoll_unit(port, AWAY, "4", 5, 1, &[]),
        "Target device failed to respond",
    );
    row
}
