//! Keeps the copies of library, intents and accounts alike on all hosts.
//!
//! A notice says what changed, and is worked on at once. What got lost is found by comparing marks every second: where
//! they differ, the lists are compared, and what is missing is fetched. Nothing depends on a notice arriving.
//!
//! ```text
//! notice: intent x is at (7, 2) ──► is that news? ──► ask the teller for it ──► disk ──► reconcile
//! notice: my marks are a, b ──────► differ from ours? ──► ask the teller for its lists ──► each entry as above
//! ```
//! Never: works on more than a few notices at once; those that wait beyond a bound are dropped.

use std::sync::Arc;

use bumpless_core::{Digest, HostId, Intent, LoopId, intent::PAST_REVISIONS_MAX};
use tokio::sync::{Semaphore, mpsc};

use crate::{
    error::Error,
    limits::{ANSWER_WAIT, LOOPS_MAX, NOTICES_AT_ONCE},
    room::{Room, count},
    wire::{Ask, Notice, Position, Told},
};

/// Checks an intent that came from another host, as far as it can be without its components.
pub(crate) fn check(intent: &Intent) -> Result<(), Error> {
    let id = &intent.loop_id;
    let sound = intent.past.len() <= PAST_REVISIONS_MAX && intent.revisions().all(|s| s.id == *id && s.check().is_ok());
    if sound {
        Ok(())
    } else {
        Err(Error::internal(format!(
            "what a host sent as the intent of loop {id} is none"
        )))
    }
}

impl Room {
    /// Works on notices until the room stops.
    pub(crate) async fn hear_notices(room: Arc<Self>, mut notices: mpsc::Receiver<(HostId, Notice)>) {
        let places = Arc::new(Semaphore::new(NOTICES_AT_ONCE));
        while let Some((from, notice)) = notices.recv().await {
            if !room.is_news(&from, &notice) {
                continue;
            }
            let Ok(place) = Arc::clone(&places).acquire_owned().await else {
                return;
            };
            let worker = Arc::clone(&room);
            room.spawn(async move {
                if let Err(error) = worker.hear(&from, notice).await {
                    tracing::debug!(%from, %error, "a notice could not be followed; the next comparison finds it");
                }
                drop(place);
            });
        }
    }

    fn is_news(&self, from: &HostId, notice: &Notice) -> bool {
        match notice {
            Notice::Standing { library, intents } => {
                let marks = (*library, *intents);
                let ours = (self.library_mark(), self.intents_mark());
                let mut comparing = self.comparing.lock();
                if marks == ours {
                    comparing.done.remove(from);
                    return false;
                }
                // Compared before with just these marks on both sides: what differs stays different, for example removals
                // that only one of the two remembers.
                let joined = (marks.0 ^ ours.0.rotate_left(1), marks.1 ^ ours.1.rotate_left(1));
                comparing.done.get(from) != Some(&joined) && comparing.now.insert(from.clone())
            }
            Notice::Component(digest, edition) => self.library.wants(digest, edition),
            Notice::ComponentGone(..) => true,
            Notice::Intent(id, position) => self.book.wants(id, *position),
            Notice::Gone(tombstone) => self.book.mourns(tombstone),
            // These are passed on where they arrive.
            Notice::Field(_) | Notice::Alarm(_) | Notice::Message(_) => false,
        }
    }

    async fn hear(self: &Arc<Self>, from: &HostId, notice: Notice) -> Result<(), Error> {
        match notice {
            Notice::Standing { library, intents } => {
                let compared = self.compare(from).await;
                let ours = (self.library_mark(), self.intents_mark());
                let mut comparing = self.comparing.lock();
                comparing.now.remove(from);
                if compared.is_ok() {
                    let joined = (library ^ ours.0.rotate_left(1), intents ^ ours.1.rotate_left(1));
                    comparing.done.insert(from.clone(), joined);
                }
                compared
            }
            Notice::Component(digest, _) => self.copy_component(from, digest).await,
            Notice::ComponentGone(digest, at_ms) => self.component_gone(digest, at_ms).await,
            Notice::Intent(id, _) => self.copy_intent(from, id).await,
            Notice::Gone(tombstone) => self.loop_gone(tombstone).await,
            Notice::Field(_) | Notice::Alarm(_) | Notice::Message(_) => Ok(()),
        }
    }

