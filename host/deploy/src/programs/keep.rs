//! The home's part: that each program is where it shall be.
//!
//! ```text
//!  each second, or when poked:  ask every host what it runs
//!     ├ a run of an earlier term, or of a program that was removed ──► ended
//!     ├ a run that came to its end or to a fault ──► written down; it is not begun again by itself
//!     ├ owner gone, or being emptied ──► next term on disk, next host ──► run there
//!     └ owner there and its run is not ──► run, from the checkpoint
//! ```
//! Owns: who runs what, on the disk before anybody is told. Never: begins again what has ended.

use std::sync::{Arc, atomic::Ordering};

use bumpless_core::{
    Fence, HostId, LoopId, ProgramId, ProgramSpec,
    place::rank_preferring,
    program::{Status, Wanted},
};
use futures_util::future::join_all;

use super::{Desk, Kept, ProgramAsk, ProgramTold, ProgramView, RunTold, no_program};
use crate::{
    beat::every,
    error::Error,
    limits::{APPLY_WAIT, RECONCILE_EVERY, STAGE_WAIT},
    room::Room,
    wire::{Ask, Told},
};

/// Programs that are brought to where they shall be at a time: each waits for its owner.
const SETTLED_AT_ONCE: usize = 8;

/// A desk at one look.
struct Look {
    id: ProgramId,
    fence: Fence,
    /// Something must be asked of its owner, going by what was heard of its run.
    asks: bool,
}

impl Room {
    /// The host that shall run it: as it is where that is well, else the first of the ranking.
    pub(super) fn program_owner(&self, spec: &ProgramSpec, now: Option<&HostId>) -> Option<HostId> {
        let eligible = self.roster.eligible();
        if let Some(now) = now
            && eligible.iter().any(|candidate| candidate.host == *now)
        {
            return Some(now.clone());
        }
        let id = LoopId::new(spec.id.as_str()).ok()?;
        rank_preferring(&id, &eligible, &spec.prefer).into_iter().next()
    }

    /// Asks a host about programs.
    pub(super) async fn program_tell(self: &Arc<Self>, to: &HostId, ask: ProgramAsk) -> Result<ProgramTold, Error> {
        let wait = match ask {
            // It may have to be fetched and compiled.
            ProgramAsk::Run(..) => APPLY_WAIT,
            _ => STAGE_WAIT,
        };
        match self.ask(to, Ask::Program(Box::new(ask)), wait).await? {
            Told::Program(told) => Ok(*told),
            _ => Err(Error::internal("a host gave an answer to another question")),
        }
    }

    /// How a program is at its owner, and whether the owner said anything.
    async fn program_run_at(self: &Arc<Self>, owner: &HostId, id: &ProgramId) -> Option<Option<RunTold>> {
        match self.program_tell(owner, ProgramAsk::RunOf(id.clone())).await {
            Ok(ProgramTold::Runs(runs)) => Some(runs.into_iter().next()),
            _ => None,
        }
    }

    /// Brings one program to where it shall be, as far as its owner can be reached.
    pub(super) async fn program_settle(self: &Arc<Self>, id: &ProgramId) {
        let Ok(desk) = self.program_desk(id) else { return };
        if self.program_sure(id).is_err() {
            return;
        }
        let (owner, term) = (desk.fence.owner.clone(), desk.fence.term);
        let run = self.program_run_at(&owner, id).await.flatten();
        let hindrance = match next(&desk, run.filter(|run| run.term == term).as_ref()) {
            Some(ask) => self.program_tell(&owner, ask).await.err(),
            None => None,
        };
        let hindrance = hindrance.map(|error| error.to_string()).unwrap_or_default();
        if let Some(Some(run)) = self.program_run_at(&owner, id).await {
            self.programs_hear(&owner, &[run]).await;
        }
        if let Some(kept) = self.programs.desks.lock().get_mut(id) {
            kept.hindrance = hindrance;
        }
    }

    /// Takes down how runs are. An end is written down.
    async fn programs_hear(&self, from: &HostId, runs: &[RunTold]) {
        let ended: Vec<RunTold> = {
            let mut desks = self.programs.desks.lock();
            let mut heard = |run: &RunTold| {
                let kept = desks.get_mut(&run.id)?;
                if !kept.desk.fence.admits(from, run.term) {
                    return None;
                }
                kept.run = Some(run.clone());
                let news = is_over(run.status) && kept.desk.ended.is_none();
                news.then(|| run.clone())
            };
            runs.iter().filter_map(&mut heard).collect()
        };
        if ended.is_empty() {
            return;
        }
        let _turn = self.programs.changing.lock().await;
        let over = |run: RunTold| {
            let mut desk = self.program_desk(&run.id).ok()?;
            desk.fence.admits(from, run.term).then(|| {
                desk.ended = Some((run.status, run.reason));
                desk
            })
        };
        let desks: Vec<Desk> = ended.into_iter().filter_map(over).collect();
        if let Err(error) = self.programs_keep(desks).await {
            tracing::warn!(%error, "the end of a program could not be written down");
        }
    }

