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
pub(crate) struct Place(Arc<AtomicU32>);

impl Places {
    pub(crate) fn new(max: u32) -> Self {
        Self {
            max,
            used: Arc::default(),
        }
    }

    /// A place, or [`Error::Full`].
    pub(crate) fn take(&self) -> Result<Place, Error> {
        self.used
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |used| {
                (used < self.max).then_some(used + 1)
            })
            .map(|_| Place(Arc::clone(&self.used)))
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
        self.0.fetch_sub(1, Ordering::Relaxed);
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
        let first = places.take().unwrap();
        let _second = places.take().unwrap();
        assert_eq!(
            places.take().unwrap_err().to_string(),
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
        assert!(places.take().is_ok());
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
