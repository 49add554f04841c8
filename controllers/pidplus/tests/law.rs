//! Tests of PIDPlus: the equations of the paper, equality with PID, and what it is for: seldom and lost measurements.

#![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

use bumpless_isa::table::{OUT, PV};
use bumpless_pid::Pid;
use bumpless_pidplus::PidPlus;
use bumpless_sdk::{
    Controller,
    bench::{Bench, good, repeated},
};

const DT_S: f64 = 0.1;

fn start<C: Controller>(parameters: &[(&str, f64)], track: f64) -> Bench<C> {
    Bench::start(parameters, &[track]).expect("starts")
}

/// A signal with no pattern: the golden ratio's multiples, −1 to 1.
fn rough(i: u32) -> f64 {
    2.0 * (f64::from(i) * 0.618_033_988_749_895).fract() - 1.0
}

#[test]
fn equals_pid_bit_by_bit_when_every_measurement_is_fresh() {
    let given = [
        ("k", 3.0),
        ("ti", 8.0),
        ("td", 1.5),
        ("beta", 0.6),
        ("gamma", 0.2),
        ("dead-band", 0.1),
        ("pv-filter", 0.4),
        ("out-rate", 30.0),
    ];
    let (mut pid, mut plus) = (start::<Pid>(&given, 40.0), start::<PidPlus>(&given, 40.0));
    for i in 0..2000 {
        let dt_s = DT_S * (1.5 + rough(i + 7));
        pid.set(PV, 50.0 + 5.0 * rough(i));
        plus.set(PV, 50.0 + 5.0 * rough(i));
        pid.set_setpoint(50.0 + f64::from(i / 100));
        plus.set_setpoint(50.0 + f64::from(i / 100));
        assert_eq!(
            pid.step(dt_s).expect("steps"),
            plus.step(dt_s).expect("steps"),
            "step {i}"
        );
    }
}

#[test]
fn follows_the_recursion_of_the_paper() {
    // PI: U_n = K·e_n + I_n, I_n = I_(n−1) + (U_(n−1) − I_(n−1))·(1 − e^(−ΔT/Ti)), only at received measurements.
    let (k, ti) = (1.7, 6.0);
    let mut bench = start::<PidPlus>(
        &[("k", k), ("ti", ti), ("out-low", -1000.0), ("out-high", 1000.0)],
        40.0,
    );
    bench.set_setpoint(50.0);
    bench.set(PV, 48.0);
    bench.step(DT_S).expect("steps");
    let (mut u, mut integral, mut waited, mut pv) = (40.0, 40.0 - k * 2.0, 0.0, 48.0);
    for i in 1..500u32 {
        waited += DT_S;
        let received = rough(i) > 0.3;
        if received {
            pv = 50.0 + 3.0 * rough(3 * i);
            integral += (u - integral) * (1.0 - (-waited / ti).exp());
            waited = 0.0;
        }
        bench.set_reading(PV, Some(if received { good(pv) } else { repeated(pv, 1) }));
        let found = bench.step(DT_S).expect("steps")[0];
        u = k * (50.0 - pv) + integral;
        assert!((found - u).abs() < 1e-9, "step {i}: {found} and {u}");
    }
}

#[test]
fn between_measurements_only_the_setpoint_moves_the_output() {
    let mut bench = start::<PidPlus>(&[("k", 2.0), ("ti", 5.0), ("td", 1.0)], 40.0);
    bench.set_setpoint(52.0);
    for pv in [50.0, 50.5, 51.0] {
        bench.set(PV, pv);
        bench.step(DT_S).expect("steps");
    }
    let held = bench.wanted()[0];
    bench.set_reading(PV, Some(repeated(51.0, 1)));
    for _ in 0..600 {
        assert_eq!(
            bench.step(DT_S).expect("steps"),
            [held],
            "a minute without measurements"
        );
    }
    bench.set_setpoint(53.0);
    assert!(
        (bench.step(DT_S).expect("steps")[0] - (held + 2.0)).abs() < 1e-9,
        "K times the change"
    );
}

