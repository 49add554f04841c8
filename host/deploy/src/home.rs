//! The loops whose home is here: opened, kept in step with the hosts that are there, and settled after a rollback.
//!
//! Owns: which hosts hold which revisions (as they report it), and which members the loops were last told.
//! Never: decides who owns a loop; the arbiter does, among the members.
//!
//! ```text
//! intent here ──records gathered──► opened ──members told, again when hosts come, go, get ready or drain──► closed (deleted)
//!                                     │
//!                                     └─ a record of another revision ──► intent settled: committed, on disk, told to all
//! ```

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
    sync::Arc,
    time::{Duration, Instant},
};

use bumpless_core::{
    ComponentInfo, Digest, HostId, Intent, LoopId, LoopSpec, PointId, Record,
    place::{self, Candidate},
};
use bumpless_loops::HomeRevision;
use futures_util::future::join_all;
use parking_lot::Mutex;
use tokio::task::JoinSet;

use crate::{
    audit::{Act, AuditKind},
    bench::wire_up,
    error::Error,
    holder::{wanted_members, wanted_revisions},
    limits::{ANSWER_WAIT, GATHER_WAIT, MOVE_WAIT, RECORDS_ASKED},
    masters::Mastery,
    plan::PointFacts,
    preference::{Favourites, Look},
    room::{Locks, Room},
    wire::{Ask, Notice, Told},
};

/// Pause between two looks for hosts that came while records are gathered.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Pause after which a move that was asked for is looked at again.
const MOVE_LOOK: Duration = Duration::from_millis(200);

/// An opened home.
#[derive(Debug, Default, Clone)]
struct Opened {
    /// The members that the loops were last told.
    members: Vec<HostId>,
    /// The mastership under which it was opened; none where its devices have one master.
    epoch: Option<u32>,
    /// An owner that shall give the loop away, and since when.
    leaving: Option<(HostId, Instant)>,
    /// What is remembered of the hosts that it prefers.
    favourites: Favourites,
}

/// The homes of this host.
#[derive(Debug, Default)]
pub(crate) struct Homes {
    opened: Mutex<BTreeMap<LoopId, Opened>>,
    ready: Mutex<HashMap<HostId, BTreeSet<(LoopId, u64)>>>,
    /// The revision that the latest record of another revision named.
    revised: Mutex<HashMap<LoopId, u64>>,
    /// Held while a loop is changed.
    pub(crate) locks: Locks,
    /// Held while points are claimed, so that two loops do not get one output.
    pub(crate) claims: tokio::sync::Mutex<()>,
}

impl Homes {
    pub(crate) fn revised(&self, id: &LoopId, revision: u64) {
        self.revised.lock().insert(id.clone(), revision);
    }

    pub(crate) fn is_open(&self, id: &LoopId) -> bool {
        self.opened.lock().contains_key(id)
    }

    /// The mastership under which a home was opened.
    pub(crate) fn epoch(&self, id: &LoopId) -> Option<u32> {
        self.opened.lock().get(id).and_then(|opened| opened.epoch)
    }

    /// A host reports what it holds. Gives back how much it is believed to hold now.
    pub(crate) fn told(&self, from: &HostId, came: Vec<(LoopId, u64)>, went: &[(LoopId, u64)], afresh: bool) -> u64 {
        let mut ready = self.ready.lock();
        let pairs = ready.entry(from.clone()).or_default();
        if afresh {
            pairs.clear();
        }
        for pair in went {
            pairs.remove(pair);
        }
        pairs.extend(came);
        pairs.len() as u64
    }

    /// What a host that went, or came anew, held is not known.
    pub(crate) fn forget_host(&self, host: &HostId) {
        self.ready.lock().remove(host);
    }

    /// Can this host step this revision, as far as it was reported?
    pub(crate) fn is_ready(&self, host: &HostId, id: &LoopId, revision: u64) -> bool {
        self.ready
            .lock()
            .get(host)
            .is_some_and(|pairs| pairs.contains(&(id.clone(), revision)))
    }

