//! The rollouts of one host: begun, kept on disk, looked at, stopped, and gone on with after a restart.
//!
//! Owns: the list, its bounds, and that what is told was kept before. Never: decides what comes next; `course` does.
//!
//! ```text
//! begun ──► under way (at most 4) ──► ended, kept to be looked at (16 in all, the oldest goes first)
//! ```

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use bumpless_core::{Digest, LoopId};
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::sync::{Notify, oneshot};

use super::{
    LegView, RolloutDraft, RolloutView, Stage, State,
    course::{Course, Leg},
    tour::travel,
    watch::Eye,
};
use crate::{
    bench::stopping,
    book::on_disk,
    error::{Error, Words, chain},
    library::title,
    limits::{ROLLOUT_ERROR_PART, ROLLOUT_LOOPS_MAX, ROLLOUTS_KEPT_MAX, ROLLOUTS_RUNNING_MAX},
    room::Room,
    wire::{RolloutAsk, Told},
};

/// The setting that counts rollouts, so that no two ever have one name.
const COUNT: &str = "rollouts";

/// What a rollout is about; it never changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Head {
    pub(crate) title: String,
    pub(crate) digest: Digest,
    pub(crate) parameters: BTreeMap<String, f64>,
    pub(crate) started_at_unix_ms: u64,
}

/// A rollout on disk.
#[derive(Debug, Serialize, Deserialize)]
struct Kept {
    head: Head,
    course: Course,
    ended_at_unix_ms: Option<u64>,
}

/// A rollout as it stands.
#[derive(Debug)]
pub(crate) struct Desk {
    pub(crate) course: Course,
    /// One for each leg.
    pub(crate) eyes: Vec<Eye>,
    pub(crate) ended_at_unix_ms: Option<u64>,
}

/// One rollout.
#[derive(Debug)]
pub(crate) struct Rollout {
    pub(crate) number: u64,
    pub(crate) head: Head,
    pub(crate) desk: Mutex<Desk>,
    /// Held while it is written, so that an older state never overwrites a newer one.
    writing: tokio::sync::Mutex<()>,
    /// Its task shall look again.
    pub(crate) wake: Notify,
}

impl Rollout {
    fn new(number: u64, head: Head, course: Course, ended_at_unix_ms: Option<u64>) -> Self {
        let mut eyes: Vec<Eye> = course
            .legs
            .iter()
            .map(|leg| Eye::new(course.rule.cycles, leg.before))
            .collect();
        for (eye, leg) in eyes.iter_mut().zip(&course.legs) {
            // The watch begins anew, for what passed meanwhile was not seen.
            if let (Stage::Watched, Some(revision)) = (leg.stage, leg.revision) {
                eye.changed(revision, leg.error_before, course.rule.factor, leg.floor, true);
            }
        }
        Self {
            number,
            head,
            desk: Mutex::new(Desk {
                course,
                eyes,
                ended_at_unix_ms,
            }),
            writing: tokio::sync::Mutex::default(),
            wake: Notify::new(),
        }
    }

    /// Brings it to the disk as it stands, and gives what was written.
    pub(crate) async fn keep(&self, room: &Room) -> Result<Course, Error> {
        let _turn = self.writing.lock().await;
        let kept = {
            let desk = self.desk.lock();
            Kept {
                head: self.head.clone(),
                course: desk.course.as_kept(),
                ended_at_unix_ms: desk.ended_at_unix_ms,
            }
        };
        let (store, number) = (room.store.clone(), self.number);
        on_disk(move || store.put_rollout(number, &kept).map(|()| kept.course))
            .await?
            .map_err(Error::from)
    }

    fn running(&self) -> bool {
        !self.desk.lock().course.ended()
    }

