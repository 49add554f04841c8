//! How wasmtime is set up: the cyclic profile in two shapes of memory, and the profile of programs.
//!
//! Owns: every wasmtime setting with its reason, and the choice between the shapes by what the kernel allows.
//! Never: differs between the host and its compiling child, for compiled code only loads where the settings agree.

use std::num::NonZeroUsize;

use wasmtime::{Config, InstanceAllocationStrategy, PoolingAllocationConfig, WasmBacktraceDetails};

use crate::{
    Error,
    config::Limits,
    error::brief,
    sandbox::{CORE_INSTANCES_MAX, MEMORIES_MAX, MEMORIES_PER_PLACE, TABLES_MAX},
};

/// Instances up to which slots are reserved ahead: no `mmap` beside running cycles, and a new instance in about 1 µs.
/// Beyond it the maps of the slots would not fit into the kernel's default of 65,530.
const POOLED_INSTANCES_MAX: u32 = 14_000;

/// Memory maps of one place: of each memory the part in use and the part still closed. Measured with 8,000
/// instances of a component with one memory: 2 each.
const MAPS_PER_POOLED_INSTANCE: usize = 2 * MEMORIES_PER_PLACE;
/// Memory maps of one prepared component: code, read-only data, and what lies between.
const MAPS_PER_COMPONENT: usize = 6;
/// Memory maps left to the rest of the process: thread stacks, allocator arenas, the bus, the database.
const MAPS_OF_OTHERS: usize = 4096;

/// Components that say what they are at once.
pub(crate) const INSPECTED_AT_ONCE: u32 = 4;
/// Places for instances of components that are being tried: one that is used and one that is fresh, as many again for those that
/// are just being dropped, and two places each.
pub(crate) const TRIAL_INSTANCES: u32 = 8;
/// Slots beyond the instances that loops may have.
const SPARE_INSTANCES: u32 = 2 * INSPECTED_AT_ONCE + TRIAL_INSTANCES;

/// Stack of a guest in bytes; a thread that steps must have 1 MiB or more in all.
const STACK_BYTES_MAX: usize = 256 * 1024;
/// Stack of a program in bytes: an interpreter calls itself for each call of its script.
const PROGRAM_STACK_BYTES_MAX: usize = 512 * 1024;
/// Stack of a program's fiber in bytes: its own, and as much for what the host does in its calls. Only what was touched is in
/// RAM.
const PROGRAM_FIBER_BYTES: usize = 1024 * 1024;

/// The two shapes of memory of cyclic components, and what programs run under. Code compiled for one does not load in another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Profile {
    /// Slots reserved at start, up to 14,000 instances. A small Rust component takes about 40 KiB per instance.
    Pooled,
    /// Memory allocated and cleared with each instance: next to no memory maps, so instances by the ten thousand, but all
    /// of a guest's first memory is in RAM from its start: about 85 KiB for the same component.
    OnDemand,
    /// Free-running programs: as [`Profile::OnDemand`], with a stack for an interpreter, and on fibers, so that a program that
    /// waits needs no thread. An engine of its own: nothing of it can slow a controller's call.
    Program,
}

