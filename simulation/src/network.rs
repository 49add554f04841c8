//! The links between hosts: how long a message takes, whether it arrives, and whether it arrives twice.
//!
//! Never: looks into a message.

use crate::{plan::Fault, random::Random};

/// Shortest way of a message, in ns.
const LEAST_NS: u64 = 150_000;
/// Mean of what comes on top, in ns.
const MORE_NS: f64 = 100_000.0;
/// One in so many messages waits longer, as behind a burst.
const BURST_PART: f64 = 0.001;
/// Mean of that wait, in ns.
const BURST_NS: f64 = 2_000_000.0;
/// Of a bad link: messages lost, repeated, and held up, and by how much in the mean.
const BAD: (f64, f64, f64, f64) = (0.2, 0.1, 0.3, 10_000_000.0);

/// Of a saturated host: how long one message occupies its link, and how long one waits there before it is dropped, in ns. Less
/// than a loop at 1 s with its votes needs many times over, and less than a tenth of what a host with fifty such loops sends.
const SATURATED: (u64, u64) = (2_500_000, 50_000_000);

/// A host's link while other traffic fills it.
#[derive(Debug, Clone, Copy, Default)]
struct Link {
    /// Faults that fill it now.
    faults: u32,
    /// Until when it is busy with what was sent.
    busy_until_ns: u64,
}

/// The links.
#[derive(Debug)]
pub(crate) struct Network {
    random: Random,
    /// Faults of each host that make its links bad.
    bad: Vec<u32>,
    /// Of each host.
    links: Vec<Link>,
    /// Partitions by the number of their fault: the hosts on one side, and whether what comes from them gets through.
    cuts: Vec<(usize, Vec<u32>, bool)>,
}

impl Network {
    pub(crate) fn new(seed: u64, hosts: u32) -> Self {
        Self {
            random: Random::new(seed, "network"),
            bad: vec![0; hosts as usize],
            links: vec![Link::default(); hosts as usize],
            cuts: Vec::new(),
        }
    }

    pub(crate) fn cut(&mut self, number: usize, fault: &Fault) {
        let mut side = fault.hosts.clone();
        side.sort_unstable();
        self.cuts.push((number, side, fault.one_way));
    }

    pub(crate) fn mend(&mut self, number: usize) {
        self.cuts.retain(|(n, ..)| *n != number);
    }

    pub(crate) fn spoil(&mut self, host: u32, bad: bool) {
        if let Some(count) = self.bad.get_mut(host as usize) {
            *count = if bad { *count + 1 } else { count.saturating_sub(1) };
        }
    }

    pub(crate) fn saturate(&mut self, host: u32, saturated: bool) {
        if let Some(link) = self.links.get_mut(host as usize) {
            link.faults = if saturated {
                link.faults + 1
            } else {
                link.faults.saturating_sub(1)
            };
        }
    }

    /// How long a message waits at the saturated links on its way, in ns; none where one has no room for it.
    fn queue(&mut self, from: u32, to: u32, now_ns: u64) -> Option<u64> {
        let (each_ns, wait_ns_max) = SATURATED;
        let mut waits_ns = 0;
        for host in [from, to] {
            let Some(link) = self.links.get_mut(host as usize).filter(|link| link.faults > 0) else {
                continue;
            };
            let free_ns = link.busy_until_ns.max(now_ns);
            if free_ns - now_ns > wait_ns_max {
                return None;
            }
            link.busy_until_ns = free_ns + each_ns;
            waits_ns += link.busy_until_ns - now_ns;
        }
        Some(waits_ns)
    }

    /// Does nothing at all get from one to the other?
    pub(crate) fn is_cut(&self, from: u32, to: u32) -> bool {
        self.cuts.iter().any(|(_, side, one_way)| {
            let (out, into) = (side.binary_search(&from).is_ok(), side.binary_search(&to).is_ok());
            out != into && !(*one_way && out)
        })
    }

