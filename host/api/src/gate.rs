//! The listener's gate: so many connections, so many of one address, and none that is silent for ever.
//!
//! ```text
//! waiting for a place ─► accepting ─► open ── bytes either way: the clock starts anew
//!                            │         └ IDLE_TIME_MAX without a byte: closed, the place is free again
//!                            └ one address has ADDRESS_CONNECTIONS_MAX: closed at once
//! ```
//! A feed writes at least every few seconds, so only a dead or dawdling peer is ever closed. Connections beyond the limit
//! wait in the kernel's own bounded queue. Programs on this machine share one address, and are bound by all places alone.
//! Never: looks at what is sent.

use std::{
    collections::HashMap,
    io,
    net::{IpAddr, SocketAddr},
    pin::Pin,
    sync::{Arc, Mutex, PoisonError},
    task::{Context, Poll},
    time::Duration,
};

use axum::serve::Listener;
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpStream},
    sync::{OwnedSemaphorePermit, Semaphore},
    time::{Instant, Sleep, sleep},
};

use crate::limits::{ADDRESS_CONNECTIONS_MAX, CONNECTIONS_MAX, IDLE_TIME_MAX};

/// Connections of each address.
type Counts = Arc<Mutex<HashMap<IpAddr, usize>>>;

/// One of the connections that an address may have.
struct OfAddress {
    counts: Counts,
    address: IpAddr,
}

impl OfAddress {
    fn take(counts: &Counts, address: IpAddr) -> Option<Self> {
        // Each change is whole, so a poisoned map is still right.
        let mut all = counts.lock().unwrap_or_else(PoisonError::into_inner);
        let count = all.entry(address).or_default();
        if *count >= ADDRESS_CONNECTIONS_MAX && !address.is_loopback() {
            return None;
        }
        *count += 1;
        Some(Self {
            counts: Arc::clone(counts),
            address,
        })
    }
}

impl Drop for OfAddress {
    fn drop(&mut self) {
        let mut all = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = all.get_mut(&self.address) {
            *count -= 1;
            if *count == 0 {
                all.remove(&self.address);
            }
        }
    }
}

/// A listener with places.
pub(crate) struct Gate {
    listener: TcpListener,
    places: Arc<Semaphore>,
    counts: Counts,
    idle_time_max: Duration,
}

impl Gate {
    pub(crate) fn new(listener: TcpListener) -> Self {
        Self {
            listener,
            places: Arc::new(Semaphore::new(CONNECTIONS_MAX)),
            counts: Counts::default(),
            idle_time_max: IDLE_TIME_MAX,
        }
    }

    /// The next connection, in its place.
    pub(crate) async fn accept(&mut self) -> (Place, SocketAddr) {
        let permit = match Arc::clone(&self.places).acquire_owned().await {
            Ok(permit) => permit,
            // The semaphore is ours and is never closed.
            Err(_) => std::future::pending().await,
        };
        loop {
            // Errors of accepting are waited out by axum's own listener.
            let (stream, peer) = Listener::accept(&mut self.listener).await;
            let Some(of_address) = OfAddress::take(&self.counts, peer.ip().to_canonical()) else {
                tracing::debug!(%peer, "an address has as many connections as one may have");
                continue;
            };
            // Without it, small answers may wait 40 ms for an acknowledgement.
            if let Err(error) = stream.set_nodelay(true) {
                tracing::debug!(%error, "a connection keeps its delay");
            }
            return (Place::new(stream, self.idle_time_max, permit, of_address), peer);
        }
    }
}

/// One connection in its place.
pub(crate) struct Place {
    stream: TcpStream,
    idle: Pin<Box<Sleep>>,
    idle_time_max: Duration,
    _permit: OwnedSemaphorePermit,
    _of_address: OfAddress,
}

impl Place {
    fn new(stream: TcpStream, idle_time_max: Duration, permit: OwnedSemaphorePermit, of_address: OfAddress) -> Self {
        Self {
            stream,
            idle: Box::pin(sleep(idle_time_max)),
            idle_time_max,
            _permit: permit,
            _of_address: of_address,
        }
    }

    /// Starts the clock anew if there was progress.
    fn progress<T>(&mut self, polled: &Poll<io::Result<T>>) {
        if matches!(polled, Poll::Ready(Ok(_))) {
            let next = Instant::now() + self.idle_time_max;
            self.idle.as_mut().reset(next);
        }
    }
}

impl AsyncRead for Place {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_read(cx, buffer);
        self.progress(&polled);
        // A connection always has a read that waits, so this is where its silence ends.
        if polled.is_pending() && self.idle.as_mut().poll(cx).is_ready() {
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        polled
    }
}

impl AsyncWrite for Place {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.progress(&polled);
        polled
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        pieces: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write_vectored(cx, pieces);
        self.progress(&polled);
        polled
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::AsyncReadExt as _;

    use super::*;

    async fn gate(places: usize, idle_time_max: Duration) -> (Gate, SocketAddr) {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("an address");
        (
            Gate {
                listener,
                places: Arc::new(Semaphore::new(places)),
                counts: Counts::default(),
                idle_time_max,
            },
            address,
        )
    }

    #[tokio::test]
    async fn a_place_is_taken_and_given_back() {
        let (mut gate, address) = gate(1, IDLE_TIME_MAX).await;
        let _first = TcpStream::connect(address).await.expect("the kernel takes it");
        let _second = TcpStream::connect(address).await.expect("the kernel takes it");
        let (place, _) = gate.accept().await;
        assert_eq!(gate.places.available_permits(), 0);
        drop(place);
        gate.accept().await;
    }

    #[tokio::test(start_paused = true)]
    async fn silence_ends_a_connection() {
        let (mut gate, address) = gate(1, Duration::from_secs(60)).await;
        let _peer = TcpStream::connect(address).await.expect("the kernel takes it");
        let (mut place, _) = gate.accept().await;
        let started = Instant::now();
        let error = place.read_u8().await.expect_err("nothing is ever sent");
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert_eq!(started.elapsed().as_secs(), 60);
    }

    #[test]
    fn one_address_has_so_many_and_this_machine_all() {
        let counts = Counts::default();
        let address = IpAddr::from([192, 0, 2, 7]);
        let mut taken: Vec<_> = (0..ADDRESS_CONNECTIONS_MAX)
            .filter_map(|_| OfAddress::take(&counts, address))
            .collect();
        assert_eq!(taken.len(), ADDRESS_CONNECTIONS_MAX);
        assert!(OfAddress::take(&counts, address).is_none());
        assert!(OfAddress::take(&counts, IpAddr::from([192, 0, 2, 8])).is_some());
        taken.pop();
        assert!(OfAddress::take(&counts, address).is_some());
        drop(taken);
        assert!(counts.lock().is_ok_and(|all| all.is_empty()));
        let here = IpAddr::from([127, 0, 0, 1]);
        let many: Vec<_> = (0..ADDRESS_CONNECTIONS_MAX * 2)
            .filter_map(|_| OfAddress::take(&counts, here))
            .collect();
        assert_eq!(many.len(), ADDRESS_CONNECTIONS_MAX * 2);
    }
}