    /// The members that the loops were last told.
    pub(crate) fn members(&self, id: &LoopId) -> Vec<HostId> {
        self.opened
            .lock()
            .get(id)
            .map(|opened| opened.members.clone())
            .unwrap_or_default()
    }

    /// A person moved the loop there, whatever it prefers.
    pub(crate) fn moved(&self, id: &LoopId, to: &HostId) {
        if let Some(opened) = self.opened.lock().get_mut(id) {
            opened.favourites.sent(to.clone(), Instant::now());
        }
    }

    pub(crate) fn closed(&self, id: &LoopId) {
        self.opened.lock().remove(id);
        self.revised.lock().remove(id);
    }
}

/// The members to tell: those of the wanted that are ready, filled up with others that are ready and still there; where
/// nobody is, the wanted, who are getting ready.
pub(crate) fn members_now(
    wanted: &[HostId],
    ranked: &[HostId],
    n: usize,
    ready: &dyn Fn(&HostId) -> bool,
) -> Vec<HostId> {
    let mut chosen: Vec<HostId> = wanted.iter().filter(|h| ready(h)).cloned().collect();
    if chosen.is_empty() {
        let others: Vec<HostId> = ranked.iter().filter(|h| ready(h)).take(n).cloned().collect();
        return if others.is_empty() { wanted.to_vec() } else { others };
    }
    for host in ranked {
        if chosen.len() >= n.min(wanted.len()) {
            break;
        }
        if ready(host) && !chosen.contains(host) {
            chosen.push(host.clone());
        }
    }
    chosen
}

/// Takes back what is on its way in, where nobody waits for it.
fn withdraw_pending(intent: &mut Intent) -> Result<(), Error> {
    match intent.pending.as_ref().map(|spec| spec.revision) {
        Some(pending) => intent
            .withdraw(pending)
            .map(drop)
            .map_err(|error| Error::internal(error.to_string())),
        None => Ok(()),
    }
}

impl Room {
    /// What this host knows of one of its points.
    pub(crate) fn point_facts(&self, point: &PointId, of: &LoopId) -> Option<PointFacts> {
        let io = self.io.as_ref()?;
        let info = io.info(io.index(point)?)?;
        let taken_by = if info.writable {
            self.book
                .writer_of(point, Some(of))
                .or_else(|| self.programs.writer_of(point))
        } else {
            None
        };
        Some(PointFacts {
            low: info.low,
            high: info.high,
            unit: info.unit.clone(),
            writable: info.writable,
            taken_by,
        })
    }

    /// A component's summary, from the library or from another host.
    pub(crate) async fn info_of(
        self: &Arc<Self>,
        digest: Digest,
        first: Option<&HostId>,
    ) -> Result<Arc<ComponentInfo>, Error> {
        if let Some(info) = self.library.get(&digest) {
            return Ok(info);
        }
        let mut hosts = self.roster.others();
        hosts.sort_by_key(|host| Some(host) != first);
        for host in hosts {
            if let Ok(Told::Info(Some(info))) = self.ask(&host, Ask::Info(digest), ANSWER_WAIT).await
                && info.digest == digest
                && info.check().is_ok()
            {
                return Ok(Arc::from(info));
            }
        }
        Err(Error::not_found(
            format!("no host knows component {}", digest.short()),
            "upload it again",
        ))
    }

    /// A revision as the loops' home needs it.
    pub(crate) async fn home_revision(self: &Arc<Self>, spec: &LoopSpec) -> Result<HomeRevision, Error> {
        let info = self.info_of(spec.digest, None).await?;
        let wiring = wire_up(spec, &info.descriptor)?;
        Ok(HomeRevision {
            spec: Arc::new(spec.clone()),
            wiring: Arc::new(wiring),
            term_floor: self.term_floor(spec),
        })
    }

