//! Every record of a run, from the live feed of the home, which comes and goes.
//!
//! Never: the truth about the actuators, which is the journal's; what the feed lost is counted.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use serde_json::Value;

use crate::{Api, Error, chaos::check::Seen, journal::same_day, pause};

/// Longest silence of a feed, which says something every second.
const SILENCE: Duration = Duration::from_secs(3);
/// Pause before a feed that broke off is opened again.
const AGAIN: Duration = Duration::from_millis(50);

#[derive(Debug, Default)]
struct Shared {
    seen: Mutex<Vec<Seen>>,
    lost: AtomicU64,
    stop: AtomicBool,
}

/// A follower of the feed.
#[derive(Debug)]
pub struct Observer {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Observer {
    /// Follows these loops at this host. `near_ns` is a time before all records, in ns since 1970.
    ///
    /// # Errors
    /// [`Error::Program`] where there is no thread.
    pub fn follow(api: &Api, loops: &[String], near_ns: u64) -> Result<Self, Error> {
        let shared: Arc<Shared> = Arc::default();
        let numbers: HashMap<String, usize> = loops.iter().cloned().zip(0..).collect();
        let (api, of_thread) = (api.clone(), Arc::clone(&shared));
        let thread = std::thread::Builder::new()
            .name("observer".to_owned())
            .spawn(move || {
                while !of_thread.stop.load(Ordering::Relaxed) {
                    read(&api, &numbers, near_ns, &of_thread);
                    pause(AGAIN);
                }
            })
            .map_err(|source| Error::Program {
                program: "a thread".to_owned(),
                source,
            })?;
        Ok(Self {
            shared,
            thread: Some(thread),
        })
    }

    /// Stops, and gives the records as they came.
    #[must_use]
    pub fn finish(mut self) -> Vec<Seen> {
        self.end();
        std::mem::take(&mut *self.shared.seen.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Records that the feed was too slow for.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.shared.lost.load(Ordering::Relaxed)
    }

    fn end(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // One that panicked has told what it saw.
            let _ended = thread.join();
        }
    }
}

impl Drop for Observer {
    fn drop(&mut self) {
        self.end();
    }
}

fn read(api: &Api, numbers: &HashMap<String, usize>, near_ns: u64, shared: &Shared) {
    // The home may be away; it is tried again.
    let Ok(feed) = api.live("") else { return };
    while !shared.stop.load(Ordering::Relaxed) {
        let Ok(event) = feed.next(SILENCE) else { return };
        match event.name.as_str() {
            "record" => {
                if let Some(seen) = seen(&event.data, numbers, near_ns) {
                    shared.seen.lock().unwrap_or_else(PoisonError::into_inner).push(seen);
                }
            }
            "lost" => {
                let records = event.data["records"].as_u64().unwrap_or(1);
                shared.lost.fetch_add(records, Ordering::Relaxed);
            }
            _ => {}
        }
    }
}

fn seen(record: &Value, numbers: &HashMap<String, usize>, near_ns: u64) -> Option<Seen> {
    let events = record["events"].as_array().map(Vec::as_slice).unwrap_or_default();
    let has = |kind: &str| events.iter().any(|event| event["kind"] == kind);
    Some(Seen {
        loop_number: *numbers.get(record["loop"].as_str()?)?,
        position: (record["term"].as_u64()?, record["seq"].as_u64()?),
        at_ns: same_day(record["at_unix_us"].as_u64()? * 1000, near_ns),
        setpoint: record["setpoint"].as_f64()?,
        measurement: record["measurement"].as_f64().unwrap_or(f64::NAN),
        hedged: has("hedged"),
        took_over: has("took-over"),
    })
}
