//! Faults on purpose: what is inflicted and when, by which means, and whether the promises held.
//!
//! ```text
//!   Schedule (seeded) ──fault──► Inflictor ──kill, stop, cut, delay, fill, set the date──►  Cell of processes
//!                                                                                             │
//!   Operator ──setpoints, each with its key──► API of any host                                │
//!      └── what was acknowledged ──┐                     journal, records ◄──── Observer ◄────┘
//!                                  └──► check ◄──────────────────┘
//! ```
//! Owns: network namespaces, relays and small disks for as long as a run lasts; all of them go with the process, however it
//! ends. Never: looks inside a host.

mod check;
pub(crate) mod dates;
mod disk;
mod inflictor;
mod net;
mod observer;
mod operator;
mod relay;
mod schedule;

pub use check::{Breach, Seen, kept_commands};
pub use disk::Disk;
pub use inflictor::{Inflictor, Window};
pub use net::Net;
pub use observer::Observer;
pub use operator::{Operator, Order, Outcome, Profile, unix_ns};
pub use relay::{Relay, Way};
pub use schedule::{Fault, Kind, Schedule};
