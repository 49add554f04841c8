//! When a measurement counts for `pid`: always. The rest of the law is [`bumpless_isa`]'s.

/// ΔT of a step, s: the time since the step before. PID uses what it sees, fresh or not.
pub use bumpless_isa::block::always as elapsed_s;
