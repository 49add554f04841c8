//! How a host is: what it publishes of itself every second or so.
//!
//! Never: measures; that is `probe`.

use bumpless_core::{Digest, HostId};
use serde::{Deserialize, Serialize};

/// What a host offers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Roles {
    /// It owns points, and is home to the loops that write them.
    pub io: bool,
    /// It runs components.
    pub control: bool,
}

/// One host's state, as it publishes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Vitals {
    /// Whose.
    pub host: HostId,
    /// Grows by one with each publication of this process; an older one that arrives late can be told by it.
    pub seq: u64,
    /// When the process started, in ms of Unix time.
    pub started_at_ms: u64,
    /// What it offers.
    pub roles: Roles,
    /// Where its API listens, as `address:port`, if it serves one.
    pub api: Option<String>,
    /// Load of the processors that the process may run on, by anyone, 0 to 1.
    pub cpu: f32,
    /// This process's part of it, 0 to 1.
    pub cpu_process: f32,
    /// Resident memory of this process, in bytes.
    pub memory_bytes: u64,
    /// Components that are compiled here and ready to step.
    pub ready: Vec<Digest>,
    /// Loops whose cycle it runs now.
    pub loops_owned: u32,
    /// Loops that it holds, owned or standing by.
    pub loops_held: u32,
    /// It is about to leave: give it nothing new.
    pub draining: bool,
    /// It stays so over a restart.
    pub drain_kept: bool,
    /// Words that it goes by besides its name, for what loops prefer.
    pub labels: Vec<String>,
    /// Version of the program.
    pub version: String,
    /// Now by its steady clock, in ms of Unix time: what its records are stamped with. People are told where it is off.
    pub unix_ms: u64,
}
