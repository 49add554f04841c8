//! The whole table of hostile components in one engine: each has the end that it must have, and the engine goes on.
//!
//! The limits are small here, so that a test is short; what is tested is that they hold. Valid components of random code come
//! from wasm-smith: what they do nobody knows, and nothing may come of it but a refusal, a fault or effects within bounds.

use std::{sync::Arc, time::Duration};

use arbitrary::Unstructured;
use bumpless_core::{
    Effects, Fault, Frame, Reading,
    limits::{LOG_LINES_PER_STEP_MAX, STATE_BYTES_MAX},
};
use bumpless_engine::{Engine, Error, Instance, Limits, Origin, Prepared};
use bumpless_tests::hostile::{Call, End, Guest, Hostile, Tells, componentize, table};
use proptest::{prelude::ProptestConfig, proptest};

use crate::{
    child::{engine_with, leftovers, this_binary},
    guest::{PATIENCE_NS, frame, state},
};

/// Far more than an honest call takes, short enough for dozens that take all of it.
const LIMIT_NS: u64 = 20_000_000;

fn limits() -> Limits {
    Limits {
        describe_time_max: Duration::from_millis(100),
        compile_time_max: Duration::from_secs(2),
        compile_memory_bytes_max: 512 * 1024 * 1024,
        ..Limits::default()
    }
}

/// An error with its sources, as an operator sees it.
fn words(error: &Error) -> String {
    let mut text = error.to_string();
    let mut next = std::error::Error::source(error);
    while let Some(source) = next {
        text = format!("{text}: {source}");
        next = source.source();
    }
    text
}

fn frame_for(prepared: &Prepared) -> Frame {
    Frame {
        readings: prepared
            .descriptor()
            .ports
            .iter()
            .map(|_| Reading::good(50.0, 4000))
            .collect(),
        ..frame(1.0)
    }
}

/// Nothing that a step gives is beyond what a step may give.
fn within_bounds(effects: &Effects) -> bool {
    effects.state.len() <= STATE_BYTES_MAX
        && effects.log.len() <= LOG_LINES_PER_STEP_MAX
        && effects.writes.iter().all(|(_, value)| value.is_finite())
        && effects.messages.len() <= 16
        && effects.alarms.len() <= 32
}

/// Calls the function that misbehaves, as often as it takes; the last effects where it never came to a fault.
fn misbehave(guest: &Hostile, prepared: &Arc<Prepared>, instance: &mut Instance) -> Result<Option<Effects>, Fault> {
    let descriptor = prepared.descriptor();
    let parameters: Vec<f64> = descriptor.parameters.iter().map(|p| p.default).collect();
    let track = vec![50.0; descriptor.outputs().count()];
    let mut last = instance.start(&parameters, &track, LIMIT_NS);
    if guest.call == Call::Start {
        return last.map(|_| None);
    }
    if guest.call == Call::Migrate {
        let own = Origin {
            name: descriptor.name.clone(),
            version: descriptor.version.clone(),
            state_layout: descriptor.state_layout,
        };
        let state = last.unwrap_or_default();
        return instance
            .migrate(&own, &state, &parameters, &track, LIMIT_NS)
            .map(|_| None);
    }
    let frame = frame_for(prepared);
    let mut effects = None;
    for _ in 0..guest.calls {
        let end = instance.step(&frame, &last?, LIMIT_NS)?;
        last = Ok(end.state.clone());
        effects = Some(end);
    }
    Ok(effects)
}

/// What is wrong with the end that it had; nothing where it is the right one.
fn judge(guest: &Hostile, engine: &Engine, bytes: &[u8]) -> Option<String> {
    let prepared = match engine.open(bytes) {
        Ok((_, prepared)) => prepared,
        Err(error) => {
            let text = words(&error);
            let expected = matches!(guest.end, End::Refused | End::Either) && guest.is_told_by(&text);
            return (!expected).then(|| format!("refused: {text}"));
        }
    };
    if guest.end == End::Refused {
        return Some("taken".to_owned());
    }
    let mut instance = prepared.instantiate().unwrap();
    let end = misbehave(guest, &prepared, &mut instance);
    assert!(instance.memory_bytes() <= limits().memory_bytes_max, "{}", guest.name);
    match (guest.end, end) {
        (End::Faulted, Err(fault)) if guest.is_told_by(&fault.to_string()) => None,
        (End::Bounded | End::Either, Ok(Some(effects))) if within_bounds(&effects) => {
            let told = effects.log.iter().any(|line| line.text.contains("were dropped"));
            (told != (guest.event == Tells::Log)).then(|| format!("lines dropped and told: {told}"))
        }
        (_, end) => Some(format!("{end:?}").chars().take(300).collect()),
    }
}

