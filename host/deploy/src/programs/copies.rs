//! The home's part: copies of its programs on the disks of standbys, so that another host can go on with them.
//!
//! ```text
//!  each second, and when something changed:
//!    too few standbys there ──────────────► others are chosen, on the disk
//!    a standby has not the newest ────────► it is sent that, some programs at a time
//!    one says that it is the home, and newer ──► this host's desk becomes a copy
//!    one says that the program was removed ────► so it is here
//!  after a start: nothing is run before the standbys have said so, or were waited for
//! ```
//! Queue policy: nothing waits. A standby is sent the newest state, however many changes that passes over.
//! Owns: which hosts are standbys, and what each is known to have. Never: a decision of a standby's.

use std::{
    collections::BTreeMap,
    sync::{Arc, atomic::Ordering},
};

use bumpless_core::{HostId, LoopId, ProgramId, ProgramSpec, place::rank_preferring};
use futures_util::future::join_all;

use super::{Copied, Desk, Known, Position, ProgramAsk, ProgramTold, Row, standby::Copy};
use crate::{
    beat::every,
    book::on_disk,
    error::Error,
    limits::{COPIES_PAUSE, PROGRAM_SURE_AFTER, PROGRAM_TERMS_SKIPPED, RECONCILE_EVERY},
    room::Room,
};

/// Standbys of one program: one may be away, as the home is.
const STANDBYS: usize = 2;
/// Programs in one message: 2 MB of checkpoints.
const COPIES_AT_ONCE: usize = 32;
/// Removed programs that are remembered, those of the greatest terms: what comes back after so many is taken for new.
const GONE_MAX: usize = 1_000;

/// Is one desk newer than another? Of two that say the same of themselves, the home's name decides.
pub(super) fn is_newer(a: &Desk, b: &Desk) -> bool {
    (a.position(), &a.spec.home) > (b.position(), &b.spec.home)
}

/// The standbys of a program: the other masters of its devices, those that it has and that are there, then the ranking. One that
/// is away stays where nobody else is there.
fn chosen(
    partners: &[HostId],
    now: &[HostId],
    ranked: &[HostId],
    here: &HostId,
    there: impl Fn(&HostId) -> bool,
) -> Vec<HostId> {
    let mut standbys: Vec<HostId> = Vec::new();
    let wanted = STANDBYS.max(partners.len());
    let present = now.iter().filter(|host| there(host));
    let all = partners.iter().chain(present).chain(ranked).chain(now);
    for host in all.filter(|host| *host != here) {
        if standbys.len() < wanted && !standbys.contains(host) {
            standbys.push(host.clone());
        }
    }
    standbys
}

impl Room {
    /// Keeps copies where they shall be: of the programs at home here, and those that are here. Until the room stops.
    pub(crate) async fn keep_copies(room: Arc<Self>) {
        let mut tick = every(RECONCILE_EVERY);
        loop {
            let look = tokio::select! {
                _ = tick.tick() => true,
                () = room.programs.changed.notified() => false,
            };
            if look {
                room.choose_standbys().await;
            }
            room.send_copies().await;
            room.be_sure();
            if look {
                room.look_after_copies().await;
            }
            // Who saves all the time is copied now and then.
            tokio::time::sleep(COPIES_PAUSE).await;
        }
    }

    /// The other masters of the devices that a program's points are on.
    fn partners(&self, spec: &ProgramSpec) -> Vec<HostId> {
        let Some(io) = &self.io else { return Vec::new() };
        let mut hosts: Vec<HostId> = spec
            .grants
            .values()
            .filter_map(|grant| io.redundant(io.index(&grant.point)?))
            .map(|(_, view)| view.with)
            .collect();
        hosts.sort();
        hosts.dedup();
        hosts
    }

