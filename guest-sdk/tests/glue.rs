//! Tests of the glue, the state's form and the bench, with a controller that remembers everything it is told.

#![allow(clippy::expect_used, clippy::unwrap_used, reason = "tests")]

use bumpless_sdk::{
    bench::{Bench, Frame, bad, good, repeated, run},
    blocks,
    envelope::Envelope,
    glue,
    prelude::*,
};
use proptest::prelude::*;
use serde::{Deserialize, Serialize};

const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "bar", "Measurement").required(),
    PortSpec::analog_output("first", "%", "First output"),
    PortSpec::digital_input("stop", "Stops it"),
    PortSpec::analog_output("second", "%", "Second output"),
];
const PARAMETERS: &[ParameterSpec] = &[
    ParameterSpec::number("gain", "", 2.0, 0.0, 10.0, "Gain"),
    ParameterSpec::choice("shape", &["flat", "steep"], "Shape"),
];
const PV: Input = Input::of(PORTS, "pv");
const STOP: Input = Input::of(PORTS, "stop");
const FIRST: Output = Output::of(PORTS, "first");
const SECOND: Output = Output::of(PORTS, "second");
const GAIN: Parameter = Parameter::of(PARAMETERS, "gain");
const SHAPE: Parameter = Parameter::of(PARAMETERS, "shape");

struct Older;
struct Newer;
struct Stranger;

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Count(u32);

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Wide {
    count: u64,
    second: f64,
    tuned: bool,
}

const fn description(name: &'static str, state_layout: u32) -> Description {
    Description {
        name,
        version: "1.2.3",
        text: "For tests",
        ports: PORTS,
        parameters: PARAMETERS,
        state_layout,
    }
}

impl Controller for Older {
    const DESCRIPTION: Description = description("counter", 1);
    type State = Count;

    fn start(_: &Parameters<'_>, _: &Track<'_>) -> Result<Count, Fault> {
        Ok(Count(0))
    }

    fn step(count: &mut Count, _: &Parameters<'_>, _: &Cycle, _: &mut Io<'_>) -> Result<(), Fault> {
        count.0 += 1;
        Ok(())
    }
}

impl Controller for Newer {
    const DESCRIPTION: Description = description("counter", 2);
    type State = Wide;

    fn start(_: &Parameters<'_>, track: &Track<'_>) -> Result<Wide, Fault> {
        Ok(Wide {
            count: 0,
            second: track.of(SECOND),
            tuned: false,
        })
    }

    fn step(state: &mut Wide, p: &Parameters<'_>, cycle: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        if io.read_usable(STOP).is_some_and(|r| r.value != 0.0) {
            return Err(Fault::failed("stopped"));
        }
        state.count += 1;
        let pv = io.read(PV);
        io.write(FIRST, p.of(GAIN) * pv.value);
        io.write(FIRST, p.of(GAIN) * pv.value + cycle.setpoint);
        io.write(
            SECOND,
            if p.choice(SHAPE) == 1 {
                f64::from(u8::from(pv.fresh))
            } else {
                io.held(SECOND).value + 1.0
            },
        );
        io.log(Level::Info, "counted");
        io.raise("high", Priority::Low, "Too high");
        io.clear("low");
        while let Some(message) = io.receive() {
            io.publish(&message.topic, &message.data);
        }
        Ok(())
    }

    fn retune(state: &mut Wide, old: &Parameters<'_>, new: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        state.tuned = old.of(GAIN) != new.of(GAIN);
        Ok(())
    }

    fn adopt(from: &Origin<'_>, _: &Parameters<'_>, track: &Track<'_>) -> Result<Option<Wide>, Fault> {
        if (from.name, from.state_layout) != ("counter", 1) {
            return Ok(None);
        }
        let Count(count) = from.open()?.law()?;
        Ok(Some(Wide {
            count: count.into(),
            second: track.of(SECOND),
            tuned: false,
        }))
    }
}

impl Controller for Stranger {
    const DESCRIPTION: Description = description("stranger", 1);
    type State = ();

    fn start(_: &Parameters<'_>, _: &Track<'_>) -> Result<(), Fault> {
        Ok(())
    }

    fn step(_: &mut (), _: &Parameters<'_>, _: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        io.write(FIRST, f64::NAN);
        Ok(())
    }
}

fn law(bench: &Bench<Newer>) -> Wide {
    Envelope::parse(bench.state())
        .expect("is whole")
        .law()
        .expect("decodes")
}

#[test]
fn the_state_has_the_documented_form() {
    let state = glue::start::<Newer>(&[2.5, 1.0], &[10.0, 20.0]).expect("starts");
    let expected = [
        &[0xB1, 7][..],
        b"counter",
        &2u32.to_le_bytes(),
        &[2],
        &2.5f64.to_le_bytes(),
        &1.0f64.to_le_bytes(),
        &[0],
        &20.0f64.to_le_bytes(),
        &[0],
    ]
    .concat();
    assert_eq!(state, expected);
}

