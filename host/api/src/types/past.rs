//! The long history of a loop or a point, as columns.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use bumpless_core::history::{Bucket, Row, Series, Spread};
use bumpless_deploy::history::HistoryView;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{SilentHost, finite};

/// Least, greatest and mean of something, one entry for each piece of time; null where there was nothing.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct HistoryValues {
    /// The least.
    pub min: Vec<Option<f64>>,
    /// The greatest.
    pub max: Vec<Option<f64>>,
    /// The mean of all cycles.
    pub mean: Vec<Option<f64>>,
}

/// A stretch of time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct HistoryStretch {
    /// From, in µs since 1970-01-01 UTC.
    pub from_unix_us: u64,
    /// To.
    pub to_unix_us: u64,
}

/// Which kept pieces a part of an answer is made of.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct HistoryPart {
    /// From, in µs since 1970-01-01 UTC.
    pub from_unix_us: u64,
    /// To.
    pub to_unix_us: u64,
    /// Their length, in ms; 0 for single cycles.
    pub step_ms: f64,
}

/// The history of a loop or a point over a window, as columns: one entry for each piece of time in each, oldest first.
///
/// Pieces without any cycle are left out; where that is not just a slow loop, `gaps` says so. Times are those of the loop's home.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct History {
    /// The loop; none for a point.
    #[serde(rename = "loop")]
    pub loop_name: Option<String>,
    /// The point; none for a loop.
    pub point: Option<String>,
    /// Where the answer begins, in µs since 1970-01-01 UTC.
    pub from_unix_us: u64,
    /// Up to here it is all that there is; before the end that was asked for where one answer does not hold so much.
    pub to_unix_us: u64,
    /// Length of most pieces, in ms; 0 for single cycles.
    pub piece_ms: f64,
    /// Which kept pieces it is made of.
    pub made_of: Vec<HistoryPart>,
    /// Stretches of which no host has anything.
    pub gaps: Vec<HistoryStretch>,
    /// Hosts that something is from.
    pub sources: Vec<String>,
    /// Hosts that did not answer.
    pub silent: Vec<SilentHost>,
    /// When each piece begins.
    pub at_unix_us: Vec<u64>,
    /// Its length, in ms.
    pub ms: Vec<f64>,
    /// Cycles in it; of a point, values that were read.
    pub cycles: Vec<u64>,
    /// Cycles that ended without a commit.
    pub lost: Vec<u64>,
    /// Cycles that wrote later than half a period after their deadline.
    pub late: Vec<u64>,
    /// Cycles whose measurement was bad.
    pub bad: Vec<u64>,
    /// Cycles in manual.
    pub manual: Vec<u64>,
    /// Changes between manual and automatic.
    pub mode_changes: Vec<u64>,
    /// Wanted values.
    pub setpoint: HistoryValues,
    /// Measured values; of a point, its values.
    pub measurement: HistoryValues,
    /// What was written, by output port.
    pub outputs: BTreeMap<String, HistoryValues>,
    /// Times of the steps, in µs.
    pub step_us: HistoryValues,
}

impl HistoryValues {
    fn put(&mut self, spread: &Spread, unit: f64) {
        let value = |value: Option<f64>| value.map(|value| value / unit).and_then(finite);
        self.min.push(value(spread.least()));
        self.max.push(value(spread.greatest()));
        self.mean.push(value(spread.mean()));
    }
}

/// What a piece says of an output, by its name.
pub(crate) fn output(row: &Row, name: &str) -> Spread {
    let number = row.layout.outputs.iter().position(|known| known == name);
    let spread = number.and_then(|number| row.bucket.outputs.get(number));
    spread.copied().unwrap_or_default()
}

/// Names of all outputs of some pieces.
pub(crate) fn output_names(rows: &[Row]) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    let mut last: Option<&Arc<_>> = None;
    for row in rows {
        if last.is_none_or(|last| !Arc::ptr_eq(last, &row.layout)) {
            names.extend(row.layout.outputs.iter().cloned());
            last = Some(&row.layout);
        }
    }
    names
}

impl History {
    /// The answer's form over HTTP.
    pub(crate) fn new(series: &Series, view: &HistoryView) -> Self {
        let us = |ns: u64| ns / 1_000;
        let ms = |ns: u64| ns as f64 / 1e6;
        let (loop_name, point) = match series {
            Series::Loop(id) => (Some(id.to_string()), None),
            Series::Point(id) => (None, Some(id.to_string())),
        };
        let rows = &view.rows;
        let count = |of: fn(&Bucket) -> u64| rows.iter().map(|row| of(&row.bucket)).collect::<Vec<_>>();
        let values = |of: &dyn Fn(&Row) -> Spread, unit: f64| {
            let mut values = HistoryValues::default();
            rows.iter().for_each(|row| values.put(&of(row), unit));
            values
        };
        let outputs = output_names(rows).into_iter().map(|name| {
            let column = values(&|row| output(row, &name), 1.0);
            (name, column)
        });
        Self {
            loop_name,
            point,
            from_unix_us: us(view.from_ns),
            to_unix_us: us(view.to_ns),
            piece_ms: ms(view.width_ns),
            made_of: view
                .made_of
                .iter()
                .map(|(from, to, step)| HistoryPart {
                    from_unix_us: us(*from),
                    to_unix_us: us(*to),
                    step_ms: ms(*step),
                })
                .collect(),
            gaps: view
                .gaps
                .iter()
                .map(|(from, to)| HistoryStretch {
                    from_unix_us: us(*from),
                    to_unix_us: us(*to),
                })
                .collect(),
            sources: view.sources.iter().map(ToString::to_string).collect(),
            silent: view
                .silent
                .iter()
                .map(|(host, reason)| SilentHost {
                    host: host.to_string(),
                    reason: reason.clone(),
                })
                .collect(),
            at_unix_us: rows.iter().map(|row| us(row.start_ns())).collect(),
            ms: rows.iter().map(|row| ms(row.step_ns)).collect(),
            cycles: count(|b| b.cycles),
            lost: count(|b| b.lost),
            late: count(|b| b.late),
            bad: count(|b| b.bad),
            manual: count(|b| b.manual),
            mode_changes: count(|b| b.mode_changes),
            setpoint: values(&|row| row.bucket.setpoint, 1.0),
            measurement: values(&|row| row.bucket.measurement, 1.0),
            step_us: values(&|row| row.bucket.step_ns, 1e3),
            outputs: outputs.collect(),
        }
    }
}