    pub(super) async fn program_show(self: &Arc<Self>, id: &ProgramId) -> Result<ProgramView, Error> {
        let owner = self.program_desk(id)?.fence.owner;
        if let Some(Some(run)) = self.program_run_at(&owner, id).await {
            self.programs_hear(&owner, &[run]).await;
        }
        let desks = self.programs.desks.lock();
        desks.get(id).map(Kept::view).ok_or_else(|| no_program(id))
    }

    /// Keeps the programs that are at home here running, until the room stops.
    pub(crate) async fn keep_programs(room: Arc<Self>) {
        let mut tick = every(RECONCILE_EVERY);
        loop {
            tokio::select! {
                _ = tick.tick() => {}
                () = room.programs.poke.notified() => {}
            }
            if room.programs.had_some.load(Ordering::Acquire) {
                room.keep_programs_once().await;
            }
        }
    }

    async fn keep_programs_once(self: &Arc<Self>) {
        let mut hosts = self.roster.others();
        hosts.push(self.here.clone());
        let heard = join_all(hosts.into_iter().map(|host| async move {
            match self.program_tell(&host, ProgramAsk::Runs).await {
                Ok(ProgramTold::Runs(runs)) => Some((host, runs)),
                _ => None,
            }
        }))
        .await;
        let heard: Vec<(HostId, Vec<RunTold>)> = heard.into_iter().flatten().collect();
        for (host, runs) in &heard {
            self.programs_hear(host, runs).await;
            for run in runs {
                if let Some(ask) = self.program_stray(run)
                    && let Err(error) = self.program_tell(host, ask).await
                {
                    tracing::debug!(program = %run.id, %host, %error, "a run that is over here was not ended there");
                }
            }
        }
        let looks: Vec<Look> = {
            let desks = self.programs.desks.lock();
            let look = |kept: &Kept| {
                let fence = &kept.desk.fence;
                let told = heard.iter().find(|(host, _)| *host == fence.owner);
                let run = told.and_then(|(_, runs)| {
                    let mut runs = runs.iter();
                    runs.find(|run| run.id == kept.desk.spec.id && run.term == fence.term)
                });
                Look {
                    id: kept.desk.spec.id.clone(),
                    fence: fence.clone(),
                    asks: told.is_some() && wants(&kept.desk, run.map(|run| run.status)),
                }
            };
            let alive = desks.values().filter(|kept| kept.sure && kept.desk.ended.is_none());
            alive.map(look).collect()
        };
        let eligible: Vec<HostId> = self.roster.eligible().into_iter().map(|c| c.host).collect();
        for some in looks.chunks(SETTLED_AT_ONCE) {
            join_all(some.iter().map(|look| async {
                if !eligible.contains(&look.fence.owner) {
                    self.program_move(look).await;
                } else if look.asks {
                    self.program_settle(&look.id).await;
                }
            }))
            .await;
        }
    }

    /// What to say to a host of a run there that is none of this home's any more.
    fn program_stray(&self, run: &RunTold) -> Option<ProgramAsk> {
        let desks = self.programs.desks.lock();
        match desks.get(&run.id) {
            // What was given to another host meanwhile.
            Some(kept) if run.term < kept.desk.fence.term && !is_over(run.status) => {
                Some(ProgramAsk::End(run.id.clone(), run.term))
            }
            Some(_) => None,
            None => {
                let ours = run.home == self.here && !self.programs.copies.lock().contains_key(&run.id);
                ours.then(|| ProgramAsk::Forget(run.id.clone(), run.term))
            }
        }
    }

