//! A chain of loops in different components: two and three `pid`s that speak by points and messages only, as loops of a cell do.
//!
//! ```text
//!   top ── out ──► point ──► middle ── out ──► point ──► bottom ── out ──► actuator
//!    ▲── "bkcal-2" ───────────┘  ▲── "bkcal-1" ───────────┘                       messages arrive with the next cycle
//! ```

use bumpless_isa::{
    chain::{INITIALISE, NO_FALL, NO_RISE, Report},
    table::{OUT, PV, REMOTE_ON, REMOTE_SP},
};
use bumpless_pid::Pid;
use bumpless_sdk::{Mode, bench::Bench};

const DT_S: f64 = 0.1;

/// A flow loop under a level loop, each a component; the flow of 0.5 s and 1 per output, the level of 10 s and 1 per flow.
struct Chain {
    above: Bench<Pid>,
    below: Bench<Pid>,
    flow: f64,
    level: f64,
    /// What the point between them holds.
    point: f64,
    out: f64,
}

impl Chain {
    fn start(below: &[(&str, f64)]) -> Self {
        let above = [("k", 3.0), ("ti", 8.0), ("out-high", 100.0), ("bkcal-in", 1.0)];
        let mut given = vec![("k", 1.0), ("ti", 1.0), ("bkcal-out", 1.0)];
        given.extend_from_slice(below);
        let mut chain = Self {
            above: Bench::start(&above, &[0.0]).unwrap(),
            below: Bench::start(&given, &[30.0]).unwrap(),
            flow: 30.0,
            level: 30.0,
            point: 0.0,
            out: 30.0,
        };
        chain.above.set_setpoint(30.0);
        chain.below.set_setpoint(30.0);
        chain.below.set(REMOTE_ON, 0.0);
        chain
    }

    fn step(&mut self) -> Option<Report> {
        self.above.set(PV, self.level);
        self.point = self.above.step(DT_S).unwrap()[0];
        self.below.set(PV, self.flow);
        self.below.set(REMOTE_SP, self.point);
        self.out = self.below.step(DT_S).unwrap()[0];
        let mut report = None;
        for (topic, data) in self.below.desk().published.clone() {
            report = Report::decode(&data);
            self.above.send(&topic, &data);
        }
        self.flow += (self.out - self.flow) * DT_S / 0.5;
        self.level += (self.flow - self.level) * DT_S / 10.0;
        report
    }

    fn run(&mut self, steps: u32) -> Option<Report> {
        (0..steps).fold(None, |_, _| self.step())
    }
}

#[test]
fn the_loop_above_follows_until_the_one_below_takes_it_and_nothing_bumps() {
    let mut chain = Chain::start(&[]);
    assert_eq!(chain.step().map(|r| r.has(INITIALISE)), Some(true));
    chain.run(20);
    assert!(
        (chain.point - 30.0).abs() < 1e-9,
        "it follows the setpoint below: {}",
        chain.point
    );
    chain.below.set(REMOTE_ON, 1.0);
    let before = chain.out;
    assert_eq!(chain.step().map(|r| r.has(INITIALISE)), Some(false));
    chain.run(5);
    assert!((chain.out - before).abs() < 1e-6, "{before} and {}", chain.out);
    chain.above.set_setpoint(45.0);
    chain.run(1500);
    assert!(
        (chain.level - 45.0).abs() < 0.01,
        "the cascade is closed: {}",
        chain.level
    );
    // A hand at the loop below: the one above follows its setpoint, and both come back without a bump.
    chain.below.set_mode(Mode::Manual);
    chain.below.hold(OUT, 60.0);
    chain.run(300);
    assert!(chain.level > 55.0);
    let left = chain.point;
    chain.below.set_mode(Mode::Automatic);
    chain.run(1);
    assert_eq!(chain.out, 60.0, "where the hand left it");
    chain.run(2);
    assert!(
        (chain.point - left).abs() < 1.0,
        "no windup above: {left} and {}",
        chain.point
    );
}

