//! A slow network between two hosts: a TCP relay that holds back what goes one way.
//!
//! ```text
//! host c ══ TCP ══► relay ══ TCP ══► host a     c to a: passed on at once
//! host c ◄═ TCP ═══ relay ◄═ TCP ═══ host a     a to c: passed on after the delay
//! ```
//! Never: loses, reorders or merges bytes of one direction; so it is a slow network and not a broken one.

use std::{
    net::SocketAddr,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::{TcpListener, TcpStream},
    sync::mpsc,
    time::Instant,
};

use crate::error::Error;

/// Bytes read at once.
const CHUNK_BYTES: usize = 64 * 1024;
/// Chunks that may wait in one direction; beyond it the reader waits, and so does the sender.
const CHUNKS_MAX: usize = 4096;

/// A relay at work. It ends with the runtime that it was started on.
#[derive(Debug)]
pub(crate) struct Relay {
    /// Where it listens.
    pub(crate) address: SocketAddr,
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    delay_us: AtomicU64,
    bytes_held: AtomicU64,
}

impl Relay {
    /// Listens on a free loopback port and connects whoever comes with `to`.
    pub(crate) async fn start(to: SocketAddr) -> Result<Self, Error> {
        let listener = TcpListener::bind("127.0.0.1:0")
            .await
            .map_err(Error::io("the relay cannot listen"))?;
        let address = listener.local_addr().map_err(Error::io("the relay has no address"))?;
        let shared: Arc<Shared> = Arc::default();
        let of_links = Arc::clone(&shared);
        tokio::spawn(async move {
            while let Ok((near, _)) = listener.accept().await {
                tokio::spawn(link(near, to, Arc::clone(&of_links)));
            }
        });
        Ok(Self { address, shared })
    }

    /// Holds back from now on what goes to those that connected.
    pub(crate) fn delay(&self, delay: Duration) {
        let us = u64::try_from(delay.as_micros()).unwrap_or(u64::MAX);
        self.shared.delay_us.store(us, Ordering::Relaxed);
    }

    /// Bytes that went the way that can be held back.
    pub(crate) fn bytes(&self) -> u64 {
        self.shared.bytes_held.load(Ordering::Relaxed)
    }
}

async fn link(near: TcpStream, to: SocketAddr, shared: Arc<Shared>) {
    let Ok(far) = TcpStream::connect(to).await else { return };
    if near.set_nodelay(true).is_err() || far.set_nodelay(true).is_err() {
        return;
    }
    let ((mut near_read, mut near_write), (mut far_read, mut far_write)) = (near.into_split(), far.into_split());
    tokio::spawn(async move {
        // Ends when either side closes; the halves then close the rest.
        let _ = tokio::io::copy(&mut near_read, &mut far_write).await;
    });
    let (sender, mut waiting) = mpsc::channel::<(Instant, Vec<u8>)>(CHUNKS_MAX);
    let of_reader = Arc::clone(&shared);
    tokio::spawn(async move {
        let mut chunk = vec![0; CHUNK_BYTES];
        while let Ok(count) = far_read.read(&mut chunk).await {
            let Some(bytes) = chunk.get(..count).filter(|bytes| !bytes.is_empty()) else {
                break;
            };
            of_reader.bytes_held.fetch_add(count as u64, Ordering::Relaxed);
            let delay = Duration::from_micros(of_reader.delay_us.load(Ordering::Relaxed));
            if sender.send((Instant::now() + delay, bytes.to_vec())).await.is_err() {
                break;
            }
        }
    });
    while let Some((due, bytes)) = waiting.recv().await {
        if due > Instant::now() {
            tokio::time::sleep_until(due).await;
        }
        if near_write.write_all(&bytes).await.is_err() {
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[tokio::test]
    async fn what_comes_back_is_whole_and_held_back() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let relay = Relay::start(listener.local_addr().unwrap()).await.unwrap();
        tokio::spawn(async move {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut bytes = [0; 4];
            while stream.read_exact(&mut bytes).await.is_ok() {
                stream.write_all(&bytes).await.unwrap();
            }
        });
        let mut stream = TcpStream::connect(relay.address).await.unwrap();
        for (delay, word) in [(Duration::ZERO, b"fast"), (Duration::from_millis(30), b"slow")] {
            relay.delay(delay);
            let sent = Instant::now();
            stream.write_all(word).await.unwrap();
            let mut bytes = [0; 4];
            stream.read_exact(&mut bytes).await.unwrap();
            assert_eq!(&bytes, word);
            // Never earlier; how much later is the machine's business.
            assert!(sent.elapsed() >= delay);
        }
        assert_eq!(relay.bytes(), 8);
    }
}
