//! A Modbus TCP device that notes who wrote what and when, written from the protocol's text alone.
//!
//! Each master has a port of its own, so the device knows which of them a request is from, whatever they say of themselves.
//! Functions 1 to 4, 5, 6, 15 and 16; all units alike; 1,000 registers and 1,000 bits, inputs and outputs the same ones.
//! Input register 0 is the device's own: it changes with every read, so that a controller has something to do.
//! Never: judges; whoever asks for the notes does.

use std::{
    io::{Read as _, Write as _},
    net::{SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use crate::Error;

/// Registers, and bits.
const ADDRESSES: usize = 1_000;

/// How long a connection's thread waits for bytes before it looks whether the device ends.
const LOOK: Duration = Duration::from_millis(20);

/// One write as the device obeyed it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Obeyed {
    /// When.
    pub at: Instant,
    /// The port that it came through: the master's number.
    pub master: usize,
    /// Function 5, 6, 15 or 16.
    pub function: u8,
    /// First address.
    pub start: u16,
    /// The values.
    pub values: Vec<u16>,
    /// The registers from `watched` on, before the write.
    pub watched: [u16; 3],
}

#[derive(Debug)]
struct Inside {
    words: [u16; ADDRESSES],
    bits: [bool; ADDRESSES],
    obeyed: Vec<Obeyed>,
    /// First of three registers whose values are noted with every write.
    watched: usize,
    /// The device answers so much later.
    delay: Duration,
    /// A port that answers nothing any more, as if its cable were out.
    cut: Option<usize>,
    random: u32,
}

/// A device at work. It ends when it is dropped.
#[derive(Debug)]
pub struct FieldDevice {
    inside: Arc<Mutex<Inside>>,
    ending: Arc<AtomicBool>,
    addresses: Vec<SocketAddr>,
    threads: Vec<JoinHandle<()>>,
}

impl FieldDevice {
    /// Starts a device with one port per master.
    ///
    /// # Errors
    /// Where no port of the loopback interface is free.
    pub fn start(masters: usize, watched: u16) -> Result<Self, Error> {
        let inside = Arc::new(Mutex::new(Inside {
            words: [0; ADDRESSES],
            bits: [false; ADDRESSES],
            obeyed: Vec::new(),
            watched: usize::from(watched).min(ADDRESSES - 3),
            delay: Duration::ZERO,
            cut: None,
            random: 0x2545_f491,
        }));
        let ending = Arc::new(AtomicBool::new(false));
        let (mut addresses, mut threads) = (Vec::new(), Vec::new());
        for master in 0..masters {
            let file = |source| Error::File {
                path: "127.0.0.1:0".into(),
                action: "listened at",
                source,
            };
            let listener = TcpListener::bind(("127.0.0.1", 0)).map_err(file)?;
            addresses.push(listener.local_addr().map_err(file)?);
            let (inside, ending) = (Arc::clone(&inside), Arc::clone(&ending));
            threads.push(std::thread::spawn(move || {
                for stream in listener.incoming().map_while(Result::ok) {
                    if ending.load(Ordering::Acquire) {
                        return;
                    }
                    let (inside, ending) = (Arc::clone(&inside), Arc::clone(&ending));
                    // Ends with its connection, or soon after the device.
                    std::thread::spawn(move || serve(stream, master, &inside, &ending));
                }
            }));
        }
        Ok(Self {
            inside,
            ending,
            addresses,
            threads,
        })
    }

    /// Where a master finds it.
    #[must_use]
    pub fn address(&self, master: usize) -> String {
        self.addresses.get(master).map_or_else(String::new, ToString::to_string)
    }

    /// Answers so much later from now on.
    pub fn set_delay(&self, delay: Duration) {
        held(&self.inside).delay = delay;
    }

    /// Cuts one master's way to the device, or none's.
    pub fn cut(&self, master: Option<usize>) {
        held(&self.inside).cut = master;
    }

    /// A register as it is now; 0 where there is none.
    #[must_use]
    pub fn word(&self, address: u16) -> u16 {
        held(&self.inside).words.get(usize::from(address)).copied().unwrap_or(0)
    }

    /// Sets registers, as a person at the device would.
    pub fn set_words(&self, start: u16, values: &[u16]) {
        let mut inside = held(&self.inside);
        for (place, value) in inside.words.iter_mut().skip(usize::from(start)).zip(values) {
            *place = *value;
        }
    }

    /// All writes so far, in the order in which they were obeyed.
    #[must_use]
    pub fn obeyed(&self) -> Vec<Obeyed> {
        held(&self.inside).obeyed.clone()
    }
}

impl Drop for FieldDevice {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Release);
        for address in &self.addresses {
            // Wakes the accept.
            drop(TcpStream::connect(address));
        }
        for thread in self.threads.drain(..) {
            // One that failed has said so on the terminal.
            drop(thread.join());
        }
    }
}

fn held(inside: &Mutex<Inside>) -> MutexGuard<'_, Inside> {
    inside.lock().unwrap_or_else(PoisonError::into_inner)
}

