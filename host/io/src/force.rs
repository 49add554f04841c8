//! Points that a person holds at a value: which, at what, and until when.
//!
//! ```text
//! free ──force──► forced ──unforce, or its time is over──► free
//!                   └──force again──► forced, with the new value and time
//! ```
//!
//! Owns: what `IoServer` puts in the place of a reading or a write. Never: says who may force, or keeps a force over a
//! restart; deployment does both. A cycle's thread looks at one number where nothing is forced, and copies one entry under a
//! lock where something is.

use std::{
    collections::HashMap,
    sync::atomic::{AtomicUsize, Ordering::Relaxed},
};

use parking_lot::RwLock;

use crate::{Error, limits::FORCES_MAX, server::PointIndex};

/// One force.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Force {
    /// The value in the point's unit.
    pub value: f64,
    /// It ends by itself at this time, in ns of the I/O host's clock.
    pub until_ns: u64,
}

/// All forces of a host.
#[derive(Debug, Default)]
pub(crate) struct Forces {
    held: RwLock<HashMap<PointIndex, Force>>,
    /// How many there are, so that nobody takes the lock for nothing.
    count: AtomicUsize,
}

impl Forces {
    /// The value that a point is forced to at `now_ns`. One whose time is over counts no more, whoever sweeps it when.
    pub(crate) fn value(&self, point: PointIndex, now_ns: u64) -> Option<f64> {
        if self.is_empty() {
            return None;
        }
        let force = self.held.read().get(&point).copied()?;
        (now_ns < force.until_ns).then_some(force.value)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.count.load(Relaxed) == 0
    }

    /// Begins or changes a force.
    pub(crate) fn put(&self, point: PointIndex, force: Force) -> Result<(), Error> {
        let mut held = self.held.write();
        if held.len() >= FORCES_MAX && !held.contains_key(&point) {
            return Err(Error::TooManyForces);
        }
        held.insert(point, force);
        self.count.store(held.len(), Relaxed);
        Ok(())
    }

    /// Ends a force; says which there was.
    pub(crate) fn end(&self, point: PointIndex) -> Option<Force> {
        let mut held = self.held.write();
        let ended = held.remove(&point);
        self.count.store(held.len(), Relaxed);
        ended
    }

    /// All of them, those whose time is over too until they are ended.
    pub(crate) fn all(&self) -> Vec<(PointIndex, Force)> {
        if self.is_empty() {
            return Vec::new();
        }
        self.held.read().iter().map(|(point, force)| (*point, *force)).collect()
    }
}
