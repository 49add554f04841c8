//! Everything that must not bump: start, manual, tracking, limits, rate limits, retuning, lost cycles.

use bumpless_isa::table::{FF, OUT, PV, TRACK, TRACK_ON};
use bumpless_pid::Pid;
use bumpless_sdk::{
    Fault, Mode,
    bench::{Bench, bad, good, repeated},
};

use crate::plant::{Kind, Plant};

const DT_S: f64 = 0.1;

fn start(parameters: &[(&str, f64)], track: f64) -> Bench<Pid> {
    Bench::start(parameters, &[track]).expect("starts")
}

fn step(bench: &mut Bench<Pid>) -> f64 {
    bench.step(DT_S).expect("steps")[0]
}

/// The same with a measurement and a setpoint.
fn step_at(bench: &mut Bench<Pid>, pv: f64, setpoint: f64) -> f64 {
    bench.set(PV, pv);
    bench.set_setpoint(setpoint);
    step(bench)
}

#[test]
fn the_first_automatic_output_is_what_the_actuator_holds() {
    for ti in [0.0, 7.0] {
        for (pv, setpoint) in [(20.0, 20.0), (20.0, 90.0), (1e6, -1e6)] {
            let given = [
                ("k", 3.0),
                ("ti", ti),
                ("td", 2.0),
                ("beta", 0.4),
                ("gamma", 1.0),
                ("ff-gain", 0.3),
            ];
            let mut bench = start(&given, 37.25);
            bench.set(FF, 12.0);
            assert_eq!(
                step_at(&mut bench, pv, setpoint),
                37.25,
                "ti {ti}, pv {pv}, setpoint {setpoint}"
            );
        }
    }
}

#[test]
fn after_the_start_the_integral_goes_on_from_the_track_value() {
    let mut bench = start(&[("k", 2.0), ("ti", 10.0)], 40.0);
    assert_eq!(step_at(&mut bench, 50.0, 55.0), 40.0);
    // I moves by K·e·(1 − e^(−dt/Ti)) per step.
    let moved = 2.0 * 5.0 * (1.0 - (-DT_S / 10.0f64).exp());
    assert!((step_at(&mut bench, 50.0, 55.0) - (40.0 + moved)).abs() < 1e-12);
    assert!((step_at(&mut bench, 50.0, 55.0) - (40.0 + 2.0 * moved)).abs() < 1e-12);
}

#[test]
fn a_missing_cycle_is_made_up_for_by_its_true_time() {
    let given = [("k", 2.0), ("ti", 10.0)];
    let (mut every, mut gap) = (start(&given, 40.0), start(&given, 40.0));
    for bench in [&mut every, &mut gap] {
        step_at(bench, 50.0, 51.0);
    }
    let by_one = gap.step(0.5).expect("steps")[0];
    // Nothing stands between the samples but the actuator, which held: the exact lag over 0.5 s.
    let expected = 40.0 + 2.0 * (1.0 - (-0.05f64).exp());
    assert!((by_one - expected).abs() < 1e-12, "{by_one}");
    let by_five = (0..5).fold(0.0, |_, _| step(&mut every));
    assert!((by_five - by_one).abs() < 0.01, "{by_five} and {by_one}");
}

#[test]
fn manual_to_automatic_starts_where_the_hand_left_it() {
    let mut bench = start(&[("k", 4.0), ("ti", 20.0), ("td", 1.0)], 40.0);
    for i in 0..50 {
        step_at(&mut bench, 50.0 + f64::from(i % 7), 52.0);
    }
    bench.set_mode(Mode::Manual);
    for hand in [40.0, 45.5, 71.0] {
        bench.hold(OUT, hand);
        assert_eq!(step_at(&mut bench, 49.0, 52.0), hand);
        assert_eq!(bench.wanted(), [hand], "in manual it wants what is held");
    }
    bench.set_mode(Mode::Automatic);
    assert_eq!(
        step_at(&mut bench, 45.0, 60.0),
        71.0,
        "even when setpoint and measurement moved meanwhile"
    );
    let next = step_at(&mut bench, 45.0, 60.0);
    assert!((next - 71.0).abs() <= 4.0 * 15.0 * DT_S / 20.0, "{next}");
}

