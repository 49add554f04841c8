//! Two hosts, one device: which of them writes. The lease that the device itself keeps (`bumpless_core::lease`), kept up.
//!
//! ```toml
//! [bus.redundant]
//! with = "io-2"         # the other host, which has the same bus with the same points and the same register
//! rank = 1              # 1 here, 2 there
//! register = 900        # first of three holding registers of the device that nobody else writes
//! lease_ms = 2000       # at least eight times the bus's timeout_ms; the device goes over within about 1.6 times this
//! ```
//!
//! ```text
//! Keeper ── lease reads and beats, as errands that go first ──► link ──► device
//!    └─ until when ──► Mastership ◄── asked by the link right before each write, and by the server at each commit
//! ```
//!
//! Owns: the lease's clock, which also runs while the machine sleeps. Never: decides; `core::lease` does.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::SeqCst},
    },
    time::{Duration, Instant},
};

use bumpless_core::{
    HostId,
    lease::{Lease, LeaseStep, LeaseTimes, Token},
};
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use crate::{
    Error,
    errand::{Errand, Post},
    limits::LEASE_MS_RANGE,
    modbus::Table,
};

/// The other master of a device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RedundantConfig {
    /// The other host.
    pub with: HostId,
    /// 1 to 15, different on each host; where nobody ever was master, the lower goes first.
    pub rank: u8,
    /// First of three holding registers of the device that nobody else writes.
    pub register: u16,
    /// The unit that has them, if not the bus's.
    #[serde(default)]
    pub unit_id: Option<u8>,
    /// How long a master may write after its last sign of life, in ms.
    #[serde(default)]
    pub lease_ms: Option<u64>,
}

/// A checked configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RedundantPlan {
    pub(crate) with: HostId,
    pub(crate) rank: u8,
    pub(crate) register: u16,
    pub(crate) unit_id: u8,
    pub(crate) times: LeaseTimes,
}

impl RedundantConfig {
    /// Checks it against the bus's time-out.
    ///
    /// A write is on its way for at most two time-outs: one in which the network must have delivered it (the connection's
    /// user time-out, after which the system gives it up), and one in which the device must have obeyed it. A claim follows
    /// the read that allows it within two: the read's own, and that of a poll that is under way.
    pub(crate) fn plan(&self, bus: &str, bus_unit_id: u8, timeout_ms: u64) -> Result<RedundantPlan, Error> {
        let wrong = |problem: String| Err(Error::config(format!("{bus}, redundant"), problem));
        if !(1..=15).contains(&self.rank) {
            return wrong(format!("rank = {}: 1 to 15, different on each host", self.rank));
        }
        if self.register > u16::MAX - 2 {
            return wrong(format!(
                "register = {}: three registers from there must exist",
                self.register
            ));
        }
        let (least, most) = LEASE_MS_RANGE;
        let lease_ms = self.lease_ms.unwrap_or((8 * timeout_ms).max(least));
        if !(least..=most).contains(&lease_ms) {
            return wrong(format!("lease_ms = {lease_ms}: {least} to {most} are possible"));
        }
        let ns = |ms: u64| ms.saturating_mul(1_000_000);
        let times = LeaseTimes {
            lease_ns: ns(lease_ms),
            in_flight_ns: ns(2 * timeout_ms),
            claim_ns: ns(2 * timeout_ms),
        };
        if !times.fit() {
            return wrong(format!(
                "lease_ms = {lease_ms} is too short for timeout_ms = {timeout_ms}; make it at least {} or the time-out shorter",
                8 * timeout_ms
            ));
        }
        Ok(RedundantPlan {
            with: self.with.clone(),
            rank: self.rank,
            register: self.register,
            unit_id: self.unit_id.unwrap_or(bus_unit_id),
            times,
        })
    }
}

/// A clock that runs while the machine sleeps, in ns. Its zero means nothing.
pub(crate) fn lease_clock_ns() -> u64 {
    let now = clock_gettime(ClockId::Boottime);
    let seconds = u64::try_from(now.tv_sec).unwrap_or_default();
    seconds
        .saturating_mul(1_000_000_000)
        .saturating_add(u64::try_from(now.tv_nsec).unwrap_or_default())
}

/// Until when this host may write.
#[derive(Debug, Default)]
pub(crate) struct Mastership {
    until_ns: AtomicU64,
    /// When the lease's registers were read or written well last; 0 for never.
    reached_ns: AtomicU64,
}

impl Mastership {
    /// May the device be written now? Right before each write; one look at the clock.
    pub(crate) fn may_write(&self) -> bool {
        lease_clock_ns() < self.until_ns.load(SeqCst)
    }

    /// Were the lease's registers reached within this time? Then this host could take the device over.
    pub(crate) fn reached_within(&self, ns: u64) -> bool {
        let reached_ns = self.reached_ns.load(SeqCst);
        reached_ns > 0 && lease_clock_ns().saturating_sub(reached_ns) <= ns
    }
}

/// A bus with two masters, as its host sees it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MasterView {
    /// The other host.
    pub with: HostId,
    /// The number of the mastership, while this host has it.
    pub epoch: Option<u32>,
    /// This host reaches the device, and within its last lease's time the lease's registers: it is master, or could be.
    pub ready: bool,
}

/// What keeps the lease up.
pub(crate) struct Keeper {
    pub(crate) plan: RedundantPlan,
    pub(crate) mastership: Arc<Mastership>,
    pub(crate) post: Post,
    pub(crate) timeout_ms: u64,
    /// The epoch, while this host is master.
    pub(crate) epoch: watch::Sender<Option<u32>>,
}

