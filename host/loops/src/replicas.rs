//! What this host knows of the others as replicas: latency, load, what they hold ready, and whether they answer.
//!
//! Shared by all workers; each entry has its own short lock. Never: asks anybody; probes are sent by worker 0.

use std::{collections::HashMap, sync::Arc};

use bumpless_core::{
    Digest, HostId,
    chatter::{PROBES_PER_TURN_MAX, PROBES_WANTED_MAX, WANTED_NS},
    select::{Candidate, Health},
};
use parking_lot::{Mutex, RwLock};

/// A probe without an answer after this time counts as a failure, in ns: three probe intervals.
const PROBE_LOST_NS: u64 = 300_000_000;

#[derive(Debug, Default)]
struct Replica {
    alive: bool,
    control: bool,
    health: Health,
    cpu: f32,
    ready: Vec<Digest>,
    /// Token and time of the probe that is out.
    probe: Option<(u64, u64)>,
    /// When the last one was sent, in ns; 0 before the first.
    probed_ns: u64,
    /// When it last was a member of a loop that runs here, in ns; none before that.
    wanted_ns: Option<u64>,
}

/// The table of replicas.
#[derive(Debug, Default)]
pub(crate) struct Replicas {
    hosts: RwLock<HashMap<HostId, Arc<Mutex<Replica>>>>,
}

impl Replicas {
    fn entry(&self, host: &HostId) -> Arc<Mutex<Replica>> {
        if let Some(replica) = self.hosts.read().get(host) {
            return Arc::clone(replica);
        }
        Arc::clone(self.hosts.write().entry(host.clone()).or_default())
    }

    /// New vitals of a host.
    pub(crate) fn seen(&self, host: &HostId, control: bool, cpu: f32, ready: &[Digest]) {
        let entry = self.entry(host);
        let mut replica = entry.lock();
        replica.alive = true;
        replica.control = control;
        replica.cpu = cpu;
        if replica.ready != ready {
            replica.ready = ready.to_vec();
        }
    }

    /// The host is gone. Its health goes too: whoever comes back under its name is measured afresh.
    pub(crate) fn gone(&self, host: &HostId) {
        self.hosts.write().remove(host);
    }

    /// A step or probe was answered.
    pub(crate) fn answered(&self, host: &HostId, latency_ns: u64) {
        self.entry(host).lock().health.answered(latency_ns);
    }

    /// A step was given up on.
    pub(crate) fn silent(&self, host: &HostId, now_ns: u64, waited_ns: u64) {
        self.entry(host).lock().health.failed(now_ns, waited_ns);
    }

    /// The hosts to probe at this turn, each with a token to send: at most [`PROBES_PER_TURN_MAX`], those that steps may be asked
    /// of before others, and who waited longest first. A probe that got lost counts as a failure.
    pub(crate) fn probes(&self, here: &HostId, now_ns: u64) -> Vec<(HostId, u64)> {
        let hosts: Vec<_> = self
            .hosts
            .read()
            .iter()
            .filter(|(h, _)| *h != here)
            .map(|(h, r)| (h.clone(), Arc::clone(r)))
            .collect();
        let mut free = Vec::new();
        for (host, entry) in hosts {
            let mut replica = entry.lock();
            match replica.probe {
                _ if !replica.alive => continue,
                Some((_, sent_ns)) if now_ns.saturating_sub(sent_ns) < PROBE_LOST_NS => continue,
                Some((_, sent_ns)) => {
                    replica.health.failed(now_ns, now_ns - sent_ns);
                    replica.probe = None;
                }
                None => {}
            }
            let wanted = replica
                .wanted_ns
                .is_some_and(|at_ns| now_ns.saturating_sub(at_ns) < WANTED_NS);
            let key = (!wanted, replica.probed_ns);
            drop(replica);
            free.push((key, host, entry));
        }
        free.sort_by(|(a, a_host, _), (b, b_host, _)| (a, a_host).cmp(&(b, b_host)));
        let wanted = free.iter().take_while(|((others, _), ..)| !others).count();
        // Beyond their places those that are wanted wait for the next turn, and the others come in.
        if free.len() > PROBES_PER_TURN_MAX && wanted > PROBES_WANTED_MAX {
            free.drain(PROBES_WANTED_MAX..wanted);
        }
        free.truncate(PROBES_PER_TURN_MAX);
        let send = |(_, host, entry): (_, HostId, Arc<Mutex<Replica>>)| {
            let mut replica = entry.lock();
            (replica.probe, replica.probed_ns) = (Some((now_ns, now_ns)), now_ns);
            (host, now_ns)
        };
        free.into_iter().map(send).collect()
    }

    /// A probe's answer.
    pub(crate) fn probed(&self, host: &HostId, token: u64, now_ns: u64) {
        let entry = self.entry(host);
        let mut replica = entry.lock();
        if let Some((_, sent_ns)) = replica.probe.take_if(|(expected, _)| *expected == token) {
            replica.health.answered(now_ns.saturating_sub(sent_ns));
        }
    }