    /// Before the first home opens: the newest records that other hosts have of our loops, for what our disk has may be a
    /// second old. Bounded; a host that comes later is too late, and the terms that a restart skips keep its record out. Who could
    /// not be asked is asked again: just after a quick restart a member may still speak with the life before.
    pub(crate) async fn gather_records(self: &Arc<Self>) {
        let ours: Vec<LoopId> = self
            .book
            .all()
            .iter()
            .filter(|i| i.home == self.here)
            .map(|i| i.loop_id.clone())
            .collect();
        if ours.is_empty() {
            return;
        }
        let until = tokio::time::Instant::now() + GATHER_WAIT;
        let ours = Arc::new(ours);
        let (mut asked, mut asking) = (HashSet::new(), JoinSet::new());
        while tokio::time::Instant::now() < until {
            for host in self.session.hosts() {
                if host != self.here && asked.insert(host.clone()) {
                    let (room, ours) = (Arc::clone(self), Arc::clone(&ours));
                    asking.spawn(async move {
                        for some in ours.chunks(RECORDS_ASKED) {
                            match room.ask(&host, Ask::Records(some.to_vec()), GATHER_WAIT).await {
                                Ok(Told::Records(records)) => {
                                    for record in records {
                                        room.feed.remember(&Arc::new(record));
                                    }
                                }
                                other => {
                                    let why = other.err();
                                    tracing::debug!(%host, ?why, "the records of a host could not be asked for; it is asked again");
                                    return Some(host);
                                }
                            }
                        }
                        None
                    });
                }
            }
            let pause = tokio::time::Instant::now() + LOOK_EVERY;
            tokio::time::sleep_until(pause.min(until)).await;
            while let Some(answered) = asking.try_join_next() {
                if let Ok(Some(host)) = answered {
                    asked.remove(&host);
                }
            }
        }
    }

    /// Settles revisions, tells members, opens homes. Idempotent.
    pub(crate) async fn keep_homes(self: &Arc<Self>) {
        self.follow_masters().await;
        let ours = || self.book.all().into_iter().filter(|intent| intent.home == self.here);
        // The open ones first: opening may have to wait for other hosts.
        let eligible = self.roster.eligible();
        let mut look_again = false;
        for intent in ours().filter(|intent| self.homes.is_open(&intent.loop_id)) {
            if let Err(error) = self.settle(&intent).await {
                tracing::warn!(loop_id = %intent.loop_id, %error, "the revision in force could not be kept; it is tried again");
            }
            look_again |= self.tell_members(&intent, &eligible);
        }
        if look_again {
            self.poke_in(MOVE_LOOK);
        }
        for intent in ours().filter(|intent| !self.homes.is_open(&intent.loop_id)) {
            let (id, revision) = (&intent.loop_id, intent.current.revision);
            if self.stopped() {
                return;
            }
            let lock = self.homes.locks.of(id);
            // Where another master has the device, or nobody, nothing could be written.
            if self.mastery(&intent.current) == Mastery::Away {
                continue;
            }
            // A new loop is opened by the change that creates it.
            if self.holder.due(id, revision)
                && let Ok(_turn) = lock.try_lock()
                && !self.homes.is_open(id)
                && let Err(error) = self.reopen(id).await
            {
                self.holder.failed(id, revision, &error);
            }
        }
    }

    /// Opens the home of a loop that was there before. The caller has the loop's lock.
    async fn reopen(self: &Arc<Self>, id: &LoopId) -> Result<(), Error> {
        let Some(held) = self.book.get(id) else { return Ok(()) };
        if self.feed.last(id).is_none() {
            // The disk knows of no record, for example because it is new; a member may.
            self.ask_for_record(id).await;
        }
        let last = self.feed.last(id).map(|last| last.record);
        let mut intent = (*held).clone();
        if let Some(record) = &last
            && intent.find(record.revision).is_some()
        {
            intent
                .commit(record.revision)
                .map_err(|error| Error::internal(error.to_string()))?;
        }
        withdraw_pending(&mut intent)?;
        let intent = if intent.position() == held.position() {
            held
        } else {
            self.publish(intent).await?
        };
        self.open(&intent, last).await
    }

