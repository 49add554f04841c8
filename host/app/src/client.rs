//! Asks the API: one agent, one address, every failure an [`Error`] of the right sort.
//!
//! Never: repeats a request by itself; only the asker knows whether twice is right.

use std::{
    io::Read,
    net::{IpAddr, ToSocketAddrs as _},
    sync::Arc,
    time::Duration,
};

use bumpless_api::{Problem, types::Me};
use serde::{Serialize, de::DeserializeOwned};
use ureq::{
    Agent, Body, SendBody,
    http::{HeaderValue, Request, Response, StatusCode, header},
    middleware::MiddlewareNext,
    tls::{RootCerts, TlsConfig},
};

use crate::{error::Error, proof::Proof};

/// Longest wait for a connection: a host that does not take one in this time is not there.
const CONNECT_TIME_MAX: Duration = Duration::from_secs(3);
/// Longest wait for the head of an answer: above the longest that the API allows itself for a change.
const ANSWER_TIME_MAX: Duration = Duration::from_secs(160);
/// Longest wait where the cell compiles and tries what it is sent: above the longest that the API allows itself for that.
const WORK_TIME_MAX: Duration = Duration::from_secs(920);
/// Longest time for the rest of an answer.
const BODY_TIME_MAX: Duration = Duration::from_secs(120);
/// Parts of a list at most: with the API's default, a million rows.
const PARTS_MAX: u32 = 1_000;
/// Bytes of an answer: the longest list of loops has some tens of MB.
const ANSWER_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// A way to one host's API.
#[derive(Debug, Clone)]
pub(crate) struct Client {
    agent: Agent,
    base: String,
    /// Who asks, for the audit trail.
    by: String,
    /// What is shown to hosts.
    proof: Proof,
}

/// The text of a good answer.
pub(crate) struct Answer {
    api: String,
    pub(crate) text: String,
}

impl Answer {
    /// What the text means.
    pub(crate) fn decode<T: DeserializeOwned>(&self) -> Result<T, Error> {
        serde_json::from_str(&self.text).map_err(|error| Error::Answer {
            api: self.api.clone(),
            reason: format!("its JSON: {error}"),
        })
    }
}

impl Client {
    /// For the API at `api`, such as `http://127.0.0.1:8480`, without a credential.
    pub(crate) fn new(api: &str) -> Result<Self, Error> {
        Self::with(api, Proof::default())
    }

    /// For the API at `api`, with what is shown to it.
    pub(crate) fn with(api: &str, proof: Proof) -> Result<Self, Error> {
        Self::sending(api, proof, Vec::new())
    }

    /// The same for another host of the cell.
    pub(crate) fn at(&self, api: &str) -> Result<Self, Error> {
        Self::with(api, self.proof.clone())
    }

    /// With headers that go with every request.
    fn sending(api: &str, proof: Proof, more: Vec<(header::HeaderName, HeaderValue)>) -> Result<Self, Error> {
        let base = api.trim_end_matches('/').to_owned();
        let plain = base.strip_prefix("http://");
        if plain.is_none() && !base.starts_with("https://") {
            return Err(Error::Usage(format!(
                "{api:?} is no address of an API: write it as http://HOST:PORT or https://HOST:PORT"
            )));
        }
        let mut headers = more;
        headers.extend(proof.bearer.clone().map(|bearer| (header::AUTHORIZATION, bearer)));
        if !headers.is_empty() && plain.is_some_and(|authority| !stays_here(authority)) {
            return Err(Error::Usage(format!(
                "{api} has no TLS, and everybody on the way would read the token; write it as https://HOST:PORT"
            )));
        }
        let headers = Arc::new(headers);
        let with_headers = move |mut request: Request<SendBody>, next: MiddlewareNext| {
            for (name, value) in headers.iter() {
                request.headers_mut().insert(name, value.clone());
            }
            next.handle(request)
        };
        let roots = proof
            .roots
            .as_ref()
            .map_or(RootCerts::WebPki, |roots| RootCerts::new_with_certs(roots));
        let config = Agent::config_builder()
            .http_status_as_error(false)
            .timeout_connect(Some(CONNECT_TIME_MAX))
            .timeout_recv_response(Some(ANSWER_TIME_MAX))
            // The API is meant as it was typed; proxies are for the world outside.
            .proxy(None)
            .max_redirects(0)
            .tls_config(TlsConfig::builder().root_certs(roots).build())
            .middleware(with_headers)
            .user_agent(concat!("bumpless/", env!("CARGO_PKG_VERSION")))
            .build();
        Ok(Self {
            agent: config.into(),
            base,
            by: who(),
            proof,
        })
    }

