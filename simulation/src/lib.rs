//! Whole cells in simulated time, from a seed. What decides is the product's own code, `bumpless_core`'s desk, arbiter, seat,
//! select, vote, place and tick; what is made up is time, links, disks, deaths, and a law that counts its steps.
//!
//! The model checker (`model/`) takes every course of a cell of two hosts; this takes some courses of cells of thousands, with
//! every kind of fault at once. A plan gives the same course each time, so a seed that breaks a rule can be looked at.
//!
//! - `plan`: what is simulated, and the schedule of faults.
//! - `world`: time, order, and what a fault does; `event`, `network`, `host`, `random`: its parts.
//! - `home`, `seat`: what the product's loops and deployment do around the core, without threads.
//! - `law`: the loops' component.
//! - `rules`: what must hold at every write.
//!
//! What is simpler than the product: a step takes a fixed time; hosts hear of each other after a drawn time instead of by the
//! bus; a home that starts hears of records at one moment. Never: used by the product.

mod counts;
mod error;
mod event;
mod home;
mod host;
mod law;
mod network;
mod plan;
mod random;
mod rules;
mod seat;
mod world;

pub use counts::{Counts, Harm, Messages};
pub use error::Error;
pub use plan::{Broken, FAULTS_MAX, Fault, FaultKind, HOSTS_MAX, LOOPS_MAX, Plan, SECONDS_MAX, Schedule};
pub use rules::{RULES, Violation};
pub use world::World;
