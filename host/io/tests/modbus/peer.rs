//! A Modbus TCP device that misbehaves on demand, written from the protocol's text alone: it shares no code with the
//! client under test.

use std::{
    io::{Read, Write},
    net::{SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread::JoinHandle,
    time::Duration,
};

/// How the device answers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Manner {
    /// As it should.
    Good,
    /// As it should, one byte after the other.
    Dribbling,
    /// With this exception to everything.
    Exception(u8),
    /// With this exception to writes.
    WriteException(u8),
    /// Exception 2 to reads of more than two addresses: gaps do not exist here.
    RefusesGaps,
    /// Exception 2 to reads of this address and its neighbours with it.
    Without(u16),
    /// Not at all.
    Silent,
    /// Not for this unit.
    SilentUnit(u8),
    /// By closing the connection.
    Closes,
    /// With the number of another request.
    WrongTransaction,
    /// With one register too few.
    Short,
    /// With bytes that are no Modbus.
    Garbage,
    /// As it should, in the frames of a serial line.
    Rtu,
    /// As it should, without function 22.
    WithoutMask,
    /// Confirms writes and does nothing.
    Forgets,
}

/// What the device holds, and how it behaves.
pub(crate) struct Device {
    pub(crate) manner: Manner,
    pub(crate) words: [u16; 1000],
    pub(crate) bits: [bool; 1000],
    /// Requests that came.
    pub(crate) asked: u64,
}

/// A request as it came: unit and function with data.
pub(crate) type Seen = (u8, Vec<u8>);

pub(crate) struct Peer {
    pub(crate) address: SocketAddr,
    pub(crate) device: Arc<Mutex<Device>>,
    /// Writes in the order in which they came.
    pub(crate) writes: mpsc::Receiver<Seen>,
    ending: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// An address that nobody else can take and at which nobody listens yet.
pub(crate) struct Reserved {
    socket: tokio::net::TcpSocket,
    pub(crate) address: SocketAddr,
}

impl Reserved {
    pub(crate) fn new() -> Self {
        let socket = tokio::net::TcpSocket::new_v4().expect("a socket");
        socket.bind(([127, 0, 0, 1], 0).into()).expect("a free port");
        let address = socket.local_addr().expect("an address");
        Self { socket, address }
    }

    /// The device comes to life.
    pub(crate) fn listen(self, runtime: &tokio::runtime::Runtime) -> Peer {
        let _context = runtime.enter();
        let listener = self
            .socket
            .listen(64)
            .and_then(tokio::net::TcpListener::into_std)
            .expect("a listener");
        listener.set_nonblocking(false).expect("a listener that waits");
        Peer::start_on(listener)
    }
}

impl Peer {
    pub(crate) fn start() -> Self {
        Self::start_on(TcpListener::bind("127.0.0.1:0").expect("a free port"))
    }

    fn start_on(listener: TcpListener) -> Self {
        let address = listener.local_addr().expect("an address");
        let device = Arc::new(Mutex::new(Device {
            manner: Manner::Good,
            words: [0; 1000],
            bits: [false; 1000],
            asked: 0,
        }));
        let ending = Arc::new(AtomicBool::new(false));
        let (sender, writes) = mpsc::channel();
        let (shared, end) = (device.clone(), ending.clone());
        let thread = std::thread::spawn(move || {
            for stream in listener.incoming() {
                if end.load(Ordering::Acquire) {
                    return;
                }
                let Ok(stream) = stream else { continue };
                let (device, end, sender) = (shared.clone(), end.clone(), sender.clone());
                std::thread::spawn(move || serve(stream, &device, &end, &sender));
            }
        });
        Self {
            address,
            device,
            writes,
            ending,
            thread: Some(thread),
        }
    }

    pub(crate) fn behave(&self, manner: Manner) {
        self.device.lock().expect("device").manner = manner;
    }

