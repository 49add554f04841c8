//! What practitioners expect of a PID block, one test per item that no other file has; docs/laws.md has the whole table.
//!
//! Sources of the items: ISA-TR5.9-2023 and the PID block of Foundation Fieldbus.

use bumpless_isa::table::{HOLD, OUT, PV, REMOTE_ON, REMOTE_SP, RESET};
use bumpless_pid::Pid;
use bumpless_sdk::{
    Mode,
    bench::{Bench, bad, repeated},
    prelude::*,
};
use serde::Serialize;

const DT_S: f64 = 0.1;

fn start(given: &[(&str, f64)]) -> Bench<Pid> {
    let mut bench = Bench::start(given, &[40.0]).unwrap();
    assert_eq!(at(&mut bench, 50.0, 50.0), 40.0);
    bench
}

fn at(bench: &mut Bench<Pid>, pv: f64, setpoint: f64) -> f64 {
    bench.set(PV, pv);
    bench.set_setpoint(setpoint);
    bench.step(DT_S).unwrap()[0]
}

/// A measurement without a pattern, around 50.
fn rough(i: u32) -> f64 {
    50.0 + (f64::from(i) * 0.618_033_988_749_895).fract()
}

#[test]
fn the_three_forms_are_one_law_after_their_conversion() {
    // Series k(1 + 1/ti·s)(1 + td·s) with 2, 8, 2; parallel k + 1/(ti·s) + td·s with 2.5, 4, 4: both are K 2.5, Ti 10, Td 1.6.
    let forms = [
        [("form", 0.0), ("k", 2.5), ("ti", 10.0), ("td", 1.6)],
        [("form", 1.0), ("k", 2.0), ("ti", 8.0), ("td", 2.0)],
        [("form", 2.0), ("k", 2.5), ("ti", 4.0), ("td", 4.0)],
    ];
    let mut benches = forms.map(|given| start(&given));
    for i in 0..300 {
        let outs = benches.each_mut().map(|bench| at(bench, rough(i), 50.4));
        assert!(outs.iter().all(|out| (out - outs[0]).abs() < 1e-9), "{i}: {outs:?}");
    }
    let refused = Bench::<Pid>::start(&[("form", 2.0), ("k", 0.0), ("td", 1.0)], &[0.0]).unwrap_err();
    assert!(matches!(refused, Fault::BadParameter(text) if text.contains("parallel")));
}

#[test]
fn structures_are_weights() {
    // A step of the setpoint by 10 with K = 2: what P and D make of it at once.
    for (name, beta, gamma, at_once) in [
        ("PID on the error", 1.0, 1.0, 20.0 + 2.0 * 10.0 * 1.0 / (0.1 + DT_S)),
        ("PI on the error, D on the measurement", 1.0, 0.0, 20.0),
        ("I on the error, PD on the measurement", 0.0, 0.0, 0.0),
        ("two degrees of freedom", 0.4, 0.0, 8.0),
    ] {
        let given = [
            ("k", 2.0),
            ("ti", 1e6),
            ("td", 1.0),
            ("beta", beta),
            ("gamma", gamma),
            ("out-high", 1e3),
        ];
        let mut bench = start(&given);
        let out = at(&mut bench, 50.0, 60.0);
        assert!((out - 40.0 - at_once).abs() < 1e-3, "{name}: {out}");
    }
}

#[test]
fn the_setpoint_has_limits_and_a_rate() {
    let given = [
        ("k", 1.0),
        ("ti", 0.0),
        ("bias", 40.0),
        ("sp-low", 20.0),
        ("sp-high", 60.0),
        ("sp-rate", 5.0),
    ];
    let mut bench = start(&given);
    assert!((at(&mut bench, 50.0, 90.0) - 40.5).abs() < 1e-9, "5 per second");
    let end = (0..100).fold(0.0, |_, _| at(&mut bench, 50.0, 90.0));
    assert!((end - 50.0).abs() < 1e-9, "not above 60: {end}");
    let low = (0..200).fold(0.0, |_, _| at(&mut bench, 50.0, -90.0));
    assert!((low - 10.0).abs() < 1e-9, "not below 20: {low}");
    let refused = Bench::<Pid>::start(&[("sp-low", 5.0), ("sp-high", 5.0)], &[0.0]).unwrap_err();
    assert!(matches!(refused, Fault::BadParameter(text) if text.contains("sp-low")));
}

