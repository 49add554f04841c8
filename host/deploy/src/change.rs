//! Changes of loops, at their home: create, change, and the way of a revision from proposal to its first record.
//!
//! ```text
//! checked ──tried on members──► kept on disk ──held by members──► opened                              (new loop)
//! checked ──proposed, on disk──► held by members ──Revise──► record says done ──► committed, on disk  (running loop)
//!                     │                │                └─ refused ─┐
//!                     └────────────────┴── not ready, no cycle ─────┴─► withdrawn: the old revision never left
//! ```
//! A change runs in a task of its own, so that an asker that goes away leaves nothing half done.

mod amend;
mod readiness;

use std::{sync::Arc, time::Duration};

use bumpless_core::{
    Command, CommandBody, ComponentInfo, Event, HostId, Intent, LoopId, LoopSpec, Outcome, Record,
    place::{self, Candidate},
};
use bumpless_loops::CommandReply;
use futures_util::future::join_all;
use tokio::{sync::oneshot, time::timeout};
use tracing::{Instrument as _, info_span};

use crate::{
    SPANS, admission,
    audit::{Act, AuditKind},
    bench::stopping,
    change::readiness::Readiness,
    draft::LoopDraft,
    error::{Error, chain},
    expect::Expect,
    holder::wanted_members,
    library::as_controller,
    limits::{CHANGE_WAIT, COMMAND_WAIT_MIN, LOOPS_MAX, READY_WAIT},
    plan::{self, Ground},
    room::{Room, count},
    view::{ApplyEnd, HandOverView},
    wire::{Ask, Notice, Told},
};

/// What a swap leaves behind.
#[derive(Debug, Default)]
struct Dropped {
    parameters: Vec<String>,
    ports: Vec<String>,
    notes: Vec<String>,
}

impl Dropped {
    fn of(swapped: plan::Swapped) -> (LoopSpec, Self) {
        let plan::Swapped {
            spec,
            parameters,
            ports,
            notes,
        } = swapped;
        let dropped = Self {
            parameters,
            ports,
            notes,
        };
        (spec, dropped)
    }
}

/// How a command for a new revision ended.
enum Revised {
    Done(Arc<Record>),
    Refused(String),
    /// It was taken back before any cycle began with it.
    TakenBack(Error),
}

impl Room {
    /// Creates or changes a loop whose points are here.
    pub(crate) async fn apply_here(
        self: &Arc<Self>,
        from: HostId,
        draft: LoopDraft,
        expect: Expect,
    ) -> Result<ApplyEnd, Error> {
        let id = plan::loop_id(&draft.name)?;
        self.in_turn(id.clone(), move |room| async move {
            room.expected(&id, &expect).await?;
            let info = room.component(&draft.component, &from).await?;
            let fallback = match &draft.fallback {
                Some(reference) => Some(room.component(reference, &from).await?),
                None => None,
            };
            match room.book.get(&id) {
                None => room.create(&draft, &info, fallback.as_deref()).await,
                Some(intent) => {
                    room.is_home(&intent)?;
                    let spec = plan::spec(
                        &draft,
                        info.digest,
                        &info.descriptor,
                        &room.ground(&|p| room.point_facts(p, &id)),
                    )?;
                    room.check_fallback(&spec, &info, fallback.as_deref())?;
                    room.change(intent, spec, &info, Dropped::default()).await
                }
            }
        })
        .await
    }

    /// Does what a change relies on hold? The caller has the loop's turn.
    async fn expected(self: &Arc<Self>, id: &LoopId, expect: &Expect) -> Result<(), Error> {
        if *expect == Expect::Anything {
            return Ok(());
        }
        // A revision whose record is there, but not yet in the book, counts.
        if self.book.get(id).is_some() {
            self.settle_locked(id).await?;
        }
        expect.check(id, self.book.get(id).map(|intent| intent.current.revision))
    }

    fn is_home(&self, intent: &Intent) -> Result<(), Error> {
        if intent.home == self.here {
            return Ok(());
        }
        Err(Error::refused(
            format!(
                "loop {} has its home at host {}, not at {}",
                intent.loop_id, intent.home, self.here
            ),
            "ask again; a loop's home cannot change, except by deleting the loop and creating it anew",
        ))
    }