    fn view(&self, room: &Room, with_loops: bool) -> RolloutView {
        let desk = self.desk.lock();
        let course = &desk.course;
        let leg = |(leg, eye): (&Leg, &Eye)| {
            let watched = leg.stage == Stage::Watched;
            LegView {
                loop_id: leg.id.clone(),
                stage: leg.stage,
                reason: leg.reason.clone(),
                cycles_before: match leg.stage {
                    Stage::Waiting | Stage::Refused => eye.cycles_before(),
                    _ => course.rule.cycles,
                },
                cycles: if watched { eye.cycles() } else { leg.cycles },
                revision_before: leg.before,
                revision: leg.revision,
                error_before: leg.error_before.or_else(|| eye.error_before()),
                error: if watched { eye.error() } else { leg.error },
            }
        };
        let number = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
        RolloutView {
            id: format!("{}.{}", room.here, self.number),
            host: room.here.clone(),
            component: self.head.title.clone(),
            digest: self.head.digest,
            parameters: self.head.parameters.clone(),
            rule: course.rule,
            state: match () {
                () if !course.ended() => State::Running,
                () if course.failure().is_some() => State::Failed,
                () if course.stopped() => State::Stopped,
                () => State::Done,
            },
            failure: course.failure().map(str::to_owned),
            started_at_unix_ms: self.head.started_at_unix_ms,
            ended_at_unix_ms: desk.ended_at_unix_ms,
            total: number(course.legs.len()),
            done: number(course.legs.iter().filter(|leg| leg.stage == Stage::Done).count()),
            loops: if with_loops {
                course.legs.iter().zip(&desk.eyes).map(leg).collect()
            } else {
                Vec::new()
            },
        }
    }
}

/// The rollouts of a host.
#[derive(Debug, Default)]
pub(crate) struct Ledger {
    all: Mutex<BTreeMap<u64, Arc<Rollout>>>,
    /// Held while one is begun, so that two do not take the last place or the same loop.
    beginning: tokio::sync::Mutex<()>,
}

impl Ledger {
    fn find(&self, room: &Room, number: u64) -> Result<Arc<Rollout>, Error> {
        self.all.lock().get(&number).cloned().ok_or_else(|| {
            Error::not_found(
                format!("host {} has no rollout {number}", room.here),
                format!("list the rollouts; a host keeps the last {ROLLOUTS_KEPT_MAX}"),
            )
        })
    }

    fn list(&self) -> Vec<Arc<Rollout>> {
        self.all.lock().values().cloned().collect()
    }
}

impl Room {
    /// Goes on with what was under way when this host stopped. Blocks.
    pub(crate) fn resume_rollouts(self: &Arc<Self>) -> Result<(), Error> {
        for (number, kept) in self.store.rollouts::<Kept>()? {
            let rollout = Arc::new(Rollout::new(number, kept.head, kept.course, kept.ended_at_unix_ms));
            self.rollouts.all.lock().insert(number, Arc::clone(&rollout));
            // One that ended and was not marked as ended is marked now.
            if kept.ended_at_unix_ms.is_none() {
                tracing::info!(number, "going on with a rollout");
                self.spawn(travel(Arc::clone(self), rollout));
            }
        }
        Ok(())
    }

    /// Begins a rollout, in a task of its own: an asker that goes away must leave none on disk that nobody goes on with.
    pub(crate) async fn start_rollout(self: &Arc<Self>, draft: RolloutDraft) -> Result<RolloutView, Error> {
        let room = Arc::clone(self);
        let (sender, receiver) = oneshot::channel();
        self.spawn(async move {
            // The asker may have gone.
            let _ = sender.send(room.begin_rollout(draft).await);
        });
        receiver.await.map_err(|_| stopping())?
    }

    async fn begin_rollout(self: &Arc<Self>, draft: RolloutDraft) -> Result<RolloutView, Error> {
        draft.rule.check()?;
        let info = self.library.controller(&draft.component)?;
        let given = draft.parameters.iter().map(|(name, value)| (name.as_str(), *value));
        info.descriptor
            .parameter_values(given)
            .map_err(|error| Error::Invalid(Words::new(chain(&error), "")))?;
        let loops = self.loops_of(&draft)?;
        let _turn = self.rollouts.beginning.lock().await;
        self.room_for_a_rollout(&loops)?;
        let legs = loops
            .iter()
            .map(|id| self.leg(id))
            .collect::<Result<Vec<Leg>, Error>>()?;
        let store = self.store.clone();
        let number = on_disk(move || store.count_up(COUNT)).await??;
        let head = Head {
            title: title(&info),
            digest: info.digest,
            parameters: draft.parameters,
            started_at_unix_ms: self.clock.unix_ms(),
        };
        let rollout = Arc::new(Rollout::new(number, head, Course::new(draft.rule, legs), None));
        rollout.keep(self).await?;
        self.rollouts.all.lock().insert(number, Arc::clone(&rollout));
        self.forget_old_rollouts().await;
        tracing::info!(number, component = %rollout.head.title, loops = loops.len(), "a rollout begins");
        let view = rollout.view(self, true);
        self.spawn(travel(Arc::clone(self), rollout));
        Ok(view)
    }