#[test]
fn in_manual_the_setpoint_may_follow_the_measurement() {
    let given = [("k", 2.0), ("ti", 10.0), ("sp-track", 1.0), ("sp-rate", 1.0)];
    let mut bench = start(&given);
    bench.set_mode(Mode::Manual);
    at(&mut bench, 70.0, 50.0);
    bench.set_mode(Mode::Automatic);
    assert_eq!(at(&mut bench, 70.0, 50.0), 40.0);
    // From the measurement to the setpoint at its rate: the error grows by 0.1 per step.
    let next = at(&mut bench, 70.0, 50.0);
    assert!((next - 40.0).abs() < 0.3, "{next}");
    let later = (0..100).fold(0.0, |_, _| at(&mut bench, 70.0, 50.0));
    assert!(later < 30.0, "{later}");
}

#[test]
fn a_remote_setpoint_comes_goes_and_fails_without_a_bump() {
    let mut bench = start(&[("k", 3.0), ("ti", 20.0)]);
    bench.set(REMOTE_SP, 58.0);
    let before = at(&mut bench, 50.0, 50.0);
    bench.set(REMOTE_ON, 1.0);
    let there = at(&mut bench, 50.0, 50.0);
    assert!(
        (there - before).abs() < 1e-9,
        "the change of source is no wish: {before} and {there}"
    );
    let moved = at(&mut bench, 50.0, 50.0);
    assert!(
        (moved - there - 3.0 * 8.0 * DT_S / 20.0).abs() < 0.01,
        "but the integral goes its way: {moved}"
    );
    bench.set(REMOTE_SP, 59.0);
    let stepped = at(&mut bench, 50.0, 50.0);
    assert!(
        (stepped - moved - 3.0).abs() < 0.2,
        "P follows the remote setpoint: {stepped}"
    );
    bench.set_reading(REMOTE_SP, Some(bad(0.0)));
    let kept = at(&mut bench, 50.0, 50.0);
    assert!((kept - stepped).abs() < 0.2, "its last value stays: {kept}");
    bench.set(REMOTE_ON, 0.0);
    let back = at(&mut bench, 50.0, 50.0);
    assert!((back - kept).abs() < 0.2, "{back}");
}

#[test]
fn hold_stops_the_integral_and_reset_leads_it() {
    let mut bench = start(&[("k", 1.0), ("ti", 5.0)]);
    bench.set(HOLD, 1.0);
    for _ in 0..100 {
        assert!((at(&mut bench, 48.0, 50.0) - 42.0).abs() < 1e-9, "P alone");
    }
    bench.set(HOLD, 0.0);
    assert!(at(&mut bench, 48.0, 50.0) > 42.0);
    // With an error of 0 the integral goes to what resets it, with its own time.
    let mut bench = start(&[("k", 1.0), ("ti", 5.0)]);
    bench.set(RESET, 60.0);
    let mut out = 40.0;
    for i in 1..100 {
        out = at(&mut bench, 50.0, 50.0);
        let expected = 60.0 - 20.0 * (-f64::from(i) * DT_S / 5.0).exp();
        assert!((out - expected).abs() < 1e-9, "{i}: {out}");
    }
    bench.set_reading(RESET, Some(repeated(60.0, 5)));
    assert!(at(&mut bench, 50.0, 50.0) > out, "it need not be fresh");
}

#[test]
fn alarms_come_go_with_their_band_and_are_told_once() {
    let given = [
        ("hi", 60.0),
        ("hi-hi", 70.0),
        ("lo", 40.0),
        ("lo-lo", 30.0),
        ("dv-hi", 15.0),
        ("dv-lo", 15.0),
        ("alarm-band", 2.0),
    ];
    let mut bench = start(&given);
    let mut told = |pv: f64| {
        at(&mut bench, pv, 50.0);
        let alarms = bench.desk().alarms.iter();
        alarms
            .map(|(name, raised)| (name.clone(), raised.is_some()))
            .collect::<Vec<_>>()
    };
    let list = |names: &[(&str, bool)]| names.iter().map(|(n, r)| ((*n).to_owned(), *r)).collect::<Vec<_>>();
    for (pv, expected) in [
        (59.0, list(&[])),
        (61.0, list(&[("hi", true)])),
        (62.0, list(&[])),
        (71.0, list(&[("hi-hi", true), ("dv-hi", true)])),
        (69.0, list(&[])),
        (67.0, list(&[("hi-hi", false)])),
        (57.0, list(&[("hi", false), ("dv-hi", false)])),
        (29.0, list(&[("lo", true), ("lo-lo", true), ("dv-lo", true)])),
        (50.0, list(&[("lo", false), ("lo-lo", false), ("dv-lo", false)])),
    ] {
        assert_eq!(told(pv), expected, "{pv}");
    }
    let mut silent = start(&[]);
    at(&mut silent, 1e6, 50.0);
    assert!(silent.desk().alarms.is_empty(), "without limits there are none");
}