    /// One change of a loop at a time, a few at a home, each in a task of its own.
    async fn in_turn<F, W>(self: &Arc<Self>, id: LoopId, work: W) -> Result<ApplyEnd, Error>
    where
        F: Future<Output = Result<ApplyEnd, Error>> + Send + 'static,
        W: FnOnce(Arc<Self>) -> F + Send + 'static,
    {
        let room = Arc::clone(self);
        let (sender, receiver) = oneshot::channel();
        let span =
            info_span!(target: SPANS, "change", loop.name = %id, host = %self.here, good = tracing::field::Empty);
        let whole = span.clone();
        let task = async move {
            let end = async {
                let crowded = |_| {
                    Error::busy(
                        format!("other changes are under way at host {}", room.here),
                        "try again",
                    )
                };
                let _place = timeout(CHANGE_WAIT, room.changes.acquire())
                    .await
                    .map_err(crowded)?
                    .map_err(|_| stopping())?;
                let lock = room.homes.locks.of(&id);
                let taken = |_| {
                    Error::busy(
                        format!("another change of loop {id} is under way"),
                        "wait for its end, then try again",
                    )
                };
                let _turn = timeout(CHANGE_WAIT, lock.lock()).await.map_err(taken)?;
                work(Arc::clone(&room)).await
            }
            .await;
            count(if end.is_ok() {
                &room.tallies.applies
            } else {
                &room.tallies.applies_refused
            });
            whole.record("good", end.is_ok());
            room.poke();
            // The asker may have gone.
            let _ = sender.send(end);
        };
        self.spawn(task.instrument(span));
        receiver.await.map_err(|_| stopping())?
    }

    fn ground<'a>(&'a self, point: &'a dyn Fn(&bumpless_core::PointId) -> Option<plan::PointFacts>) -> Ground<'a> {
        Ground {
            home: &self.here,
            point,
        }
    }

    /// A component by reference; by digest also where only the asker has heard of it yet.
    async fn component(self: &Arc<Self>, reference: &str, from: &HostId) -> Result<Arc<ComponentInfo>, Error> {
        match reference.parse() {
            Ok(digest) => as_controller(self.info_of(digest, Some(from)).await?),
            Err(_) => self.library.controller(reference),
        }
    }

    async fn ask_members(self: &Arc<Self>, members: &[HostId], ask: &Ask) -> Readiness {
        let answers = join_all(
            members
                .iter()
                .map(|host| async move { (host.clone(), self.ask(host, ask.clone(), READY_WAIT).await) }),
        );
        let mut readiness = Readiness {
            ready: Vec::new(),
            missing: Vec::new(),
        };
        for (host, answer) in answers.await {
            match answer {
                Ok(_) => readiness.ready.push(host),
                Err(error) => readiness.missing.push((host, error)),
            }
        }
        readiness
    }

    /// Could the fallback run the loop? Better told now than when it is needed.
    fn check_fallback(
        &self,
        spec: &LoopSpec,
        info: &ComponentInfo,
        fallback: Option<&ComponentInfo>,
    ) -> Result<(), Error> {
        let Some(fallback) = fallback else { return Ok(()) };
        let swapped = plan::fall_back(spec, fallback.digest, Some(&info.descriptor), &fallback.descriptor);
        let facts = |point: &_| self.point_facts(point, &spec.id);
        match plan::complete(swapped.spec, &fallback.descriptor, &self.ground(&facts)) {
            Ok(_) => Ok(()),
            Err(error) => {
                let words = error.words();
                Err(Error::invalid(
                    format!(
                        "{}@{} cannot be the fallback: {}",
                        fallback.name, fallback.version, words.reason
                    ),
                    "choose a component that runs with this loop's ports",
                ))
            }
        }
    }