#[test]
fn a_loop_below_at_its_limit_stops_the_integral_above_with_a_band() {
    let mut chain = Chain::start(&[("out-high", 50.0), ("bkcal-band", 4.0)]);
    chain.below.set(REMOTE_ON, 1.0);
    chain.run(10);
    chain.above.set_setpoint(90.0);
    let report = chain.run(600).unwrap();
    assert!(report.has(NO_RISE) && !report.has(NO_FALL), "{report:?}");
    let wound = chain.point;
    chain.run(3000);
    assert!(
        chain.point < wound + 5.0,
        "the integral stands: {wound} and {}",
        chain.point
    );
    // Within 4 % of 50 of the limit it is still reported, beyond that no more: the output is seen on its way down.
    let mut flags = Vec::new();
    for i in 0..5000 {
        chain.above.set_setpoint((90.0 - 0.02 * f64::from(i)).max(40.0));
        let report = chain.step().unwrap();
        flags.push((chain.out, report.has(NO_RISE)));
    }
    let band = |(out, told): &(f64, bool)| *out < 50.0 && *out > 48.0 && *told;
    assert!(flags.iter().any(band), "the band holds it");
    assert!(flags.iter().all(|(out, told)| *out > 48.0 || !*told), "and lets it go");
    chain.run(1500);
    assert!((chain.level - 40.0).abs() < 0.05, "{}", chain.level);
}

#[test]
fn a_loop_above_holds_while_it_hears_nothing_and_its_measurement_may_be_what_is_reported() {
    let mut chain = Chain::start(&[("bkcal-value", 1.0)]);
    chain.below.set(REMOTE_ON, 1.0);
    chain.above.set_setpoint(60.0);
    chain.above.set(PV, 30.0);
    for _ in 0..20 {
        assert_eq!(chain.above.step(DT_S).unwrap(), [0.0], "nothing is heard");
    }
    let report = chain.run(3).unwrap();
    assert!(
        (report.value - chain.flow).abs() < 2.0 && report.value != 30.0,
        "{report:?}, flow {}",
        chain.flow
    );
    let moved = chain.point;
    assert!(moved > 0.0, "it goes on: {moved}");
    // Lost messages do not matter for some cycles, silence does.
    for i in 0..200 {
        let out = chain.above.step(DT_S).unwrap()[0];
        if i > 52 {
            assert_eq!(out, chain.above.wanted()[0]);
        }
    }
    let still = chain.above.step(DT_S).unwrap()[0];
    assert_eq!(chain.above.step(DT_S).unwrap()[0], still, "silence: the output holds");
}

#[test]
fn in_a_chain_of_three_a_hand_at_the_bottom_is_felt_at_the_top() {
    let link = |k: f64, numbers: &[(&'static str, f64)]| {
        let mut given = vec![("k", k), ("ti", 4.0)];
        given.extend_from_slice(numbers);
        Bench::<Pid>::start(&given, &[20.0]).unwrap()
    };
    let mut benches = [
        link(1.0, &[("bkcal-in", 2.0)]),
        link(1.0, &[("bkcal-in", 1.0), ("bkcal-out", 2.0)]),
        link(1.0, &[("bkcal-out", 1.0)]),
    ];
    for bench in &mut benches {
        bench.set(PV, 20.0);
        bench.set_setpoint(20.0);
    }
    let [_, middle, bottom] = &mut benches;
    middle.set(REMOTE_ON, 1.0);
    bottom.set(REMOTE_ON, 1.0);
    let mut run = |manual: bool, steps: u32| {
        let mut flags = [None; 2];
        for _ in 0..steps {
            let mut passed = None;
            for i in 0..3 {
                if let Some(setpoint) = passed {
                    benches[i].set(REMOTE_SP, setpoint);
                }
                if i == 2 {
                    benches[i].set_mode(if manual { Mode::Manual } else { Mode::Automatic });
                }
                passed = Some(benches[i].step(DT_S).unwrap()[0]);
                for (topic, data) in benches[i].desk().published.clone() {
                    flags[i - 1] = Report::decode(&data).map(|r| r.has(INITIALISE));
                    benches[i - 1].send(&topic, &data);
                }
            }
        }
        flags
    };
    assert_eq!(run(false, 30), [Some(false), Some(false)], "all three are one cascade");
    assert_eq!(run(true, 5), [Some(true), Some(true)], "IMan climbs the chain");
    assert_eq!(run(false, 5), [Some(false), Some(false)], "and leaves it again");
}