#[test]
fn in_manual_a_bad_measurement_is_no_fault_and_automatic_starts_from_the_next_good_one() {
    let mut bench = start(&[("k", 4.0), ("ti", 20.0), ("td", 10.0)], 40.0);
    bench.set_mode(Mode::Manual);
    bench.set_reading(PV, Some(bad(0.0)));
    assert_eq!(step(&mut bench), 40.0);
    bench.set_mode(Mode::Automatic);
    assert_eq!(
        step_at(&mut bench, 80.0, 81.0),
        40.0,
        "no derivative kick from the time without measurement"
    );
    assert!((step_at(&mut bench, 80.0, 81.0) - 40.0).abs() < 0.1);
}

#[test]
fn tracking_makes_the_output_follow_and_lets_go_without_a_bump() {
    let mut bench = start(&[("k", 4.0), ("ti", 20.0)], 40.0);
    step_at(&mut bench, 50.0, 52.0);
    bench.set(TRACK, 12.5);
    bench.set(TRACK_ON, 1.0);
    assert_eq!(step_at(&mut bench, 50.0, 52.0), 12.5);
    bench.set_reading(TRACK, Some(bad(99.0)));
    assert_eq!(
        step_at(&mut bench, 50.0, 52.0),
        12.5,
        "a bad track value holds the actuator"
    );
    bench.set(TRACK_ON, 0.0);
    assert_eq!(step_at(&mut bench, 47.0, 52.0), 12.5);
}

#[test]
fn retuning_does_not_move_the_output() {
    let before = [
        ("k", 2.0),
        ("ti", 15.0),
        ("td", 3.0),
        ("ff-gain", 0.5),
        ("dead-band", 0.2),
    ];
    let changes: [&[(&str, f64)]; 8] = [
        &[("k", 20.0), ("ti", 15.0), ("td", 3.0), ("ff-gain", 0.5)],
        &[("k", 2.0), ("ti", 0.5), ("td", 3.0), ("ff-gain", 0.5)],
        &[("k", 2.0), ("ti", 0.0), ("td", 3.0), ("ff-gain", 0.5)],
        &[("k", 2.0), ("ti", 15.0), ("td", 0.0), ("ff-gain", 0.5)],
        &[("k", 2.0), ("ti", 15.0), ("td", 9.0), ("n", 5.0), ("ff-gain", 0.5)],
        &[("k", 2.0), ("ti", 15.0), ("td", 3.0), ("beta", 0.0), ("ff-gain", -2.0)],
        &[
            ("k", 2.0),
            ("ti", 15.0),
            ("td", 3.0),
            ("ff-gain", 0.5),
            ("pv-filter", 2.0),
        ],
        &[("k", 2.0), ("ti", 15.0), ("td", 3.0), ("ff-gain", 0.5), ("action", 1.0)],
    ];
    for change in changes {
        let mut bench = start(&before, 40.0);
        bench.set(FF, 10.0);
        for i in 0..80u32 {
            step_at(&mut bench, 50.0 + 0.05 * f64::from(i.min(40)), 53.0);
        }
        let last = bench.wanted()[0];
        bench.retune(change).expect("retunes");
        // The measurement stands still, one unit away: what a step does of itself is bounded by K·e·dt/Ti, here 0.4.
        let next = step(&mut bench);
        assert!((next - last).abs() < 0.4, "{change:?}: {last} and {next}");
    }
    let mut bench = start(&before, 40.0);
    step_at(&mut bench, 50.0, 53.0);
    let error = bench
        .retune(&[("out-low", 60.0), ("out-high", 60.0)])
        .expect_err("no range");
    assert!(matches!(error, Fault::BadParameter(text) if text == "out-low must be less than out-high"));
}

#[test]
fn retuning_at_rest_is_exact() {
    let mut bench = start(&[("k", 2.0), ("ti", 15.0)], 40.0);
    for _ in 0..30 {
        step_at(&mut bench, 50.0, 50.0);
    }
    bench
        .retune(&[("k", 50.0), ("ti", 1.0), ("td", 5.0), ("beta", 0.2)])
        .expect("retunes");
    for _ in 0..30 {
        assert!((step_at(&mut bench, 50.0, 50.0) - 40.0).abs() < 1e-9);
    }
}

