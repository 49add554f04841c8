//! One simulated host: its life, its clock, what it holds, and what it knows of the others.
//!
//! ```text
//! alive ──kill──► dead ──start──► alive, a life later, knowing nothing but its disk
//!   └──pause──► still: what arrives waits ──go on──► alive
//! ```
//! Never: decides anything; `home` and `seat` do, with the core's code.

use std::{
    collections::{HashMap, VecDeque},
    sync::Arc,
};

use bumpless_core::{
    Event as CycleEvent, Frame, LoopSpec, Record, Redundancy,
    protocol::Sample,
    seat::{Attempts, Standing},
    select::Health,
    vote::{Ballot, Cast, Judged},
};

use crate::{event::Event, plan::FaultKind};

/// Events that wait for a paused host at most; the rest is lost, as from a full inbox.
pub(crate) const INBOX_MAX: usize = 65_536;

/// A clock of its own: steady while the host lives, anywhere after a start, and never quite as fast as the others.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Clock {
    pub(crate) local_ns: u64,
    pub(crate) since_ns: u64,
    pub(crate) ppm: i64,
}

impl Clock {
    /// What it shows at a simulated time, in ns.
    pub(crate) fn shows(&self, now_ns: u64) -> u64 {
        let passed = i128::from(now_ns.saturating_sub(self.since_ns));
        let passed = passed + passed * i128::from(self.ppm) / 1_000_000;
        self.local_ns.saturating_add(u64::try_from(passed).unwrap_or_default())
    }

    /// The first simulated time at which it shows at least this.
    pub(crate) fn reaches(&self, local_ns: u64) -> u64 {
        let left = i128::from(local_ns.saturating_sub(self.local_ns));
        let passed = left * 1_000_000 / (1_000_000 + i128::from(self.ppm));
        let mut at_ns = self.since_ns.saturating_add(u64::try_from(passed).unwrap_or_default());
        while self.shows(at_ns) < local_ns {
            at_ns += 1;
        }
        at_ns
    }
}

/// A request on its way.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Asked {
    pub(crate) correlation: u64,
    pub(crate) host: u32,
    pub(crate) at_ns: u64,
}

/// A cycle on its way.
#[derive(Debug)]
pub(crate) struct Running {
    pub(crate) sample: Box<Sample>,
    pub(crate) spec: Arc<LoopSpec>,
    pub(crate) base: Option<Arc<Record>>,
    pub(crate) frame: Frame,
    pub(crate) state: Arc<[u8]>,
    pub(crate) standing: Standing,
    pub(crate) events: Vec<CycleEvent>,
    pub(crate) attempts: Attempts,
    pub(crate) ballot: Option<Ballot>,
    pub(crate) redundancy: Redundancy,
    pub(crate) asked: Vec<Asked>,
    pub(crate) started_ns: u64,
    pub(crate) next_at_ns: u64,
    pub(crate) give_up_at_ns: u64,
    pub(crate) hedge_ns: u64,
}

/// A loop that a host holds.
#[derive(Debug, Default)]
pub(crate) struct Seat {
    pub(crate) last: Option<Arc<Record>>,
    pub(crate) inflight: Option<Arc<Record>>,
    pub(crate) running: Option<Box<Running>>,
    pub(crate) late: Option<(Cast, Vec<u64>)>,
    pub(crate) judged: Vec<Judged>,
}

/// One host.
#[derive(Debug)]
pub(crate) struct Host {
    pub(crate) alive: bool,
    pub(crate) life: u32,
    /// Pauses that hold it now.
    pub(crate) pauses: u32,
    /// Faults that slow it down now.
    pub(crate) slow: u32,
    /// Faults that keep its disk from taking writes now.
    pub(crate) disk_full: u32,
    /// Terms that it set aside, on a place of its disk that it has already.
    pub(crate) terms_set_aside: u64,
    /// Faults that make its steps come out wrong now.
    pub(crate) bits: u32,
    pub(crate) clock: Clock,
    /// Its clock after the next start, in ns beside the true time.
    pub(crate) clock_next: Option<i64>,
    pub(crate) inbox: VecDeque<Event>,
    pub(crate) seats: HashMap<u32, Seat>,
    pub(crate) health: HashMap<u32, Health>,
    pub(crate) correlations: u64,
    /// Loops at home here.
    pub(crate) homes: Vec<u32>,
    /// Loops that it may hold, and its rank among their hosts.
    pub(crate) ranks: Vec<(u32, u8)>,
    /// The last fault that touched it, and until when what goes wrong is its doing.
    pub(crate) fault: Option<(FaultKind, u64)>,
    /// A sync that was asked for is on its way.
    pub(crate) syncing: bool,
}

impl Host {
    pub(crate) fn new(clock: Clock) -> Self {
        Self {
            alive: true,
            life: 0,
            pauses: 0,
            slow: 0,
            disk_full: 0,
            terms_set_aside: 0,
            bits: 0,
            clock,
            clock_next: None,
            inbox: VecDeque::new(),
            seats: HashMap::new(),
            health: HashMap::new(),
            correlations: 0,
            homes: Vec::new(),
            ranks: Vec::new(),
            fault: None,
            syncing: false,
        }
    }

    /// Does it do anything now?
    pub(crate) const fn runs(&self) -> bool {
        self.alive && self.pauses == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_and_its_inverse_agree() {
        for ppm in [-200, 0, 137, 200] {
            let clock = Clock {
                local_ns: 5_000_000_000_000,
                since_ns: 7_000_000,
                ppm,
            };
            for local_ns in [
                5_000_000_000_000,
                5_000_000_000_001,
                5_123_456_789_012,
                9_999_999_999_999,
            ] {
                let at_ns = clock.reaches(local_ns);
                assert!(clock.shows(at_ns) >= local_ns, "{ppm} {local_ns}");
                assert!(
                    at_ns == 7_000_000 || clock.shows(at_ns - 1) < local_ns,
                    "{ppm} {local_ns}"
                );
            }
        }
    }
}
