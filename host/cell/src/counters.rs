//! What the bus counts. Counts only grow until the session ends.
//!
//! Never: knows of a message that Zenoh dropped under congestion; the receiver sees that as a gap in the sequence.

use std::sync::atomic::{AtomicU64, Ordering};

use serde::Serialize;

/// One reading of a session's counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Counters {
    /// Messages handed to Zenoh.
    pub sent: u64,
    /// Messages that could not be encoded, were too large, or were not taken by Zenoh.
    pub send_failed: u64,
    /// Messages that reached the sink.
    pub received: u64,
    /// Messages that could not be read.
    pub malformed: u64,
    /// Requests that this host was asked.
    pub requests: u64,
    /// Requests that were refused because too many were in flight.
    pub requests_busy: u64,
}

/// The live counts.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub(crate) sent: AtomicU64,
    pub(crate) send_failed: AtomicU64,
    pub(crate) received: AtomicU64,
    pub(crate) malformed: AtomicU64,
    pub(crate) requests: AtomicU64,
    pub(crate) requests_busy: AtomicU64,
}

/// Adds one. Counts order nothing, so relaxed is enough.
pub(crate) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

impl Tally {
    pub(crate) fn read(&self) -> Counters {
        let get = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        Counters {
            sent: get(&self.sent),
            send_failed: get(&self.send_failed),
            received: get(&self.received),
            malformed: get(&self.malformed),
            requests: get(&self.requests),
            requests_busy: get(&self.requests_busy),
        }
    }
}
