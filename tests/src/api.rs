//! A thin client of a host's API: what a user's own script would do.

use std::{collections::BTreeMap, fmt::Debug, path::Path, time::Duration};

use serde_json::{Value, json};
use ureq::http;

use crate::{Error, Feed, WAIT_MAX, wait_until};

/// Longest request: beyond what the host itself allows.
const REQUEST_MAX: Duration = Duration::from_secs(160);

/// Longest answer that is read, in bytes.
const ANSWER_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// An answer, whatever its status.
#[derive(Debug, Clone)]
pub struct Answer {
    /// HTTP status.
    pub status: u16,
    /// Headers, names in lower case.
    pub headers: BTreeMap<String, String>,
    /// The body.
    pub body: Vec<u8>,
}

impl Answer {
    /// The body as text.
    #[must_use]
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    /// The body as JSON; null where it is none.
    #[must_use]
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_default()
    }

    /// Is it a success?
    #[must_use]
    pub const fn ok(&self) -> bool {
        self.status >= 200 && self.status < 300
    }
}

/// A host's API.
#[derive(Debug, Clone)]
pub struct Api {
    base: String,
    agent: ureq::Agent,
}

impl Api {
    /// The API at an address such as `http://127.0.0.1:8480`.
    #[must_use]
    pub fn new(base: impl Into<String>) -> Self {
        Self::within(base, REQUEST_MAX)
    }

    /// The same, with another longest time for a request.
    #[must_use]
    pub fn within(base: impl Into<String>, longest: Duration) -> Self {
        let agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            // The hosts are on this machine; proxies are for the world outside.
            .proxy(None)
            .timeout_connect(Some(Duration::from_secs(5)))
            .timeout_global(Some(longest))
            .build()
            .into();
        Self {
            base: base.into(),
            agent,
        }
    }

    /// Its address.
    #[must_use]
    pub fn base(&self) -> &str {
        &self.base
    }

    /// Any request, with any answer.
    ///
    /// # Errors
    /// [`Error::Http`] where no answer comes.
    pub fn send(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Result<Answer, Error> {
        let url = format!("{}{path}", self.base);
        let failed = |source: ureq::Error| Error::Http {
            method: method.to_owned(),
            url: url.clone(),
            source: Box::new(source),
        };
        let mut request = http::Request::builder().method(method).uri(&url);
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        // A body where the method has none is refused by the client itself.
        let answer = if body.is_empty() && !matches!(method, "POST" | "PUT" | "PATCH") {
            request
                .body(())
                .map_err(ureq::Error::from)
                .and_then(|request| self.agent.run(request))
        } else {
            request
                .body(body)
                .map_err(ureq::Error::from)
                .and_then(|request| self.agent.run(request))
        };
        let mut answer = answer.map_err(failed)?;
        let headers = answer
            .headers()
            .iter()
            .map(|(name, value)| {
                (
                    name.as_str().to_owned(),
                    String::from_utf8_lossy(value.as_bytes()).into_owned(),
                )
            })
            .collect();
        let body = answer
            .body_mut()
            .with_config()
            .limit(ANSWER_BYTES_MAX)
            .read_to_vec()
            .map_err(failed)?;
        Ok(Answer {
            status: answer.status().as_u16(),
            headers,
            body,
        })
    }

    /// A request that must succeed. Null where the answer has no body.
    ///
    /// # Errors
    /// [`Error::Refused`] with the problem in words, or [`Error::Http`].
    pub fn ask(&self, method: &str, path: &str, body: Option<&Value>) -> Result<Value, Error> {
        let text = body.map(Value::to_string).unwrap_or_default();
        let headers: &[(&str, &str)] = if body.is_some() {
            &[("content-type", "application/json")]
        } else {
            &[]
        };
        self.success(method, path, &self.send(method, path, headers, text.as_bytes())?)
    }

    fn success(&self, method: &str, path: &str, answer: &Answer) -> Result<Value, Error> {
        let url = format!("{}{path}", self.base);
        if !answer.ok() {
            return Err(Error::Refused {
                method: method.to_owned(),
                url,
                status: answer.status,
                body: answer.text(),
            });
        }
        if answer.body.is_empty() {
            return Ok(Value::Null);
        }
        serde_json::from_slice(&answer.body).map_err(|source| Error::Json {
            url,
            text: answer.text().chars().take(300).collect(),
            source,
        })
    }

    /// GET.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn get(&self, path: &str) -> Result<Value, Error> {
        self.ask("GET", path, None)
    }

