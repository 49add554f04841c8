//! How many cells run at once in one test process: as many as the machine has processors for, so that hosts keep their
//! deadlines. The others wait.
//!
//! A test that needs two cells takes two slots; the second one always comes, because the others hold one each and end.

use std::{
    sync::{Condvar, Mutex, PoisonError},
    time::Duration,
};

use crate::Error;

/// Cells at once. Four processes each, and two processors on the smallest machine.
const SLOTS: usize = 2;

/// Longest wait for a slot: all other tests together take a few minutes.
const SLOT_MAX: Duration = Duration::from_secs(1800);

static TAKEN: Mutex<usize> = Mutex::new(0);
static FREED: Condvar = Condvar::new();

/// The right to run one cell.
#[derive(Debug)]
pub(crate) struct Slot(());

impl Slot {
    pub(crate) fn take() -> Result<Self, Error> {
        let taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
        let (mut taken, waited) = FREED
            .wait_timeout_while(taken, SLOT_MAX, |taken| *taken >= SLOTS)
            .unwrap_or_else(PoisonError::into_inner);
        if waited.timed_out() {
            return Err(Error::Waited {
                what: "another cell of this process to end".to_owned(),
                seconds: SLOT_MAX.as_secs_f64(),
                seen: format!("{taken} cells"),
            });
        }
        *taken += 1;
        Ok(Self(()))
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        let mut taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
        *taken = taken.saturating_sub(1);
        drop(taken);
        FREED.notify_one();
    }
}
