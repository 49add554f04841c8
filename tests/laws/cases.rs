//! The cases: parameters, inputs, and what the laws made of them.
//!
//! Never: what they should have made of them.

use bumpless_autotune::{Autotune, FOUND, STAGE};
use bumpless_cascade::{INNER_PV, TwoLoops};
use bumpless_feedforward::Feedforward;
use bumpless_fuzzy::Fuzzy;
use bumpless_isa::table::{FF, PV};
use bumpless_kalman_pid::{ESTIMATE, KalmanPid, LOAD};
use bumpless_lead_lag::{IN, LeadLagBlock};
use bumpless_mpc::Mpc;
use bumpless_pid::Pid;
use bumpless_pidplus::PidPlus;
use bumpless_sdk::{
    Controller, Input,
    bench::{Bench, good, repeated},
};
use bumpless_smith::Smith;
use serde_json::{Value, json};

use crate::{
    plant::{Draw, Plant},
    stations,
};

pub(crate) type Given = Vec<(&'static str, f64)>;

/// Where every loop begins: output and setpoint of a process at rest.
pub(crate) const BASE: f64 = 40.0;

/// All cases.
pub(crate) fn all() -> Vec<Value> {
    let mut draw = Draw(20_260);
    let mut cases = Vec::new();
    for n in 0..16 {
        cases.push(pid(&mut draw, n));
    }
    for n in 0..3 {
        cases.push(smith(&mut draw, n));
        cases.push(cascade(&mut draw, n));
        cases.push(lead_lag(&mut draw, n));
        cases.push(feedforward(&mut draw, n));
        cases.push(kalman(&mut draw, n));
        cases.push(autotune(&mut draw, n));
    }
    for n in 0..4 {
        cases.push(mpc(&mut draw, n));
        cases.push(fuzzy(&mut draw, n));
    }
    cases.extend(stations::all(&mut draw));
    cases
}

pub(crate) fn parameters(given: &Given) -> Value {
    given
        .iter()
        .map(|(name, value)| ((*name).to_owned(), json!(value)))
        .collect::<serde_json::Map<_, _>>()
        .into()
}

/// A course without a pattern: at rest for a second, then steps and ramps within `reach`, three to six of them.
fn profile(draw: &mut Draw, reach: f64, dt_s: f64, cycles: usize) -> Vec<f64> {
    let mut course = vec![0.0; (1.0 / dt_s).round() as usize];
    let moves = draw.between(3.0, 6.99) as usize;
    let mut value: f64 = 0.0;
    while course.len() < cycles {
        let length = (cycles as f64 / moves as f64 * draw.between(0.6, 1.4)) as usize;
        let to = draw.between(-reach, reach);
        // One of three goes there slowly.
        let ramp = if draw.between(0.0, 3.0) < 1.0 { length / 2 } else { 0 };
        let from = value;
        course.extend((1..=ramp).map(|i| from + (to - from) * i as f64 / ramp as f64));
        course.extend(std::iter::repeat_n(to, length - ramp));
        value = to;
    }
    course.truncate(cycles);
    course
}

/// Greatest setpoint and load of a profile, in units of measurement and output.
const REACH: (f64, f64) = (10.0, 6.0);

/// A closed loop under a course of the setpoint, and one of a load at the process's input.
fn closed<C: Controller>(
    given: &Given,
    plant: &mut Plant,
    dt_s: f64,
    (setpoint, load): (&[f64], &[f64]),
) -> [Vec<f64>; 2] {
    let mut bench = Bench::<C>::start(given, &[BASE]).unwrap();
    let pv = Input::of(C::DESCRIPTION.ports, "pv");
    let rest = plant.output();
    let (mut ys, mut us) = (Vec::new(), Vec::new());
    for (setpoint, load) in setpoint.iter().zip(load) {
        bench.set_setpoint(rest + setpoint);
        bench.set(pv, plant.output());
        let u = bench.step(dt_s).unwrap()[0];
        ys.push(plant.output());
        us.push(u);
        plant.advance(u + load);
    }
    [ys, us]
}

/// Tuning by SIMC for a process with two lags.
fn simc(plant: &Plant, draw: &mut Draw) -> Given {
    let [t1, t2] = plant.lags_s;
    let tau_c = plant.delay_s.max(0.5) * draw.between(1.0, 2.0);
    let k = t1 / (plant.gain * (tau_c + plant.delay_s));
    vec![
        ("k", k),
        ("ti", t1.min(4.0 * (tau_c + plant.delay_s))),
        ("td", t2),
        ("out-low", -1e6),
        ("out-high", 1e6),
    ]
}

fn pid(draw: &mut Draw, n: u32) -> Value {
    let (dt_s, cycles) = (0.02, 4000);
    let t1 = draw.between(4.0, 10.0);
    // Every second one without a derivative.
    let t2 = if n.is_multiple_of(2) {
        0.0
    } else {
        draw.between(0.5, 2.0)
    };
    let delay_s = draw.on_grid(0.0, 3.0, dt_s);
    let mut plant = Plant::resting(draw.between(0.5, 3.0), [t1, t2], delay_s, dt_s, BASE);
    let mut given = simc(&plant, draw);
    // Three of four as simple-pid can have them: all or nothing of the setpoint in P and in D. Its D has no filter, so where D
    // sees the setpoint step ours has hardly one.
    let (beta, gamma, filter) = if n % 4 == 3 {
        (draw.between(0.0, 1.0), draw.between(0.0, 1.0), draw.between(5.0, 20.0))
    } else {
        let gamma = f64::from(u8::from(n % 3 == 1));
        let filter = if gamma > 0.0 { 100.0 } else { draw.between(5.0, 20.0) };
        (f64::from(u8::from(n % 5 > 1)), gamma, filter)
    };
    given.push(("n", filter));
    given.push(("beta", beta));
    given.push(("gamma", gamma));
    let run = if n % 3 == 2 { closed::<PidPlus> } else { closed::<Pid> };
    let (setpoint, load) = (
        profile(draw, REACH.0, dt_s, cycles),
        profile(draw, REACH.1, dt_s, cycles),
    );
    let [y, u] = run(&given, &mut plant, dt_s, (&setpoint, &load));
    json!({
        "law": "pid", "name": format!("pid {n}"), "parameters": parameters(&given), "dt": dt_s, "base": BASE,
        "plant": {"gain": plant.gain, "lags": plant.lags_s, "delay": delay_s}, "step": REACH.0, "setpoint": setpoint,
        "load": load, "y": y, "u": u,
    })
}

fn smith(draw: &mut Draw, n: u32) -> Value {
    let (dt_s, cycles) = (0.02, 4000);
    let (gain, lag) = (draw.between(0.5, 2.0), draw.between(3.0, 8.0));
    let delay_s = draw.on_grid(3.0, 8.0, dt_s);
    let mut plant = Plant::resting(gain, [0.0, lag], delay_s, dt_s, BASE);
    let given = vec![
        ("k", 3.0 / gain),
        ("ti", lag),
        ("out-low", -1e6),
        ("out-high", 1e6),
        ("model-gain", gain),
        ("model-lag", lag),
        ("model-delay", delay_s),
    ];
    let setpoint = profile(draw, REACH.0, dt_s, cycles);
    let [y, _] = closed::<Smith>(&given, &mut plant, dt_s, (&setpoint, &vec![0.0; cycles]));
    json!({
        "law": "smith", "name": format!("smith {n}"), "parameters": parameters(&given), "dt": dt_s, "base": BASE,
        "step": REACH.0, "setpoint": setpoint, "y": y,
    })
}

fn cascade(draw: &mut Draw, n: u32) -> Value {
    let (dt_s, cycles) = (0.01, 4000);
    let (inner_s, outer_s) = (draw.between(0.5, 1.0), draw.between(6.0, 12.0));
    let given = vec![
        ("k", draw.between(1.0, 3.0)),
        ("ti", draw.between(5.0, 12.0)),
        ("inner-k", draw.between(1.0, 3.0)),
        ("inner-ti", draw.between(0.5, 2.0)),
        ("inner-low", -1e6),
        ("inner-high", 1e6),
        ("out-low", -1e6),
        ("out-high", 1e6),
    ];
    let mut bench = Bench::<TwoLoops>::start(&given, &[BASE]).unwrap();
    let (mut inner, mut outer) = (BASE, BASE);
    let mut y = Vec::new();
    let setpoint = profile(draw, REACH.0, dt_s, cycles);
    for wanted in &setpoint {
        bench.set_setpoint(BASE + wanted);
        bench.set(bumpless_cascade::PV, outer);
        bench.set(INNER_PV, inner);
        let u = bench.step(dt_s).unwrap()[0];
        y.push(outer);
        for _ in 0..20 {
            let part = dt_s / 20.0;
            let before = inner;
            inner += (u - inner) * -(-part / inner_s).exp_m1();
            outer += (0.5 * (before + inner) - outer) * -(-part / outer_s).exp_m1();
        }
    }
    json!({
        "law": "cascade", "name": format!("cascade {n}"), "parameters": parameters(&given), "dt": dt_s, "base": BASE,
        "inner": inner_s, "outer": outer_s, "step": REACH.0, "setpoint": setpoint, "y": y,
    })
}

/// A signal that stays for some cycles and then jumps.
pub(crate) fn steps(draw: &mut Draw, cycles: usize) -> Vec<f64> {
    let mut signal = Vec::new();
    while signal.len() < cycles {
        let value = draw.between(-50.0, 50.0);
        let length = draw.between(1.0, 20.0) as usize;
        signal.extend(std::iter::repeat_n(value, length));
    }
    signal.truncate(cycles);
    signal
}

fn lead_lag(draw: &mut Draw, n: u32) -> Value {
    let dt_s = draw.on_grid(0.05, 0.5, 0.01);
    let given = vec![
        ("gain", draw.between(-2.0, 2.0)),
        ("bias", draw.between(-5.0, 5.0)),
        ("lead", draw.between(0.0, 5.0)),
        ("lag", draw.between(0.5, 5.0)),
        ("balance-time", 0.0),
        ("out-low", -1e6),
        ("out-high", 1e6),
    ];
    let mut bench = Bench::<LeadLagBlock>::start(&given, &[0.0]).unwrap();
    let input = steps(draw, 300);
    let out: Vec<f64> = input
        .iter()
        .map(|value| {
            bench.set(IN, *value);
            bench.step(dt_s).unwrap()[0]
        })
        .collect();
    json!({
        "law": "lead-lag", "name": format!("lead-lag {n}"), "parameters": parameters(&given), "dt": dt_s, "input": input, "out": out,
    })
}

fn feedforward(draw: &mut Draw, n: u32) -> Value {
    let dt_s = draw.on_grid(0.05, 0.5, 0.01);
    let delay = draw.between(0.0, 12.0).round();
    let given = vec![
        // Without feedback only the way of the disturbance is left.
        ("k", 0.0),
        ("ff-gain", draw.between(-2.0, 2.0)),
        ("ff-lead", draw.between(0.0, 5.0)),
        ("ff-lag", draw.between(0.5, 5.0)),
        ("ff-delay", delay * dt_s),
        ("out-low", -1e6),
        ("out-high", 1e6),
    ];
    let mut bench = Bench::<Feedforward>::start(&given, &[BASE]).unwrap();
    bench.set_setpoint(0.0);
    bench.set(PV, 0.0);
    let input = steps(draw, 300);
    let out: Vec<f64> = input
        .iter()
        .map(|value| {
            bench.set(FF, *value);
            bench.step(dt_s).unwrap()[0]
        })
        .collect();
    json!({
        "law": "feedforward", "name": format!("feedforward {n}"), "parameters": parameters(&given), "dt": dt_s, "base": BASE,
        "delay_steps": delay, "input": input, "out": out,
    })
}

fn kalman(draw: &mut Draw, n: u32) -> Value {
    let dt_s = 0.1;
    let (gain, lag) = (draw.between(0.5, 2.0), draw.between(3.0, 15.0));
    let given = vec![
        ("k", 0.5 / gain),
        ("ti", lag),
        ("out-low", -1e6),
        ("out-high", 1e6),
        ("model-gain", gain),
        ("model-lag", lag),
        ("noise", draw.between(0.2, 1.0)),
        ("unrest", draw.between(0.01, 0.1)),
        ("drift", draw.between(0.01, 0.3)),
    ];
    let mut plant = Plant::resting(gain, [0.0, lag], 0.0, dt_s, BASE);
    let mut bench = Bench::<KalmanPid>::start(&given, &[BASE]).unwrap();
    let rest = plant.output();
    let (mut pv, mut fresh, mut held, mut estimate, mut load) = (vec![], vec![], vec![], vec![], vec![]);
    let mut now_held = BASE;
    for i in 0..600u32 {
        let is_fresh = i == 0 || draw.between(0.0, 1.0) < 0.7;
        let value = plant.output() + draw.between(-1.0, 1.0);
        bench.set_reading(PV, Some(if is_fresh { good(value) } else { repeated(value, 1) }));
        bench.set_setpoint(if i > 100 { rest + 5.0 } else { rest });
        held.push(now_held);
        now_held = bench.step(dt_s).unwrap()[0];
        pv.push(value);
        fresh.push(is_fresh);
        estimate.push(bench.written(ESTIMATE).unwrap());
        load.push(bench.written(LOAD).unwrap());
        plant.advance(if i > 300 { now_held + 3.0 } else { now_held });
    }
    json!({
        "law": "kalman-pid", "name": format!("kalman-pid {n}"), "parameters": parameters(&given), "dt": dt_s,
        "pv": pv, "fresh": fresh, "held": held, "estimate": estimate, "load": load,
    })
}

fn autotune(draw: &mut Draw, n: u32) -> Value {
    let dt_s = 0.05;
    let (gain, lag) = (draw.between(0.5, 2.0), draw.between(5.0, 12.0));
    let delay_s = draw.on_grid(2.0, 5.0, dt_s);
    let tune = f64::from(1 + n % 2);
    let given = vec![
        ("k", 0.1 / gain),
        ("ti", 100.0),
        ("tune", tune),
        ("noise", 0.01),
        ("pv-span", 1e3),
        ("quiet-time", 25.0),
        // Ziegler and Nichols, PI.
        ("rule", 2.0),
    ];
    let mut plant = Plant::resting(gain, [0.0, lag], delay_s, dt_s, BASE);
    let mut bench = Bench::<Autotune>::start(&given, &[BASE]).unwrap();
    bench.set_setpoint(plant.output());
    let mut stage = 0.0;
    for _ in 0..40_000 {
        bench.set(PV, plant.output());
        let u = bench.step(dt_s).unwrap()[0];
        stage = bench.written(STAGE).unwrap();
        if stage > 1.0 {
            break;
        }
        plant.advance(u);
    }
    let found: Vec<f64> = FOUND.iter().map(|port| bench.written(*port).unwrap()).collect();
    json!({
        "law": "autotune", "name": format!("autotune {n}"), "parameters": parameters(&given), "stage": stage, "found": found,
        "plant": {"gain": gain, "lags": [0.0, lag], "delay": delay_s},
    })
}

fn mpc(draw: &mut Draw, n: u32) -> Value {
    let dt_s = 0.5;
    let gain = draw.between(0.5, 2.0) * if n.is_multiple_of(2) { 1.0 } else { -1.0 };
    let (lag, delay) = (draw.between(4.0, 10.0), draw.between(0.0, 8.0).round());
    let mut given = vec![
        ("gain", gain),
        ("lag", lag),
        ("delay", delay * dt_s),
        ("interval", 1.0),
        ("horizon", 25.0),
        ("moves", 4.0),
        ("move-weight", draw.between(0.02, 0.5)),
        ("reference-time", draw.between(0.0, 4.0)),
        ("out-low", 20.0),
        ("out-high", 60.0),
        ("out-rate", 4.0),
    ];
    if n >= 2 {
        // Limits that the setpoint lies beyond.
        given.push(("pv-high", gain * BASE + 7.0));
        given.push(("pv-low", gain * BASE - 7.0));
    }
    // The process is 15 % stronger than the model.
    let mut plant = Plant::resting(gain * 1.15, [0.0, lag], delay * dt_s, dt_s, BASE);
    let mut bench = Bench::<Mpc>::start(&given, &[BASE]).unwrap();
    let rest = plant.output();
    let (mut pv, mut setpoint, mut out) = (vec![], vec![], vec![]);
    for i in 0..160u32 {
        let wanted = match i {
            0..10 => rest,
            10..80 => rest + 12.0,
            _ => rest - 30.0,
        };
        bench.set_setpoint(wanted);
        bench.set(bumpless_mpc::PV, plant.output());
        pv.push(plant.output());
        setpoint.push(wanted);
        let u = bench.step(dt_s).unwrap()[0];
        out.push(u);
        plant.advance(u);
    }
    json!({
        "law": "mpc", "name": format!("mpc {n}"), "parameters": parameters(&given), "dt": dt_s, "base": BASE,
        "pv": pv, "setpoint": setpoint, "out": out,
    })
}

fn fuzzy(draw: &mut Draw, n: u32) -> Value {
    let dt_s = 0.5;
    let given = vec![
        ("error-span", draw.between(5.0, 20.0)),
        ("rate-span", draw.between(2.0, 10.0)),
        ("out-span", draw.between(5.0, 30.0)),
        ("ti", 0.0),
        ("rate-filter", 0.0),
        ("action", f64::from(n % 2)),
        ("out-low", -1e6),
        ("out-high", 1e6),
    ];
    let mut bench = Bench::<Fuzzy>::start(&given, &[BASE]).unwrap();
    bench.set_setpoint(50.0);
    let mut value: f64 = 50.0;
    let (mut pv, mut out) = (vec![], vec![]);
    for _ in 0..60 {
        value = (value + draw.between(-4.0, 4.0)).clamp(30.0, 70.0);
        bench.set(bumpless_fuzzy::PV, value);
        out.push(bench.step(dt_s).unwrap()[0]);
        pv.push(value);
    }
    assert_eq!(out[0], BASE);
    json!({
        "law": "fuzzy", "name": format!("fuzzy {n}"), "parameters": parameters(&given), "dt": dt_s, "base": BASE, "setpoint": 50.0,
        "pv": pv, "out": out,
    })
}