#[test]
fn each_of_the_table_has_its_end_and_the_engine_goes_on() {
    let components = bumpless_tests::components().unwrap();
    let dir = tempfile::tempdir().unwrap();
    let engine = engine_with(&dir, 4, limits(), this_binary()).unwrap();
    let honest = engine.prepare(&Guest::good().build()).unwrap();
    let mut neighbour = honest.instantiate().unwrap();
    let mut wrong = Vec::new();
    for guest in table().unwrap() {
        let bytes = guest.bytes(&components).unwrap();
        if let Some(what) = judge(&guest, &engine, &bytes) {
            wrong.push(format!("{}: {what}", guest.name));
        }
        // Neither one that lives since before, nor one that is made now, has felt anything.
        for law in [&mut neighbour, &mut honest.instantiate().unwrap()] {
            let end = law.step(&frame(1.0), &state(1.0), PATIENCE_NS).unwrap();
            assert_eq!(end.writes, [(1, 2.0)], "after {}", guest.name);
        }
        assert_eq!(leftovers(&dir), 0, "{}", guest.name);
        assert_eq!(engine.capacity().instances_used, 1, "{}", guest.name);
    }
    assert!(wrong.is_empty(), "{} of the table:\n{}", wrong.len(), wrong.join("\n"));
}

/// A controller's shape, filled with random code that uses nothing that the sandbox does not have.
fn random_controller(seed: &[u8]) -> Option<Vec<u8>> {
    let config = wasm_smith::Config {
        module_shape: Some(Guest::shape().ok()?),
        gc_enabled: false,
        exceptions_enabled: false,
        threads_enabled: false,
        memory64_enabled: false,
        relaxed_simd_enabled: false,
        max_memory32_bytes: 1 << 20,
        max_table_elements: 1000,
        max_instructions: 200,
        ..wasm_smith::Config::default()
    };
    let module = wasm_smith::Module::new(config, &mut Unstructured::new(seed)).ok()?;
    componentize(&module.to_bytes()).ok()
}

fn random_component(seed: &[u8]) -> Option<Vec<u8>> {
    let component = wasm_smith::Component::new(wasm_smith::Config::default(), &mut Unstructured::new(seed)).ok()?;
    Some(component.to_bytes())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_components_are_refused_or_bounded(seed in proptest::collection::vec(proptest::num::u8::ANY, 2048)) {
        // One engine for each, so that nothing of a case reaches the next.
        let engine = Engine::new(bumpless_engine::Config { instances_max: 2, limits: limits(), ..Default::default() }).unwrap();
        if let Some(bytes) = random_component(&seed) {
            assert!(engine.inspect(&bytes).is_err(), "no component made by chance is a controller");
        }
        // It has a controller's imports and exports, so its code runs: in its start function, and when it describes itself.
        let Some(bytes) = random_controller(&seed) else { return Ok(()) };
        if let Ok((_, prepared)) = engine.open(&bytes) {
            let mut instance = prepared.instantiate().unwrap();
            let _state_or_fault = instance.start(&[], &[], LIMIT_NS);
        }
        let honest = engine.prepare(&Guest::good().build()).unwrap();
        let end = honest.instantiate().unwrap().step(&frame(1.0), &state(1.0), PATIENCE_NS).unwrap();
        assert_eq!(end.writes, [(1, 2.0)]);
    }
}

/// Its state goes on where its memory begins anew.
#[test]
fn a_guest_whose_memory_grows_is_made_anew_and_never_misses_a_step() {
    let guest = table()
        .unwrap()
        .into_iter()
        .find(|guest| guest.name == "grows-step-by-step")
        .unwrap();
    let dir = tempfile::tempdir().unwrap();
    let engine = engine_with(&dir, 2, limits(), this_binary()).unwrap();
    let bytes = guest.bytes(&bumpless_tests::components().unwrap()).unwrap();
    let prepared = engine.prepare(&bytes).unwrap();
    let mut instance = prepared.instantiate().unwrap();
    let frame = frame_for(&prepared);
    let (mut largest, mut made_anew) = (0, 0);
    for _ in 0..100 {
        instance.step(&frame, &[], PATIENCE_NS).unwrap();
        let now = instance.memory_bytes();
        made_anew += u32::from(now == 0);
        largest = largest.max(now);
    }
    assert!(made_anew >= 5, "{made_anew}");
    assert!(largest > limits().memory_bytes_max / 2, "{largest}");
}
