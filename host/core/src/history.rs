//! The long memory of a loop: time in pieces, each with least, greatest and mean of its numbers and with what went wrong.
//!
//! Owns: what a piece holds ([`Bucket`]), how pieces become coarser ([`thin`]), how what several hosts kept becomes one
//! history ([`overlay`]), and what is missing in it ([`gaps`], [`doubtful`]). Never: where pieces lie, or who asks for them.
//!
//! ```text
//! cycles ──► 1 s ──► 10 s ──► 1 min ──► 15 min      pieces of each step begin at multiples of it, so finer ones nest
//! ```
//! Times are those of the loop's home, in ns since 1970: every host that keeps the loop cuts it at the same places.

use std::{fmt, sync::Arc};

use serde::{Deserialize, Serialize};

use crate::name::{LoopId, PointId};

mod bucket;
mod join;

pub use bucket::{Bucket, Seen, Spread};
pub use join::{doubtful, gaps, overlay, thin};

/// Lengths of the pieces that are kept, in ns, finest first. Each divides the next.
pub const STEPS_NS: [u64; 4] = [1_000_000_000, 10_000_000_000, 60_000_000_000, 900_000_000_000];

/// Whose numbers they are.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Series {
    /// A loop's: setpoint, measurement, outputs.
    Loop(LoopId),
    /// A point's, which no loop needs to use: its value is the measurement.
    Point(PointId),
}

impl fmt::Display for Series {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Loop(id) => write!(f, "loop {id}"),
            Self::Point(id) => write!(f, "point {id}"),
        }
    }
}

/// What the numbers of some pieces in a row stand for.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Layout {
    /// Names of the output ports, in the order of [`Bucket::outputs`].
    pub outputs: Vec<String>,
    /// Time from cycle to cycle, in ns; 0 where it is not known.
    pub period_ns: u64,
}

/// One piece.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Its length, in ns; 0 for a single cycle.
    pub step_ns: u64,
    /// What its numbers stand for.
    pub layout: Arc<Layout>,
    /// Its numbers.
    pub bucket: Bucket,
}

impl Row {
    /// When it begins, in ns since 1970.
    #[must_use]
    pub const fn start_ns(&self) -> u64 {
        self.bucket.start_ns
    }

    /// When it ends, in ns since 1970.
    #[must_use]
    pub const fn end_ns(&self) -> u64 {
        self.bucket.start_ns.saturating_add(self.step_ns)
    }

    /// Takes in another piece; the place and length stay. Where the outputs differ, both are kept by their names.
    pub fn merge(&mut self, other: &Self) {
        if self.layout.outputs == other.layout.outputs {
            self.bucket.merge(&other.bucket);
        } else {
            let mut names = self.layout.outputs.clone();
            let mut moved = other.bucket.clone();
            let spreads = std::mem::take(&mut moved.outputs);
            self.bucket.outputs.resize(names.len(), Spread::default());
            self.bucket.merge(&moved);
            for (name, spread) in other.layout.outputs.iter().zip(&spreads) {
                match names.iter().position(|known| known == name) {
                    Some(at) => {
                        if let Some(held) = self.bucket.outputs.get_mut(at) {
                            held.merge(spread);
                        }
                    }
                    None => {
                        names.push(name.clone());
                        self.bucket.outputs.push(*spread);
                    }
                }
            }
            self.layout = Arc::new(Layout {
                outputs: names,
                period_ns: self.layout.period_ns.max(other.layout.period_ns),
            });
        }
    }

    /// The longest time without a piece, after or before this one, that is no gap: a slow loop has seconds without a cycle.
    fn patience_ns(&self) -> u64 {
        let two_periods = self.layout.period_ns.saturating_mul(2);
        if self.step_ns > two_periods {
            self.step_ns
        } else if two_periods > 0 {
            two_periods
        } else {
            1
        }
    }
}

/// Which pieces serve a question that wants one number for every `width_ns`: the coarsest of which at least two make one, else
/// the finest. None: only single cycles are fine enough.
#[must_use]
pub fn step_for(width_ns: u64) -> Option<u64> {
    let finest = STEPS_NS[0];
    if width_ns < finest {
        return None;
    }
    let fits = STEPS_NS.iter().rev().find(|step| step.saturating_mul(2) <= width_ns);
    Some(fits.copied().unwrap_or(finest))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn steps_nest_and_serve() {
        assert!(STEPS_NS.windows(2).all(|pair| pair[1] % pair[0] == 0));
        const S: u64 = 1_000_000_000;
        for (width_ns, step) in [
            (S - 1, None),
            (S, Some(S)),
            (19 * S, Some(S)),
            (20 * S, Some(10 * S)),
            // A day on a thousand columns.
            (86 * S, Some(10 * S)),
            (120 * S, Some(60 * S)),
            // A year.
            (31_536 * S, Some(900 * S)),
        ] {
            assert_eq!(step_for(width_ns), step, "{width_ns}");
        }
    }

    #[test]
    fn pieces_with_other_outputs_are_joined_by_name() {
        let row = |names: &[&str], values: &[f64]| {
            let mut bucket = Bucket::at(0);
            bucket.take(&Seen {
                at_ns: 5,
                setpoint: 1.0,
                measurement: Some(2.0),
                outputs: values,
                ..Seen::default()
            });
            Row {
                step_ns: 10,
                layout: Arc::new(Layout {
                    outputs: names.iter().map(|&name| name.to_owned()).collect(),
                    period_ns: 1,
                }),
                bucket,
            }
        };
        let mut joined = row(&["a", "b"], &[1.0, 2.0]);
        joined.merge(&row(&["c", "b"], &[3.0, 6.0]));
        assert_eq!(joined.layout.outputs, ["a", "b", "c"]);
        let means: Vec<_> = joined.bucket.outputs.iter().map(|o| o.mean().unwrap()).collect();
        assert_eq!(means, [1.0, 4.0, 3.0]);
        assert_eq!((joined.bucket.cycles, joined.bucket.measurement.count), (2, 2));
    }
}
