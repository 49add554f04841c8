//! Does a host that makes and drops instances for years grow? Alone in its binary, for it measures the whole process.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use bumpless_engine::Profile;

use guest::{Guest, PATIENCE_NS, engine_for, frame, state};

#[path = "it/guest.rs"]
#[allow(dead_code, reason = "shared with the other tests, which use the rest")]
mod guest;

#[test]
fn ten_thousand_instances_come_and_go_without_growth() {
    // Both shapes of memory: slots, and allocation on demand.
    for (instances_max, profile) in [(4, Profile::Pooled), (14_001, Profile::OnDemand)] {
        let engine = engine_for(instances_max);
        assert_eq!(engine.profile(), profile);
        let law = engine.prepare(&Guest::good().build()).unwrap();
        let once = |n: u32| {
            for _ in 0..n {
                law.instantiate()
                    .unwrap()
                    .step(&frame(1.0), &state(1.0), PATIENCE_NS)
                    .unwrap();
            }
        };
        once(500);
        let before = resident_kib();
        once(10_000);
        let grown = resident_kib().saturating_sub(before);
        // One leaked instance has at least its two pages of memory: 10,000 would be 80 MiB and more.
        assert!(grown < 16 * 1024, "{profile:?} grew by {grown} KiB");
        assert_eq!(engine.capacity().instances_used, 0);
    }
}

/// Memory of this process in RAM, in KiB.
fn resident_kib() -> u64 {
    let pages = std::fs::read_to_string("/proc/self/statm").unwrap();
    pages.split(' ').nth(1).unwrap().parse::<u64>().unwrap() * 4
}
