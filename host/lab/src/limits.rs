//! Every bound of this room, with its unit and its reason.

/// Virtual time of one run, in s: ten days, at 50 ms more than 17 million cycles.
pub const DURATION_S_MAX: f64 = 864_000.0;

/// Cycles of one run, over all loops: at 2 µs each, some minutes of work.
pub const CYCLES_MAX: f64 = 50_000_000.0;

/// Runs of one experiment: cases times sweep points times seeds.
pub const RUNS_MAX: usize = 100_000;

/// Loops of one experiment: more belong into the simulation of cells, not into a control experiment.
pub const LOOPS_MAX: usize = 32;

/// Hosts of one experiment, as replicas of a loop.
pub const HOSTS_MAX: usize = bumpless_core::limits::REPLICAS_MAX;

/// Rows of a run's trace that are kept, per loop; beyond it every second one is dropped, and again. A page is 1,000 px wide.
pub const TRACE_ROWS_MAX: usize = 8_192;

/// Notes of a run that are kept: takeovers, faults, swaps. The count goes on.
pub const NOTES_MAX: usize = 1_000;

/// Longest processor time of one step or one advance of a plant, in ns: a run is not in a hurry, but it must end.
pub const CALL_NS_MAX: u64 = 2_000_000_000;

/// Size of an experiment's file, in bytes.
pub const EXPERIMENT_BYTES_MAX: u64 = 1 << 20;

/// Size of a file with recorded cycles, in bytes.
pub const RECORDED_BYTES_MAX: u64 = 256 << 20;

/// Messages on their way at once, over all channels; beyond it the network is taken for broken.
pub const MESSAGES_MAX: usize = 1 << 20;
