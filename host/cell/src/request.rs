//! Requests with replies, on Zenoh queries: slower than the cycle lanes, but they end by themselves.
//!
//! Owns: the envelope of requests and replies, the limit on those in flight. Never: runs on a cycle's thread.
//!
//! ```text
//! asker                                          host
//! request ──── query, attachment [version] ────► Arrival::Request ── Responder
//!    │ Ok / Refused ◄── reply, attachment [version, 0 | 1] ── reply(Ok | Err) or dropped
//!    │ NoSuchHost   ◄── closed without a reply: absent, died, or went
//!    │ Timeout      ◄── error reply of the asker's own Zenoh
//! ```
//!
//! Versions travel beside the payload, so a component is not copied to put a byte in front of it. Zenoh's own error
//! replies are its time-out alone: a refusal is an ordinary reply, and the two cannot be taken for each other.

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use bumpless_core::HostId;
use parking_lot::Mutex;
use tokio::{runtime::Handle, sync::oneshot};
use zenoh::{
    Wait,
    bytes::ZBytes,
    qos::{CongestionControl, Priority},
    query::{ConsolidationMode, Query, Reply},
};

use crate::{
    error::{Error, cut},
    limits::{REFUSAL_CHARS_MAX, REQUEST_BYTES_MAX, REQUEST_TIMEOUT_MS_MAX, REQUESTS_IN_FLIGHT_MAX},
    session::Shared,
    wire::VERSION,
};

const DONE: u8 = 0;
const REFUSED: u8 = 1;

/// A place among the requests that a host answers at a time.
#[derive(Debug)]
pub(crate) struct Place(Arc<AtomicUsize>);

impl Place {
    /// Takes one, if there is one.
    pub(crate) fn take(in_flight: &Arc<AtomicUsize>) -> Option<Self> {
        in_flight
            .fetch_update(Ordering::AcqRel, Ordering::Acquire, |taken| {
                (taken < REQUESTS_IN_FLIGHT_MAX).then_some(taken + 1)
            })
            .ok()
            .map(|_| Self(Arc::clone(in_flight)))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

/// Takes the reply to one request, from any thread and at any time until the asker's patience ends.
///
/// Dropped without a reply, it refuses, so the asker never waits for a bug.
pub struct Responder {
    pending: Option<(Query, Place)>,
    runtime: Handle,
}

impl fmt::Debug for Responder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Responder")
            .field("pending", &self.pending.is_some())
            .finish()
    }
}

impl Responder {
    pub(crate) const fn new(query: Query, place: Place, runtime: Handle) -> Self {
        Self {
            pending: Some((query, place)),
            runtime,
        }
    }

    /// Replies: bytes, or a refusal in words (at most 4,096 characters are sent). More than
    /// [`REQUEST_BYTES_MAX`] bytes become a refusal.
    ///
    /// Never blocks: the sending waits for the link on a thread of the runtime's blocking pool.
    pub fn reply(mut self, reply: Result<Vec<u8>, String>) {
        self.answer(reply);
    }

    fn answer(&mut self, reply: Result<Vec<u8>, String>) {
        let Some((query, place)) = self.pending.take() else {
            return;
        };
        let reply = reply.and_then(|bytes| {
            if bytes.len() > REQUEST_BYTES_MAX {
                Err(format!(
                    "the reply has {} bytes, at most {REQUEST_BYTES_MAX} are carried",
                    bytes.len()
                ))
            } else {
                Ok(bytes)
            }
        });
        // Not awaited: the reply's fate shows at the asker.
        drop(self.runtime.spawn_blocking(move || {
            send(&query, reply);
            drop(place);
        }));
    }
}

impl Drop for Responder {
    fn drop(&mut self) {
        self.answer(Err("the host dropped the request without a reply".to_owned()));
    }
}

/// Replies to a query; waits for the link at most [`REPLY_WAIT_US_MAX`](crate::limits::REPLY_WAIT_US_MAX).
pub(crate) fn send(query: &Query, reply: Result<Vec<u8>, String>) {
    let (kind, bytes) = match reply {
        Ok(bytes) => (DONE, bytes),
        Err(reason) => (REFUSED, cut(&reason, REFUSAL_CHARS_MAX).into_bytes()),
    };
    let sent = query
        .reply(query.key_expr().clone(), bytes)
        .attachment(vec![VERSION, kind])
        .wait();
    if let Err(error) = sent {
        tracing::debug!(key = %query.key_expr(), %error, "a reply could not be sent");
    }
}

