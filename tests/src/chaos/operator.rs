//! An operator who does not stop: setpoints of many loops up and down, through any host, each order with a key of its own.
//!
//! ```text
//! due ──► asked at one host ──answer──► done, with the record's position
//!                 └─ no answer ──► the same order at the next host, with the same key ── … ──► unknown
//! ```
//! The levels follow the clock, so that runs can be compared; every order adds some thousandths of its own, so that a record
//! tells which order it follows. Never: sends an order of a loop before the one before it had its answer, or none.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use serde_json::json;

use crate::{Api, Error, pause};

/// Hosts that one order is tried at.
const TRIES_MAX: u32 = 3;
/// Longest wait for one answer: beyond what a host itself allows a command of a fast loop.
const ANSWER_MAX: Duration = Duration::from_secs(8);
/// Orders of one loop after which its thousandths begin anew.
const THOUSANDTHS: u64 = 4_000;
/// Threads that give orders: one that waits for a dead host must not hold up the others.
const THREADS: usize = 4;

/// Now, in ns since 1970.
#[must_use]
pub fn unix_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

/// How the levels go.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    /// The two levels, in the loops' unit.
    pub levels: [f64; 2],
    /// Time on one level.
    pub half: Duration,
}

impl Profile {
    /// The level's number of a loop at a time after the start; loops are spread over the half.
    fn level(&self, after: Duration, loop_number: usize, loops: usize) -> u64 {
        let half_ns = self.half.as_nanos().max(1);
        let shift_ns = half_ns * loop_number as u128 / loops.max(1) as u128;
        u64::try_from((after.as_nanos() + shift_ns) / half_ns).unwrap_or(u64::MAX)
    }
}

/// How an order ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Acknowledged: part of the record at this ownership and cycle, or before it.
    Done((u64, u64)),
    /// No host said so. It may have been done.
    Unknown,
}

/// One order.
#[derive(Debug, Clone, PartialEq)]
pub struct Order {
    /// The loop.
    pub loop_name: String,
    /// The setpoint, unlike that of any other recent order of the loop.
    pub setpoint: f64,
    /// When it was sent first, in ns since 1970.
    pub sent_ns: u64,
    /// When its answer came, or was waited for no longer.
    pub answered_ns: u64,
    /// How it ended.
    pub outcome: Outcome,
    /// Hosts that were asked.
    pub tries: u32,
}

/// The threads that give orders.
#[derive(Debug)]
pub struct Operator {
    stop: Arc<AtomicBool>,
    orders: Arc<Mutex<Vec<Order>>>,
    threads: Vec<JoinHandle<()>>,
}

impl Operator {
    /// Starts to order these loops at these addresses of APIs, by turns.
    ///
    /// # Errors
    /// [`Error::Program`] where there are no threads.
    pub fn start(addresses: &[String], loops: &[String], profile: Profile) -> Result<Self, Error> {
        let stop = Arc::new(AtomicBool::new(false));
        let orders: Arc<Mutex<Vec<Order>>> = Arc::default();
        let started = Instant::now();
        let mut threads = Vec::new();
        for turn in 0..THREADS {
            let apis: Vec<Api> = addresses
                .iter()
                .map(|address| Api::within(address.clone(), ANSWER_MAX))
                .collect();
            let mut hand = Hand {
                apis,
                all: loops.len(),
                mine: loops
                    .iter()
                    .cloned()
                    .enumerate()
                    .filter(|(n, _)| n % THREADS == turn)
                    .map(|(n, name)| (n, name, None))
                    .collect(),
                profile,
                started,
                given: turn as u64,
                orders: Arc::clone(&orders),
            };
            let stop = Arc::clone(&stop);
            let thread = std::thread::Builder::new().name(format!("operator-{turn}"));
            let thread = thread.spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    hand.look(&stop);
                    pause(Duration::from_millis(5));
                }
            });
            threads.push(thread.map_err(|source| Error::Program {
                program: "a thread".to_owned(),
                source,
            })?);
        }
        Ok(Self { stop, orders, threads })
    }

    /// Stops, and gives all orders in the order of their sending.
    #[must_use]
    pub fn finish(mut self) -> Vec<Order> {
        self.end();
        let mut orders = std::mem::take(&mut *self.orders.lock().unwrap_or_else(PoisonError::into_inner));
        orders.sort_by_key(|order| order.sent_ns);
        orders
    }

    fn end(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // A thread that panicked has told its orders.
            let _ended = thread.join();
        }
    }
}

impl Drop for Operator {
    fn drop(&mut self) {
        self.end();
    }
}

/// One thread's loops.
struct Hand {
    apis: Vec<Api>,
    all: usize,
    /// Number, name, and the level ordered last.
    mine: Vec<(usize, String, Option<u64>)>,
    profile: Profile,
    started: Instant,
    given: u64,
    orders: Arc<Mutex<Vec<Order>>>,
}

impl Hand {
    fn look(&mut self, stop: &AtomicBool) {
        for place in 0..self.mine.len() {
            let Some((number, name, ordered)) = self.mine.get(place).cloned() else {
                return;
            };
            let level = self.profile.level(self.started.elapsed(), number, self.all);
            if ordered == Some(level) || stop.load(Ordering::Relaxed) {
                continue;
            }
            let order = self.order(&name, level);
            self.orders.lock().unwrap_or_else(PoisonError::into_inner).push(order);
            if let Some(entry) = self.mine.get_mut(place) {
                entry.2 = Some(level);
            }
        }
    }

    fn order(&mut self, name: &str, level: u64) -> Order {
        self.given += THREADS as u64;
        let [even, odd] = self.profile.levels;
        let base = if level.is_multiple_of(2) { even } else { odd };
        let setpoint = base + (self.given % THOUSANDTHS) as f64 / 1_000.0 * 0.01;
        let key = format!("{:08x}-0000-4000-8000-{:012x}", std::process::id(), self.given);
        let sent_ns = unix_ns();
        let body = json!({ "setpoint": setpoint }).to_string();
        let headers = [("content-type", "application/json"), ("idempotency-key", key.as_str())];
        let (mut outcome, mut tries) = (Outcome::Unknown, 0);
        while outcome == Outcome::Unknown && tries < TRIES_MAX {
            let turn = usize::try_from(self.given / THREADS as u64 + u64::from(tries)).unwrap_or(0);
            let Some(api) = self.apis.get(turn % self.apis.len().max(1)) else {
                break;
            };
            tries += 1;
            let path = format!("/v1/loops/{name}/setpoint");
            if let Ok(answer) = api.send("POST", &path, &headers, body.as_bytes())
                && answer.ok()
                && let (Some(term), Some(seq)) = (answer.json()["term"].as_u64(), answer.json()["seq"].as_u64())
            {
                outcome = Outcome::Done((term, seq));
            }
        }
        Order {
            loop_name: name.to_owned(),
            setpoint,
            sent_ns,
            answered_ns: unix_ns(),
            outcome,
            tries,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loops_change_their_levels_one_after_another() {
        let profile = Profile {
            levels: [1.0, 2.0],
            half: Duration::from_secs(10),
        };
        let levels = |s: u64| -> Vec<u64> { (0..4).map(|n| profile.level(Duration::from_secs(s), n, 4)).collect() };
        assert_eq!(levels(0), [0, 0, 0, 0]);
        assert_eq!(levels(3), [0, 0, 0, 1]);
        assert_eq!(levels(6), [0, 0, 1, 1]);
        assert_eq!(levels(10), [1, 1, 1, 1]);
    }
}
