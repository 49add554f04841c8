//! The server against clients that behave, dawdle, crowd and lie.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests"
)]

use parking_lot::Mutex;
use proptest::prelude::*;
use tokio::runtime::Runtime;

use super::*;

/// A hundred registers and coils in memory; register 13 cannot be read, 14 not be written.
struct Memory {
    words: Mutex<[u16; 100]>,
    bits: Mutex<[bool; 100]>,
    identity: Identity,
    written: Arc<Mutex<Vec<Write>>>,
}

impl Memory {
    fn new() -> Self {
        Self {
            words: Mutex::new(std::array::from_fn(|n| n as u16)),
            bits: Mutex::new([false; 100]),
            identity: Identity::new(["maker", "code", "1", "", "", "", ""]),
            written: Arc::default(),
        }
    }
}

fn cut<T: Copy>(all: &[T], start: u16, count: usize) -> Result<Vec<T>, Exception> {
    let start = usize::from(start);
    all.get(start..start + count)
        .map(<[T]>::to_vec)
        .ok_or(Exception::ADDRESS)
}

impl Registers for Memory {
    fn unit(&self, unit: u8) -> Result<(), Exception> {
        if unit == 7 { Err(Exception::TARGET) } else { Ok(()) }
    }

    fn bits(&self, _: Table, start: u16, count: u16) -> Result<Vec<bool>, Exception> {
        cut(self.bits.lock().as_slice(), start, usize::from(count))
    }

    fn words(&self, _: Table, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        if (start..start.saturating_add(count)).contains(&13) {
            return Err(Exception::FAILURE);
        }
        cut(self.words.lock().as_slice(), start, usize::from(count))
    }

    fn write(&self, _: &Client, write: Write) -> Writing {
        let end = match &write {
            Write::Coils { start, bits } => {
                let at = usize::from(*start);
                let mut held = self.bits.lock();
                held.get_mut(at..at + bits.len())
                    .map(|own| own.copy_from_slice(bits))
                    .ok_or(Exception::ADDRESS)
            }
            Write::Registers { start, words } => {
                let at = usize::from(*start);
                let mut held = self.words.lock();
                let own = held.get_mut(at..at + words.len()).ok_or(Exception::ADDRESS);
                own.and_then(|own| {
                    if (at..at + words.len()).contains(&14) {
                        return Err(Exception::FAILURE);
                    }
                    own.copy_from_slice(words);
                    Ok(())
                })
            }
        };
        if end.is_ok() {
            self.written.lock().push(write);
        }
        Box::pin(async move { end })
    }

    fn identity(&self) -> &Identity {
        &self.identity
    }
}

fn client() -> Client {
    Client {
        address: ([127, 0, 0, 1], 9).into(),
        role: None,
    }
}

fn runtime() -> Runtime {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap()
}

#[test]
fn each_function_and_each_refusal() {
    let memory = Memory::new();
    let runtime = runtime();
    let ask = |unit: u8, pdu: &[u8]| runtime.block_on(answer(&memory, &Masks::default(), &client(), unit, pdu));
    let table: [(&[u8], &[u8]); 18] = [
        (&[3, 0, 2, 0, 2], &[3, 4, 0, 2, 0, 3]),
        (&[4, 0, 2, 0, 1], &[4, 2, 0, 2]),
        (&[5, 0, 1, 0xFF, 0], &[5, 0, 1, 0xFF, 0]),
        (&[15, 0, 2, 0, 2, 1, 0b11], &[15, 0, 2, 0, 2]),
        (&[1, 0, 0, 0, 9], &[1, 2, 0b1110, 0]),
        (&[2, 0, 1, 0, 1], &[2, 1, 1]),
        (&[6, 0, 5, 0, 0x12], &[6, 0, 5, 0, 0x12]),
        (&[22, 0, 5, 0, 0xF2, 0, 0x25], &[22, 0, 5, 0, 0xF2, 0, 0x25]),
        (&[3, 0, 5, 0, 1], &[3, 2, 0, 0x17]),
        (&[16, 0, 8, 0, 2, 4, 1, 1, 2, 2], &[16, 0, 8, 0, 2]),
        // Writes first, then reads what it wrote.
        (&[23, 0, 8, 0, 2, 0, 8, 0, 1, 2, 9, 9], &[23, 4, 9, 9, 2, 2]),
        (
            &[43, 14, 4, 0],
            &[43, 14, 4, 0x82, 0, 0, 1, 0, 5, b'm', b'a', b'k', b'e', b'r'],
        ),
        (&[3, 0, 99, 0, 2], &[0x83, 2]),
        (&[3, 0, 0, 0, 0], &[0x83, 3]),
        (&[3, 0, 13, 0, 1], &[0x83, 4]),
        (&[6, 0, 14, 0, 1], &[0x86, 4]),
        (&[99, 1, 2], &[0xE3, 1]),
        (&[22, 0, 13, 0, 0, 0, 0], &[0x96, 4]),
    ];
    for (pdu, wanted) in table {
        assert_eq!(ask(1, pdu), wanted, "{pdu:?}");
    }
    assert_eq!(ask(7, &[3, 0, 0, 0, 1]), [0x83, 11]);
    // A read-write whose read cannot be must not write.
    let before = memory.written.lock().len();
    assert_eq!(ask(1, &[23, 0, 13, 0, 1, 0, 8, 0, 1, 2, 7, 7]), [0x97, 4]);
    assert_eq!(memory.written.lock().len(), before);
}

