//! The points of a host: the process image, the buses, and the drivers that keep them true.
//!
//! Owns: the steady clock of the I/O host, point tables, scaling, the simulated plant, the Modbus TCP client.
//! Never: decides who may write (the arbiter does, before it calls `write`), waits in `read` or `write`, or knows loops
//! beyond the stamp that the journal keeps.
//!
//! ```text
//! device ── driver ──► image ──► IoServer::read ──► frame
//! device ◄─ driver ◄── outbox ◄─ IoServer::write ◄─ commit
//! ```
//!
//! Reading order: `clock`, `config`, `scaling`, `image`, `server`, then the drivers `sim` and `modbus`.

pub mod clock;
pub mod config;
pub mod errand;
pub mod error;
pub mod force;
pub mod image;
pub mod job;
pub mod limits;
pub mod master;
pub mod point_list;
pub mod request_map;
pub mod rest;
pub mod scaling;
pub mod scan;
pub mod server;
pub mod status;

pub mod journal;
pub mod modbus;
pub mod sim;

pub use clock::Clock;
pub use config::{BusConfig, Config, OnStop};
pub use errand::{Errand, ErrandError};
pub use error::Error;
pub use force::Force;
pub use job::{JobConfig, JobStep};
pub use master::{MasterView, RedundantConfig};
pub use rest::Rest;
pub use server::{IoServer, PointIndex, PointInfo, WriteStamp};
pub use status::BusStatus;
