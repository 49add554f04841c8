//! The standby's part: copies of programs of other homes, and what becomes of them when such a home is gone.
//!
//! ```text
//!            the home is there                      away for 5 s, or this host is master of the program's devices
//!   copy ◄──────────────────────── copy ───────────────────────────────────────────────────────────► home here,
//!     │ it says: not needed, removed                                        where no host there knows better     terms
//!     ▼                                                                                                          far on
//!   none
//! ```
//! A program whose points only its home serves stays where it is: elsewhere it could neither read nor write. Its copy brings it
//! back to a home that comes again with an empty disk.
//! Owns: copies, on the disk before they are acknowledged. Never: takes over a program whose home is there, except by a lease.

use std::{collections::BTreeMap, sync::Arc, time::Instant};

use bumpless_core::{HostId, ProgramId};
use futures_util::future::join_all;

use super::{Copied, Desk, Known, Position, ProgramAsk, ProgramTold, Row, copies::is_newer};
use crate::{
    book::on_disk,
    error::Error,
    limits::{PROGRAM_HOME_AWAY, PROGRAM_REVISIONS_SKIPPED},
    masters::Mastery,
    room::Room,
};

/// Copies that one host keeps.
const COPIES_MAX: usize = 20_000;
/// Programs that one question is about.
const ASKED_AT_ONCE: usize = 64;

/// A copy, in memory without its checkpoint, which is on the disk.
#[derive(Debug)]
pub(crate) struct Copy {
    pub(crate) desk: Desk,
    away_since: Option<Instant>,
    /// The home has said that it shall be kept, since it came.
    wanted: bool,
}

impl Copy {
    pub(crate) fn of(desk: Desk) -> Self {
        Self {
            desk: Desk {
                checkpoint: None,
                ..desk
            },
            away_since: None,
            wanted: false,
        }
    }

    /// May this host go on with it, going by how long the home is away, and by what it serves of its points?
    fn is_free(&mut self, home_there: bool, mastery: Mastery, now: Instant) -> bool {
        self.away_since = (!home_there).then(|| self.away_since.unwrap_or(now));
        let away = self
            .away_since
            .is_some_and(|since| now.duration_since(since) >= PROGRAM_HOME_AWAY);
        match mastery {
            Mastery::Master(_) => true,
            Mastery::Alone => away && self.desk.spec.grants.is_empty(),
            Mastery::Away => false,
        }
    }
}

/// Is it this host that goes on with a program? `others` are the hosts that said something of it.
fn is_heir(here: &HostId, own: &Desk, others: &[(HostId, Known)]) -> bool {
    let place = |host: &HostId| own.standbys.iter().position(|standby| standby == host);
    let before = |host: &HostId| match (place(host), place(here)) {
        (Some(a), Some(b)) => a < b,
        (Some(_), None) => true,
        (None, Some(_)) => false,
        (None, None) => host < here,
    };
    let position: Position = own.position();
    others.iter().all(|(host, known)| {
        if known.home {
            // The home of before, where a lease has gone from it.
            known.position <= position && *host == own.spec.home
        } else {
            known.position < position || (known.position == position && !before(host))
        }
    })
}

