//! One connection to a device: a request goes out, its answer comes back, within a time.
//!
//! ```text
//! idle ──call──► sent ──the answer──► idle
//!                  ├─ an answer to another request: passed over (it came too late for its own)
//!                  ├─ time over: idle, and on TCP still sound, for answers carry the number of their request
//!                  └─ closed, or no Modbus: the connection is over
//! ```
//!
//! Never: sends a second request before the first has ended; decides when to ask again (that is `link`).

use std::{
    io,
    pin::Pin,
    task::{Context, Poll},
    time::Duration,
};

use tokio::{
    io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, ReadBuf},
    time::{Instant, sleep_until, timeout_at},
};

use super::{
    exception::Exception,
    frame::{Cut, Framing, cut_header, find_answer, with_checksum, with_header},
    request::{Answer, Fault, Request},
};

/// Bytes that may wait to be understood: some answers that came late, or noise; more is no Modbus.
const WAITING_BYTES_MAX: usize = 4096;

/// A stream of bytes to a device.
pub(crate) trait Stream: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Stream for T {}

/// How a request went wrong.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Failure {
    /// The device answered with an exception; the connection is sound.
    Exception(Exception),
    /// No answer in time; in words.
    Silent(String),
    /// The device's answer is not one to the question; the connection is sound.
    Malformed(String),
    /// The connection is gone, or what comes over it is no Modbus.
    Lost(String),
    /// Nothing was sent: another host is the device's master.
    Fenced,
}

/// A connection.
pub(crate) struct Connection {
    stream: Box<dyn Stream>,
    framing: Framing,
    /// Silence that a serial line needs before a request.
    pause: Duration,
    /// Is it a line that other devices share, so that what comes unasked is noise?
    line: bool,
    transaction: u16,
    waiting: Vec<u8>,
    last_byte: Instant,
}

impl std::fmt::Debug for Connection {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Connection")
            .field("framing", &self.framing)
            .field("transaction", &self.transaction)
            .finish_non_exhaustive()
    }
}

impl Connection {
    /// Over a network, with or without TLS.
    pub(crate) fn over_network(stream: impl Stream + 'static, framing: Framing) -> Self {
        Self {
            stream: Box::new(stream),
            framing,
            pause: Duration::ZERO,
            line: false,
            transaction: 0,
            waiting: Vec::new(),
            last_byte: Instant::now(),
        }
    }

    /// Over a serial line, whose silence between frames is `pause`.
    pub(crate) fn over_line(stream: impl Stream + 'static, pause: Duration) -> Self {
        Self {
            pause,
            line: true,
            ..Self::over_network(stream, Framing::Rtu)
        }
    }

    /// May a request be asked again on this connection after one that was not answered? Without numbers a late answer
    /// could be taken for the next one's, except on a line, which is listened to until it is silent.
    pub(crate) const fn outlives_silence(&self) -> bool {
        matches!(self.framing, Framing::Tcp) || self.line
    }

