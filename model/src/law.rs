//! The law of the model: it counts its steps, and sends the count as its output. Two revisions of it, told apart by digest.
//!
//! Never: anything that needs a sandbox.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{
    Descriptor, Digest, Direction, Effects, LoopId, LoopSpec, Mode, OutputLimit, PointId, Policy, PortKind, PortSpec,
    Reading, Strategy, Wiring,
};

/// Period of the loop, in ns: a second, so that the desk's own times (a second for a suspect) are some cycles.
pub(crate) const PERIOD_NS: u64 = 1_000_000_000;
/// Revisions that there are.
pub(crate) const REVISIONS: [u64; 2] = [1, 2];

/// A revision, and its ports by number.
#[derive(Debug, Clone)]
pub(crate) struct Law {
    pub(crate) spec: Arc<LoopSpec>,
    pub(crate) wiring: Wiring,
}

/// The loop.
#[allow(clippy::expect_used, reason = "a constant")]
pub(crate) fn loop_id() -> LoopId {
    LoopId::new("counted").expect("a valid name")
}

/// One revision.
#[allow(clippy::expect_used, reason = "constants")]
pub(crate) fn law(revision: u64) -> Law {
    let port = |name: &str, direction| PortSpec {
        name: name.to_owned(),
        direction,
        kind: PortKind::Analog,
        unit: String::new(),
        required: direction == Direction::Output,
        text: String::new(),
    };
    let descriptor = Descriptor {
        name: "count".to_owned(),
        version: format!("{revision}.0.0"),
        text: String::new(),
        ports: vec![port("pv", Direction::Input), port("out", Direction::Output)],
        parameters: Vec::new(),
        state_layout: 1,
    };
    let point = |name: &str| PointId::new(name).expect("a valid name");
    let spec = LoopSpec {
        id: loop_id(),
        revision,
        digest: Digest::of(&revision.to_le_bytes()),
        period_ns: PERIOD_NS,
        ports: BTreeMap::from([("pv".to_owned(), point("p.pv")), ("out".to_owned(), point("p.out"))]),
        parameters: BTreeMap::new(),
        setpoint: 0.0,
        setpoint_range: (0.0, 100.0),
        mode: Mode::Automatic,
        strategy: Strategy::Local,
        replicas: 3,
        limits: BTreeMap::from([(
            "out".to_owned(),
            OutputLimit {
                low: 0.0,
                high: 1e9,
                rate_per_s: None,
                safe: 0.0,
            },
        )]),
        listens: Vec::new(),
        fallback: None,
        fallback_parameters: Default::default(),
        prefer: vec![],
        policy: Policy::default(),
    };
    let wiring = Wiring::new(&spec, &descriptor).expect("the law fits its loop");
    Law {
        spec: Arc::new(spec),
        wiring,
    }
}

/// What a step of the law makes of a state.
pub(crate) fn step(state: &[u8]) -> Effects {
    let count = count(state) + 1;
    Effects {
        state: count.to_le_bytes().to_vec(),
        writes: vec![(1, count as f64)],
        ..Effects::default()
    }
}

/// The number in a state; 0 for none.
pub(crate) fn count(state: &[u8]) -> u64 {
    state.try_into().map_or(0, u64::from_le_bytes)
}

/// What the points read when the actuator holds this.
pub(crate) fn readings(held: f64, at_ns: u64) -> Vec<Reading> {
    vec![Reading::good(0.0, at_ns), Reading::good(held, at_ns)]
}
