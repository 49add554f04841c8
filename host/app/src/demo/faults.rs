//! Faults of the demonstration on request: the API of a child passes a wish on, the parent does it.
//!
//! ```text
//! kill ─► dead until somebody starts it      pause ─► stopped ─ its time is over ─► continued
//! start ─► started again                     stress ─► every core busy ─ its time is over ─► over
//! delay, lose ─► its way to the plant is bad ─ its time is over ─► good
//! ```
//! Never: lasts longer than a minute, or longer than the demonstration; never touches a process that is not its child.

use std::{
    hint::black_box,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use bumpless_api::types::{Fault, FaultKind};
use rustix::process::Signal;

use super::children::Cell;
use crate::error::Error;

/// Threads that keep cores busy at most.
const BURNERS_MAX: usize = 64;
/// What `delay` adds each way. Two of them are more than what a 10 Hz cycle waits before it asks another replica.
const DELAY: Duration = Duration::from_millis(30);
/// Pieces of a hundred that `lose` loses.
const LOST_PERCENT: u32 = 10;

/// Faults that last.
#[derive(Default)]
pub(super) struct Faults {
    /// Hosts that are paused, and until when.
    paused: Vec<(String, Instant)>,
    /// Hosts whose way to the plant is bad, and until when.
    bad_ways: Vec<(String, Instant)>,
    /// Until when the cores are busy.
    stressed: Option<Instant>,
}

impl Faults {
    /// Does a fault; says what was done, in words. Starting a host is the caller's: it takes time.
    pub(super) fn act(&mut self, fault: &Fault, cell: &Cell) -> Result<String, Error> {
        let (host, time) = (&fault.host, Duration::from_secs(u64::from(fault.seconds.clamp(1, 60))));
        let none = || Error::Demo(format!("there is no running host {host}"));
        match fault.fault {
            FaultKind::Kill => cell
                .signal(host, Signal::KILL)
                .then(|| format!("host {host} is killed, as asked for"))
                .ok_or_else(none),
            FaultKind::Pause => {
                if !cell.signal(host, Signal::STOP) {
                    return Err(none());
                }
                self.paused.retain(|(name, _)| name != host);
                self.paused.push((host.clone(), Instant::now() + time));
                Ok(format!("host {host} is paused for {} s, as asked for", time.as_secs()))
            }
            FaultKind::Stress => {
                if self.stressed.is_some_and(|until| Instant::now() < until) {
                    return Err(Error::Demo("the cores are busy already".to_owned()));
                }
                self.stressed = Some(Instant::now() + time);
                burn(time)?;
                Ok(format!("every core is busy for {} s, as asked for", time.as_secs()))
            }
            FaultKind::Delay | FaultKind::Lose => {
                let relay = cell
                    .relay(host)
                    .ok_or_else(|| Error::Demo(format!("{host} has no way to the plant that could be bad")))?;
                let what = if fault.fault == FaultKind::Delay {
                    relay.delay(DELAY);
                    format!("is {} ms longer each way", DELAY.as_millis())
                } else {
                    relay.lose(LOST_PERCENT);
                    format!("loses {LOST_PERCENT} % of what passes")
                };
                self.bad_ways.retain(|(name, _)| name != host);
                self.bad_ways.push((host.clone(), Instant::now() + time));
                Ok(format!(
                    "the way from {host} to the plant {what} for {} s, as asked for",
                    time.as_secs()
                ))
            }
            FaultKind::Start => Ok(format!("host {host} is started again, as asked for")),
        }
    }

    /// Ends what has lasted for long enough; says what.
    pub(super) fn look(&mut self, cell: &Cell) -> Vec<String> {
        let paused = over(&mut self.paused)
            .into_iter()
            .filter(|name| cell.signal(name, Signal::CONT))
            .map(|name| format!("host {name} goes on"));
        let bad_ways = over(&mut self.bad_ways).into_iter().filter_map(|name| {
            let relay = cell.relay(&name)?;
            relay.delay(Duration::ZERO);
            relay.lose(0);
            Some(format!("the way from {name} to the plant is good again"))
        });
        paused.chain(bad_ways).collect()
    }
}

/// Takes out whose time is over.
fn over(lasting: &mut Vec<(String, Instant)>) -> Vec<String> {
    let now = Instant::now();
    let ended = lasting.extract_if(.., |(_, until)| *until <= now);
    ended.map(|(name, _)| name).collect()
}

/// One thread per core that computes until its time is over.
fn burn(time: Duration) -> Result<(), Error> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let until = Instant::now() + time;
    let sum = Arc::new(AtomicU64::new(0));
    for n in 0..cores.min(BURNERS_MAX) {
        let sum = Arc::clone(&sum);
        let work = move || {
            while Instant::now() < until {
                let mut x = 1_u64;
                for i in 0..10_000_u64 {
                    x = black_box(x.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(i));
                }
                sum.fetch_add(x, Ordering::Relaxed);
            }
        };
        std::thread::Builder::new()
            .name(format!("stress-{n}"))
            .spawn(work)
            .map_err(|error| Error::start("the load of the demonstration", error))?;
    }
    Ok(())
}
