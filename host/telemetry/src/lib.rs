//! Metrics and traces for a collector, by OTLP (protobuf over HTTP).
//!
//! Owns: the way out: one thread that sends metrics, one that sends spans, their queues and time limits. It is off unless the
//! configuration has `[otlp]`. It knows nothing of loops: metrics come as the OpenMetrics text that `/metrics` serves, so both
//! ways say the same; spans come through `tracing`, from those with the target [`SPANS`].
//! Never: runs on a cycle's thread or makes one wait. Spans are made by the API and by deployment only; a full queue drops them.
//!
//! ```text
//! /metrics' text ──every_s──► parsed ──► OTLP messages ─┐
//!                                                       ├─HTTP, at most SEND_TIME_MAX─► collector
//! spans ──queue (SPANS_WAITING_MAX, full: dropped)──────┘        └ away: told once a minute, tried again with the next
//! ```

mod error;
mod http;
mod message;
mod metrics;
mod open_metrics;
mod spans;

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use serde::{Deserialize, Serialize};

pub use error::Error;
pub use spans::SpanLayer;

/// The target of spans that are meant for a collector. They stay out of the log.
pub const SPANS: &str = "bumpless::spans";

/// Longest time of one sending: below the shortest pause between two.
const SEND_TIME_MAX: Duration = Duration::from_secs(5);

/// Spans that wait to be sent: a minute of thirty requests a second.
const SPANS_WAITING_MAX: usize = 2_048;

/// Headers of a sending at most, and characters of one: for a collector's key.
const HEADERS_MAX: usize = 16;
const HEADER_CHARS_MAX: usize = 1_024;

/// Longest pause between two sendings of metrics, in s.
const EVERY_S_MAX: u64 = 3_600;

/// Where to, and what: the table `[otlp]` of a host's file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The collector, such as `http://127.0.0.1:4318`; `/v1/metrics` and `/v1/traces` are added. Plain HTTP: TLS ends at a
    /// collector on this machine.
    pub endpoint: String,
    /// Shall metrics be sent?
    #[serde(default = "yes")]
    pub metrics: bool,
    /// Shall spans be sent?
    #[serde(default = "yes")]
    pub traces: bool,
    /// Time between two sendings of metrics, in s, 5 to 3,600.
    #[serde(default = "every")]
    pub every_s: u64,
    /// Headers of each sending, for example the collector's key; at most 16.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub headers: BTreeMap<String, String>,
}

const fn yes() -> bool {
    true
}

const fn every() -> u64 {
    15
}

impl Config {
    /// Can it be meant?
    ///
    /// # Errors
    /// The key and what is wrong with it, in words.
    pub fn check(&self) -> Result<(), String> {
        let rest = self.endpoint.strip_prefix("http://");
        if rest.is_none_or(|rest| rest.is_empty() || rest.starts_with('/'))
            || self.endpoint.contains(char::is_whitespace)
        {
            return Err(format!(
                "endpoint = {:?}: write http://HOST:PORT (TLS ends at a collector on this machine)",
                self.endpoint
            ));
        }
        if !(SEND_TIME_MAX.as_secs()..=EVERY_S_MAX).contains(&self.every_s) {
            return Err(format!(
                "every_s = {}: use {} to {EVERY_S_MAX}",
                self.every_s,
                SEND_TIME_MAX.as_secs()
            ));
        }
        if self.headers.len() > HEADERS_MAX {
            return Err(format!("headers: {}, at most {HEADERS_MAX}", self.headers.len()));
        }
        let bad = |text: &str| text.chars().count() > HEADER_CHARS_MAX || !text.chars().all(|c| matches!(c, ' '..='~'));
        let name_char = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        for (name, value) in &self.headers {
            if name.is_empty() || bad(name) || !name.chars().all(name_char) || bad(value) {
                return Err(format!(
                    "headers: {name:?}: names have letters, digits and dashes, values printable ASCII of at most {HEADER_CHARS_MAX} \
                     characters"
                ));
            }
        }
        Ok(())
    }

    /// The address of one kind.
    fn address(&self, kind: &str) -> String {
        format!("{}/v1/{kind}", self.endpoint.trim_end_matches('/'))
    }
}

