//! Why telemetry cannot be sent at all. A collector that is away is no error: it is told in the log, and tried again.

/// What failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The table `[otlp]` cannot be meant.
    #[error("[otlp] {0}")]
    Config(String),
    /// The exporter of spans could not be made.
    #[error("spans cannot be sent: {0}; check [otlp] endpoint")]
    Spans(String),
    /// The thread that sends metrics could not be started.
    #[error("the thread that sends metrics cannot be started; check this machine's limit on threads")]
    Thread(#[source] std::io::Error),
}
