//! What the composition root decides about the sandbox: where code is kept, how it is compiled, and every bound.
//!
//! Never: reads files or the environment; the application does and fills this in.

use std::{ffi::OsString, path::PathBuf, time::Duration};

use bumpless_core::limits::COMPONENT_BYTES_MAX;

/// How uploaded components are compiled.
#[derive(Debug, Clone)]
pub enum Compile {
    /// On the caller's thread, without memory or time limits. For tests and for components from a trusted build only:
    /// hostile code can make a compiler take gigabytes and minutes.
    InProcess,
    /// In a child process with limits: `program args… IN OUT`, which must call
    /// [`compile_child::run`](crate::compile_child::run)`(IN, OUT)`.
    Child {
        /// The program, usually the host's own binary.
        program: PathBuf,
        /// Arguments before the two paths, for example `compile-child`.
        args: Vec<OsString>,
    },
}

/// Bounds of components and of the work done for them.
#[derive(Debug, Clone)]
pub struct Limits {
    /// Greatest size of an uploaded component, in bytes.
    pub component_bytes_max: usize,
    /// Greatest linear memory of one instance, in bytes; a multiple of 64 KiB. 16 MiB holds a law with room for tables and
    /// models, and 1,000 greedy instances still fit into a small server.
    pub memory_bytes_max: usize,
    /// Greatest number of elements of one table. Tables hold function pointers; large guests need some thousands.
    pub table_elements_max: usize,
    /// Components that may be prepared at once: each maps its code, and maps are scarce (`vm.max_map_count`).
    pub prepared_max: usize,
    /// Compiled components kept on disk; the oldest go first. Each takes about four times its component's size.
    pub cached_max: usize,
    /// Longest time of `describe` and of making an instance, each.
    pub describe_time_max: Duration,
    /// Greatest address space of the compiling child, in bytes.
    pub compile_memory_bytes_max: u64,
    /// Longest time of one compilation in the child, by the clock and by the processor; whole seconds.
    pub compile_time_max: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            component_bytes_max: COMPONENT_BYTES_MAX,
            memory_bytes_max: 16 * 1024 * 1024,
            table_elements_max: 10_000,
            prepared_max: 256,
            cached_max: 1024,
            // Generous beside the microseconds that an honest guest takes, short enough for an upload to wait for.
            describe_time_max: Duration::from_secs(1),
            compile_memory_bytes_max: 2 * 1024 * 1024 * 1024,
            compile_time_max: Duration::from_secs(60),
        }
    }
}

/// Everything that [`Engine::new`](crate::Engine::new) needs.
#[derive(Clone)]
pub struct Config {
    /// Folder of compiled code, made with mode 0700 where missing; none to keep nothing on disk.
    pub cache_dir: Option<PathBuf>,
    /// Key that authenticates what is in the folder; see [`cache_key`](crate::cache_key). Unused without a folder.
    pub cache_key: [u8; 32],
    /// Instances that may live at once; 1 or more.
    pub instances_max: u32,
    /// How components are compiled.
    pub compile: Compile,
    /// Bounds.
    pub limits: Limits,
    /// Shall faults name files and lines, where a component brings debug information? For an author's tools, never for a host:
    /// that information comes from outside, and reading it takes milliseconds on the thread that stepped. Needs
    /// [`Compile::InProcess`].
    pub lines: bool,
}

impl Default for Config {
    /// No cache, compiled in this process, 1,000 instances.
    fn default() -> Self {
        Self {
            cache_dir: None,
            cache_key: [0; 32],
            instances_max: 1000,
            compile: Compile::InProcess,
            limits: Limits::default(),
            lines: false,
        }
    }
}

impl std::fmt::Debug for Config {
    /// Everything but the key.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Config")
            .field("cache_dir", &self.cache_dir)
            .field("instances_max", &self.instances_max)
            .field("compile", &self.compile)
            .field("limits", &self.limits)
            .field("lines", &self.lines)
            .finish_non_exhaustive()
    }
}