    async fn ask_for_record(self: &Arc<Self>, id: &LoopId) {
        let hosts = self.roster.others();
        let ask = |host: HostId| async move { self.ask(&host, Ask::Records(vec![id.clone()]), GATHER_WAIT).await };
        for answer in join_all(hosts.into_iter().map(ask)).await {
            if let Ok(Told::Records(records)) = answer {
                for record in records.into_iter().filter(|record| record.loop_id == *id) {
                    self.feed.remember(&Arc::new(record));
                }
            }
        }
    }

    /// Hands a home to the loops.
    pub(crate) async fn open(self: &Arc<Self>, intent: &Intent, last: Option<Arc<Record>>) -> Result<(), Error> {
        // Looked at before the floor of the terms is: one that came meanwhile is noticed, and the home opened again.
        let mastery = self.mastery(&intent.current);
        let revision = self.home_revision(&intent.current).await?;
        self.set_aside_terms(last.as_deref()).await;
        self.field
            .open_home(revision, last)
            .map_err(|error| Error::refused(crate::error::chain(&error), ""))?;
        for spec in wanted_revisions(intent)
            .into_iter()
            .filter(|spec| spec.revision != intent.current.revision)
        {
            // What a probation may go back to. Without it a rollback's commit would be refused, so it is worth a warning.
            let known = match self.home_revision(spec).await {
                Ok(known) => self.field.add_home_revision(known).map_err(|error| error.to_string()),
                Err(error) => Err(error.to_string()),
            };
            if let Err(error) = known {
                tracing::warn!(loop_id = %spec.id, revision = spec.revision, error, "an earlier revision cannot be gone back to");
            }
        }
        self.homes.opened.lock().insert(
            intent.loop_id.clone(),
            Opened {
                epoch: match mastery {
                    Mastery::Master(epoch) => Some(epoch),
                    Mastery::Alone | Mastery::Away => None,
                },
                ..Opened::default()
            },
        );
        self.holder.succeeded(&intent.loop_id, intent.current.revision);
        if self.tell_members(intent, &self.roster.eligible()) {
            self.poke_in(MOVE_LOOK);
        }
        Ok(())
    }

    /// Keeps a change of an intent of ours, and tells all hosts.
    pub(crate) async fn publish(&self, intent: Intent) -> Result<Arc<Intent>, Error> {
        let intent = self.book.change(intent).await?;
        self.announce(&Notice::Intent(intent.loop_id.clone(), intent.position()));
        Ok(intent)
    }

    /// Outside of a change: the arbiter took a record of another revision than the intent has in force, because a probation
    /// went back; or a change ended without being able to clear up, because the disk was full. A change that is under way
    /// settles for itself.
    async fn settle(self: &Arc<Self>, intent: &Intent) -> Result<(), Error> {
        let id = &intent.loop_id;
        if self.unsettled(id).is_none() && intent.pending.is_none() {
            return Ok(());
        }
        let lock = self.homes.locks.of(id);
        let Ok(_turn) = lock.try_lock() else { return Ok(()) };
        self.settle_locked(id).await
    }

    /// As [`Room::settle`], for a caller that has the loop's lock.
    pub(crate) async fn settle_locked(self: &Arc<Self>, id: &LoopId) -> Result<(), Error> {
        let held = self.book.find(id)?;
        let mut intent = (*held).clone();
        let revised = self.unsettled(id);
        match revised.map(|revision| intent.commit(revision)) {
            Some(Ok(true)) => {
                tracing::info!(loop_id = %id, revision = intent.current.revision, "the loop went on with another revision by itself");
                let seen = self.seen_revision(&intent, intent.current.revision);
                let asked = serde_json::json!({ "left_revision": held.current.revision });
                let act = Act::on_loop(AuditKind::LoopWentBack, id, asked);
                self.audit_own(act, seen, None).await;
            }
            Some(Err(error)) => tracing::error!(loop_id = %id, %error, "the loop runs a revision that nobody knows"),
            Some(Ok(false)) | None => {}
        }
        withdraw_pending(&mut intent)?;
        if intent.position() != held.position() {
            self.publish(intent).await?;
        }
        let mut unsettled = self.homes.revised.lock();
        if unsettled.get(id).copied() == revised {
            unsettled.remove(id);
        }
        Ok(())
    }