    /// Compares everything with another host, and takes what is newer there. The first failure is given back, after all
    /// else was tried.
    async fn compare(self: &Arc<Self>, from: &HostId) -> Result<(), Error> {
        let mut end = Ok(());
        match self.ask(from, Ask::Library, ANSWER_WAIT).await {
            Ok(Told::Library(components, removals)) => {
                for (digest, at_ms) in removals {
                    if self
                        .library
                        .get(&digest)
                        .is_some_and(|info| info.uploaded_at_unix_ms <= at_ms)
                    {
                        end = end.and(self.component_gone(digest, at_ms).await);
                    }
                }
                for (digest, edition) in components {
                    if self.library.wants(&digest, &edition) {
                        end = end.and(self.copy_component(from, digest).await);
                    }
                }
            }
            Ok(_) => end = Err(Error::internal("the answer is no library")),
            Err(error) => end = Err(error),
        }
        // Before the intents: what a loop starts must be judged by what is known by then.
        end = end.and(self.compare_trust(from).await);
        match self.ask(from, Ask::Intents, ANSWER_WAIT).await {
            Ok(Told::Intents(heads, gone)) => {
                for tombstone in gone {
                    if self.book.mourns(&tombstone) {
                        end = end.and(self.loop_gone(tombstone).await);
                    }
                }
                for (id, position) in heads {
                    if self.book.wants(&id, position) {
                        end = end.and(self.copy_intent(from, id).await);
                    }
                }
            }
            Ok(_) => end = end.and(Err(Error::internal("the answer is no list of intents"))),
            Err(error) => end = end.and(Err(error)),
        }
        end.and(self.copy_access(from).await)
    }

    async fn copy_component(self: &Arc<Self>, from: &HostId, digest: Digest) -> Result<(), Error> {
        let Told::Info(Some(info)) = self.ask(from, Ask::Info(digest), ANSWER_WAIT).await? else {
            return Ok(());
        };
        if info.digest != digest {
            return Err(Error::internal("the answer is another component"));
        }
        info.check().map_err(|error| {
            count(&self.tallies.malformed);
            Error::invalid(format!("the summary of component {}: {error}", digest.short()), "")
        })?;
        let edition = info.edition();
        if !self.library.wants(&digest, &edition) {
            return Ok(());
        }
        self.bytes_of(digest, Some(from)).await?;
        {
            let _admission = self.admission.lock().await;
            // A newer copy may have come, or a person may have written something, meanwhile.
            if !self.library.wants(&digest, &edition) {
                return Ok(());
            }
            self.library.keep(Arc::from(info), None).await?;
        }
        self.poke();
        Ok(())
    }

    pub(crate) async fn component_gone(&self, digest: Digest, at_ms: u64) -> Result<(), Error> {
        if self.library.remove(digest, at_ms).await? {
            self.signing.forget(&digest).await?;
            self.bench.forget(&digest);
        }
        Ok(())
    }

    async fn copy_intent(self: &Arc<Self>, from: &HostId, id: LoopId) -> Result<(), Error> {
        let Told::Intent(Some(intent)) = self.ask(from, Ask::Intent(id.clone()), ANSWER_WAIT).await? else {
            return Ok(());
        };
        let sound = if intent.loop_id == id {
            check(&intent)
        } else {
            Err(Error::internal("the answer is another intent"))
        };
        sound.inspect_err(|_| count(&self.tallies.malformed))?;
        self.take_intent(*intent).await
    }

    /// Takes another host's copy of an intent. Of a loop whose home is here there is nothing newer elsewhere, except after
    /// this host lost its disk.
    async fn take_intent(self: &Arc<Self>, intent: Intent) -> Result<(), Error> {
        let position: Position = intent.position();
        if !self.book.wants(&intent.loop_id, position) || self.book.len() >= LOOPS_MAX {
            return Ok(());
        }
        if self.book.keep(Arc::new(intent)).await? {
            self.poke();
        }
        Ok(())
    }

    async fn loop_gone(&self, tombstone: bumpless_store::Tombstone) -> Result<(), Error> {
        let id = tombstone.loop_id.clone();
        if self.book.bury(tombstone).await? {
            if self.homes.is_open(&id) {
                self.homes.closed(&id);
                if let Err(error) = self.field.close_home(&id) {
                    tracing::error!(loop_id = %id, %error, "a deleted loop could not be closed; restart this host");
                }
            }
            self.gone(&id);
            self.poke();
        }
        Ok(())
    }
}
