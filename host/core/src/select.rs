//! Which replica steps: pure, so that a simulator can ask it a million times.
//!
//! `select` gives an order: the first is asked, the rest are what is left when it is silent. Never: remembers anything;
//! measurements come in with the candidates ([`Health`] keeps them), random numbers as arguments.

use crate::{name::HostId, name::LoopId, place, spec::Strategy};

/// Latencies within this of the best are good enough and take turns, in ns. Below it, differences are the scheduler's
/// noise on commodity kernels, and a herd on one replica would make them true.
pub const LATENCY_GOOD_ENOUGH_NS: u64 = 2_000_000;
/// Loads within this of the least are good enough and take turns (part of the cores that a host may use).
pub const CPU_GOOD_ENOUGH: f32 = 0.15;
/// Weight of a new sample in the smoothed latency: 1/4 follows a step of the network in a handful of cycles.
const SMOOTHING: f64 = 0.25;
/// Failures in a row that open a replica's breaker.
const BREAKER_FAILURES: u32 = 2;
/// First time that a breaker stays open, in ns; doubles up to the greatest.
const BREAKER_NS_MIN: u64 = 500_000_000;
/// Longest time that a breaker stays open without a probe that succeeds, in ns.
const BREAKER_NS_MAX: u64 = 30_000_000_000;

/// What a host knows of one replica: smoothed latency and a circuit breaker.
///
/// ```text
/// closed ── 2 failures in a row ──► open ── a probe answers ──► closed
///                                    ▲ └── time is up: tried once; a failure doubles the time
///                                    └──────────┘
/// ```
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Health {
    latency_ns: Option<f64>,
    failures: u32,
    open_until_ns: u64,
    opened: u32,
}

impl Health {
    /// A step or probe was answered after `latency_ns`.
    pub fn answered(&mut self, latency_ns: u64) {
        let sample = latency_ns as f64;
        self.latency_ns = Some(self.latency_ns.map_or(sample, |l| l + SMOOTHING * (sample - l)));
        self.failures = 0;
        self.opened = 0;
        self.open_until_ns = 0;
    }

    /// A step or probe got no answer within `waited_ns`: the latency is at least that.
    pub fn failed(&mut self, now_ns: u64, waited_ns: u64) {
        let waited = waited_ns as f64;
        self.latency_ns = Some(self.latency_ns.map_or(waited, |l| l.max(l + SMOOTHING * (waited - l))));
        self.failures += 1;
        if self.failures >= BREAKER_FAILURES && now_ns >= self.open_until_ns {
            self.open_until_ns = now_ns + (BREAKER_NS_MIN << self.opened.min(6)).min(BREAKER_NS_MAX);
            self.opened += 1;
        }
    }

    /// Smoothed latency, in ns.
    #[must_use]
    pub fn latency_ns(&self) -> Option<u64> {
        self.latency_ns.map(|l| l as u64)
    }

    /// May the replica be asked?
    #[must_use]
    pub const fn closed(&self, now_ns: u64) -> bool {
        now_ns >= self.open_until_ns
    }
}

/// One replica, as the owner sees it.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// The host.
    pub host: HostId,
    /// Is it the owner itself?
    pub here: bool,
    /// Does it hold the component, ready?
    pub ready: bool,
    /// May it be asked (breaker closed)?
    pub closed: bool,
    /// Smoothed latency, in ns; none before the first answer.
    pub latency_ns: Option<u64>,
    /// Load of the cores that it may use, 0 to 1.
    pub cpu: f32,
}