    /// Smoothed latency of a host, in ns.
    pub(crate) fn latency_ns(&self, host: &HostId) -> Option<u64> {
        let entry = self.hosts.read().get(host).cloned()?;
        let replica = entry.lock();
        replica.health.latency_ns()
    }

    /// The members as candidates for a step of `digest`. This host counts as ready and near.
    pub(crate) fn candidates(&self, members: &[HostId], here: &HostId, digest: &Digest, now_ns: u64) -> Vec<Candidate> {
        let hosts = self.hosts.read();
        members
            .iter()
            .map(|host| {
                let is_here = host == here;
                let mut candidate = Candidate {
                    host: host.clone(),
                    here: is_here,
                    ready: is_here,
                    closed: true,
                    latency_ns: is_here.then_some(0),
                    cpu: 0.0,
                };
                if let Some(entry) = hosts.get(host) {
                    let mut replica = entry.lock();
                    candidate.cpu = replica.cpu;
                    if !is_here {
                        replica.wanted_ns = Some(now_ns);
                        candidate.ready = replica.control && replica.ready.contains(digest);
                        candidate.closed = replica.health.closed(now_ns);
                        candidate.latency_ns = replica.health.latency_ns();
                    }
                }
                candidate
            })
            .collect()
    }

    /// Every host that is known to be alive and runs controllers.
    pub(crate) fn controllers(&self) -> Vec<HostId> {
        let mut hosts: Vec<HostId> = self
            .hosts
            .read()
            .iter()
            .filter(|(_, r)| {
                let replica = r.lock();
                replica.alive && replica.control
            })
            .map(|(h, _)| h.clone())
            .collect();
        hosts.sort_unstable();
        hosts
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::collections::BTreeMap;

    use super::*;

    const TURN_NS: u64 = bumpless_core::chatter::PROBE_NS;

    fn host(n: usize) -> HostId {
        HostId::new(format!("h{n}")).unwrap()
    }

    fn cell(hosts: usize) -> Replicas {
        let replicas = Replicas::default();
        for n in 0..hosts {
            replicas.seen(&host(n), true, 0.0, &[]);
        }
        replicas
    }

    /// Probes for so many turns, each answered; gives how often each host was probed.
    fn turns(replicas: &Replicas, from: u64, turns: u64, wanted: &[HostId]) -> BTreeMap<HostId, u64> {
        let mut count = BTreeMap::new();
        for turn in from..from + turns {
            let now_ns = turn * TURN_NS;
            replicas.candidates(wanted, &host(0), &Digest::of(b"x"), now_ns);
            let due = replicas.probes(&host(0), now_ns);
            assert!(due.len() <= PROBES_PER_TURN_MAX, "{} at one turn", due.len());
            for (other, token) in due {
                replicas.probed(&other, token, now_ns + 1);
                *count.entry(other).or_default() += 1;
            }
        }
        count
    }

    #[test]
    fn a_small_cell_is_probed_whole_at_every_turn() {
        let count = turns(&cell(PROBES_PER_TURN_MAX + 1), 1, 10, &[]);
        assert_eq!(count.len(), PROBES_PER_TURN_MAX);
        assert!(count.values().all(|n| *n == 10), "{count:?}");
    }

    #[test]
    fn a_large_cell_costs_no_more_and_replicas_come_first_while_nobody_is_forgotten() {
        let replicas = cell(101);
        let wanted = [host(41), host(42)];
        let count = turns(&replicas, 1, 50, &wanted);
        assert!(wanted.iter().all(|h| count[h] == 50), "{count:?}");
        assert_eq!(count.len(), 100, "everybody was probed");
        // More replicas than places: they take turns, and one place stays for the others.
        let many: Vec<HostId> = (1..=30).map(host).collect();
        let count = turns(&replicas, 51, 100, &many);
        // The two from before are wanted still.
        let turns_each = 100 * PROBES_WANTED_MAX as u64 / (30 + wanted.len() as u64);
        assert!(many.iter().all(|h| count[h] + 2 >= turns_each), "{count:?}");
        assert_eq!(count.len(), 100, "everybody was probed");
        // A loop that went: its members are hosts like others after a while.
        let later = 151 + WANTED_NS / TURN_NS;
        let count = turns(&replicas, later, 25, &[]);
        assert!(count.values().all(|n| *n == 2), "{count:?}");
    }

    #[test]
    fn a_probe_that_is_lost_counts_whether_or_not_another_is_sent() {
        let replicas = cell(40);
        let first = replicas.probes(&host(0), TURN_NS);
        let closed = |now_ns| {
            let all: Vec<HostId> = (1..40).map(host).collect();
            let candidates = replicas.candidates(&all, &host(0), &Digest::of(b"x"), now_ns);
            candidates.iter().filter(|c| c.closed).count()
        };
        // Nobody answers: two in a row open a breaker.
        for turn in 2..40 {
            replicas.probes(&host(0), turn * TURN_NS);
        }
        assert_eq!(first.len(), PROBES_PER_TURN_MAX);
        assert!(closed(40 * TURN_NS) < 39, "some are left alone");
    }
}
