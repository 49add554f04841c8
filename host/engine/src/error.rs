//! Why a component is not taken, or the sandbox cannot be had. What a guest does wrong while it runs is a
//! [`Fault`](bumpless_core::Fault) instead.
//!
//! Each message names the place and the cure; a source is never repeated in the text of its error.

use std::{io, path::PathBuf};

use bumpless_core::{Fault, descriptor::DescriptorError};

/// Everything that this room can refuse.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Too many bytes.
    #[error("the component has {bytes} bytes; at most {max} are accepted")]
    TooBig {
        /// Its size.
        bytes: usize,
        /// The limit.
        max: usize,
    },
    /// Not a component at all.
    #[error("this is no WebAssembly component but {found}; {cure}")]
    NotComponent {
        /// What it is instead.
        found: &'static str,
        /// What to do.
        cure: &'static str,
    },
    /// Wants something that is not offered.
    #[error("import {name:?} is not offered to controllers; {cure}")]
    Import {
        /// The import's name, cut to 128 characters.
        name: String,
        /// What to do.
        cure: &'static str,
    },
    /// Imports or exports do not fit the world.
    #[error("this is no controller of the world bumpless:control@0.1.0: {reason}")]
    World {
        /// Which import or export, and how it differs.
        reason: String,
    },
    /// Imports or exports do not fit the world of plants.
    #[error("this is no plant of the world bumpless:control@0.1.0: {reason}")]
    PlantWorld {
        /// Which import or export, and how it differs.
        reason: String,
    },
    /// What a plant says of itself makes no sense.
    #[error("what the plant says of itself is not acceptable: {reason}")]
    PlantInfo {
        /// What, and how it should be.
        reason: String,
    },
    /// Imports or exports do not fit the world of programs.
    #[error("this is no program of the world bumpless:control@0.1.0: {reason}")]
    ProgramWorld {
        /// Which import or export, and how it differs.
        reason: String,
    },
    /// What a program says of itself makes no sense.
    #[error("what the program says of itself is not acceptable: {reason}")]
    ProgramInfo {
        /// What, and how it should be.
        reason: String,
    },
    /// A script that cannot ride in a component.
    #[error("the script cannot be taken: {reason}")]
    Script {
        /// What, and how it should be.
        reason: String,
    },
    /// More core instances, memories or tables than one component may have, or a first memory over the limit.
    #[error("the component needs more than an instance may have: {reason}")]
    Needs {
        /// What, how much, and the limit.
        reason: String,
    },
    /// The compiler refused it.
    #[error("the component does not compile: {reason}")]
    Compile {
        /// The compiler's words, shortened.
        reason: String,
    },
    /// The compiling child hit its memory limit.
    #[error(
        "compiling the component took more than {max_mib} MiB of memory and was stopped; simplify it or raise the limit"
    )]
    CompileMemory {
        /// The limit.
        max_mib: u64,
    },
    /// The compiling child wrote more than it may.
    #[error("the component becomes more than {max_mib} MiB of machine code; simplify it")]
    CompileOutput {
        /// The limit.
        max_mib: u64,
    },
    /// The compiling child hit its time limit.
    #[error("compiling the component took longer than {max_s} s and was stopped; simplify it or raise the limit")]
    CompileTime {
        /// The limit.
        max_s: u64,
    },
    /// The compiling child cannot be run.
    #[error("the compiler process {program} cannot be run")]
    CompileChild {
        /// What was run.
        program: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// An instance cannot be made.
    #[error("the component cannot be instantiated")]
    Instantiate(#[source] Fault),
    /// `describe` did not return.
    #[error("the component cannot say what it is")]
    Describe(#[source] Fault),
    /// `describe` returned nonsense.
    #[error("what the component says of itself is not acceptable")]
    Descriptor(#[from] DescriptorError),
    /// No room for another instance.
    #[error("all {max} instances of this host are in use; stop a loop or raise the host's instance limit")]
    Full {
        /// The limit.
        max: u32,
    },
    /// No room for another component.
    #[error("all {max} places for prepared components are in use; delete components that no loop uses")]
    TooManyPrepared {
        /// The limit.
        max: usize,
    },
    /// Others compile or inspect.
    #[error("other components are being {doing} and this one waited {waited_s} s for its turn; try again")]
    Busy {
        /// "compiled" or "inspected".
        doing: &'static str,
        /// How long it waited.
        waited_s: u64,
    },
    /// A bound in the configuration makes no sense.
    #[error("engine setting {name} = {value}: {cure}")]
    Setting {
        /// The setting.
        name: &'static str,
        /// Its value.
        value: u64,
        /// What it should be.
        cure: &'static str,
    },
    /// The kernel allows too few memory maps.
    #[error(
        "vm.max_map_count = {allowed} leaves no room: this process has {used} memory maps and needs {needed} more; \
         run: sysctl -w vm.max_map_count={wanted}"
    )]
    Maps {
        /// What the kernel allows.
        allowed: usize,
        /// Maps in use.
        used: usize,
        /// Maps needed besides.
        needed: usize,
        /// A setting that would do.
        wanted: usize,
    },
    /// wasmtime refused its settings or the machine.
    #[error("the WebAssembly engine cannot start on this machine: {reason}")]
    Engine {
        /// wasmtime's words.
        reason: String,
    },
    /// A thread cannot be made.
    #[error("the engine's clock thread cannot be started")]
    Thread(#[source] io::Error),
    /// A file of the cache, the key or the compiler's exchange.
    #[error("{doing} {path} failed; check that the folder exists, is writable and has space")]
    File {
        /// What was tried, for example "writing".
        doing: &'static str,
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The key file does not hold a key.
    #[error("{path} holds {bytes} bytes and not the 32 of a key; delete it to get a new one")]
    Key {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
    },
}

impl Error {
    /// For `map_err` on file operations.
    pub(crate) fn file(doing: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::File { doing, path, source }
    }
}

/// One line of at most 400 characters: the engine's texts can be pages long.
pub(crate) fn brief(error: &wasmtime::Error) -> String {
    one_line(&format!("{error:#}"))
}

/// One line of at most 400 characters.
pub(crate) fn one_line(text: &str) -> String {
    text.split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
        .chars()
        .take(400)
        .collect()
}
