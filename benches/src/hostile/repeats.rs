//! Does a host that meets hostile components for years grow? Each is made, misbehaves and is dropped, thousands of times.
//!
//! Never: judges what they do; the engine's tests do.

use std::time::Instant;

use bumpless_core::{Cycle, Frame, Mode, Reading};
use bumpless_engine::{Config, Engine};
use bumpless_tests::hostile::{Call, End, Hostile};

use super::resident_mib;
use crate::{
    Options,
    error::Error,
    report::{Bound, Report},
};

/// Limit of a call: those that spin take all of it, and the ticker's millisecond.
const LIMIT_NS: u64 = 200_000;
/// Repeats before the measurement begins.
const WARM_UP: u64 = 50;
/// Growth that is none, in MiB: 10,000 leaks of one page would be 40.
const MIB_MAX: f64 = 4.0;

pub(super) fn run(options: Options, report: &mut Report, guests: &[(Vec<u8>, Hostile)]) -> Result<(), Error> {
    let repeats = options.count(10_000, 300);
    let engine = Engine::new(Config {
        instances_max: 4,
        ..Config::default()
    })
    .map_err(|source| Error::Engine {
        what: "its settings".to_owned(),
        source,
    })?;
    let (mut worst, mut whose, mut count) = (0.0_f64, String::new(), 0_u32);
    let all_from = resident_mib(None);
    let taken = guests
        .iter()
        .filter(|(_, guest)| matches!(guest.end, End::Faulted | End::Bounded));
    for (bytes, guest) in taken {
        let refused = |source| Error::Engine {
            what: guest.name.clone(),
            source,
        };
        let prepared = engine.prepare(bytes).map_err(refused)?;
        let descriptor = prepared.descriptor();
        let parameters: Vec<f64> = descriptor.parameters.iter().map(|p| p.default).collect();
        let track = vec![50.0; descriptor.outputs().count()];
        let frame = Frame {
            cycle: Cycle {
                seq: 1,
                at_ns: 10_000_000,
                dt_ns: 10_000_000,
                mode: Mode::Automatic,
                setpoint: 50.0,
            },
            readings: descriptor.ports.iter().map(|_| Reading::good(50.0, 1)).collect(),
            messages: Vec::new(),
        };
        let once = || -> Result<(), Error> {
            let mut instance = prepared.instantiate().map_err(refused)?;
            let first = instance.start(&parameters, &track, LIMIT_NS);
            if guest.call == Call::Step {
                let _fault_or_effects = instance.step(&frame, &first.unwrap_or_default(), LIMIT_NS);
            }
            Ok(())
        };
        for _ in 0..WARM_UP {
            once()?;
        }
        let (before, started) = (resident_mib(None), Instant::now());
        for _ in 0..repeats {
            once()?;
        }
        let grown = resident_mib(None) - before;
        report.progress(&format!(
            "{}: {repeats} times in {:.1} s, {grown:+.2} MiB",
            guest.name,
            started.elapsed().as_secs_f64()
        ));
        if grown > worst || whose.is_empty() {
            (worst, whose) = (grown, guest.name.clone());
        }
        count += 1;
        engine.forget(prepared.digest());
    }
    report.progress(&format!("most: {whose}"));
    report.told("hostile.repeats.components", f64::from(count), "components");
    report.told("hostile.repeats.each", repeats as f64, "times");
    report.figure("hostile.repeats.growth_worst", worst, "MiB", Bound::AtMost(MIB_MAX));
    report.told("hostile.repeats.growth_of_all", resident_mib(None) - all_from, "MiB");
    Ok(())
}