    async fn choose_standbys(self: &Arc<Self>) {
        let _turn = self.programs.changing.lock().await;
        let eligible = self.roster.eligible();
        let others = eligible.iter().filter(|candidate| candidate.host != self.here).count();
        let desks: Vec<Desk> = {
            let desks = self.programs.desks.lock();
            let changed = desks.values().filter(|kept| kept.sure).filter_map(|kept| {
                let now = &kept.desk.standbys;
                let there = |host: &HostId| self.roster.there(host);
                if now.len() >= STANDBYS.min(others) && now.iter().all(there) {
                    return None;
                }
                let spec = &kept.desk.spec;
                let id = LoopId::new(spec.id.as_str()).ok()?;
                let ranked = rank_preferring(&id, &eligible, &spec.prefer);
                let standbys = chosen(&self.partners(spec), now, &ranked, &self.here, there);
                (standbys != *now).then(|| Desk {
                    standbys,
                    ..kept.desk.clone()
                })
            });
            // The rest has its turn a second later: what is copied here is held twice.
            changed.take(8 * COPIES_AT_ONCE).collect()
        };
        if desks.is_empty() {
            return;
        }
        if let Err(error) = self.programs_keep(desks).await {
            tracing::warn!(%error, "the standbys of programs could not be written down");
        }
    }

    async fn send_copies(self: &Arc<Self>) {
        let there = self.roster.others();
        for kept in self.programs.desks.lock().values_mut() {
            // One that comes back may have lost its disk.
            kept.told.retain(|host, _| there.contains(host));
        }
        join_all(there.into_iter().map(|host| async move {
            while let Some(desks) = self.copies_for(&host) {
                if !self.send_some(&host, desks).await {
                    return;
                }
            }
        }))
        .await;
    }

    /// What a host does not have yet; none for nothing.
    fn copies_for(&self, host: &HostId) -> Option<Vec<Desk>> {
        let desks = self.programs.desks.lock();
        let lacking = desks.values().filter(|kept| {
            let desk = &kept.desk;
            let concerned = desk.standbys.contains(host) || desk.former.as_ref() == Some(host);
            concerned && kept.told.get(host) != Some(&desk.position())
        });
        let some: Vec<Desk> = lacking.take(COPIES_AT_ONCE).map(|kept| kept.desk.clone()).collect();
        (!some.is_empty()).then_some(some)
    }

    /// Sends some copies. Says whether more may follow.
    async fn send_some(self: &Arc<Self>, host: &HostId, desks: Vec<Desk>) -> bool {
        let sent: Vec<(ProgramId, Position)> = desks
            .iter()
            .map(|desk| (desk.spec.id.clone(), desk.position()))
            .collect();
        let answers = match self.program_tell(host, ProgramAsk::Copies(desks)).await {
            Ok(ProgramTold::Copied(answers)) if answers.len() == sent.len() => answers,
            Ok(_) => return false,
            Err(error) => {
                tracing::debug!(%host, %error, "a standby did not take copies; they are sent again");
                return false;
            }
        };
        let mut all = true;
        for ((id, position), answer) in sent.into_iter().zip(answers) {
            match answer {
                Copied::Kept => self.copy_is_there(&id, host, position).await,
                Copied::Newer(desk) => self.superseded(*desk).await,
                Copied::Gone => self.dropped(&id, position).await,
                Copied::Unknown | Copied::Refused => all = false,
            }
        }
        all
    }

    async fn copy_is_there(&self, id: &ProgramId, host: &HostId, position: Position) {
        let former = {
            let mut desks = self.programs.desks.lock();
            let Some(kept) = desks.get_mut(id) else { return };
            kept.told.insert(host.clone(), position);
            kept.desk.former.as_ref() == Some(host)
        };
        if !former {
            return;
        }
        let _turn = self.programs.changing.lock().await;
        let Ok(mut desk) = self.program_desk(id) else { return };
        desk.former = None;
        if let Err(error) = self.program_keep(desk).await {
            tracing::warn!(program = %id, %error, "that the former home knows could not be written down");
        }
    }

    /// Another host is the program's home: what is here becomes a copy.
    async fn superseded(self: &Arc<Self>, newer: Desk) {
        let id = newer.spec.id.clone();
        let before = {
            let _turn = self.programs.changing.lock().await;
            let Ok(own) = self.program_desk(&id) else { return };
            if !is_newer(&newer, &own) {
                return;
            }
            if let Err(error) = self.desk_becomes_copy(newer).await {
                tracing::warn!(program = %id, %error, "that another host is the program's home could not be written down");
                return;
            }
            own
        };
        self.end_at_owner(&before).await;
    }