    /// One request and its answer, within `longest`.
    pub(crate) async fn call(&mut self, unit: u8, request: &Request, longest: Duration) -> Result<Answer, Failure> {
        let until = Instant::now() + longest;
        if self.framing == Framing::Rtu {
            self.hush(until).await?;
        }
        self.transaction = self.transaction.wrapping_add(1);
        let pdu = request.encode();
        let frame = match self.framing {
            Framing::Tcp => with_header(self.transaction, unit, &pdu),
            Framing::Rtu => with_checksum(unit, &pdu),
        };
        let sending = async {
            self.stream.write_all(&frame).await?;
            self.stream.flush().await
        };
        match timeout_at(until, sending).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return Err(Failure::Lost(error.to_string())),
            // Half of it may be on its way, so nothing can follow.
            Err(_) => {
                return Err(Failure::Lost(format!(
                    "it could not be sent within {} ms",
                    longest.as_millis()
                )));
            }
        }
        loop {
            match self.look(unit, request.function())? {
                Some(pdu) => return request.answer(&pdu).map_err(Failure::from),
                None => match self.receive(until).await? {
                    true => {}
                    false => return Err(self.silent(longest)),
                },
            }
        }
    }

    /// The answer, where it is there.
    fn look(&mut self, unit: u8, function: u8) -> Result<Option<Vec<u8>>, Failure> {
        if self.framing == Framing::Rtu {
            let found = find_answer(&self.waiting, unit, function);
            let pdu = found.and_then(|range| self.waiting.get(range)).map(<[u8]>::to_vec);
            if pdu.is_some() {
                self.waiting.clear();
            }
            return Ok(pdu);
        }
        loop {
            match cut_header(&self.waiting) {
                Cut::More => return Ok(None),
                Cut::Broken(problem) => return Err(Failure::Lost(problem)),
                Cut::Frame {
                    transaction,
                    unit: from,
                    pdu,
                    end,
                } => {
                    let bytes = self.waiting.get(pdu).map(<[u8]>::to_vec).unwrap_or_default();
                    self.waiting.drain(..end);
                    if transaction != self.transaction {
                        // It came too late for its own request.
                        continue;
                    }
                    if from != unit {
                        return Err(Failure::Malformed(format!("the answer is unit {from}'s")));
                    }
                    return Ok(Some(bytes));
                }
            }
        }
    }

    /// Some more bytes; false where the time is over.
    async fn receive(&mut self, until: Instant) -> Result<bool, Failure> {
        let mut piece = [0; 512];
        let count = match timeout_at(until, self.stream.read(&mut piece)).await {
            Err(_) => return Ok(false),
            Ok(Ok(0)) => return Err(Failure::Lost("the device closed the connection".to_owned())),
            Ok(Ok(count)) => count,
            Ok(Err(error)) if error.kind() == io::ErrorKind::UnexpectedEof => {
                return Err(Failure::Lost("the device closed the connection".to_owned()));
            }
            Ok(Err(error)) => return Err(Failure::Lost(error.to_string())),
        };
        self.last_byte = Instant::now();
        self.waiting.extend(piece.get(..count).unwrap_or_default());
        if self.waiting.len() > WAITING_BYTES_MAX {
            let problem = format!("{WAITING_BYTES_MAX} bytes came that are no answer");
            if !self.line {
                return Err(Failure::Lost(problem));
            }
            self.waiting.clear();
        }
        Ok(true)
    }

    /// Passes over what came unasked, and waits until the line has been silent for its pause.
    async fn hush(&mut self, until: Instant) -> Result<(), Failure> {
        loop {
            self.waiting.clear();
            match unasked(&mut self.stream).await {
                Some(Ok(0)) => return Err(Failure::Lost("the device closed the connection".to_owned())),
                Some(Ok(_)) => self.last_byte = Instant::now(),
                Some(Err(error)) => return Err(Failure::Lost(error.to_string())),
                None => {
                    let silent = self.last_byte + self.pause;
                    if silent <= Instant::now() {
                        return Ok(());
                    }
                    sleep_until(silent).await;
                }
            }
            if Instant::now() >= until {
                return Err(Failure::Silent("the line was never silent".to_owned()));
            }
        }
    }

    fn silent(&mut self, longest: Duration) -> Failure {
        let damaged = self.framing == Framing::Rtu && !self.waiting.is_empty();
        let bytes = self.waiting.len();
        let within = format!("no answer within {} ms", longest.as_millis());
        Failure::Silent(if damaged {
            format!("{within}; {bytes} bytes came without a good checksum: check baud, parity and wiring")
        } else {
            within
        })
    }

    /// Ends it, so that the device sees an orderly end.
    pub(crate) async fn close(&mut self) {
        // One that does not care is left to the system.
        let _ = self.stream.shutdown().await;
    }
}

/// What is there now, without waiting: a read of some bytes, or none.
async fn unasked(stream: &mut Box<dyn Stream>) -> Option<io::Result<usize>> {
    let mut piece = [0; 512];
    std::future::poll_fn(|context: &mut Context<'_>| {
        let mut buffer = ReadBuf::new(&mut piece);
        Poll::Ready(match Pin::new(&mut *stream).poll_read(context, &mut buffer) {
            Poll::Ready(result) => Some(result.map(|()| buffer.filled().len())),
            Poll::Pending => None,
        })
    })
    .await
}

