//! What a page that watches many loops needs: the numbers of a cycle in short, what people should hear of, and curves.

use std::collections::BTreeMap;

use bumpless_core as model;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{FieldNews, Mode, PortTable, Quality, finite, us};

/// The numbers of one cycle, without what only the full record has.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LiveRow {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// Number of the ownership.
    pub term: u64,
    /// Number of the cycle.
    pub seq: u64,
    /// Revision of the loop that was in force.
    pub revision: u64,
    /// When the inputs were frozen, in µs since 1970-01-01 UTC by the steady clock of the I/O host.
    pub at_unix_us: u64,
    /// Who decided the output.
    pub mode: Mode,
    /// Wanted value.
    pub setpoint: Option<f64>,
    /// Value of the measured port; the last good one where the reading is bad.
    pub measurement: Option<f64>,
    /// How far the measurement may be trusted.
    pub quality: Quality,
    /// What the arbiter let through, by output port.
    pub outputs: BTreeMap<String, Option<f64>>,
    /// The host that ran the cycle.
    pub owner: String,
    /// The host whose replica gave the step.
    pub stepped_by: String,
    /// Time of the step as the owner saw it, in µs: network included.
    pub step_us: f64,
    /// Time from the deadline to the actuator's write, in µs.
    pub committed_after_us: f64,
    /// Faulty cycles in a row, up to and with this one.
    pub faults_in_row: u32,
    /// While a swap is on probation: the cycles left.
    pub probation_cycles_left: Option<u32>,
}

impl LiveRow {
    /// The row of a record.
    pub(crate) fn new(record: &model::Record, ports: &PortTable) -> Self {
        let measured = ports.measured.and_then(|port| record.readings.get(port));
        Self {
            loop_name: record.loop_id.to_string(),
            term: record.term,
            seq: record.seq,
            revision: record.revision,
            at_unix_us: record.at_ns / 1_000,
            mode: record.mode.into(),
            setpoint: finite(record.setpoint),
            measurement: measured.and_then(|reading| finite(reading.value_or_last())),
            quality: measured.map_or(Quality::Bad, |reading| reading.quality.into()),
            outputs: ports.by_output(&record.outputs),
            owner: record.owner.to_string(),
            stepped_by: record.stepped_by.to_string(),
            step_us: us(record.step_ns),
            committed_after_us: us(record.committed_after_ns),
            faults_in_row: record.faults_in_row,
            probation_cycles_left: record.probation.map(|(_, cycles)| cycles),
        }
    }
}

/// One beat of the feed in rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LiveRows {
    /// Records that passed while this reader was too slow, and of which only the newest of each loop is told.
    pub lost: u64,
    /// The newest cycle of every loop that moved since the last beat.
    pub loops: Vec<LiveRow>,
    /// Every cycle of the loops whose trace was asked for, oldest first. Those made up for after a pause come here too.
    pub trace: Vec<LiveRow>,
}

/// What happened to points and jobs since the last beat, in the feed in rows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LiveField {
    /// Happenings that are left out because too many came at once: ask for points and jobs again.
    pub lost: u64,
    /// What happened, oldest first.
    pub news: Vec<FieldNews>,
}

/// Where a loop stands beside its cycles. Sent when something of any loop changes; a loop that is gone is not in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Standing {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// The revision in force.
    pub revision: u64,
    /// A revision on its way.
    pub pending_revision: Option<u64>,
    /// Live hosts that hold it, in rank order.
    pub members: Vec<String>,
    /// Things that the answering host could not do for it and tries again.
    pub failures: u64,
    /// Cycles without a commit; only the home has counts.
    pub lost: Option<u64>,
    /// Changes of ownership after a silence.
    pub takeovers: Option<u64>,
}

/// How much a notice matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Weight {
    /// For the record.
    Info,
    /// Something is not as it should be.
    Warning,
    /// A person should look.
    Urgent,
}

/// Something that people should hear of: an event, an alarm or a warning of a loop, told when it begins.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Notice {
    /// Its number at the host that answers; it grows, and begins anew with the host's process.
    pub number: u64,
    /// Time of the cycle, in µs since 1970-01-01 UTC.
    pub at_unix_us: u64,
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// Number of the ownership.
    pub term: u64,
    /// Number of the cycle.
    pub seq: u64,
    /// How much it matters.
    pub weight: Weight,
    /// What kind of thing, in one word: those of the events of a record, `alarm`, `alarm-cleared`, `log`.
    pub kind: String,
    /// In words.
    pub text: String,
}

/// What people should hear of, as far as this host remembers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Notices {
    /// Oldest first.
    pub notices: Vec<Notice>,
    /// Alarms of controllers that are raised now.
    pub standing: Vec<Notice>,
    /// Since when this host remembers, in ms since 1970-01-01 UTC.
    pub since_unix_ms: u64,
}

/// Curves of a loop over a window, as columns: one entry per chosen cycle in each.
///
/// Where the window has more cycles than were asked for, each piece of it is told by the cycles with its least and greatest
/// measurement and output and its latest write, so that no excursion is lost. All of them are recorded values; nothing is averaged.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct Trend {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// Cycles that were read.
    pub cycles: u64,
    /// Up to here the window was read, in µs since 1970-01-01 UTC; less than asked for where it has more cycles than one answer
    /// reads.
    pub read_to_unix_us: u64,
    /// Pieces of the log that were damaged and left out.
    pub unread: u64,
    /// Hosts, by the numbers in `owner` and `stepped_by`.
    pub hosts: Vec<String>,
    /// Times of the cycles.
    pub at_unix_us: Vec<u64>,
    /// Numbers of the cycles.
    pub seq: Vec<u64>,
    /// Wanted values.
    pub setpoint: Vec<Option<f64>>,
    /// Measured values.
    pub measurement: Vec<Option<f64>>,
    /// Was the measurement good?
    pub good: Vec<bool>,
    /// What the arbiter let through, one column per output port.
    pub outputs: BTreeMap<String, Vec<Option<f64>>>,
    /// Did the controller decide?
    pub automatic: Vec<bool>,
    /// Who ran the cycle.
    pub owner: Vec<u32>,
    /// Whose replica stepped.
    pub stepped_by: Vec<u32>,
    /// Times of the steps, in µs.
    pub step_us: Vec<f64>,
    /// Times from deadline to write, in µs.
    pub committed_after_us: Vec<f64>,
    /// What people should hear of in the window; at most 500, the first ones.
    pub notices: Vec<Notice>,
}
