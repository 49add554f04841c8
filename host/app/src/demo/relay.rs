//! The demonstration's bad network: a TCP relay between a controller host and the plant, which holds back or stalls what passes.
//!
//! ```text
//! controller ══ TCP ══► relay ══ TCP ══► plant        both ways: read ─► queue ─ its time has come ─► written
//! ```
//! On a TCP link a lost packet is a stall of everything behind it until it is sent again, so that is what `lose` does: a piece
//! in ten waits for the time after which Linux sends again. Never: loses, reorders or changes bytes of a link that lives.

use std::{
    io::{Read as _, Write as _},
    net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::{Duration, Instant},
};

use crate::error::Error;

/// Bytes read at once.
const CHUNK_BYTES: usize = 64 * 1024;
/// Chunks that may wait in one direction; beyond it the reader waits, and so does the sender.
const CHUNKS_MAX: usize = 1024;
/// Links at once: a host has one, and a second one while it makes it anew.
const LINKS_MAX: usize = 16;
/// Longest wait for the other end of a new link.
const CONNECT_MAX: Duration = Duration::from_secs(2);
/// After which time Linux sends a lost packet again, at least.
const SENT_AGAIN: Duration = Duration::from_millis(200);

#[derive(Debug)]
struct Shared {
    to: Mutex<SocketAddr>,
    delay_us: AtomicU64,
    lost_percent: AtomicU32,
    ended: AtomicBool,
    links: Mutex<Vec<TcpStream>>,
}

/// A relay at work. Dropped, it ends with its links.
#[derive(Debug)]
pub(super) struct Relay {
    address: SocketAddr,
    shared: Arc<Shared>,
}

impl Relay {
    /// Listens on a free loopback port and connects whoever comes with `to`.
    pub(super) fn start(to: SocketAddr) -> Result<Self, Error> {
        let failed = |error| Error::start("the demonstration's network", error);
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let shared = Arc::new(Shared {
            to: Mutex::new(to),
            delay_us: AtomicU64::new(0),
            lost_percent: AtomicU32::new(0),
            ended: AtomicBool::new(false),
            links: Mutex::default(),
        });
        let of_links = Arc::clone(&shared);
        let accept = move || {
            for near in listener.incoming().map_while(Result::ok) {
                if of_links.ended.load(Ordering::Acquire) {
                    return;
                }
                let shared = Arc::clone(&of_links);
                // Where there are no threads the link is closed, and made anew.
                let _thread = spawn("relay-link", move || link(near, &shared));
            }
        };
        spawn("relay", accept).map_err(|error| Error::start("the demonstration's network", error))?;
        Ok(Self { address, shared })
    }

    /// Where it listens, as hosts have it.
    pub(super) fn locator(&self) -> String {
        format!("tcp/{}", self.address)
    }

    /// New links lead there from now on: the other host was started again.
    pub(super) fn lead_to(&self, to: SocketAddr) {
        *self.shared.to.lock().unwrap_or_else(PoisonError::into_inner) = to;
        self.shared.break_links();
    }

    /// Holds back from now on what passes, both ways.
    pub(super) fn delay(&self, delay: Duration) {
        let us = u64::try_from(delay.as_micros()).unwrap_or(u64::MAX);
        self.shared.delay_us.store(us, Ordering::Relaxed);
    }

    /// Stalls so many of a hundred pieces from now on, both ways.
    pub(super) fn lose(&self, percent: u32) {
        self.shared.lost_percent.store(percent, Ordering::Relaxed);
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::Release);
        self.shared.break_links();
        // The thread that accepts sees the end with the next link, which is this one.
        let _woken = TcpStream::connect_timeout(&self.address, CONNECT_MAX);
    }
}