impl From<Fault> for Failure {
    fn from(fault: Fault) -> Self {
        match fault {
            Fault::Exception(exception) => Self::Exception(exception),
            Fault::Malformed(text) => Self::Malformed(text),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]
    use proptest::prelude::*;
    use tokio::io::duplex;

    use super::*;
    use crate::modbus::Table;

    const LONGEST: Duration = Duration::from_secs(5);

    fn read(count: u16) -> Request {
        Request::Read {
            table: Table::Holding,
            start: 0,
            count,
        }
    }

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .start_paused(true)
            .build()
            .unwrap()
    }

    #[test]
    fn late_answers_are_passed_over_and_the_own_one_taken() {
        runtime().block_on(async {
            let (near, mut far) = duplex(4096);
            let mut connection = Connection::over_network(near, Framing::Tcp);
            let silent = connection.call(1, &read(1), LONGEST).await;
            assert_eq!(silent, Err(Failure::Silent("no answer within 5000 ms".to_owned())));
            // The first request is answered when the second has been asked.
            far.write_all(&with_header(1, 1, &[3, 2, 0, 11])).await.unwrap();
            far.write_all(&with_header(2, 1, &[3, 2, 0, 22])).await.unwrap();
            assert_eq!(connection.call(1, &read(1), LONGEST).await, Ok(Answer::Words(vec![22])));
            far.write_all(&with_header(3, 9, &[3, 2, 0, 22])).await.unwrap();
            let other = connection.call(1, &read(1), LONGEST).await;
            assert_eq!(other, Err(Failure::Malformed("the answer is unit 9's".to_owned())));
        });
    }

    #[test]
    fn a_line_is_listened_to_until_it_is_silent() {
        runtime().block_on(async {
            let (near, mut far) = duplex(4096);
            let mut connection = Connection::over_line(near, Duration::from_millis(4));
            far.write_all(b"noise").await.unwrap();
            let device = async {
                let mut asked = [0; 8];
                far.read_exact(&mut asked).await.unwrap();
                // The line echoes, then the device answers.
                far.write_all(&asked).await.unwrap();
                far.write_all(&with_checksum(1, &[3, 2, 0, 7])).await.unwrap();
            };
            let one = read(1);
            let (answer, ()) = tokio::join!(connection.call(1, &one, LONGEST), device);
            assert_eq!(answer, Ok(Answer::Words(vec![7])));
            let mut damaged = with_checksum(1, &[3, 2, 0, 7]);
            damaged[3] = 9;
            let device = async {
                let mut asked = [0; 8];
                far.read_exact(&mut asked).await.unwrap();
                far.write_all(&damaged).await.unwrap();
            };
            let one = read(1);
            let (answer, ()) = tokio::join!(connection.call(1, &one, LONGEST), device);
            match answer {
                Err(Failure::Silent(text)) => assert!(text.contains("7 bytes came without a good checksum"), "{text}"),
                other => panic!("{other:?}"),
            }
            drop(far);
            let lost = connection.call(1, &read(1), LONGEST).await;
            assert_eq!(lost, Err(Failure::Lost("the device closed the connection".to_owned())));
        });
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// Whatever a peer sends, in whatever pieces, a call ends in an answer or in words.
        #[test]
        fn random_bytes_from_a_peer_are_survived(
            pieces in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..80), 0..12),
            rtu in any::<bool>(),
            valid in 0..3_u8,
        ) {
            let framing = if rtu { Framing::Rtu } else { Framing::Tcp };
            runtime().block_on(async move {
                let (near, mut far) = duplex(64 * 1024);
                let mut connection = Connection::over_network(near, framing);
                let peer = async move {
                    let mut asked = [0; 8];
                    far.read_exact(&mut asked).await.unwrap();
                    // Sometimes the header is right, so that what is behind it is looked at.
                    if valid == 1 {
                        far.write_all(&[0, 1, 0, 0, 0, 20, 1, 3]).await.unwrap();
                    }
                    for piece in pieces {
                        if far.write_all(&piece).await.is_err() {
                            return None;
                        }
                    }
                    // Kept open, so that silence is met too.
                    (valid != 2).then_some(far)
                };
                let three = read(3);
                let (answer, _far) = tokio::join!(connection.call(1, &three, LONGEST), peer);
                match answer {
                    Ok(Answer::Words(words)) => assert_eq!(words.len(), 3),
                    Ok(other) => panic!("{other:?}"),
                    Err(_) => {}
                }
            });
        }
    }
}
