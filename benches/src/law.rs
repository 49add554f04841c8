//! A controller as the benches step it: a component in the sandbox, and the same law as a native function.
//!
//! Both see the same samples, so that what differs is the sandbox.

use std::{path::PathBuf, sync::Arc};

use bumpless_core::{Cycle, Direction, Frame, Mode, Reading};
use bumpless_engine::{Engine, Prepared};
use bumpless_isa::{Memory, Sample, Tuning};

use crate::error::Error;

/// Setpoint of all steps, in units of the measurement.
const SETPOINT: f64 = 50.0;
/// Time between two steps, in ns.
const DT_NS: u64 = 10_000_000;
/// Different samples, stepped in turn.
const SAMPLES: u32 = 64;

/// Where a component of this repository is, built if it is not.
pub(crate) fn component_path(name: &str) -> Result<PathBuf, Error> {
    let path = xtask::components::build()
        .map_err(Error::Components)?
        .join(format!("{name}.wasm"));
    if path.is_file() {
        Ok(path)
    } else {
        Err(Error::Missing(path))
    }
}

/// A component of this repository, prepared.
pub(crate) fn prepare(engine: &Engine, name: &str) -> Result<Arc<Prepared>, Error> {
    let path = component_path(name)?;
    let bytes = std::fs::read(&path).map_err(Error::io(format!("{} cannot be read", path.display())))?;
    engine.prepare(&bytes).map_err(|source| Error::Engine {
        what: name.to_owned(),
        source,
    })
}

fn measurement(number: u32) -> f64 {
    SETPOINT + f64::from(number) / 100.0
}

/// Samples of a loop near its setpoint, as frames of a component.
pub(crate) fn frames(prepared: &Prepared) -> Vec<Frame> {
    (0..SAMPLES)
        .map(|number| {
            let at_ns = u64::from(number) * DT_NS;
            let reading = |direction| match direction {
                Direction::Input => Reading::good(measurement(number), at_ns),
                Direction::Output => Reading::good(SETPOINT, at_ns),
            };
            // Like a loop with two points: the measurement and the actuator. Other ports are not connected.
            let readings = prepared.descriptor().ports.iter().map(|port| {
                if port.required {
                    reading(port.direction)
                } else {
                    Reading::unconnected()
                }
            });
            Frame {
                cycle: Cycle {
                    seq: u64::from(number),
                    at_ns,
                    dt_ns: DT_NS,
                    mode: Mode::Automatic,
                    setpoint: SETPOINT,
                },
                readings: readings.collect(),
                messages: Vec::new(),
            }
        })
        .collect()
}

/// The same samples for the law itself.
pub(crate) fn samples() -> Vec<Sample> {
    (0..SAMPLES)
        .map(|number| Sample::automatic(measurement(number), SETPOINT, Some(SETPOINT), DT_NS as f64 / 1e9))
        .collect()
}

/// The defaults of `pid`'s table.
pub(crate) const fn tuning() -> Tuning {
    Tuning {
        bias: 50.0,
        ..Tuning::pi(1.0, 60.0, 0.0, 100.0)
    }
}

/// A first memory that goes on from the actuator.
pub(crate) const fn memory() -> Memory {
    Memory::new(SETPOINT)
}

/// A first state of a component with its default parameters.
pub(crate) fn first_state(instance: &mut bumpless_engine::Instance, limit_ns: u64) -> Result<Vec<u8>, Error> {
    let descriptor = instance.prepared().descriptor();
    let parameters: Vec<f64> = descriptor
        .parameters
        .iter()
        .map(|parameter| parameter.default)
        .collect();
    let track = vec![SETPOINT; descriptor.outputs().count()];
    Ok(instance.start(&parameters, &track, limit_ns)?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn the_native_law_and_the_component_give_the_same_outputs() {
        let engine = Engine::new(bumpless_engine::Config::default()).unwrap();
        let prepared = prepare(&engine, "pid").unwrap();
        let mut instance = prepared.instantiate().unwrap();
        let mut state = first_state(&mut instance, 1_000_000_000).unwrap();
        let mut native = memory();
        for (frame, sample) in frames(&prepared).iter().zip(samples()) {
            let effects = instance.step(frame, &state, 1_000_000_000).unwrap();
            let output = native.step(&tuning(), &sample);
            assert_eq!(
                effects.writes.first().map(|(_, value)| value.to_bits()),
                Some(output.to_bits())
            );
            state = effects.state;
        }
    }
}
