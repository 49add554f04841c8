//! The engine with real components: the stock controllers and the test guests, built from their sources.

use std::{path::PathBuf, sync::OnceLock};

use bumpless_core::{Cycle, Descriptor, Fault, Frame, Mode, Reading};
use bumpless_engine::{Config, Engine, Error, Instance, Origin};

use crate::guest::PATIENCE_NS;

/// Time limit of the calls that are expected to pass it.
const SHORT_NS: u64 = 20_000_000;

fn component(name: &str) -> Vec<u8> {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| xtask::components::build().expect("components"));
    std::fs::read(folder.join(name).with_extension("wasm")).expect(name)
}

fn engine() -> Engine {
    Engine::new(Config {
        instances_max: 4,
        ..Config::default()
    })
    .expect("engine")
}

/// The measurement as given, 50 at the actuator, and nothing else connected.
fn frame(descriptor: &Descriptor, seq: u64, pv: f64) -> Frame {
    let at_ns = seq * 100_000_000;
    let readings = descriptor.ports.iter().map(|port| match port.name.as_str() {
        "pv" => Reading::good(pv, at_ns),
        "out" => Reading::good(50.0, at_ns),
        _ => Reading::unconnected(),
    });
    Frame {
        cycle: Cycle {
            seq,
            at_ns,
            dt_ns: 100_000_000,
            mode: Mode::Automatic,
            setpoint: 45.0,
        },
        readings: readings.collect(),
        messages: vec![],
    }
}

fn started(instance: &mut Instance, given: &[(&str, f64)]) -> Vec<u8> {
    let parameters = instance
        .prepared()
        .descriptor()
        .parameter_values(given.iter().copied())
        .unwrap();
    instance.start(&parameters, &[50.0], PATIENCE_NS).unwrap()
}

#[test]
fn stock_controllers_start_where_the_actuator_is_and_take_over_each_others_state() {
    let engine = engine();
    for name in ["pid", "pidplus"] {
        let law = engine.prepare(&component(name)).unwrap();
        let d = law.descriptor().clone();
        assert_eq!(d.name, name);
        let out = u8::try_from(d.port("out").unwrap()).unwrap();
        let mut one = law.instantiate().unwrap();
        let mut state = started(&mut one, &[]);
        let first = one.step(&frame(&d, 1, 40.0), &state, PATIENCE_NS).unwrap();
        assert_eq!(first.writes, [(out, 50.0)], "{name} starts without a bump");
        state = one.step(&frame(&d, 2, 40.0), &first.state, PATIENCE_NS).unwrap().state;

        // A used and a fresh instance agree bit by bit.
        let mut fresh = law.instantiate().unwrap();
        let again = frame(&d, 3, 41.0);
        assert_eq!(
            one.step(&again, &state, PATIENCE_NS).unwrap(),
            fresh.step(&again, &state, PATIENCE_NS).unwrap(),
            "{name}"
        );

        // Its own state and the other's go on where they were; nonsense is refused.
        let parameters = d.parameter_values([]).unwrap();
        for from in ["pid", "pidplus"] {
            let other = engine.prepare(&component(from)).unwrap();
            let said = other.descriptor();
            let origin = Origin {
                name: said.name.clone(),
                version: said.version.clone(),
                state_layout: said.state_layout,
            };
            let mut other = other.instantiate().unwrap();
            let left = started(&mut other, &[]);
            let left = other.step(&frame(&d, 1, 40.0), &left, PATIENCE_NS).unwrap().state;
            let taken = one.migrate(&origin, &left, &parameters, &[50.0], PATIENCE_NS).unwrap();
            let writes = one.step(&frame(&d, 2, 40.0), &taken, PATIENCE_NS).unwrap().writes;
            let same = other.step(&frame(&d, 2, 40.0), &left, PATIENCE_NS).unwrap().writes;
            assert_eq!(writes, same, "{from} to {name}");
        }
        assert!(matches!(
            one.step(&frame(&d, 3, 40.0), &[0xFF; 40], PATIENCE_NS).unwrap_err(),
            Fault::BadState(_)
        ));
    }
}

#[test]
fn stock_controllers_say_what_they_lack() {
    let law = engine().prepare(&component("pid")).unwrap();
    let mut one = law.instantiate().unwrap();
    let state = started(&mut one, &[]);
    let mut frame = frame(law.descriptor(), 1, 40.0);
    frame.readings.clear();
    assert!(matches!(
        one.step(&frame, &state, PATIENCE_NS).unwrap_err(),
        Fault::BadInput(_)
    ));
    assert!(matches!(
        one.start(&[1.0], &[50.0], PATIENCE_NS).unwrap_err(),
        Fault::BadParameter(_)
    ));
}

#[test]
fn guests_that_are_no_controllers_are_refused() {
    let engine = engine();
    let refused = |name: &str| engine.prepare(&component(&format!("guests/{name}"))).unwrap_err();
    assert!(matches!(
        refused("describe-spins"),
        Error::Describe(Fault::Overrun { limit_us: 1_000_000 })
    ));
    assert!(matches!(refused("lies-in-describe"), Error::Descriptor(_)));
    assert!(matches!(
        refused("wrong-world"),
        Error::World { .. } | Error::Import { .. }
    ));
    assert!(
        matches!(refused("forbidden-import"), Error::Import { name, .. } if name.starts_with("outside:disk/files"))
    );
}

