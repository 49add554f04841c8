//! Between our client and a peer's server: sees which functions went out and came back, and spoils answers on demand.
//!
//! Never: changes a request.

use std::{
    io::{Read as _, Write as _},
    net::{TcpListener, TcpStream},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
    time::Duration,
};

/// What is done to answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Spoil {
    /// Nothing.
    Nothing,
    /// Byte after byte.
    Pieces,
    /// With the number of another request.
    Number,
    /// Its first half, and then the connection ends.
    Half,
    /// Other bytes.
    Nonsense,
}

struct Inside {
    spoil: Mutex<Spoil>,
    spoiled: AtomicU32,
    /// By function: answered well, refused with an exception.
    seen: Mutex<[(u32, u32); 128]>,
    ending: AtomicBool,
}

/// A relay at work; it ends when it is dropped.
pub(crate) struct Relay {
    pub(crate) port: u16,
    inside: Arc<Inside>,
}

impl Relay {
    pub(crate) fn start(to: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = listener.local_addr().expect("an address").port();
        let inside = Arc::new(Inside {
            spoil: Mutex::new(Spoil::Nothing),
            spoiled: AtomicU32::new(0),
            seen: Mutex::new([(0, 0); 128]),
            ending: AtomicBool::new(false),
        });
        let own = Arc::clone(&inside);
        std::thread::spawn(move || {
            for ours in listener.incoming().map_while(Result::ok) {
                if own.ending.load(Ordering::Acquire) {
                    return;
                }
                let Ok(theirs) = TcpStream::connect(("127.0.0.1", to)) else {
                    continue;
                };
                let (Ok(up), Ok(down)) = (ours.try_clone(), theirs.try_clone()) else {
                    continue;
                };
                let own = Arc::clone(&own);
                std::thread::spawn(move || pass(up, theirs));
                std::thread::spawn(move || answers(down, ours, &own));
            }
        });
        Self { port, inside }
    }

    /// Spoils answers from now on.
    pub(crate) fn spoil(&self, spoil: Spoil) {
        *self.inside.spoil.lock().expect("a lock") = spoil;
    }

    /// Answers that were spoiled so far.
    pub(crate) fn spoiled(&self) -> u32 {
        self.inside.spoiled.load(Ordering::Acquire)
    }

    /// How often a function was answered well, and with an exception.
    pub(crate) fn seen(&self, function: u8) -> (u32, u32) {
        self.inside.seen.lock().expect("a lock")[usize::from(function & 0x7f)]
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.inside.ending.store(true, Ordering::Release);
        // Wakes the accept.
        drop(TcpStream::connect(("127.0.0.1", self.port)));
    }
}

fn pass(mut from: TcpStream, mut to: TcpStream) {
    let mut piece = [0; 1024];
    while let Ok(count @ 1..) = from.read(&mut piece) {
        if to.write_all(&piece[..count]).is_err() {
            break;
        }
    }
    let _ = to.shutdown(std::net::Shutdown::Both);
}

fn answers(mut from: TcpStream, mut to: TcpStream, inside: &Inside) {
    let (mut held, mut piece) = (Vec::new(), [0; 1024]);
    let _ = to.set_nodelay(true);
    'open: while let Ok(count @ 1..) = from.read(&mut piece) {
        held.extend_from_slice(&piece[..count]);
        while held.len() >= 8 {
            let length = 6 + usize::from(u16::from_be_bytes([held[4], held[5]]));
            if held.len() < length {
                break;
            }
            let mut frame: Vec<u8> = held.drain(..length).collect();
            let function = frame[7];
            {
                let mut seen = inside.seen.lock().expect("a lock");
                let (well, refused) = &mut seen[usize::from(function & 0x7f)];
                *if function & 0x80 == 0 { well } else { refused } += 1;
            }
            let spoil = *inside.spoil.lock().expect("a lock");
            let sent = match spoil {
                Spoil::Nothing => to.write_all(&frame),
                Spoil::Pieces => frame.iter().try_for_each(|byte| {
                    std::thread::sleep(Duration::from_micros(50));
                    to.write_all(&[*byte])
                }),
                Spoil::Number => {
                    frame[1] = frame[1].wrapping_add(77);
                    to.write_all(&frame)
                }
                Spoil::Half => {
                    let _ = to.write_all(&frame[..length / 2]);
                    Err(std::io::ErrorKind::Other.into())
                }
                Spoil::Nonsense => to.write_all(b"HTTP/1.1 400 Bad Request\r\n\r\n"),
            };
            if spoil != Spoil::Nothing {
                inside.spoiled.fetch_add(1, Ordering::AcqRel);
            }
            if sent.is_err() {
                break 'open;
            }
        }
    }
    let _ = to.shutdown(std::net::Shutdown::Both);
    let _ = from.shutdown(std::net::Shutdown::Both);
}
