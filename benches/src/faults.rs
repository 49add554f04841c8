//! The cell that `failover` breaks: a plant and three controller hosts in four processes, and two loops, at 10 Hz and at
//! 100 Hz, with the same rank of hosts, so that one kill hits the owner, or a replica, of both.
//!
//! ```text
//! kill a replica:  next non-owner ─► kill -9 ─► restart ─► wait until it steps both loops
//! pause a replica: next non-owner ─► SIGSTOP ─► 5 s ─► SIGCONT ─► wait until it steps both loops
//! kill the owner:  owner of both ─► kill -9 ─► wait for another owner of both ─► restart ─► wait until it steps both loops
//! ```

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use bumpless_core::{HostId, LoopId, place};
use bumpless_io::Clock;
use bumpless_tests::{Api, Cell, CellOptions};
use serde_json::json;

use crate::{error::Error, history::History};

/// One of the two loops.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LoopOf {
    /// Its part of a figure's name.
    pub(crate) label: &'static str,
    /// Its period, in ns.
    pub(crate) period_ns: u64,
    /// Its actuator.
    pub(crate) point: &'static str,
}

/// The loops of the bench.
pub(crate) const LOOPS: [LoopOf; 2] = [
    LoopOf {
        label: "10hz",
        period_ns: 100_000_000,
        point: "plant.0.out",
    },
    LoopOf {
        label: "100hz",
        period_ns: 10_000_000,
        point: "plant.1.out",
    },
];
/// The controller hosts of a harness cell.
const CONTROLLERS: [&str; 3] = ["a", "b", "c"];
/// Half of the setpoint's period: it goes up and down by turns, so that an undisturbed run has an IAE to compare with.
const PROFILE_HALF: Duration = Duration::from_secs(5);
/// The setpoint's two values, in % of span.
const SETPOINTS: [f64; 2] = [60.0, 40.0];
/// How long a replica is stopped.
const PAUSE: Duration = Duration::from_secs(5);
/// Kills are spread over the cycle of the slower loop, in ms.
const SPREAD_MS: u64 = 100;

/// The cell under test, and who follows it.
pub(crate) struct Faults {
    pub(crate) cell: Cell,
    pub(crate) history: History,
    pub(crate) names: [String; 2],
    pub(crate) clock: Clock,
    profile: Option<Profile>,
    turn: u64,
}

/// The thread that moves the setpoints.
struct Profile {
    stop: Arc<AtomicBool>,
    missed: Arc<AtomicU64>,
    started: Instant,
    thread: JoinHandle<()>,
}

impl Faults {
    /// Starts the cell and its loops, and waits until every host steps both.
    pub(crate) fn start() -> Result<Self, Error> {
        let fopdt = "{ count = 2, gain = 1.0, tau_s = 1.0, dead_time_s = 0.1, noise = 0.02 }";
        let mut cell = Cell::start(CellOptions::first_order(fopdt))?;
        let api = cell.plant.api();
        api.upload_stock(&["pidplus"])?;
        let names = names_of_one_rank()?;
        for (number, (name, of)) in names.iter().zip(LOOPS).enumerate() {
            api.apply(&json!({
                "name": name,
                "component": "pidplus",
                "period_ms": of.period_ns as f64 / 1e6,
                "ports": { "pv": format!("plant.{number}.pv"), "out": of.point },
                "parameters": { "k": 1.5, "ti": 1.0 },
                "setpoint": SETPOINTS[1],
                "strategy": "round-robin",
            }))?;
        }
        let loops: Vec<&str> = names.iter().map(String::as_str).collect();
        let history = History::follow(&api, &loops)?;
        for host in CONTROLLERS {
            history.wait_steps(&loops, host, 0)?;
        }
        cell.wait_joined()?;
        let profile = Profile::start(api, names.clone())?;
        Ok(Self {
            cell,
            history,
            names,
            clock: Clock::start(),
            profile: Some(profile),
            turn: 0,
        })
    }

    /// Waits for the next beginning of the setpoint's period; gives that time, in ns since 1970.
    pub(crate) fn wait_period(&self) -> u64 {
        let period = PROFILE_HALF * 2;
        if let Some(profile) = &self.profile {
            let elapsed = profile.started.elapsed();
            let into = Duration::from_nanos(u64::try_from(elapsed.as_nanos() % period.as_nanos()).unwrap_or(0));
            std::thread::sleep(period.saturating_sub(into));
        }
        self.clock.now_ns()
    }

    /// The setpoint's period, in ns.
    pub(crate) const fn period_ns() -> u64 {
        2 * PROFILE_HALF.as_secs() * 1_000_000_000
    }

    /// Kills a replica and starts it again.
    pub(crate) fn kill_replica(&mut self) -> Result<(), Error> {
        let host = self.next_replica()?;
        self.wait_a_moment();
        let place = self.history.place();
        self.cell.host(&host)?.kill9();
        // The cycles until the bus misses it are the ones that count; it must not be back before.
        std::thread::sleep(Duration::from_millis(SPREAD_MS));
        self.bring_back(&host, place)
    }

