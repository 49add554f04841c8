//! When a measurement counts for `pidplus`: when it is fresh. The rest of the law is [`bumpless_isa`]'s.
//!
//! Song, Mok, Chen, Nixon, Blevins, Wojsznis, *Improving PID control with unreliable communications* (ISA Expo 2006):
//! the integral, as a first-order lag on the output, and the derivative are advanced only when a new measurement is
//! received, over the time ΔT since the one received before:
//!
//! ```text
//!   I_n = I_(n−1) + (U_(n−1) − I_(n−1)) · (1 − e^(−ΔT/Ti))         D = K·Td·(w_n − w_(n−1)) / ΔT
//! ```
//! In between, both are held, and the proportional action still follows the setpoint. Differences from the paper: U is what
//! the actuator really holds (external reset); the derivative keeps the filter Td/N, so that the law equals `pid` bit by bit
//! when every measurement is fresh; D and feedforward stay out of the lag, as in `pid`.

/// ΔT of a step, s: the time since the last fresh measurement where this one is fresh, none where it is not.
pub const fn elapsed_s(waited_s: &mut f64, dt_s: f64, fresh: bool) -> Option<f64> {
    let waited = *waited_s + dt_s;
    if fresh {
        *waited_s = 0.0;
        Some(waited)
    } else {
        *waited_s = waited;
        None
    }
}
