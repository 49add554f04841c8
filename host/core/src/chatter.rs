//! How often hosts tell and ask each other what no cycle waits for, so that a host does not drown in it as its cell grows.
//!
//! Pure. Never: about the messages of cycles; a loop has a bounded number of replicas, so those grow with a host's own loops alone.
//!
//! ```text
//! told to everybody (vitals; how far library and intents are;
//!                    who was met, and where he listens):        a pause that grows with the hosts, beyond a small cell
//! asked of single hosts (probes):                               so many at a turn, those that steps may be asked of first
//! ```

/// Messages of one kind that a host is sent each second by all the others together, at most: a small part of what the cycles of
/// fifty loops are.
pub const TOLD_PER_S_MAX: u64 = 50;

/// Shortest pause between two vitals of a host, in ns.
pub const VITALS_NS_MIN: u64 = 200_000_000;

/// Shortest pause between two tellings of how far a host's copies of library and intents are, in ns.
pub const STANDING_NS_MIN: u64 = 1_000_000_000;

/// Shortest pause between two roll calls of a host, in ns: two hosts that lost each other meet again within some such pauses.
pub const ROLL_NS_MIN: u64 = 5_000_000_000;

/// Vitals missed in a row before what a host last said of itself counts as old.
pub const VITALS_MISSED_MAX: u64 = 10;

/// Between two turns of probes, in ns.
pub const PROBE_NS: u64 = 100_000_000;

/// Hosts that are probed at one turn.
pub const PROBES_PER_TURN_MAX: usize = 8;

/// Of these, hosts that steps may be asked of; the others share what is left, so that none is forgotten.
pub const PROBES_WANTED_MAX: usize = PROBES_PER_TURN_MAX - 1;

/// How long a host stays one that steps may be asked of, in ns, after it last was a member of a loop that runs here.
pub const WANTED_NS: u64 = 10_000_000_000;

/// Pause between two messages of one kind to everybody, in ns, in a cell of so many hosts: `least_ns` where they are few.
#[must_use]
pub const fn pause_ns(least_ns: u64, hosts: usize) -> u64 {
    let others = hosts.saturating_sub(1) as u64;
    let shared_ns = others.saturating_mul(1_000_000_000 / TOLD_PER_S_MAX);
    if shared_ns > least_ns { shared_ns } else { least_ns }
}

/// Messages a second that a host of a cell of so many hosts receives for all this, when nothing happens: vitals, standings and roll
/// calls of the others, their probes, and the answers to its own.
#[must_use]
pub fn received_per_s(hosts: usize) -> f64 {
    let others = hosts.saturating_sub(1);
    let told = |least_ns| others as f64 * 1e9 / pause_ns(least_ns, hosts) as f64;
    let probes = others.min(PROBES_PER_TURN_MAX) as f64 * 1e9 / PROBE_NS as f64;
    // As many are asked of a host on the mean as it asks.
    told(VITALS_NS_MIN) + told(STANDING_NS_MIN) + told(ROLL_NS_MIN) + 2.0 * probes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_cells_talk_at_their_own_pace() {
        for hosts in [1, 2, 5, 11] {
            assert_eq!(pause_ns(VITALS_NS_MIN, hosts), VITALS_NS_MIN, "{hosts}");
            assert_eq!(pause_ns(STANDING_NS_MIN, hosts), STANDING_NS_MIN, "{hosts}");
        }
        assert!((received_per_s(5) - (4.0 * 5.0 + 4.0 + 4.0 / 5.0 + 2.0 * 4.0 * 10.0)).abs() < 1e-9);
    }

    #[test]
    fn what_a_host_receives_is_bounded_whatever_the_size_of_its_cell() {
        let most = 3.0 * TOLD_PER_S_MAX as f64 + 2.0 * PROBES_PER_TURN_MAX as f64 * 1e9 / PROBE_NS as f64;
        for hosts in [251, 1_000, 10_000] {
            assert!(
                (received_per_s(hosts) - most).abs() < 1e-6,
                "{hosts}: {}",
                received_per_s(hosts)
            );
        }
        assert!((0..300).all(|hosts| received_per_s(hosts) <= most + 1e-6));
        assert_eq!(pause_ns(VITALS_NS_MIN, usize::MAX), u64::MAX, "no overflow");
    }
}
