//! The other side of Modbus: a listener that lets clients read and write registers that somebody else holds.
//!
//! ```text
//! accepted ─► place free? ──no──► closed at once (counted)
//!                └─yes─► TLS, where wanted ─► open ── request ─► answer ─┐
//!                                              ▲ └───────────────────────┘
//!                                              └─ no whole request for `idle`, no Modbus, or stopped: closed
//! ```
//!
//! Owns: connections, their number and their time. A client's requests are answered one after the other, in order, so
//! what waits is in the kernel's own bounded buffers. Never: knows what a register means (that is whoever implements
//! [`Registers`]), or lets a client hold up another, except for the time of a write: function 22 reads and writes in one.

use std::{
    fmt,
    future::Future,
    io,
    net::SocketAddr,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _},
    net::{TcpListener, TcpStream},
    sync::{OwnedSemaphorePermit, Semaphore, watch},
    task::JoinSet,
    time::{Instant, sleep, timeout, timeout_at},
};
use tokio_rustls::TlsAcceptor;

use super::{
    exception::Exception,
    frame::{Cut, FRAME_BYTES_MAX, cut_header, with_header},
    group::Table,
    request::{Answer, EXCEPTION_BIT, Request},
    role::role_of,
};
use crate::limits::{SERVER_SEND_MS_MAX, SERVER_STOP_MS_MAX};

mod identity;
mod masks;

pub use identity::Identity;
pub use masks::Masks;

/// A write on its way; it owns what it needs.
pub type Writing = Pin<Box<dyn Future<Output = Result<(), Exception>> + Send>>;

/// What is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Write {
    /// Coils from `start` on.
    Coils {
        /// The first.
        start: u16,
        /// On or off, at least one.
        bits: Vec<bool>,
    },
    /// Holding registers from `start` on.
    Registers {
        /// The first.
        start: u16,
        /// At least one.
        words: Vec<u16>,
    },
}

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Client {
    /// Its address.
    pub address: SocketAddr,
    /// The role in its certificate; none without TLS, or where the certificate has none.
    pub role: Option<String>,
}

impl fmt::Display for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.address.fmt(f)?;
        match &self.role {
            Some(role) => write!(f, " (role {role})"),
            None => Ok(()),
        }
    }
}

/// The registers behind a server. Addresses never pass 65,535: who asks beyond has been refused.
pub trait Registers: Send + Sync + 'static {
    /// Is there such a unit?
    ///
    /// # Errors
    /// The exception for the client, where there is none.
    fn unit(&self, unit: u8) -> Result<(), Exception>;

    /// May this client ask anything at all?
    ///
    /// # Errors
    /// The exception for the client; by Modbus/TCP Security, 1 to one whose role may not.
    fn admits(&self, client: &Client) -> Result<(), Exception> {
        let _ = client;
        Ok(())
    }

    /// Coils or discrete inputs. It answers from memory: it never waits.
    ///
    /// # Errors
    /// The exception for the client.
    fn bits(&self, table: Table, start: u16, count: u16) -> Result<Vec<bool>, Exception>;

    /// Registers, as for [`Registers::bits`].
    ///
    /// # Errors
    /// The exception for the client.
    fn words(&self, table: Table, start: u16, count: u16) -> Result<Vec<u16>, Exception>;

    /// Writes, all of it or nothing as far as can be told before; it may wait, with a bound of its own.
    fn write(&self, client: &Client, write: Write) -> Writing;

    /// Who the server is.
    fn identity(&self) -> &Identity;
}

/// How clients are received.
#[derive(Clone)]
pub struct ServerOptions {
    /// Its name in the log.
    pub name: String,
    /// Clients at once; a further one is closed at once.
    pub connections_max: usize,
    /// A client that sends no whole request for so long is closed.
    pub idle: Duration,
    /// Encrypted, with clients that show a certificate.
    pub tls: Option<TlsAcceptor>,
}

impl fmt::Debug for ServerOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ServerOptions")
            .field("name", &self.name)
            .field("connections_max", &self.connections_max)
            .field("idle", &self.idle)
            .field("tls", &self.tls.is_some())
            .finish()
    }
}

/// What a server has seen since its start.
#[derive(Debug, Default)]
pub struct ServerCounts {
    /// Clients that are connected now.
    pub open: AtomicU64,
    /// Clients that were let in.
    pub accepted: AtomicU64,
    /// Clients that found no place.
    pub refused: AtomicU64,
    /// Requests that were answered, exceptions among them.
    pub requests: AtomicU64,
    /// Answers that were exceptions.
    pub exceptions: AtomicU64,
    /// Connections that were closed because what came was no Modbus, or no TLS.
    pub malformed: AtomicU64,
}

