//! The log of a host: lines on the error output, and spans for a collector where one is configured.
//!
//! Never: writes a span into the log, or a line to the collector.

use std::io::IsTerminal as _;

use bumpless_telemetry::{SPANS, Telemetry};
use tracing_subscriber::{
    EnvFilter, Layer as _,
    filter::{FilterExt as _, filter_fn},
    layer::SubscriberExt as _,
    util::SubscriberInitExt as _,
};

use crate::cli::LogFormat;

/// Log lines where BUMPLESS_LOG says nothing: ours from info up, the bus's only when something is wrong.
const LOG_DEFAULT: &str = "info,zenoh=warn,zenoh_transport=error,zenoh_link_commons=error";

/// Log lines go to the error output; the standard output is for the line that says "ready".
pub(crate) fn start(format: LogFormat, telemetry: Option<&Telemetry>) {
    let filter = EnvFilter::try_from_env("BUMPLESS_LOG").unwrap_or_else(|_| EnvFilter::new(LOG_DEFAULT));
    // Spans are for the collector: in front of each line they would say the same again and again.
    let filter = filter.and(filter_fn(|metadata| {
        !(metadata.is_span() && metadata.target() == SPANS)
    }));
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal());
    let spans = telemetry.and_then(Telemetry::layer);
    let all = tracing_subscriber::registry().with(spans);
    // Only one log can be set; whoever set one before (a test) keeps it.
    let _ = match format {
        LogFormat::Text => all.with(lines.with_filter(filter)).try_init(),
        LogFormat::Json => all.with(lines.json().with_filter(filter)).try_init(),
    };
}

#[cfg(test)]
mod tests {
    #[test]
    fn both_ends_mean_the_same_spans() {
        assert_eq!(bumpless_telemetry::SPANS, bumpless_deploy::SPANS);
    }
}
