//! What the ISA-form controllers share: the tables of ports and parameters, the tuning, the arithmetic and the glue.
//!
//! Owns the law of `pid` and `pidplus`; they differ only in *when* a measurement counts, which each says in its own `law.rs`.
//! Because they share tables and memory, each takes over the other's state and goes on from it. Other laws put something before
//! or behind this block: their tables begin with these tables, so the handles here are good for theirs.
//! Never: a component of its own.

pub mod table;

mod tuning;
pub use tuning::{Action, Tuning};

mod law;
pub use law::{Demand, Memory, Memory1, Phase, Sample};

mod alarms;
mod mode;
pub use mode::Actual;

pub mod block;
pub mod chain;
pub mod station;
