//! The cell as a Modbus device: points and loops as coils and registers, for SCADA systems.
//!
//! Owns: the maps from addresses to points and loops, who may write which of them, and the copies of other hosts' points.
//! Never: writes a point or a loop itself. A write goes the way of every command, with its limits and its refusals; what
//! speaks Modbus is `bumpless_io::modbus::server`.
//!
//! ```text
//! client ─ request ─► server (io) ─► Face ── read ───► points here: the process image; others: a copy, refreshed
//!                                     │    └─────────► loops: their last record
//!                                     └── write ─► map, permission, range ─► the cell's commands ─► outcome or exception
//! ```
//!
//! Reading order: `config`, `map` (pure), `plant` (what is asked of the cell), `face`, `server`.

pub mod config;
pub mod error;
pub mod limits;

mod face;
mod map;
mod plant;
mod server;

pub use config::ModbusServerConfig;
pub use error::Error;
pub use server::{Servers, check, start};