impl Shared {
    fn break_links(&self) {
        for link in self.links.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            // One that broke by itself is broken.
            let _broken = link.shutdown(Shutdown::Both);
        }
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> std::io::Result<thread::JoinHandle<()>> {
    thread::Builder::new().name(name.to_owned()).spawn(work)
}

fn link(near: TcpStream, shared: &Arc<Shared>) {
    let to = *shared.to.lock().unwrap_or_else(PoisonError::into_inner);
    let Ok(far) = TcpStream::connect_timeout(&to, CONNECT_MAX) else {
        return;
    };
    if near.set_nodelay(true).is_err() || far.set_nodelay(true).is_err() {
        return;
    }
    let ends = (near.try_clone(), far.try_clone(), near.try_clone(), far.try_clone());
    let (Ok(near_out), Ok(far_out), Ok(near_end), Ok(far_end)) = ends else {
        return;
    };
    {
        let mut links = shared.links.lock().unwrap_or_else(PoisonError::into_inner);
        if links.len() >= 2 * LINKS_MAX {
            // Those that ended long ago.
            links.drain(..LINKS_MAX);
        }
        links.push(near_end);
        links.push(far_end);
    }
    carry(near, far_out, shared);
    carry(far, near_out, shared);
}

/// Two threads: one reads and notes when it is due, one waits and writes.
fn carry(mut from: TcpStream, to: TcpStream, shared: &Arc<Shared>) {
    let (sender, waiting) = sync_channel::<(Instant, Vec<u8>)>(CHUNKS_MAX);
    let shared = Arc::clone(shared);
    // Where there are no threads the link falls silent, which is a fault like others.
    let _reader = spawn("relay-in", move || read(&mut from, &sender, &shared));
    let _writer = spawn("relay-out", move || write(to, &waiting));
}

fn read(from: &mut TcpStream, sender: &SyncSender<(Instant, Vec<u8>)>, shared: &Shared) {
    let mut chunk = vec![0; CHUNK_BYTES];
    let mut count: u32 = 0;
    while let Ok(length) = from.read(&mut chunk) {
        let Some(bytes) = chunk.get(..length).filter(|bytes| !bytes.is_empty()) else {
            return;
        };
        let delay = Duration::from_micros(shared.delay_us.load(Ordering::Relaxed));
        count = count.wrapping_add(1);
        let lost = is_lost(count, shared.lost_percent.load(Ordering::Relaxed));
        let due = Instant::now() + delay + if lost { SENT_AGAIN } else { Duration::ZERO };
        if sender.send((due, bytes.to_vec())).is_err() {
            return;
        }
    }
}

/// Is this piece one of those that are lost? Spread evenly by a multiplicative hash, so that it is no rhythm of the cycles.
const fn is_lost(count: u32, percent: u32) -> bool {
    count.wrapping_mul(2_654_435_761) / 42_949_673 < percent
}

fn write(mut to: TcpStream, waiting: &Receiver<(Instant, Vec<u8>)>) {
    for (due, bytes) in waiting {
        thread::sleep(due.saturating_duration_since(Instant::now()));
        if to.write_all(&bytes).is_err() {
            break;
        }
    }
    // The other side hears that this one has gone.
    let _closed = to.shutdown(Shutdown::Both);
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    /// Answers what it hears, with a letter before it.
    fn echo(letter: u8) -> SocketAddr {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let address = listener.local_addr().unwrap();
        thread::spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                thread::spawn(move || {
                    let mut bytes = [0; 4];
                    while stream.read_exact(&mut bytes).is_ok()
                        && stream.write_all(&[&[letter], &bytes[..]].concat()).is_ok()
                    {}
                });
            }
        });
        address
    }

    fn ask(stream: &mut TcpStream) -> [u8; 5] {
        let mut bytes = [0; 5];
        stream.write_all(b"ping").unwrap();
        stream.read_exact(&mut bytes).unwrap();
        bytes
    }

    #[test]
    fn what_passes_is_whole_held_back_and_led_elsewhere() {
        let relay = Relay::start(echo(b'a')).unwrap();
        let mut stream = TcpStream::connect(relay.address).unwrap();
        assert_eq!(ask(&mut stream), *b"aping");
        relay.delay(Duration::from_millis(20));
        let sent = Instant::now();
        assert_eq!(ask(&mut stream), *b"aping");
        // Never earlier, there and back; how much later is the machine's business.
        assert!(sent.elapsed() >= Duration::from_millis(40));
        relay.delay(Duration::ZERO);
        relay.lose(100);
        let sent = Instant::now();
        assert_eq!(ask(&mut stream), *b"aping");
        assert!(sent.elapsed() >= 2 * SENT_AGAIN);
        relay.lose(0);
        relay.lead_to(echo(b'b'));
        assert_eq!(stream.read(&mut [0; 1]).unwrap_or(0), 0, "the old link is broken");
        assert_eq!(ask(&mut TcpStream::connect(relay.address).unwrap()), *b"bping");
    }

    #[test]
    fn as_many_are_lost_as_was_said() {
        for percent in [0, 10, 50, 100] {
            let lost = (0..10_000).filter(|&count| is_lost(count, percent)).count();
            assert!(
                lost.abs_diff(percent as usize * 100) <= 50,
                "{percent} %: {lost} of 10000"
            );
        }
    }
}
