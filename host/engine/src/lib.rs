//! The sandbox: inspects, compiles, keeps and steps control components.
//!
//! Owns: wasmtime and everything that names it, the generated bindings, the compiled-code cache, the limits of a guest
//! and the thread that stops one that spins.
//! Never: knows loops, hosts, buses or the network; reads wall-clock time for a guest; lets a guest's misdeed become more
//! than an [`Error`] or a [`Fault`](bumpless_core::Fault).
//!
//! ```text
//! bytes ─ inspect ─▶ Inspection            (is it a controller? what does it say of itself?)
//! bytes ─ prepare ─▶ Prepared (one per digest, shared)
//!                       └─ instantiate ─▶ Instance (one per replica) ─ start / step / migrate ─▶ state, effects or fault
//! ```
//!
//! A simulated plant goes the same way with its own world: `open_plant`, then `instantiate`, `begin`, `advance` (`plant`).
//! A free-running program has an engine of its own (`programs`), and runs as a future (`program`); a script rides in its
//! interpreter's bytes (`script`).
//!
//! Reading order: `config`, `engine`, `admission`, `prepared`, `instance`; below them `profile`, `compile` with
//! `compile_child`, `cache`, `ticker`, `sandbox`, `imports`; `convert` alone joins generated types and the core's nouns.

mod admission;
mod bindings;
mod cache;
mod capacity;
mod compile;
pub mod compile_child;
mod config;
mod convert;
mod engine;
mod error;
mod imports;
mod instance;
mod place;
mod plant;
mod plant_bindings;
mod prepared;
mod profile;
mod program;
mod program_bindings;
mod programs;
mod sandbox;
mod script;
mod ticker;

pub use admission::{INTERFACES, Inspection, PROGRAM_INTERFACES};
pub use cache::cache_key;
pub use capacity::Capacity;
pub use compile::precompile;
pub use config::{Compile, Config, Limits};
pub use engine::{Either, Engine};
pub use error::Error;
pub use instance::{Instance, Origin};
pub use plant::{PlantInfo, PlantInstance, PlantRole, PlantSignal, PlantView, PreparedPlant};
pub use prepared::Prepared;
pub use profile::Profile;
pub use program::{
    Answer, Later, PreparedProgram, ProgramInfo, ProgramSlot, Question, Reply, Sight, Surroundings, Turn, Usage,
};
pub use programs::Programs;
pub use script::{SCRIPT_BYTES_MAX, Script, split, wrap};

// Instances are stepped by whichever worker has the turn; the rest is shared by all of them.
const _: () = {
    const fn send<T: Send>() {}
    const fn shared<T: Send + Sync>() {}
    send::<Instance>();
    send::<PlantInstance>();
    shared::<PreparedPlant>();
    shared::<Engine>();
    shared::<Prepared>();
    shared::<PreparedProgram>();
    shared::<Programs>();
};