/// Serves until `stop` is true or its sender is gone, then lets requests under way end, with a bound.
pub async fn serve(
    listener: TcpListener,
    options: ServerOptions,
    registers: Arc<dyn Registers>,
    counts: Arc<ServerCounts>,
    mut stop: watch::Receiver<bool>,
) {
    let places = Arc::new(Semaphore::new(options.connections_max));
    let masks = Arc::new(Masks::default());
    let mut clients = JoinSet::new();
    let mut full = false;
    loop {
        // Those that have ended give their memory back.
        while clients.try_join_next().is_some() {}
        let accepted = tokio::select! {
            _ = stop.wait_for(|stop| *stop) => break,
            accepted = listener.accept() => accepted,
        };
        let (stream, address) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                // Too many open files, most likely; it passes, or the log says that it does not.
                tracing::warn!(server = %options.name, %error, "a client could not be accepted");
                sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else {
            counts.refused.fetch_add(1, Ordering::Relaxed);
            if !std::mem::replace(&mut full, true) {
                let most = options.connections_max;
                tracing::warn!(server = %options.name, client = %address, "all {most} places are taken: clients are refused");
            }
            continue;
        };
        full = false;
        counts.accepted.fetch_add(1, Ordering::Relaxed);
        let one = Connected {
            client: Client { address, role: None },
            options: options.clone(),
            registers: Arc::clone(&registers),
            masks: Arc::clone(&masks),
            counts: Arc::clone(&counts),
            stop: stop.clone(),
            _place: place,
        };
        clients.spawn(one.live(stream));
    }
    drop(listener);
    let ended = timeout(Duration::from_millis(SERVER_STOP_MS_MAX), async {
        while clients.join_next().await.is_some() {}
    });
    if ended.await.is_err() {
        tracing::warn!(server = %options.name, "requests under way did not end in time");
        clients.shutdown().await;
    }
}

/// One client.
struct Connected {
    client: Client,
    options: ServerOptions,
    registers: Arc<dyn Registers>,
    masks: Arc<Masks>,
    counts: Arc<ServerCounts>,
    stop: watch::Receiver<bool>,
    _place: OwnedSemaphorePermit,
}

/// Why a connection ended, where it is worth a word.
enum End {
    Done,
    NoModbus(String),
}

impl Connected {
    async fn live(mut self, stream: TcpStream) {
        self.counts.open.fetch_add(1, Ordering::Relaxed);
        // Small answers must leave at once. Where the system refuses, they leave a little later.
        let _ = stream.set_nodelay(true);
        let end = match self.options.tls.clone() {
            None => self.talk(stream).await,
            Some(acceptor) => {
                // A handshake may take as long as a request.
                let shaken = tokio::select! {
                    _ = self.stop.wait_for(|stop| *stop) => None,
                    shaken = timeout(self.options.idle, acceptor.accept(stream)) => Some(shaken),
                };
                match shaken {
                    None => Ok(End::Done),
                    Some(Ok(Ok(stream))) => {
                        let certificates = stream.get_ref().1.peer_certificates();
                        self.client.role = certificates.and_then(|chain| role_of(chain.first()?));
                        self.talk(stream).await
                    }
                    Some(Ok(Err(error))) => Ok(End::NoModbus(format!("TLS: {error}"))),
                    Some(Err(_)) => Ok(End::NoModbus(
                        "TLS: the client did not finish its part in time".to_owned(),
                    )),
                }
            }
        };
        self.counts.open.fetch_sub(1, Ordering::Relaxed);
        match end {
            Ok(End::Done) => {}
            Ok(End::NoModbus(problem)) => {
                self.counts.malformed.fetch_add(1, Ordering::Relaxed);
                tracing::warn!(server = %self.options.name, client = %self.client, "closed: {problem}");
            }
            Err(error) => tracing::debug!(server = %self.options.name, client = %self.client, %error, "closed"),
        }
    }

