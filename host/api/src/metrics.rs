//! Metrics in the OpenMetrics text format, which Prometheus reads.
//!
//! Counts of this host come from the cell at the moment of the scrape; times are observed from the records of the cycles
//! that this host owned, so that the sum over all hosts counts each cycle once.
//! Names and units follow the conventions of Prometheus: base units, the unit at the end, `_total` behind counts.
//! docs/metrics.md lists them all. Never: a series without a bound; see the limits that begin with `METRIC`.

mod loops;
mod scrape;

use std::{collections::HashSet, fmt, sync::Arc, time::Duration};

use bumpless_core::{HostId, Record};
use bumpless_deploy::Deploy;
use prometheus_client::{
    encoding::text,
    metrics::{
        counter::Counter,
        family::Family,
        histogram::{Histogram, exponential_buckets},
        info::Info,
    },
    registry::{Registry, Unit},
};
use tokio::sync::{broadcast::error::RecvError, watch};

use crate::{cell::Cell, limits::METRIC_HOSTS_MAX};

/// The content type of the text format.
pub(crate) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(String, String)>;

/// Upper bounds for the times of requests, in s: from an answer from memory to the longest change.
const REQUEST_TIMES_S: [f64; 11] = [1e-3, 2.5e-3, 5e-3, 10e-3, 25e-3, 0.1, 0.25, 1.0, 2.5, 10.0, 40.0];

fn request_times() -> Histogram {
    Histogram::new(REQUEST_TIMES_S)
}

/// From 10 µs, what a local step takes, doubling up to 5 s, beyond which a histogram adds nothing to an alarm.
fn seconds() -> Histogram {
    Histogram::new(exponential_buckets(10e-6, 2.0, 20))
}

/// Everything that is measured on a host: what `/metrics` serves.
pub struct Metrics {
    cell: Arc<dyn Cell>,
    registry: Registry,
    step_seconds: Family<Labels, Histogram, fn() -> Histogram>,
    cycle_seconds: Histogram,
    commit_seconds: Histogram,
    records_missed: Counter,
    requests: Family<Labels, Counter>,
    request_seconds: Family<Labels, Histogram, fn() -> Histogram>,
    loops: loops::Loops,
}

impl fmt::Debug for Metrics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Metrics").finish_non_exhaustive()
    }
}

impl Metrics {
    /// Of a host, for [`crate::Options`] and for whoever else sends its text on.
    #[must_use]
    pub fn of(deploy: &Deploy) -> Arc<Self> {
        Arc::new(Self::new(Arc::new(deploy.clone())))
    }

    /// Registers everything. The cell is asked at each scrape.
    pub(crate) fn new(cell: Arc<dyn Cell>) -> Self {
        let metrics = Self {
            registry: Registry::with_prefix("bumpless"),
            step_seconds: Family::new_with_constructor(seconds),
            cycle_seconds: seconds(),
            commit_seconds: seconds(),
            records_missed: Counter::default(),
            requests: Family::default(),
            request_seconds: Family::new_with_constructor(request_times),
            loops: loops::Loops::new(),
            cell: Arc::clone(&cell),
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
        registry.register_with_unit(
            "http_request",
            "Time until the head of an answer, by method and route",
            Unit::Seconds,
            self.request_seconds.clone(),
        );
        self.loops.register(registry);
        let build = vec![
            ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
            ("host".to_owned(), cell.here().to_string()),
        ];
        registry.register(
            "build",
            "1, with the version of the program and the host's name",
            Info::new(build),
        );
        registry.register_collector(Box::new(scrape::Scrape { cell }));
        self
    }

    /// The text of one scrape.
    ///
    /// # Errors
    /// Where a value cannot be written, which is a fault of the program.
    pub fn text(&self) -> Result<String, fmt::Error> {
        let homes: HashSet<_> = self
            .cell
            .loops()
            .into_iter()
            .filter(|l| l.tally.is_some())
            .map(|l| l.id)
            .collect();
        self.loops.keep(|id| homes.contains(id));
        let mut out = String::new();
        text::encode(&mut out, &self.registry)?;
        Ok(out)
    }

    /// One request was answered. `route` is its pattern, of which there are as many as routes.
    pub(crate) fn answered(&self, method: &str, route: &str, status: u16, time: Duration) {
        let labels = vec![
            ("method".to_owned(), method.to_owned()),
            ("route".to_owned(), route.to_owned()),
        ];
        self.request_seconds.get_or_create(&labels).observe(time.as_secs_f64());
        let labels = vec![
            ("method".to_owned(), method.to_owned()),
            ("status".to_owned(), status.to_string()),
        ];
        self.requests.get_or_create(&labels).inc();
    }

    /// Observes one record: the times of its host if this one owned the cycle, those of its loop if it is at home here.
    fn observe(&self, record: &Record, here: &HostId, known: &mut HashSet<HostId>) {
        if record.home == *here {
            let period_ns = || {
                let view = self.cell.loop_view(&record.loop_id).ok()?;
                (view.spec.revision == record.revision).then_some(view.spec.period_ns)
            };
            self.loops.observe(record, period_ns);
        }
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
