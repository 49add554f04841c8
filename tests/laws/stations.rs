//! The cases of the laws that stand around others: ratio, split range, schedule, selector, two positions.
//!
//! Never: what the laws should have made of them.

use bumpless_gain_schedule::{GainSchedule, SCHEDULE};
use bumpless_isa::table::PV;
use bumpless_on_off::OnOff;
use bumpless_override_selector::{LIMIT_PV, OverrideSelector};
use bumpless_ratio::{Ratio, WILD};
use bumpless_sdk::bench::Bench;
use bumpless_split_range::SplitRange;
use serde_json::{Value, json};

use crate::{
    cases::{BASE, parameters, steps},
    plant::{Draw, Plant},
};

/// Cycles of a case that is compared step by step.
const CYCLES: usize = 300;

/// All of these cases.
pub(crate) fn all(draw: &mut Draw) -> Vec<Value> {
    let mut cases = Vec::new();
    for n in 0..4 {
        cases.push(ratio(draw, n));
        cases.push(split_range(draw, n));
        cases.push(gain_schedule(draw, n));
        cases.push(override_selector(draw, n));
        cases.push(on_off(draw, n));
    }
    cases.push(on_off_alone(draw, 4));
    cases.push(on_off_alone(draw, 5));
    cases
}

/// A signal that wanders about a middle, and stays within `reach` of it.
fn wander(draw: &mut Draw, middle: f64, step: f64, reach: f64, cycles: usize) -> Vec<f64> {
    let mut value = middle;
    (0..cycles)
        .map(|_| {
            value = (value + draw.between(-step, step)).clamp(middle - reach, middle + reach);
            value
        })
        .collect()
}

fn ratio(draw: &mut Draw, n: u32) -> Value {
    let dt_s = draw.on_grid(0.05, 0.5, 0.01);
    let given = vec![
        ("ratio-low", 0.4),
        ("ratio-high", 1.6),
        ("bias", draw.between(-10.0, 10.0)),
        (
            "wild-filter",
            if n.is_multiple_of(2) {
                0.0
            } else {
                draw.between(0.5, 5.0)
            },
        ),
        ("balance-time", draw.between(1.0, 10.0)),
        ("out-low", -20.0),
        ("out-high", 40.0),
    ];
    let mut bench = Bench::<Ratio>::start(&given, &[10.0]).unwrap();
    let wild = steps(draw, CYCLES);
    // Some beyond what the ratio may be.
    let ratio: Vec<f64> = steps(draw, CYCLES).iter().map(|s| 1.0 + s / 50.0).collect();
    let out: Vec<f64> = wild
        .iter()
        .zip(&ratio)
        .map(|(wild, ratio)| {
            bench.set(WILD, *wild);
            bench.set_setpoint(*ratio);
            bench.step(dt_s).unwrap()[0]
        })
        .collect();
    json!({
        "law": "ratio", "name": format!("ratio {n}"), "parameters": parameters(&given), "dt": dt_s, "held": 10.0, "wild": wild,
        "ratio": ratio, "out": out,
    })
}

fn split_range(draw: &mut Draw, n: u32) -> Value {
    let dt_s = 0.1;
    let (split, gap) = (draw.between(40.0, 60.0), draw.between(-15.0, 15.0));
    let given = vec![
        ("k", draw.between(0.5, 1.5)),
        ("ti", draw.between(10.0, 20.0)),
        ("split", split),
        ("gap", gap),
        ("a-low", draw.between(60.0, 100.0)),
        ("a-split", draw.between(0.0, 10.0)),
        ("b-split", draw.between(0.0, 10.0)),
        ("b-high", draw.between(60.0, 100.0)),
    ];
    let of = |name: &str| given.iter().find(|(n, _)| *n == name).unwrap().1;
    // B alone is open at first, by 60 % of its way: so the first u is known.
    let begun = split + 0.5 * gap;
    let u = begun + 0.6 * (100.0 - begun);
    let b = of("b-split") + 0.6 * (of("b-high") - of("b-split"));
    let mut bench = Bench::<SplitRange>::start(&given, &[of("a-split"), b]).unwrap();
    // A process that A cools and B heats: from B's part through the gap to A's, and back.
    let lag_s = draw.between(15.0, 25.0);
    let rests_at = |a: f64, b: f64| 20.0 + 0.6 * b - 0.4 * a;
    let rest = rests_at(of("a-split"), b);
    let mut y = rest;
    let (mut pv, mut setpoint, mut out_a, mut out_b) = (vec![], vec![], vec![], vec![]);
    for i in 0..4500 {
        let wanted = if (100..2500).contains(&i) { 8.0 } else { rest };
        bench.set_setpoint(wanted);
        bench.set(PV, y);
        pv.push(y);
        setpoint.push(wanted);
        let both = bench.step(dt_s).unwrap();
        out_a.push(both[0]);
        out_b.push(both[1]);
        y += (rests_at(both[0], both[1]) - y) * dt_s / lag_s;
    }
    json!({
        "law": "split-range", "name": format!("split-range {n}"), "parameters": parameters(&given), "dt": dt_s, "u": u,
        "setpoint": setpoint, "pv": pv, "a": out_a, "b": out_b,
    })
}

