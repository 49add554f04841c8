//! Runs loops: threads, schedule, the cycle's pipeline. The only place where the sample's line and the component's line
//! meet: a prepared instance is handed in, and takes effect between two cycles.
//!
//! Owns: the worker threads, the homes (loops whose points this host serves) and the seats (loops that this host holds).
//! Never: compiles, touches the disk, speaks async, decides (that is `core`), or waits for anybody on a cycle's path.
//!
//! ```text
//!  deadline ─► Home: freeze sample ─┬─ here ──────────► Seat: base, settle, step here or on replicas, conclude
//!                                   └─ wire ─► other host's Seat                     │
//!  Home: check, write, take ◄───────── commit (inline, or over the wire) ◄───────────┘
//!    └─► record: wire to all, sink to deploy (both never block)
//! ```
//!
//! A loop lives on one worker of each host, chosen by its name, so nothing of a loop is shared between threads.
//!
//! Reading order: `handle` (what others may ask), `worker` (the thread), `home`, `seat`, `steps`, `vote`, `revise`, `calls`, then `replicas`, `wire`.

mod calls;
mod error;
mod event;
mod handle;
mod home;
mod inbox;
mod replicas;
mod revise;
mod seat;
mod shared;
mod steps;
mod testing;
mod vote;
mod wire;
mod worker;

pub use error::Error;
pub use event::{CallEnd, CommandReply, HeldRevision, HomeRevision, LoopsEvent};
pub use handle::{Config, Loops};
pub use home::HomeView;
pub use wire::Wire;