    /// Goes on with the fallback, because the component in force keeps failing. Nobody asked, so nobody is told of a
    /// failure but the log; the next failing cycles ask again.
    pub(crate) fn fall_back(self: &Arc<Self>, failing: &Record) {
        let (id, revision, faults) = (failing.loop_id.clone(), failing.revision, failing.faults_in_row);
        let (room, spawned) = (Arc::clone(self), Arc::clone(self));
        self.spawn(async move {
            let name = id.clone();
            let end = room.in_turn(id.clone(), move |room| async move {
                let intent = room.book.find(&id)?;
                let current = intent.current.clone();
                let Some(digest) = current.fallback.filter(|_| current.revision == revision) else {
                    return Err(Error::refused("the loop was changed meanwhile", ""));
                };
                let new = room.info_of(digest, None).await?;
                let old = room.info_of(current.digest, None).await.ok();
                let swapped = plan::fall_back(&current, digest, old.as_ref().map(|i| &i.descriptor), &new.descriptor);
                let (spec, dropped) = Dropped::of(swapped);
                let facts = |point: &_| room.point_facts(point, &id);
                let spec = plan::complete(spec, &new.descriptor, &room.ground(&facts))?;
                room.change(intent, spec, &new, dropped).await
            });
            let end = end.await;
            let seen = spawned.revised(&end).await;
            let asked = serde_json::json!({ "failed_revision": revision, "faults_in_row": faults });
            let act = Act::on_loop(AuditKind::LoopFallback, &name, asked);
            spawned.audit_own(act, seen, end.as_ref().err()).await;
            match end {
                Ok(end) => tracing::error!(
                    loop_id = %name, failed = revision, revision = end.revision, faults,
                    "the loop's component kept failing; its fallback runs now"
                ),
                Err(error) => tracing::warn!(loop_id = %name, revision, faults, %error, "the loop cannot fall back"),
            }
        });
    }

    async fn create(
        self: &Arc<Self>,
        draft: &LoopDraft,
        info: &ComponentInfo,
        fallback: Option<&ComponentInfo>,
    ) -> Result<ApplyEnd, Error> {
        let id = plan::loop_id(&draft.name)?;
        let facts = |point: &_| self.point_facts(point, &id);
        let spec = plan::spec(draft, info.digest, &info.descriptor, &self.ground(&facts))?;
        self.check_fallback(&spec, info, fallback)?;
        let mut warnings = admission::warnings(info, &spec, false)?;
        warnings.extend(self.may_start(info, false)?);
        if let Some(fallback) = fallback {
            warnings.extend(self.may_start(fallback, false)?);
        }
        if self.book.len() >= LOOPS_MAX {
            return Err(Error::busy(
                format!("the cell has {LOOPS_MAX} loops, the most it may have"),
                "delete loops that are not needed",
            ));
        }
        let members = place::members(&id, &self.roster.eligible(), &spec.prefer, usize::from(spec.replicas));
        if members.is_empty() {
            return Err(nobody());
        }
        let tried = self
            .ask_members(&members, &Ask::Try(Box::new(spec.clone())))
            .instrument(info_span!(target: SPANS, "try"))
            .await;
        if tried.ready.is_empty() {
            return Err(tried.failure(&format!("no host can run loop {id}"), "nothing was created"));
        }
        let intent = {
            let _claim = self.homes.claims.lock().await;
            // The outputs may have been claimed meanwhile.
            let facts = |point: &_| self.point_facts(point, &id);
            let spec = plan::complete(spec, &info.descriptor, &self.ground(&facts))?;
            let after = self.book.last_removed(&id).await?;
            let intent =
                Intent::new(self.here.clone(), spec, after).map_err(|error| Error::refused(error.to_string(), ""))?;
            self.publish(intent).await?
        };
        let revision = intent.current.revision;
        // Those that are ready before the first cycle need not decline it; the others follow by themselves.
        let held = self
            .ask_members(&tried.ready, &Ask::Hold(Box::new((*intent).clone()), revision))
            .instrument(info_span!(target: SPANS, "make ready", revision))
            .await;
        for host in held.ready {
            self.homes.told(&host, vec![(id.clone(), revision)], &[], false);
        }
        if let Err(error) = self.open(&intent, None).await {
            if let Some(tombstone) = self.book.remove(&id).await? {
                self.announce(&Notice::Gone(tombstone));
            }
            return Err(error);
        }
        Ok(ApplyEnd {
            id,
            revision,
            created: true,
            unchanged: false,
            hand_over: None,
            dropped_parameters: Vec::new(),
            dropped_ports: Vec::new(),
            warnings,
        })
    }

