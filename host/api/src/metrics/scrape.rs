//! What the cell is asked for at each scrape: this host's counts, its hosts as it sees them, and the loops at home here.
//!
//! Never: a series without a bound; see [`METRIC_LOOPS_MAX`] and [`METRIC_HOSTS_MAX`].

use std::{fmt, sync::Arc};

use bumpless_deploy::webhook::WebhookView;
use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeCounterValue, EncodeGaugeValue, EncodeMetric as _, NoLabelSet},
    metrics::{MetricType, counter::ConstCounter, gauge::ConstGauge},
    registry::Unit,
};

use crate::{
    cell::Cell,
    limits::{METRIC_HOSTS_MAX, METRIC_LOOPS_MAX},
};

/// Asks the cell at each scrape.
pub(super) struct Scrape {
    pub(super) cell: Arc<dyn Cell>,
}

impl fmt::Debug for Scrape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Scrape").finish_non_exhaustive()
    }
}

impl Collector for Scrape {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let c = self.cell.counters();
        for (name, help, value) in [
            ("records", "Records that reached this host", c.records),
            ("cycles_taken", "Cycles taken, loops whose home is here", c.cycles_taken),
            (
                "cycles_lost",
                "Cycles without a commit, loops whose home is here",
                c.cycles_lost,
            ),
            (
                "cycles_skipped",
                "Cycles that the home came too late for",
                c.cycles_skipped,
            ),
            ("takeovers", "Changes of ownership after a silence", c.takeovers),
            ("commits_refused", "Commits that the arbiter refused", c.commits_refused),
            ("uploads", "Components taken in", c.uploads),
            ("uploads_refused", "Components refused", c.uploads_refused),
            ("applies", "Changes of loops that ended well, homes here", c.applies),
            (
                "applies_refused",
                "Changes of loops that were refused, homes here",
                c.applies_refused,
            ),
            ("fetches", "Components fetched from other hosts", c.fetches),
            ("fetches_failed", "Fetches that failed", c.fetches_failed),
            (
                "fetches_corrupt",
                "Fetched bytes whose digest was wrong",
                c.fetches_corrupt,
            ),
            (
                "prepares_failed",
                "Revisions that could not be made ready here",
                c.prepares_failed,
            ),
            ("requests", "Requests from other hosts that were answered", c.requests),
            (
                "malformed",
                "Messages from other hosts that could not be read",
                c.malformed,
            ),
            (
                "arrivals_dropped",
                "Messages dropped because a queue was full",
                c.arrivals_dropped,
            ),
            (
                "cycles_recorded",
                "Cycles in the log on disk, loops whose home is here",
                c.cycles_recorded,
            ),
            (
                "cycles_unrecorded",
                "Cycles that the log dropped because too many waited for the disk",
                c.cycles_unrecorded,
            ),
            (
                "cycle_log_damaged",
                "Pieces of the log that could not be read",
                c.cycle_log_damaged,
            ),
            ("audit_entries", "Entries of this host's audit trail", c.audit_entries),
            (
                "audit_writes_refused",
                "Times that the disk refused entries of the audit trail",
                c.audit_refused,
            ),
            (
                "audit_entries_lost",
                "Entries of the audit trail that were dropped because the disk refused them for too long",
                c.audit_lost,
            ),
            (
                "history_taken",
                "Cycles and values of points that are in the history",
                c.history_taken,
            ),
            (
                "history_dropped",
                "Cycles, values and pieces that the history lost because too many waited or the disk took nothing",
                c.history_dropped,
            ),
            (
                "history_damaged",
                "Blocks of the history that could not be read",
                c.history_damaged,
            ),
        ] {
            let metric = ConstCounter::new(value);
            metric.encode(encoder.encode_descriptor(name, help, None, metric.metric_type())?)?;
        }
        for (name, help, value) in [
            ("hosts_alive", "Hosts that are alive", c.hosts_alive),
            ("loops_known", "Loops known to this host", c.loops_known),
            ("loops_home", "Loops whose home is here", c.loops_home),
            ("loops_held", "Loops held here, owned or standing by", c.loops_held),
            ("loops_owned", "Loops owned here", c.loops_owned),
            ("programs_home", "Programs whose home is here", c.programs_home),
            (
                "programs_running",
                "Programs that run here, or stand paused",
                c.programs_running,
            ),
            (
                "programs_faulted",
                "Programs whose last run here ended in a fault",
                c.programs_faulted,
            ),
            (
                "programs_copied",
                "Programs of other homes that are copied here",
                c.programs_copied,
            ),
            ("components", "Components in the library", c.components),
            (
                "audit_entries_waiting",
                "Entries of the audit trail that wait for the disk",
                c.audit_waiting,
            ),
            (
                "alarms_standing",
                "Alarms that stand, homes here; what is kept quiet does not count",
                c.alarms_standing,
            ),
            (
                "alarms_unacknowledged",
                "Alarms that wait for a person, homes here",
                c.alarms_unacknowledged,
            ),
            (
                "alarms_stale",
                "Alarms that stand for more than a day, homes here",
                c.alarms_stale,
            ),
            (
                "alarms_quiet",
                "Alarms that are shelved, suppressed or out of service, homes here",
                c.alarms_quiet,
            ),
            (
                "alarms_recent",
                "Alarms that came in the last ten minutes, homes here; more than 10 is a flood",
                c.alarms_recent,
            ),
        ] {
            let metric = ConstGauge::new(value);
            metric.encode(encoder.encode_descriptor(name, help, None, metric.metric_type())?)?;
        }
        let metric = ConstGauge::new(c.cycle_log_bytes);
        let help = "Recorded cycles on disk";
        metric.encode(encoder.encode_descriptor("cycle_log", help, Some(&Unit::Bytes), metric.metric_type())?)?;
        let metric = ConstGauge::new(c.audit_bytes);
        let help = "The audit trail on disk";
        metric.encode(encoder.encode_descriptor("audit", help, Some(&Unit::Bytes), metric.metric_type())?)?;
        let metric = ConstGauge::new(c.clock_offset_ms as f64 * 1e-3);
        let help = "How far the host's clock is off, beside its own date and those of other hosts";
        metric.encode(encoder.encode_descriptor(
            "clock_offset",
            help,
            Some(&Unit::Seconds),
            metric.metric_type(),
        )?)?;
        if let Some(free) = c.disk_free_bytes {
            let metric = ConstGauge::new(free);
            let help = "Room on the disk of the host's data";
            metric.encode(encoder.encode_descriptor("disk_free", help, Some(&Unit::Bytes), metric.metric_type())?)?;
        }
        self.webhooks(&mut encoder, &c.webhooks)?;
        for (name, help, value) in [
            ("history", "Thinned history on disk", c.history_bytes),
            (
                "history_cut",
                "Left out of the history at the start because a write had broken off",
                c.history_cut_bytes,
            ),
        ] {
            let metric = ConstGauge::new(value);
            metric.encode(encoder.encode_descriptor(name, help, Some(&Unit::Bytes), metric.metric_type())?)?;
        }
        let metric = ConstGauge::new(u64::from(c.history_failing));
        let help = "1 while the disk takes no history";
        metric.encode(encoder.encode_descriptor("history_failing", help, None, metric.metric_type())?)?;
        self.hosts(&mut encoder)?;
        self.loops(&mut encoder)
    }
}