#[test]
fn the_integral_does_not_wind_up_at_a_limit() {
    let mut bench = start(&[("k", 2.0), ("ti", 10.0), ("out-high", 60.0)], 40.0);
    for _ in 0..6000 {
        step_at(&mut bench, 0.0, 50.0);
    }
    assert_eq!(bench.wanted(), [60.0]);
    // Ten minutes at the limit: with β = 1 the output leaves it in the step in which the error changes its sign.
    assert_eq!(step_at(&mut bench, 49.0, 50.0), 60.0);
    assert!(step_at(&mut bench, 50.5, 50.0) < 60.0);
}

#[test]
fn a_limit_outside_the_sandbox_is_followed_too() {
    let mut bench = start(&[("k", 2.0), ("ti", 10.0)], 40.0);
    for _ in 0..6000 {
        // The host lets no more than 45 through.
        step_at(&mut bench, 0.0, 10.0);
        bench.hold(OUT, 45.0);
    }
    let wanted = bench.wanted()[0];
    assert!(
        (wanted - (45.0 + 20.0)).abs() < 1e-6,
        "the integral is at the actuator's value: {wanted}"
    );
    assert!(step_at(&mut bench, 10.5, 10.0) < 45.0);
}

#[test]
fn the_rate_limit_counts_from_what_the_actuator_holds() {
    let mut bench = start(&[("k", 10.0), ("ti", 5.0), ("out-rate", 20.0)], 40.0);
    step_at(&mut bench, 50.0, 50.0);
    assert!((step_at(&mut bench, 50.0, 60.0) - 42.0).abs() < 1e-12);
    assert!((step_at(&mut bench, 50.0, 60.0) - 44.0).abs() < 1e-12);
    bench.hold(OUT, 30.0);
    assert!((step_at(&mut bench, 50.0, 60.0) - 32.0).abs() < 1e-12);
    // A longer period allows more.
    assert!((bench.step(0.5).expect("steps")[0] - 42.0).abs() < 1e-12);
}

#[test]
fn a_rate_limited_loop_settles_without_windup() {
    let given = [("k", 5.0), ("ti", 2.0), ("out-rate", 2.0)];
    let mut bench = start(&given, 0.0);
    let mut plant = Plant::new(Kind::Lags(vec![5.0]), 0.0, DT_S);
    step_at(&mut bench, 0.0, 0.0);
    let mut peak: f64 = 0.0;
    for _ in 0..3000 {
        let out = step_at(&mut bench, plant.output(), 10.0);
        peak = peak.max(plant.step(out));
    }
    assert!((plant.output() - 10.0).abs() < 1e-6, "{}", plant.output());
    assert!(peak < 13.0, "{peak}");
}

#[test]
fn weights_of_zero_keep_setpoint_steps_out_of_the_output() {
    let mut bench = start(&[("k", 10.0), ("ti", 20.0), ("td", 5.0), ("beta", 0.0)], 40.0);
    step_at(&mut bench, 50.0, 50.0);
    step_at(&mut bench, 50.0, 50.0);
    let after = step_at(&mut bench, 50.0, 70.0);
    assert!(
        (after - 40.0).abs() < 1e-9,
        "neither P nor D sees the setpoint: {after}"
    );
    let mut with_p = start(&[("k", 0.5), ("ti", 20.0), ("td", 5.0)], 40.0);
    step_at(&mut with_p, 50.0, 50.0);
    assert!(
        (step_at(&mut with_p, 50.0, 70.0) - 50.0).abs() < 1e-9,
        "β = 1: P sees it whole, D (γ = 0) not"
    );
}

#[test]
fn the_derivative_follows_the_closed_form_of_its_filter() {
    // A ramp of 1/s: d goes to −Td with time constant Td/N; backward difference, so d_k = −Td·(1 − q^k), q = Tf/(Tf+dt).
    let (td, n, k) = (4.0, 8.0, 0.5);
    let mut bench = start(
        &[("k", k), ("ti", 0.0), ("td", td), ("n", n), ("balance-time", 1e6)],
        50.0,
    );
    step_at(&mut bench, 0.0, 0.0);
    let tf = td / n;
    let q: f64 = tf / (tf + DT_S);
    for i in 1..100 {
        let pv = f64::from(i) * DT_S;
        let expected = 50.0 + k * (-pv - td * (1.0 - q.powi(i)));
        let found = step_at(&mut bench, pv, 0.0);
        assert!((found - expected).abs() < 1e-4, "{i}: {found} and {expected}");
    }
}

