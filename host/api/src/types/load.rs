//! How many alarms operators had, by ANSI/ISA-18.2, and how webhooks do.

use bumpless_core::HostId;
use bumpless_deploy::{alarms::AlarmLoad as Load, webhook::WebhookView};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::SilentHost;

/// Hosts that did not answer.
pub(crate) fn silent(hosts: Vec<(HostId, String)>) -> Vec<SilentHost> {
    let one = |(host, reason): (HostId, String)| SilentHost {
        host: host.to_string(),
        reason,
    };
    hosts.into_iter().map(one).collect()
}

/// One alarm and how often it came.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FrequentAlarm {
    /// The loop.
    #[serde(rename = "loop")]
    pub loop_name: String,
    /// The alarm.
    pub alarm: String,
    /// Comings in the last day.
    pub comings: u64,
    /// Part of all comings, in %.
    pub percent: f64,
    /// Did it come three times within a minute?
    pub chattered: bool,
}

/// The figures by which ANSI/ISA-18.2 judges an alarm system, of the last day and the whole cell. What was kept quiet does not count.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AlarmMetrics {
    /// Comings in all.
    pub comings: u64,
    /// Comings in the ten minutes that run now.
    pub now_per_10_min: u64,
    /// Mean of the ten-minute spans; up to 1 is very likely to be acceptable, up to 2 manageable.
    pub mean_per_10_min: f64,
    /// The most in any ten minutes; up to 10 is acceptable.
    pub peak_per_10_min: u64,
    /// Spans of ten minutes with more than ten comings.
    pub floods: u64,
    /// Part of all spans that were floods, in %; less than 1 is acceptable.
    pub flood_percent: f64,
    /// Comings in each span of ten minutes, 144 of them, the one that runs now last.
    pub spans: Vec<u64>,
    /// Alarms that stand.
    pub standing: u64,
    /// Alarms that wait for an acknowledgement.
    pub unacknowledged: u64,
    /// Alarms that stand for more than a day; there should be none.
    pub stale: u64,
    /// Alarms that are shelved, suppressed, or out of service.
    pub quiet: u64,
    /// Comings of low, medium and high priority, in %; about 80, 15 and 5 are usual.
    pub percent_by_priority: [f64; 3],
    /// The ten that came most often, and behind them others that chattered.
    pub frequent: Vec<FrequentAlarm>,
    /// Alarms that chattered: came three times within a minute; there should be none.
    pub chattering: u64,
    /// Were there more than could be looked at? The figures are then too small.
    pub cut: bool,
    /// Hosts that did not answer, and are not counted.
    pub silent: Vec<SilentHost>,
}

impl AlarmMetrics {
    /// The figures of what was counted.
    pub(crate) fn of(load: Load, hosts: Vec<(HostId, String)>) -> Self {
        let (comings, floods) = (load.comings(), load.floods());
        let spans = load.spans.len().max(1) as f64;
        let percent = |part: u64, all: u64| 100.0 * part as f64 / all.max(1) as f64;
        let frequent: Vec<FrequentAlarm> = load
            .frequent
            .into_iter()
            .map(|alarm| FrequentAlarm {
                loop_name: alarm.loop_id.to_string(),
                alarm: alarm.alarm,
                comings: alarm.comings,
                percent: percent(alarm.comings, comings),
                chattered: alarm.chattered,
            })
            .collect();
        Self {
            comings,
            now_per_10_min: load.spans.last().copied().unwrap_or_default(),
            mean_per_10_min: comings as f64 / spans,
            peak_per_10_min: load.spans.iter().max().copied().unwrap_or_default(),
            floods,
            flood_percent: 100.0 * floods as f64 / spans,
            standing: load.standing,
            unacknowledged: load.unacknowledged,
            stale: load.stale,
            quiet: load.quiet,
            percent_by_priority: load.by_priority.map(|count| percent(count, comings)),
            chattering: frequent.iter().filter(|alarm| alarm.chattered).count() as u64,
            frequent,
            spans: load.spans,
            cut: load.cut,
            silent: silent(hosts),
        }
    }
}

/// How one webhook does.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Webhook {
    /// Its host, which tells of the alarms of the loops at home there.
    pub host: String,
    /// Its name.
    pub name: String,
    /// Where to, without what may be secret in it.
    pub to: String,
    /// Events that wait.
    pub waiting: u64,
    /// Events that were told since the host's start.
    pub told: u64,
    /// Tries that failed.
    pub failed: u64,
    /// Events that the receiver refused for good.
    pub refused: u64,
    /// Events that were dropped because too many waited.
    pub dropped: u64,
    /// When the last one was told, in ms of Unix time.
    pub last_told_unix_ms: Option<u64>,
    /// Why the last try failed; none where it did not.
    pub trouble: Option<String>,
}

impl From<WebhookView> for Webhook {
    fn from(view: WebhookView) -> Self {
        Self {
            host: view.host.to_string(),
            name: view.name,
            to: view.to,
            waiting: view.waiting,
            told: view.told,
            failed: view.failed,
            refused: view.refused,
            dropped: view.dropped,
            last_told_unix_ms: view.last_told_unix_ms,
            trouble: view.trouble,
        }
    }
}

/// The webhooks of the cell.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Webhooks {
    /// By host, in the order of configuration.
    pub webhooks: Vec<Webhook>,
    /// Hosts that did not answer.
    pub silent: Vec<SilentHost>,
}