#[test]
fn new_limits_of_the_output_move_it_only_as_far_as_they_must() {
    let mut bench = start(&[("k", 1.0), ("ti", 10.0)]);
    at(&mut bench, 50.0, 50.0);
    bench
        .retune(&[("k", 1.0), ("ti", 10.0), ("out-high", 80.0), ("out-low", 20.0)])
        .unwrap();
    assert!((at(&mut bench, 50.0, 50.0) - 40.0).abs() < 1e-9);
    bench.retune(&[("k", 1.0), ("ti", 10.0), ("out-high", 30.0)]).unwrap();
    assert_eq!(at(&mut bench, 50.0, 50.0), 30.0);
    bench.retune(&[("k", 1.0), ("ti", 10.0)]).unwrap();
    let free = at(&mut bench, 50.0, 50.0);
    assert!((free - 40.0).abs() < 0.3, "{free}");
}

/// The state as layout 1 wrote it: fifteen parameters, and a memory without a source and alarms.
#[derive(Serialize)]
struct Memory1 {
    phase: bumpless_isa::Phase,
    numbers: [f64; 8],
}

#[test]
fn a_state_of_layout_1_is_taken_over() {
    let memory = Memory1 {
        phase: bumpless_isa::Phase::Running,
        // output, integral, pv, setpoint, feedforward, derivative, its setpoint, waited
        numbers: [42.0, 40.0, 50.0, 51.0, 0.0, 0.0, 51.0, 0.0],
    };
    goes_on_from(1, 15, &postcard::to_allocvec(&memory).unwrap());
}

#[test]
fn a_state_of_layout_2_is_taken_over() {
    let mut memory = bumpless_isa::Memory::new(42.0);
    memory.phase = bumpless_isa::Phase::Running;
    (memory.integral, memory.pv, memory.setpoint) = (40.0, 50.0, 51.0);
    memory.derivative_setpoint = 51.0;
    // Layout 2 had the law's memory alone.
    goes_on_from(2, 27, &postcard::to_allocvec(&memory).unwrap());
}

/// A state in an older layout, with its first so many parameters: K 2, Ti 10, an error of 1, an output of 42.
#[track_caller]
fn goes_on_from(state_layout: u32, parameters: usize, law: &[u8]) {
    let mut values: Vec<f64> = Pid::DESCRIPTION.parameters.iter().map(|p| p.default).collect();
    (values[0], values[1]) = (2.0, 10.0);
    let mut bytes = vec![0xB1, 3];
    bytes.extend_from_slice(b"pid");
    bytes.extend_from_slice(&state_layout.to_le_bytes());
    bytes.push(u8::try_from(parameters).unwrap());
    bytes.extend(values.iter().take(parameters).flat_map(|v| v.to_le_bytes()));
    bytes.extend_from_slice(law);
    let origin = Origin {
        name: "pid",
        version: "0.1.0",
        state_layout,
        bytes: &bytes,
    };
    let defaults: Vec<f64> = Pid::DESCRIPTION.parameters.iter().map(|p| p.default).collect();
    let mut given = defaults;
    (given[0], given[1]) = (2.0, 10.0);
    let state = bumpless_sdk::glue::migrate::<Pid>(&origin, &given, &[42.0]).unwrap();
    let mut bench = Bench::<Pid>::start(&[("k", 2.0), ("ti", 10.0)], &[42.0]).unwrap();
    bench.set_state(state);
    bench.hold(OUT, 42.0);
    let moved = 2.0 * (1.0 - (-DT_S / 10.0f64).exp());
    assert!(
        (at(&mut bench, 50.0, 51.0) - (42.0 + moved)).abs() < 1e-9,
        "as if nothing had been"
    );
}
