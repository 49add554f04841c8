//! The beat of what looks again and again. Never: catches up what it missed.

use std::time::Duration;

/// A beat that does not catch up what it missed.
pub(crate) fn every(period: Duration) -> tokio::time::Interval {
    let mut tick = tokio::time::interval(period);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    tick
}