impl Room {
    /// Takes copies of a home's programs.
    pub(super) async fn copies_come(self: &Arc<Self>, from: &HostId, desks: Vec<Desk>) -> Vec<Copied> {
        let _turn = self.programs.changing.lock().await;
        let mut answers = Vec::with_capacity(desks.len());
        let mut rows: Vec<(usize, Desk)> = Vec::new();
        for (place, desk) in desks.into_iter().enumerate() {
            answers.push(match self.copy_comes(from, &desk).await {
                Ok(Copied::Kept) => {
                    rows.push((place, desk));
                    Copied::Kept
                }
                Ok(answer) => answer,
                Err(error) => {
                    tracing::warn!(program = %desk.spec.id, %error, "a copy was refused");
                    Copied::Refused
                }
            });
        }
        if rows.is_empty() {
            return answers;
        }
        let store = self.store.clone();
        let written = on_disk(move || {
            let rows: Vec<(usize, Row)> = rows
                .into_iter()
                .map(|(place, desk)| (place, Row::Copy(Box::new(desk))))
                .collect();
            let named: Vec<(&str, &Row)> = rows
                .iter()
                .filter_map(|(_, row)| match row {
                    Row::Copy(desk) => Some((desk.spec.id.as_str(), row)),
                    Row::Home(_) | Row::Gone(_) => None,
                })
                .collect();
            let end = store.put_programs(&named);
            (rows, end)
        })
        .await;
        match written {
            Ok((rows, Ok(()))) => {
                let mut copies = self.programs.copies.lock();
                let mut gone = self.programs.gone.lock();
                for (_, row) in rows {
                    if let Row::Copy(desk) = row {
                        gone.remove(&desk.spec.id);
                        // A home of before is told, and need not keep it.
                        let wanted = desk.standbys.contains(&self.here);
                        let mut copy = Copy::of(*desk);
                        copy.wanted = wanted;
                        copies.insert(copy.desk.spec.id.clone(), copy);
                    }
                }
            }
            Ok((rows, Err(error))) => {
                tracing::warn!(%error, "copies of programs could not be written");
                for (place, _) in rows {
                    if let Some(answer) = answers.get_mut(place) {
                        *answer = Copied::Refused;
                    }
                }
            }
            Err(error) => {
                tracing::warn!(%error, "copies of programs could not be written");
                answers.fill_with(|| Copied::Refused);
            }
        }
        answers
    }

    /// What becomes of one copy; `Kept` for one that is to be written.
    async fn copy_comes(self: &Arc<Self>, from: &HostId, desk: &Desk) -> Result<Copied, Error> {
        desk.spec
            .check()
            .map_err(|error| Error::invalid(error.to_string(), ""))?;
        let id = &desk.spec.id;
        if desk.spec.home != *from {
            return Err(Error::invalid(
                format!("its home is host {}, and it came from {from}", desk.spec.home),
                "",
            ));
        }
        if self
            .programs
            .gone
            .lock()
            .get(id)
            .is_some_and(|term| *term >= desk.fence.term)
        {
            return Ok(Copied::Gone);
        }
        if let Ok(own) = self.program_desk(id) {
            if !is_newer(desk, &own) {
                return Ok(Copied::Newer(Box::new(own)));
            }
            // Another host is its home, and that one ends the run.
            self.desk_becomes_copy(desk.clone()).await?;
            return Ok(Copied::Kept);
        }
        let newer = {
            let copies = self.programs.copies.lock();
            if !copies.contains_key(id) && copies.len() >= COPIES_MAX {
                return Err(Error::busy(
                    format!("this host has {COPIES_MAX} copies"),
                    "add a host to the cell",
                ));
            }
            let other = copies.get(id).filter(|copy| copy.desk.spec.home != *from);
            other.is_some_and(|copy| is_newer(&copy.desk, desk))
        };
        if newer {
            return Ok(self
                .copy_on_disk(id)
                .await?
                .map_or(Copied::Refused, |copy| Copied::Newer(Box::new(copy))));
        }
        Ok(Copied::Kept)
    }

    /// A copy with its checkpoint.
    async fn copy_on_disk(&self, id: &ProgramId) -> Result<Option<Desk>, Error> {
        let (store, name) = (self.store.clone(), id.clone());
        let row = on_disk(move || store.program::<Row>(name.as_str())).await??;
        Ok(match row {
            Some(Row::Copy(desk)) => Some(*desk),
            _ => None,
        })
    }

    /// The program was removed at its home.
    pub(super) async fn copy_removed(self: &Arc<Self>, id: &ProgramId, term: u64) -> Result<(), Error> {
        let _turn = self.programs.changing.lock().await;
        let copy = self.programs.copies.lock().get(id).map(|copy| copy.desk.fence.term);
        let own = self.program_desk(id).ok();
        let known = copy.or(own.as_ref().map(|desk| desk.fence.term));
        if known.is_none_or(|known| known > term) {
            return Ok(());
        }
        self.remember_gone(id, term).await?;
        self.programs.copies.lock().remove(id);
        self.programs.desks.lock().remove(id);
        Ok(())
    }