    async fn talk(&mut self, mut stream: impl AsyncRead + AsyncWrite + Unpin) -> io::Result<End> {
        let mut waiting = Vec::with_capacity(FRAME_BYTES_MAX);
        let mut piece = [0; FRAME_BYTES_MAX];
        loop {
            let until = Instant::now() + self.options.idle;
            let (transaction, unit, pdu) = loop {
                match cut_header(&waiting) {
                    Cut::Broken(problem) => return Ok(End::NoModbus(problem)),
                    Cut::Frame {
                        transaction,
                        unit,
                        pdu,
                        end,
                    } => {
                        let bytes = waiting.get(pdu).map(<[u8]>::to_vec).unwrap_or_default();
                        waiting.drain(..end);
                        break (transaction, unit, bytes);
                    }
                    Cut::More => {}
                }
                let count = tokio::select! {
                    _ = self.stop.wait_for(|stop| *stop) => return Ok(End::Done),
                    read = timeout_at(until, stream.read(&mut piece)) => match read {
                        Ok(read) => read?,
                        Err(_) => return Ok(End::Done),
                    },
                };
                if count == 0 {
                    return Ok(End::Done);
                }
                // At most one frame more than what is looked at, so it stays small.
                waiting.extend(piece.get(..count).unwrap_or_default());
            };
            let answer = answer(self.registers.as_ref(), &self.masks, &self.client, unit, &pdu).await;
            self.counts.requests.fetch_add(1, Ordering::Relaxed);
            if answer.first().is_some_and(|function| function & EXCEPTION_BIT != 0) {
                self.counts.exceptions.fetch_add(1, Ordering::Relaxed);
            }
            let frame = with_header(transaction, unit, &answer);
            let sending = async {
                stream.write_all(&frame).await?;
                stream.flush().await
            };
            match timeout(Duration::from_millis(SERVER_SEND_MS_MAX), sending).await {
                Ok(sent) => sent?,
                // It reads nothing: whatever it was, it has gone.
                Err(_) => return Ok(End::Done),
            }
        }
    }
}

/// The answer to the bytes of one request.
pub async fn answer(registers: &dyn Registers, masks: &Masks, client: &Client, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let function = pdu.first().copied().unwrap_or(0);
    let refused = |exception: Exception| vec![function | EXCEPTION_BIT, exception.0];
    if let Err(exception) = registers.admits(client).and_then(|()| registers.unit(unit)) {
        return refused(exception);
    }
    let request = match Request::parse(pdu) {
        Ok(request) => request,
        Err(exception) => return refused(exception),
    };
    let answered = answered(registers, masks, client, &request).await;
    request.respond(&answered)
}

async fn answered(
    registers: &dyn Registers,
    masks: &Masks,
    client: &Client,
    request: &Request,
) -> Result<Answer, Exception> {
    let write = |write: Write| registers.write(client, write);
    match request {
        Request::Read { table, start, count } if table.is_bits() => {
            registers.bits(*table, *start, *count).map(Answer::Bits)
        }
        Request::Read { table, start, count } => registers.words(*table, *start, *count).map(Answer::Words),
        Request::WriteCoil { address, on } => {
            let bits = vec![*on];
            write(Write::Coils { start: *address, bits }).await?;
            Ok(Answer::Done)
        }
        Request::WriteCoils { start, bits } => {
            let bits = bits.clone();
            write(Write::Coils { start: *start, bits }).await?;
            Ok(Answer::Done)
        }
        Request::WriteRegister { address, word } => {
            let _shared = masks.beside(*address, 1).await;
            let words = vec![*word];
            write(Write::Registers { start: *address, words }).await?;
            Ok(Answer::Done)
        }
        Request::WriteRegisters { start, words } => {
            let _shared = masks.beside(*start, words.len()).await;
            let words = words.clone();
            write(Write::Registers { start: *start, words }).await?;
            Ok(Answer::Done)
        }
        Request::MaskWrite { address, and, or } => {
            let mut alone = masks.alone().await;
            let held = registers.words(Table::Holding, *address, 1)?;
            let held = held.first().copied().ok_or(Exception::FAILURE)?;
            let base = alone.base(*address, held, Instant::now());
            let word = (base & and) | (or & !and);
            write(Write::Registers {
                start: *address,
                words: vec![word],
            })
            .await?;
            alone.remember(*address, held, word, Instant::now());
            Ok(Answer::Done)
        }
        Request::ReadWrite {
            read_start,
            read_count,
            write_start,
            words,
        } => {
            // What cannot be read must not be found out after the write.
            registers.words(Table::Holding, *read_start, *read_count)?;
            let start = *write_start;
            let words = words.clone();
            let _shared = masks.beside(start, words.len()).await;
            write(Write::Registers { start, words }).await?;
            registers
                .words(Table::Holding, *read_start, *read_count)
                .map(Answer::Words)
        }
        Request::Identify { depth, object } => registers.identity().answer(*depth, *object),
    }
}

#[cfg(test)]
mod tests;