struct Served {
    address: SocketAddr,
    counts: Arc<ServerCounts>,
    stop: watch::Sender<bool>,
    task: tokio::task::JoinHandle<()>,
}

async fn served(connections_max: usize, idle: Duration) -> Served {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let (stop, stopping) = watch::channel(false);
    let counts = Arc::new(ServerCounts::default());
    let options = ServerOptions {
        name: "test".to_owned(),
        connections_max,
        idle,
        tls: None,
    };
    let task = tokio::spawn(serve(
        listener,
        options,
        Arc::new(Memory::new()),
        counts.clone(),
        stopping,
    ));
    Served {
        address,
        counts,
        stop,
        task,
    }
}

async fn exchange(stream: &mut TcpStream, transaction: u16, pdu: &[u8]) -> io::Result<Vec<u8>> {
    stream.write_all(&with_header(transaction, 1, pdu)).await?;
    let mut header = [0; 7];
    stream.read_exact(&mut header).await?;
    assert_eq!(header[..2], transaction.to_be_bytes());
    let mut rest = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
    stream.read_exact(&mut rest).await?;
    Ok(rest)
}

#[test]
fn clients_crowd_pipeline_dribble_and_leave() {
    runtime().block_on(async {
        let server = served(2, Duration::from_secs(60)).await;
        let mut one = TcpStream::connect(server.address).await.unwrap();
        let mut two = TcpStream::connect(server.address).await.unwrap();
        assert_eq!(exchange(&mut one, 1, &[3, 0, 3, 0, 1]).await.unwrap(), [3, 2, 0, 3]);
        assert_eq!(exchange(&mut two, 9, &[3, 0, 4, 0, 1]).await.unwrap(), [3, 2, 0, 4]);
        // No place for a third: it is closed without an answer.
        let mut three = TcpStream::connect(server.address).await.unwrap();
        assert!(exchange(&mut three, 1, &[3, 0, 3, 0, 1]).await.is_err());
        assert_eq!(server.counts.refused.load(Ordering::Relaxed), 1);
        // Ten requests in one piece are answered in their order.
        let pile: Vec<u8> = (0..10)
            .flat_map(|n| with_header(n, 1, &[3, 0, n as u8, 0, 1]))
            .collect();
        one.write_all(&pile).await.unwrap();
        let mut answers = vec![0; 11 * 10];
        one.read_exact(&mut answers).await.unwrap();
        let seen: Vec<(u8, u8)> = answers.chunks(11).map(|frame| (frame[1], frame[10])).collect();
        assert_eq!(seen, (0..10).map(|n| (n, n)).collect::<Vec<_>>());
        // Byte by byte is a request too.
        for byte in with_header(5, 1, &[3, 0, 6, 0, 1]) {
            two.write_all(&[byte]).await.unwrap();
        }
        let mut answer = [0; 11];
        two.read_exact(&mut answer).await.unwrap();
        assert_eq!(answer[10], 6);
        // What is no Modbus is closed and counted; the neighbour goes on.
        two.write_all(b"GET / HTTP/1.1\r\n\r\n").await.unwrap();
        assert_eq!(two.read(&mut answer).await.unwrap_or(0), 0);
        assert_eq!(exchange(&mut one, 3, &[3, 0, 3, 0, 1]).await.unwrap(), [3, 2, 0, 3]);
        server.stop.send_replace(true);
        server.task.await.unwrap();
        assert_eq!(one.read(&mut answer).await.unwrap_or(0), 0);
        assert_eq!(server.counts.malformed.load(Ordering::Relaxed), 1);
        assert_eq!(server.counts.open.load(Ordering::Relaxed), 0);
    });
}