    /// Stops a replica for a while.
    pub(crate) fn pause_replica(&mut self) -> Result<(), Error> {
        let host = self.next_replica()?;
        self.wait_a_moment();
        self.cell.host(&host)?.pause()?;
        std::thread::sleep(PAUSE);
        let place = self.history.place();
        self.cell.host(&host)?.resume()?;
        self.wait_steps(&host, place)
    }

    /// Kills the owner of both loops and starts it again.
    pub(crate) fn kill_owner(&mut self) -> Result<(), Error> {
        let host = self.owner_of_both()?;
        self.wait_a_moment();
        let place = self.history.place();
        self.cell.host(&host)?.kill9();
        for name in self.names.clone() {
            let what = format!("another owner of {name} than {host}");
            self.history
                .wait(&what, place, |record| record.loop_name == name && record.owner != host)?;
        }
        self.bring_back(&host, place)
    }

    fn bring_back(&mut self, host: &str, place: usize) -> Result<(), Error> {
        self.cell.restart(host)?;
        // Steps from before the fault lie before `place` but for those on their way, so the count starts anew.
        let place = place.max(self.history.place());
        self.wait_steps(host, place)
    }

    fn wait_steps(&self, host: &str, place: usize) -> Result<(), Error> {
        let loops: Vec<&str> = self.names.iter().map(String::as_str).collect();
        self.history.wait_steps(&loops, host, place)
    }

    /// The hosts that own neither loop, by turns.
    fn next_replica(&mut self) -> Result<String, Error> {
        let owner = self.owner_of_both()?;
        self.turn += 1;
        let others: Vec<&str> = CONTROLLERS.into_iter().filter(|host| *host != owner).collect();
        let turn = usize::try_from(self.turn).unwrap_or(0) % others.len().max(1);
        Ok(others.get(turn).copied().unwrap_or_default().to_owned())
    }

    /// The owner of the loops; where each has its own, the faster loop is moved to the slower one's.
    fn owner_of_both(&mut self) -> Result<String, Error> {
        let owner = |name: &str| self.history.last(name).map(|record| record.owner).unwrap_or_default();
        let [slow, fast] = &self.names;
        let wanted = owner(slow);
        if owner(fast) != wanted {
            let place = self.history.place();
            self.cell.plant.api().move_owner(fast, &wanted)?;
            let what = format!("{wanted} to own {fast}");
            self.history.wait(&what, place, |record| {
                record.loop_name == *fast && record.owner == wanted
            })?;
        }
        Ok(wanted)
    }

    /// Different faults hit different parts of a cycle.
    fn wait_a_moment(&self) {
        let millis = self.clock.now_ns() / 1_000 * 7_919 % SPREAD_MS;
        std::thread::sleep(Duration::from_millis(millis));
    }

    /// Ends the profile; gives the setpoints that were not taken.
    pub(crate) fn stop_profile(&mut self) -> u64 {
        let Some(profile) = self.profile.take() else { return 0 };
        profile.stop.store(true, Ordering::Relaxed);
        drop(profile.thread.join());
        profile.missed.load(Ordering::Relaxed)
    }
}

impl Drop for Faults {
    fn drop(&mut self) {
        self.stop_profile();
    }
}

impl Profile {
    fn start(api: Api, names: [String; 2]) -> Result<Self, Error> {
        let stop = Arc::new(AtomicBool::new(false));
        let missed = Arc::new(AtomicU64::new(0));
        let started = Instant::now();
        let (stop_there, missed_there) = (Arc::clone(&stop), Arc::clone(&missed));
        let thread = std::thread::Builder::new()
            .name("profile".to_owned())
            .spawn(move || {
                let mut due = started;
                for setpoint in SETPOINTS.into_iter().cycle() {
                    while Instant::now() < due {
                        if stop_there.load(Ordering::Relaxed) {
                            return;
                        }
                        std::thread::sleep(
                            due.saturating_duration_since(Instant::now())
                                .min(Duration::from_millis(50)),
                        );
                    }
                    for name in &names {
                        if api.setpoint(name, setpoint).is_err() {
                            missed_there.fetch_add(1, Ordering::Relaxed);
                        }
                    }
                    due += PROFILE_HALF;
                }
            })
            .map_err(Error::io("the profile's thread cannot be started"))?;
        Ok(Self {
            stop,
            missed,
            started,
            thread,
        })
    }
}

/// Two loop names for which the hosts have the same rank.
fn names_of_one_rank() -> Result<[String; 2], Error> {
    let hosts = CONTROLLERS
        .into_iter()
        .map(HostId::new)
        .collect::<Result<Vec<_>, _>>()?;
    let slow = "slow";
    let wanted = place::rank(&LoopId::new(slow)?, &hosts);
    for number in 0.. {
        let fast = format!("fast-{number}");
        if place::rank(&LoopId::new(&fast)?, &hosts) == wanted {
            return Ok([slow.to_owned(), fast]);
        }
    }
    Ok([slow.to_owned(), "fast".to_owned()])
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn both_loops_have_one_rank_of_hosts() {
        let [slow, fast] = names_of_one_rank().unwrap();
        let hosts = CONTROLLERS.map(|host| HostId::new(host).unwrap());
        let rank = |name: &str| place::rank(&LoopId::new(name).unwrap(), &hosts);
        assert_ne!(slow, fast);
        assert_eq!(rank(&slow), rank(&fast));
    }
}