impl Profile {
    /// The name that the compiling child is told.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Pooled => "pooled",
            Self::OnDemand => "on-demand",
            Self::Program => "program",
        }
    }

    /// The profile of that name.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        [Self::Pooled, Self::OnDemand, Self::Program]
            .into_iter()
            .find(|p| p.name() == name)
    }

    /// The shape for so many instances under the kernel's limit on memory maps, or an error where neither fits.
    pub(crate) fn choose(instances_max: u32, limits: &Limits, maps: Maps) -> Result<Self, Error> {
        let lean = limits.prepared_max * MAPS_PER_COMPONENT + MAPS_OF_OTHERS;
        let pooled = (instances_max + SPARE_INSTANCES) as usize * MAPS_PER_POOLED_INSTANCE + lean;
        let free = maps.allowed.saturating_sub(maps.used);
        if instances_max <= POOLED_INSTANCES_MAX && pooled <= free {
            Ok(Self::Pooled)
        } else if lean <= free {
            if instances_max <= POOLED_INSTANCES_MAX {
                tracing::warn!(
                    allowed = maps.allowed,
                    "vm.max_map_count is too small for {instances_max} pooled instances; they are allocated on demand, \
                     which makes new instances slower"
                );
            }
            Ok(Self::OnDemand)
        } else {
            let wanted = (maps.used + lean).next_multiple_of(65_536);
            Err(Error::Maps {
                allowed: maps.allowed,
                used: maps.used,
                needed: lean,
                wanted,
            })
        }
    }

    /// Settings that decide about the code: the same in the host and in the compiling child.
    fn code_settings(self, limits: &Limits, lines: bool) -> Config {
        let mut config = Config::new();
        config
            // Deadlines: epochs, which cost less than fuel and need no accounting per instruction.
            .epoch_interruption(true)
            .consume_fuel(false)
            .max_wasm_stack(STACK_BYTES_MAX)
            // Every host must compute the same bits.
            .cranelift_nan_canonicalization(true)
            .wasm_relaxed_simd(false)
            // What a cyclic law does not need is not offered: less to attack and less per call.
            .concurrency_support(false)
            .gc_support(false)
            .wasm_memory64(false)
            // What joins two components of one, as those of an interpreter with its stubs, copies from memory to memory.
            .wasm_multi_memory(true)
            // Nothing is put off until it is first used: that would be in a cycle.
            .table_lazy_init(false)
            .memory_init_cow(false)
            // The name of the law's own function is enough for a fault's text; a panic puts a dozen of Rust's above it.
            .wasm_backtrace_max_frames(NonZeroUsize::new(24))
            .generate_address_map(lines)
            // Said, because the default asks the environment.
            .wasm_backtrace_details(if lines {
                WasmBacktraceDetails::Enable
            } else {
                WasmBacktraceDetails::Disable
            })
            .guard_before_linear_memory(false);
        match self {
            // The base of a memory never moves. Accesses are checked against its size; reserving 4 GiB a piece would
            // save the check but cost page tables for each instance, and address space that small machines lack.
            Self::Pooled => {
                config
                    .memory_may_move(false)
                    .memory_reservation(limits.memory_bytes_max as u64)
                    .memory_guard_size(1 << 16)
                    .memory_reservation_for_growth(0);
            }
            // Plain allocations without guards, so that memory maps stay few.
            Self::OnDemand | Self::Program => {
                config
                    .memory_may_move(true)
                    .memory_reservation(0)
                    .memory_guard_size(0)
                    .memory_reservation_for_growth(0);
            }
        }
        if self == Self::Program {
            config
                .max_wasm_stack(PROGRAM_STACK_BYTES_MAX)
                .async_stack_size(PROGRAM_FIBER_BYTES);
        }
        config
    }

    /// An engine that only compiles, with as many threads as [`compile_threads`] allows.
    pub(crate) fn compiler(self, limits: &Limits) -> Result<wasmtime::Engine, Error> {
        let mut config = self.code_settings(limits, false);
        config.parallel_compilation(compile_threads() > 1);
        engine(&config)
    }

    /// An engine that runs; with `lines` as [`Config::lines`](crate::Config::lines) says.
    pub(crate) fn runtime(self, instances_max: u32, limits: &Limits, lines: bool) -> Result<wasmtime::Engine, Error> {
        let mut config = self.code_settings(limits, lines);
        config.coredump_on_trap(lines);
        // Where the host itself compiles it leaves the other cores to the cycles.
        config.parallel_compilation(false);
        if self == Self::Pooled {
            config.allocation_strategy(InstanceAllocationStrategy::Pooling(pool(instances_max, limits)));
        }
        engine(&config)
    }
}

