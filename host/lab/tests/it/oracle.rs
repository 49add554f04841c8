//! Numbers that are known otherwise: seven processes under PI, IE = Ti/K, PIDPlus = PID without losses.

use crate::setup::{figure, run};

/// A process under PI and what it gives for a unit step of the setpoint and of the load, in continuous time.
struct Known {
    plant: &'static str,
    k: f64,
    ti: f64,
    /// IAE, TV, peak.
    setpoint: [f64; 3],
    load: [f64; 3],
    ms: f64,
    /// Period as a part of the process's unit of time, and length of a run in that unit.
    step: f64,
    duration: f64,
}

const KNOWN: [Known; 7] = [
    Known {
        plant: "lags_s = [1, 0.2]",
        k: 5.5,
        ti: 0.8,
        setpoint: [0.357, 12.66, 1.230],
        load: [0.1455, f64::NAN, 0.154],
        ms: 1.560,
        step: 2.5e-4,
        duration: 12.0,
    },
    Known {
        plant: "lags_s = [1], dead_time_s = 1",
        k: 0.5,
        ti: 1.0,
        setpoint: [2.169, 1.26, 1.041],
        load: [2.035, f64::NAN, 0.724],
        ms: 1.590,
        step: 1e-3,
        duration: 20.0,
    },
    Known {
        plant: "lags_s = [4], dead_time_s = 1",
        k: 2.0,
        ti: 4.0,
        setpoint: [2.169, 4.12, 1.041],
        load: [2.000, f64::NAN, 0.343],
        ms: 1.590,
        step: 1e-3,
        duration: 50.0,
    },
    Known {
        plant: "lags_s = [0.1], dead_time_s = 1",
        k: 0.05,
        ti: 0.1,
        setpoint: [2.169, 1.09, 1.041],
        load: [2.168, f64::NAN, 1.000],
        ms: 1.590,
        // A sampled reset is longer by half a period: 0.1 % of so short a reset time.
        step: 2e-4,
        duration: 20.0,
    },
    Known {
        plant: "lags_s = [1, 1, 1, 1]",
        k: 0.3,
        ti: 1.5,
        setpoint: [5.589, 1.15, 1.049],
        load: [5.400, f64::NAN, 0.713],
        ms: 1.463,
        step: 2e-3,
        duration: 60.0,
    },
    Known {
        plant: "lags_s = [1, 1, 1], leads_s = [-1]",
        k: 0.3,
        ti: 1.5,
        setpoint: [5.405, 1.12, 1.039],
        load: [5.506, f64::NAN, 0.828],
        ms: 1.572,
        step: 2e-3,
        duration: 60.0,
    },
    Known {
        plant: "lags_s = [], integrators = 1, dead_time_s = 1",
        k: 0.5,
        ti: 8.0,
        setpoint: [3.922, 1.22, 1.277],
        load: [16.00, f64::NAN, 1.961],
        ms: 1.704,
        step: 2e-3,
        duration: 120.0,
    },
];

/// Both experiments in the process's own time times `scale`, so that the period is what a loop may have.
fn text(known: &Known, component: &str) -> String {
    // A period of 1 ms and more.
    let scale = (1e-3 / known.step).max(1.0);
    let period_ms = known.step * scale * 1e3;
    let plant = known
        .plant
        .split_inclusive([',', '[', ']', ' '])
        .map(|part| {
            let end = part.len() - usize::from(part.ends_with([',', ']', '[', ' ']));
            match part[..end].parse::<f64>() {
                Ok(number)
                    if !known.plant.contains(&format!("integrators = {}", &part[..end]))
                        || part[..end].contains('.') =>
                {
                    format!("{}{}", number * scale, &part[end..])
                }
                _ => part.to_owned(),
            }
        })
        .collect::<String>();
    // The integrating process has its dead time in the unit of time, and its gain per unit of time.
    let (plant, gain) = if known.plant.contains("integrators") {
        (
            format!("lags_s = [], integrators = 1, dead_time_s = {scale}"),
            1.0 / scale,
        )
    } else {
        (plant, 1.0)
    };
    let (step_s, duration_s) = (10.0 * period_ms * 1e-3, known.duration * scale);
    format!(
        r#"
name = "oracle"
duration_s = {end}
plant = {{ model = "linear", linear = {{ gain = {gain}, {plant} }} }}
controller = {{ component = "{component}", parameters = {{ k = {k}, ti = {ti}, out-low = -1e9, out-high = 1e9 }} }}
measure = {{ rule = "trapezoid", from_s = {step_s} }}
[[loop]]
name = "l"
ports = {{ pv = "pv", out = "out" }}
period_ms = {period_ms}
setpoint = [{{ at_s = 0, to = 0 }}]
[[case]]
name = "setpoint"
set = {{ "loop.l.setpoint" = [{{ at_s = 0, to = 0 }}, {{ at_s = {step_s}, to = 1 }}] }}
[[case]]
name = "load"
set = {{ disturbance = [{{ at_s = {step_s}, signal = "load", to = 1 }}] }}
"#,
        end = duration_s + step_s,
        k = known.k,
        ti = known.ti * scale,
    )
}

#[test]
fn pi_on_seven_processes_gives_the_known_figures() {
    for known in &KNOWN {
        let outcome = run(&text(known, "pid"));
        let scale = (1e-3 / known.step).max(1.0);
        let near = |what: &str, got: f64, expected: f64, percent: f64| {
            // The table's own rounding comes on top: two decimals for TV, three for the others.
            let rounding = if what.ends_with("TV") { 0.005 } else { 0.0005 };
            let allowed = expected.abs() * percent / 100.0 + rounding;
            assert!(
                (got - expected).abs() <= allowed,
                "{}: {what} = {got}, not {expected}",
                known.plant
            );
        };
        let setpoint = |key| figure(&outcome, "setpoint", &[], key);
        let load = |key| figure(&outcome, "load", &[], key);
        near("setpoint IAE", setpoint("iae") / scale, known.setpoint[0], 0.5);
        near("setpoint TV", setpoint("tv"), known.setpoint[1], 0.5);
        near(
            "setpoint peak",
            1.0 + setpoint("overshoot") / 100.0,
            known.setpoint[2],
            0.5,
        );
        near("load IAE", load("iae") / scale, known.load[0], 0.5);
        near("load peak", load("peak"), known.load[2], 0.5);
        near("load IE", -load("ie") / scale, known.ti / known.k, 0.1);
        near("Ms", load("ms"), known.ms, 0.5);
    }
}

#[test]
fn pidplus_is_pid_to_the_last_bit_when_every_sample_arrives() {
    let known = &KNOWN[1];
    let (pid, plus) = (run(&text(known, "pid")), run(&text(known, "pidplus")));
    for (a, b) in pid.variants.iter().zip(&plus.variants) {
        assert_eq!(a.runs[0].loops, b.runs[0].loops);
        assert!(a.runs[0].loops[0].trace.len() > 1000);
    }
}
