//! The cascade on a process of two lags: it settles, a disturbance of the inner loop hardly reaches the outer one, and nothing
//! bumps.

#![allow(clippy::unwrap_used, reason = "tests")]

use bumpless_cascade::{INNER_PV, OUT, PV, TwoLoops};
use bumpless_sdk::{bench::Bench, prelude::*};

const TUNING: [(&str, f64); 4] = [("k", 2.0), ("ti", 8.0), ("inner-k", 1.5), ("inner-ti", 1.0)];

/// A fast lag of 1 s inside a slow one of 10 s; the disturbance acts on the fast one.
#[derive(Clone, Copy)]
struct Process {
    inner: f64,
    outer: f64,
}

impl Process {
    fn advance(&mut self, input: f64, disturbance: f64, dt_s: f64) {
        self.inner += (input + disturbance - self.inner) * dt_s / 1.0;
        self.outer += (self.inner - self.outer) * dt_s / 10.0;
    }
}

fn at_rest(value: f64) -> (Bench<TwoLoops>, Process) {
    let mut bench = Bench::<TwoLoops>::start(&TUNING, &[value]).unwrap();
    bench.set_setpoint(value);
    let process = Process {
        inner: value,
        outer: value,
    };
    (bench, process)
}

/// Runs for a time; gives the greatest error of the outer loop, and the greatest step of the output.
fn run(bench: &mut Bench<TwoLoops>, process: &mut Process, setpoint: f64, disturbance: f64, for_s: f64) -> (f64, f64) {
    let (mut worst, mut step, mut last) = (0.0_f64, 0.0_f64, None);
    bench.set_setpoint(setpoint);
    for _ in 0..(for_s / 0.1) as usize {
        bench.set(PV, process.outer);
        bench.set(INNER_PV, process.inner);
        let out = bench.step(0.1).unwrap()[0];
        step = step.max(last.map_or(0.0, |before: f64| (out - before).abs()));
        last = Some(out);
        process.advance(out, disturbance, 0.1);
        worst = worst.max((setpoint - process.outer).abs());
    }
    (worst, step)
}

#[test]
fn it_starts_from_the_actuator_and_settles_at_a_new_setpoint() {
    let (mut bench, mut process) = at_rest(30.0);
    bench.set(PV, process.outer);
    bench.set(INNER_PV, process.inner);
    assert_eq!(
        bench.step(0.1).unwrap(),
        [30.0],
        "the first output is what the actuator holds"
    );
    run(&mut bench, &mut process, 50.0, 0.0, 120.0);
    assert!((process.outer - 50.0).abs() < 0.05, "{}", process.outer);
}

#[test]
fn a_disturbance_of_the_inner_loop_hardly_reaches_the_outer_one() {
    let (mut bench, mut process) = at_rest(40.0);
    let (worst, _) = run(&mut bench, &mut process, 40.0, 10.0, 100.0);
    assert!(worst < 1.0, "without the inner loop it would be several: {worst}");
    assert!((process.outer - 40.0).abs() < 0.05);
}

#[test]
fn manual_to_automatic_and_a_new_tuning_do_not_bump() {
    let (mut bench, mut process) = at_rest(40.0);
    run(&mut bench, &mut process, 42.0, 0.0, 5.0);
    bench.set_mode(Mode::Manual);
    bench.hold(OUT, 55.0);
    for _ in 0..50 {
        bench.set(PV, process.outer);
        bench.set(INNER_PV, process.inner);
        assert_eq!(bench.step(0.1).unwrap(), [55.0]);
        process.advance(55.0, 0.0, 0.1);
    }
    bench.set_mode(Mode::Automatic);
    bench.set(PV, process.outer);
    bench.set(INNER_PV, process.inner);
    assert!((bench.step(0.1).unwrap()[0] - 55.0).abs() < 1e-9, "back to automatic");
    let mut plain = Bench::<TwoLoops>::start(&TUNING, &[55.0]).unwrap();
    plain.set_state(bench.state().to_vec());
    plain.set(PV, process.outer);
    plain.set(INNER_PV, process.inner);
    plain.set_setpoint(42.0);
    let without = plain.step(0.1).unwrap()[0];
    bench
        .retune(&[("k", 4.0), ("ti", 4.0), ("inner-k", 3.0), ("inner-ti", 0.5)])
        .unwrap();
    bench.set(PV, process.outer);
    bench.set(INNER_PV, process.inner);
    let with = bench.step(0.1).unwrap()[0];
    assert!(
        (with - without).abs() < 2.0,
        "only what the new tuning does with the same error: {with} for {without}"
    );
}

#[test]
fn an_outer_loop_whose_inner_one_is_at_its_limit_does_not_wind_up() {
    let (mut bench, mut process) = at_rest(90.0);
    // Out of reach: the actuator ends at 100.
    run(&mut bench, &mut process, 130.0, 0.0, 200.0);
    let (_, _) = run(&mut bench, &mut process, 80.0, 0.0, 30.0);
    assert!(
        process.outer < 90.0,
        "it comes back at once, not after the integral has unwound: {}",
        process.outer
    );
}

#[test]
fn what_cannot_be_is_refused() {
    for (parameters, part) in [
        (vec![("inner-low", 5.0), ("inner-high", 5.0)], "inner-low"),
        (vec![("out-low", 100.0), ("out-high", 0.0)], "out-low"),
    ] {
        let error = Bench::<TwoLoops>::start(&parameters, &[0.0]).unwrap_err();
        assert!(format!("{error:?}").contains(part), "{error:?}");
    }
    let mut bench = Bench::<TwoLoops>::start(&TUNING, &[1.0]).unwrap();
    bench.set(PV, 1.0);
    assert!(format!("{:?}", bench.step(0.1).unwrap_err()).contains("inner-pv"));
}

#[test]
fn the_inner_loop_alone_and_back_to_the_cascade_do_not_bump() {
    use bumpless_cascade::{INNER_ON, INNER_SP, INNER_SP_OUT};

    let (mut bench, mut process) = at_rest(40.0);
    run(&mut bench, &mut process, 42.0, 0.0, 5.0);
    let (out, inner_sp) = (bench.wanted()[0], bench.written(INNER_SP_OUT).unwrap());
    bench.set(INNER_ON, 1.0);
    run(&mut bench, &mut process, 42.0, 0.0, 0.1);
    assert!((bench.wanted()[0] - out).abs() < 0.5, "the inner setpoint stays");
    assert!((bench.written(INNER_SP_OUT).unwrap() - inner_sp).abs() < 1e-9);
    bench.set(INNER_SP, 60.0);
    run(&mut bench, &mut process, 42.0, 0.0, 60.0);
    assert!(
        (process.inner - 60.0).abs() < 0.01,
        "its own setpoint is reached: {}",
        process.inner
    );
    let before = bench.wanted()[0];
    bench.set(INNER_ON, 0.0);
    run(&mut bench, &mut process, 42.0, 0.0, 0.1);
    let after = bench.wanted()[0];
    assert!(
        (after - before).abs() < 0.01,
        "back in the cascade from there: {before} and {after}"
    );
    run(&mut bench, &mut process, 42.0, 0.0, 200.0);
    assert!((process.outer - 42.0).abs() < 0.05, "{}", process.outer);
}
