//! Small, complete values to keep in a store.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{
    ComponentInfo, Descriptor, Digest, Direction, HostId, Intent, LoopId, LoopSpec, Mode, OutputLimit, PointId, Policy,
    PortKind, PortSpec, Reading, Record, Strategy,
};

pub(crate) fn loop_id(name: &str) -> LoopId {
    LoopId::new(name).unwrap()
}

pub(crate) fn host(name: &str) -> HostId {
    HostId::new(name).unwrap()
}

pub(crate) fn spec(name: &str, setpoint: f64) -> LoopSpec {
    let free = OutputLimit {
        low: 0.0,
        high: 100.0,
        rate_per_s: None,
        safe: 0.0,
    };
    let slow = OutputLimit {
        rate_per_s: Some(5.0),
        ..free
    };
    LoopSpec {
        id: loop_id(name),
        revision: 0,
        digest: Digest::of(name.as_bytes()),
        period_ns: 10_000_000,
        ports: BTreeMap::from([("input".into(), PointId::new("lt-1").unwrap())]),
        parameters: BTreeMap::from([("gain".into(), 2.5), ("reset-s".into(), 12.0)]),
        setpoint,
        setpoint_range: (-1.0e9, 1.0e9),
        mode: Mode::Automatic,
        strategy: Strategy::P2c,
        replicas: 3,
        limits: BTreeMap::from([("output".into(), free), ("valve".into(), slow)]),
        listens: vec!["alarms".into()],
        fallback: None,
        fallback_parameters: BTreeMap::new(),
        prefer: vec![],
        policy: Policy::default(),
    }
}

pub(crate) fn intent(name: &str) -> Intent {
    Intent::new(host("io-1"), spec(name, 1.0), 0).unwrap()
}

pub(crate) fn record(name: &str, term: u64, seq: u64) -> Arc<Record> {
    Arc::new(Record {
        loop_id: loop_id(name),
        term,
        seq,
        after: (term, seq.saturating_sub(1)),
        revision: 1,
        digest: Digest::of(name.as_bytes()),
        home: host("h-0"),
        owner: host("h-1"),
        stepped_by: host("h-2"),
        at_ns: seq * 10_000_000,
        dt_ns: 10_000_000,
        mode: Mode::Automatic,
        setpoint: 50.0,
        manual: vec![12.5],
        readings: vec![Reading::good(49.5, seq * 10_000_000), Reading::unconnected()],
        heard: vec![],
        wanted: vec![12.5],
        outputs: vec![12.5],
        state: Arc::from(seq.to_le_bytes()),
        faults_in_row: 0,
        probation: Some((1, 4)),
        redundancy: bumpless_core::Redundancy {
            have: 2,
            want: 3,
            vote: None,
        },
        applied: Vec::new(),
        events: Vec::new(),
        alarms: Vec::new(),
        messages: Vec::new(),
        log: Vec::new(),
        step_ns: 1_000,
        cycle_ns: 2_000,
        committed_after_ns: 3_000,
    })
}

pub(crate) fn info(bytes: &[u8]) -> ComponentInfo {
    let output = PortSpec {
        name: "output".into(),
        direction: Direction::Output,
        kind: PortKind::Analog,
        unit: "%".into(),
        required: true,
        text: "to the valve".into(),
    };
    let descriptor = Descriptor {
        name: "pid".into(),
        version: "1.2.3".into(),
        text: "a controller".into(),
        ports: vec![output],
        parameters: Vec::new(),
        state_layout: 1,
    };
    ComponentInfo {
        digest: Digest::of(bytes),
        name: "pid".into(),
        version: "1.2.3".into(),
        descriptor,
        world: bumpless_core::component::CONTROLLER_WORLD.into(),
        imports: vec!["bumpless:control/io@0.1.0".into()],
        bytes: bytes.len() as u64,
        uploaded_at_unix_ms: 1_700_000_000_000,
        uploaded_by: "operator".into(),
        note: String::new(),
        labels: [("stage".to_owned(), "pilot".to_owned())].into(),
        changes: 2,
        history: Vec::new(),
        admission: None,
    }
}