#[test]
fn a_step_sees_the_frame_and_leaves_its_effects() {
    let mut bench = Bench::<Newer>::start(&[("gain", 3.0)], &[10.0, 20.0]).expect("starts");
    bench.set(PV, 4.0);
    bench.set_setpoint(0.5);
    bench.send("topic", b"data");
    assert_eq!(bench.step(0.1).expect("steps"), [12.5, 21.0], "the last write counts");
    assert_eq!(bench.desk().log, [(Level::Info, "counted".to_owned())]);
    assert_eq!(bench.desk().published, [("topic".to_owned(), b"data".to_vec())]);
    let raised = Some((Priority::Low, "Too high".to_owned()));
    assert_eq!(
        bench.desk().alarms,
        [("high".to_owned(), raised), ("low".to_owned(), None)]
    );
    assert_eq!(bench.step(0.1).expect("steps"), [12.5, 22.0]);
    assert!(bench.desk().published.is_empty(), "a message is received once");
    bench.set_mode(Mode::Manual);
    assert_eq!(
        bench.step(0.1).expect("steps"),
        [12.5, 22.0],
        "in manual the actuator holds"
    );
    assert_eq!(bench.wanted(), [12.5, 23.0]);
    assert_eq!(law(&bench).count, 3);
}

#[test]
fn a_fault_leaves_state_and_outputs_as_they_were() {
    let mut bench = Bench::<Newer>::start(&[], &[10.0, 20.0]).expect("starts");
    bench.set(PV, 4.0);
    bench.step(0.1).expect("steps");
    let before = bench.state().to_vec();
    bench.set(STOP, 1.0);
    assert!(matches!(bench.step(0.1), Err(Fault::Failed(text)) if text == "stopped"));
    assert_eq!(bench.state(), before);
    bench.set_reading(STOP, Some(bad(1.0)));
    bench.step(0.1).expect("a bad stop is none");
    bench.set_reading(STOP, None);
    bench.step(0.1).expect("nor is one that is not connected");
    let mut wild = Bench::<Stranger>::start(&[], &[0.0, 0.0]).expect("starts");
    assert!(
        matches!(wild.step(0.1), Err(Fault::Failed(_))),
        "NaN is a fault, as in the host"
    );
}

#[test]
fn a_list_of_frames_gives_a_list_of_outputs() {
    let frame = |pv: Reading, setpoint| Frame {
        dt_s: 0.1,
        mode: Mode::Automatic,
        setpoint,
        readings: vec![Some(pv), Some(good(1.0)), None, Some(good(7.0))],
    };
    let frames = [frame(good(1.0), 0.0), frame(repeated(2.0, 5), 1.0)];
    let outputs = run::<Newer>(&[("shape", 1.0)], &[0.0, 0.0], &frames).expect("runs");
    assert_eq!(outputs, [[2.0, 1.0], [5.0, 0.0]]);
}

#[test]
fn values_that_the_table_does_not_allow_are_refused() {
    let cases: [(&[f64], &[f64], &str); 7] = [
        (&[1.0], &[0.0, 0.0], "one value per parameter is needed"),
        (&[1.0, 0.0, 0.0], &[0.0, 0.0], "one value per parameter is needed"),
        (&[10.5, 0.0], &[0.0, 0.0], "gain is out of its range"),
        (&[1.0, f64::NAN], &[0.0, 0.0], "shape is out of its range"),
        (&[1.0, 2.0], &[0.0, 0.0], "shape is out of its range"),
        (&[1.0, 1.0], &[0.0], "track needs one finite value per output port"),
        (
            &[1.0, 1.0],
            &[0.0, f64::INFINITY],
            "track needs one finite value per output port",
        ),
    ];
    for (parameters, track, expected) in cases {
        let started = glue::start::<Newer>(parameters, track);
        assert!(
            matches!(&started, Err(Fault::BadParameter(text)) if text == expected),
            "{parameters:?} {started:?}"
        );
        let from = Origin {
            name: "counter",
            version: "1.2.3",
            state_layout: 2,
            bytes: &[],
        };
        let migrated = glue::migrate::<Newer>(&from, parameters, track);
        assert!(
            matches!(&migrated, Err(Fault::BadParameter(text)) if text == expected),
            "{parameters:?}"
        );
    }
    assert!(matches!(
        Bench::<Newer>::start(&[("speed", 1.0)], &[0.0, 0.0]),
        Err(Fault::BadParameter(_))
    ));
}