/// A guest, what its parameters are, and how its first step ends.
type Misdeed = (&'static str, &'static [(&'static str, f64)], fn(&Fault) -> bool);

#[test]
fn guests_misdeeds_are_faults() {
    let cases: [Misdeed; 11] = [
        ("traps", &[], |f| matches!(f, Fault::Trap(_))),
        ("spins", &[], |f| {
            *f == Fault::Overrun {
                limit_us: SHORT_NS / 1000,
            }
        }),
        (
            "recurses",
            &[],
            |f| matches!(f, Fault::Trap(text) if text.starts_with("call stack exhausted") || text.starts_with("out of bounds")),
        ),
        (
            "grows-memory",
            &[],
            |f| matches!(f, Fault::Limit(text) if text.contains("of memory; at most 16777216")),
        ),
        (
            "returns-nan",
            &[],
            |f| matches!(f, Fault::BadWrite { port, value } if port == "out" && value == "NaN"),
        ),
        (
            "bad-state",
            &[],
            |f| matches!(f, Fault::Limit(text) if text.starts_with("a state of ")),
        ),
        (
            "bad-state",
            &[("bytes", 1e6)],
            |f| matches!(f, Fault::Limit(text) if text.starts_with("one call moved")),
        ),
        (
            "floods-messages",
            &[],
            |f| matches!(f, Fault::Limit(text) if text == "more than 16 messages in one step"),
        ),
        (
            "floods-messages",
            &[("bytes", 5000.0)],
            |f| matches!(f, Fault::Limit(text) if text == "a message of 5000 bytes; at most 4096 are carried"),
        ),
        (
            "floods-messages",
            &[("messages", 0.0), ("alarms", 100.0)],
            |f| matches!(f, Fault::Limit(text) if text == "more than 32 alarm changes in one step"),
        ),
        ("jumps", &[], |f| matches!(f, Fault::Trap(_))),
    ];
    let engine = engine();
    for (name, given, expected) in cases {
        let law = engine.prepare(&component(&format!("guests/{name}"))).unwrap();
        let d = law.descriptor();
        let mut one = law.instantiate().unwrap();
        let limit_ns = if name == "spins" { SHORT_NS } else { PATIENCE_NS };
        let bad = started(&mut one, &[given, &[("after", 0.0)]].concat());
        let fault = one.step(&frame(d, 1, 40.0), &bad, limit_ns).unwrap_err();
        assert!(expected(&fault), "{name} {given:?}: {fault:?}");
        // The same instance then serves a state that does not misbehave yet.
        let good = started(&mut one, &[("after", 1.0)]);
        let effects = one.step(&frame(d, 2, 40.0), &good, PATIENCE_NS).unwrap();
        assert_eq!(effects.writes, [(1, 50.0)], "{name}");
    }
}

#[test]
fn guests_that_do_not_start_or_take_over_say_so() {
    let engine = engine();
    let guest = |name: &str| engine.prepare(&component(&format!("guests/{name}"))).unwrap();

    let law = guest("fails-start");
    let parameters = law.descriptor().parameter_values([]).unwrap();
    let mut one = law.instantiate().unwrap();
    assert!(matches!(
        one.start(&parameters, &[50.0], PATIENCE_NS).unwrap_err(),
        Fault::Failed(_) | Fault::BadParameter(_)
    ));

    let law = guest("start-spins");
    let parameters = law.descriptor().parameter_values([]).unwrap();
    let mut one = law.instantiate().unwrap();
    assert_eq!(
        one.start(&parameters, &[50.0], SHORT_NS).unwrap_err(),
        Fault::Overrun {
            limit_us: SHORT_NS / 1000
        }
    );

    let law = guest("declines-migrate");
    let d = law.descriptor();
    let mut one = law.instantiate().unwrap();
    let state = started(&mut one, &[]);
    let from = Origin {
        name: d.name.clone(),
        version: d.version.clone(),
        state_layout: d.state_layout,
    };
    let parameters = d.parameter_values([]).unwrap();
    assert!(matches!(
        one.migrate(&from, &state, &parameters, &[50.0], PATIENCE_NS)
            .unwrap_err(),
        Fault::BadState(_)
    ));
}

#[test]
fn a_guest_that_floods_its_log_loses_lines_and_no_cycle() {
    let law = engine().prepare(&component("guests/floods-log")).unwrap();
    let mut one = law.instantiate().unwrap();
    let state = started(&mut one, &[("after", 0.0)]);
    let effects = one
        .step(&frame(law.descriptor(), 1, 40.0), &state, PATIENCE_NS)
        .unwrap();
    assert_eq!(effects.writes, [(1, 50.0)]);
    assert_eq!(effects.log.len(), 16);
    assert_eq!(
        effects.log[15].text,
        "985 more lines were dropped: at most 16 per step are kept"
    );
}