    /// Looks after the copies: asks their homes whether they are needed, and goes on with those that are free.
    pub(super) async fn look_after_copies(self: &Arc<Self>) {
        let now = Instant::now();
        let mut to_ask: BTreeMap<HostId, Vec<ProgramId>> = BTreeMap::new();
        let mut free: Vec<ProgramId> = Vec::new();
        for (id, copy) in self.programs.copies.lock().iter_mut() {
            let home = copy.desk.spec.home.clone();
            let there = self.roster.there(&home);
            if !there {
                copy.wanted = false;
            } else if !copy.wanted {
                to_ask.entry(home).or_default().push(id.clone());
            }
            let mastery = self.mastery_over(copy.desk.spec.grants.values().map(|grant| &grant.point));
            if copy.is_free(there, mastery, now) {
                free.push(id.clone());
            }
        }
        for (home, ids) in to_ask {
            for ids in ids.chunks(ASKED_AT_ONCE) {
                self.ask_home(&home, ids).await;
            }
        }
        for ids in free.chunks(ASKED_AT_ONCE) {
            if let Err(error) = self.go_on(ids).await {
                tracing::warn!(%error, "programs without a home could not be taken over; it is tried again");
            }
        }
    }

    /// Asks a home that has come (again) whether it knows of these copies.
    async fn ask_home(self: &Arc<Self>, home: &HostId, ids: &[ProgramId]) {
        let Ok(ProgramTold::Copied(answers)) = self.program_tell(home, ProgramAsk::Kept(ids.to_vec())).await else {
            return;
        };
        for (id, answer) in ids.iter().zip(answers) {
            let end = match answer {
                Copied::Kept => Ok(true),
                Copied::Gone => self.forget_copy(id, home).await.map(|()| false),
                Copied::Unknown => match self.copy_on_disk(id).await {
                    Ok(Some(desk)) => {
                        let back = ProgramAsk::Return(Box::new(desk));
                        self.program_tell(home, back).await.map(|_| true)
                    }
                    Ok(None) => Ok(false),
                    Err(error) => Err(error),
                },
                Copied::Newer(_) | Copied::Refused => Ok(false),
            };
            match end {
                Ok(wanted) => {
                    if let Some(copy) = self.programs.copies.lock().get_mut(id) {
                        copy.wanted = wanted;
                    }
                }
                Err(error) => tracing::debug!(program = %id, %home, %error, "a copy waits for its home"),
            }
        }
    }

    async fn forget_copy(&self, id: &ProgramId, home: &HostId) -> Result<(), Error> {
        let _turn = self.programs.changing.lock().await;
        let is = self
            .programs
            .copies
            .lock()
            .get(id)
            .is_some_and(|copy| copy.desk.spec.home == *home);
        if is {
            let (store, name) = (self.store.clone(), id.clone());
            on_disk(move || store.remove_program(name.as_str())).await??;
            self.programs.copies.lock().remove(id);
        }
        Ok(())
    }