impl Keeper {
    /// Runs until told to stop; gives the mastership up then, so that the other host need not wait for the lease's end.
    pub(crate) async fn run(self, bus: &str, mut stop: watch::Receiver<bool>) {
        let mut lease = Lease::new(self.plan.rank, self.plan.times, lease_clock_ns());
        let mut stopping = false;
        loop {
            let wait_ns = lease.due_ns().saturating_sub(lease_clock_ns());
            if !stopping {
                let told = tokio::select! {
                    biased;
                    told = stop.wait_for(|stop| *stop) => { drop(told); true }
                    () = tokio::time::sleep(Duration::from_nanos(wait_ns.min(self.left_ns(&lease)))) => false,
                };
                if told {
                    stopping = true;
                    lease.give_up(lease_clock_ns());
                    self.publish(bus, &lease);
                }
            }
            if stopping && !lease.is_giving_up() {
                break;
            }
            self.publish(bus, &lease);
            if lease_clock_ns() < lease.due_ns() {
                if stopping {
                    tokio::time::sleep(Duration::from_nanos(wait_ns)).await;
                }
                continue;
            }
            self.one(bus, &mut lease).await;
            self.publish(bus, &lease);
        }
        self.mastership.until_ns.store(0, SeqCst);
        self.epoch.send_replace(None);
    }

    /// Time until the lease is over, so that its end is told even where nothing else happens; long where there is none.
    fn left_ns(&self, lease: &Lease) -> u64 {
        match lease.until_ns() {
            0 => self.plan.times.lease_ns,
            until_ns => until_ns.saturating_sub(lease_clock_ns()).max(1_000_000),
        }
    }

    /// One step of the lease.
    async fn one(&self, bus: &str, lease: &mut Lease) {
        let sent_ns = lease_clock_ns();
        let step = lease.step(sent_ns);
        let (errand, wait) = match step {
            LeaseStep::Read => (
                Errand::Read {
                    unit_id: self.plan.unit_id,
                    table: Table::Holding,
                    start: self.plan.register,
                    count: 3,
                },
                Duration::from_millis(2 * self.timeout_ms),
            ),
            LeaseStep::Write(token, until_ns) => {
                if sent_ns >= until_ns {
                    return lease.failed(sent_ns);
                }
                (
                    Errand::Write {
                        unit_id: self.plan.unit_id,
                        table: Table::Holding,
                        start: self.plan.register,
                        words: token.words().to_vec(),
                    },
                    Duration::from_nanos(until_ns - sent_ns),
                )
            }
        };
        let answer = match self.post.send_first(errand, Instant::now() + wait) {
            Ok(asked) => {
                let answer = asked.answer();
                tokio::pin!(answer);
                // The lease may end while its beat is on its way: that is told at once.
                loop {
                    let left = Duration::from_nanos(self.left_ns(lease));
                    tokio::select! {
                        answer = &mut answer => break answer.map_err(|error| error.to_string()),
                        () = tokio::time::sleep(left) => self.publish(bus, lease),
                    }
                }
            }
            Err(error) => Err(error.to_string()),
        };
        let now_ns = lease_clock_ns();
        if answer.is_ok() {
            self.mastership.reached_ns.store(now_ns, SeqCst);
        }
        match (step, answer) {
            (LeaseStep::Read, Ok(words)) => match <[u16; 3]>::try_from(words) {
                Ok(words) => lease.read(sent_ns, now_ns, Token::of(words)),
                Err(_) => lease.failed(now_ns),
            },
            (LeaseStep::Write(token, _), Ok(_)) => lease.written(sent_ns, now_ns, token),
            (_, Err(error)) => {
                tracing::debug!(bus, error, "the lease's registers cannot be reached");
                lease.failed(now_ns);
            }
        }
    }

    /// Tells the writers until when, and everyone else whether.
    fn publish(&self, bus: &str, lease: &Lease) {
        self.mastership.until_ns.store(lease.until_ns(), SeqCst);
        let epoch = lease.epoch(lease_clock_ns());
        self.epoch.send_if_modified(|held| {
            let news = *held != epoch;
            if news {
                match epoch {
                    Some(epoch) => tracing::warn!(bus, epoch, "this host is the device's master"),
                    None => tracing::warn!(bus, "this host is the device's master no more"),
                }
            }
            *held = epoch;
            news
        });
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]
    use super::*;

    fn config(text: &str) -> RedundantConfig {
        toml::from_str(&format!("with = \"b\"\n{text}")).unwrap()
    }

    #[test]
    fn what_cannot_be_is_refused_with_its_cure() {
        let good = config("rank = 1\nregister = 900");
        let plan = good.plan("bus \"line\"", 7, 500).unwrap();
        assert_eq!(
            (plan.unit_id, plan.times.lease_ns, plan.times.in_flight_ns),
            (7, 4_000_000_000, 1_000_000_000)
        );
        assert!(plan.times.fit());
        for (text, part) in [
            ("rank = 0\nregister = 900", "rank = 0: 1 to 15"),
            ("rank = 16\nregister = 900", "different on each host"),
            ("rank = 1\nregister = 65534", "three registers from there"),
            (
                "rank = 1\nregister = 0\nlease_ms = 3999",
                "too short for timeout_ms = 500; make it at least 4000",
            ),
            ("rank = 1\nregister = 0\nlease_ms = 10", "lease_ms = 10: "),
        ] {
            let error = config(text).plan("bus \"line\"", 1, 500).expect_err(part).to_string();
            assert!(
                error.contains(part) && error.contains("bus \"line\", redundant"),
                "{part}: {error}"
            );
        }
    }

    #[test]
    fn the_clock_goes_on() {
        let first = lease_clock_ns();
        assert!(lease_clock_ns() >= first && first > 0);
        let mastership = Mastership::default();
        assert!(!mastership.may_write());
        mastership.until_ns.store(u64::MAX, SeqCst);
        assert!(mastership.may_write());
    }
}
