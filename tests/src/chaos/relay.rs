//! A bad network between two hosts: a TCP relay that holds back, stalls, narrows or breaks what passes.
//!
//! ```text
//! host c ══ TCP ══► relay ══ TCP ══► host a     away: from who connected
//! host c ◄═ TCP ═══ relay ◄═ TCP ═══ host a     back: to who connected
//! ```
//! A narrow link takes so many bytes a second and keeps few; whoever sends more finds it full, as behind a switch that carries
//! other traffic. A packet that is lost on a TCP link is a stall of everything behind it until it is sent again; that is what `stall` does.
//! Never: loses, reorders or changes bytes of a link that lives.

use std::{
    io::{Read as _, Write as _},
    net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::{Duration, Instant},
};

use crate::{Error, pause};

/// Bytes read at once.
const CHUNK_BYTES: usize = 64 * 1024;
/// Chunks that may wait in one direction; beyond it the reader waits, and so does the sender.
const CHUNKS_MAX: usize = 4096;
/// Bytes that wait at a narrow link; beyond it the sender finds it full: what a small switch keeps for a port.
const NARROW_BYTES_MAX: u64 = 32 * 1024;
/// Bytes that a narrow link takes at once, so that a large message does not pass in one leap.
const NARROW_SLICE_BYTES: usize = 1024;
/// Links at once: a host has one or two.
const LINKS_MAX: usize = 64;
/// Pause between two looks whether a stall is over.
const LOOK: Duration = Duration::from_millis(1);
/// Longest wait for the other end of a new link.
const CONNECT_MAX: Duration = Duration::from_secs(2);

/// A direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// From who connected.
    Away,
    /// To who connected.
    Back,
}

#[derive(Debug, Default)]
struct Lane {
    delay_us: AtomicU64,
    stalled: AtomicBool,
    bytes: AtomicU64,
    /// Bytes a second; 0 for as many as come.
    bytes_per_s: AtomicU64,
    waiting_bytes: AtomicU64,
}

#[derive(Debug, Default)]
struct Shared {
    away: Lane,
    back: Lane,
    ended: AtomicBool,
    links: Mutex<Vec<TcpStream>>,
}

impl Shared {
    const fn lane(&self, way: Way) -> &Lane {
        match way {
            Way::Away => &self.away,
            Way::Back => &self.back,
        }
    }

    fn break_links(&self) {
        for link in self.links.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            // One that broke by itself is broken.
            let _broken = link.shutdown(Shutdown::Both);
        }
    }
}

/// A relay at work. Dropped, it ends with its links.
#[derive(Debug)]
pub struct Relay {
    /// Where it listens.
    pub address: SocketAddr,
    shared: Arc<Shared>,
}

impl Relay {
    /// Listens on a free port of `on` and connects whoever comes with `to`.
    ///
    /// # Errors
    /// [`Error::Program`] where the address cannot be had.
    pub fn start(on: IpAddr, to: SocketAddr) -> Result<Self, Error> {
        let failed = |source| Error::Program {
            program: "a relay".to_owned(),
            source,
        };
        let listener = TcpListener::bind((on, 0)).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let shared: Arc<Shared> = Arc::default();
        let of_links = Arc::clone(&shared);
        std::thread::Builder::new()
            .name("relay".to_owned())
            .spawn(move || {
                for near in listener.incoming().map_while(Result::ok) {
                    if of_links.ended.load(Ordering::Acquire) {
                        return;
                    }
                    let shared = Arc::clone(&of_links);
                    // Where there are no threads the link is closed, which is a fault like others.
                    let _thread = std::thread::Builder::new()
                        .name("relay-link".to_owned())
                        .spawn(move || link(near, to, &shared));
                }
            })
            .map_err(failed)?;
        Ok(Self { address, shared })
    }

    /// Holds back from now on what goes that way.
    pub fn delay(&self, way: Way, delay: Duration) {
        let us = u64::try_from(delay.as_micros()).unwrap_or(u64::MAX);
        self.shared.lane(way).delay_us.store(us, Ordering::Relaxed);
    }