#[test]
fn a_client_that_finishes_no_request_is_closed() {
    runtime().block_on(async {
        let server = served(1, Duration::from_millis(50)).await;
        let mut dawdler = TcpStream::connect(server.address).await.unwrap();
        dawdler.write_all(&[0, 1, 0]).await.unwrap();
        let mut buffer = [0; 8];
        // The end of the stream comes; a test that waits for ever would be ended from outside.
        assert_eq!(dawdler.read(&mut buffer).await.unwrap_or(0), 0);
    });
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// Whatever bytes come in whatever pieces, the server closes or answers, and goes on serving the next client.
    #[test]
    fn random_bytes_are_survived(
        pieces in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..120), 0..10),
        framed in any::<bool>(),
    ) {
        let memory = Arc::new(Memory::new());
        let (stop, stopping) = watch::channel(false);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().start_paused(true).build().unwrap();
        runtime.block_on(async {
            let (near, mut far) = tokio::io::duplex(64 * 1024);
            let mut connected = Connected {
                masks: Arc::default(),
                client: client(),
                options: ServerOptions {
                    name: "test".to_owned(),
                    connections_max: 1,
                    idle: Duration::from_secs(1),
                    tls: None,
                },
                registers: memory.clone(),
                counts: Arc::default(),
                stop: stopping,
                _place: Arc::new(Semaphore::new(1)).try_acquire_owned().unwrap(),
            };
            let mut wanted = 0;
            let sending = async {
                for (n, piece) in pieces.iter().enumerate() {
                    let bytes = if framed && !piece.is_empty() {
                        wanted += 1;
                        with_header(n as u16, 1, piece)
                    } else {
                        piece.clone()
                    };
                    if far.write_all(&bytes).await.is_err() {
                        break;
                    }
                }
                let _ = far.shutdown().await;
                let mut said = Vec::new();
                let _ = far.read_to_end(&mut said).await;
                said
            };
            let (_end, said) = tokio::join!(async { connected.talk(near).await }, sending);
            // Each well-framed request has exactly one answer, whatever it asked.
            let (mut rest, mut answers) = (said.as_slice(), 0);
            while let Cut::Frame { end, .. } = cut_header(rest) {
                rest = &rest[end..];
                answers += 1;
            }
            assert!(rest.is_empty(), "half an answer");
            if framed {
                assert_eq!(answers, wanted);
            }
        });
        drop(stop);
    }
}

/// Takes a write at once, and does it when others have had their turn.
struct Late(Arc<Memory>);

impl Registers for Late {
    fn unit(&self, unit: u8) -> Result<(), Exception> {
        self.0.unit(unit)
    }

    fn bits(&self, table: Table, start: u16, count: u16) -> Result<Vec<bool>, Exception> {
        self.0.bits(table, start, count)
    }

    fn words(&self, table: Table, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        self.0.words(table, start, count)
    }

    fn write(&self, client: &Client, write: Write) -> Writing {
        let (memory, client) = (Arc::clone(&self.0), client.clone());
        Box::pin(async move {
            for _ in 0..4 {
                tokio::task::yield_now().await;
            }
            memory.write(&client, write).await
        })
    }

    fn identity(&self) -> &Identity {
        self.0.identity()
    }
}

#[test]
fn two_clients_that_mask_one_register_lose_no_bit() {
    let (late, masks, client) = (Late(Arc::new(Memory::new())), Masks::default(), client());
    let mask = |bit: u8| {
        let pdu = [22, 0, 20, 0xFF, !(1 << bit), 0, 1 << bit];
        let (late, masks, client) = (&late, &masks, &client);
        async move { answer(late, masks, client, 1, &pdu).await }
    };
    late.0.words.lock()[20] = 0;
    runtime().block_on(async { tokio::join!(mask(0), mask(1), mask(2), mask(3)) });
    assert_eq!(late.0.words.lock()[20], 0b1111);
}
