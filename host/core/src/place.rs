//! Where loops live: rendezvous (highest random weight) hashing, the same on every host without talking.
//!
//! Source: Thaler and Ravishankar, "Using name-based mappings to increase hit rates", IEEE/ACM ToN 6(1), 1998. When a host
//! leaves, only its own loops move. Never: looks at load or liveness; the caller gives the eligible hosts.

use crate::name::{HostId, LoopId};

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
    let mut weighed: Vec<(u64, &HostId)> = hosts.iter().map(|h| (weight([loop_id.as_str(), h.as_str()]), h)).collect();
    weighed.sort_unstable_by(|a, b| b.cmp(a));
    weighed.dedup();
    weighed.into_iter().map(|(_, h)| h.clone()).collect()
}

/// The hosts that hold this loop: the first `n` of the ranking.
#[must_use]
pub fn members(loop_id: &LoopId, eligible: &[HostId], n: usize) -> Vec<HostId> {
    let mut ranked = rank(loop_id, eligible);
    ranked.truncate(n);
    ranked
}

/// Where in its period a loop runs, in ns, so that loops of one period do not all wake at once.
#[must_use]
pub fn phase_ns(loop_id: &LoopId, period_ns: u64) -> u64 {
    weight([loop_id.as_str(), ""]) % period_ns.max(1)
}
