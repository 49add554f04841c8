//! What most test guests share: a law that holds its output for `after` steps, and from then on does its misdeed.
//!
//! Ports are those of the stock controllers that every loop connects (`pv`, `out`), so a guest can be swapped into any loop.
//! Never: a misdeed of its own.

use std::marker::PhantomData;

use bumpless_sdk::prelude::*;
use serde::{Deserialize, Serialize};

/// The ports of every guest.
pub const PORTS: &[PortSpec] = &[
    PortSpec::analog_input("pv", "", "Measurement; not used"),
    PortSpec::analog_output("out", "", "Holds what the actuator holds").required(),
];

/// To the actuator.
pub const OUT: Output = Output::of(PORTS, "out");

/// First row of every guest's table.
pub const AFTER: ParameterSpec = ParameterSpec::number(
    "after",
    "steps",
    0.0,
    0.0,
    1e9,
    "Good steps before the misdeed; 0 for none",
);

const AFTER_HANDLE: Parameter = Parameter::of(&[AFTER], "after");

/// One way to misbehave.
pub trait Misdeed: 'static {
    /// The component's name.
    const NAME: &'static str;
    /// What it does, in one line.
    const TEXT: &'static str;
    /// The parameters; the first is [`AFTER`].
    const PARAMETERS: &'static [ParameterSpec] = &[AFTER];

    /// Misbehaves. The output has been written already: what the actuator holds.
    fn strike(parameters: &Parameters<'_>, io: &mut Io<'_>, held: f64) -> Result<(), Fault>;
}

/// The controller that holds its output until it misbehaves.
#[derive(Debug)]
pub struct Countdown<M>(PhantomData<M>);

/// Steps done so far.
#[derive(Debug, Serialize, Deserialize)]
pub struct Steps(u64);

impl<M: Misdeed> Controller for Countdown<M> {
    const DESCRIPTION: Description = Description {
        name: M::NAME,
        version: env!("CARGO_PKG_VERSION"),
        text: M::TEXT,
        ports: PORTS,
        parameters: M::PARAMETERS,
        state_layout: 1,
    };

    type State = Steps;

    fn start(_: &Parameters<'_>, _: &Track<'_>) -> Result<Steps, Fault> {
        Ok(Steps(0))
    }

    fn step(steps: &mut Steps, parameters: &Parameters<'_>, _: &Cycle, io: &mut Io<'_>) -> Result<(), Fault> {
        let held = io.held(OUT).value;
        io.write(OUT, held);
        if steps.0 as f64 >= parameters.of(AFTER_HANDLE) {
            M::strike(parameters, io, held)?;
        }
        steps.0 += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use bumpless_sdk::bench::Bench;

    use super::*;

    struct Says;

    impl Misdeed for Says {
        const NAME: &'static str = "says";
        const TEXT: &'static str = "Fails in words";

        fn strike(_: &Parameters<'_>, _: &mut Io<'_>, _: f64) -> Result<(), Fault> {
            Err(Fault::failed("now"))
        }
    }

    #[test]
    fn holds_for_the_given_steps_and_then_strikes_for_good() {
        let mut bench = Bench::<Countdown<Says>>::start(&[("after", 2.0)], &[31.0]).expect("starts");
        for _ in 0..2 {
            assert_eq!(bench.step(0.1).expect("is good"), [31.0]);
        }
        for _ in 0..2 {
            assert!(matches!(bench.step(0.1), Err(Fault::Failed(_))));
        }
        let mut at_once = Bench::<Countdown<Says>>::start(&[], &[31.0]).expect("starts");
        assert!(at_once.step(0.1).is_err());
    }
}
