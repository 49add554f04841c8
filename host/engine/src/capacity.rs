//! Who may have an instance, and who must wait for a turn.
//!
//! Owns: the count of living instances and the turnstiles before compiling and describing.
//! Never: queues an instance: beyond the limit the answer is no, at once and clearly.

use std::{
    sync::{
        Arc, Condvar, Mutex, PoisonError,
        atomic::{AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use crate::Error;

/// How many instances there may be and are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Capacity {
    /// Greatest number of instances.
    pub instances_max: u32,
    /// Instances alive now.
    pub instances_used: u32,
}

/// Counts instances.
#[derive(Debug)]
pub(crate) struct Places {
    max: u32,
    used: Arc<AtomicU32>,
}

/// One instance's right to exist; given back on drop.
#[derive(Debug)]
pub(crate) struct Place {
    used: Arc<AtomicU32>,
    weight: u32,
}

impl Places {
    pub(crate) fn new(max: u32) -> Self {
        Self {
            max,
            used: Arc::default(),
        }
    }

    /// A place, or several for an instance that needs the slots of several; or [`Error::Full`].
    pub(crate) fn take(&self, weight: u32) -> Result<Place, Error> {
        self.used
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |used| {
                used.checked_add(weight).filter(|&used| used <= self.max)
            })
            .map(|_| Place {
                used: Arc::clone(&self.used),
                weight,
            })
            .map_err(|_| Error::Full { max: self.max })
    }

    pub(crate) fn capacity(&self) -> Capacity {
        Capacity {
            instances_max: self.max,
            instances_used: self.used.load(Ordering::Relaxed),
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.used.fetch_sub(self.weight, Ordering::Relaxed);
    }
}

/// Lets a set number in at once; the others wait for a bounded time.
#[derive(Debug)]
pub(crate) struct Turnstile {
    free: Mutex<u32>,
    left: Condvar,
    doing: &'static str,
}

/// The right to be inside; given back on drop.
#[derive(Debug)]
pub(crate) struct Turn<'a>(&'a Turnstile);

impl Turnstile {
    /// `doing` completes "other components are being …".
    pub(crate) fn new(at_once: u32, doing: &'static str) -> Self {
        Self {
            free: Mutex::new(at_once),
            left: Condvar::new(),
            doing,
        }
    }

    /// Waits for at most `patience`, then [`Error::Busy`].
    pub(crate) fn enter(&self, patience: Duration) -> Result<Turn<'_>, Error> {
        let until = Instant::now() + patience;
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        while *free == 0 {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(Error::Busy {
                    doing: self.doing,
                    waited_s: patience.as_secs(),
                });
            }
            free = self
                .left
                .wait_timeout(free, left)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
        *free -= 1;
        Ok(Turn(self))
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        *self.0.free.lock().unwrap_or_else(PoisonError::into_inner) += 1;
        self.0.left.notify_one();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]
    use super::*;

    #[test]
    fn places_are_refused_beyond_the_limit_and_come_back() {
        let places = Places::new(2);
        assert!(places.take(3).is_err(), "one that is too large for all of them");
        let first = places.take(1).unwrap();
        let _second = places.take(1).unwrap();
        assert_eq!(
            places.take(1).unwrap_err().to_string(),
            "all 2 instances of this host are in use; stop a loop or raise the host's instance limit"
        );
        drop(first);
        assert_eq!(
            places.capacity(),
            Capacity {
                instances_max: 2,
                instances_used: 1
            }
        );
        assert!(places.take(2).is_err());
        assert!(places.take(1).is_ok());
    }

    #[test]
    fn a_full_turnstile_says_so() {
        let turnstile = Turnstile::new(1, "compiled");
        let turn = turnstile.enter(Duration::ZERO).unwrap();
        assert_eq!(
            turnstile.enter(Duration::ZERO).unwrap_err().to_string(),
            "other components are being compiled and this one waited 0 s for its turn; try again"
        );
        drop(turn);
        assert!(turnstile.enter(Duration::ZERO).is_ok());
    }
}