    /// The caller holds `changing`.
    pub(super) async fn desk_becomes_copy(&self, newer: Desk) -> Result<(), Error> {
        let id = newer.spec.id.clone();
        let (store, name) = (self.store.clone(), id.clone());
        let desk = on_disk(move || {
            let row = Row::Copy(Box::new(newer));
            store.put_program(name.as_str(), &row).map(|()| row)
        })
        .await??;
        let Row::Copy(desk) = desk else { return Ok(()) };
        tracing::warn!(program = %id, home = %desk.spec.home, "another host is the program's home now");
        let mut desks = self.programs.desks.lock();
        self.programs.copies.lock().insert(id.clone(), Copy::of(*desk));
        desks.remove(&id);
        Ok(())
    }

    async fn end_at_owner(self: &Arc<Self>, desk: &Desk) {
        let end = ProgramAsk::End(desk.spec.id.clone(), desk.fence.term);
        if let Err(error) = self.program_tell(&desk.fence.owner, end).await {
            tracing::debug!(program = %desk.spec.id, %error, "the owner did not answer; the home ends its run");
        }
    }

    /// The program was removed while this host was away.
    async fn dropped(self: &Arc<Self>, id: &ProgramId, position: Position) {
        let desk = {
            let _turn = self.programs.changing.lock().await;
            let Ok(desk) = self.program_desk(id) else { return };
            if desk.position() != position {
                return;
            }
            tracing::warn!(program = %id, "the program was removed while this host was away");
            if let Err(error) = self.program_gone(id, &desk).await {
                tracing::warn!(program = %id, %error, "a program could not be removed");
                return;
            }
            desk
        };
        self.end_at_owner(&desk).await;
    }

    /// Forgets a program that is at home here, and has its copies forgotten. The caller holds `changing`.
    pub(super) async fn program_gone(self: &Arc<Self>, id: &ProgramId, desk: &Desk) -> Result<(), Error> {
        let mut hosts = desk.standbys.clone();
        hosts.extend(desk.former.clone());
        let term = desk.fence.term;
        if hosts.is_empty() {
            let (store, name) = (self.store.clone(), id.clone());
            on_disk(move || store.remove_program(name.as_str())).await??;
        } else {
            self.remember_gone(id, term).await?;
        }
        self.programs.desks.lock().remove(id);
        let (room, id) = (Arc::clone(self), id.clone());
        self.spawn(async move {
            let tell = |host: HostId| {
                let (room, id) = (Arc::clone(&room), id.clone());
                async move {
                    if let Err(error) = room.program_tell(&host, ProgramAsk::Removed(id, term)).await {
                        tracing::debug!(%host, %error, "a standby was not told of a removal; it asks when it is back");
                    }
                }
            };
            join_all(hosts.into_iter().map(tell)).await;
        });
        Ok(())
    }

    /// Writes down that a program was removed, in the place of what was known of it.
    pub(super) async fn remember_gone(&self, id: &ProgramId, term: u64) -> Result<(), Error> {
        let over: Vec<ProgramId> = {
            let mut gone = self.programs.gone.lock();
            gone.insert(id.clone(), term);
            surplus(&mut gone)
        };
        let (store, name) = (self.store.clone(), id.clone());
        on_disk(move || {
            store.put_program(name.as_str(), &Row::Gone(term))?;
            over.iter()
                .try_for_each(|old| store.remove_program(old.as_str()).map(drop))
        })
        .await?
        .map_err(Error::from)
    }

    /// After a start: have the standbys of each program been heard?
    fn be_sure(&self) {
        let waited = self.programs.opened.elapsed() >= PROGRAM_SURE_AFTER;
        let mut news = false;
        for kept in self.programs.desks.lock().values_mut().filter(|kept| !kept.sure) {
            let mut asked = kept.desk.standbys.iter().chain(&kept.desk.former);
            if waited || asked.all(|host| kept.told.contains_key(host)) {
                kept.sure = true;
                news = true;
            }
        }
        if news {
            self.programs.poke.notify_one();
        }
    }

    /// What a standby shall do with its copies.
    pub(super) fn copies_wanted(&self, from: &HostId, ids: &[ProgramId]) -> Vec<Copied> {
        let desks = self.programs.desks.lock();
        let copies = self.programs.copies.lock();
        let gone = self.programs.gone.lock();
        let word = |id: &ProgramId| match desks.get(id) {
            Some(kept) if kept.desk.standbys.contains(from) => Copied::Kept,
            Some(_) => Copied::Gone,
            None if gone.contains_key(id) => Copied::Gone,
            // The new home will say.
            None if copies.contains_key(id) => Copied::Kept,
            None => Copied::Unknown,
        };
        ids.iter().map(word).collect()
    }

