//! The journey of one rollout: a task that looks at the records as they pass, asks the loops' homes, and keeps on disk what
//! it is about to do before it does it.
//!
//! Owns: the waits, every one of them bounded. Never: decides what comes next (`course`) or what a record means (`watch`).
//!
//! ```text
//! record, answer, stop or tick ──► course ──► kept on disk ──► ask homes ──┐
//!        ▲                                                                 │
//!        └─────────────────────────────────────────────────────────────────┘ until nothing is left to do
//! ```
//! A disk that fails holds up changes, and never the way back of a loop that failed.

use std::{
    collections::HashMap,
    pin::Pin,
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{Digest, LoopId, Record};
use futures_util::{StreamExt as _, stream::FuturesUnordered};
use serde_json::{Value, json};
use tokio::sync::broadcast;

use super::{
    Stage,
    course::{Action, Course, Fall, Leg},
    guarded::{self, Guarded},
    ledger::{Desk, Rollout},
    watch::Sight,
};
use crate::{
    audit::{Act, Asker, AuditKind, Via},
    beat::every,
    error::Error,
    expect::Expect,
    limits::{ANSWER_WAIT, APPLY_WAIT, ROLLOUT_ASK_FOR, ROLLOUT_ASK_PAUSE, ROLLOUT_LOOK_EVERY, ROLLOUT_WATCH_SLACK},
    plan,
    room::Room,
    view::ApplyEnd,
    wire::{Amend, Ask, Roll, Told},
};

/// How an action ended.
enum End {
    Changed(Result<ApplyEnd, Error>),
    /// The revision that the rollout brought, if it did.
    Found(Result<Option<u64>, Error>),
    WentBack(Result<ApplyEnd, Error>),
}

type UnderWay = FuturesUnordered<Pin<Box<dyn Future<Output = (usize, End)> + Send>>>;

/// Runs a rollout to its end.
pub(super) async fn travel(room: Arc<Room>, rollout: Arc<Rollout>) {
    // From here on no record is missed that comes after a change.
    let mut feed = room.feed.subscribe();
    let mut tick = every(ROLLOUT_LOOK_EVERY);
    let mut under_way = UnderWay::new();
    let mut tour = Tour::new(room, rollout);
    loop {
        if tour.act(&mut under_way).await {
            return;
        }
        // Most records say nothing new.
        while !tokio::select! {
            record = feed.recv() => match record {
                Ok(record) => tour.see(&record),
                Err(broadcast::error::RecvError::Lagged(missed)) => {
                    tracing::debug!(missed, "a rollout came too late for records");
                    false
                }
                // The room stops, and this task with it.
                Err(broadcast::error::RecvError::Closed) => return,
            },
            Some((number, end)) = under_way.next(), if !under_way.is_empty() => tour.ended(number, end),
            () = tour.rollout.wake.notified() => true,
            _ = tick.tick() => tour.look(Instant::now()),
        } {}
    }
}

struct Tour {
    room: Arc<Room>,
    rollout: Arc<Rollout>,
    /// Leg by loop.
    numbers: HashMap<LoopId, usize>,
    /// The port that a component measures.
    measured: HashMap<Digest, Option<usize>>,
    /// Since when a leg is due or watched, and which of the two.
    since: HashMap<usize, (Stage, Instant)>,
    /// What is on disk; none where that is not certain.
    kept: Option<Course>,
}

impl Tour {
    fn new(room: Arc<Room>, rollout: Arc<Rollout>) -> Self {
        let numbers = {
            let desk = rollout.desk.lock();
            let legs = desk.course.legs.iter().enumerate();
            legs.map(|(number, leg)| (leg.id.clone(), number)).collect()
        };
        Self {
            room,
            rollout,
            numbers,
            measured: HashMap::new(),
            since: HashMap::new(),
            kept: None,
        }
    }

    /// Chooses, keeps, asks. Says whether the rollout has ended.
    async fn act(&mut self, under_way: &mut UnderWay) -> bool {
        let changed = {
            let mut desk = self.rollout.desk.lock();
            let Desk {
                course,
                eyes,
                ended_at_unix_ms,
            } = &mut *desk;
            course.choose_back();
            course.choose(|number| eyes.get(number).is_some_and(super::watch::Eye::ready));
            for (leg, eye) in course.legs.iter_mut().zip(eyes) {
                if leg.stage == Stage::Changing && leg.error_before.is_none() {
                    leg.error_before = eye.error_before();
                }
            }
            if course.ended() && ended_at_unix_ms.is_none() {
                *ended_at_unix_ms = Some(self.room.clock.unix_ms());
                self.kept = None;
            }
            self.kept.as_ref() != Some(&course.as_kept())
        };
        if changed {
            self.kept = match self.rollout.keep(&self.room).await {
                Ok(kept) => Some(kept),
                Err(error) => {
                    tracing::warn!(number = self.rollout.number, %error, "a rollout waits, for it cannot be kept on disk");
                    None
                }
            };
        }
        let (actions, ended) = {
            let mut desk = self.rollout.desk.lock();
            // A stop that came meanwhile has taken back what was chosen.
            let actions = desk.course.actions(self.kept.is_some());
            (actions, desk.course.ended())
        };
        for action in actions {
            under_way.push(self.begin(action));
        }
        let over = ended && self.kept.is_some() && self.rollout.desk.lock().ended_at_unix_ms.is_some();
        if over {
            let desk = self.rollout.desk.lock();
            match desk.course.failure() {
                Some(failure) => tracing::error!(number = self.rollout.number, failure, "a rollout failed"),
                None => tracing::info!(number = self.rollout.number, "a rollout ended"),
            }
        }
        over
    }

    fn begin(&self, action: Action) -> Pin<Box<dyn Future<Output = (usize, End)> + Send>> {
        let room = Arc::clone(&self.room);
        let head = &self.rollout.head;
        let desk = self.rollout.desk.lock();
        let (Action::Change(number) | Action::Find(number) | Action::Back(number)) = action;
        let Some(leg) = desk.course.legs.get(number) else {
            let none = Error::internal("a rollout has no such loop");
            return Box::pin(async move { (number, End::Changed(Err(none))) });
        };
        let id = leg.id.clone();
        let roll = Roll {
            component: head.digest.to_string(),
            parameters: head.parameters.clone(),
            before: leg.before,
            last_before: leg.last_before,
        };
        let back = Amend::Return {
            from: leg.revision.unwrap_or(leg.before),
            to: leg.before,
        };
        let digest = head.digest;
        let name = format!("{}.{}", self.room.here, self.rollout.number);
        Box::pin(async move {
            let asked = |amend: &Amend| match amend {
                Amend::Return { from, to } => json!({ "rollout": name, "from_revision": from, "to_revision": to }),
                _ => json!({ "rollout": name, "component": digest.to_string() }),
            };
            let end = match action {
                Action::Change(_) => {
                    let amend = Amend::Roll(roll);
                    End::Changed(noted(&room, &id, asked(&amend), amended(&room, &id, &amend).await).await)
                }
                Action::Find(_) => End::Found(found(&room, &id, &roll, digest).await),
                Action::Back(_) => {
                    End::WentBack(noted(&room, &id, asked(&back), amended(&room, &id, &back).await).await)
                }
            };
            (number, end)
        })
    }

    /// An answer came. Says that there is something new.
    fn ended(&mut self, number: usize, end: End) -> bool {
        let mut desk = self.rollout.desk.lock();
        let Some(last_before) = desk.course.legs.get(number).map(|leg| leg.last_before) else {
            return false;
        };
        let runs = match end {
            End::Changed(Ok(end)) => Some(end.revision),
            End::Changed(Err(error @ Error::Timeout(_))) | End::Found(Err(error)) => {
                let why = format!("it is not known whether it was changed: {error}");
                desk.course.unknown(number, &why);
                None
            }
            End::Changed(Err(error)) => {
                desk.course.refused(number, &error.to_string());
                None
            }
            End::Found(Ok(Some(revision))) => Some(revision),
            End::Found(Ok(None)) => {
                desk.course.spared(number);
                None
            }
            End::WentBack(end) => {
                let end = end.map(drop).map_err(|error| error.to_string());
                desk.course.went_back(number, end);
                None
            }
        };
        if let Some(revision) = runs {
            desk.course.changed(number, revision, revision > last_before);
            let Desk { course, eyes, .. } = &mut *desk;
            if let (Some(leg), Some(eye)) = (course.legs.get(number), eyes.get_mut(number)) {
                eye.changed(revision, leg.error_before, course.rule.factor, leg.floor, false);
            }
        }
        true
    }

    /// A record passes. Says whether there is something new.
    fn see(&mut self, record: &Record) -> bool {
        let Some(&number) = self.numbers.get(&record.loop_id) else {
            return false;
        };
        let measured = self.measured(&record.digest);
        let mut desk = self.rollout.desk.lock();
        let Desk { course, eyes, .. } = &mut *desk;
        let (Some(leg), Some(eye)) = (course.legs.get_mut(number), eyes.get_mut(number)) else {
            return false;
        };
        if !matches!(leg.stage, Stage::Waiting | Stage::Changing | Stage::Watched) {
            return false;
        }
        let was_ready = eye.ready();
        let sight = eye.see(record, measured);
        if sight == Sight::GoesOn {
            return !was_ready && eye.ready();
        }
        (leg.error, leg.cycles) = (eye.error(), eye.cycles());
        match sight {
            Sight::Passed => course.passed(number),
            Sight::Fell(fall, why) => course.fell(number, fall, &why),
            Sight::GoesOn => {}
        }
        true
    }

    fn measured(&mut self, digest: &Digest) -> Option<usize> {
        if let Some(known) = self.measured.get(digest) {
            return *known;
        }
        let info = self.room.library.get(digest)?;
        let ports = &info.descriptor.ports;
        let measured =
            plan::measured_port(&info.descriptor).and_then(|name| ports.iter().position(|port| port.name == name));
        self.measured.insert(*digest, measured);
        measured
    }

    /// Looks at the waits. Says whether there is something new, or something to try again.
    fn look(&mut self, now: Instant) -> bool {
        let mut desk = self.rollout.desk.lock();
        let Desk { course, eyes, .. } = &mut *desk;
        let due = course.due();
        let watched: Vec<usize> = (0..course.legs.len())
            .filter(|number| course.legs.get(*number).is_some_and(|leg| leg.stage == Stage::Watched))
            .collect();
        self.since.retain(|number, (stage, _)| match stage {
            Stage::Waiting => due.contains(number),
            _ => watched.contains(number),
        });
        let mut news = self.kept.is_none();
        for (number, stage) in due
            .into_iter()
            .map(|number| (number, Stage::Waiting))
            .chain(watched.into_iter().map(|number| (number, Stage::Watched)))
        {
            let (_, since) = *self.since.entry(number).or_insert((stage, now));
            let (Some(leg), Some(eye)) = (course.legs.get_mut(number), eyes.get(number)) else {
                continue;
            };
            let late = now.saturating_duration_since(since) > patience(leg, course.rule.cycles);
            let intent = self.room.book.get(&leg.id);
            let wanted = course.rule.cycles;
            let why = match (stage, intent) {
                (_, None) => "the loop was deleted".to_owned(),
                (Stage::Waiting, Some(intent)) if intent.current.revision != leg.before => format!(
                    "somebody changed it meanwhile: revision {} is in force, not {}",
                    intent.current.revision, leg.before
                ),
                (Stage::Waiting, Some(_)) if late => format!(
                    "only {} of {wanted} cycles before the change were seen; cycles in manual or without a measurement do not count",
                    eye.cycles_before()
                ),
                (Stage::Watched, Some(_)) if late => format!(
                    "only {} of {wanted} cycles were seen in time; cycles in manual or without a measurement do not count",
                    eye.cycles()
                ),
                _ => continue,
            };
            news = true;
            if stage == Stage::Waiting {
                course.refused(number, &why);
            } else {
                (leg.error, leg.cycles) = (eye.error(), eye.cycles());
                let fall = if self.room.book.get(&leg.id).is_some() {
                    Fall::Runs
                } else {
                    Fall::Others
                };
                course.fell(number, fall, &why);
            }
        }
        news
    }
}

/// How long a loop may take to be seen for so many cycles.
fn patience(leg: &Leg, cycles: u32) -> Duration {
    Duration::from_nanos(leg.period_ns)
        .saturating_mul(cycles)
        .saturating_mul(4)
        .saturating_add(ROLLOUT_WATCH_SLACK)
}

/// May the same question be answered otherwise in a while?
const fn passing(error: &Error) -> bool {
    matches!(error, Error::Busy(_) | Error::Unreachable(_) | Error::Timeout(_))
}

fn unexpected() -> Error {
    Error::internal("a host gave an answer to another question")
}

/// Asks a loop's home for a change, again and again for a while: it does it once.
async fn amended(room: &Arc<Room>, id: &LoopId, amend: &Amend) -> Result<ApplyEnd, Error> {
    let until = Instant::now() + ROLLOUT_ASK_FOR;
    loop {
        let home = room.book.home(id)?;
        match room
            .ask(
                &home,
                Ask::Amend(id.clone(), amend.clone(), Expect::Anything),
                APPLY_WAIT,
            )
            .await
        {
            Ok(Told::Applied(end)) => return Ok(end),
            Ok(_) => return Err(unexpected()),
            Err(error) if passing(&error) && Instant::now() < until => tokio::time::sleep(ROLLOUT_ASK_PAUSE).await,
            Err(error) => return Err(error),
        }
    }
}

/// Writes a change, or its refusal, down, and passes it on.
async fn noted(room: &Arc<Room>, id: &LoopId, asked: Value, end: Result<ApplyEnd, Error>) -> Result<ApplyEnd, Error> {
    let asker = Asker {
        via: Via::Rollout,
        ..Asker::default()
    };
    let seen = room.revised(&end).await;
    let act = Act::on_loop(AuditKind::LoopRolled, id, asked);
    asker.asks(room.audit_own(act, seen, end.as_ref().err())).await;
    end
}

/// Finds out whether a change was made before this host restarted. Gives the revision that it brought.
async fn found(room: &Arc<Room>, id: &LoopId, roll: &Roll, digest: Digest) -> Result<Option<u64>, Error> {
    let until = Instant::now() + ROLLOUT_ASK_FOR;
    loop {
        let home = room.book.home(id)?;
        let error = match room.ask(&home, Ask::Intent(id.clone()), ANSWER_WAIT).await {
            // One that is on its way is decided soon.
            Ok(Told::Intent(Some(intent))) if intent.pending.is_some() => {
                Error::busy(format!("a change of loop {id} is under way"), "look at the loop")
            }
            Ok(Told::Intent(Some(intent))) => {
                let stands = guarded::forwards(&intent, roll, digest) == Ok(Guarded::Stands);
                return Ok(stands.then_some(intent.current.revision));
            }
            Ok(Told::Intent(None)) => return Ok(None),
            Ok(_) => return Err(unexpected()),
            Err(error) => error,
        };
        if !passing(&error) || Instant::now() >= until {
            return Err(error);
        }
        tokio::time::sleep(ROLLOUT_ASK_PAUSE).await;
    }
}