/// Threads that compile where the machine has so many cores: a quarter of them, so that even at the lowest priority most
/// caches stay with the cycles; one on a small machine. More than four hardly help, and each takes address space.
pub(crate) fn compile_threads() -> usize {
    threads_for(std::thread::available_parallelism().map_or(1, NonZeroUsize::get))
}

const fn threads_for(cores: usize) -> usize {
    match cores / 4 {
        0 => 1,
        few if few < 4 => few,
        _ => 4,
    }
}

fn pool(instances_max: u32, limits: &Limits) -> PoolingAllocationConfig {
    let instances = instances_max + SPARE_INSTANCES;
    let times = |each: usize| instances.saturating_mul(u32::try_from(each).unwrap_or(u32::MAX));
    let mut pool = PoolingAllocationConfig::new();
    pool.total_component_instances(instances)
        .total_core_instances(times(CORE_INSTANCES_MAX))
        .total_memories(times(MEMORIES_PER_PLACE))
        .total_tables(times(TABLES_MAX))
        .max_core_instances_per_component(u32::try_from(CORE_INSTANCES_MAX).unwrap_or(u32::MAX))
        .max_memories_per_component(u32::try_from(MEMORIES_MAX).unwrap_or(u32::MAX))
        .max_tables_per_component(u32::try_from(TABLES_MAX).unwrap_or(u32::MAX))
        .max_memory_size(limits.memory_bytes_max)
        .table_elements(limits.table_elements_max)
        // A slot that comes back is zeroed and not unmapped up to this size, so that the instance made after a trap
        // does not fault its pages in again during a cycle.
        .linear_memory_keep_resident(128 * 1024)
        .table_keep_resident(16 * 1024)
        .max_unused_warm_slots(64);
    pool
}

fn engine(config: &Config) -> Result<wasmtime::Engine, Error> {
    wasmtime::Engine::new(config).map_err(|error| Error::Engine { reason: brief(&error) })
}

/// Memory maps that the kernel allows one process, and those in use.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Maps {
    pub(crate) allowed: usize,
    pub(crate) used: usize,
}

impl Maps {
    /// Reads them from `/proc`; where that is missing, the kernel's default is assumed.
    pub(crate) fn read() -> Self {
        let allowed = std::fs::read_to_string("/proc/sys/vm/max_map_count")
            .ok()
            .and_then(|t| t.trim().parse().ok());
        let used = std::fs::read("/proc/self/maps").map(|t| t.iter().filter(|&&b| b == b'\n').count());
        Self {
            allowed: allowed.unwrap_or(65_530),
            used: used.unwrap_or(1000),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]
    use super::*;

    #[test]
    fn the_kernels_limit_decides_the_shape() {
        let limits = Limits::default();
        let choose = |instances, allowed| Profile::choose(instances, &limits, Maps { allowed, used: 500 });
        assert_eq!(choose(14_000, 65_530).unwrap(), Profile::Pooled);
        assert_eq!(choose(14_001, 1 << 20).unwrap(), Profile::OnDemand);
        assert_eq!(choose(14_000, 60_000).unwrap(), Profile::OnDemand);
        assert_eq!(
            choose(10, 4000).unwrap_err().to_string(),
            "vm.max_map_count = 4000 leaves no room: this process has 500 memory maps and needs 5632 more; \
             run: sysctl -w vm.max_map_count=65536"
        );
    }

    #[test]
    fn compiling_leaves_cores_to_the_cycles() {
        let threads: Vec<usize> = [1, 2, 4, 7, 8, 16, 128].map(threads_for).to_vec();
        assert_eq!(threads, [1, 1, 1, 1, 2, 4, 4]);
    }

    #[test]
    fn names_lead_back() {
        for profile in [Profile::Pooled, Profile::OnDemand, Profile::Program] {
            assert_eq!(Profile::named(profile.name()), Some(profile));
        }
        assert_eq!(Profile::named("winch"), None);
    }

    #[test]
    fn this_process_has_maps() {
        let maps = Maps::read();
        assert!(maps.used > 10 && maps.allowed > maps.used, "{maps:?}");
    }
}