    /// Gives a program whose owner is gone, or is being emptied, to another host.
    async fn program_move(self: &Arc<Self>, seen: &Look) {
        let id = &seen.id;
        {
            let _turn = self.programs.changing.lock().await;
            let Ok(mut desk) = self.program_desk(id) else { return };
            // A run that came to its end stays where it ended, and what shall not run needs no owner.
            if desk.fence != seen.fence || desk.ended.is_some() || desk.spec.wanted == Wanted::Stopped {
                return;
            }
            let Some(owner) = self.program_owner(&desk.spec, None) else {
                return;
            };
            tracing::info!(program = %id, from = %desk.fence.owner, to = %owner, "a program goes on at another host");
            desk.give(owner, 0);
            if let Err(error) = self.program_keep(desk).await {
                tracing::warn!(program = %id, %error, "a program cannot be given to another host");
                return;
            }
        }
        if self.roster.there(&seen.fence.owner) {
            let end = ProgramAsk::End(id.clone(), seen.fence.term);
            if let Err(error) = self.program_tell(&seen.fence.owner, end).await {
                tracing::debug!(program = %id, %error, "the owner before did not answer; its writes have an old term");
            }
        }
        self.program_settle(id).await;
    }
}

pub(super) const fn is_over(status: Status) -> bool {
    matches!(status, Status::Stopped | Status::Fault)
}

/// Must its owner be asked for something?
fn wants(desk: &Desk, run: Option<Status>) -> bool {
    match (desk.spec.wanted, run) {
        (Wanted::Stopped, Some(Status::Running | Status::Paused))
        | (Wanted::Running | Wanted::Paused, None)
        | (Wanted::Running, Some(Status::Paused))
        | (Wanted::Paused, Some(Status::Running)) => desk.ended.is_none(),
        // A run that has ended is not begun again by itself: it would fault for ever.
        _ => false,
    }
}

/// What its owner must be asked, so that a program is where it shall be.
fn next(desk: &Desk, run: Option<&RunTold>) -> Option<ProgramAsk> {
    if !wants(desk, run.map(|run| run.status)) {
        return None;
    }
    let (id, term) = (desk.spec.id.clone(), desk.fence.term);
    Some(match (desk.spec.wanted, run) {
        (Wanted::Stopped, _) => ProgramAsk::End(id, term),
        (_, None) => ProgramAsk::Run(Box::new(desk.spec.clone()), term, desk.checkpoint.clone()),
        (wanted, Some(_)) => ProgramAsk::Pause(id, term, wanted == Wanted::Paused),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use std::collections::BTreeMap;

    use bumpless_core::Digest;

    use super::*;

    #[test]
    fn an_owner_is_asked_for_what_is_missing_and_an_ended_run_is_left_alone() {
        let desk = |wanted| Desk {
            spec: ProgramSpec {
                id: ProgramId::new("p").unwrap(),
                revision: 1,
                digest: Digest::of(b"p"),
                home: HostId::new("h").unwrap(),
                grants: BTreeMap::new(),
                publishes: vec![],
                listens: vec![],
                components: vec![],
                share_percent: 1,
                memory_bytes: 1 << 20,
                prefer: vec![],
                wanted,
            },
            fence: Fence {
                owner: HostId::new("o").unwrap(),
                term: 7,
            },
            checkpoint: None,
            ended: None,
            standbys: vec![],
            former: None,
            change: 0,
        };
        let run = |status| RunTold {
            id: ProgramId::new("p").unwrap(),
            home: HostId::new("h").unwrap(),
            term: 7,
            status,
            reason: String::new(),
            used_ns: 0,
            memory_bytes: 0,
            up_ms: 0,
            lines: (0, 0),
        };
        let word = |wanted, status: Option<Status>| {
            next(&desk(wanted), status.map(run).as_ref()).map(|ask| match ask {
                ProgramAsk::Run(_, 7, _) => "run",
                ProgramAsk::Pause(_, 7, true) => "pause",
                ProgramAsk::Pause(_, 7, false) => "resume",
                ProgramAsk::End(_, 7) => "end",
                _ => "else",
            })
        };
        use Status as S;
        for (wanted, status, expected) in [
            (Wanted::Running, None, Some("run")),
            (Wanted::Running, Some(S::Running), None),
            (Wanted::Running, Some(S::Paused), Some("resume")),
            (Wanted::Running, Some(S::Fault), None),
            (Wanted::Running, Some(S::Stopped), None),
            (Wanted::Paused, None, Some("run")),
            (Wanted::Paused, Some(S::Running), Some("pause")),
            (Wanted::Stopped, None, None),
            (Wanted::Stopped, Some(S::Running), Some("end")),
            (Wanted::Stopped, Some(S::Paused), Some("end")),
        ] {
            assert_eq!(word(wanted, status), expected, "{wanted:?} {status:?}");
        }
        // Its owner has lost its memory, and the home has not.
        let mut ended = desk(Wanted::Running);
        ended.ended = Some((S::Stopped, String::new()));
        assert!(next(&ended, None).is_none());
    }
}
