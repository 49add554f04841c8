//! The law of the simulated loops: it counts its steps and sends the count as its output, so that a step that was lost or done
//! twice, or an output that is not its state's, shows in the numbers.
//!
//! Never: anything that needs a sandbox.

use std::collections::BTreeMap;

use bumpless_core::{
    Descriptor, Digest, Direction, Effects, HostId, LoopId, LoopSpec, Mode, OnFewer, OutputLimit, PointId, Policy,
    PortKind, PortSpec, Reading, Strategy, Wiring, limits::REPLICAS_MAX,
};

/// Replicas of a loop that is not alone on its home.
pub(crate) const REPLICAS: u8 = 3;
/// Hosts that hold a loop, spares with them.
pub(crate) const HOLDERS: usize = REPLICAS as usize + 1;
const _: () = assert!(HOLDERS <= REPLICAS_MAX && HOLDERS <= 8, "a byte has a bit for each");

/// What loops choose their replicas by; a loop's number says which.
const STRATEGIES: [Strategy; 6] = [
    Strategy::RoundRobin,
    Strategy::Vote(REPLICAS),
    Strategy::Latency,
    Strategy::Local,
    Strategy::P2c,
    Strategy::Shard,
];

/// One in so many loops has no other host than its home.
const ALONE_EVERY: u32 = 10;

/// The name of a host.
#[allow(clippy::expect_used, reason = "a letter and digits")]
pub(crate) fn host_id(number: u32) -> HostId {
    HostId::new(format!("h{number}")).expect("a valid name")
}

/// The number in a name that [`host_id`] made; `u32::MAX` for another.
pub(crate) fn host_number(id: &HostId) -> u32 {
    id.as_str()
        .get(1..)
        .and_then(|digits| digits.parse().ok())
        .unwrap_or(u32::MAX)
}

/// The name of a loop.
#[allow(clippy::expect_used, reason = "a letter and digits")]
pub(crate) fn loop_id(number: u32) -> LoopId {
    LoopId::new(format!("l{number}")).expect("a valid name")
}

/// The number in a name that [`loop_id`] made; `u32::MAX` for another.
pub(crate) fn loop_number(id: &LoopId) -> u32 {
    id.as_str()
        .get(1..)
        .and_then(|digits| digits.parse().ok())
        .unwrap_or(u32::MAX)
}

/// Is this loop alone on its home?
pub(crate) const fn is_alone(number: u32) -> bool {
    number % ALONE_EVERY == ALONE_EVERY - 1
}

/// The ports by number: the law is the same for all loops and revisions.
#[allow(clippy::expect_used, reason = "constants")]
pub(crate) fn wiring() -> Wiring {
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
        version: "1.0.0".to_owned(),
        text: String::new(),
        ports: vec![port("pv", Direction::Input), port("out", Direction::Output)],
        parameters: Vec::new(),
        state_layout: 1,
    };
    Wiring::new(&spec(0, 1), &descriptor).expect("the law fits its loop")
}

/// One revision of a loop: fast ones, middling ones and, most of them, slow ones.
#[allow(clippy::expect_used, reason = "constants")]
pub(crate) fn spec(number: u32, revision: u64) -> LoopSpec {
    let point = |name: &str| PointId::new(name).expect("a valid name");
    let alone = is_alone(number);
    let period_ms: u64 = match number % 50 {
        0 | 19 => 100,
        1..=8 => 500,
        _ => 1000,
    };
    LoopSpec {
        id: loop_id(number),
        revision,
        digest: Digest::from_bytes([u8::try_from(revision % 256).unwrap_or_default(); 32]),
        period_ns: period_ms * 1_000_000,
        ports: BTreeMap::from([("pv".to_owned(), point("p.pv")), ("out".to_owned(), point("p.out"))]),
        parameters: BTreeMap::new(),
        setpoint: 0.0,
        setpoint_range: (0.0, 1e9),
        mode: Mode::Automatic,
        strategy: if alone {
            Strategy::Local
        } else {
            STRATEGIES[number as usize % STRATEGIES.len()]
        },
        replicas: if alone { 1 } else { REPLICAS },
        limits: BTreeMap::from([(
            "out".to_owned(),
            OutputLimit {
                low: 0.0,
                high: 1e12,
                rate_per_s: None,
                safe: 0.0,
            },
        )]),
        listens: Vec::new(),
        fallback: None,
        fallback_parameters: BTreeMap::new(),
        prefer: Vec::new(),
        policy: Policy {
            // One that errs must never be the last that votes.
            on_fewer: OnFewer::Fault,
            ..Policy::default()
        },
    }
}

/// What a step makes of a state.
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
