//! A reader of the live feed: server-sent events (HTML standard, section 9.2) on a thread of its own.

use std::{
    io::{BufRead as _, BufReader},
    sync::mpsc::{Receiver, RecvTimeoutError, sync_channel},
    time::{Duration, Instant},
};

use serde_json::Value;

use crate::{Error, WAIT_MAX};

/// Events that wait for the reader; beyond it the thread waits, and the host then drops for it.
const WAITING_MAX: usize = 10_000;

/// Longest life of a feed.
const FEED_MAX: Duration = Duration::from_secs(1800);

/// One event.
#[derive(Debug, Clone)]
pub struct Event {
    /// `record`, `hosts` or `lost`.
    pub name: String,
    /// Its id; empty where it has none.
    pub id: String,
    /// Its data.
    pub data: Value,
}

/// An open feed. Dropped, it closes with the next event.
#[derive(Debug)]
pub struct Feed {
    events: Receiver<Event>,
}

impl Feed {
    /// Opens a feed at a whole address; `last_event_id` resumes one.
    ///
    /// # Errors
    /// [`Error::Http`] or [`Error::Refused`].
    pub fn open(url: &str, last_event_id: Option<&str>) -> Result<Self, Error> {
        let agent: ureq::Agent = ureq::Agent::config_builder()
            .http_status_as_error(false)
            .proxy(None)
            .timeout_connect(Some(Duration::from_secs(5)))
            .timeout_recv_response(Some(WAIT_MAX))
            // A feed says something every second.
            .timeout_per_read(Some(WAIT_MAX))
            .timeout_recv_body(Some(FEED_MAX))
            .build()
            .into();
        let mut request = agent.get(url).header("accept", "text/event-stream");
        if let Some(id) = last_event_id {
            request = request.header("last-event-id", id);
        }
        let mut answer = request.call().map_err(|source| Error::Http {
            method: "GET".to_owned(),
            url: url.to_owned(),
            source: Box::new(source),
        })?;
        if !answer.status().is_success() {
            return Err(Error::Refused {
                method: "GET".to_owned(),
                url: url.to_owned(),
                status: answer.status().as_u16(),
                body: answer.body_mut().read_to_string().unwrap_or_default(),
            });
        }
        let (sender, events) = sync_channel(WAITING_MAX);
        let lines = BufReader::new(answer.into_body().into_reader());
        std::thread::Builder::new()
            .name("feed".to_owned())
            .spawn(move || {
                let mut parser = Parser::default();
                // A feed that breaks off ends the channel, which the reader sees.
                for line in lines.lines().map_while(Result::ok) {
                    if let Some(event) = parser.line(&line)
                        && sender.send(event).is_err()
                    {
                        return;
                    }
                }
            })
            .map_err(|source| Error::Program {
                program: "a thread".to_owned(),
                source,
            })?;
        Ok(Self { events })
    }

    /// The next event of any name.
    ///
    /// # Errors
    /// [`Error::FeedEnded`] where none comes in time or the feed broke off.
    pub fn next(&self, longest: Duration) -> Result<Event, Error> {
        self.events.recv_timeout(longest).map_err(|error| match error {
            RecvTimeoutError::Timeout => Error::FeedEnded(format!("no event in {longest:?}")),
            RecvTimeoutError::Disconnected => Error::FeedEnded("the host closed it".to_owned()),
        })
    }

    /// The next event that is as wanted; those before it are passed over. Waits 30 s at most.
    ///
    /// # Errors
    /// As [`Feed::next`].
    pub fn event_where(&self, what: &str, is: impl Fn(&Event) -> bool) -> Result<Event, Error> {
        let start = Instant::now();
        loop {
            let left = WAIT_MAX.saturating_sub(start.elapsed());
            let next = self
                .next(left)
                .map_err(|error| Error::FeedEnded(format!("{error}; waited for {what}")))?;
            if is(&next) {
                return Ok(next);
            }
            if left.is_zero() {
                return Err(Error::FeedEnded(format!("it never came: {what}")));
            }
        }
    }

    /// The next record.
    ///
    /// # Errors
    /// As [`Feed::next`].
    pub fn record(&self) -> Result<Value, Error> {
        self.record_where("any record", |_| true)
    }

    /// The next record that is as wanted; those before it are passed over. Waits 30 s at most.
    ///
    /// # Errors
    /// As [`Feed::next`].
    pub fn record_where(&self, what: &str, is: impl Fn(&Value) -> bool) -> Result<Value, Error> {
        self.record_within(WAIT_MAX, what, is)
    }

    /// The next record that is as wanted, with another longest wait: for a plant that takes its time.
    ///
    /// # Errors
    /// As [`Feed::next`].
    pub fn record_within(&self, longest: Duration, what: &str, is: impl Fn(&Value) -> bool) -> Result<Value, Error> {
        let start = Instant::now();
        let mut last = Value::Null;
        loop {
            let left = longest.saturating_sub(start.elapsed());
            let next = match self.next(left) {
                Ok(event) => event,
                Err(error) => {
                    return Err(Error::FeedEnded(format!(
                        "{error}; waited for {what}; last seen: {last}"
                    )));
                }
            };
            if next.name == "record" {
                if is(&next.data) {
                    return Ok(next.data);
                }
                last = next.data;
            } else if left.is_zero() {
                return Err(Error::FeedEnded(format!(
                    "no record in {longest:?}: {what}; last seen: {last}"
                )));
            }
        }
    }

    /// What waits already, without waiting for more.
    #[must_use]
    pub fn drain(&self) -> Vec<Event> {
        self.events.try_iter().collect()
    }
}

/// Lines become events.
#[derive(Default)]
struct Parser {
    name: String,
    id: String,
    data: String,
}

impl Parser {
    fn line(&mut self, line: &str) -> Option<Event> {
        if line.is_empty() {
            let data = std::mem::take(&mut self.data);
            let name = std::mem::take(&mut self.name);
            return (!data.is_empty()).then(|| Event {
                name: if name.is_empty() { "message".to_owned() } else { name },
                id: self.id.clone(),
                data: serde_json::from_str(&data).unwrap_or(Value::String(data)),
            });
        }
        let (field, value) = line.split_once(':').unwrap_or((line, ""));
        let value = value.strip_prefix(' ').unwrap_or(value);
        match field {
            "event" => value.clone_into(&mut self.name),
            "id" => value.clone_into(&mut self.id),
            "data" => {
                if !self.data.is_empty() {
                    self.data.push('\n');
                }
                self.data.push_str(value);
            }
            // A comment, or what is not known.
            _ => {}
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_become_events() {
        let mut parser = Parser::default();
        let text = ": alive\n\nevent: record\nid: 7\ndata: {\"seq\":\ndata: 3}\n\ndata:plain\n\n";
        let events: Vec<Event> = text.lines().filter_map(|line| parser.line(line)).collect();
        let seen: Vec<_> = events
            .iter()
            .map(|e| (e.name.as_str(), e.id.as_str(), e.data.to_string()))
            .collect();
        assert_eq!(
            seen,
            [
                ("record", "7", "{\"seq\":3}".to_owned()),
                ("message", "7", "\"plain\"".to_owned())
            ]
        );
    }
}