#[test]
fn within_the_dead_band_nothing_moves_and_its_edge_is_no_jump() {
    let mut bench = start(&[("k", 2.0), ("ti", 10.0), ("dead-band", 1.0)], 40.0);
    step_at(&mut bench, 50.0, 50.0);
    for pv in [50.9, 49.1, 50.0, 49.0, 51.0] {
        assert!((step_at(&mut bench, pv, 50.0) - 40.0).abs() < 1e-9, "{pv}");
    }
    let outside = step_at(&mut bench, 48.9, 50.0);
    assert!(
        (outside - 40.2).abs() < 1e-9,
        "only what is beyond the band counts: {outside}"
    );
}

#[test]
fn feedforward_acts_at_once_and_the_integral_does_not_take_it_back() {
    let mut bench = start(&[("k", 2.0), ("ti", 10.0), ("ff-gain", 0.5)], 40.0);
    bench.set(FF, 0.0);
    step_at(&mut bench, 50.0, 50.0);
    bench.set(FF, 20.0);
    for _ in 0..1000 {
        assert!((step_at(&mut bench, 50.0, 50.0) - 50.0).abs() < 1e-9);
    }
    bench.set_reading(FF, Some(bad(0.0)));
    assert!(
        (step_at(&mut bench, 50.0, 50.0) - 50.0).abs() < 1e-9,
        "a failing feedforward stays where it was"
    );
}

#[test]
fn without_integral_the_output_returns_to_the_bias() {
    let mut bench = start(&[("k", 2.0), ("ti", 0.0), ("bias", 30.0), ("balance-time", 10.0)], 40.0);
    assert_eq!(step_at(&mut bench, 49.0, 50.0), 40.0);
    for i in 1..=400 {
        let found = step_at(&mut bench, 49.0, 50.0);
        // From 38 (so that 38 + K·e = 40) to the bias.
        let expected = 30.0 + 8.0 * (-f64::from(i) * DT_S / 10.0).exp() + 2.0;
        assert!((found - expected).abs() < 1e-9, "{i}: {found} and {expected}");
    }
}

#[test]
fn bad_inputs_are_faults_and_leave_the_state() {
    let mut bench = start(&[], 40.0);
    bench.set_setpoint(50.0);
    let is_bad = |bench: &mut Bench<Pid>| matches!(bench.step(DT_S), Err(Fault::BadInput(_)));
    assert!(is_bad(&mut bench), "not connected");
    bench.set_reading(PV, Some(bad(50.0)));
    assert!(is_bad(&mut bench), "bad quality");
    bench.set(PV, f64::NAN);
    assert!(is_bad(&mut bench), "no number");
    bench.set(PV, 50.0);
    bench.set_setpoint(f64::INFINITY);
    assert!(is_bad(&mut bench), "no setpoint");
    assert_eq!(
        step_at(&mut bench, 50.0, 51.0),
        40.0,
        "then it starts as if nothing had been"
    );
    // PID uses what it sees, fresh or not.
    bench.set_reading(PV, Some(repeated(50.0, 5_000_000_000)));
    assert!(step(&mut bench) > 40.0);
}

#[test]
fn an_actuator_that_cannot_be_read_is_taken_to_hold_the_last_output() {
    let given = [("k", 2.0), ("ti", 10.0)];
    let (mut read, mut blind) = (start(&given, 40.0), start(&given, 40.0));
    for i in 0..20 {
        blind.hold_reading(OUT, None);
        let pv = 50.0 + 0.1 * f64::from(i);
        assert_eq!(step_at(&mut read, pv, 52.0), step_at(&mut blind, pv, 52.0));
    }
    blind.hold_reading(OUT, Some(good(f64::NAN)));
    assert!(step(&mut blind).is_finite());
}

#[test]
fn dead_time_does_not_unsettle_a_loop_that_is_tuned_for_it() {
    let mut bench = start(&[("k", 0.5), ("ti", 1.0), ("out-low", -100.0)], 0.0);
    let mut plant = Plant::new(Kind::Lags(vec![1.0]), 1.0, DT_S);
    step_at(&mut bench, 0.0, 0.0);
    for _ in 0..600 {
        let out = step_at(&mut bench, plant.output(), 10.0);
        plant.step(out);
    }
    assert!((plant.output() - 10.0).abs() < 1e-6);
}