    /// Brings a checked specification into force. The caller has the loop's lock.
    async fn change(
        self: &Arc<Self>,
        intent: Arc<Intent>,
        spec: LoopSpec,
        info: &ComponentInfo,
        dropped: Dropped,
    ) -> Result<ApplyEnd, Error> {
        let id = intent.loop_id.clone();
        if !self.homes.is_open(&id) {
            return Err(Error::busy(
                format!("loop {id} is not open at its home yet"),
                "try again; its failures say what is in the way",
            ));
        }
        self.settle_locked(&id).await?;
        let current = &self.book.find(&id)?.current.clone();
        // What ran before within this limit may always be gone back to, and so may what was chosen for the worst case.
        let ran = |past: &LoopSpec| past.digest == spec.digest && past.step_limit_ns() == spec.step_limit_ns();
        let known = intent.revisions().any(ran) || current.fallback == Some(spec.digest);
        let mut warnings = admission::warnings(info, &spec, known)?;
        warnings.extend(dropped.notes.iter().cloned());
        let goes_on = current.digest == spec.digest || current.fallback == Some(spec.digest);
        warnings.extend(self.may_start(info, goes_on)?);
        if let Some(digest) = spec.fallback.filter(|digest| current.fallback != Some(*digest)) {
            let fallback = self.info_of(digest, None).await?;
            warnings.extend(self.may_start(&fallback, false)?);
        }
        let end = |revision, unchanged, hand_over| ApplyEnd {
            id: id.clone(),
            revision,
            created: false,
            unchanged,
            hand_over,
            dropped_parameters: dropped.parameters.clone(),
            dropped_ports: dropped.ports.clone(),
            warnings: warnings.clone(),
        };
        if plan::same(current, &spec) {
            return Ok(end(current.revision, true, None));
        }
        let eligible = self.roster.eligible();
        if eligible.is_empty() {
            return Err(nobody());
        }
        let (intent, revision) = {
            let _claim = self.homes.claims.lock().await;
            let facts = |point: &_| self.point_facts(point, &id);
            let spec = plan::complete(spec, &info.descriptor, &self.ground(&facts))?;
            let mut intent = (*self.book.find(&id)?).clone();
            let revision = intent
                .propose(spec)
                .map_err(|error| Error::busy(error.to_string(), ""))?;
            (self.publish(intent).await?, revision)
        };
        match self.bring_in(&intent, revision, &eligible).await {
            Ok(Revised::Done(record)) => {
                let mut intent = (*self.book.find(&id)?).clone();
                intent
                    .commit(revision)
                    .map_err(|error| Error::internal(error.to_string()))?;
                self.publish(intent).await?;
                Ok(end(revision, false, hand_over(&record)))
            }
            Ok(Revised::Refused(reason)) => {
                self.take_back(&id, revision).await?;
                Err(Error::refused(
                    format!("loop {id} did not go on with the change: {reason}"),
                    "the old revision stays in force",
                ))
            }
            Ok(Revised::TakenBack(error)) | Err(error) => {
                self.take_back(&id, revision).await?;
                Err(error)
            }
        }
    }

    async fn take_back(&self, id: &LoopId, revision: u64) -> Result<(), Error> {
        let mut intent = (*self.book.find(id)?).clone();
        intent
            .withdraw(revision)
            .map_err(|error| Error::internal(error.to_string()))?;
        self.publish(intent).await.map(drop)
    }

    /// From proposal to the first record, or to the reason why there is none.
    async fn bring_in(
        self: &Arc<Self>,
        intent: &Intent,
        revision: u64,
        eligible: &[Candidate],
    ) -> Result<Revised, Error> {
        let id = &intent.loop_id;
        let spec = intent
            .find(revision)
            .ok_or_else(|| Error::internal("a proposed revision is gone"))?;
        let known = self.home_revision(spec).await?;
        self.field
            .add_home_revision(known)
            .map_err(|error| Error::busy(chain(&error), ""))?;
        let mut members = wanted_members(intent, eligible);
        let owner = self.field.home_view(id).and_then(|view| view.owner);
        if let Some(owner) = owner
            .as_ref()
            .filter(|owner| !members.contains(owner) && self.roster.there(owner))
        {
            members.push(owner.clone());
        }
        let readiness = self
            .ask_members(&members, &Ask::Hold(Box::new(intent.clone()), revision))
            .instrument(info_span!(target: SPANS, "make ready", revision))
            .await;
        for host in &readiness.ready {
            self.homes.told(host, vec![(id.clone(), revision)], &[], false);
        }
        // All, or the one that must take it and one to stand by.
        let owner_ready = owner
            .as_ref()
            .is_none_or(|owner| readiness.ready.contains(owner) || !self.roster.there(owner));
        let enough = readiness.missing.is_empty() || (owner_ready && readiness.ready.len() >= 2);
        if !enough {
            return Err(readiness.failure(
                &format!("the change of loop {id} is not ready where it must be"),
                "the old revision stays in force",
            ));
        }
        let switch = self.revise(id, revision, intent.current.period_ns);
        switch.instrument(info_span!(target: SPANS, "switch", revision)).await
    }

