//! The live feed of a cell, from whichever host answers.
//!
//! ```text
//! connecting to host i ── ok ──► reading ── end, silence ──► connecting to the next host known, at once
//!      └── no ──► (RETRY pause) ──► connecting to the next host known
//! ```
//! The queue is bounded; while it is full the thread waits, the host's feed overflows, and the host says how many records
//! were lost. Ends when its reader is gone, or when no host answered for GIVE_UP.

use std::{
    io::{BufRead as _, BufReader, Read},
    sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
    time::{Duration, Instant},
};

use bumpless_api::types::{AlarmHappening, Hosts, Record};
use serde::Deserialize;

use crate::{
    client::{Client, encoded},
    error::Error,
};

/// Records between the thread and its reader: ten seconds at 100 Hz.
const QUEUE_MAX: usize = 1_000;
/// Silence after which a host counts as lost: it sends its hosts every second.
const SILENCE_MAX: Duration = Duration::from_secs(3);
/// Pause before the next host is tried, so that a cell that is down is not hammered.
const RETRY: Duration = Duration::from_millis(250);
/// Time after which a cell that never answers is given up: long enough for every host of it to be started again.
const GIVE_UP: Duration = Duration::from_secs(60);
/// Bytes of one line of the feed: a record with 64 ports has some 20 KB.
const LINE_BYTES_MAX: u64 = 1024 * 1024;

/// What comes from the cell.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum News {
    /// A cycle.
    Record(Box<Record>, String),
    /// The hosts, every second.
    Hosts(Hosts),
    /// Something happened to an alarm.
    Alarm(Box<AlarmHappening>, String),
    /// Records that this reader was too slow for.
    Lost(u64),
    /// The feed now comes from this API.
    Connected(String),
    /// The feed ended; another host is tried.
    Disconnected(String),
    /// No host of the cell answered for [`GIVE_UP`]: the last news.
    Gone(String),
}

/// A thread that reads the feed.
pub(crate) struct Feed {
    news: Receiver<News>,
}

impl Feed {
    /// Starts reading what concerns one loop.
    pub(crate) fn start(client: &Client, name: &str) -> Result<Self, Error> {
        Self::open(client, format!("/v1/live?loops={}", encoded(name)))
    }

    /// Starts reading for what happens to alarms, of one loop where one is named. Records come thinned out as far as they can be.
    pub(crate) fn of_alarms(client: &Client, name: Option<&str>) -> Result<Self, Error> {
        let of = name.map(|name| format!("&loops={}", encoded(name))).unwrap_or_default();
        Self::open(client, format!("/v1/live?every_ms={}{of}", u32::MAX))
    }

    fn open(client: &Client, path: String) -> Result<Self, Error> {
        let first = client.clone();
        let (sender, news) = sync_channel(QUEUE_MAX);
        std::thread::Builder::new()
            .name("feed".to_owned())
            .spawn(move || follow(&first, &path, &sender))
            .map_err(|error| Error::start("the thread of the feed", error))?;
        Ok(Self { news })
    }

    /// The next news, or none within `wait`.
    pub(crate) fn next(&self, wait: Duration) -> Option<News> {
        match self.news.recv_timeout(wait) {
            Ok(news) => Some(news),
            Err(RecvTimeoutError::Timeout) => None,
            // The thread ended with its last news, which was taken; what it said is still so.
            Err(RecvTimeoutError::Disconnected) => Some(News::Gone("the feed ended".to_owned())),
        }
    }
}

/// Reads until nobody listens any more.
fn follow(first: &Client, path: &str, news: &SyncSender<News>) {
    let mut apis = vec![first.api().to_owned()];
    let mut turn = 0;
    let mut answered_at = Instant::now();
    loop {
        let api = apis[turn % apis.len()].clone();
        let (end, had_answered) = match first.at(&api).and_then(|client| client.stream(path, SILENCE_MAX)) {
            Ok(stream) => {
                if news.send(News::Connected(api.clone())).is_err() {
                    return;
                }
                let end = read(stream, news, &mut apis);
                answered_at = Instant::now();
                (end, true)
            }
            Err(error) => (End::Feed(error.to_string()), false),
        };
        match end {
            End::Reader => return,
            End::Feed(reason) => {
                let gone = answered_at.elapsed() >= GIVE_UP;
                let word = if gone {
                    News::Gone(reason)
                } else {
                    News::Disconnected(reason)
                };
                if news.send(word).is_err() || gone {
                    return;
                }
            }
        }
        // The next one known; at once where the last one answered until now.
        turn = apis.iter().position(|known| *known == api).map_or(turn, |at| at + 1);
        if !had_answered || apis.len() == 1 {
            std::thread::sleep(RETRY);
        }
    }
}

