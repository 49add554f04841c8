//! Points that a person holds at a value: by whom, why, and until when.
//!
//! ```text
//! free ──force: on disk, then in the image──► forced ──unforce, or its time: out of the image, then off the disk──► free
//!          start of the host: from the disk into the image, before any loop runs
//! ```
//!
//! Of a device with two masters both hosts know its forces (`marks`), so that the one that takes over goes on with them, and
//! what ended at one ends at the other.
//!
//! Owns: that a force outlives its host's process and no longer than its time. Never: puts a value anywhere; the I/O server
//! does, at each read and write, and looks at the time itself.

use std::{sync::Arc, time::Duration};

use bumpless_core::PointId;
use bumpless_io::{Force, IoServer, PointIndex};
use bumpless_store::Store;
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::{
    FieldEvent,
    marks::{Mark, Marks, Position},
};
use crate::{
    audit::{Act, AuditKind, Seen},
    beat::every,
    book::on_disk,
    error::{Error, chain},
    limits::{FORCES_LOOK, WORDS_CHARS_MAX},
    room::Room,
    wire::Notice,
};

/// A wish to hold a point at a value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ForceDraft {
    /// In the point's unit.
    pub value: f64,
    /// For so long, in s: 1 s to 24 h.
    pub seconds: u64,
    /// Who wants it.
    pub by: String,
    /// Why.
    pub why: String,
}

/// A point that is held.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ForceView {
    /// In the point's unit.
    pub value: f64,
    /// Since when, in ms of Unix time as the I/O host's steady clock has it.
    pub since_unix_ms: u64,
    /// It ends by itself then.
    pub until_unix_ms: u64,
    /// Who wanted it.
    pub by: String,
    /// Why.
    pub why: String,
}

/// The forces of this host.
pub(crate) struct Forces {
    pub(super) marks: Mutex<Marks>,
    /// Held while one is changed, so that disk and image end up alike.
    pub(super) changing: tokio::sync::Mutex<()>,
}

impl Forces {
    /// Reads the disk.
    pub(super) fn open(store: &Store) -> Result<Self, Error> {
        Ok(Self {
            marks: Mutex::new(Marks::new(store.forces()?)),
            changing: tokio::sync::Mutex::default(),
        })
    }

    pub(super) fn of(&self, point: &PointId) -> Option<ForceView> {
        self.marks.lock().force(point).cloned()
    }
}

/// Someone's name or reason: something, and not a book.
pub(super) fn words(what: &str, text: &str) -> Result<String, Error> {
    let text = text.trim();
    if text.is_empty() || text.chars().count() > WORDS_CHARS_MAX || text.chars().any(char::is_control) {
        return Err(Error::invalid(
            format!("{what} has {} characters", text.chars().count()),
            format!("give 1 to {WORDS_CHARS_MAX} on one line, so that the next shift knows"),
        ));
    }
    Ok(text.to_owned())
}

/// A force as the I/O server takes it.
pub(super) fn as_force(view: &ForceView) -> Force {
    Force {
        value: view.value,
        until_ns: view.until_unix_ms.saturating_mul(1_000_000),
    }
}

impl Room {
    /// Puts forces back that were in force when the host ended, and begins to look after them.
    pub(crate) fn resume_forces(self: &Arc<Self>) -> Result<(), Error> {
        let Some(io) = &self.io else { return Ok(()) };
        let now_ns = io.clock().now_ns();
        let held = self.commissioning.forces.marks.lock().forces();
        for (point, view) in held {
            let resumed = match io.index(&point) {
                None => Err("the point is no longer there".to_owned()),
                Some(index) => io
                    .force(index, as_force(&view), now_ns)
                    .map_err(|error| error.to_string()),
            };
            match resumed {
                Ok(()) => tracing::warn!(%point, value = view.value, by = view.by, "still forced after the start"),
                Err(reason) => {
                    tracing::warn!(%point, reason, "a force ended while the host was away");
                    self.commissioning.forces.marks.lock().forget(&point);
                    self.store.remove_force(&point)?;
                }
            }
        }
        let room = Arc::clone(self);
        self.spawn(async move {
            let mut tick = every(FORCES_LOOK);
            loop {
                tick.tick().await;
                room.look_after_forces().await;
            }
        });
        Ok(())
    }

    /// Ends what is over, and hands forced outputs to devices that came back.
    async fn look_after_forces(self: &Arc<Self>) {
        let Some(io) = &self.io else { return };
        let now_ns = io.clock().now_ns();
        for (index, force) in io.forced() {
            if now_ns >= force.until_ns
                && let Some(point) = io.info(index).map(|info| info.id.clone())
                && let Err(error) = self
                    .end_force(io, index, &point, "its time was over", Some(force))
                    .await
            {
                // It counts no more in any case; only the row is left, and is tried again.
                tracing::warn!(%point, %error, "a force that is over is still on disk");
            }
        }
        io.hold_forced(now_ns);
        let over = self.commissioning.forces.marks.lock().sweep(now_ns / 1_000_000);
        for point in over {
            let store = self.store.clone();
            if let Ok(Err(error)) = on_disk(move || store.remove_force(&point)).await {
                // It is forgotten in memory, and again after the next start.
                tracing::debug!(%error, "the memory of an ended force is still on disk");
            }
        }
        self.look_after_standbys();
        self.share_forces().await;
    }