    /// The revision that the loop went to, where that is not settled.
    pub(crate) fn unsettled(&self, id: &LoopId) -> Option<u64> {
        self.homes.revised.lock().get(id).copied()
    }

    /// Tells the loops who may own this one, if that changed. An owner that shall not stay moves the loop first; then this
    /// says that it must be looked at again.
    fn tell_members(&self, intent: &Intent, eligible: &[Candidate]) -> bool {
        let id = &intent.loop_id;
        // Held to the end, so that of two tellers at once the later one is also the one that is remembered.
        let mut all = self.homes.opened.lock();
        let Some(opened) = all.get_mut(id) else { return false };
        let n = usize::from(intent.current.replicas);
        let wanted: Vec<HostId> = wanted_members(intent, eligible).into_iter().take(n).collect();
        let ranked = place::rank_preferring(id, eligible, &intent.current.prefer);
        let ready = |host: &HostId| self.homes.is_ready(host, id, intent.current.revision);
        let mut members = members_now(&wanted, &ranked, n, &ready);
        if !intent.current.prefer.is_empty() && opened.leaving.is_none() {
            let owner = self.field.home_view(id).and_then(|view| view.owner);
            let look = Look {
                candidates: eligible,
                prefer: &intent.current.prefer,
                members: &members,
                owner: owner.as_ref(),
                ready: &ready,
                draining: &|host| self.roster.draining(host),
            };
            if let Some(host) = opened.favourites.look(self.clock.now_ns(), Instant::now(), &look) {
                tracing::info!(loop_id = %id, %host, "the loop goes back to the host that it prefers");
                // Where the worker is too busy the next look asks again.
                let _ = self.field.move_to(id, host);
            }
        }
        if members == opened.members && opened.leaving.is_none() {
            return false;
        }
        let owner = self.field.home_view(id).and_then(|view| view.owner);
        match owner {
            Some(owner) if !members.contains(&owner) && self.roster.there(&owner) && members.iter().any(ready) => {
                let since = match &opened.leaving {
                    Some((host, since)) if *host == owner => *since,
                    _ => Instant::now(),
                };
                if since.elapsed() < MOVE_WAIT {
                    if let Some(next) = members.iter().find(|h| ready(h)) {
                        // Where the worker is too busy the next look asks again.
                        let _ = self.field.move_to(id, next.clone());
                    }
                    members.push(owner.clone());
                    opened.leaving = Some((owner, since));
                } else {
                    opened.leaving = None;
                }
            }
            _ => opened.leaving = None,
        }
        if members != opened.members {
            match self.field.set_members(id, members.clone()) {
                Ok(()) => opened.members = members,
                Err(error) => tracing::debug!(loop_id = %id, %error, "the members are told again later"),
            }
        }
        opened.leaving.is_some()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn members_are_ready_hosts_first_of_all() {
        let name = |h: &str| HostId::new(h).unwrap();
        let all = ["a", "b", "c", "d"].map(name).to_vec();
        let wanted = &all[..3];
        let now = |ready: &str| {
            let ready = |h: &HostId| ready.contains(h.as_str());
            let members = members_now(wanted, &all, 3, &ready);
            members.iter().map(HostId::as_str).collect::<String>()
        };
        assert_eq!(now("abc"), "abc");
        assert_eq!(now("abcd"), "abc");
        assert_eq!(now("bd"), "bd", "one that is ready stands in");
        assert_eq!(now("d"), "d");
        assert_eq!(now(""), "abc", "nobody is ready: those who are getting ready");
    }
}
