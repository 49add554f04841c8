//! `[history]`: how much of the past a host keeps.
//!
//! Never: decides which loops; the host keeps those that are at home or held there.

use bumpless_core::{PointId, history::STEPS_NS};
use bumpless_deploy::limits::HISTORY_POINTS_MAX;
use bumpless_store::{Bounds, CYCLE_BYTES_MAX, HISTORY_BYTES_MAX};
use serde::{Deserialize, Serialize};

use super::in_range;
use crate::error::Error;

/// Days that anything is kept at most: a century.
const DAYS_MAX: u64 = 36_525;

const DAY_NS: u64 = 86_400 * STEPS_NS[0];

/// The table of the file.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct HistoryTable {
    enabled: bool,
    bytes_max_mib: u64,
    cycles_days_max: u64,
    thinned_mib_max: u64,
    seconds_days_max: u64,
    minutes_days_max: u64,
    quarters_days_max: u64,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    points: Vec<PointId>,
}

impl Default for HistoryTable {
    fn default() -> Self {
        // Hours of single cycles of a dozen loops at 10 Hz, weeks of their seconds, years of their minutes, and no surprise on a
        // small disk.
        Self {
            enabled: true,
            bytes_max_mib: 512,
            cycles_days_max: 30,
            thinned_mib_max: 1024,
            seconds_days_max: 30,
            minutes_days_max: 400,
            quarters_days_max: 3_700,
            points: Vec::new(),
        }
    }
}

/// What it comes to.
pub(super) struct Kept {
    pub(super) cycles_bytes_max: Option<u64>,
    pub(super) cycles_keep_ns: u64,
    pub(super) thinned: Option<Bounds>,
    pub(super) points: Vec<PointId>,
}

impl HistoryTable {
    pub(super) fn checked(self, io: bool, wrong: &dyn Fn(&str, String) -> Error) -> Result<Kept, Error> {
        let mib = |key: &str, given: u64, range: std::ops::RangeInclusive<u64>| {
            in_range(wrong, key, Some(given), 0, range.start() >> 20, range.end() >> 20).map(|mib| mib << 20)
        };
        let ns = |key: &str, given: u64| in_range(wrong, key, Some(given), 0, 1, DAYS_MAX).map(|days| days * DAY_NS);
        let cycles = mib("history.bytes_max_mib", self.bytes_max_mib, CYCLE_BYTES_MAX)?;
        let thinned = mib("history.thinned_mib_max", self.thinned_mib_max, HISTORY_BYTES_MAX)?;
        let cycles_keep_ns = ns("history.cycles_days_max", self.cycles_days_max)?;
        let seconds = ns("history.seconds_days_max", self.seconds_days_max)?;
        let minutes = ns("history.minutes_days_max", self.minutes_days_max)?;
        let quarters = ns("history.quarters_days_max", self.quarters_days_max)?;
        if !io && !self.points.is_empty() {
            let reason = "this host serves no points; list them at the host that does";
            return Err(wrong("history.points", reason.to_owned()));
        }
        if self.points.len() > HISTORY_POINTS_MAX {
            let reason = format!("there are {} points; at most {HISTORY_POINTS_MAX}", self.points.len());
            return Err(wrong("history.points", reason));
        }
        Ok(Kept {
            cycles_bytes_max: self.enabled.then_some(cycles),
            cycles_keep_ns,
            thinned: self.enabled.then_some(Bounds {
                bytes_max: thinned,
                keep_ns: [seconds, seconds, minutes, quarters],
            }),
            points: if self.enabled { self.points } else { Vec::new() },
        })
    }
}
