//! What can go wrong when loops are handed in.

use bumpless_core::{HostId, LoopId, PointId};

/// Why a loop cannot run here.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The host serves no points.
    #[error("host {0} serves no points, so no loop can have its home here: give it a bus in its configuration")]
    NoIo(HostId),
    /// A point is not served here.
    #[error(
        "loop {loop_id}: point {point} is not served by this host; all points of a loop must be served by its home"
    )]
    NoSuchPoint {
        /// The loop.
        loop_id: LoopId,
        /// The point.
        point: PointId,
    },
    /// The inbox of a worker is full: the host is overloaded.
    #[error("the host is too busy to take the change; try again, or move loops to other hosts")]
    Busy,
    /// A thread could not be started.
    #[error("a worker thread could not be started: {0}")]
    Thread(#[source] std::io::Error),
}
