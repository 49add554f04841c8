//! Messages of the cell on their way to the programs of this host.
//!
//! Queue policy: each program keeps the newest so many of a topic as it asked for, and drops the oldest. The host keeps the newest
//! four of a topic, for at most 10 s and of at most 256 topics, so that who begins to listen knows what was said last.
//! Owns: the mailboxes. Never: sends anything to another host.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{Arc, Weak},
    time::{Duration, Instant},
};

use bumpless_core::Message;
use parking_lot::Mutex;
use tokio::sync::Notify;

/// Messages of one topic that the host keeps.
const HEARD_PER_TOPIC_MAX: usize = 4;
/// Topics that the host keeps something of; beyond it the one that was silent longest is forgotten.
const HEARD_TOPICS_MAX: usize = 256;
/// Age of what a listener begins with.
const HEARD_FOR: Duration = Duration::from_secs(10);

/// The mail of one program.
#[derive(Debug, Default)]
pub(crate) struct Mailbox {
    state: Mutex<Mail>,
    came: Notify,
}

#[derive(Debug, Default)]
struct Mail {
    depths: BTreeMap<String, usize>,
    waiting: VecDeque<Message>,
    dropped: u64,
}

impl Mailbox {
    pub(crate) fn receive(&self) -> Option<Message> {
        self.state.lock().waiting.pop_front()
    }

    /// Waits for a message.
    pub(crate) async fn wait(&self) -> Message {
        loop {
            let came = self.came.notified();
            if let Some(message) = self.receive() {
                return message;
            }
            came.await;
        }
    }

    fn put(&self, message: &Message) {
        let mut mail = self.state.lock();
        let Some(&depth) = mail.depths.get(&message.topic) else {
            return;
        };
        let there = mail.waiting.iter().filter(|m| m.topic == message.topic).count();
        if there >= depth {
            let oldest = mail.waiting.iter().position(|m| m.topic == message.topic);
            if let Some(oldest) = oldest {
                mail.waiting.remove(oldest);
                mail.dropped += 1;
            }
        }
        mail.waiting.push_back(message.clone());
        drop(mail);
        // A permit is kept where nobody waits yet.
        self.came.notify_one();
    }

    pub(crate) fn dropped(&self) -> u64 {
        self.state.lock().dropped
    }
}

/// All mailboxes of a host. Cheap to clone.
#[derive(Debug, Clone, Default)]
pub struct Exchange(Arc<Mutex<Post>>);

#[derive(Debug, Default)]
struct Post {
    listeners: BTreeMap<String, Vec<Weak<Mailbox>>>,
    heard: BTreeMap<String, VecDeque<(Instant, Message)>>,
}

impl Exchange {
    /// A message was said somewhere in the cell. Never blocks for longer than a look into some mailboxes.
    pub fn say(&self, message: &Message) {
        let mut post = self.0.lock();
        if !post.heard.contains_key(&message.topic) && post.heard.len() >= HEARD_TOPICS_MAX {
            let last = |said: &VecDeque<(Instant, Message)>| said.back().map(|(at, _)| *at);
            let silent = post
                .heard
                .iter()
                .min_by_key(|(_, said)| last(said))
                .map(|(topic, _)| topic.clone());
            silent.and_then(|topic| post.heard.remove(&topic));
        }
        let heard = post.heard.entry(message.topic.clone()).or_default();
        heard.push_back((Instant::now(), message.clone()));
        if heard.len() > HEARD_PER_TOPIC_MAX {
            heard.pop_front();
        }
        if let Some(listeners) = post.listeners.get_mut(&message.topic) {
            listeners.retain(|listener| match listener.upgrade() {
                Some(mailbox) => {
                    mailbox.put(message);
                    true
                }
                None => false,
            });
        }
    }

    pub(crate) fn listen(&self, mailbox: &Arc<Mailbox>, topic: String, depth: usize) {
        let mut post = self.0.lock();
        let before = mailbox.state.lock().depths.insert(topic.clone(), depth);
        if before.is_some() {
            return;
        }
        if let Some(heard) = post.heard.get(&topic) {
            let fresh: Vec<&Message> = heard
                .iter()
                .filter(|(at, _)| at.elapsed() < HEARD_FOR)
                .map(|(_, message)| message)
                .collect();
            for message in fresh.iter().skip(fresh.len().saturating_sub(depth)) {
                mailbox.put(message);
            }
        }
        let listeners = post.listeners.entry(topic).or_default();
        listeners.retain(|listener| listener.strong_count() > 0);
        listeners.push(Arc::downgrade(mailbox));
    }

    pub(crate) fn forget(&self, mailbox: &Arc<Mailbox>) {
        let mut post = self.0.lock();
        let mut mail = mailbox.state.lock();
        mail.waiting.clear();
        for topic in std::mem::take(&mut mail.depths).into_keys() {
            if let Some(listeners) = post.listeners.get_mut(&topic) {
                listeners.retain(|listener| !std::ptr::eq(listener.as_ptr(), Arc::as_ptr(mailbox)));
                if listeners.is_empty() {
                    post.listeners.remove(&topic);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(topic: &str, data: u8) -> Message {
        Message {
            topic: topic.to_owned(),
            data: vec![data],
        }
    }

    fn all(mailbox: &Mailbox) -> Vec<u8> {
        std::iter::from_fn(|| mailbox.receive())
            .filter_map(|message| message.data.first().copied())
            .collect()
    }

    #[test]
    fn a_listener_begins_with_what_was_said_last_and_keeps_the_newest() {
        let (exchange, mailbox) = (Exchange::default(), Arc::new(Mailbox::default()));
        for n in 0..6 {
            exchange.say(&message("a", n));
        }
        exchange.listen(&mailbox, "a".to_owned(), 2);
        assert_eq!(all(&mailbox), [4, 5]);
        for n in 6..10 {
            exchange.say(&message("a", n));
            exchange.say(&message("b", n));
        }
        assert_eq!((all(&mailbox), mailbox.dropped()), (vec![8, 9], 2));
        exchange.forget(&mailbox);
        exchange.say(&message("a", 10));
        assert_eq!(all(&mailbox), Vec::<u8>::new());
        assert!(exchange.0.lock().listeners.is_empty());
    }

    #[test]
    fn what_is_kept_has_a_bound() {
        let exchange = Exchange::default();
        for n in 0..HEARD_TOPICS_MAX + 10 {
            exchange.say(&message(&format!("t{n}"), 0));
        }
        let post = exchange.0.lock();
        assert_eq!(post.heard.len(), HEARD_TOPICS_MAX);
        assert!(!post.heard.contains_key("t0") && post.heard.contains_key("t265"));
    }
}