/// Who is speaking.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The host's name: `service.instance.id` and `host.name`.
    pub host: String,
    /// The cell's name: `service.namespace`.
    pub cell: String,
    /// Version of the program: `service.version`.
    pub version: String,
}

impl Identity {
    /// As the semantic conventions name it.
    fn attributes(&self) -> [(&'static str, &str); 5] {
        [
            ("service.name", "bumpless"),
            ("service.namespace", &self.cell),
            ("service.instance.id", &self.host),
            ("service.version", &self.version),
            ("host.name", &self.host),
        ]
    }
}

/// Gives the OpenMetrics text of the moment; none where it cannot be written.
pub type Source = Arc<dyn Fn() -> Option<String> + Send + Sync>;

/// What goes out.
#[derive(Debug)]
pub struct Telemetry {
    config: Config,
    identity: Identity,
    spans: Option<spans::Spans>,
    metrics: Option<metrics::Sender>,
}

impl Telemetry {
    /// Starts what sends spans. Metrics go out once they have a source.
    ///
    /// # Errors
    /// [`Error::Config`] for a table that cannot be meant, [`Error::Spans`].
    pub fn start(config: Config, identity: Identity) -> Result<Self, Error> {
        config.check().map_err(Error::Config)?;
        let spans = config
            .traces
            .then(|| spans::Spans::start(&config, &identity))
            .transpose()?;
        Ok(Self {
            config,
            identity,
            spans,
            metrics: None,
        })
    }

    /// What takes spans in, for the subscriber; none where no spans are sent.
    #[must_use]
    pub fn layer<S>(&self) -> Option<SpanLayer<S>>
    where
        S: tracing::Subscriber + for<'a> tracing_subscriber::registry::LookupSpan<'a>,
    {
        self.spans.as_ref().map(spans::Spans::layer)
    }

    /// Sends metrics from now on, where the configuration wants it.
    ///
    /// # Errors
    /// [`Error::Thread`].
    pub fn send_metrics(&mut self, source: Source) -> Result<(), Error> {
        if self.config.metrics && self.metrics.is_none() {
            self.metrics = Some(metrics::Sender::start(&self.config, &self.identity, source)?);
        }
        Ok(())
    }

    /// Sends what waits, once, and ends. Takes at most some seconds; call it where blocking is allowed.
    pub fn stop(self) {
        if let Some(metrics) = self.metrics {
            metrics.stop();
        }
        if let Some(spans) = self.spans {
            spans.stop();
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    pub(crate) fn config(endpoint: &str) -> Config {
        Config {
            endpoint: endpoint.to_owned(),
            metrics: true,
            traces: true,
            every_s: 5,
            headers: BTreeMap::new(),
        }
    }

    pub(crate) fn identity() -> Identity {
        Identity {
            host: "a".into(),
            cell: "demo".into(),
            version: "0.1.0".into(),
        }
    }

    #[test]
    fn tables_that_cannot_be_meant_are_told_with_their_key() {
        type Change = fn(&mut Config);
        let table: [(Change, &str); 7] = [
            (|c| c.endpoint = "https://x".into(), "endpoint = \"https://x\""),
            (|c| c.endpoint = "http:///x".into(), "write http://HOST:PORT"),
            (|c| c.endpoint = "http://a b".into(), "write http://HOST:PORT"),
            (|c| c.every_s = 4, "every_s = 4: use 5 to 3600"),
            (
                |c| c.headers = BTreeMap::from([("a b".into(), "x".into())]),
                "headers: \"a b\"",
            ),
            (
                |c| c.headers = BTreeMap::from([("a".into(), "x\n".into())]),
                "headers: \"a\"",
            ),
            (
                |c| c.headers = (0..17).map(|n| (format!("h{n}"), "x".into())).collect(),
                "headers: 17, at most 16",
            ),
        ];
        for (change, part) in table {
            let mut config = config("http://127.0.0.1:4318");
            assert_eq!(config.check(), Ok(()));
            change(&mut config);
            let words = config.check().expect_err(part);
            assert!(words.contains(part), "{words}");
        }
        assert_eq!(config("http://c:4318/").address("traces"), "http://c:4318/v1/traces");
    }
}
