//! The published experiments with the level, in their order: what changes when.
//!
//! Owns: setpoints and valves over time. Never: runs anything.

/// The hand valve out of the tank, in %: `open` is as far as the pump can still hold 95 % of level against it.
const OPEN: f64 = 60.0;
const PARTLY: f64 = 35.0;
const A_LITTLE_LESS: f64 = 50.0;

/// What changes.
#[derive(Debug, Clone, Copy)]
pub(super) enum Event {
    Setpoint(f64),
    Valve(f64),
}

/// One experiment.
pub(super) struct Trial {
    pub(super) key: &'static str,
    pub(super) title: &'static str,
    pub(super) distributed: bool,
    pub(super) setpoint: f64,
    pub(super) valve: f64,
    /// When, in s after the beginning, and what.
    pub(super) events: &'static [(f64, Event)],
    pub(super) seconds: f64,
}

pub(super) const CENTRAL: [Trial; 4] = [
    Trial {
        key: "central.open",
        title: "23 to 50 %, valve open",
        distributed: false,
        setpoint: 23.0,
        valve: OPEN,
        events: &[(10.0, Event::Setpoint(50.0))],
        seconds: 150.0,
    },
    Trial {
        key: "central.partly",
        title: "23 to 50 %, valve partly shut",
        distributed: false,
        setpoint: 23.0,
        valve: PARTLY,
        events: &[(10.0, Event::Setpoint(50.0))],
        seconds: 150.0,
    },
    Trial {
        key: "central.high",
        title: "50 to 95 %, valve partly shut",
        distributed: false,
        setpoint: 50.0,
        valve: PARTLY,
        events: &[(10.0, Event::Setpoint(95.0))],
        seconds: 200.0,
    },
    Trial {
        key: "central.outflow",
        title: "95 %: valve opened at 22 s, a little less at 121 s",
        distributed: false,
        setpoint: 95.0,
        valve: PARTLY,
        events: &[(22.0, Event::Valve(OPEN)), (121.0, Event::Valve(A_LITTLE_LESS))],
        seconds: 200.0,
    },
];

pub(super) const DISTRIBUTED: [Trial; 3] = [
    Trial {
        key: "distributed.steps",
        title: "23 to 51 to 89 %, valve open",
        distributed: true,
        setpoint: 23.0,
        valve: OPEN,
        events: STEPS,
        seconds: 320.0,
    },
    Trial {
        key: "distributed.down",
        title: "89 to 30 %, valve open",
        distributed: true,
        setpoint: 89.0,
        valve: OPEN,
        events: &[(10.0, Event::Setpoint(30.0))],
        seconds: 200.0,
    },
    Trial {
        key: "distributed.outflow",
        title: "46 %: valve a little less, then open",
        distributed: true,
        setpoint: 46.0,
        valve: A_LITTLE_LESS,
        events: &[(20.0, Event::Valve(PARTLY)), (40.0, Event::Valve(OPEN))],
        seconds: 160.0,
    },
];

const STEPS: &[(f64, Event)] = &[(10.0, Event::Setpoint(51.0)), (150.0, Event::Setpoint(89.0))];