impl Scrape {
    /// Those who are told of alarms.
    fn webhooks(&self, encoder: &mut DescriptorEncoder<'_>, hooks: &[WebhookView]) -> fmt::Result {
        let rows = |value: &dyn Fn(&WebhookView) -> u64| -> Vec<(String, u64)> {
            hooks.iter().map(|hook| (hook.name.clone(), value(hook))).collect()
        };
        for (name, help, rows) in [
            ("webhook_told", "Events that were told", rows(&|hook| hook.told)),
            (
                "webhook_failed",
                "Tries to tell an event that failed",
                rows(&|hook| hook.failed),
            ),
            (
                "webhook_refused",
                "Events that the receiver refused for good",
                rows(&|hook| hook.refused),
            ),
            (
                "webhook_dropped",
                "Events that were dropped because too many waited",
                rows(&|hook| hook.dropped),
            ),
        ] {
            counters(encoder, (name, help), "webhook", &rows)?;
        }
        let waiting: Vec<(String, f64)> = hooks
            .iter()
            .map(|hook| (hook.name.clone(), hook.waiting as f64))
            .collect();
        gauges(
            encoder,
            ("webhook_waiting", "Events that wait", None),
            "webhook",
            &waiting,
        )
    }
}

/// One labelled value per row.
fn gauges<V: EncodeGaugeValue>(
    encoder: &mut DescriptorEncoder<'_>,
    (name, help, unit): (&str, &str, Option<&Unit>),
    label: &str,
    rows: &[(String, V)],
) -> fmt::Result {
    let mut metric = encoder.encode_descriptor(name, help, unit, MetricType::Gauge)?;
    for (value_of, value) in rows {
        metric
            .encode_family(&[(label, value_of.as_str())])?
            .encode_gauge(value)?;
    }
    Ok(())
}