    /// POST with a JSON body.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn post(&self, path: &str, body: &Value) -> Result<Value, Error> {
        self.ask("POST", path, Some(body))
    }

    /// PUT with a JSON body.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn put(&self, path: &str, body: &Value) -> Result<Value, Error> {
        self.ask("PUT", path, Some(body))
    }

    /// DELETE.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn delete(&self, path: &str) -> Result<Value, Error> {
        self.ask("DELETE", path, None)
    }

    /// Uploads the bytes of a component.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn upload_bytes(&self, bytes: &[u8]) -> Result<Value, Error> {
        let path = "/v1/components";
        let answer = self.send("POST", path, &[("content-type", "application/wasm")], bytes)?;
        self.success("POST", path, &answer)
    }

    /// Uploads a component from a file.
    ///
    /// # Errors
    /// [`Error::File`], or as [`Api::ask`].
    pub fn upload(&self, path: &Path) -> Result<Value, Error> {
        let bytes = std::fs::read(path).map_err(|source| Error::File {
            path: path.to_owned(),
            action: "read",
            source,
        })?;
        self.upload_bytes(&bytes)
    }

    /// Uploads a test guest by name: one that its trial would keep out is taken in by force.
    ///
    /// # Errors
    /// [`Error::File`], or as [`Api::ask`].
    pub fn upload_guest(&self, name: &str) -> Result<Value, Error> {
        let path = crate::components()?.join(format!("guests/{name}.wasm"));
        let bytes = std::fs::read(&path).map_err(|source| Error::File {
            path,
            action: "read",
            source,
        })?;
        let path = "/v1/components?force=true";
        let answer = self.send("POST", path, &[("content-type", "application/wasm")], &bytes)?;
        self.success("POST", path, &answer)
    }

    /// Uploads stock controllers by name: `["pid", "pidplus"]`.
    ///
    /// # Errors
    /// As [`Api::upload`].
    pub fn upload_stock(&self, names: &[&str]) -> Result<(), Error> {
        let folder = crate::components()?;
        for name in names {
            self.upload(&folder.join(format!("{name}.wasm")))?;
        }
        Ok(())
    }

    /// Creates or changes the loop that the draft names.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn apply(&self, draft: &Value) -> Result<Value, Error> {
        let name = draft["name"].as_str().unwrap_or_default();
        self.put(&format!("/v1/loops/{name}"), draft)
    }

    /// One loop with its last record.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn loop_view(&self, name: &str) -> Result<Value, Error> {
        self.get(&format!("/v1/loops/{name}"))
    }

    /// A command: `setpoint`, `mode`, `output`, or a change: `swap`, `rollback`, `set`, `move`.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn command(&self, name: &str, what: &str, body: &Value) -> Result<Value, Error> {
        self.post(&format!("/v1/loops/{name}/{what}"), body)
    }

    /// Sets the setpoint.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn setpoint(&self, name: &str, setpoint: f64) -> Result<Value, Error> {
        self.command(name, "setpoint", &json!({ "setpoint": setpoint }))
    }

    /// Manual or automatic.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn mode(&self, name: &str, mode: &str) -> Result<Value, Error> {
        self.command(name, "mode", &json!({ "mode": mode }))
    }

    /// Goes on with another component.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn swap(&self, name: &str, component: &str) -> Result<Value, Error> {
        self.command(name, "swap", &json!({ "component": component }))
    }

    /// Goes back to a revision, or to the one before.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn rollback(&self, name: &str, revision: Option<u64>) -> Result<Value, Error> {
        let body = revision.map_or_else(|| json!({}), |revision| json!({ "revision": revision }));
        self.command(name, "rollback", &body)
    }

    /// Sets the strategy.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn strategy(&self, name: &str, strategy: &str) -> Result<Value, Error> {
        self.command(name, "set", &json!({ "strategy": strategy }))
    }

    /// Gives the ownership to a host.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn move_owner(&self, name: &str, host: &str) -> Result<Value, Error> {
        self.command(name, "move", &json!({ "host": host }))
    }

    /// One step of a component.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn call(&self, component: &str, request: &Value) -> Result<Value, Error> {
        self.post(&format!("/v1/components/{component}/call"), request)
    }

    /// The hosts, as this one sees them.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn hosts(&self) -> Result<Vec<Value>, Error> {
        self.list("/v1/hosts", "hosts")
    }

    /// The loops.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn loops(&self) -> Result<Vec<Value>, Error> {
        self.list("/v1/loops", "loops")
    }

    /// The library.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn components(&self) -> Result<Vec<Value>, Error> {
        self.list("/v1/components", "components")
    }

    /// The points of all hosts.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn points(&self) -> Result<Vec<Value>, Error> {
        self.list("/v1/points", "points")
    }

    fn list(&self, path: &str, key: &str) -> Result<Vec<Value>, Error> {
        match self.get(path)?.get_mut(key).map(Value::take) {
            Some(Value::Array(rows)) => Ok(rows),
            _ => Ok(Vec::new()),
        }
    }

    /// One point; null where there is none of that name.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn point(&self, name: &str) -> Result<Value, Error> {
        let points = self.points()?;
        Ok(points
            .into_iter()
            .find(|point| point["name"] == name)
            .unwrap_or_default())
    }

    /// The metrics as text.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn metrics(&self) -> Result<String, Error> {
        let answer = self.send("GET", "/metrics", &[], &[])?;
        if answer.ok() {
            Ok(answer.text())
        } else {
            self.success("GET", "/metrics", &answer).map(|_| String::new())
        }
    }

    /// Follows the records; `query` such as `?loops=pressure`, or empty.
    ///
    /// # Errors
    /// As [`Api::ask`].
    pub fn live(&self, query: &str) -> Result<Feed, Error> {
        Feed::open(&format!("{}/v1/live{query}", self.base), None)
    }

    /// Asks until the answer is `Ok`; `Err` holds what was seen instead. Waits 30 s at most.
    ///
    /// # Errors
    /// [`Error::Waited`] with what was seen last.
    pub fn wait_until<T, S: Debug>(&self, what: &str, mut ask: impl FnMut(&Self) -> Result<T, S>) -> Result<T, Error> {
        wait_until(what, WAIT_MAX, || ask(self))
    }

    /// Waits until the loop is as wanted; gives it.
    ///
    /// # Errors
    /// [`Error::Waited`] with the loop as it was last.
    pub fn wait_for_loop(&self, name: &str, what: &str, is: impl Fn(&Value) -> bool) -> Result<Value, Error> {
        self.wait_until(what, |api| match api.loop_view(name) {
            Ok(view) if is(&view) => Ok(view),
            Ok(view) => Err(brief(&view)),
            Err(error) => Err(error.to_string()),
        })
    }
}

/// The main numbers of a loop.
fn brief(view: &Value) -> String {
    let keys = [
        "revision",
        "pending_revision",
        "members",
        "owner",
        "term",
        "seq",
        "mode",
        "setpoint",
        "measurement",
        "outputs",
        "last_age_ms",
        "tally",
        "failures",
    ];
    keys.map(|key| format!("{key}={}", view[key])).join(" ")
}
