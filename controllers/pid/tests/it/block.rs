//! What a PID block has around its law: bypass, out of service, target and actual mode, quality, anti-windup limits, the scale of
//! the feedforward; docs/laws.md has the whole table.
//!
//! Sources of the items: ISA-TR5.9-2023 and the PID block of Foundation Fieldbus.

use bumpless_isa::table::{BYPASS_ON, FF, NO_FALL, NO_RISE, OOS, OUT, PV, REMOTE_ON, REMOTE_SP, TRACK, TRACK_ON};
use bumpless_pid::Pid;
use bumpless_sdk::{
    Mode, Quality, Reading,
    bench::{Bench, bad, good},
    prelude::*,
};

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

fn uncertain(value: f64) -> Reading {
    Reading {
        quality: Quality::Uncertain,
        ..good(value)
    }
}

/// Names of the alarms that the last step raised (on) or cleared.
fn told(bench: &Bench<Pid>) -> Vec<(String, bool)> {
    let alarms = bench.desk().alarms.iter();
    alarms.map(|(name, raised)| (name.clone(), raised.is_some())).collect()
}

fn list(names: &[(&str, bool)]) -> Vec<(String, bool)> {
    names.iter().map(|(n, r)| ((*n).to_owned(), *r)).collect()
}

#[test]
fn bypass_sends_the_setpoint_through_and_comes_and_goes_without_a_bump() {
    let scale = [
        ("sp-low", 0.0),
        ("sp-high", 200.0),
        ("out-low", 0.0),
        ("out-high", 100.0),
    ];
    let mut given = scale.to_vec();
    given.extend([("k", 2.0), ("ti", 5.0), ("balance-time", 2.0)]);
    let mut bench = start(&given);
    let before = at(&mut bench, 50.0, 50.0);
    bench.set(BYPASS_ON, 1.0);
    assert_eq!(at(&mut bench, 50.0, 50.0), before, "first where it is");
    // 50 of 0 to 200 is 25 of 0 to 100, which it goes to with the balance time.
    for i in 1..100 {
        let expected = 25.0 + 15.0 * (-f64::from(i) * DT_S / 2.0).exp();
        let out = at(&mut bench, 50.0 + f64::from(i), 50.0);
        assert!((out - expected).abs() < 1e-9, "{i}: {out}, whatever is measured");
    }
    let step = at(&mut bench, 50.0, 150.0) - at(&mut bench, 50.0, 150.0);
    assert!(step.abs() < 0.2);
    assert!(
        (at(&mut bench, 50.0, 150.0) - 75.0).abs() < 0.2,
        "the setpoint goes through at once"
    );
    // Without a measurement it goes on: that is what it is for.
    bench.set_reading(PV, Some(bad(50.0)));
    let blind = bench.step(DT_S).unwrap()[0];
    assert!((blind - 75.0).abs() < 0.2, "{blind}");
    bench
        .retune(&[
            ("k", 1.0),
            ("ti", 5.0),
            ("balance-time", 2.0),
            ("sp-low", 0.0),
            ("sp-high", 300.0),
        ])
        .unwrap();
    let retuned = bench.step(DT_S).unwrap()[0];
    assert!((retuned - blind).abs() < 2.0, "{retuned}");
    bench.set(BYPASS_ON, 0.0);
    let held = bench.step(DT_S);
    assert!(
        matches!(held, Err(Fault::BadInput(_))),
        "and without bypass it does not"
    );
    assert_eq!(at(&mut bench, 170.0, 150.0), retuned, "back from where it is");
    let next = at(&mut bench, 170.0, 150.0);
    assert!((next - retuned).abs() < 1.0, "{next}");
    // A setpoint without limits is the output itself, within the output's limits.
    let mut bench = start(&[("balance-time", 0.0)]);
    bench.set(BYPASS_ON, 1.0);
    at(&mut bench, 50.0, 130.0);
    assert_eq!(at(&mut bench, 50.0, 130.0), 100.0);
}

#[test]
fn a_block_out_of_service_stays_says_so_and_comes_back_from_where_it_is() {
    let mut bench = start(&[("k", 2.0), ("ti", 5.0), ("hi", 60.0), ("tell", 1.0)]);
    at(&mut bench, 61.0, 50.0);
    assert_eq!(told(&bench), list(&[("hi", true)]));
    bench.set(OOS, 1.0);
    bench.hold(OUT, 33.0);
    assert_eq!(at(&mut bench, 90.0, 50.0), 33.0);
    assert_eq!(
        told(&bench),
        list(&[("hi", false), ("mode", true)]),
        "it looks at nothing"
    );
    bench.set_reading(PV, Some(bad(0.0)));
    assert_eq!(
        bench.step(DT_S).unwrap(),
        [33.0],
        "not even at a measurement that fails"
    );
    bench.set(OOS, 0.0);
    assert_eq!(at(&mut bench, 70.0, 50.0), 33.0);
    assert_eq!(told(&bench), list(&[("hi", true), ("mode", false)]));
    assert!(at(&mut bench, 70.0, 50.0) < 33.0);
}

