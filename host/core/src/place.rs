//! Where loops live: rendezvous (highest random weight) hashing, the same on every host without talking.
//!
//! Source: Thaler and Ravishankar, "Using name-based mappings to increase hit rates", IEEE/ACM ToN 6(1), 1998. When a host
//! leaves, only its own loops move. What a loop prefers goes before the hash. Never: looks at load or liveness; the caller
//! gives the eligible hosts.

use crate::name::{HostId, LoopId};

/// A host that may hold loops.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Candidate {
    /// The host.
    pub host: HostId,
    /// Words that it goes by besides its name, such as `east`; see [`crate::LoopSpec::prefer`].
    pub labels: Vec<String>,
}

impl Candidate {
    /// Place of the first word of `prefer` that is this host's name or one of its labels; the number of words where none
    /// is. Less is better.
    #[must_use]
    pub fn preference(&self, prefer: &[String]) -> usize {
        let is_it = |word: &String| word == self.host.as_str() || self.labels.contains(word);
        prefer.iter().position(is_it).unwrap_or(prefer.len())
    }
}

/// FNV-1a, 64 bits, then a final mix (SplitMix64's), because FNV alone leaves the high bits of short names alike.
fn weight(parts: [&str; 2]) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for part in parts {
        // A byte that no name holds keeps ("ab", "c") apart from ("a", "bc").
        for byte in part.bytes().chain([0xff]) {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
    hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    hash ^ (hash >> 31)
}

/// All hosts, best first, for this loop. The order of the input does not matter.
#[must_use]
pub fn rank(loop_id: &LoopId, hosts: &[HostId]) -> Vec<HostId> {
    let mut weighed: Vec<(u64, &HostId)> = hosts
        .iter()
        .map(|h| (weight([loop_id.as_str(), h.as_str()]), h))
        .collect();
    weighed.sort_unstable_by(|a, b| b.cmp(a));
    weighed.dedup();
    weighed.into_iter().map(|(_, h)| h.clone()).collect()
}

/// All candidates, best first: those that the loop prefers, in the order of its words, and each alike by [`rank`].
#[must_use]
pub fn rank_preferring(loop_id: &LoopId, candidates: &[Candidate], prefer: &[String]) -> Vec<HostId> {
    let hosts: Vec<HostId> = candidates.iter().map(|c| c.host.clone()).collect();
    let mut ranked = rank(loop_id, &hosts);
    // A stable sort: within one preference the rank stays.
    ranked.sort_by_key(|host| {
        let candidate = candidates.iter().find(|c| c.host == *host);
        candidate.map_or(prefer.len(), |c| c.preference(prefer))
    });
    ranked
}

/// The hosts that hold this loop: the first `n` of the ranking.
#[must_use]
pub fn members(loop_id: &LoopId, eligible: &[Candidate], prefer: &[String], n: usize) -> Vec<HostId> {
    let mut ranked = rank_preferring(loop_id, eligible, prefer);
    ranked.truncate(n);
    ranked
}

/// Where in its period a loop runs, in ns, so that loops of one period do not all wake at once.
#[must_use]
pub fn phase_ns(loop_id: &LoopId, period_ns: u64) -> u64 {
    weight([loop_id.as_str(), ""]) % period_ns.max(1)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::collections::BTreeMap;

    use proptest::prelude::*;

    use super::*;

    fn hosts(count: usize) -> Vec<HostId> {
        (1..=count).map(|n| HostId::new(format!("host-{n}")).unwrap()).collect()
    }

    fn loops(count: usize) -> Vec<LoopId> {
        (1..=count).map(|n| LoopId::new(format!("loop-{n}")).unwrap()).collect()
    }

    fn candidates(hosts: &[HostId]) -> Vec<Candidate> {
        let plain = |host: &HostId| Candidate {
            host: host.clone(),
            labels: vec![],
        };
        hosts.iter().map(plain).collect()
    }

    #[test]
    fn what_a_loop_prefers_goes_before_the_hash() {
        let id = LoopId::new("level-1").unwrap();
        let mut all = candidates(&hosts(5));
        all[0].labels = vec!["east".to_owned()];
        all[3].labels = vec!["fast".to_owned(), "east".to_owned()];
        let ranked = |prefer: &[&str]| -> Vec<String> {
            let prefer: Vec<String> = prefer.iter().map(ToString::to_string).collect();
            let ranked = rank_preferring(&id, &all, &prefer);
            ranked.iter().map(ToString::to_string).collect()
        };
        assert_eq!(ranked(&[]), ["host-3", "host-4", "host-5", "host-2", "host-1"]);
        assert_eq!(
            ranked(&["nobody"]),
            ranked(&[]),
            "a word that nobody goes by changes nothing"
        );
        assert_eq!(ranked(&["host-2"]), ["host-2", "host-3", "host-4", "host-5", "host-1"]);
        assert_eq!(ranked(&["east"]), ["host-4", "host-1", "host-3", "host-5", "host-2"]);
        assert_eq!(
            ranked(&["host-1", "fast", "host-5"]),
            ["host-1", "host-4", "host-5", "host-3", "host-2"]
        );
    }

    #[test]
    fn the_ranking_is_the_same_in_every_version() {
        // A host of another version must agree, so these values never change.
        assert_eq!(weight(["level-1", "host-1"]), 0x3675_20b4_9f5f_c8c6);
        let ranked: Vec<String> = rank(&LoopId::new("level-1").unwrap(), &hosts(5))
            .iter()
            .map(ToString::to_string)
            .collect();
        assert_eq!(ranked, ["host-3", "host-4", "host-5", "host-2", "host-1"]);
        assert_eq!(phase_ns(&LoopId::new("level-1").unwrap(), 10_000_000), 9_508_839);
    }

    #[test]
    fn neighbouring_names_do_not_run_together() {
        assert_ne!(weight(["ab", "c"]), weight(["a", "bc"]));
        assert_ne!(weight(["a", "b"]), weight(["b", "a"]));
    }

    #[test]
    fn loops_spread_evenly_and_so_do_those_of_a_host_that_leaves() {
        // 5,000 loops on 5 hosts: 1,000 each with a standard deviation of 28; five of those are allowed. Names that differ
        // in one digit are the hard case for a weak hash.
        let (hosts, loops) = (hosts(5), loops(5_000));
        let count = |hosts: &[HostId], loops: &[LoopId]| {
            let mut counts = BTreeMap::new();
            for id in loops {
                *counts.entry(rank(id, hosts)[0].clone()).or_insert(0_i64) += 1;
            }
            counts
        };
        for (host, n) in count(&hosts, &loops) {
            assert!((n - 1_000).abs() < 141, "{host}: {n}");
        }
        let orphans: Vec<LoopId> = loops.into_iter().filter(|id| rank(id, &hosts)[0] == hosts[2]).collect();
        let left: Vec<HostId> = hosts.iter().filter(|h| **h != hosts[2]).cloned().collect();
        let share = orphans.len() as i64 / 4;
        for (host, n) in count(&left, &orphans) {
            assert!((n - share).abs() < 70, "{host} takes {n} of {}", orphans.len());
        }
    }

    #[test]
    fn phases_fill_the_period() {
        let mut tenths = [0_i64; 10];
        for id in loops(5_000) {
            tenths[usize::try_from(phase_ns(&id, 1_000_000) / 100_000).unwrap()] += 1;
        }
        assert!(tenths.iter().all(|n| (n - 500).abs() < 110), "{tenths:?}");
        assert_eq!(phase_ns(&loops(1)[0], 0), 0);
    }

    proptest! {
        #[test]
        fn only_the_loops_of_the_host_that_leaves_move(count in 1..12_usize, gone in any::<prop::sample::Index>(), n in 1..5_usize, id in "[a-z][a-z0-9-]{0,20}") {
            let id = LoopId::new(id).unwrap();
            let hosts = hosts(count);
            let gone = &hosts[gone.index(count)];
            let left: Vec<HostId> = hosts.iter().filter(|h| *h != gone).cloned().collect();
            let before = members(&id, &candidates(&hosts), &[], n);
            let after = members(&id, &candidates(&left), &[], n);
            // Those that stay keep their order, and at most one comes in, at the end.
            let kept: Vec<HostId> = before.iter().filter(|h| *h != gone).cloned().collect();
            prop_assert!(after.starts_with(&kept));
            prop_assert!(after.len() <= kept.len() + 1);
            prop_assert_eq!(after.len(), n.min(left.len()));
            if !before.contains(gone) {
                prop_assert_eq!(before, after);
            }
        }

        #[test]
        fn the_order_of_the_hosts_does_not_matter(mut names in proptest::collection::vec("[a-z]{1,3}", 0..12), seed in any::<u64>()) {
            let id = LoopId::new("level-1").unwrap();
            let make = |names: &[String]| -> Vec<HostId> { names.iter().map(|n| HostId::new(n.clone()).unwrap()).collect() };
            let ranked = rank(&id, &make(&names));
            names.sort_by_key(|name| weight([name.as_str(), &seed.to_string()]));
            prop_assert_eq!(&rank(&id, &make(&names)), &ranked);
            // Each host once, however often it was named.
            names.sort();
            names.dedup();
            let mut sorted = ranked;
            sorted.sort();
            prop_assert_eq!(sorted, make(&names));
        }
    }
}