    /// Asks the loop to go on with a revision, and waits until that is decided one way or the other.
    async fn revise(&self, id: &LoopId, revision: u64, period_ns: u64) -> Result<Revised, Error> {
        let command = Command {
            id: self.new_command_id(),
            body: CommandBody::Revise(revision),
        };
        let command_id = command.id;
        let (sender, mut receiver) = oneshot::channel();
        let reply = Box::new(move |reply| drop(sender.send(reply)));
        self.field
            .command(id, command, reply)
            .map_err(|error| Error::busy(chain(&error), ""))?;
        let period = Duration::from_nanos(period_ns);
        let mut wait = COMMAND_WAIT_MIN.max(period * 3);
        loop {
            match timeout(wait, &mut receiver).await {
                Ok(Ok(CommandReply::Applied { applied, record })) => {
                    return Ok(match applied.outcome {
                        Outcome::Done => Revised::Done(record),
                        Outcome::Refused(reason) => Revised::Refused(reason),
                    });
                }
                Ok(Ok(CommandReply::Full)) => {
                    return Err(Error::busy(
                        format!("too many commands wait for loop {id}"),
                        "try again",
                    ));
                }
                Ok(Ok(CommandReply::NoSuchLoop) | Err(_)) => {
                    return Err(Error::busy(
                        format!("loop {id} was closed at its home"),
                        "look at the loop, then try again",
                    ));
                }
                Err(_) => {
                    if self.withdraw(id, command_id).await == Some(true) {
                        return Ok(Revised::TakenBack(Error::timeout(
                            format!("no cycle of loop {id} took the change within {} s", wait.as_secs_f32()),
                            "the old revision stays in force; check that the loop has an owner",
                        )));
                    }
                    // It rides in a sample that is out: the next record decides, or the next try to take it back.
                    wait = period.max(Duration::from_millis(100));
                }
            }
        }
    }

    /// Takes a command back. None where the loop does not say.
    pub(crate) async fn withdraw(&self, id: &LoopId, command: bumpless_core::CommandId) -> Option<bool> {
        let (sender, receiver) = oneshot::channel();
        self.field
            .withdraw(id, command, Box::new(move |taken| _ = sender.send(taken)))
            .ok()?;
        timeout(COMMAND_WAIT_MIN, receiver).await.ok()?.ok()
    }

    /// Could this host run it? Nothing stays.
    pub(crate) async fn try_here(self: &Arc<Self>, from: &HostId, spec: LoopSpec) -> Result<Told, Error> {
        self.made_ready(Arc::new(spec), Some(from)).await.map(|_| Told::Done)
    }

    /// Makes a revision ready here, and says when it is.
    pub(crate) async fn hold_here(
        self: &Arc<Self>,
        from: &HostId,
        intent: Intent,
        revision: u64,
    ) -> Result<Told, Error> {
        let spec = intent
            .find(revision)
            .cloned()
            .ok_or_else(|| Error::internal("the intent has no such revision"))?;
        let home = intent.home.clone();
        if home != *from {
            return Err(Error::refused(
                format!("only the home of loop {} may ask for this", intent.loop_id),
                "",
            ));
        }
        crate::sync::check(&intent)?;
        if home != self.here {
            self.book.keep(Arc::new(intent)).await?;
        }
        let span = info_span!(target: SPANS, "hold", loop.name = %spec.id, revision, host = %self.here);
        self.hold(&spec, &home).instrument(span).await.map(|()| Told::Done)
    }
}

fn nobody() -> Error {
    Error::unreachable(
        "no host that runs controllers is there",
        "start one, or wait until one is back",
    )
}

/// How the state came over, as the record says.
fn hand_over(record: &Record) -> Option<HandOverView> {
    record.events.iter().find_map(|event| match event {
        Event::Revised {
            from_digest,
            by,
            bump_percent,
            ..
        } => Some(HandOverView {
            by: by.clone(),
            bump_percent: *bump_percent,
            from_digest: *from_digest,
        }),
        _ => None,
    })
}
