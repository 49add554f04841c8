//! Doors: what programs that are no hosts may ask over the bus, in plain JSON, with any Zenoh client.
//!
//! ```text
//! program ── get bumpless/<cell>/open/<door>/<host>, payload ──► host ── Knock ──► whoever opened the door
//!         ◄── one reply, JSON ───────────────────────────────────────────────────────┘
//!         ◄── put bumpless/<cell>/open/<door>/<host>/<what> ──── what became of it, to all who listen
//! ```
//!
//! Owns: the keys, the bounds on bytes and on questions at a time. Never: reads a payload, or answers a question that was put
//! to several hosts at once: what is asked is done, so it must be asked of one.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use tokio::runtime::Handle;
use zenoh::{
    Wait,
    bytes::{Encoding, ZBytes},
    qos::CongestionControl,
    query::Query,
};

use crate::{
    error::Error,
    limits::{DOOR_ASKED_MAX, DOOR_BYTES_MAX},
    session::Session,
};

/// A question at a door.
pub struct Knock {
    /// What was asked; at most [`DOOR_BYTES_MAX`] bytes.
    pub payload: Vec<u8>,
    query: Query,
    runtime: Handle,
    _place: Place,
}

impl std::fmt::Debug for Knock {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Knock")
            .field("bytes", &self.payload.len())
            .finish_non_exhaustive()
    }
}

/// One of the questions that a door bears at a time.
struct Place(Arc<AtomicUsize>);

impl Place {
    fn take(asked: &Arc<AtomicUsize>) -> Option<Self> {
        asked
            .fetch_update(Ordering::AcqRel, Ordering::Acquire, |taken| {
                (taken < DOOR_ASKED_MAX).then_some(taken + 1)
            })
            .ok()
            .map(|_| Self(Arc::clone(asked)))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Knock {
    /// Answers, with JSON. Dropped without an answer, the asker is told by its own Zenoh that there is none.
    ///
    /// Never blocks: the sending waits for the link on a thread of the runtime's blocking pool.
    pub fn answer(self, json: Vec<u8>) {
        let runtime = self.runtime.clone();
        // Not awaited: the reply's fate shows at the asker.
        drop(runtime.spawn_blocking(move || {
            let key = self.query.key_expr().clone();
            let sent = self.query.reply(key, json).encoding(Encoding::APPLICATION_JSON).wait();
            if let Err(error) = sent {
                tracing::debug!(key = %self.query.key_expr(), %error, "an answer at a door could not be sent");
            }
        }));
    }
}

/// Tells an asker in Zenoh's own way why there is no answer.
fn turn_away(query: Query, reason: String, runtime: &Handle) {
    drop(runtime.spawn_blocking(move || {
        if let Err(error) = query.reply_err(reason).wait() {
            tracing::debug!(key = %query.key_expr(), %error, "an asker at a door could not be turned away");
        }
    }));
}

impl Session {
    /// Opens a door of this host. `answers` runs on Zenoh's threads and must not block.
    ///
    /// # Errors
    /// [`Error::Declare`], [`Error::Closed`].
    pub fn open_door(&self, door: &str, answers: impl Fn(Knock) + Send + Sync + 'static) -> Result<(), Error> {
        let key = self.shared.inbox.keys.door(door, self.host());
        let (own, runtime, asked) = (key.clone(), self.shared.inbox.runtime.clone(), Arc::default());
        self.shared
            .zenoh()?
            .declare_queryable(key.clone())
            .complete(true)
            .callback(move |query: Query| {
                if query.key_expr().as_str() != own {
                    return turn_away(query, format!("ask one host, by the key {own}"), &runtime);
                }
                let bytes = query.payload().map_or(0, ZBytes::len);
                if bytes > DOOR_BYTES_MAX {
                    let reason = format!("{bytes} bytes are too many; at most {DOOR_BYTES_MAX} are read");
                    return turn_away(query, reason, &runtime);
                }
                let Some(place) = Place::take(&asked) else {
                    let reason = format!("the host is busy with {DOOR_ASKED_MAX} questions; ask again later");
                    return turn_away(query, reason, &runtime);
                };
                let payload = query
                    .payload()
                    .map_or_else(Vec::new, |bytes| bytes.to_bytes().into_owned());
                answers(Knock {
                    payload,
                    query,
                    runtime: runtime.clone(),
                    _place: place,
                });
            })
            .background()
            .wait()
            .map_err(|source| Error::Declare { key, source })
    }

    /// Tells all who listen at a door of this host what became of something, with JSON. Never blocks; where a link is full, it
    /// is dropped, and can be asked for.
    ///
    /// # Errors
    /// [`Error::Send`], [`Error::Closed`].
    pub fn publish_at_door(&self, door: &str, what: &str, json: Vec<u8>) -> Result<(), Error> {
        let key = format!("{}/{what}", self.shared.inbox.keys.door(door, self.host()));
        self.shared
            .zenoh()?
            .put(key.clone(), json)
            .encoding(Encoding::APPLICATION_JSON)
            .congestion_control(CongestionControl::Drop)
            .wait()
            .map_err(|source| Error::Declare { key, source })
    }
}