    pub(crate) fn set_words(&self, start: usize, words: &[u16]) {
        self.device.lock().expect("device").words[start..start + words.len()].copy_from_slice(words);
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Release);
        // Wakes the accept.
        let _ = TcpStream::connect(self.address);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn serve(mut stream: TcpStream, device: &Mutex<Device>, ending: &AtomicBool, writes: &mpsc::Sender<Seen>) {
    stream
        .set_read_timeout(Some(Duration::from_millis(20)))
        .expect("a time-out");
    let mut buffer = Vec::new();
    let mut chunk = [0; 512];
    while !ending.load(Ordering::Acquire) {
        match stream.read(&mut chunk) {
            Ok(0) => return,
            Ok(count) => buffer.extend_from_slice(&chunk[..count]),
            Err(e) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => continue,
            Err(_) => return,
        }
        if device.lock().expect("device").manner == Manner::Rtu {
            // Requests of 8 bytes only: reads, and functions 5 and 6.
            while buffer.len() >= 8 {
                let frame: Vec<u8> = buffer.drain(..8).collect();
                let pdu = &frame[1..6];
                if matches!(pdu[0], 5 | 6) {
                    let _ = writes.send((frame[0], pdu.to_vec()));
                }
                let answer = answered(&mut device.lock().expect("device"), pdu);
                let frame = bumpless_io::modbus::frame::with_checksum(frame[0], &answer);
                if stream.write_all(&frame).is_err() {
                    return;
                }
            }
            continue;
        }
        while buffer.len() >= 7 {
            let length = usize::from(u16::from_be_bytes([buffer[4], buffer[5]]));
            if buffer.len() < 6 + length {
                break;
            }
            let frame: Vec<u8> = buffer.drain(..6 + length).collect();
            let (unit, pdu) = (frame[6], &frame[7..]);
            let mut device = device.lock().expect("device");
            let manner = device.manner;
            device.asked += 1;
            let is_write = matches!(pdu[0], 5 | 6 | 15 | 16 | 22 | 23);
            let mut answer = match manner {
                Manner::Silent => continue,
                Manner::SilentUnit(quiet) if quiet == unit => continue,
                Manner::Closes => return,
                Manner::Exception(code) => vec![pdu[0] | 0x80, code],
                Manner::WriteException(code) if is_write => vec![pdu[0] | 0x80, code],
                Manner::WithoutMask if pdu[0] == 22 => vec![pdu[0] | 0x80, 1],
                Manner::Forgets if matches!(pdu[0], 5 | 6 | 15 | 16) => pdu[..5].to_vec(),
                Manner::RefusesGaps if !is_write && u16::from_be_bytes([pdu[3], pdu[4]]) > 2 => vec![pdu[0] | 0x80, 2],
                Manner::Without(address) if !is_write && reads(pdu, address) => vec![pdu[0] | 0x80, 2],
                _ => answered(&mut device, pdu),
            };
            drop(device);
            if is_write && !(manner == Manner::WithoutMask && pdu[0] == 22) {
                let _ = writes.send((unit, pdu.to_vec()));
            }
            if manner == Manner::Short && !is_write {
                answer.truncate(answer.len() - 2);
                answer[1] -= 2;
            }
            let mut bytes = frame[..4].to_vec();
            if manner == Manner::WrongTransaction {
                bytes[1] = bytes[1].wrapping_add(77);
            }
            bytes.extend_from_slice(&(answer.len() as u16 + 1).to_be_bytes());
            bytes.push(unit);
            bytes.extend_from_slice(&answer);
            if manner == Manner::Garbage {
                bytes = b"HTTP/1.1 400 Bad Request\r\n\r\n".to_vec();
            }
            let sent = if manner == Manner::Dribbling {
                bytes
                    .iter()
                    .try_for_each(|byte| stream.write_all(&[*byte]).and_then(|()| stream.flush()))
            } else {
                stream.write_all(&bytes)
            };
            if sent.is_err() {
                return;
            }
        }
    }
}

/// Does a read ask for this address?
fn reads(pdu: &[u8], address: u16) -> bool {
    let (start, count) = (
        u16::from_be_bytes([pdu[1], pdu[2]]),
        u16::from_be_bytes([pdu[3], pdu[4]]),
    );
    (start..start + count).contains(&address)
}

/// The answer of a device in order. Coils and discrete inputs share their bits, both kinds of registers their words.
fn answered(device: &mut Device, pdu: &[u8]) -> Vec<u8> {
    let start = usize::from(u16::from_be_bytes([pdu[1], pdu[2]]));
    let second = u16::from_be_bytes([pdu[3], pdu[4]]);
    let count = usize::from(second);
    match pdu[0] {
        1 | 2 => {
            let mut bytes = vec![0_u8; count.div_ceil(8)];
            for n in 0..count {
                bytes[n / 8] |= u8::from(device.bits[start + n]) << (n % 8);
            }
            [&[pdu[0], bytes.len() as u8], bytes.as_slice()].concat()
        }
        3 | 4 => {
            let bytes: Vec<u8> = device.words[start..start + count]
                .iter()
                .flat_map(|w| w.to_be_bytes())
                .collect();
            [&[pdu[0], bytes.len() as u8], bytes.as_slice()].concat()
        }
        5 => {
            device.bits[start] = second == 0xFF00;
            pdu.to_vec()
        }
        6 => {
            device.words[start] = second;
            pdu.to_vec()
        }
        15 => {
            for n in 0..count {
                device.bits[start + n] = pdu[6 + n / 8] >> (n % 8) & 1 == 1;
            }
            pdu[..5].to_vec()
        }
        16 => {
            for n in 0..count {
                device.words[start + n] = u16::from_be_bytes([pdu[6 + 2 * n], pdu[7 + 2 * n]]);
            }
            pdu[..5].to_vec()
        }
        22 => {
            let or = u16::from_be_bytes([pdu[5], pdu[6]]);
            device.words[start] = (device.words[start] & second) | (or & !second);
            pdu.to_vec()
        }
        function => vec![function | 0x80, 1],
    }
}