/// What a request holds, or why it is none.
pub(crate) fn payload(query: &Query) -> Result<Vec<u8>, Error> {
    version("request", query.attachment(), 1)?;
    let bytes = query.payload().map_or(0, ZBytes::len);
    if bytes > REQUEST_BYTES_MAX {
        return Err(Error::TooLarge {
            what: "request",
            bytes,
            limit: REQUEST_BYTES_MAX,
        });
    }
    Ok(query
        .payload()
        .map(|payload| payload.to_bytes().into_owned())
        .unwrap_or_default())
}

/// Checks the attachment `[version, …]` of `length` bytes and gives it back.
fn version(what: &'static str, attachment: Option<&ZBytes>, length: usize) -> Result<Vec<u8>, Error> {
    let undecodable = |bytes, reason: &str| Error::Undecodable {
        what,
        bytes,
        reason: reason.to_owned(),
    };
    let attachment = attachment.ok_or_else(|| undecodable(0, "it has no version"))?;
    if attachment.len() != length {
        return Err(undecodable(attachment.len(), "its version has the wrong length"));
    }
    let attachment = attachment.to_bytes().into_owned();
    match attachment.first() {
        Some(&VERSION) => Ok(attachment),
        Some(&found) => Err(Error::Version {
            what,
            found,
            spoken: VERSION,
        }),
        None => Err(undecodable(0, "it has no version")),
    }
}

/// Asks a host, and waits.
pub(crate) async fn ask(
    shared: Arc<Shared>,
    key: String,
    to: &HostId,
    payload: Vec<u8>,
    timeout: Duration,
) -> Result<Vec<u8>, Error> {
    if payload.len() > REQUEST_BYTES_MAX {
        return Err(Error::TooLarge {
            what: "request",
            bytes: payload.len(),
            limit: REQUEST_BYTES_MAX,
        });
    }
    let timeout = timeout.clamp(Duration::from_millis(1), Duration::from_millis(REQUEST_TIMEOUT_MS_MAX));
    let timeout_ms = u64::try_from(timeout.as_millis()).unwrap_or(REQUEST_TIMEOUT_MS_MAX);
    let (sender, receiver) = oneshot::channel();
    let sender = Mutex::new(Some(sender));
    // Sending a large payload waits for the link, so it does not happen on a thread of the runtime that others share.
    let sending = tokio::task::spawn_blocking(move || {
        shared
            .zenoh()?
            .get(key)
            .payload(payload)
            .attachment(vec![VERSION])
            .consolidation(ConsolidationMode::None)
            .congestion_control(CongestionControl::Block)
            .priority(Priority::DataLow)
            .timeout(timeout)
            // Dropped by Zenoh when the query ends; without a reply until then, the channel closes.
            .callback(move |reply: Reply| {
                if let Some(sender) = sender.lock().take() {
                    // The asker may have stopped waiting.
                    let _ = sender.send(reply);
                }
            })
            .wait()
            .map_err(|source| Error::Send {
                what: "request",
                source,
            })
    });
    let answered = async {
        match sending.await {
            Ok(sent) => sent?,
            // The runtime is stopping.
            Err(_) => return Err(Error::NoSuchHost { host: to.clone() }),
        }
        receiver.await.map_err(|_| Error::NoSuchHost { host: to.clone() })
    };
    // Zenoh keeps the time; this one only covers a send that is stuck behind a full link.
    let reply = tokio::time::timeout(timeout + Duration::from_millis(200), answered)
        .await
        .map_err(|_| Error::Timeout {
            host: to.clone(),
            timeout_ms,
        })??;
    let Ok(sample) = reply.result() else {
        return Err(Error::Timeout {
            host: to.clone(),
            timeout_ms,
        });
    };
    let bytes = sample.payload().len();
    if bytes > REQUEST_BYTES_MAX {
        return Err(Error::TooLarge {
            what: "reply",
            bytes,
            limit: REQUEST_BYTES_MAX,
        });
    }
    match version("reply", sample.attachment(), 2)?.get(1) {
        Some(&DONE) => Ok(sample.payload().to_bytes().into_owned()),
        Some(&REFUSED) => Err(Error::Refused {
            host: to.clone(),
            reason: cut(
                &String::from_utf8_lossy(&sample.payload().to_bytes()),
                REFUSAL_CHARS_MAX,
            ),
        }),
        _ => Err(Error::Undecodable {
            what: "reply",
            bytes,
            reason: "it neither gives nor refuses".to_owned(),
        }),
    }
}
