//! Which registers are asked for together: fewest requests within the protocol's limits.
//!
//! Pure. A number is never split over two requests, so what is read of it is of one moment.

use serde::{Deserialize, Serialize};

use crate::limits::{BITS_PER_READ_MAX, REGISTERS_PER_READ_MAX};

/// The four address spaces of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Table {
    /// Bits to read and write (functions 1, 5, 15).
    Coil,
    /// Bits to read (function 2).
    Discrete,
    /// Registers to read and write (functions 3, 6, 16).
    Holding,
    /// Registers to read (function 4).
    Input,
}

impl Table {
    /// Does an address hold one bit?
    #[must_use]
    pub const fn is_bits(self) -> bool {
        matches!(self, Self::Coil | Self::Discrete)
    }

    /// Can it be written?
    #[must_use]
    pub const fn is_writable(self) -> bool {
        matches!(self, Self::Coil | Self::Holding)
    }

    /// Addresses of one read.
    #[must_use]
    pub const fn read_max(self) -> u16 {
        if self.is_bits() {
            BITS_PER_READ_MAX
        } else {
            REGISTERS_PER_READ_MAX
        }
    }

    /// Its name in messages.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Coil => "coils",
            Self::Discrete => "discrete inputs",
            Self::Holding => "holding registers",
            Self::Input => "input registers",
        }
    }
}

/// What one point needs read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Item {
    /// The point's number on its bus.
    pub point: usize,
    /// The unit behind the address.
    pub unit_id: u8,
    /// The address space.
    pub table: Table,
    /// How often, in ms.
    pub period_ms: u64,
    /// First address.
    pub start: u16,
    /// How many addresses.
    pub count: u16,
}

/// One request and the points that it serves.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Group {
    /// The unit behind the address.
    pub unit_id: u8,
    /// The address space.
    pub table: Table,
    /// How often, in ms.
    pub period_ms: u64,
    /// First address.
    pub start: u16,
    /// How many addresses.
    pub count: u16,
    /// The points, by address.
    pub items: Vec<Item>,
}

impl Group {
    /// The same points without a gap: one group for each stretch of addresses that are all wanted. For devices that
    /// refuse to read what they do not have.
    #[must_use]
    pub fn without_gaps(&self) -> Vec<Self> {
        merged(self.items.clone(), 0)
    }

    /// The same points in smaller requests, where the device does not have an address of this one: without gaps; where there
    /// are none, in two halves. One part where there is nothing to part: the address is that of its points.
    #[must_use]
    pub fn parts(&self) -> Vec<Self> {
        let mut parts = self.without_gaps();
        if parts.len() == 1 {
            let mut items = self.items.clone();
            let upper = items.split_off(items.len() / 2);
            parts = [items, upper].into_iter().flat_map(|items| merged(items, 0)).collect();
        }
        parts
    }
}