/// Why reading stopped.
enum End {
    /// The reader of the news is gone.
    Reader,
    /// The feed is.
    Feed(String),
}

/// Reads events until the feed or its reader ends; notes the APIs of the cell.
fn read(stream: impl Read, news: &SyncSender<News>, apis: &mut Vec<String>) -> End {
    let mut lines = BufReader::new(stream);
    let mut event = Event::default();
    loop {
        let mut line = String::new();
        match lines.by_ref().take(LINE_BYTES_MAX).read_line(&mut line) {
            Ok(0) => return End::Feed("it ended".to_owned()),
            Ok(_) if !line.ends_with('\n') => return End::Feed("a line of it is too long or broke off".to_owned()),
            Ok(_) => {}
            Err(error) => return End::Feed(error.to_string()),
        }
        let Some(next) = event.take(line.trim_end_matches(['\r', '\n'])) else {
            continue;
        };
        match next {
            Ok(next) => {
                if let News::Hosts(hosts) = &next {
                    learn(apis, hosts);
                }
                if news.send(next).is_err() {
                    return End::Reader;
                }
            }
            Err(reason) => return End::Feed(reason),
        }
    }
}

/// Keeps the addresses of all hosts that were ever named, for the day when the one that answers dies.
fn learn(apis: &mut Vec<String>, hosts: &Hosts) {
    /// More addresses than a person's cell has; a bound, because they come from outside.
    const APIS_MAX: usize = 256;
    for api in hosts.hosts.iter().filter_map(|host| host.api.as_ref()) {
        if apis.len() < APIS_MAX && !apis.contains(api) {
            apis.push(api.clone());
        }
    }
}

/// One server-sent event as it comes together, line by line (WHATWG HTML, 9.2.6).
#[derive(Debug, Default)]
struct Event {
    name: String,
    data: String,
}

#[derive(Deserialize)]
struct Lost {
    records: u64,
}

impl Event {
    /// Takes a line; an empty one ends the event. None while it is not whole, or is of no kind that is known here.
    fn take(&mut self, line: &str) -> Option<Result<News, String>> {
        if !line.is_empty() {
            let (field, value) = line.split_once(':').unwrap_or((line, ""));
            let value = value.strip_prefix(' ').unwrap_or(value);
            match field {
                "event" => value.clone_into(&mut self.name),
                "data" => {
                    if !self.data.is_empty() {
                        self.data.push('\n');
                    }
                    self.data.push_str(value);
                }
                // Comments (keep-alive), ids, retry times.
                _ => {}
            }
            return None;
        }
        let Self { name, data } = std::mem::take(self);
        let wrong = |error: serde_json::Error| format!("its event {name} is not understood: {error}");
        match name.as_str() {
            "record" => Some(
                serde_json::from_str(&data)
                    .map(|record| News::Record(Box::new(record), data.clone()))
                    .map_err(wrong),
            ),
            "hosts" => Some(serde_json::from_str(&data).map(News::Hosts).map_err(wrong)),
            "alarm" => Some(
                serde_json::from_str(&data)
                    .map(|event| News::Alarm(Box::new(event), data.clone()))
                    .map_err(wrong),
            ),
            "lost" => Some(
                serde_json::from_str(&data)
                    .map(|lost: Lost| News::Lost(lost.records))
                    .map_err(wrong),
            ),
            // Kinds that a later host may add.
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn news(text: &str) -> (Vec<News>, String) {
        let (sender, receiver) = sync_channel(100);
        let End::Feed(reason) = read(text.as_bytes(), &sender, &mut Vec::new()) else {
            panic!("the reader is there")
        };
        drop(sender);
        (receiver.iter().collect(), reason)
    }

    #[test]
    fn events_are_read_and_unknown_ones_passed_over() {
        let text = "event: lost\ndata: {\"records\": 3}\n\n: keep-alive\n\nevent: new\ndata: x\n\n\
                    event: hosts\r\ndata: {\"hosts\":\r\ndata:  []}\r\n\r\n";
        let (news, reason) = news(text);
        assert_eq!(
            news,
            [
                News::Lost(3),
                News::Hosts(Hosts {
                    hosts: Vec::new(),
                    next: None
                })
            ]
        );
        assert_eq!(reason, "it ended");
    }

    #[test]
    fn a_broken_feed_says_so_and_ends() {
        for (text, part) in [
            (
                "event: lost\ndata: {\"records\": -3}\n\n",
                "its event lost is not understood",
            ),
            ("event: record\ndata: {}\n\n", "its event record is not understood"),
            ("event: lo", "broke off"),
            ("", "it ended"),
        ] {
            let (_, reason) = news(text);
            assert!(reason.contains(part), "{text:?}: {reason}");
        }
    }
}
