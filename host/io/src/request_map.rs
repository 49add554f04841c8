//! How the points of a device become requests, for people, before anything is sent.
//!
//! Pure. Never: plans otherwise than the driver; it shows the driver's own plan.

use crate::{
    Error,
    modbus::{ModbusConfig, Table},
};

/// One request that the driver will send again and again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MappedRequest {
    /// The unit behind the address.
    pub unit_id: u8,
    /// The Modbus function that reads.
    pub function: u8,
    /// The address space.
    pub table: Table,
    /// First address, from 0.
    pub start: u16,
    /// Addresses asked for.
    pub count: u16,
    /// Addresses among them that no point needs.
    pub unused: u16,
    /// How often, in ms.
    pub period_ms: u64,
    /// The points that it serves, with their first address and their number of addresses.
    pub points: Vec<(String, u16, u16)>,
}

/// The requests of a device, in the order of unit, table and address.
///
/// # Errors
/// [`Error::Config`] as the host would refuse it.
pub fn requests(config: &ModbusConfig) -> Result<Vec<MappedRequest>, Error> {
    let (plan, _) = config.plan(config.transport())?;
    let name = |point: usize| {
        plan.points
            .get(point)
            .map_or_else(String::new, |point| point.id.to_string())
    };
    let mapped = plan.groups.iter().map(|group| {
        let mut used = vec![false; usize::from(group.count)];
        for item in &group.items {
            let first = usize::from(item.start.saturating_sub(group.start));
            used.iter_mut()
                .skip(first)
                .take(usize::from(item.count))
                .for_each(|one| *one = true);
        }
        MappedRequest {
            unit_id: group.unit_id,
            function: match group.table {
                Table::Coil => 1,
                Table::Discrete => 2,
                Table::Holding => 3,
                Table::Input => 4,
            },
            table: group.table,
            start: group.start,
            count: group.count,
            unused: used.iter().filter(|used| !**used).count() as u16,
            period_ms: group.period_ms,
            points: group
                .items
                .iter()
                .map(|item| (name(item.point), item.start, item.count))
                .collect(),
        }
    });
    Ok(mapped.collect())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]
    use super::*;
    use crate::{BusConfig, Config};

    #[test]
    fn the_map_is_what_the_driver_asks() {
        let config: Config = toml::from_str(
            "[[bus]]\nid = \"line\"\ndriver = \"modbus-tcp\"\naddress = \"h:502\"\ngap_max = 4\n\
             [[bus.point]]\nid = \"a\"\ntable = \"input\"\naddress = 0\ntype = \"f32\"\nlow = 0.0\nhigh = 1.0\n\
             [[bus.point]]\nid = \"b\"\ntable = \"input\"\naddress = 5\nlow = 0.0\nhigh = 1.0\n\
             [[bus.point]]\nid = \"c\"\ntable = \"coil\"\naddress = 9\n",
        )
        .unwrap();
        let Some(BusConfig::ModbusTcp(line)) = config.buses.first() else {
            panic!("a Modbus bus");
        };
        let map = requests(line).unwrap();
        let shapes: Vec<_> = map
            .iter()
            .map(|r| (r.function, r.start, r.count, r.unused, r.points.len()))
            .collect();
        assert_eq!(shapes, [(1, 9, 1, 0, 1), (4, 0, 6, 3, 2)]);
    }
}
