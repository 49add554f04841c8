//! Metrics in the OpenMetrics text format, which Prometheus reads.
//!
//! Counts of this host come from the cell at the moment of the scrape; times are observed from the records of the cycles
//! that this host owned, so that the sum over all hosts counts each cycle once.
//! Never: a series without a bound; see [`METRIC_LOOPS_MAX`] and [`METRIC_HOSTS_MAX`].

use std::{collections::HashSet, fmt, sync::Arc};

use bumpless_core::{HostId, Record};
use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeCounterValue, EncodeGaugeValue, EncodeMetric as _, NoLabelSet, text},
    metrics::{
        MetricType,
        counter::{ConstCounter, Counter},
        family::Family,
        gauge::ConstGauge,
        histogram::{Histogram, exponential_buckets},
    },
    registry::{Registry, Unit},
};
use tokio::sync::{broadcast::error::RecvError, watch};

use crate::{
    cell::Cell,
    limits::{METRIC_HOSTS_MAX, METRIC_LOOPS_MAX},
};

/// The content type of the text format.
pub(crate) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(String, String)>;

/// From 10 µs, what a local step takes, doubling up to 5 s, beyond which a histogram adds nothing to an alarm.
fn seconds() -> Histogram {
    Histogram::new(exponential_buckets(10e-6, 2.0, 20))
}

/// Everything that is measured.
pub(crate) struct Metrics {
    registry: Registry,
    step_seconds: Family<Labels, Histogram, fn() -> Histogram>,
    cycle_seconds: Histogram,
    commit_seconds: Histogram,
    records_missed: Counter,
    requests: Family<Labels, Counter>,
}

impl Metrics {
    /// Registers everything. The cell is asked at each scrape.
    pub(crate) fn new(cell: Arc<dyn Cell>) -> Self {
        let metrics = Self {
            registry: Registry::with_prefix("bumpless"),
            step_seconds: Family::new_with_constructor(seconds),
            cycle_seconds: seconds(),
            commit_seconds: seconds(),
            records_missed: Counter::default(),
            requests: Family::default(),
        };
        metrics.registered(cell)
    }

    fn registered(mut self, cell: Arc<dyn Cell>) -> Self {
        let registry = &mut self.registry;
        registry.register_with_unit(
            "step",
            "Time of a step as the owner saw it, network included, by the host that stepped; cycles owned by this host",
            Unit::Seconds,
            self.step_seconds.clone(),
        );
        registry.register_with_unit(
            "cycle",
            "Time from a sample's arrival at the owner to its commit; cycles owned by this host",
            Unit::Seconds,
            self.cycle_seconds.clone(),
        );
        registry.register_with_unit(
            "commit",
            "Time from a cycle's deadline to the actuator's write; cycles owned by this host",
            Unit::Seconds,
            self.commit_seconds.clone(),
        );
        registry.register(
            "metric_records_missed",
            "Records that these metrics did not see because they came too fast",
            self.records_missed.clone(),
        );
        registry.register(
            "http_requests",
            "Requests answered, by method and status",
            self.requests.clone(),
        );
        registry.register_collector(Box::new(Scrape { cell }));
        self
    }

    /// The text of one scrape.
    pub(crate) fn text(&self) -> Result<String, fmt::Error> {
        let mut out = String::new();
        text::encode(&mut out, &self.registry)?;
        Ok(out)
    }

    /// One request was answered.
    pub(crate) fn answered(&self, method: &str, status: u16) {
        let labels = vec![
            ("method".to_owned(), method.to_owned()),
            ("status".to_owned(), status.to_string()),
        ];
        self.requests.get_or_create(&labels).inc();
    }

    /// Observes one record, if this host owned its cycle.
    fn observe(&self, record: &Record, here: &HostId, known: &mut HashSet<HostId>) {
        if record.owner != *here {
            return;
        }
        let named = known.contains(&record.stepped_by)
            || (known.len() < METRIC_HOSTS_MAX && known.insert(record.stepped_by.clone()));
        let host = if named { record.stepped_by.as_str() } else { "other" };
        let labels = vec![("host".to_owned(), host.to_owned())];
        self.step_seconds
            .get_or_create(&labels)
            .observe(record.step_ns as f64 * 1e-9);
        self.cycle_seconds.observe(record.cycle_ns as f64 * 1e-9);
        self.commit_seconds.observe(record.committed_after_ns as f64 * 1e-9);
    }

    /// Observes records until the host stops.
    pub(crate) async fn follow(self: Arc<Self>, cell: Arc<dyn Cell>, mut stop: watch::Receiver<bool>) {
        let (here, mut known) = (cell.here(), HashSet::new());
        let mut records = cell.records();
        loop {
            let next = tokio::select! {
                biased;
                _ = stop.wait_for(|stop| *stop) => return,
                next = records.recv() => next,
            };
            match next {
                Ok(record) => self.observe(&record, &here, &mut known),
                Err(RecvError::Lagged(missed)) => {
                    self.records_missed.inc_by(missed);
                }
                Err(RecvError::Closed) => return,
            }
        }
    }
}

/// Asks the cell at each scrape.
struct Scrape {
    cell: Arc<dyn Cell>,
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
            ("components", "Components in the library", c.components),
            ("cycle_log_bytes", "Bytes of recorded cycles on disk", c.cycle_log_bytes),
        ] {
            let metric = ConstGauge::new(value);
            metric.encode(encoder.encode_descriptor(name, help, None, metric.metric_type())?)?;
        }
        self.hosts(&mut encoder)?;
        self.loops(&mut encoder)
    }
}

/// One labelled value per row.
fn gauges<V: EncodeGaugeValue>(
    encoder: &mut DescriptorEncoder<'_>,
    (name, help): (&str, &str),
    label: &str,
    rows: &[(String, V)],
) -> fmt::Result {
    let mut metric = encoder.encode_descriptor(name, help, None, MetricType::Gauge)?;
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
            ("host_alive", "1 while the host is alive, as this host sees it"),
            "host",
            &alive,
        )?;
        let cpu = rows(&|h| f64::from(h.cpu));
        gauges(
            encoder,
            ("host_cpu_ratio", "Load of the cores that the host may use, 0 to 1"),
            "host",
            &cpu,
        )?;
        let memory = rows(&|h| h.memory_bytes as f64);
        gauges(
            encoder,
            ("host_memory_bytes", "Resident bytes of the host"),
            "host",
            &memory,
        )?;
        let latency: Vec<(String, f64)> = hosts
            .iter()
            .filter_map(|h| h.latency_ns.map(|ns| (h.id.to_string(), ns as f64 * 1e-9)))
            .collect();
        let help = "Smoothed latency of a step on the host, as this host measures it";
        gauges(encoder, ("host_latency_seconds", help), "host", &latency)
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
            ("loop_record_age_seconds", "Age of the last record"),
            "loop",
            &age,
        )?;
        let setpoint: Vec<(String, f64)> = home()
            .filter_map(|(l, _)| l.last.as_ref().map(|r| (l.id.to_string(), r.setpoint)))
            .collect();
        gauges(
            encoder,
            ("loop_setpoint", "Setpoint in force, in the unit of the measurement"),
            "loop",
            &setpoint,
        )
    }
}