    /// A copy comes back to a home that has lost its disk.
    pub(super) async fn program_returns(self: &Arc<Self>, mut desk: Desk) -> Result<(), Error> {
        let id = desk.spec.id.clone();
        let _turn = self.programs.changing.lock().await;
        let known = self.programs_known(std::slice::from_ref(&id)) != [None];
        if known || self.programs.gone.lock().contains_key(&id) || desk.spec.home != self.here {
            return Ok(());
        }
        desk.spec
            .check()
            .map_err(|error| Error::invalid(error.to_string(), ""))?;
        tracing::warn!(program = %id, "a program of this host comes back from a standby");
        let (owner, ended) = (desk.fence.owner.clone(), desk.ended.take());
        let floor = desk.fence.term.saturating_add(PROGRAM_TERMS_SKIPPED);
        desk.give(owner, floor.max(self.program_term_floor(&id)));
        desk.ended = ended;
        self.program_keep(desk).await?;
        self.programs.poke.notify_one();
        Ok(())
    }

    /// What is known of programs here.
    pub(super) fn programs_known(&self, ids: &[ProgramId]) -> Vec<Option<Known>> {
        let desks = self.programs.desks.lock();
        let copies = self.programs.copies.lock();
        let known = |id: &ProgramId| {
            let own = desks.get(id).map(|kept| (true, kept.desk.position()));
            let copy = || copies.get(id).map(|copy| (false, copy.desk.position()));
            own.or_else(copy).map(|(home, position)| Known { home, position })
        };
        ids.iter().map(known).collect()
    }

    /// A term that no earlier one of a program reaches, whoever gave it.
    pub(super) fn term_beyond(&self, desk: &Desk, epoch: Option<u32>) -> u64 {
        let skipped = desk.fence.term.saturating_add(PROGRAM_TERMS_SKIPPED);
        let lease = u64::from(epoch.unwrap_or(0)).saturating_mul(crate::limits::TERMS_PER_EPOCH);
        let last = self.programs.last_term.load(Ordering::Acquire);
        skipped.max(lease).max(self.terms.floor()).max(last)
    }
}

/// Takes out what is too much: those of the least terms.
fn surplus(gone: &mut BTreeMap<ProgramId, u64>) -> Vec<ProgramId> {
    let mut over = Vec::new();
    while gone.len() > GONE_MAX {
        let Some(least) = gone.iter().min_by_key(|(_, term)| **term).map(|(id, _)| id.clone()) else {
            break;
        };
        gone.remove(&least);
        over.push(least);
    }
    over
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn hosts(names: &[&str]) -> Vec<HostId> {
        names.iter().map(|name| HostId::new(*name).unwrap()).collect()
    }

    #[test]
    fn standbys_stay_while_they_are_there_and_partners_come_first() {
        for (partners, now, ranked, away, expected) in [
            (&[][..], &[][..], &["a", "b", "c"][..], &[][..], &["b", "c"][..]),
            (&[], &["c", "d"], &["a", "b", "c", "d"], &[], &["c", "d"]),
            (&[], &["c", "d"], &["a", "b", "d"], &["c"], &["d", "b"]),
            (&[], &["c", "d"], &["a"], &["c", "d"], &["c", "d"]),
            (&["z"], &["c", "d"], &["a", "b"], &["z"], &["z", "c"]),
            (&[], &[], &["a"], &[], &[]),
        ] {
            let (partners, now, ranked, away) = (hosts(partners), hosts(now), hosts(ranked), hosts(away));
            let here = HostId::new("a").unwrap();
            let standbys = chosen(&partners, &now, &ranked, &here, |host| !away.contains(host));
            assert_eq!(standbys, hosts(expected), "{now:?} {ranked:?}");
        }
    }

    #[test]
    fn of_those_that_were_removed_the_newest_are_remembered() {
        let id = |n: usize| ProgramId::new(format!("p{n}")).unwrap();
        let mut gone: BTreeMap<ProgramId, u64> = (0..GONE_MAX + 2).map(|n| (id(n), n as u64)).collect();
        assert_eq!(surplus(&mut gone), [id(0), id(1)]);
        assert_eq!(gone.len(), GONE_MAX);
    }
}