fn gain_schedule(draw: &mut Draw, n: u32) -> Value {
    let dt_s = draw.on_grid(0.05, 0.3, 0.01);
    let mut given = vec![
        ("points", 4.0),
        ("by", f64::from(n % 2)),
        ("out-low", -1e6),
        ("out-high", 1e6),
    ];
    let names = [
        ["x1", "k", "ti"],
        ["x2", "k2", "ti2"],
        ["x3", "k3", "ti3"],
        ["x4", "k4", "ti4"],
    ];
    let mut x = draw.between(30.0, 40.0);
    for [at, k, ti] in names {
        given.push((at, x));
        given.push((k, draw.between(0.2, 4.0)));
        given.push((ti, draw.between(2.0, 20.0)));
        x += draw.between(8.0, 12.0);
    }
    let mut bench = Bench::<GainSchedule>::start(&given, &[BASE]).unwrap();
    let pv = wander(draw, 50.0, 3.0, 25.0, CYCLES);
    let schedule = wander(draw, 50.0, 5.0, 30.0, CYCLES);
    let setpoint: Vec<f64> = steps(draw, CYCLES).iter().map(|s| 50.0 + 0.2 * s).collect();
    let mut out = vec![];
    for i in 0..CYCLES {
        bench.set(PV, pv[i]);
        bench.set(SCHEDULE, schedule[i]);
        bench.set_setpoint(setpoint[i]);
        out.push(bench.step(dt_s).unwrap()[0]);
    }
    json!({
        "law": "gain-schedule", "name": format!("gain-schedule {n}"), "parameters": parameters(&given), "dt": dt_s, "base": BASE,
        "pv": pv, "schedule": schedule, "setpoint": setpoint, "out": out,
    })
}

fn override_selector(draw: &mut Draw, n: u32) -> Value {
    let (dt_s, cycles) = (0.01, 6000);
    let (lag, limit_lag, limit_gain) = (draw.between(5.0, 12.0), draw.between(1.0, 3.0), draw.between(1.5, 2.5));
    let high = n % 2 == 1;
    // The limit is where the output is 50: a wish beyond it meets the limit.
    let limit = limit_gain * 50.0;
    let given = vec![
        ("k", draw.between(1.0, 3.0)),
        ("ti", draw.between(4.0, 12.0)),
        ("select", f64::from(u8::from(high))),
        ("limit-sp", limit),
        ("limit-k", draw.between(0.2, 1.0)),
        ("limit-ti", draw.between(1.0, 4.0)),
        ("out-low", -1e6),
        ("out-high", 1e6),
    ];
    let (free, beyond) = if high { (70.0, 20.0) } else { (30.0, 80.0) };
    let mut bench = Bench::<OverrideSelector>::start(&given, &[free]).unwrap();
    let (mut y, mut x) = (free, limit_gain * free);
    let turns = [draw.between(2.0, 6.0), draw.between(25.0, 35.0)];
    let (mut ys, mut xs) = (vec![], vec![]);
    for i in 0..cycles {
        let t = f64::from(i) * dt_s;
        bench.set_setpoint(if t >= turns[0] && t < turns[1] { beyond } else { free });
        bench.set(PV, y);
        bench.set(LIMIT_PV, x);
        let u = bench.step(dt_s).unwrap()[0];
        ys.push(y);
        xs.push(x);
        y += (u - y) * -(-dt_s / lag).exp_m1();
        x += (limit_gain * u - x) * -(-dt_s / limit_lag).exp_m1();
    }
    json!({
        "law": "override-selector", "name": format!("override-selector {n}"), "parameters": parameters(&given), "dt": dt_s,
        "lag": lag, "limit_lag": limit_lag, "limit_gain": limit_gain, "free": free, "beyond": beyond, "turns": turns,
        "y": ys, "x": xs,
    })
}

/// Around a process: it swings.
fn on_off(draw: &mut Draw, n: u32) -> Value {
    let dt_s = 0.01;
    let (gain, lag) = (draw.between(0.5, 2.0), draw.between(4.0, 10.0));
    let delay_s = draw.on_grid(0.5, 2.0, dt_s);
    let given = vec![("hysteresis", draw.between(1.0, 5.0)), ("action", 0.0)];
    let mut plant = Plant::resting(gain, [0.0, lag], delay_s, dt_s, 0.0);
    let mut bench = Bench::<OnOff>::start(&given, &[0.0]).unwrap();
    let setpoint = 50.0 * gain;
    let (mut pv, mut out) = (vec![], vec![]);
    for _ in 0..8000 {
        bench.set_setpoint(setpoint);
        bench.set(bumpless_on_off::PV, plant.output());
        pv.push(plant.output());
        let u = bench.step(dt_s).unwrap()[0];
        out.push(u);
        plant.advance(u);
    }
    json!({
        "law": "on-off", "name": format!("on-off {n}"), "parameters": parameters(&given), "dt": dt_s, "setpoint": setpoint,
        "plant": {"gain": gain, "lags": [0.0, lag], "delay": delay_s}, "pv": pv, "out": out,
    })
}

/// On a signal, with shortest times, mirrored.
fn on_off_alone(draw: &mut Draw, n: u32) -> Value {
    let dt_s = draw.on_grid(0.1, 1.0, 0.1);
    let given = vec![
        ("hysteresis", draw.between(1.0, 4.0)),
        ("on-value", 80.0),
        ("off-value", 20.0),
        ("action", f64::from(n % 2)),
        ("on-min", draw.between(1.0, 6.0)),
        ("off-min", draw.between(1.0, 6.0)),
    ];
    let mut bench = Bench::<OnOff>::start(&given, &[20.0]).unwrap();
    bench.set_setpoint(50.0);
    let pv = wander(draw, 50.0, 2.0, 8.0, 600);
    let out: Vec<f64> = pv
        .iter()
        .map(|value| {
            bench.set(bumpless_on_off::PV, *value);
            bench.step(dt_s).unwrap()[0]
        })
        .collect();
    json!({
        "law": "on-off", "name": format!("on-off {n}"), "parameters": parameters(&given), "dt": dt_s, "setpoint": 50.0, "pv": pv,
        "out": out,
    })
}
