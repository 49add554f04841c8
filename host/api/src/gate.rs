//! The listener's gate: so many connections, and none that is silent for ever.
//!
//! ```text
//! waiting for a place ─► accepting ─► open ── bytes either way: the clock starts anew
//!                                       └ IDLE_TIME_MAX without a byte: closed, the place is free again
//! ```
//! A feed writes at least every few seconds, so only a dead or dawdling peer is ever closed. Connections beyond the limit
//! wait in the kernel's own bounded queue. Never: looks at what is sent.

use std::{
    io,
    net::SocketAddr,
    pin::Pin,
    sync::Arc,
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

use crate::limits::{CONNECTIONS_MAX, IDLE_TIME_MAX};

/// A listener with places.
pub(crate) struct Gate {
    listener: TcpListener,
    places: Arc<Semaphore>,
    idle_time_max: Duration,
}

impl Gate {
    pub(crate) fn new(listener: TcpListener) -> Self {
        Self {
            listener,
            places: Arc::new(Semaphore::new(CONNECTIONS_MAX)),
            idle_time_max: IDLE_TIME_MAX,
        }
    }
}

impl Listener for Gate {
    type Io = Place;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Place, SocketAddr) {
        let permit = match Arc::clone(&self.places).acquire_owned().await {
            Ok(permit) => permit,
            // The semaphore is ours and is never closed.
            Err(_) => std::future::pending().await,
        };
        // Errors of accepting are waited out by axum's own listener.
        let (stream, peer) = Listener::accept(&mut self.listener).await;
        // Without it, small answers may wait 40 ms for an acknowledgement.
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!(%error, "a connection keeps its delay");
        }
        (Place::new(stream, self.idle_time_max, permit), peer)
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

/// One connection in its place.
pub(crate) struct Place {
    stream: TcpStream,
    idle: Pin<Box<Sleep>>,
    idle_time_max: Duration,
    _permit: OwnedSemaphorePermit,
}

impl Place {
    fn new(stream: TcpStream, idle_time_max: Duration, permit: OwnedSemaphorePermit) -> Self {
        Self {
            stream,
            idle: Box::pin(sleep(idle_time_max)),
            idle_time_max,
            _permit: permit,
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
}