    /// The times in ns until a message arrives: none where it is lost, two where it comes twice.
    pub(crate) fn ways(&mut self, from: u32, to: u32, now_ns: u64) -> [Option<u64>; 2] {
        if self.is_cut(from, to) {
            return [None, None];
        }
        let Some(waits_ns) = self.queue(from, to, now_ns) else {
            return [None, None];
        };
        let is_bad = |host: u32| self.bad.get(host as usize).is_some_and(|count| *count > 0);
        let bad = is_bad(from) || is_bad(to);
        let (lost, twice, held_up, by_ns) = BAD;
        if bad && self.random.chance(lost) {
            return [None, None];
        }
        let way = |random: &mut Random| {
            let mut ns = waits_ns + LEAST_NS + random.exponential(MORE_NS);
            if random.chance(BURST_PART) {
                ns += random.exponential(BURST_NS);
            }
            if bad && random.chance(held_up) {
                ns += random.exponential(by_ns);
            }
            ns
        };
        let first = way(&mut self.random);
        let again = (bad && self.random.chance(twice)).then(|| way(&mut self.random));
        [Some(first), again]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::FaultKind;

    #[test]
    fn a_partition_parts_its_sides_and_one_way_lets_out_what_is_inside() {
        let mut network = Network::new(1, 4);
        let mut fault = Fault {
            kind: FaultKind::Partition,
            at_ms: 0,
            for_ms: 1,
            hosts: vec![2, 0],
            one_way: false,
        };
        network.cut(7, &fault);
        assert!(network.is_cut(0, 1) && network.is_cut(1, 2));
        assert!(!network.is_cut(0, 2) && !network.is_cut(1, 3));
        network.mend(7);
        fault.one_way = true;
        network.cut(8, &fault);
        assert!(!network.is_cut(0, 1) && network.is_cut(1, 0));
        assert_eq!(network.ways(1, 0, 0), [None, None]);
        assert!(network.ways(0, 1, 0)[0].is_some_and(|ns| ns >= LEAST_NS));
    }

    #[test]
    fn a_bad_link_loses_and_repeats_and_a_good_one_does_not() {
        let mut network = Network::new(1, 2);
        let count = |network: &mut Network| {
            let ways: Vec<_> = (0..1000).map(|_| network.ways(0, 1, 0)).collect();
            let lost = ways.iter().filter(|way| way[0].is_none()).count();
            (lost, ways.iter().filter(|way| way[1].is_some()).count())
        };
        assert_eq!(count(&mut network), (0, 0));
        network.spoil(1, true);
        let (lost, twice) = count(&mut network);
        assert!(
            (150..250).contains(&lost) && (50..130).contains(&twice),
            "{lost} {twice}"
        );
        network.spoil(1, false);
        assert_eq!(count(&mut network), (0, 0));
    }

    #[test]
    fn a_saturated_link_queues_drops_and_recovers() {
        let mut network = Network::new(1, 3);
        network.saturate(1, true);
        let sent: Vec<Option<u64>> = (0..100).map(|_| network.ways(0, 1, 1_000)[0]).collect();
        let passed = sent.iter().flatten().count();
        assert!((20..25).contains(&passed), "as many as fit in the queue: {passed}");
        let (each_ns, wait_ns_max) = SATURATED;
        let longest_ns = sent.iter().flatten().max().copied().unwrap_or_default();
        assert!(
            longest_ns > wait_ns_max,
            "the last waits for all before it: {longest_ns}"
        );
        assert!(
            network.ways(0, 2, 1_000)[0].is_some_and(|ns| ns < each_ns),
            "others are free"
        );
        assert!(
            network.ways(1, 0, 1_000_000_000)[0].is_some_and(|ns| ns >= each_ns),
            "both directions share it, and it empties"
        );
        network.saturate(1, false);
        assert_eq!(network.ways(0, 1, 1_000).iter().flatten().count(), 1);
    }
}
