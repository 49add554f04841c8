//! A test guest: it counts its steps outside of its state, so that two replicas give two answers.
//!
//! Never: used outside tests.

use std::sync::atomic::{AtomicU64, Ordering};

use bumpless_sdk::prelude::*;
use guest_countdown::{Countdown, Misdeed, OUT};

/// What may not be: it outlives the call, and no record holds it.
static STEPS: AtomicU64 = AtomicU64::new(0);

struct Remembers;

impl Misdeed for Remembers {
    const NAME: &'static str = "remembers";
    const TEXT: &'static str = "Keeps a count between calls";

    fn strike(_: &Parameters<'_>, io: &mut Io<'_>, held: f64) -> Result<(), Fault> {
        let steps = STEPS.fetch_add(1, Ordering::Relaxed);
        io.write(OUT, held + steps as f64 * 1e-6);
        Ok(())
    }
}

bumpless_sdk::export!(Countdown<Remembers>);