    /// Goes on with programs whose home is gone, as far as no host that is there knows better.
    async fn go_on(self: &Arc<Self>, ids: &[ProgramId]) -> Result<(), Error> {
        let known = join_all(self.roster.others().into_iter().map(|host| async move {
            match self.program_tell(&host, ProgramAsk::Known(ids.to_vec())).await {
                Ok(ProgramTold::Known(known)) => Some((host, known)),
                _ => None,
            }
        }))
        .await;
        let known: Vec<(HostId, Vec<Option<Known>>)> = known.into_iter().flatten().collect();
        let _turn = self.programs.changing.lock().await;
        let mut desks = Vec::new();
        for (place, id) in ids.iter().enumerate() {
            let said: Vec<(HostId, Known)> = known
                .iter()
                .filter_map(|(host, known)| Some((host.clone(), (*known.get(place)?)?)))
                .collect();
            let position = match self.programs.copies.lock().get(id) {
                Some(copy) if is_heir(&self.here, &copy.desk, &said) => copy.desk.position(),
                _ => continue,
            };
            let Some(mut desk) = self.copy_on_disk(id).await?.filter(|desk| desk.position() == position) else {
                continue;
            };
            let epoch = match self.mastery_over(desk.spec.grants.values().map(|grant| &grant.point)) {
                Mastery::Master(epoch) => Some(epoch),
                Mastery::Alone | Mastery::Away => None,
            };
            tracing::warn!(program = %id, from = %desk.spec.home, "this host is the program's home now");
            desk.former = Some(desk.spec.home.clone());
            desk.spec.home = self.here.clone();
            desk.spec.revision = desk.spec.revision.saturating_add(PROGRAM_REVISIONS_SKIPPED);
            desk.standbys.retain(|standby| *standby != self.here);
            let owner = self.program_owner(&desk.spec, Some(&desk.fence.owner));
            let ended = desk.ended.take();
            let floor = self.term_beyond(&desk, epoch);
            desk.give(owner.unwrap_or_else(|| self.here.clone()), floor);
            desk.ended = ended;
            desks.push(desk);
        }
        if desks.is_empty() {
            return Ok(());
        }
        let taken: Vec<ProgramId> = desks.iter().map(|desk| desk.spec.id.clone()).collect();
        self.programs_keep(desks).await?;
        let mut copies = self.programs.copies.lock();
        for id in &taken {
            copies.remove(id);
        }
        drop(copies);
        self.programs.poke.notify_one();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::collections::BTreeMap;

    use bumpless_core::{Digest, Fence, Grant, PointId, ProgramSpec, program::Wanted};

    use super::*;

    fn host(name: &str) -> HostId {
        HostId::new(name).unwrap()
    }

    fn desk() -> Desk {
        Desk {
            spec: ProgramSpec {
                id: ProgramId::new("p").unwrap(),
                revision: 1,
                digest: Digest::of(b"p"),
                home: host("h"),
                grants: BTreeMap::new(),
                publishes: vec![],
                listens: vec![],
                components: vec![],
                share_percent: 1,
                memory_bytes: 1 << 20,
                prefer: vec![],
                wanted: Wanted::Running,
            },
            fence: Fence {
                owner: host("o"),
                term: 7,
            },
            checkpoint: Some(vec![1]),
            ended: None,
            standbys: vec![host("b"), host("c")],
            former: None,
            change: 3,
        }
    }

    #[test]
    fn the_newest_copy_goes_on_and_of_equal_ones_the_first_standby() {
        let known = |home, position| Known { home, position };
        let own = desk();
        for (here, others, expected) in [
            ("b", &[][..], true),
            ("b", &[("c", known(false, (7, 3)))], true),
            ("c", &[("b", known(false, (7, 3)))], false),
            ("c", &[("b", known(false, (7, 2)))], true),
            ("b", &[("c", known(false, (7, 4)))], false),
            ("b", &[("x", known(false, (7, 3)))], true),
            ("x", &[("c", known(false, (7, 3)))], false),
            // Somebody else is the home already.
            ("b", &[("c", known(true, (1_000_007, 1)))], false),
            // The home of before has lost its lease.
            ("b", &[("h", known(true, (7, 3)))], true),
            ("b", &[("h", known(true, (7, 9)))], false),
        ] {
            let others: Vec<(HostId, Known)> = others.iter().map(|(name, known)| (host(name), *known)).collect();
            assert_eq!(is_heir(&host(here), &own, &others), expected, "{here} {others:?}");
        }
    }

    #[test]
    fn a_copy_is_free_when_its_home_is_away_or_its_devices_are_here() {
        let now = Instant::now();
        let later = now + PROGRAM_HOME_AWAY;
        let mut copy = Copy::of(desk());
        assert_eq!(copy.desk.checkpoint, None, "it is on the disk");
        assert!(!copy.is_free(true, Mastery::Alone, now));
        assert!(!copy.is_free(true, Mastery::Alone, later), "its home is there");
        assert!(!copy.is_free(false, Mastery::Alone, later), "not yet for long");
        assert!(copy.is_free(false, Mastery::Alone, later + PROGRAM_HOME_AWAY));
        assert!(!copy.is_free(true, Mastery::Alone, later + PROGRAM_HOME_AWAY));
        let grant = Grant {
            point: PointId::new("p.x").unwrap(),
            write: true,
            raw: None,
            range: (0.0, 1.0),
            unit: String::new(),
        };
        copy.desk.spec.grants.insert("x".into(), grant);
        assert!(
            !copy.is_free(false, Mastery::Alone, later + 9 * PROGRAM_HOME_AWAY),
            "its points are gone"
        );
        assert!(!copy.is_free(true, Mastery::Away, now));
        assert!(copy.is_free(true, Mastery::Master(1), now));
    }
}