/// One labelled count per row.
fn counters<V: EncodeCounterValue>(
    encoder: &mut DescriptorEncoder<'_>,
    (name, help): (&str, &str),
    label: &str,
    rows: &[(String, V)],
) -> fmt::Result {
    let mut metric = encoder.encode_descriptor(name, help, None, MetricType::Counter)?;
    for (value_of, value) in rows {
        metric
            .encode_family(&[(label, value_of.as_str())])?
            .encode_counter::<NoLabelSet, V, f64>(value, None)?;
    }
    Ok(())
}

impl Scrape {
    fn hosts(&self, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let hosts: Vec<_> = self.cell.hosts().into_iter().take(METRIC_HOSTS_MAX).collect();
        let rows = |value: &dyn Fn(&bumpless_deploy::HostView) -> f64| -> Vec<(String, f64)> {
            hosts.iter().map(|h| (h.id.to_string(), value(h))).collect()
        };
        let alive = rows(&|h| f64::from(u8::from(h.alive)));
        gauges(
            encoder,
            ("host_alive", "1 while the host is alive, as this host sees it", None),
            "host",
            &alive,
        )?;
        let cpu = rows(&|h| f64::from(h.cpu));
        gauges(
            encoder,
            (
                "host_cpu",
                "Load of the cores that the host may use, 0 to 1",
                Some(&Unit::Other("ratio".to_owned())),
            ),
            "host",
            &cpu,
        )?;
        let memory = rows(&|h| h.memory_bytes as f64);
        gauges(
            encoder,
            ("host_memory", "Resident memory of the host", Some(&Unit::Bytes)),
            "host",
            &memory,
        )?;
        let latency: Vec<(String, f64)> = hosts
            .iter()
            .filter_map(|h| h.latency_ns.map(|ns| (h.id.to_string(), ns as f64 * 1e-9)))
            .collect();
        let help = "Smoothed latency of a step on the host, as this host measures it";
        gauges(encoder, ("host_latency", help, Some(&Unit::Seconds)), "host", &latency)
    }

    /// Loops whose home is here: only the home counts their cycles.
    fn loops(&self, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let loops = self.cell.loops();
        let home = || {
            loops
                .iter()
                .filter_map(|l| l.tally.map(|t| (l, t)))
                .take(METRIC_LOOPS_MAX)
        };
        for (name, help, value) in [
            (
                "loop_cycles_taken",
                "Cycles taken",
                (|t| t.taken) as fn(bumpless_core::desk::Tally) -> u64,
            ),
            ("loop_cycles_lost", "Cycles that ended without a commit", |t| t.lost),
            ("loop_takeovers", "Changes of ownership after a silence", |t| {
                t.takeovers
            }),
        ] {
            let rows: Vec<(String, u64)> = home().map(|(l, t)| (l.id.to_string(), value(t))).collect();
            counters(encoder, (name, help), "loop", &rows)?;
        }
        let age: Vec<(String, f64)> = home()
            .filter_map(|(l, _)| l.last_age_ms.map(|ms| (l.id.to_string(), ms as f64 * 1e-3)))
            .collect();
        gauges(
            encoder,
            ("loop_record_age", "Age of the last record", Some(&Unit::Seconds)),
            "loop",
            &age,
        )?;
        let setpoint: Vec<(String, f64)> = home()
            .filter_map(|(l, _)| l.last.as_ref().map(|r| (l.id.to_string(), r.setpoint)))
            .collect();
        gauges(
            encoder,
            (
                "loop_setpoint",
                "Setpoint in force, in the unit of the measurement",
                None,
            ),
            "loop",
            &setpoint,
        )
    }
}