#[test]
fn the_derivative_is_taken_over_the_time_between_measurements() {
    // The same slope, seen every 0.1 s by one and every 1 s by the other; without filter both give K·Td·slope.
    let given = [
        ("k", 1.0),
        ("ti", 0.0),
        ("balance-time", 1e6),
        ("td", 2.0),
        ("n", 100.0),
    ];
    let mut bench = start::<PidPlus>(&given, 50.0);
    bench.set(PV, 0.0);
    bench.set_setpoint(0.0);
    bench.step(DT_S).expect("steps");
    for i in 1..=100u32 {
        let pv = f64::from(i) * DT_S;
        bench.set_reading(PV, Some(if i % 10 == 0 { good(pv) } else { repeated(pv, 1) }));
        bench.step(DT_S).expect("steps");
    }
    let derivative = bench.wanted()[0] - (50.0 - 10.0);
    assert!((derivative + 2.0).abs() < 0.01, "{derivative}");
}

/// IAE of a setpoint step on a lag of 5 s whose measurement arrives only every `every` cycles.
fn iae<C: Controller>(every: u32) -> f64 {
    let mut bench = start::<C>(
        &[("k", 2.0), ("ti", 5.0), ("out-low", -1000.0), ("out-high", 1000.0)],
        0.0,
    );
    let (mut plant, mut seen, mut iae) = (0.0, 0.0, 0.0);
    bench.set(PV, 0.0);
    bench.step(DT_S).expect("steps");
    bench.set_setpoint(10.0);
    for i in 0..3000u32 {
        if i % every == 0 {
            seen = plant;
        }
        bench.set_reading(PV, Some(if i % every == 0 { good(seen) } else { repeated(seen, 1) }));
        let out = bench.step(DT_S).expect("steps")[0];
        plant += (out - plant) * (1.0 - (-DT_S / 5.0f64).exp());
        iae += (10.0f64 - plant).abs() * DT_S;
    }
    iae
}

#[test]
fn keeps_its_grip_where_measurements_are_seldom_and_pid_loses_it() {
    let (pid, plus) = (iae::<Pid>(50), iae::<PidPlus>(50));
    assert!(plus < 0.6 * pid, "PIDPlus {plus}, PID {pid}");
    assert!((iae::<Pid>(1) - iae::<PidPlus>(1)).abs() < 1e-9);
}

#[test]
fn takes_over_from_pid_and_gives_back_without_a_bump() {
    let given = [("k", 3.0), ("ti", 8.0), ("td", 1.0)];
    let run = |bench: &mut Bench<Pid>| {
        for i in 0..200 {
            bench.set(PV, 50.0 + rough(i));
            bench.set_setpoint(51.0);
            bench.step(DT_S).expect("steps");
        }
    };
    let (mut stayed, mut swapped) = (start::<Pid>(&given, 40.0), start::<Pid>(&given, 40.0));
    run(&mut stayed);
    run(&mut swapped);
    let (mut plus, taken) = swapped.swap::<PidPlus>(&given).expect("swaps");
    assert!(taken, "by migrate, not by start");
    assert_eq!(
        plus.step(DT_S).expect("steps"),
        stayed.step(DT_S).expect("steps"),
        "as if nothing had been"
    );
    let (mut back, taken) = plus
        .swap::<Pid>(&[("k", 9.0), ("ti", 2.0), ("td", 1.0)])
        .expect("swaps");
    assert!(taken);
    stayed.set(PV, 50.0 + rough(199));
    let (a, b) = (back.step(DT_S).expect("steps")[0], stayed.step(DT_S).expect("steps")[0]);
    // One step of the faster integral apart.
    assert!((a - b).abs() < 9.0 * 2.0 * DT_S / 2.0 + 0.5, "{a} and {b}");
}

#[test]
fn an_actuator_held_from_outside_is_followed_at_the_next_measurement() {
    let mut bench = start::<PidPlus>(&[("k", 1.0), ("ti", 5.0)], 40.0);
    bench.set_setpoint(50.0);
    bench.set(PV, 50.0);
    bench.step(DT_S).expect("steps");
    bench.hold(OUT, 60.0);
    bench.set_reading(PV, Some(repeated(50.0, 1)));
    bench.step(DT_S).expect("steps");
    bench.hold(OUT, 60.0);
    bench.set(PV, 50.0);
    let out = bench.step(10.0).expect("steps")[0];
    let expected = 40.0 + 20.0 * (1.0 - (-10.1f64 / 5.0).exp());
    assert!((out - expected).abs() < 1e-9, "{out} and {expected}");
}
