//! Places, tables and the coming and going of instances.

use bumpless_core::Digest;
use bumpless_engine::{Capacity, Config, Engine, Error, Limits, Profile};

use crate::guest::{Guest, PATIENCE_NS, engine_for, frame, state};

#[test]
fn instances_are_refused_beyond_the_limit_and_places_come_back() {
    let engine = engine_for(2);
    let law = engine.prepare(&Guest::good().build()).unwrap();
    let first = law.instantiate().unwrap();
    let _second = law.instantiate().unwrap();
    assert!(matches!(law.instantiate().unwrap_err(), Error::Full { max: 2 }));
    // An inspection has slots of its own.
    engine
        .inspect(
            &Guest {
                name: "other".into(),
                ..Guest::good()
            }
            .build(),
        )
        .unwrap();
    drop(first);
    assert_eq!(
        engine.capacity(),
        Capacity {
            instances_max: 2,
            instances_used: 1
        }
    );
    law.instantiate().unwrap();
    assert_eq!(
        engine.capacity(),
        Capacity {
            instances_max: 2,
            instances_used: 1
        }
    );
}

#[test]
fn a_guest_that_fails_at_its_start_gives_its_place_back() {
    let engine = engine_for(1);
    // Starts well once for its description, and traps whenever an instance is made: it counts in no memory of its own,
    // so it must be a trap in each; the description then fails already.
    let bytes = Guest {
        extra: "(func $begin (unreachable))".into(),
        start_section: "(start $begin)".into(),
        ..Guest::good()
    }
    .build();
    assert!(engine.prepare(&bytes).is_err());
    assert_eq!(engine.capacity().instances_used, 0);
}

#[test]
fn a_component_is_prepared_once_and_forgotten_on_request() {
    let engine = engine_for(2);
    let bytes = Guest::good().build();
    let digest = Digest::of(&bytes);
    assert!(engine.prepared(&digest).is_none());
    let first = engine.prepare(&bytes).unwrap();
    assert!(std::sync::Arc::ptr_eq(&first, &engine.prepare(&bytes).unwrap()));
    assert!(std::sync::Arc::ptr_eq(&first, &engine.prepared(&digest).unwrap()));
    let mut living = first.instantiate().unwrap();
    engine.forget(&digest);
    assert!(engine.prepared(&digest).is_none());
    // Even without the engine an instance that lives goes on.
    drop((first, engine));
    assert!(living.step(&frame(1.0), &state(1.0), PATIENCE_NS).is_ok());
}

#[test]
fn the_table_of_components_is_bounded() {
    let limits = Limits {
        prepared_max: 1,
        ..Limits::default()
    };
    let engine = Engine::new(Config {
        instances_max: 1,
        limits,
        ..Config::default()
    })
    .unwrap();
    let first = Guest::good().build();
    let second = Guest {
        name: "other".into(),
        ..Guest::good()
    }
    .build();
    engine.prepare(&first).unwrap();
    assert_eq!(
        engine.prepare(&second).unwrap_err().to_string(),
        "all 1 places for prepared components are in use; delete components that no loop uses"
    );
    engine.forget(&Digest::of(&first));
    engine.prepare(&second).unwrap();
}

#[test]
fn a_thousand_instances_live_beside_each_other() {
    for (instances_max, profile) in [(1000, Profile::Pooled), (14_001, Profile::OnDemand)] {
        let engine = engine_for(instances_max);
        assert_eq!(engine.profile(), profile);
        let law = engine.prepare(&Guest::good().build()).unwrap();
        let mut all: Vec<_> = (0..1000).map(|_| law.instantiate().unwrap()).collect();
        for (i, one) in (0_u32..).zip(&mut all) {
            let sum = one.step(&frame(1.0), &state(f64::from(i)), PATIENCE_NS).unwrap();
            assert_eq!(sum.writes, [(1, f64::from(i) + 1.0)]);
        }
    }
}
