//! A scan finds what a device has, within its bounds.

use bumpless_io::{
    modbus::Table,
    scan::{ScanPlan, Stretch, scan},
};

use crate::{
    peer::{Manner, Peer},
    runtime,
};

#[test]
fn units_and_stretches_are_found() {
    let (peer, runtime) = (Peer::start(), runtime());
    let plan = ScanPlan {
        units: vec![1, 4],
        tables: vec![Table::Holding, Table::Coil],
        last: 299,
        timeout_ms: 150,
        pause_ms: 0,
        ..ScanPlan::default()
    };
    let address = peer.address.to_string();
    let found = runtime.block_on(scan(&address, &plan)).unwrap();
    let stretch = |unit_id, table| Stretch {
        unit_id,
        table,
        start: 0,
        count: 300,
    };
    assert_eq!(found.units, [1, 4]);
    assert_eq!(
        found.stretches,
        [1, 4]
            .map(|unit| [stretch(unit, Table::Holding), stretch(unit, Table::Coil)])
            .concat()
    );
    assert_eq!(found.requests, 2 * (1 + 3 + 1));
    peer.behave(Manner::SilentUnit(1));
    let found = runtime.block_on(scan(&address, &plan)).unwrap();
    assert_eq!((found.units, found.stretches.len()), (vec![4], 2));
    // Reads of more than two addresses are refused: everything is found all the same, in halves.
    peer.behave(Manner::RefusesGaps);
    let plan = ScanPlan {
        last: 9,
        units: vec![1],
        ..plan
    };
    let found = runtime.block_on(scan(&address, &plan)).unwrap();
    assert_eq!(found.stretches.iter().map(|s| s.count).collect::<Vec<_>>(), [10, 10]);
    drop(peer);
    let error = runtime.block_on(scan(&address, &plan)).expect_err("nobody").to_string();
    assert!(
        error.contains(&address) && error.contains("check the address"),
        "{error}"
    );
}