#[test]
fn the_actual_mode_is_told_where_it_is_not_the_target() {
    let mut bench = start(&[("tell", 1.0)]);
    let say = |bench: &mut Bench<Pid>| {
        at(bench, 50.0, 50.0);
        bench.desk().alarms.clone()
    };
    assert_eq!(say(&mut bench), [], "Auto, as wanted");
    bench.set(TRACK, 20.0);
    bench.set(TRACK_ON, 1.0);
    let told = say(&mut bench);
    assert_eq!(told[0].0, "mode");
    assert!(told[0].1.as_ref().unwrap().1.contains("(LO)"), "{told:?}");
    assert_eq!(say(&mut bench), [], "once");
    bench.set_mode(Mode::Manual);
    assert_eq!(
        say(&mut bench),
        [("mode".to_owned(), None)],
        "Man is what the operator wants"
    );
    bench.set_mode(Mode::Automatic);
    bench.set(TRACK_ON, 0.0);
    bench.set(REMOTE_ON, 1.0);
    bench.set(REMOTE_SP, 50.0);
    assert_eq!(say(&mut bench), [], "Cas, as wanted");
    bench.set_reading(REMOTE_SP, Some(bad(50.0)));
    let told = say(&mut bench);
    assert!(
        told[0].1.as_ref().unwrap().1.contains("Auto instead of Cas"),
        "{told:?}"
    );
    bench.retune(&[]).unwrap();
    assert_eq!(say(&mut bench), [("mode".to_owned(), None)], "nothing more is told");
}

#[test]
fn a_measurement_at_the_end_of_its_range_is_used_held_or_refused() {
    // The host gives uncertain quality to a value beyond its instrument's range: there the measurement does not move any more.
    let next = |choice: f64| {
        let mut bench = start(&[("k", 1.0), ("ti", 5.0), ("on-uncertain", choice)]);
        bench.set_reading(PV, Some(uncertain(48.0)));
        bench.set_setpoint(50.0);
        (1..50).fold(bench.step(DT_S), |_, _| bench.step(DT_S))
    };
    let used = next(0.0).unwrap()[0];
    assert!((used - 44.0).abs() < 0.1, "as good: {used}");
    assert!(
        (next(1.0).unwrap()[0] - 42.0).abs() < 1e-9,
        "P alone: the integral does not live on it"
    );
    assert!(
        matches!(next(2.0), Err(Fault::BadInput(_))),
        "as bad: the policy decides, for example to go to manual"
    );
}

#[test]
fn doubtful_inputs_are_told() {
    let mut bench = start(&[("tell", 2.0)]);
    bench.set(FF, 1.0);
    let mut say = |pv: Reading, ff: Reading| {
        bench.set_reading(PV, Some(pv));
        bench.set_reading(FF, Some(ff));
        bench.step(DT_S).unwrap();
        told(&bench)
    };
    assert_eq!(say(good(50.0), good(1.0)), []);
    assert_eq!(say(uncertain(50.0), good(1.0)), list(&[("quality", true)]));
    assert_eq!(say(good(50.0), bad(1.0)), [], "another input, and still doubtful");
    assert_eq!(say(good(50.0), good(1.0)), list(&[("quality", false)]));
}

#[test]
fn anti_windup_limits_stop_the_integral_before_the_output_ends() {
    let mut bench = start(&[("k", 1.0), ("ti", 2.0), ("arw-low", 20.0), ("arw-high", 60.0)]);
    let risen = (0..400).fold(0.0, |_, _| at(&mut bench, 45.0, 50.0));
    // One step of the integral at most beyond the limit: 5 · (1 − e^(−0.1/2)).
    assert!((60.0..60.3).contains(&risen), "{risen}");
    let more = at(&mut bench, 35.0, 50.0);
    assert!((more - risen - 10.0).abs() < 1e-9, "P still acts beyond it: {more}");
    let back = at(&mut bench, 51.0, 50.0);
    assert!(back < risen - 5.0, "and the way back is free: {back}");
    let fallen = (0..800).fold(0.0, |_, _| at(&mut bench, 55.0, 50.0));
    assert!((19.7..=20.0).contains(&fallen), "{fallen}");
    let refused = Bench::<Pid>::start(&[("arw-low", 60.0), ("arw-high", 60.0)], &[0.0]).unwrap_err();
    assert!(matches!(refused, Fault::BadParameter(text) if text.contains("arw-low")));
}

#[test]
fn an_integral_that_is_barred_one_way_goes_the_other() {
    for (port, up) in [(NO_RISE, true), (NO_FALL, false)] {
        let mut bench = start(&[("k", 1.0), ("ti", 5.0)]);
        bench.set(port, 1.0);
        let (useless, useful) = if up { (48.0, 52.0) } else { (52.0, 48.0) };
        let still = (0..50).fold(0.0, |_, _| at(&mut bench, useless, 50.0));
        assert!((still - 40.0 - (50.0 - useless)).abs() < 1e-9, "{still}: P alone");
        let moved = (0..50).fold(0.0, |_, _| at(&mut bench, useful, 50.0));
        assert!((moved - 40.0).abs() > 3.0, "{moved}");
    }
}

#[test]
fn the_feedforward_has_a_scale_of_its_own() {
    // 0 to 20 of a flow over 0 to 50 of the output, gain 0.8: 2 out per unit of flow.
    let given = [
        ("ff-span", 20.0),
        ("ff-gain", 0.8),
        ("out-high", 50.0),
        ("ti", 0.0),
        ("bias", 40.0),
    ];
    let mut bench = Bench::<Pid>::start(&given, &[40.0]).unwrap();
    bench.set(FF, 5.0);
    assert_eq!(at(&mut bench, 50.0, 50.0), 40.0);
    bench.set(FF, 6.0);
    let moved = at(&mut bench, 50.0, 50.0) - 40.0;
    assert!((moved - 2.0).abs() < 0.1, "{moved}");
}
