//! Sends metrics: a thread of its own that reads the text, turns it into a message and posts it.
//!
//! ```text
//! waiting ──every_s──► sending ──► waiting
//!    └ stop ──► sending once more ──► ended
//! ```
//! What could not be sent is not kept: all numbers are cumulative, so the next sending says it all. Never: waits for the collector
//! longer than `SEND_TIME_MAX`.

use std::{
    sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel},
    thread::JoinHandle,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use opentelemetry_http::{Bytes, Request};
use prost::Message as _;

use crate::{
    Config, Error, Identity, Source,
    http::Client,
    message::{self, Times},
    open_metrics,
};

/// A collector that is away is told of so often.
const COMPLAIN_EVERY: Duration = Duration::from_secs(60);

/// The thread that sends.
#[derive(Debug)]
pub(crate) struct Sender {
    stop: SyncSender<()>,
    thread: JoinHandle<()>,
}

impl Sender {
    pub(crate) fn start(config: &Config, identity: &Identity, source: Source) -> Result<Self, Error> {
        let (stop, stopped) = sync_channel::<()>(1);
        let every = Duration::from_secs(config.every_s);
        let mut post = Post {
            address: config.address("metrics"),
            headers: config.headers.clone().into_iter().collect(),
            identity: identity.clone(),
            source,
            client: Client::new(),
            began_ns: unix_ns(),
            complained: None,
        };
        let work = move || {
            loop {
                let end = stopped.recv_timeout(every);
                post.once();
                if !matches!(end, Err(RecvTimeoutError::Timeout)) {
                    return;
                }
            }
        };
        let thread = std::thread::Builder::new()
            .name("otlp-metrics".to_owned())
            .spawn(work)
            .map_err(Error::Thread)?;
        Ok(Self { stop, thread })
    }

    /// Sends once more, and ends.
    pub(crate) fn stop(self) {
        // A full channel has been told already.
        let _ = self.stop.try_send(());
        if self.thread.join().is_err() {
            tracing::warn!("the thread that sends metrics ended with a panic");
        }
    }
}

struct Post {
    address: String,
    headers: Vec<(String, String)>,
    identity: Identity,
    source: Source,
    client: Client,
    began_ns: u64,
    complained: Option<Instant>,
}

impl Post {
    fn once(&mut self) {
        let Some(text) = (self.source)() else { return };
        let (families, strange) = open_metrics::families(&text);
        if strange > 0 {
            tracing::debug!(strange, "lines of the metrics were passed over");
        }
        let times = Times {
            began_ns: self.began_ns,
            now_ns: unix_ns(),
        };
        let body = message::request(&families, &self.identity, times).encode_to_vec();
        if let Err(reason) = self.post(body) {
            if self.complained.is_none_or(|at| at.elapsed() >= COMPLAIN_EVERY) {
                tracing::warn!(address = self.address, reason, "metrics were not sent");
                self.complained = Some(Instant::now());
            }
        } else if self.complained.take().is_some() {
            tracing::info!(address = self.address, "metrics are sent again");
        }
    }

    fn post(&self, body: Vec<u8>) -> Result<(), String> {
        let mut request = Request::post(&self.address).header("content-type", "application/x-protobuf");
        for (name, value) in &self.headers {
            request = request.header(name, value);
        }
        let request = request.body(Bytes::from(body)).map_err(|error| error.to_string())?;
        let answer = self.client.send(request).map_err(|error| error.to_string())?;
        if answer.status().is_success() {
            return Ok(());
        }
        Err(format!("the collector answered {}", answer.status()))
    }
}

fn unix_ns() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}
