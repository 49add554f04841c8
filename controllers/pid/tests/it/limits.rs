//! What holds for any numbers: outputs are finite and within their limits, states decode, damage is a fault.

use bumpless_isa::table::{BYPASS_ON, OUT, PARAMETERS, PV};
use bumpless_pid::Pid;
use bumpless_sdk::{Mode, bench::Bench};
use proptest::prelude::*;

/// Any value of each parameter's range that an engineer could mean, with limits in order.
fn parameters() -> impl Strategy<Value = Vec<(&'static str, f64)>> {
    let rows: Vec<_> = PARAMETERS
        .iter()
        .map(|p| {
            let (low, high) = (p.minimum.max(-1e4), p.maximum.min(1e4));
            prop_oneof![Just(p.default), Just(low), low..=high]
                .prop_map(move |value| (p.name, value))
                .boxed()
        })
        .collect();
    rows.prop_map(|mut values| {
        let at = |values: &[(&str, f64)], name| values.iter().position(|(n, _)| *n == name).expect("is in the table");
        for (low, high) in [("out-low", "out-high"), ("sp-low", "sp-high"), ("arw-low", "arw-high")] {
            let (low, high) = (at(&values, low), at(&values, high));
            if values[low].1 >= values[high].1 {
                values[high].1 = values[low].1 + 1.0;
            }
        }
        // A parallel form without a gain has no standard one.
        let k = at(&values, "k");
        values[k].1 = values[k].1.max(1e-3);
        values
    })
}

#[derive(Debug, Clone)]
struct Moment {
    pv: f64,
    setpoint: f64,
    dt_s: f64,
    manual: bool,
    bypass: bool,
    held: Option<f64>,
}

fn moments() -> impl Strategy<Value = Vec<Moment>> {
    let moment = (
        -1e5..1e5f64,
        -1e5..1e5f64,
        1e-3..100.0f64,
        prop::bool::weighted(0.1),
        prop::bool::weighted(0.1),
        prop::option::weighted(0.2, -1e4..1e4f64),
    )
        .prop_map(|(pv, setpoint, dt_s, manual, bypass, held)| Moment {
            pv,
            setpoint,
            dt_s,
            manual,
            bypass,
            held,
        });
    prop::collection::vec(moment, 1..80)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn outputs_are_finite_and_within_their_limits(parameters in parameters(), moments in moments(), track in -1e4..1e4f64) {
        let value = |name| parameters.iter().find(|(n, _)| *n == name).expect("is in the table").1;
        let (low, high) = (value("out-low"), value("out-high"));
        let mut bench = Bench::<Pid>::start(&parameters, &[track]).expect("starts");
        for m in moments {
            bench.set(PV, m.pv);
            bench.set_setpoint(m.setpoint);
            bench.set(BYPASS_ON, f64::from(u8::from(m.bypass)));
            bench.set_mode(if m.manual { Mode::Manual } else { Mode::Automatic });
            if let Some(held) = m.held {
                bench.hold(OUT, held);
            }
            bench.step(m.dt_s).expect("steps");
            let wanted = bench.wanted()[0];
            prop_assert!(wanted.is_finite());
            prop_assert!(m.manual || (low..=high).contains(&wanted), "{wanted} is not within {low} to {high}");
        }
    }

    #[test]
    fn a_step_is_the_same_every_time(parameters in parameters(), moments in moments()) {
        let mut benches = [Bench::<Pid>::start(&parameters, &[10.0]).expect("starts"), Bench::<Pid>::start(&parameters, &[10.0]).expect("starts")];
        for m in moments {
            for bench in &mut benches {
                bench.set(PV, m.pv);
                bench.set_setpoint(m.setpoint);
                bench.step(m.dt_s).expect("steps");
            }
            prop_assert_eq!(benches[0].state(), benches[1].state());
        }
    }

    #[test]
    fn a_damaged_state_is_a_fault_or_a_state_never_a_panic(cut in 0usize..450, at in 0usize..450, byte: u8) {
        let mut bench = Bench::<Pid>::start(&[], &[10.0]).expect("starts");
        bench.set(PV, 1.0);
        let mut state = bench.state().to_vec();
        let length = state.len();
        if let Some(slot) = state.get_mut(at) {
            *slot = byte;
        }
        state.truncate(cut);
        bench.set_state(state);
        let stepped = bench.step(0.1);
        prop_assert!(cut >= length || stepped.is_err(), "a shortened state cannot be whole");
    }
}