    /// Signs in: who one is then, and a client that is in the session.
    pub(crate) fn session(&self, path: &str, body: &impl Serialize) -> Result<(Me, Self), Error> {
        let response = self.good(self.agent.post(self.url(path)).header("x-by", &self.by).send_json(body))?;
        let odd = |reason: &str| Error::Answer {
            api: self.base.clone(),
            reason: reason.to_owned(),
        };
        let cookie = response
            .headers()
            .get(header::SET_COOKIE)
            .and_then(|value| value.to_str().ok());
        let cookie = cookie
            .and_then(|text| text.split(';').next())
            .ok_or_else(|| odd("it sets no cookie"))?;
        let mut cookie = HeaderValue::try_from(cookie).map_err(|_| odd("its cookie"))?;
        cookie.set_sensitive(true);
        let me: Me = self.answer(Ok(response))?.decode()?;
        let csrf = me.csrf.as_deref().ok_or_else(|| odd("it has no second secret"))?;
        let csrf = HeaderValue::try_from(csrf).map_err(|_| odd("its second secret"))?;
        // In the session, and in no other's name.
        let proof = Proof {
            bearer: None,
            ..self.proof.clone()
        };
        let headers = vec![
            (header::COOKIE, cookie),
            (header::HeaderName::from_static("x-csrf-token"), csrf),
        ];
        Ok((me, Self::sending(&self.base, proof, headers)?))
    }

    fn url(&self, path: &str) -> String {
        format!("{}{path}", self.base)
    }

    /// The address.
    pub(crate) fn api(&self) -> &str {
        &self.base
    }

    fn unreachable(&self, error: &ureq::Error) -> Error {
        Error::Unreachable {
            api: self.base.clone(),
            reason: error.to_string(),
        }
    }

    /// The text of a good answer, or the problem in it.
    fn answer(&self, response: Result<Response<Body>, ureq::Error>) -> Result<Answer, Error> {
        let response = self.good(response)?;
        let mut body = response.into_body();
        let text = body
            .with_config()
            .limit(ANSWER_BYTES_MAX)
            .read_to_string()
            .map_err(|e| self.unreachable(&e))?;
        Ok(Answer {
            api: self.base.clone(),
            text,
        })
    }

    /// A good answer whose body is still to be read, or the problem in it.
    fn good(&self, response: Result<Response<Body>, ureq::Error>) -> Result<Response<Body>, Error> {
        let response = response.map_err(|error| self.unreachable(&error))?;
        let status = response.status();
        if status.is_success() {
            return Ok(response);
        }
        let text = response
            .into_body()
            .with_config()
            .limit(ANSWER_BYTES_MAX)
            .read_to_string();
        let text = text.map_err(|error| self.unreachable(&error))?;
        Err(self.problem(status, &text))
    }

    fn problem(&self, status: StatusCode, text: &str) -> Error {
        match serde_json::from_str::<Problem>(text) {
            Ok(problem) => Error::Problem(Box::new(problem)),
            Err(_) => Error::Answer {
                api: self.base.clone(),
                reason: format!("status {status} without a problem in JSON; is this the API of a host?"),
            },
        }
    }

    /// `GET` with a time limit on the body.
    pub(crate) fn get(&self, path: &str) -> Result<Answer, Error> {
        let request = self.agent.get(self.url(path)).header("x-by", &self.by);
        self.answer(request.config().timeout_recv_body(Some(BODY_TIME_MAX)).build().call())
    }

    /// `GET` of a list in all its parts, as one answer. `rows` is the key of its rows.
    pub(crate) fn list(&self, path: &str, rows: &str) -> Result<Answer, Error> {
        let mut answer = self.get(path)?;
        let mut all: serde_json::Value = answer.decode()?;
        let mut parts = 1;
        while let Some(next) = all.get("next").and_then(serde_json::Value::as_str) {
            if parts == PARTS_MAX {
                return Err(Error::Answer {
                    api: self.base.clone(),
                    reason: format!("a list in more than {PARTS_MAX} parts"),
                });
            }
            parts += 1;
            let sign = if path.contains('?') { '&' } else { '?' };
            let mut part: serde_json::Value = self.get(&format!("{path}{sign}after={}", encoded(next)))?.decode()?;
            let (following, next) = (part[rows].take(), part["next"].take());
            if let (Some(all), serde_json::Value::Array(following)) = (all[rows].as_array_mut(), following) {
                all.extend(following);
            }
            all["next"] = next;
            answer.text = all.to_string();
        }
        Ok(answer)
    }

    /// `GET` of raw bytes, at most `bytes_max`.
    pub(crate) fn bytes(&self, path: &str, bytes_max: u64) -> Result<Vec<u8>, Error> {
        let request = self.agent.get(self.url(path)).header("x-by", &self.by);
        let request = request
            .config()
            .timeout_recv_response(Some(WORK_TIME_MAX))
            .timeout_recv_body(Some(BODY_TIME_MAX));
        let response = self.good(request.build().call())?;
        response
            .into_body()
            .with_config()
            .limit(bytes_max)
            .read_to_vec()
            .map_err(|error| self.unreachable(&error))
    }

    /// `GET` of a body without an end, to be read piece by piece. A silence longer than `silence_max` ends it.
    pub(crate) fn stream(&self, path: &str, silence_max: Duration) -> Result<impl Read + Send + use<>, Error> {
        let request = self.agent.get(self.url(path)).header("x-by", &self.by);
        let response = self.good(request.config().timeout_per_read(Some(silence_max)).build().call())?;
        Ok(response.into_body().into_with_config().limit(u64::MAX).reader())
    }

