//! Does a host that makes and drops instances for years grow? Alone in its binary, for it measures the whole process.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::sync::{Mutex, PoisonError};

use bumpless_core::Frame;
use bumpless_engine::Profile;
use bumpless_tests::hostile::{Call, End, table};
use guest::{Guest, PATIENCE_NS, engine_for, frame, state};

#[path = "it/guest.rs"]
#[allow(dead_code, reason = "shared with the other tests, which use the rest")]
mod guest;

/// One at a time, for each measures the whole process.
static ALONE: Mutex<()> = Mutex::new(());

#[test]
fn ten_thousand_instances_come_and_go_without_growth() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
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

/// Times that each hostile component is made, misbehaves, and is dropped. `bench hostile` does it 10,000 times.
const REPEATS: u32 = if cfg!(debug_assertions) { 100 } else { 1_000 };

/// Those that spin take all of this.
const LIMIT_NS: u64 = 1_000_000;

#[test]
fn hostile_components_come_and_go_without_growth() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let components = bumpless_tests::components().unwrap();
    let engine = engine_for(4);
    let taken = [End::Faulted, End::Bounded];
    for guest in table().unwrap().iter().filter(|guest| taken.contains(&guest.end)) {
        let prepared = engine.prepare(&guest.bytes(&components).unwrap()).unwrap();
        let descriptor = prepared.descriptor();
        let parameters: Vec<f64> = descriptor.parameters.iter().map(|p| p.default).collect();
        let track = vec![50.0; descriptor.outputs().count()];
        let frame = Frame {
            readings: vec![frame(1.0).readings[0]; descriptor.ports.len()],
            ..frame(1.0)
        };
        let times = |n: u32| {
            for _ in 0..n {
                let mut instance = prepared.instantiate().unwrap();
                let first = instance.start(&parameters, &track, LIMIT_NS);
                if guest.call == Call::Step {
                    // Twice, so that what a fault ended is made again.
                    let state = first.unwrap();
                    for _ in 0..2 {
                        let _fault_or_effects = instance.step(&frame, &state, LIMIT_NS);
                    }
                }
            }
        };
        times(20);
        let before = resident_kib();
        times(REPEATS);
        let grown = resident_kib().saturating_sub(before);
        // One page of 64 KiB kept each time would be 6 MiB and more.
        assert!(grown < 6 * 1024, "{} grew by {grown} KiB", guest.name);
        assert_eq!(engine.capacity().instances_used, 0, "{}", guest.name);
        engine.forget(prepared.digest());
    }
}

/// Memory of this process in RAM, in KiB.
fn resident_kib() -> u64 {
    let pages = std::fs::read_to_string("/proc/self/statm").unwrap();
    pages.split(' ').nth(1).unwrap().parse::<u64>().unwrap() * 4
}