#[test]
fn parameters_change_by_retune_and_layouts_by_adopt() {
    let mut bench = Bench::<Newer>::start(&[], &[10.0, 20.0]).expect("starts");
    bench.set(PV, 4.0);
    bench.step(0.1).expect("steps");
    bench.retune(&[("gain", 5.0)]).expect("retunes");
    assert_eq!(
        law(&bench),
        Wide {
            count: 1,
            second: 20.0,
            tuned: true
        }
    );
    assert_eq!(bench.step(0.1).expect("steps")[0], 20.0, "the new gain is in force");

    let mut older = Bench::<Older>::start(&[], &[10.0, 20.0]).expect("starts");
    for _ in 0..300 {
        older.step(0.1).expect("steps");
    }
    let (newer, taken) = older.swap::<Newer>(&[]).expect("swaps");
    assert!(taken);
    assert_eq!(law(&newer).count, 300);
    let (older, taken) = newer.swap::<Older>(&[]).expect("swaps");
    assert!(!taken, "it knows no newer layout, so it starts anew");
    assert_eq!(
        Envelope::parse(older.state())
            .expect("is whole")
            .law::<Count>()
            .expect("decodes"),
        Count(0)
    );
    let (_, taken) = older.swap::<Stranger>(&[]).expect("swaps");
    assert!(!taken);
}

#[test]
fn an_origin_that_does_not_fit_its_bytes_is_declined() {
    let bytes = glue::start::<Older>(&[2.0, 0.0], &[0.0, 0.0]).expect("starts");
    let honest = Origin {
        name: "counter",
        version: "1.0.0",
        state_layout: 1,
        bytes: &bytes,
    };
    glue::migrate::<Newer>(&honest, &[2.0, 0.0], &[0.0, 0.0]).expect("adopts");
    for origin in [
        Origin {
            state_layout: 2,
            ..honest
        },
        Origin {
            name: "stranger",
            ..honest
        },
        Origin {
            bytes: &bytes[..bytes.len() - 1],
            ..honest
        },
        Origin { bytes: &[], ..honest },
    ] {
        let migrated = glue::migrate::<Newer>(&origin, &[2.0, 0.0], &[0.0, 0.0]);
        assert!(matches!(migrated, Err(Fault::BadState(_))), "{origin:?}");
    }
}

#[test]
fn the_description_arrives_whole() {
    let d = glue::describe::<Newer>();
    assert_eq!(
        (d.name.as_str(), d.version.as_str(), d.state_layout),
        ("counter", "1.2.3", 2)
    );
    let ports: Vec<_> = d
        .ports
        .iter()
        .map(|p| (p.name.as_str(), p.unit.as_str(), p.required))
        .collect();
    assert_eq!(
        ports,
        [
            ("pv", "bar", true),
            ("first", "%", false),
            ("stop", "", false),
            ("second", "%", false)
        ]
    );
    let shape = &d.parameters[1];
    assert_eq!((shape.default, shape.minimum, shape.maximum), (0.0, 0.0, 1.0));
    assert_eq!(shape.choices, ["flat", "steep"]);
}

proptest! {
    #[test]
    fn any_bytes_are_a_state_or_a_fault(bytes in prop::collection::vec(any::<u8>(), 0..80)) {
        let mut bench = Bench::<Newer>::start(&[], &[0.0, 0.0]).expect("starts");
        bench.set(PV, 1.0);
        bench.set_state(bytes.clone());
        prop_assert!(matches!(bench.step(0.1), Err(Fault::BadState(_))));
        let origin = Origin { name: "counter", version: "1.0.0", state_layout: 1, bytes: &bytes };
        prop_assert!(glue::migrate::<Newer>(&origin, &[2.0, 0.0], &[0.0, 0.0]).is_err());
    }

    #[test]
    fn blocks_keep_their_promises(
        value in -1e9..1e9f64, from in -1e3..1e3f64, width in 0.0..1e3f64, rate in 0.0..1e3f64, dt in 1e-6..1e3f64,
    ) {
        let limited = blocks::limit(value, from, from + width);
        prop_assert!((from..=from + width).contains(&limited));
        prop_assert!(blocks::limit(f64::NAN, from, from + width).is_nan());
        let reached = blocks::rate_limit(value, from, rate, dt);
        prop_assert!(rate == 0.0 || (reached - from).abs() <= rate * dt * (1.0 + 1e-9) + 1e-9);
        let banded = blocks::dead_band(value, width);
        prop_assert!(banded.abs() <= value.abs() && (value.abs() > width || banded == 0.0));
        let part = blocks::lag_part(rate, dt);
        prop_assert!((0.0..=1.0).contains(&part));
        // Two halves of a lag are the whole.
        let half = blocks::lag_part(rate, dt / 2.0);
        prop_assert!((half + (1.0 - half) * half - part).abs() < 1e-9);
        let d = blocks::derivative(from, value, width, rate, dt);
        prop_assert!(d.is_finite());
    }
}
