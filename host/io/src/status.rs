//! What a bus says of itself to people.
//!
//! Never: read by the cycle.

use bumpless_core::BusId;
use parking_lot::Mutex;
use serde::Serialize;

use crate::limits::ERROR_CHARS_MAX;

/// The state of one bus. Counters count since the start.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct BusStatus {
    /// The bus.
    pub bus: BusId,
    /// `sim`, `modbus-tcp` or `modbus-rtu`.
    pub driver: &'static str,
    /// Does the device answer? A simulated plant always does.
    pub connected: bool,
    /// Points that the bus owns.
    pub points: usize,
    /// Requests that were sent, repetitions among them; 0 for a simulated plant.
    pub requests: u64,
    /// Requests that were sent again because they were not answered.
    pub retries: u64,
    /// Read requests answered well (simulated plant: readings).
    pub polls: u64,
    /// Writes that the device took.
    pub writes: u64,
    /// Requests and connections that failed, and writes that were given up.
    pub errors: u64,
    /// Polls that began more than a period late: the bus is asked for more than it can give.
    pub polls_late: u64,
    /// Connections made.
    pub connections: u64,
    /// What went wrong last, in words; stays after recovery.
    pub last_error: Option<String>,
    /// Time of the last request, in µs.
    pub latency_us: u64,
    /// Longest time of a request, in µs.
    pub latency_us_max: u64,
    /// Journal lines that the disk was too slow for.
    pub journal_dropped: u64,
}

/// A status that a task writes and anyone reads.
#[derive(Debug)]
pub(crate) struct StatusCell(Mutex<BusStatus>);

impl StatusCell {
    pub(crate) fn new(bus: BusId, driver: &'static str, connected: bool, points: usize) -> Self {
        Self(Mutex::new(BusStatus {
            bus,
            driver,
            connected,
            points,
            requests: 0,
            retries: 0,
            polls: 0,
            writes: 0,
            errors: 0,
            polls_late: 0,
            connections: 0,
            last_error: None,
            latency_us: 0,
            latency_us_max: 0,
            journal_dropped: 0,
        }))
    }

    pub(crate) fn get(&self) -> BusStatus {
        self.0.lock().clone()
    }

    pub(crate) fn update(&self, change: impl FnOnce(&mut BusStatus)) {
        change(&mut self.0.lock());
    }

    /// Counts an error and keeps its text. True where the text differs from the last one, so that a log line is due.
    pub(crate) fn error(&self, text: &str) -> bool {
        let text: String = text.chars().take(ERROR_CHARS_MAX).collect();
        let mut status = self.0.lock();
        status.errors += 1;
        let new = status.last_error.as_deref() != Some(text.as_str());
        status.last_error = Some(text);
        new
    }
}
