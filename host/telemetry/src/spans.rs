//! Spans on their way to the collector: a bounded queue and a thread of the exporter's own.
//!
//! Never: takes an event, or a span that is not meant for a collector.

use std::time::Duration;

use opentelemetry::{KeyValue, trace::TracerProvider as _};
use opentelemetry_otlp::{Protocol, SpanExporter, WithExportConfig as _, WithHttpConfig as _};
use opentelemetry_sdk::{
    Resource,
    trace::{BatchConfigBuilder, BatchSpanProcessor, SdkTracer, SdkTracerProvider},
};
use tracing::{Metadata, Subscriber};
use tracing_opentelemetry::OpenTelemetryLayer;
use tracing_subscriber::{
    Layer as _,
    filter::{FilterFn, Filtered, filter_fn},
    registry::LookupSpan,
};

use crate::{Config, Error, Identity, SEND_TIME_MAX, SPANS, SPANS_WAITING_MAX, http::Client};

/// Pause between two sendings.
const SEND_EVERY: Duration = Duration::from_secs(2);

/// Spans of one sending.
const SPANS_AT_ONCE: usize = 256;

/// Takes the spans of a subscriber that are meant for a collector.
pub type SpanLayer<S> = Filtered<OpenTelemetryLayer<S, SdkTracer>, FilterFn<fn(&Metadata<'_>) -> bool>, S>;

/// What sends spans.
#[derive(Debug)]
pub(crate) struct Spans(SdkTracerProvider);

fn meant(metadata: &Metadata<'_>) -> bool {
    metadata.is_span() && metadata.target() == SPANS
}

impl Spans {
    pub(crate) fn start(config: &Config, identity: &Identity) -> Result<Self, Error> {
        let exporter = SpanExporter::builder()
            .with_http()
            .with_http_client(Client::new())
            .with_protocol(Protocol::HttpBinary)
            .with_endpoint(config.address("traces"))
            .with_headers(config.headers.clone().into_iter().collect())
            .with_timeout(SEND_TIME_MAX)
            .build()
            .map_err(|error| Error::Spans(error.to_string()))?;
        let batch = BatchConfigBuilder::default()
            .with_max_queue_size(SPANS_WAITING_MAX)
            .with_max_export_batch_size(SPANS_AT_ONCE)
            .with_scheduled_delay(SEND_EVERY)
            .build();
        let attributes = identity
            .attributes()
            .map(|(key, value)| KeyValue::new(key, value.to_owned()));
        let resource = Resource::builder_empty().with_attributes(attributes).build();
        let processor = BatchSpanProcessor::builder(exporter).with_batch_config(batch).build();
        Ok(Self(
            SdkTracerProvider::builder()
                .with_span_processor(processor)
                .with_resource(resource)
                .build(),
        ))
    }

    pub(crate) fn layer<S: Subscriber + for<'a> LookupSpan<'a>>(&self) -> SpanLayer<S> {
        tracing_opentelemetry::layer()
            .with_tracer(self.0.tracer("bumpless"))
            .with_location(false)
            .with_threads(false)
            .with_target(false)
            .with_filter(filter_fn(meant as fn(&Metadata<'_>) -> bool))
    }

    /// Sends what waits, and ends.
    pub(crate) fn stop(self) {
        if let Err(error) = self.0.shutdown_with_timeout(SEND_TIME_MAX) {
            tracing::debug!(%error, "the last spans were not sent");
        }
    }
}
