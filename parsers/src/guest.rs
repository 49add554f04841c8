//! What components are, and what their states are.
//!
//! Never: the compiling child; a fuzzer's inputs are small, and what a large one costs is the child's bound to keep.

#![allow(clippy::expect_used, reason = "a target shows a fault by a panic")]

use std::{cell::OnceCell, time::Duration};

use bumpless_engine::{Compile, Config, Engine, Limits};
use bumpless_sdk::{Controller, Direction, Origin, envelope::Envelope, glue};

thread_local! {
    /// One for all inputs: it is dear to make.
    static ENGINE: OnceCell<Engine> = const { OnceCell::new() };
}

fn engine() -> Engine {
    let limits = Limits {
        // Inputs that spin say nothing for longer than they must.
        describe_time_max: Duration::from_millis(20),
        memory_bytes_max: 1024 * 1024,
        ..Limits::default()
    };
    let config = Config {
        instances_max: 4,
        compile: Compile::InProcess,
        limits,
        ..Config::default()
    };
    Engine::new(config).expect("an engine")
}

/// A component, as an upload is looked at: its form, its imports and exports, what it says of itself. Nothing of it is stepped.
pub(crate) fn component(bytes: &[u8]) {
    ENGINE.with(|slot| {
        let engine = slot.get_or_init(engine);
        let found = engine.inspect(bytes);
        if let Err(error) = &found {
            assert!(!error.to_string().is_empty());
        }
        let _plant = engine.open_plant(bytes);
    });
}

/// A law, by what is done with its states.
struct Law {
    name: &'static str,
    version: &'static str,
    layout: u32,
    /// A state of its own, to be damaged.
    own: fn() -> Vec<u8>,
    /// Takes a state over.
    take: fn(&Origin<'_>) -> Option<Vec<u8>>,
}

fn defaults<C: Controller>() -> (Vec<f64>, Vec<f64>) {
    let description = &C::DESCRIPTION;
    let outputs = description.ports.iter().filter(|p| p.direction == Direction::Output);
    (
        description.parameters.iter().map(|p| p.default).collect(),
        outputs.map(|_| 0.0).collect(),
    )
}

fn own<C: Controller>() -> Vec<u8> {
    let (parameters, track) = defaults::<C>();
    glue::start::<C>(&parameters, &track).unwrap_or_default()
}

fn take<C: Controller>(from: &Origin<'_>) -> Option<Vec<u8>> {
    let (parameters, track) = defaults::<C>();
    let taken = glue::migrate::<C>(from, &parameters, &track).ok()?;
    let envelope = Envelope::parse(&taken).expect("what a law made of a state is a state");
    assert!(envelope.is_of(&C::DESCRIPTION));
    envelope.law::<C::State>().expect("and its own");
    Some(taken)
}

const fn law<C: Controller>() -> Law {
    Law {
        name: C::DESCRIPTION.name,
        version: C::DESCRIPTION.version,
        layout: C::DESCRIPTION.state_layout,
        own: own::<C>,
        take: take::<C>,
    }
}

const LAWS: [Law; 15] = [
    law::<bumpless_pid::Pid>(),
    law::<bumpless_pidplus::PidPlus>(),
    law::<bumpless_on_off::OnOff>(),
    law::<bumpless_cascade::TwoLoops>(),
    law::<bumpless_autotune::Autotune>(),
    law::<bumpless_feedforward::Feedforward>(),
    law::<bumpless_fuzzy::Fuzzy>(),
    law::<bumpless_gain_schedule::GainSchedule>(),
    law::<bumpless_kalman_pid::KalmanPid>(),
    law::<bumpless_lead_lag::LeadLagBlock>(),
    law::<bumpless_mpc::Mpc>(),
    law::<bumpless_override_selector::OverrideSelector>(),
    law::<bumpless_ratio::Ratio>(),
    law::<bumpless_smith::Smith>(),
    law::<bumpless_split_range::SplitRange>(),
];

/// Two bytes say from which law to which; the rest is the state, or, where the third byte is odd, what stands in a good state in the
/// place of the law's own part.
pub(crate) fn state(bytes: &[u8]) {
    let [from, to, whole, rest @ ..] = bytes else { return };
    let of = |number: &u8| LAWS.get(usize::from(*number) % LAWS.len()).expect("a law");
    let (from, to) = (of(from), of(to));
    let damaged = if whole % 2 == 1 {
        let good = (from.own)();
        let front = Envelope::parse(&good).map_or(0, |envelope| good.len() - envelope.law.len());
        [good.get(..front).unwrap_or_default(), rest].concat()
    } else {
        rest.to_vec()
    };
    let origin = |bytes| Origin {
        name: from.name,
        version: from.version,
        state_layout: from.layout,
        bytes,
    };
    let _declined = (to.take)(&origin(&damaged));
    let _retuned = (from.take)(&origin(&damaged));
}