/// Merges items of the same unit, table and period whose addresses lie at most `gap_max` apart, within the protocol's
/// limits. Items may overlap.
#[must_use]
pub fn merged(mut items: Vec<Item>, gap_max: u16) -> Vec<Group> {
    items.sort_by_key(|i| (i.unit_id, i.table, i.period_ms, i.start, i.count, i.point));
    let mut groups: Vec<Group> = Vec::new();
    for item in items {
        // In 32 bits: an end may be 65,536.
        let item_end = u32::from(item.start) + u32::from(item.count);
        if let Some(group) = groups.last_mut() {
            let same = (group.unit_id, group.table, group.period_ms) == (item.unit_id, item.table, item.period_ms);
            let group_end = u32::from(group.start) + u32::from(group.count);
            let near = u32::from(item.start) <= group_end + u32::from(gap_max);
            let end = group_end.max(item_end);
            let length = end - u32::from(group.start);
            if same && near && length <= u32::from(group.table.read_max()) {
                group.count = length as u16;
                group.items.push(item);
                continue;
            }
        }
        groups.push(Group {
            unit_id: item.unit_id,
            table: item.table,
            period_ms: item.period_ms,
            start: item.start,
            count: item.count,
            items: vec![item],
        });
    }
    groups
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn item(point: usize, start: u16, count: u16) -> Item {
        Item {
            point,
            unit_id: 1,
            table: Table::Holding,
            period_ms: 100,
            start,
            count,
        }
    }

    fn shapes(groups: &[Group]) -> Vec<(u16, u16, usize)> {
        groups.iter().map(|g| (g.start, g.count, g.items.len())).collect()
    }

    #[test]
    fn neighbours_and_small_gaps_share_a_request() {
        let items = vec![item(0, 10, 2), item(1, 0, 1), item(2, 1, 4), item(3, 12, 1)];
        assert_eq!(shapes(&merged(items.clone(), 0)), [(0, 5, 2), (10, 3, 2)]);
        assert_eq!(shapes(&merged(items.clone(), 4)), [(0, 5, 2), (10, 3, 2)]);
        let one = merged(items, 5);
        assert_eq!(shapes(&one), [(0, 13, 4)]);
        assert_eq!(shapes(&one[0].without_gaps()), [(0, 5, 2), (10, 3, 2)]);
    }

    #[test]
    fn halves_end_at_the_single_point() {
        let groups = merged((0..5).map(|n| item(n, n as u16, 1)).collect(), 0);
        assert_eq!(shapes(&groups[0].parts()), [(0, 2, 2), (2, 3, 3)]);
        assert_eq!(shapes(&groups[0].parts()[1].parts()), [(2, 1, 1), (3, 2, 2)]);
        assert_eq!(groups[0].parts()[1].parts()[0].parts().len(), 1);
        let gap = merged(vec![item(0, 0, 1), item(1, 4, 1), item(2, 5, 1)], 10);
        assert_eq!(shapes(&gap[0].parts()), [(0, 1, 1), (4, 2, 2)], "gaps go first");
    }

    #[test]
    fn limits_overlaps_and_the_last_address() {
        let many: Vec<Item> = (0..200).map(|n| item(n, n as u16, 1)).collect();
        assert_eq!(shapes(&merged(many, 0)), [(0, 125, 125), (125, 75, 75)]);
        // A double at 124 does not fit any more, and is not cut.
        assert_eq!(
            shapes(&merged(vec![item(0, 0, 124), item(1, 124, 4)], 0)),
            [(0, 124, 1), (124, 4, 1)]
        );
        assert_eq!(
            shapes(&merged(vec![item(0, 5, 4), item(1, 5, 1), item(2, 6, 2)], 0)),
            [(5, 4, 3)]
        );
        assert_eq!(
            shapes(&merged(vec![item(0, 65_534, 2), item(1, 65_530, 1)], 10)),
            [(65_530, 6, 2)]
        );
        let bits: Vec<Item> = (0..2001)
            .map(|n| Item {
                table: Table::Coil,
                ..item(n, n as u16, 1)
            })
            .collect();
        assert_eq!(shapes(&merged(bits, 0)), [(0, 2000, 2000), (2000, 1, 1)]);
    }

    fn any_item() -> impl Strategy<Value = (u8, u8, u8, u16, u16)> {
        (0..3_u8, 0..4_u8, 0..2_u8, 0..600_u16, 1..5_u16)
    }

    proptest! {
        #[test]
        fn every_point_is_read_whole_once_and_within_the_limits(
            raw in proptest::collection::vec(any_item(), 0..120),
            gap_max in 0..20_u16,
        ) {
            let tables = [Table::Coil, Table::Discrete, Table::Holding, Table::Input];
            let items: Vec<Item> = raw.iter().enumerate().map(|(point, (unit_id, table, period, start, count))| Item {
                point,
                unit_id: *unit_id,
                table: tables[usize::from(*table)],
                period_ms: 100 * (u64::from(*period) + 1),
                start: *start,
                count: *count,
            }).collect();
            let groups = merged(items.clone(), gap_max);
            let mut served: Vec<usize> = groups.iter().flat_map(|g| g.items.iter().map(|i| i.point)).collect();
            served.sort_unstable();
            prop_assert_eq!(served, (0..items.len()).collect::<Vec<_>>());
            for g in &groups {
                prop_assert!(g.count >= 1 && g.count <= g.table.read_max());
                let mut end = g.start;
                for i in &g.items {
                    prop_assert_eq!((i.unit_id, i.table, i.period_ms), (g.unit_id, g.table, g.period_ms));
                    prop_assert!(i.start >= g.start && i.start + i.count <= g.start + g.count);
                    prop_assert!(i.start <= end + gap_max);
                    end = end.max(i.start + i.count);
                }
                prop_assert_eq!(end, g.start + g.count);
            }
            // As few as can be: two groups in a row could not have been one.
            for pair in groups.windows(2) {
                let same = (pair[0].unit_id, pair[0].table, pair[0].period_ms)
                    == (pair[1].unit_id, pair[1].table, pair[1].period_ms);
                if same {
                    let first = &pair[1].items[0];
                    let too_long = first.start + first.count - pair[0].start > pair[0].table.read_max();
                    let too_far = first.start > pair[0].start + pair[0].count + gap_max;
                    prop_assert!(too_long || too_far);
                }
            }
            // Without gaps, nothing is read that no point wants.
            for g in groups.iter().flat_map(Group::without_gaps) {
                for address in g.start..g.start + g.count {
                    prop_assert!(g.items.iter().any(|i| (i.start..i.start + i.count).contains(&address)));
                }
            }
        }
    }
}
