//! Alarms on the measurement and on its distance from the setpoint.
//!
//! ```text
//!   clear ── beyond the limit ──► active ── back by alarm-band ──► clear
//! ```
//! Owns their names, priorities and bits in the memory. Each change is told once; in between nothing is said.
//! Never: acknowledgement, shelving, delay; those are the operator's side.

use bumpless_sdk::prelude::*;

use crate::table::{ALARM_BAND, DV_HI, DV_LO, HI, HI_HI, LO, LO_LO};

/// One alarm: its name and words, urgency, limit, and the side on which it is active.
struct Watch {
    name: &'static str,
    text: &'static str,
    priority: Priority,
    limit: Parameter,
    side: Side,
}

enum Side {
    Above,
    Below,
    AboveSetpoint,
    BelowSetpoint,
}

const WATCHES: [Watch; 6] = [
    watch(
        "hi-hi",
        "the measurement is above hi-hi",
        Priority::High,
        HI_HI,
        Side::Above,
    ),
    watch("hi", "the measurement is above hi", Priority::Medium, HI, Side::Above),
    watch("lo", "the measurement is below lo", Priority::Medium, LO, Side::Below),
    watch(
        "lo-lo",
        "the measurement is below lo-lo",
        Priority::High,
        LO_LO,
        Side::Below,
    ),
    watch(
        "dv-hi",
        "the measurement is far above the setpoint",
        Priority::Low,
        DV_HI,
        Side::AboveSetpoint,
    ),
    watch(
        "dv-lo",
        "the measurement is far below the setpoint",
        Priority::Low,
        DV_LO,
        Side::BelowSetpoint,
    ),
];

/// A limit of this size is none.
const NONE: f64 = 1e9;
/// The bits of [`WATCHES`].
const WATCHED: u8 = (1 << WATCHES.len()) - 1;
/// The bit that says that the actual mode was told.
pub(crate) const MODE: u8 = 1 << 6;
/// The bit that says that doubtful inputs were told.
pub(crate) const QUALITY: u8 = 1 << 7;

const fn watch(name: &'static str, text: &'static str, priority: Priority, limit: Parameter, side: Side) -> Watch {
    Watch {
        name,
        text,
        priority,
        limit,
        side,
    }
}

/// Nothing is measured any more: clears what is active of the measurement's.
pub(crate) fn clear(active: u8, io: &mut Io<'_>) -> u8 {
    for (i, watch) in WATCHES.iter().enumerate() {
        if active & 1 << i != 0 {
            io.clear(watch.name);
        }
    }
    active & !WATCHED
}

/// Looks at one measurement; gives which alarms are active now, one bit each.
pub(crate) fn tell(active: u8, p: &Parameters<'_>, pv: f64, setpoint: f64, io: &mut Io<'_>) -> u8 {
    let mut now = active & !WATCHED;
    for (i, watch) in WATCHES.iter().enumerate() {
        let limit = p.of(watch.limit);
        let bit = 1 << i;
        if limit.abs() >= NONE && active & bit == 0 {
            continue;
        }
        let beyond = match watch.side {
            Side::Above => pv - limit,
            Side::Below => limit - pv,
            Side::AboveSetpoint => pv - setpoint - limit,
            Side::BelowSetpoint => setpoint - pv - limit,
        };
        let was = active & bit != 0;
        let is = limit.abs() < NONE && (beyond > 0.0 || was && beyond > -p.of(ALARM_BAND));
        now |= if is { bit } else { 0 };
        if is && !was {
            io.raise(watch.name, watch.priority, watch.text);
        } else if was && !is {
            io.clear(watch.name);
        }
    }
    now
}
