//! The frames that guests are given, and engines for them; the guests themselves are the harness's.

use std::sync::Arc;

use bumpless_core::{Cycle, Frame, Mode, Reading};
use bumpless_engine::{Config, Engine, Instance, Limits, Prepared};
pub(crate) use bumpless_tests::hostile::Guest;

/// Far longer than any honest guest takes, also on a busy machine.
pub(crate) const PATIENCE_NS: u64 = 10_000_000_000;

/// An engine that compiles in this process and keeps nothing.
pub(crate) fn engine() -> Engine {
    engine_for(8)
}

pub(crate) fn engine_for(instances_max: u32) -> Engine {
    Engine::new(Config {
        instances_max,
        limits: Limits::default(),
        ..Config::default()
    })
    .expect("engine")
}

pub(crate) fn prepare(guest: &Guest) -> Arc<Prepared> {
    engine().prepare(&guest.build()).expect("prepare")
}

pub(crate) fn instance(guest: &Guest) -> Instance {
    prepare(guest).instantiate().expect("instantiate")
}

pub(crate) fn frame(input: f64) -> Frame {
    Frame {
        cycle: Cycle {
            seq: 7,
            at_ns: 5000,
            dt_ns: 100,
            mode: Mode::Automatic,
            setpoint: 3.0,
        },
        readings: vec![Reading::good(input, 4000), Reading::good(0.0, 4000)],
        messages: vec![],
    }
}

pub(crate) fn state(sum: f64) -> Vec<u8> {
    sum.to_le_bytes().to_vec()
}
