//! The one way out: a blocking HTTP client with time limits, used by threads of their own.
//!
//! Never: follows redirects, uses a proxy, or reads more of an answer than it needs.

use std::{
    future::{Future, ready},
    pin::Pin,
};

use opentelemetry_http::{Bytes, HttpClient, HttpError, Request, Response};
use ureq::Agent;

use crate::SEND_TIME_MAX;

/// Bytes of a collector's answer that are read: it says which parts it refused.
const ANSWER_BYTES_MAX: u64 = 64 * 1024;

/// Sends to a collector.
#[derive(Debug, Clone)]
pub(crate) struct Client(Agent);

impl Client {
    pub(crate) fn new() -> Self {
        let config = Agent::config_builder()
            .http_status_as_error(false)
            .timeout_global(Some(SEND_TIME_MAX))
            .proxy(None)
            .max_redirects(0)
            .user_agent(concat!("bumpless/", env!("CARGO_PKG_VERSION")))
            .build();
        Self(config.into())
    }

    /// Sends one request and gives its answer, whatever its status.
    pub(crate) fn send(&self, request: Request<Bytes>) -> Result<Response<Bytes>, ureq::Error> {
        let (parts, body) = request.into_parts();
        let answer = self.0.run(Request::from_parts(parts, body.as_ref()))?;
        let (parts, mut body) = answer.into_parts();
        let bytes = body.with_config().limit(ANSWER_BYTES_MAX).read_to_vec()?;
        Ok(Response::from_parts(parts, bytes.into()))
    }
}

impl HttpClient for Client {
    // Written out as the macro of the trait does it. It blocks: the exporter has a thread of its own.
    fn send_bytes<'a, 'b>(
        &'a self,
        request: Request<Bytes>,
    ) -> Pin<Box<dyn Future<Output = Result<Response<Bytes>, HttpError>> + Send + 'b>>
    where
        'a: 'b,
        Self: 'b,
    {
        Box::pin(ready(self.send(request).map_err(Into::into)))
    }
}
