//! What this host knows of the others as replicas: latency, load, what they hold ready, and whether they answer.
//!
//! Shared by all workers; each entry has its own short lock. Never: asks anybody; probes are sent by worker 0.

use std::{collections::HashMap, sync::Arc};

use bumpless_core::{
    Digest, HostId,
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
    probe: Option<(u64, u64)>,
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

    /// The hosts to probe now, all but this one, each with a token to send. A probe that got lost counts as a failure first.
    pub(crate) fn probes(&self, here: &HostId, now_ns: u64) -> Vec<(HostId, u64)> {
        let hosts: Vec<_> = self
            .hosts
            .read()
            .iter()
            .filter(|(h, _)| *h != here)
            .map(|(h, r)| (h.clone(), Arc::clone(r)))
            .collect();
        let mut due = Vec::new();
        for (host, entry) in hosts {
            let mut replica = entry.lock();
            if !replica.alive {
                continue;
            }
            match replica.probe {
                Some((_, sent_ns)) if now_ns.saturating_sub(sent_ns) < PROBE_LOST_NS => continue,
                Some((_, sent_ns)) => replica.health.failed(now_ns, now_ns - sent_ns),
                None => {}
            }
            replica.probe = Some((now_ns, now_ns));
            due.push((host, now_ns));
        }
        due
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
                    let replica = entry.lock();
                    candidate.cpu = replica.cpu;
                    if !is_here {
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
