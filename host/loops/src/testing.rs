//! A test device: a host whose steps come out wrong now and then, as on a machine with failing memory.
//!
//! Never: on in a cell whose name does not begin with "test"; the host's configuration sees to that.

use std::{
    num::NonZeroU64,
    sync::atomic::{AtomicU64, Ordering},
};

use bumpless_core::{Effects, Fault};

/// The bit that is turned over: the uppermost of a number's fraction, so that the value moves by a quarter to a half.
const BIT: u64 = 1 << 51;

/// Turns a bit over in every so-manieth good step.
#[derive(Debug)]
pub(crate) struct FlipBits {
    every: NonZeroU64,
    steps: AtomicU64,
}

impl FlipBits {
    pub(crate) const fn new(every: NonZeroU64) -> Self {
        Self {
            every,
            steps: AtomicU64::new(0),
        }
    }

    /// A step of this host came to this.
    pub(crate) fn disturb(&self, step: &mut Result<Effects, Fault>) {
        let Ok(effects) = step else { return };
        let steps = self.steps.fetch_add(1, Ordering::Relaxed) + 1;
        if !steps.is_multiple_of(self.every.get()) {
            return;
        }
        if let Some((_, value)) = effects.writes.first_mut() {
            *value = f64::from_bits(value.to_bits() ^ BIT);
        } else if let Some(byte) = effects.state.first_mut() {
            *byte ^= 1;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn every_third_step_comes_out_wrong_and_stays_a_number() {
        let device = FlipBits::new(NonZeroU64::new(3).unwrap());
        let step = || {
            let mut step = Ok(Effects {
                writes: vec![(1, 40.0)],
                ..Effects::default()
            });
            device.disturb(&mut step);
            step.unwrap().writes[0].1
        };
        let values: Vec<f64> = (0..6).map(|_| step()).collect();
        assert_eq!(values, [40.0, 40.0, 56.0, 40.0, 40.0, 56.0]);
        let mut fault = Err(Fault::Failed("no".to_owned()));
        device.disturb(&mut fault);
        assert!(fault.is_err());
    }
}
