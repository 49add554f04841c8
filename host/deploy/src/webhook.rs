//! Alarms told to others by HTTP: one POST of JSON for each thing that happens to an alarm of a loop at home here.
//!
//! ```text
//! event of this home ──filter──► queue (queue_max; full: the oldest is dropped and counted) ──► POST ──2xx──► told, kept on disk
//!                                   ▲                                                            │ no answer, 5xx, 408, 429
//!   start: what the disk has since the last one told                                             ├─► again, 1 s to 60 s later
//!                                                                                                └ other 4xx: refused, counted
//! ```
//! One at a time and in order. A receiver that is away holds up its own queue and nothing else. What a home that dies had not
//! told, it tells after its start: the events are on its disk, and so is how far it came. Whoever gets one twice knows it by its id.
//! Owns: the queues, and what is told of them. Never: on a cycle's thread; tells what happens at other homes.

use std::{
    collections::VecDeque,
    sync::Arc,
    time::{Duration, SystemTime},
};

use bumpless_core::{
    HostId, Priority,
    alarms::{Kind, What},
};
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::{
    sync::broadcast::error::RecvError,
    task::JoinHandle,
    time::{Instant, sleep_until},
};

use crate::{
    alarms::AlarmEvent,
    book::on_disk,
    error::{Error, chain},
    limits::{WEBHOOK_BACK_OFF, WEBHOOKS_MAX},
    room::Room,
};

mod config;
mod post;

pub use config::WebhookConfig;
use post::{Answered, Poster};

/// How one webhook does.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WebhookView {
    /// Its host.
    pub host: HostId,
    /// Its name.
    pub name: String,
    /// Where to, without what may be secret in it.
    pub to: String,
    /// Events that wait.
    pub waiting: u64,
    /// Events that were told since the start.
    pub told: u64,
    /// Tries that failed since the start.
    pub failed: u64,
    /// Events that the receiver refused for good since the start.
    pub refused: u64,
    /// Events that were dropped since the start, because too many waited.
    pub dropped: u64,
    /// When the last one was told, in ms of Unix time.
    pub last_told_unix_ms: Option<u64>,
    /// Why the last try failed; none where it did not.
    pub trouble: Option<String>,
}

/// The webhooks of this host.
#[derive(Debug, Default)]
pub(crate) struct Webhooks {
    views: Vec<Arc<Mutex<WebhookView>>>,
}

impl Webhooks {
    /// How each does.
    pub(crate) fn views(&self) -> Vec<WebhookView> {
        self.views.iter().map(|view| view.lock().clone()).collect()
    }
}

/// A webhook that is ready to run.
pub(crate) struct Hook {
    config: WebhookConfig,
    poster: Arc<Poster>,
    view: Arc<Mutex<WebhookView>>,
}

/// Makes ready what is configured.
pub(crate) fn ready(configs: Vec<WebhookConfig>, here: &HostId) -> Result<(Webhooks, Vec<Hook>), Error> {
    if configs.len() > WEBHOOKS_MAX {
        return Err(Error::invalid(
            format!("{} webhooks are configured", configs.len()),
            format!("a host has at most {WEBHOOKS_MAX}"),
        ));
    }
    let mut hooks = Vec::new();
    for config in configs {
        let poster = Arc::new(Poster::new(&config)?);
        let view = Arc::new(Mutex::new(WebhookView {
            host: here.clone(),
            name: config.name.clone(),
            to: config.shown_url(),
            waiting: 0,
            told: 0,
            failed: 0,
            refused: 0,
            dropped: 0,
            last_told_unix_ms: None,
            trouble: None,
        }));
        hooks.push(Hook { config, poster, view });
    }
    let views = hooks.iter().map(|hook| Arc::clone(&hook.view)).collect();
    Ok((Webhooks { views }, hooks))
}

/// What is told: the body of one POST.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Body {
    id: String,
    host: HostId,
    #[serde(rename = "loop")]
    loop_name: String,
    alarm: String,
    kind: Option<Kind>,
    what: What,
    state: bumpless_core::alarms::State,
    priority: Priority,
    at: String,
    value: Option<f64>,
    by: Option<String>,
    note: String,
    quiet: bool,
    first_out: bool,
    response: String,
}

/// What waits, and how far it came.
struct Queue {
    waiting: VecDeque<(u64, Body)>,
    /// Number of the last event that was taken up.
    seen: u64,
}

impl Room {
    /// Begins to tell.
    pub(crate) fn begin_webhooks(self: &Arc<Self>, hooks: Vec<Hook>) {
        for hook in hooks {
            let room = Arc::clone(self);
            // Before the disk is read, so that nothing lies between.
            let events = self.alarms.subscribe();
            self.spawn(async move { tell(room, hook, events).await });
        }
    }

    fn body(&self, event: &AlarmEvent) -> Body {
        let change = &event.change;
        let definition = {
            let boards = self.alarms.boards.lock();
            let standing = boards.get(&event.loop_id).and_then(|board| board.get(&change.alarm));
            standing.map(|standing| (standing.definition.kind, standing.definition.response.clone()))
        };
        let (kind, response) = definition.unzip();
        let at = SystemTime::UNIX_EPOCH + Duration::from_nanos(change.at_ns);
        Body {
            id: format!("{}-{}", event.host, event.number),
            host: event.host.clone(),
            loop_name: event.loop_id.to_string(),
            alarm: change.alarm.clone(),
            kind,
            what: change.what,
            state: change.state,
            priority: change.priority,
            at: humantime::format_rfc3339_millis(at).to_string(),
            value: change.value.filter(|value| value.is_finite()),
            by: change.by.clone(),
            note: change.note.clone(),
            quiet: change.quiet,
            first_out: change.first_out,
            response: response.unwrap_or_default(),
        }
    }
}

