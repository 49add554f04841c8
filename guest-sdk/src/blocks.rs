//! Small pieces that laws are made of: pure, total functions of numbers, and the few with memory ([`Delay`], [`LeadLag`],
//! [`Balance`]) as parts of a law's own state.
//!
//! Never: time or I/O of their own; a law keeps what must last. None of them uses `f64::clamp`, whose panic message
//! alone would triple a component's size.

mod balance;
mod curve;
mod delay;
mod lag;

pub use balance::Balance;
pub use curve::{curve, place};
pub use delay::{CELLS, Delay, PIECES_MAX, Piece};
pub use lag::LeadLag;

/// `value` within `low` and `high`. A NaN stays one: the host must see it, not an innocent bound.
#[must_use]
pub const fn limit(value: f64, low: f64, high: f64) -> f64 {
    if value > high {
        high
    } else if value < low {
        low
    } else {
        value
    }
}

/// `target`, but at most `rate_per_s · dt_s` away from `from`. A rate of 0 is no limit.
#[must_use]
pub const fn rate_limit(target: f64, from: f64, rate_per_s: f64, dt_s: f64) -> f64 {
    if rate_per_s > 0.0 {
        let reach = rate_per_s * dt_s;
        limit(target, from - reach, from + reach)
    } else {
        target
    }
}

/// The part of a step that a first-order lag makes in `dt_s`: `1 − e^(−dt/T)`, exact for an input that holds between two
/// samples. 1 for `time_s <= 0`: no lag.
///
/// Source: zero-order-hold equivalent of `1/(1 + sT)`; Åström and Wittenmark, Computer-Controlled Systems, 3rd ed., ch. 2.
#[must_use]
pub fn lag_part(time_s: f64, dt_s: f64) -> f64 {
    if time_s > 0.0 { -(-dt_s / time_s).exp_m1() } else { 1.0 }
}

/// `error` less a band around 0, without a jump at its edges: 0 within the band.
#[must_use]
pub const fn dead_band(error: f64, half_width: f64) -> f64 {
    error - limit(error, -half_width, half_width)
}

/// One step of a derivative with a first-order filter, by backward difference: stable for every `dt_s`, with or without filter.
///
/// `d' = (Tf·d + Td·Δw) / (Tf + dt)`; the result has the unit of `w`, a gain is the law's.
/// Source: Åström and Hägglund, Advanced PID Control (ISA, 2006), ch. 13; Åström and Murray, Feedback Systems, sec. 11.5.
#[must_use]
pub const fn derivative(before: f64, change: f64, derivative_s: f64, filter_s: f64, dt_s: f64) -> f64 {
    (filter_s * before + derivative_s * change) / (filter_s + dt_s)
}
