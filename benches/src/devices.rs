//! The other process of `io`: simulated Modbus devices, one of which can be told to take its time.
//!
//! ```text
//! starts ─► one line on standard output: the ports ─► serves ── "slow 2000" / "slow 0" on standard input: the first device's delay
//!                                                        └─ standard input ends: ends
//! ```
//! Each register counts what was asked of its device, so that every read is fresh. Never: outlives the process that started
//! it, because that one holds the other end of the standard input.

use std::{
    io::{BufRead as _, Read as _, Write as _},
    net::{TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use bumpless_io::modbus::{
    Answer, Exception, Request,
    frame::{Cut, cut_header, with_header},
};

use crate::{error::Error, report};

/// Serves until the standard input ends.
pub(crate) fn run(count: u16) -> Result<(), Error> {
    let slow_ms: Arc<AtomicU64> = Arc::default();
    let mut ports = Vec::new();
    for number in 0..count {
        let listener = TcpListener::bind("127.0.0.1:0").map_err(Error::io("a device cannot listen"))?;
        ports.push(
            listener
                .local_addr()
                .map_err(Error::io("a device has no address"))?
                .port(),
        );
        let delay = if number == 0 {
            Arc::clone(&slow_ms)
        } else {
            Arc::default()
        };
        spawn("device", move || {
            for stream in listener.incoming().flatten() {
                let delay = Arc::clone(&delay);
                // A connection that cannot have its thread is closed, and tried again.
                let _ = spawn("connection", move || serve(stream, &delay));
            }
        })?;
    }
    let line = serde_json::to_string(&ports).unwrap_or_default();
    report::say(&line);
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        if let Some(ms) = line.strip_prefix("slow ").and_then(|text| text.trim().parse().ok()) {
            slow_ms.store(ms, Ordering::Relaxed);
        }
    }
    Ok(())
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), Error> {
    let thread = std::thread::Builder::new().name(name.to_owned()).spawn(work);
    thread
        .map(drop)
        .map_err(Error::io("a device's thread cannot be started"))
}

fn serve(mut stream: TcpStream, slow_ms: &AtomicU64) {
    let _ = stream.set_nodelay(true);
    let (mut waiting, mut piece, mut asked) = (Vec::new(), [0; 512], 0_u16);
    loop {
        match cut_header(&waiting) {
            Cut::Broken(_) => return,
            Cut::More => match stream.read(&mut piece) {
                Ok(count @ 1..) => waiting.extend(piece.get(..count).unwrap_or_default()),
                _ => return,
            },
            Cut::Frame {
                transaction,
                unit,
                pdu,
                end,
            } => {
                let bytes: Vec<u8> = waiting.get(pdu).map(<[u8]>::to_vec).unwrap_or_default();
                waiting.drain(..end);
                let delay_ms = slow_ms.load(Ordering::Relaxed);
                if delay_ms > 0 {
                    std::thread::sleep(Duration::from_millis(delay_ms));
                }
                asked = asked.wrapping_add(1) % 1000;
                let answer = match Request::parse(&bytes) {
                    Ok(request) => request.respond(&answered(&request, asked)),
                    Err(exception) => vec![bytes.first().copied().unwrap_or(0) | 0x80, exception.0],
                };
                if stream.write_all(&with_header(transaction, unit, &answer)).is_err() {
                    return;
                }
            }
        }
    }
}

fn answered(request: &Request, asked: u16) -> Result<Answer, Exception> {
    match request {
        Request::Read { table, count, .. } if table.is_bits() => {
            Ok(Answer::Bits(vec![asked % 2 == 1; usize::from(*count)]))
        }
        Request::Read { count, .. } => Ok(Answer::Words(vec![asked; usize::from(*count)])),
        Request::Identify { .. } | Request::ReadWrite { .. } => Err(Exception::FUNCTION),
        _ => Ok(Answer::Done),
    }
}