    /// The loops of a draft in their order.
    fn loops_of(&self, draft: &RolloutDraft) -> Result<Vec<LoopId>, Error> {
        let mut loops = draft.loops.clone();
        let mut seen = BTreeSet::new();
        if let Some(twice) = loops.iter().find(|id| !seen.insert((*id).clone())) {
            return Err(Error::invalid(
                format!("loop {twice} is named twice"),
                "name each loop once",
            ));
        }
        if let Some(reference) = &draft.all_of {
            let digest = self.library.resolve(reference)?.digest;
            let all = self.book.all();
            let running = all.iter().filter(|intent| intent.current.digest == digest);
            loops.extend(
                running
                    .map(|intent| intent.loop_id.clone())
                    .filter(|id| !seen.contains(id)),
            );
            if loops.is_empty() {
                return Err(Error::not_found(
                    format!("no loop runs {reference}"),
                    "list the loops for what they run",
                ));
            }
        }
        if loops.is_empty() || loops.len() > ROLLOUT_LOOPS_MAX {
            return Err(Error::invalid(
                format!("a rollout for {} loops", loops.len()),
                format!("name 1 to {ROLLOUT_LOOPS_MAX}"),
            ));
        }
        Ok(loops)
    }

    fn leg(&self, id: &LoopId) -> Result<Leg, Error> {
        let intent = self.book.find(id)?;
        let current = &intent.current;
        let (low, high) = current.setpoint_range;
        let floor = (high - low).abs() * ROLLOUT_ERROR_PART;
        Ok(Leg::new(
            id.clone(),
            current.revision,
            intent.last_revision,
            current.period_ns,
            floor,
        ))
    }

    fn room_for_a_rollout(&self, loops: &[LoopId]) -> Result<(), Error> {
        let running: Vec<_> = self.rollouts.list().into_iter().filter(|r| r.running()).collect();
        for rollout in &running {
            let desk = rollout.desk.lock();
            if let Some(taken) = desk.course.legs.iter().find(|leg| loops.contains(&leg.id)) {
                return Err(Error::refused(
                    format!("loop {} is part of rollout {}.{}", taken.id, self.here, rollout.number),
                    "wait for its end, or stop it",
                ));
            }
        }
        if running.len() >= ROLLOUTS_RUNNING_MAX {
            return Err(Error::busy(
                format!(
                    "{} rollouts are under way at host {}, the most there may be",
                    running.len(),
                    self.here
                ),
                "wait for the end of one, or ask another host",
            ));
        }
        Ok(())
    }

    /// Forgets those that ended, oldest first, until the others fit. What the disk refuses is tried again with the next.
    async fn forget_old_rollouts(&self) {
        let all = self.rollouts.list();
        let extra = all.len().saturating_sub(ROLLOUTS_KEPT_MAX);
        let ended = all
            .iter()
            .filter(|rollout| rollout.desk.lock().ended_at_unix_ms.is_some());
        for number in ended.map(|rollout| rollout.number).take(extra).collect::<Vec<_>>() {
            let store = self.store.clone();
            match on_disk(move || store.remove_rollout(number)).await {
                Ok(Ok(_)) => _ = self.rollouts.all.lock().remove(&number),
                Ok(Err(error)) => tracing::warn!(number, %error, "an old rollout is still on disk"),
                Err(error) => tracing::warn!(number, %error, "an old rollout is still on disk"),
            }
        }
    }

    /// Answers about the rollouts of this host.
    pub(crate) async fn rollout_here(self: &Arc<Self>, ask: RolloutAsk) -> Result<Told, Error> {
        let views = match ask {
            RolloutAsk::List => self.rollouts.list().iter().map(|r| r.view(self, false)).collect(),
            RolloutAsk::Show(number) => vec![self.rollouts.find(self, number)?.view(self, true)],
            RolloutAsk::Stop(number) => {
                let rollout = self.rollouts.find(self, number)?;
                rollout.desk.lock().course.stop();
                rollout.wake.notify_one();
                rollout.keep(self).await?;
                vec![rollout.view(self, true)]
            }
        };
        Ok(Told::Rollouts(views))
    }
}