    /// `POST` of JSON.
    pub(crate) fn post(&self, path: &str, body: &impl Serialize) -> Result<Answer, Error> {
        self.answer(self.agent.post(self.url(path)).header("x-by", &self.by).send_json(body))
    }

    /// `PUT` of JSON.
    pub(crate) fn put(&self, path: &str, body: &impl Serialize) -> Result<Answer, Error> {
        self.answer(self.agent.put(self.url(path)).header("x-by", &self.by).send_json(body))
    }

    /// `DELETE`.
    pub(crate) fn delete(&self, path: &str) -> Result<Answer, Error> {
        self.answer(self.agent.delete(self.url(path)).header("x-by", &self.by).call())
    }

    /// `PATCH` of JSON.
    pub(crate) fn patch(&self, path: &str, body: &impl Serialize) -> Result<Answer, Error> {
        self.answer(
            self.agent
                .patch(self.url(path))
                .header("x-by", &self.by)
                .send_json(body),
        )
    }

    /// `POST` of `length` bytes of a type, which the cell may work on for long.
    pub(crate) fn send_file(
        &self,
        path: &str,
        content_type: &str,
        length: u64,
        bytes: &mut dyn Read,
    ) -> Result<Answer, Error> {
        let request = self
            .agent
            .post(self.url(path))
            .header("x-by", &self.by)
            .config()
            .timeout_recv_response(Some(WORK_TIME_MAX))
            .build()
            .header("content-type", content_type)
            .header("content-length", length.to_string());
        self.answer(request.send(SendBody::from_reader(bytes)))
    }
}

/// Does this authority mean this machine?
fn stays_here(authority: &str) -> bool {
    let host = match authority.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((host, _)) => host,
        None => authority.rsplit_once(':').map_or(authority, |(host, _)| host),
    };
    match host.parse::<IpAddr>() {
        Ok(address) => address.to_canonical().is_loopback(),
        Err(_) => {
            let found = (host, 80)
                .to_socket_addrs()
                .map(|all| all.map(|a| a.ip()).collect::<Vec<_>>());
            found.is_ok_and(|all| !all.is_empty() && all.iter().all(IpAddr::is_loopback))
        }
    }
}

/// The name that goes with each request: `BUMPLESS_BY`, else the user's. What is no letter of ASCII is left out, for it would be
/// read in different ways.
fn who() -> String {
    let name = std::env::var("BUMPLESS_BY").or_else(|_| std::env::var("USER"));
    let name = name.unwrap_or_default();
    name.chars()
        .filter(|c| c.is_ascii_graphic() || *c == ' ')
        .take(200)
        .collect()
}

/// One segment of a path or one value of a query, percent-encoded (RFC 3986): unreserved characters and `@` stay.
pub(crate) fn encoded(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for byte in text.bytes() {
        if byte.is_ascii_alphanumeric() || b"-._~@".contains(&byte) {
            out.push(char::from(byte));
        } else {
            out.push_str(&format!("%{byte:02X}"));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_and_the_rest_is_encoded() {
        assert_eq!(encoded("pid@1.0.0"), "pid@1.0.0");
        assert_eq!(encoded("../a b?ü"), "..%2Fa%20b%3F%C3%BC");
    }

    #[test]
    fn addresses_are_checked() {
        let error = Client::new("127.0.0.1:8480").expect_err("no scheme");
        assert!(error.to_string().contains("http://HOST:PORT"), "{error}");
        let proof = || Proof {
            bearer: crate::proof::bearer("bpl_1").ok(),
            roots: None,
        };
        let error = Client::with("http://192.0.2.1:8480", proof()).expect_err("in the clear");
        assert!(error.to_string().contains("https://HOST:PORT"), "{error}");
        for good in [
            "https://192.0.2.1:8480",
            "http://127.0.0.1:1",
            "http://[::1]:1",
            "http://localhost:1",
        ] {
            assert!(Client::with(good, proof()).is_ok(), "{good}");
        }
        assert!(
            Client::new("http://192.0.2.1:8480").is_ok(),
            "without a token there is nothing to read"
        );
        assert_eq!(
            Client::new("http://127.0.0.1:8480/").expect("good").api(),
            "http://127.0.0.1:8480"
        );
    }

    #[test]
    fn an_api_that_is_not_there_is_said_to_be_so() {
        // A port that was free a moment ago, on which nobody listens now.
        let port = std::net::TcpListener::bind("127.0.0.1:0")
            .and_then(|l| l.local_addr())
            .expect("a port")
            .port();
        let client = Client::new(&format!("http://127.0.0.1:{port}")).expect("good");
        let error = client.get("/v1/hosts").map(|_| ()).expect_err("nobody there");
        assert_eq!(error.exit_code(), 4, "{error}");
        assert!(error.report().contains("bumpless demo"), "{}", error.report());
    }
}