/// The order in which to ask, as indices into `candidates`. Replicas that are not ready are left out; those with an open
/// breaker come last. `random` is any number, fresh for each call.
#[must_use]
pub fn select(strategy: Strategy, candidates: &[Candidate], loop_id: &LoopId, seq: u64, random: u64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..candidates.len()).filter(|&i| candidates[i].ready).collect();
    if order.is_empty() {
        return order;
    }
    let turn = |order: &mut Vec<usize>, by: u64| {
        let n = order.len() as u64;
        order.rotate_left((by % n) as usize);
    };
    // Candidates that are good enough come first and take turns; the others follow, best first.
    let take_turns = |order: &mut Vec<usize>, good: &dyn Fn(usize) -> bool, cost: &dyn Fn(usize) -> f64| {
        order.sort_by(|&a, &b| {
            good(b).cmp(&good(a)).then(if good(a) && good(b) {
                a.cmp(&b)
            } else {
                cost(a).total_cmp(&cost(b))
            })
        });
        let n = order.iter().take_while(|&&i| good(i)).count();
        if n > 1 {
            order[..n].rotate_left((seq % n as u64) as usize);
        }
    };
    // A replica that was never measured counts as good: it is measured by being asked.
    let latency = |i: usize| candidates[i].latency_ns.unwrap_or(0) as f64;
    match strategy {
        Strategy::RoundRobin => turn(&mut order, seq),
        Strategy::Random => turn(&mut order, random),
        Strategy::Cpu => {
            let least = order.iter().map(|&i| candidates[i].cpu).fold(f32::INFINITY, f32::min);
            take_turns(&mut order, &|i| candidates[i].cpu <= least + CPU_GOOD_ENOUGH, &|i| {
                f64::from(candidates[i].cpu)
            });
        }
        Strategy::Latency => {
            let best = order.iter().map(|&i| latency(i)).fold(f64::INFINITY, f64::min);
            take_turns(
                &mut order,
                &|i| latency(i) <= best + LATENCY_GOOD_ENOUGH_NS as f64,
                &latency,
            );
        }
        Strategy::P2c => {
            // Latency has the noise floor added, so that load decides among equals; load has a floor, so that latency does.
            let cost = |i: usize| {
                (latency(i) + LATENCY_GOOD_ENOUGH_NS as f64)
                    * (f64::from(candidates[i].cpu) + f64::from(CPU_GOOD_ENOUGH))
            };
            turn(&mut order, random);
            if order.len() > 1 {
                let other = 1 + ((random >> 32) % (order.len() as u64 - 1)) as usize;
                order.swap(1, other);
                if cost(order[1]) < cost(order[0]) {
                    order.swap(0, 1);
                }
            }
        }
        // Whom to ask is the ballot's; this host's own step costs no message.
        Strategy::Local | Strategy::Vote(_) => order.sort_by_key(|&i| !candidates[i].here),
        Strategy::Shard => {
            let hosts: Vec<HostId> = order.iter().map(|&i| candidates[i].host.clone()).collect();
            let rank = place::rank(loop_id, &hosts);
            order.sort_by_key(|&i| rank.iter().position(|h| *h == candidates[i].host));
        }
    }
    // Stable: within each class the strategy's order stays.
    order.sort_by_key(|&i| !candidates[i].closed);
    order
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::spec::Strategy as Choice;
    use proptest::strategy::Strategy;

    fn candidate(n: usize, latency_ns: Option<u64>, cpu: f32, closed: bool, ready: bool) -> Candidate {
        Candidate {
            host: HostId::new(format!("h{n}")).expect("valid"),
            here: n == 0,
            ready,
            closed,
            latency_ns,
            cpu,
        }
    }

    fn loop_id() -> LoopId {
        LoopId::new("l").expect("valid")
    }

    fn any_candidates() -> impl Strategy<Value = Vec<Candidate>> {
        prop::collection::vec(
            (
                prop::option::of(0u64..50_000_000),
                0.0f32..1.0,
                any::<bool>(),
                any::<bool>(),
            ),
            0..12,
        )
        .prop_map(|v| {
            v.into_iter()
                .enumerate()
                .map(|(n, (l, c, o, r))| candidate(n, l, c, o, r))
                .collect()
        })
    }

    proptest! {
        #[test]
        fn every_ready_replica_once_and_closed_ones_first(cs in any_candidates(), seq: u64, random: u64, s in 0usize..7) {
            let order = select(Choice::ALL[s], &cs, &loop_id(), seq, random);
            let mut sorted = order.clone();
            sorted.sort_unstable();
            prop_assert_eq!(sorted, (0..cs.len()).filter(|&i| cs[i].ready).collect::<Vec<_>>());
            prop_assert!(order.windows(2).all(|w| cs[w[0]].closed || !cs[w[1]].closed));
        }

        #[test]
        fn the_overloaded_and_the_slow_are_left(seq: u64, random: u64) {
            let cs = [candidate(0, Some(300_000), 0.2, true, true), candidate(1, Some(400_000), 0.95, true, true),
                      candidate(2, Some(200_000), 0.3, true, true)];
            prop_assert_ne!(select(Choice::Cpu, &cs, &loop_id(), seq, random)[0], 1);
            prop_assert_ne!(select(Choice::P2c, &cs, &loop_id(), seq, random)[0], 1);
            let cs = [candidate(0, Some(300_000), 0.2, true, true), candidate(1, Some(5_400_000), 0.2, true, true),
                      candidate(2, None, 0.3, true, true)];
            prop_assert_ne!(select(Choice::Latency, &cs, &loop_id(), seq, random)[0], 1);
        }

        #[test]
        fn good_enough_ones_take_turns(s in 0usize..3, start in 0u64..1000) {
            let strategy = [Choice::RoundRobin, Choice::Cpu, Choice::Latency][s];
            let cs: Vec<_> = (0..4).map(|n| candidate(n, Some(200_000 + n as u64), 0.1, true, true)).collect();
            let mut firsts: Vec<_> = (start..start + 4).map(|seq| select(strategy, &cs, &loop_id(), seq, 0)[0]).collect();
            firsts.sort_unstable();
            prop_assert_eq!(firsts, vec![0, 1, 2, 3]);
        }
    }

    #[test]
    fn breaker_opens_doubles_and_closes() {
        let mut h = Health::default();
        h.failed(0, 1_000_000);
        assert!(h.closed(0));
        h.failed(1, 1_000_000);
        assert!(!h.closed(2) && h.closed(1 + BREAKER_NS_MIN));
        h.failed(1 + BREAKER_NS_MIN, 1_000_000);
        assert!(!h.closed(2 * BREAKER_NS_MIN) && h.closed(1 + 3 * BREAKER_NS_MIN));
        h.answered(200_000);
        assert!(h.closed(3));
    }
}
