//! The one error of this room. Each message names the place and the cure.

use std::path::PathBuf;

use bumpless_core::{BusId, PointId};

/// What can go wrong with points and buses.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The configuration cannot be used.
    #[error("{place}: {problem}")]
    Config {
        /// Which bus or point, for example `bus "plant"` or `bus "line", point "line.out"`.
        place: String,
        /// What is wrong and what would be right.
        problem: String,
    },
    /// The journal's file cannot be made.
    #[error("bus {bus:?}: the journal {path:?} cannot be opened for writing; check the folder and its rights")]
    Journal {
        /// The bus.
        bus: String,
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A point number that this server never gave out.
    #[error("point number {0} does not exist on this host; ask for its index again")]
    UnknownPoint(u32),
    /// A write to an input.
    #[error("point {0} is an input and cannot be written; connect the output port to a writable point")]
    NotWritable(PointId),
    /// A write of NaN or infinity.
    #[error("point {point}: {value} is no number to write; nothing was written")]
    NotFinite {
        /// The point.
        point: PointId,
        /// The value as text.
        value: String,
    },
    /// A write outside the point's range.
    #[error(
        "point {point}: {value}{} is outside {low} to {high}; nothing was written",
        after_space(unit)
    )]
    OutOfRange {
        /// The point.
        point: PointId,
        /// The value.
        value: f64,
        /// The point's unit.
        unit: String,
        /// Least value.
        low: f64,
        /// Greatest value.
        high: f64,
    },
    /// A force whose time is over before it begins, or too long.
    #[error("point {point}: a force lasts from 1 s to 24 h; {seconds} s were asked for")]
    ForceTime {
        /// The point.
        point: PointId,
        /// Seconds from now.
        seconds: u64,
    },
    /// No room for another force.
    #[error("{} points are forced; end a force before the next", crate::limits::FORCES_MAX)]
    TooManyForces,
    /// No bus of that name.
    #[error("this host has no bus {0:?}")]
    NoSuchBus(String),
    /// A bus without registers.
    #[error("bus {0:?} is no Modbus device: it has points, and no registers to read or write")]
    NoRegisters(BusId),
    /// The bus's queue is full.
    #[error("bus {0:?}: too many requests wait for the device; try again")]
    ErrandsFull(BusId),
    /// Nobody at an address.
    #[error("{address}: {problem}; check the address, the cable and the device")]
    Unreachable {
        /// `host:port`.
        address: String,
        /// What the system said.
        problem: String,
    },
    /// A device that cannot be looked at from outside of its bus.
    #[error("bus {0:?} is not plain Modbus TCP: its device cannot be scanned")]
    NoScan(BusId),
    /// Another host writes this bus.
    #[error("bus {0:?}: this host is not the device's master now; nothing was written")]
    NotMaster(BusId),
    /// A write after the end.
    #[error("the I/O of this host is closed; nothing was written")]
    Closed,
}

/// The unit behind its number; nothing where there is none.
fn after_space(unit: &str) -> String {
    if unit.is_empty() {
        String::new()
    } else {
        format!(" {unit}")
    }
}

impl Error {
    /// A configuration error at a place.
    pub(crate) fn config(place: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Config {
            place: place.into(),
            problem: problem.into(),
        }
    }
}