fn serve(mut stream: TcpStream, master: usize, inside: &Mutex<Inside>, ending: &AtomicBool) {
    if stream.set_read_timeout(Some(LOOK)).is_err() || stream.set_nodelay(true).is_err() {
        return;
    }
    let (mut buffer, mut piece) = (Vec::new(), [0; 512]);
    while !ending.load(Ordering::Acquire) {
        match stream.read(&mut piece) {
            Ok(0) => return,
            Ok(count) => buffer.extend_from_slice(piece.get(..count).unwrap_or_default()),
            Err(error)
                if matches!(
                    error.kind(),
                    std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut
                ) =>
            {
                continue;
            }
            Err(_) => return,
        }
        while let Some(frame) = frame(&mut buffer) {
            let (delay, cut) = {
                let inside = held(inside);
                (inside.delay, inside.cut)
            };
            if cut == Some(master) {
                continue;
            }
            // The device is busy: that is what is played here.
            std::thread::sleep(delay);
            let (Some(head), Some(&unit), Some(pdu)) = (frame.get(..4), frame.get(6), frame.get(7..)) else {
                return;
            };
            let answer = {
                let mut inside = held(inside);
                let function = pdu.first().copied().unwrap_or(0);
                inside
                    .answer(master, pdu)
                    .unwrap_or_else(|exception| vec![function | 0x80, exception])
            };
            let mut bytes = head.to_vec();
            bytes.extend_from_slice(&(answer.len() as u16 + 1).to_be_bytes());
            bytes.push(unit);
            bytes.extend_from_slice(&answer);
            if stream.write_all(&bytes).is_err() {
                return;
            }
        }
    }
}

/// Takes one whole frame from the front.
fn frame(buffer: &mut Vec<u8>) -> Option<Vec<u8>> {
    let (high, low) = (buffer.get(4)?, buffer.get(5)?);
    let length = 6 + usize::from(u16::from_be_bytes([*high, *low]));
    (buffer.len() >= length).then(|| buffer.drain(..length).collect())
}

fn word(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_be_bytes([*bytes.get(at)?, *bytes.get(at + 1)?]))
}

impl Inside {
    /// The answer to a request, or the number of an exception.
    fn answer(&mut self, master: usize, pdu: &[u8]) -> Result<Vec<u8>, u8> {
        let function = *pdu.first().ok_or(1_u8)?;
        let start = word(pdu, 1).ok_or(3_u8)?;
        let second = word(pdu, 3).ok_or(3_u8)?;
        let first = usize::from(start);
        let count = match function {
            5 | 6 => 1,
            _ => usize::from(second),
        };
        if first + count > ADDRESSES {
            return Err(2);
        }
        match function {
            1 | 2 => {
                let mut bytes = vec![0_u8; count.div_ceil(8)];
                for (n, on) in self.bits.iter().skip(first).take(count).enumerate() {
                    if let Some(byte) = bytes.get_mut(n / 8) {
                        *byte |= u8::from(*on) << (n % 8);
                    }
                }
                Ok([&[function, bytes.len() as u8], bytes.as_slice()].concat())
            }
            3 | 4 => {
                if function == 4 && first == 0 {
                    // xorshift32: noise of some counts around 5,000.
                    self.random ^= self.random << 13;
                    self.random ^= self.random >> 17;
                    self.random ^= self.random << 5;
                    if let Some(own) = self.words.first_mut().filter(|_| count > 0) {
                        *own = 5_000 + (self.random % 64) as u16;
                    }
                }
                let words = self.words.iter().skip(first).take(count);
                let bytes: Vec<u8> = words.flat_map(|word| word.to_be_bytes()).collect();
                Ok([&[function, bytes.len() as u8], bytes.as_slice()].concat())
            }
            5 => {
                self.obey(master, function, start, vec![u16::from(second == 0xff00)]);
                Ok(pdu.to_vec())
            }
            6 => {
                self.obey(master, function, start, vec![second]);
                Ok(pdu.to_vec())
            }
            15 => {
                let bit = |n: usize| pdu.get(6 + n / 8).map(|byte| u16::from(byte >> (n % 8) & 1));
                let values: Option<Vec<u16>> = (0..count).map(bit).collect();
                self.obey(master, function, start, values.ok_or(3_u8)?);
                Ok(pdu.get(..5).ok_or(3_u8)?.to_vec())
            }
            16 => {
                let values: Option<Vec<u16>> = (0..count).map(|n| word(pdu, 6 + 2 * n)).collect();
                self.obey(master, function, start, values.ok_or(3_u8)?);
                Ok(pdu.get(..5).ok_or(3_u8)?.to_vec())
            }
            _ => Err(1),
        }
    }

    fn obey(&mut self, master: usize, function: u8, start: u16, values: Vec<u16>) {
        let mut watched = [0; 3];
        for (note, word) in watched.iter_mut().zip(self.words.iter().skip(self.watched)) {
            *note = *word;
        }
        let first = usize::from(start);
        for (n, value) in values.iter().enumerate() {
            if matches!(function, 5 | 15) {
                if let Some(bit) = self.bits.get_mut(first + n) {
                    *bit = *value != 0;
                }
            } else if let Some(word) = self.words.get_mut(first + n) {
                *word = *value;
            }
        }
        self.obeyed.push(Obeyed {
            at: Instant::now(),
            master,
            function,
            start,
            values,
            watched,
        });
    }
}