    /// Lets nothing pass that way, or everything again; what came meanwhile is not lost.
    pub fn stall(&self, way: Way, stalled: bool) {
        self.shared.lane(way).stalled.store(stalled, Ordering::Relaxed);
    }

    /// Lets only so many bytes a second pass that way from now on; none for as many as come.
    pub fn narrow(&self, way: Way, bytes_per_s: Option<u64>) {
        let bytes_per_s = bytes_per_s.map_or(0, |bytes| bytes.max(1));
        self.shared.lane(way).bytes_per_s.store(bytes_per_s, Ordering::Relaxed);
    }

    /// Breaks all links; new ones may be made.
    pub fn reset(&self) {
        self.shared.break_links();
    }

    /// Bytes that went that way.
    #[must_use]
    pub fn bytes(&self, way: Way) -> u64 {
        self.shared.lane(way).bytes.load(Ordering::Relaxed)
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

fn link(near: TcpStream, to: SocketAddr, shared: &Arc<Shared>) {
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
        if links.len() >= LINKS_MAX {
            // Those that ended long ago.
            links.drain(..LINKS_MAX / 2);
        }
        links.push(near_end);
        links.push(far_end);
    }
    carry(near, far_out, Way::Away, shared);
    carry(far, near_out, Way::Back, shared);
}

/// Two threads: one reads and notes when, one waits and writes.
fn carry(mut from: TcpStream, to: TcpStream, way: Way, shared: &Arc<Shared>) {
    let (sender, waiting) = sync_channel::<(Instant, Vec<u8>)>(CHUNKS_MAX);
    let (of_reader, of_writer) = (Arc::clone(shared), Arc::clone(shared));
    let reader = move || read(&mut from, &sender, of_reader.lane(way), &of_reader.ended);
    let writer = move || write(to, &waiting, of_writer.lane(way), &of_writer.ended);
    // Where there are no threads the link falls silent, which is a fault like others.
    let _reader = std::thread::Builder::new().name("relay-in".to_owned()).spawn(reader);
    let _writer = std::thread::Builder::new().name("relay-out".to_owned()).spawn(writer);
}

fn read(from: &mut TcpStream, sender: &SyncSender<(Instant, Vec<u8>)>, lane: &Lane, ended: &AtomicBool) {
    let mut chunk = vec![0; CHUNK_BYTES];
    while let Ok(count) = from.read(&mut chunk) {
        let Some(bytes) = chunk.get(..count).filter(|bytes| !bytes.is_empty()) else {
            return;
        };
        lane.bytes.fetch_add(count as u64, Ordering::Relaxed);
        lane.waiting_bytes.fetch_add(count as u64, Ordering::Relaxed);
        let delay = Duration::from_micros(lane.delay_us.load(Ordering::Relaxed));
        if sender.send((Instant::now() + delay, bytes.to_vec())).is_err() {
            return;
        }
        // What is not read fills the sender's own queue.
        while lane.bytes_per_s.load(Ordering::Relaxed) > 0
            && lane.waiting_bytes.load(Ordering::Relaxed) > NARROW_BYTES_MAX
            && !ended.load(Ordering::Relaxed)
        {
            pause(LOOK);
        }
    }
}

fn write(mut to: TcpStream, waiting: &Receiver<(Instant, Vec<u8>)>, lane: &Lane, ended: &AtomicBool) {
    for (due, bytes) in waiting {
        pause(due.saturating_duration_since(Instant::now()));
        while lane.stalled.load(Ordering::Relaxed) && !ended.load(Ordering::Relaxed) {
            pause(LOOK);
        }
        let written = send(&mut to, &bytes, lane);
        lane.waiting_bytes.fetch_sub(bytes.len() as u64, Ordering::Relaxed);
        if written.is_err() {
            break;
        }
    }
    // What a link that broke had not passed on waits no longer.
    for (_, bytes) in waiting.try_iter() {
        lane.waiting_bytes.fetch_sub(bytes.len() as u64, Ordering::Relaxed);
    }
    // The other side hears that this one has gone.
    let _closed = to.shutdown(Shutdown::Both);
}

/// Writes at the pace that the link has now.
fn send(to: &mut TcpStream, bytes: &[u8], lane: &Lane) -> std::io::Result<()> {
    let mut rest = bytes;
    while !rest.is_empty() {
        let bytes_per_s = lane.bytes_per_s.load(Ordering::Relaxed);
        let slice = if bytes_per_s == 0 {
            std::mem::take(&mut rest)
        } else {
            let (slice, more) = rest.split_at(rest.len().min(NARROW_SLICE_BYTES));
            rest = more;
            pause(Duration::from_secs_f64(slice.len() as f64 / bytes_per_s as f64));
            slice
        };
        to.write_all(slice)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::{net::Ipv4Addr, sync::mpsc::channel};

    use super::*;

    fn echo() -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        std::thread::spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                std::thread::spawn(move || {
                    let mut bytes = [0; 4];
                    while stream.read_exact(&mut bytes).is_ok() && stream.write_all(&bytes).is_ok() {}
                });
            }
        });
        address
    }

    #[test]
    fn what_passes_is_whole_and_held_back() {
        let relay = Relay::start(Ipv4Addr::LOCALHOST.into(), echo()).unwrap();
        let mut stream = TcpStream::connect(relay.address).unwrap();
        for (delay, word) in [(Duration::ZERO, b"fast"), (Duration::from_millis(30), b"slow")] {
            relay.delay(Way::Back, delay);
            let sent = Instant::now();
            stream.write_all(word).unwrap();
            let mut bytes = [0; 4];
            stream.read_exact(&mut bytes).unwrap();
            assert_eq!(&bytes, word);
            // Never earlier; how much later is the machine's business.
            assert!(sent.elapsed() >= delay);
        }
        assert_eq!((relay.bytes(Way::Away), relay.bytes(Way::Back)), (8, 8));
    }

    #[test]
    fn a_narrow_link_passes_everything_at_its_pace() {
        let relay = Relay::start(Ipv4Addr::LOCALHOST.into(), echo()).unwrap();
        let mut stream = TcpStream::connect(relay.address).unwrap();
        let text: Vec<u8> = (0..4096_u32).map(|n| (n % 251) as u8).collect();
        relay.narrow(Way::Away, Some(40_000));
        let sent = Instant::now();
        stream.write_all(&text).unwrap();
        let mut bytes = vec![0; text.len()];
        stream.read_exact(&mut bytes).unwrap();
        assert_eq!(bytes, text);
        // Never earlier; how much later is the machine's business.
        assert!(sent.elapsed() >= Duration::from_millis(100));
        relay.narrow(Way::Away, None);
        stream.write_all(b"wide").unwrap();
        stream.read_exact(&mut bytes[..4]).unwrap();
        assert_eq!(&bytes[..4], b"wide");
    }

    #[test]
    fn a_stall_holds_and_loses_nothing_and_a_reset_breaks() {
        let relay = Relay::start(Ipv4Addr::LOCALHOST.into(), echo()).unwrap();
        let mut stream = TcpStream::connect(relay.address).unwrap();
        let mut other = stream.try_clone().unwrap();
        let (told, heard) = channel();
        std::thread::spawn(move || {
            let mut bytes = [0; 4];
            while other.read_exact(&mut bytes).is_ok() && told.send(bytes).is_ok() {}
        });
        relay.stall(Way::Away, true);
        stream.write_all(b"once").unwrap();
        assert!(heard.recv_timeout(Duration::from_millis(50)).is_err(), "nothing passes");
        relay.stall(Way::Away, false);
        assert_eq!(heard.recv_timeout(Duration::from_secs(20)).unwrap(), *b"once");
        relay.reset();
        assert!(
            heard.recv_timeout(Duration::from_secs(20)).is_err(),
            "the link is broken"
        );
        let mut again = TcpStream::connect(relay.address).unwrap();
        again.write_all(b"more").unwrap();
        let mut bytes = [0; 4];
        again.read_exact(&mut bytes).unwrap();
        assert_eq!(&bytes, b"more");
    }
}