impl Hook {
    /// Takes an event up, where the filter lets it through. The oldest goes where there is no room.
    fn take(&self, queue: &mut Queue, room: &Room, event: &AlarmEvent) {
        if event.host != room.here || event.number <= queue.seen {
            return;
        }
        queue.seen = event.number;
        let body = room.body(event);
        if !self
            .config
            .wants(&body.loop_name, body.priority, body.kind, body.what, body.quiet)
        {
            return;
        }
        queue.waiting.push_back((event.number, body));
        let mut view = self.view.lock();
        if queue.waiting.len() > self.config.queue_max {
            queue.waiting.pop_front();
            view.dropped += 1;
        }
        view.waiting = queue.waiting.len() as u64;
    }

    /// What the disk has behind the last one that was seen: more than fits is not read, for it would be dropped.
    async fn make_up(&self, queue: &mut Queue, room: &Arc<Room>) {
        let (store, seen, max) = (room.store.clone(), queue.seen, self.config.queue_max);
        let read = on_disk(move || store.alarm_changes_after::<AlarmEvent>(seen, max)).await;
        match read.and_then(|read| read.map_err(Error::from)) {
            Ok(events) => events.iter().for_each(|event| self.take(queue, room, event)),
            Err(error) => tracing::warn!(webhook = self.config.name, %error, "what was not told before cannot be read"),
        }
    }

    fn setting(&self) -> String {
        format!("webhook-{}", self.config.name)
    }

    /// How far it came in a life before; where there was none, what happened before is not told.
    async fn resumed(&self, room: &Arc<Room>) -> u64 {
        let (store, name) = (room.store.clone(), self.setting());
        let read = on_disk(move || match store.host_value::<u64>(&name)? {
            Some(told) => Ok(told),
            None => store.last_alarm_change(),
        });
        match read.await.and_then(|read| read.map_err(Error::from)) {
            Ok(seen) => seen,
            Err(error) => {
                tracing::warn!(webhook = self.config.name, %error, "how far it came is not known; it begins with what comes now");
                room.alarms.last_number()
            }
        }
    }

    async fn keep(&self, room: &Arc<Room>, number: u64) {
        let (store, name) = (room.store.clone(), self.setting());
        let kept = on_disk(move || store.set_host_value(&name, &number)).await;
        if let Err(error) = kept.and_then(|kept| kept.map_err(Error::from)) {
            // After a start it is told again, under the same id.
            tracing::warn!(webhook = self.config.name, %error, "what was told is not kept");
        }
    }
}

/// Tells until the room stops.
async fn tell(room: Arc<Room>, hook: Hook, mut events: tokio::sync::broadcast::Receiver<Arc<AlarmEvent>>) {
    let mut queue = Queue {
        waiting: VecDeque::new(),
        seen: hook.resumed(&room).await,
    };
    hook.make_up(&mut queue, &room).await;
    let mut under_way: Option<(u64, JoinHandle<Answered>)> = None;
    let (mut next_try, mut pause) = (Instant::now(), WEBHOOK_BACK_OFF.0);
    loop {
        if under_way.is_none()
            && Instant::now() >= next_try
            && let Some((number, body)) = queue.waiting.front()
        {
            let (poster, body) = (Arc::clone(&hook.poster), body.clone());
            under_way = Some((*number, tokio::task::spawn_blocking(move || poster.post(&body))));
        }
        let pausing = under_way.is_none() && !queue.waiting.is_empty() && Instant::now() < next_try;
        let answered = async {
            match under_way.as_mut() {
                Some((number, post)) => (*number, post.await),
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            event = events.recv() => match event {
                Ok(event) => hook.take(&mut queue, &room, &event),
                Err(RecvError::Lagged(_)) => hook.make_up(&mut queue, &room).await,
                Err(RecvError::Closed) => return,
            },
            (number, answer) = answered => {
                under_way = None;
                let answer = answer.unwrap_or_else(|error| Answered::Failed(error.to_string()));
                let done = {
                    let mut view = hook.view.lock();
                    match answer {
                        Answered::Taken => {
                            view.told += 1;
                            view.trouble = None;
                            view.last_told_unix_ms = Some(room.clock.unix_ms());
                            true
                        }
                        Answered::Refused(why) => {
                            tracing::warn!(webhook = hook.config.name, why, "an alarm was refused by its receiver");
                            view.refused += 1;
                            view.trouble = Some(why);
                            true
                        }
                        Answered::Failed(why) => {
                            if view.trouble.is_none() {
                                tracing::warn!(webhook = hook.config.name, why, "an alarm is not told yet; it is tried again");
                            }
                            view.failed += 1;
                            view.trouble = Some(why);
                            false
                        }
                    }
                };
                if done {
                    pause = WEBHOOK_BACK_OFF.0;
                    next_try = Instant::now();
                    // It may have been dropped meanwhile.
                    queue.waiting.retain(|(waiting, _)| *waiting != number);
                    hook.view.lock().waiting = queue.waiting.len() as u64;
                    hook.keep(&room, number).await;
                } else {
                    next_try = Instant::now() + pause;
                    pause = (pause * 2).min(WEBHOOK_BACK_OFF.1);
                }
            }
            () = sleep_until(next_try), if pausing => {}
        }
    }
}

/// An error of the client in one line.
fn in_words(error: &dyn std::error::Error) -> String {
    chain(error).chars().take(200).collect()
}
