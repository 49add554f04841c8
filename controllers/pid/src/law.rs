//! When a measurement counts for `pid`: always. The rest of the law is [`bumpless_isa`]'s.

/// ΔT of a step, s: the time since the step before. PID uses what it sees, fresh or not.
pub const fn elapsed_s(waited_s: &mut f64, dt_s: f64, _fresh: bool) -> Option<f64> {
    // Nothing is ever waited for; kept at 0, so that `pidplus` finds the truth when it takes over.
    *waited_s = 0.0;
    Some(dt_s)
}
