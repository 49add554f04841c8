//! Numbers that are known otherwise: seven processes under PI, IE = Ti/K, PIDPlus = PID without losses.
//!
//! The rows come from `tests/peers/oracle.py`, with a digit more than the tolerances need.

use crate::setup::{figure, run};

/// A process under PI and what it gives for a unit step of the setpoint and of the load, in continuous time.
struct Known {
    plant: &'static str,
    k: f64,
    ti: f64,
    /// IAE, TV, peak.
    setpoint: [f64; 3],
    /// IAE, peak; IE is Ti/K.
    load: [f64; 2],
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
        setpoint: [0.35695, 12.6599, 1.22997],
        load: [0.145455, 0.153540],
        ms: 1.56018,
        step: 2.5e-4,
        duration: 12.0,
    },
    Known {
        plant: "lags_s = [1], dead_time_s = 1",
        k: 0.5,
        ti: 1.0,
        setpoint: [2.16869, 1.2602, 1.04052],
        load: [2.034997, 0.724278],
        ms: 1.59049,
        step: 1e-3,
        duration: 20.0,
    },
    Known {
        plant: "lags_s = [4], dead_time_s = 1",
        k: 2.0,
        ti: 4.0,
        setpoint: [2.16869, 4.1187, 1.04052],
        load: [1.999999, 0.342620],
        ms: 1.59049,
        step: 1e-3,
        duration: 50.0,
    },
    Known {
        plant: "lags_s = [0.1], dead_time_s = 1",
        k: 0.05,
        ti: 0.1,
        setpoint: [2.16869, 1.0849, 1.04052],
        load: [2.167546, 0.999955],
        ms: 1.59049,
        // A sampled reset is longer by half a period: 0.06 % of so short a reset time.
        step: 1.25e-4,
        duration: 20.0,
    },
    Known {
        plant: "lags_s = [1, 1, 1, 1]",
        k: 0.3,
        ti: 1.5,
        setpoint: [5.58913, 1.1510, 1.04851],
        load: [5.399267, 0.713100],
        ms: 1.46298,
        step: 2e-3,
        duration: 60.0,
    },
    Known {
        plant: "lags_s = [1, 1, 1], leads_s = [-1]",
        k: 0.3,
        ti: 1.5,
        setpoint: [5.40464, 1.1185, 1.03905],
        load: [5.505757, 0.827748],
        ms: 1.57153,
        step: 2e-3,
        duration: 60.0,
    },
    Known {
        plant: "lags_s = [], integrators = 1, dead_time_s = 1",
        k: 0.5,
        ti: 8.0,
        setpoint: [3.92227, 1.2176, 1.27742],
        load: [16.0, 1.961134],
        ms: 1.70352,
        step: 2e-3,
        duration: 120.0,
    },
];

/// Both experiments in the process's own time times `scale`, so that the period is what a loop may have.
fn text(known: &Known, component: &str) -> String {
    // A period of 1 ms and more.
    let scale = (1e-3 / known.step).max(1.0);
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
    let plant = format!("model = \"linear\", linear = {{ gain = {gain}, {plant} }}");
    experiment(known, component, &plant)
}

/// The experiments with a plant.
fn experiment(known: &Known, component: &str, plant: &str) -> String {
    let scale = (1e-3 / known.step).max(1.0);
    let period_ms = known.step * scale * 1e3;
    let (step_s, duration_s) = (10.0 * period_ms * 1e-3, known.duration * scale);
    format!(
        r#"
name = "oracle"
duration_s = {end}
plant = {{ {plant} }}
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
        holds(known, known.plant, &outcome);
        let ms = figure(&outcome, "load", &[], "ms");
        near(known.plant, "Ms", ms, known.ms, 0.5);
    }
}

#[test]
fn the_plants_that_are_components_give_the_known_figures_too() {
    // The dead time of `fopdt` is its output's alone: a load comes at once, and everything that follows from it a dead time
    // earlier, which no figure sees.
    for (number, plant) in [
        (1, "fopdt: tau = 1 s, dead-time = 1 s"),
        (2, "fopdt: tau = 4 s, dead-time = 1 s"),
        (3, "fopdt: tau = 0.1 s, dead-time = 1 s"),
        (6, "integrating: dead-time = 1 s"),
    ] {
        let known = &KNOWN[number];
        let scale = (1e-3 / known.step).max(1.0);
        let (name, rest) = plant.split_once(": ").unwrap();
        let constants: Vec<String> = rest
            .split(", ")
            .map(|constant| {
                let (name, seconds) = constant.split_once(" = ").unwrap();
                let seconds: f64 = seconds.trim_end_matches(" s").parse().unwrap();
                format!("{name} = {:?}", seconds * scale)
            })
            .collect();
        // Of the integrating process the gain is per unit of time.
        let gain = if name == "integrating" { 1.0 / scale } else { 1.0 };
        let constants = constants.join(", ");
        let text = format!("model = \"component:{name}\", constants = {{ gain = {gain:?}, {constants} }}");
        let outcome = run(&experiment(known, "pid", &text));
        holds(known, plant, &outcome);
    }
}

#[track_caller]
fn near(plant: &str, what: &str, got: f64, expected: f64, percent: f64) {
    let allowed = expected.abs() * percent / 100.0;
    assert!(
        (got - expected).abs() <= allowed,
        "{plant}: {what} = {got}, not {expected}"
    );
}

/// What simulation in time gives is what the table says.
#[track_caller]
fn holds(known: &Known, plant: &str, outcome: &bumpless_lab::Outcome) {
    let scale = (1e-3 / known.step).max(1.0);
    let near = |what: &str, got: f64, expected: f64, percent: f64| near(plant, what, got, expected, percent);
    let setpoint = |key| figure(outcome, "setpoint", &[], key);
    let load = |key| figure(outcome, "load", &[], key);
    near("setpoint IAE", setpoint("iae") / scale, known.setpoint[0], 0.5);
    near("setpoint TV", setpoint("tv"), known.setpoint[1], 0.5);
    near(
        "setpoint peak",
        1.0 + setpoint("overshoot") / 100.0,
        known.setpoint[2],
        0.5,
    );
    near("load IAE", load("iae") / scale, known.load[0], 0.5);
    near("load peak", load("peak"), known.load[1], 0.5);
    near("load IE", -load("ie") / scale, known.ti / known.k, 0.1);
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