    /// Holds a point of this host at a value.
    pub(super) async fn force_here(self: &Arc<Self>, point: &PointId, draft: ForceDraft) -> Result<(), Error> {
        let (io, index) = self.point_here(point)?;
        if !io.speaks_for(index) {
            return Err(self.not_master(point));
        }
        let now_ns = io.clock().now_ns();
        let view = ForceView {
            value: draft.value,
            since_unix_ms: now_ns / 1_000_000,
            until_unix_ms: (now_ns / 1_000_000).saturating_add(draft.seconds.saturating_mul(1_000)),
            by: words("by", &draft.by)?,
            why: words("why", &draft.why)?,
        };
        let turn = self.commissioning.forces.changing.lock().await;
        // The I/O server knows the bounds. What it takes is on disk a moment later, before anybody is told.
        let before = io
            .forced()
            .into_iter()
            .find(|(forced, _)| *forced == index)
            .map(|(_, force)| force);
        io.force(index, as_force(&view), now_ns)
            .map_err(|error| Error::invalid(chain(&error), ""))?;
        let mark = self.mark_now(io, index, point, view.until_unix_ms, Some(view.clone()));
        let (store, key, row) = (self.store.clone(), point.clone(), mark.clone());
        let kept = match on_disk(move || store.put_force(&key, &row)).await {
            Ok(kept) => kept.map_err(Error::from),
            Err(error) => Err(error),
        };
        if let Err(error) = kept {
            // As it was: a force that a restart would forget is none.
            match before {
                Some(force) => drop(io.force(index, force, now_ns)),
                None => drop(io.unforce(index)),
            }
            return Err(error);
        }
        self.commissioning.forces.marks.lock().put(point.clone(), mark);
        drop(turn);
        // Told to the other master before the asker hears of it, if it can be reached; else as soon as it can.
        self.share_forces().await;
        tracing::warn!(%point, value = view.value, seconds = draft.seconds, by = view.by, why = view.why, "forced");
        self.tell_field(FieldEvent::Forced {
            point: point.clone(),
            host: self.here.clone(),
            force: view,
        });
        Ok(())
    }

    /// Lets a point of this host go.
    pub(super) async fn unforce_here(self: &Arc<Self>, point: &PointId, by: &str) -> Result<(), Error> {
        let by = words("by", by)?;
        let (io, index) = self.point_here(point)?;
        if !io.speaks_for(index) {
            return Err(self.not_master(point));
        }
        if self.commissioning.force_of(point).is_none() {
            return Err(Error::refused(format!("point {point} is not forced"), ""));
        }
        self.end_force(io, index, point, &by, None).await
    }

    /// Ends a force; `only` where it is still this one.
    async fn end_force(
        self: &Arc<Self>,
        io: &Arc<IoServer>,
        index: PointIndex,
        point: &PointId,
        by: &str,
        only: Option<Force>,
    ) -> Result<(), Error> {
        let turn = self.commissioning.forces.changing.lock().await;
        let by_time = only.is_some();
        if let Some(only) = only
            && !io.forced().contains(&(index, only))
        {
            return Ok(());
        }
        // Off the disk first: what a person was told to be free must not come back with a restart. Of two masters both
        // remember the end for as long as the force would have lasted.
        let ended = self.commissioning.forces.marks.lock().get(point).cloned();
        let ended_force = ended.as_ref().and_then(|mark| mark.force.clone());
        let mark = match (io.redundant(index), ended) {
            (Some(_), Some(ended)) if by_time => Some(ended.over()),
            (Some(_), Some(ended)) => Some(self.mark_now(io, index, point, ended.over().until_unix_ms, None)),
            _ => None,
        };
        let (store, key, row) = (self.store.clone(), point.clone(), mark.clone());
        on_disk(move || match row {
            Some(row) => store.put_force(&key, &row),
            None => store.remove_force(&key).map(drop),
        })
        .await??;
        io.unforce(index);
        match mark {
            Some(mark) => self.commissioning.forces.marks.lock().put(point.clone(), mark),
            None => self.commissioning.forces.marks.lock().forget(point),
        }
        drop(turn);
        tracing::warn!(%point, by, "forced no more");
        if by_time && !io.speaks_for(index) {
            // The master tells.
            return Ok(());
        }
        if by_time {
            // Nobody asked for it, so nobody else writes it down.
            let seen = Seen::of(json!({ "force": ended_force }), json!({ "force": null }));
            let act = Act::new(AuditKind::PointUnforce, point.as_str(), json!({ "because": by }));
            self.audit_own(act, seen, None).await;
        }
        self.share_forces().await;
        self.tell_field(FieldEvent::Unforced {
            point: point.clone(),
            host: self.here.clone(),
            by: by.to_owned(),
        });
        Ok(())
    }

    /// A mark for what is said now: newer than all that was said before.
    fn mark_now(
        &self,
        io: &IoServer,
        index: PointIndex,
        point: &PointId,
        until_unix_ms: u64,
        force: Option<ForceView>,
    ) -> Mark {
        let epoch = io.redundant(index).and_then(|(_, view)| view.epoch).unwrap_or(0);
        let now_ms = io.clock().now_ns() / 1_000_000;
        let before = self
            .commissioning
            .forces
            .marks
            .lock()
            .get(point)
            .map(|mark| mark.position);
        Mark {
            position: Position::after(before, epoch, now_ms),
            until_unix_ms,
            force,
        }
    }

    /// Tells everyone, this host included.
    pub(super) fn tell_field(&self, event: FieldEvent) {
        self.announce(&Notice::Field(Box::new(event.clone())));
        self.commissioning.tell(event);
    }
}

/// How long a force still lasts, for messages.
pub(super) fn left(view: &ForceView, now_ns: u64) -> Duration {
    Duration::from_millis(view.until_unix_ms.saturating_sub(now_ns / 1_000_000))
}
