//! The home's part: what its programs shall do, who runs them, and what they may touch.
//!
//! ```text
//!  each second, or when poked:  ask every control host what it runs
//!     ├ a run that no fence here admits ──► ended
//!     ├ owner gone, or being emptied ──► next term on disk, next host ──► run there
//!     └ owner there and its run is not ──► run, from the checkpoint
//! ```
//! Owns: the desks, on disk before anything is told. Never: waits for a host that is silent longer than for an answer.

use std::{
    collections::BTreeMap,
    sync::{Arc, atomic::Ordering},
};

use bumpless_core::{
    Fence, Grant, HostId, LoopId, PointId, ProgramId, ProgramSpec,
    limits::STATE_BYTES_MAX,
    place::rank_preferring,
    program::{Status, Wanted},
};
use futures_util::future::join_all;

use super::{
    Desk, Kept, LineView, PROGRAMS_MAX, ProgramAsk, ProgramDraft, ProgramOrder, ProgramTold, ProgramView, RunTold,
    no_program,
};
use crate::{
    book::on_disk,
    error::Error,
    limits::{APPLY_WAIT, RECONCILE_EVERY, STAGE_WAIT},
    room::{Room, every},
    wire::{Ask, Told},
};

impl Room {
    /// Answers what is asked about programs.
    pub(crate) async fn programs_here(self: &Arc<Self>, from: &HostId, ask: ProgramAsk) -> Result<ProgramTold, Error> {
        match ask {
            ProgramAsk::Create(draft) => self
                .program_create(*draft)
                .await
                .map(|view| ProgramTold::Views(vec![view])),
            ProgramAsk::Order(id, order) => self
                .program_order(&id, order)
                .await
                .map(|view| ProgramTold::Views(vec![view])),
            ProgramAsk::Remove(id) => self.program_remove(&id).await.map(|()| ProgramTold::Done),
            ProgramAsk::List => {
                let desks = self.programs.desks.lock();
                Ok(ProgramTold::Views(desks.values().map(Kept::view).collect()))
            }
            ProgramAsk::Show(id) => self.program_show(&id).await.map(|view| ProgramTold::Views(vec![view])),
            ProgramAsk::Log(id, after, max) => self.program_log(&id, after, max).await.map(ProgramTold::Lines),
            ProgramAsk::Checkpoint(id) => self
                .program_desk(&id)
                .map(|desk| ProgramTold::Checkpoint(desk.checkpoint)),
            ProgramAsk::Runs => Ok(ProgramTold::Runs(self.program_runs())),
            ProgramAsk::Run(spec, term, checkpoint) => self
                .program_run(from, *spec, term, checkpoint)
                .await
                .map(|()| ProgramTold::Done),
            ProgramAsk::Pause(id, paused) => self.program_pause(&id, paused).map(|()| ProgramTold::Done),
            ProgramAsk::End(id) => {
                self.program_end(&id);
                Ok(ProgramTold::Done)
            }
            ProgramAsk::Lines(id, after, max) => Ok(ProgramTold::Lines(self.program_lines(&id, after, max))),
            ProgramAsk::Read(id, term, slot) => {
                let (io, index) = self.program_point(&id, from, term, slot, false)?;
                let now_ns = io.clock().now_ns();
                let reading = io.read_one(index, now_ns);
                Ok(ProgramTold::Sight(reading, now_ns.saturating_sub(reading.at_ns)))
            }
            ProgramAsk::Write(id, term, slot, value) => {
                let (_, index) = self.program_point(&id, from, term, slot, true)?;
                let spec = self.program_desk(&id)?.spec;
                self.program_write(&spec, from, term, index, value)
                    .map(|()| ProgramTold::Done)
                    .map_err(|reason| Error::refused(reason, ""))
            }
            ProgramAsk::Save(id, term, data) => self
                .program_save(&id, from, term, data)
                .await
                .map(|()| ProgramTold::Done),
        }
    }

    fn program_desk(&self, id: &ProgramId) -> Result<Desk, Error> {
        let desks = self.programs.desks.lock();
        desks
            .get(id)
            .map(|kept| kept.desk.clone())
            .ok_or_else(|| no_program(id))
    }

    fn program_point(
        &self,
        id: &ProgramId,
        from: &HostId,
        term: u64,
        slot: u32,
        write: bool,
    ) -> Result<(&Arc<bumpless_io::IoServer>, bumpless_io::PointIndex), Error> {
        let refused = |reason: &str| Error::refused(reason, "grant the point to the program");
        let point = {
            let desks = self.programs.desks.lock();
            let kept = desks.get(id).ok_or_else(|| no_program(id))?;
            if !kept.desk.fence.admits(from, term) {
                return Err(Error::refused(
                    format!("host {} owns program {id} now", kept.desk.fence.owner),
                    "",
                ));
            }
            let grant = kept.desk.spec.grants.values().nth(slot as usize);
            let grant = grant.ok_or_else(|| refused("the point is not granted"))?;
            if write && !grant.write {
                return Err(refused("the program may only read this point"));
            }
            grant.point.clone()
        };
        let io = self.io.as_ref().ok_or_else(|| refused("this host serves no points"))?;
        let index = io
            .index(&point)
            .ok_or_else(|| refused("this host does not serve the point any more"))?;
        Ok((io, index))
    }

    /// Puts a changed desk on the disk, then in memory. The caller holds `changing`.
    async fn program_keep(&self, desk: Desk) -> Result<(), Error> {
        self.programs.last_term.fetch_max(desk.fence.term, Ordering::AcqRel);
        let (store, copy) = (self.store.clone(), desk.clone());
        on_disk(move || store.put_program(copy.spec.id.as_str(), &copy)).await??;
        let mut desks = self.programs.desks.lock();
        match desks.get_mut(&desk.spec.id) {
            Some(kept) => kept.desk = desk,
            None => {
                desks.insert(desk.spec.id.clone(), Kept::new(desk));
            }
        }
        Ok(())
    }

    async fn program_create(self: &Arc<Self>, draft: ProgramDraft) -> Result<ProgramView, Error> {
        let _turn = self.programs.changing.lock().await;
        let spec = self.program_spec(draft)?;
        let before = self.program_desk(&spec.id).ok();
        if before.is_none() && self.programs.desks.lock().len() >= PROGRAMS_MAX {
            return Err(Error::busy(
                format!("host {} is home to {PROGRAMS_MAX} programs already", self.here),
                "remove one, or use points of another host",
            ));
        }
        let fence = before.as_ref().map_or_else(
            || Fence {
                owner: self.here.clone(),
                term: self.terms.floor().max(self.programs.last_term.load(Ordering::Acquire)),
            },
            |desk| desk.fence.clone(),
        );
        let mut spec = spec;
        spec.revision = before.as_ref().map_or(1, |desk| desk.spec.revision + 1);
        let same_code = before.as_ref().is_some_and(|desk| desk.spec.digest == spec.digest);
        let id = spec.id.clone();
        let owner = self.program_owner(&spec, None).unwrap_or_else(|| self.here.clone());
        let desk = Desk {
            // What other code saved is not for this one.
            checkpoint: before.and_then(|desk| desk.checkpoint).filter(|_| same_code),
            fence: fence.given_to(owner),
            spec,
        };
        self.program_keep(desk).await?;
        drop(_turn);
        self.program_settle(&id).await;
        self.program_show(&id).await
    }

    /// A draft as a checked specification.
    fn program_spec(&self, draft: ProgramDraft) -> Result<ProgramSpec, Error> {
        let id = ProgramId::new(&draft.name).map_err(|error| Error::invalid(error.to_string(), ""))?;
        if LoopId::new(&draft.name).is_ok_and(|id| self.book.get(&id).is_some()) {
            return Err(Error::refused(format!("there is a loop {id}"), "choose another name"));
        }
        let info = self.library.resolve(&draft.component)?;
        if !info.is_program() {
            return Err(Error::invalid(
                format!("{} is no program", crate::library::title(&info)),
                "name a component of the world program, or a script",
            ));
        }
        let mut grants = BTreeMap::new();
        for (name, grant) in draft.grants {
            let point =
                PointId::new(&grant.point).map_err(|error| Error::invalid(format!("grant {name:?}: {error}"), ""))?;
            let facts = self
                .io
                .as_ref()
                .and_then(|io| io.index(&point).and_then(|index| io.info(index)).cloned())
                .ok_or_else(|| {
                    Error::not_found(
                        format!("grant {name:?}: host {} has no point {point}", self.here),
                        "all points of a program are served by one host",
                    )
                })?;
            if grant.write {
                if !facts.writable {
                    return Err(Error::invalid(
                        format!("grant {name:?}: point {point} cannot be written"),
                        "grant it for reading",
                    ));
                }
                let other =
                    self.programs.desks.lock().values().any(|kept| {
                        kept.desk.spec.id != id && kept.desk.spec.written().any(|written| *written == point)
                    });
                if other || self.book.writer_of(&point, None).is_some() {
                    return Err(Error::refused(
                        format!("grant {name:?}: point {point} has a writer already"),
                        "grant it for reading, or end the other writer",
                    ));
                }
            }
            let grant = Grant {
                point,
                write: grant.write,
                raw: grant.raw,
                range: (facts.low, facts.high),
                unit: facts.unit,
            };
            grants.insert(name, grant);
        }
        let spec = ProgramSpec {
            id,
            revision: 0,
            digest: info.digest,
            home: self.here.clone(),
            grants,
            publishes: draft.publishes,
            listens: draft.listens,
            components: draft.components,
            share_percent: draft.share_percent,
            memory_bytes: draft.memory_bytes,
            prefer: draft.prefer,
            wanted: if draft.start { Wanted::Running } else { Wanted::Stopped },
        };
        spec.check().map_err(|error| Error::invalid(error.to_string(), ""))?;
        Ok(spec)
    }

    async fn program_order(self: &Arc<Self>, id: &ProgramId, order: ProgramOrder) -> Result<ProgramView, Error> {
        {
            let _turn = self.programs.changing.lock().await;
            let mut desk = self.program_desk(id)?;
            let over = {
                let desks = self.programs.desks.lock();
                let run = desks.get(id).and_then(|kept| kept.run.as_ref());
                run.is_none_or(|run| {
                    run.term != desk.fence.term || matches!(run.status, Status::Stopped | Status::Fault)
                })
            };
            let wanted = desk.spec.wanted;
            desk.spec.wanted = match order {
                ProgramOrder::Start | ProgramOrder::Resume => Wanted::Running,
                ProgramOrder::Stop => Wanted::Stopped,
                ProgramOrder::Pause => Wanted::Paused,
            };
            match order {
                // A new run is a new ownership: nothing of the last one counts any more.
                ProgramOrder::Start if wanted == Wanted::Stopped || over => {
                    let owner = self.program_owner(&desk.spec, Some(&desk.fence.owner));
                    desk.fence = desk.fence.given_to(owner.unwrap_or_else(|| self.here.clone()));
                }
                ProgramOrder::Pause | ProgramOrder::Resume if wanted == Wanted::Stopped || over => {
                    return Err(Error::refused(format!("program {id} does not run"), "start it"));
                }
                _ => {}
            }
            desk.spec.revision += 1;
            self.program_keep(desk).await?;
        }
        self.program_settle(id).await;
        self.program_show(id).await
    }

    async fn program_remove(self: &Arc<Self>, id: &ProgramId) -> Result<(), Error> {
        let _turn = self.programs.changing.lock().await;
        let desk = self.program_desk(id)?;
        let (store, name) = (self.store.clone(), id.clone());
        on_disk(move || store.remove_program(name.as_str())).await??;
        self.programs.desks.lock().remove(id);
        // A silent owner is ended when it is heard of again: no fence here admits its run.
        if let Err(error) = self.program_tell(&desk.fence.owner, ProgramAsk::End(id.clone())).await {
            tracing::debug!(program = %id, %error, "the owner of a removed program did not answer");
        }
        Ok(())
    }

    async fn program_save(&self, id: &ProgramId, from: &HostId, term: u64, data: Vec<u8>) -> Result<(), Error> {
        if data.len() > STATE_BYTES_MAX {
            return Err(Error::invalid(format!("a checkpoint of {} bytes", data.len()), ""));
        }
        let _turn = self.programs.changing.lock().await;
        let mut desk = self.program_desk(id)?;
        if !desk.fence.admits(from, term) {
            return Err(Error::refused(
                format!("host {} owns program {id} now", desk.fence.owner),
                "",
            ));
        }
        desk.checkpoint = Some(data);
        self.program_keep(desk).await
    }

    /// The host that shall run it: as it is where that is well, else the first of the ranking.
    fn program_owner(&self, spec: &ProgramSpec, now: Option<&HostId>) -> Option<HostId> {
        let eligible = self.roster.eligible();
        if let Some(now) = now
            && eligible.iter().any(|candidate| candidate.host == *now)
        {
            return Some(now.clone());
        }
        let id = LoopId::new(spec.id.as_str()).ok()?;
        rank_preferring(&id, &eligible, &spec.prefer).into_iter().next()
    }

    async fn program_tell(self: &Arc<Self>, to: &HostId, ask: ProgramAsk) -> Result<ProgramTold, Error> {
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

    /// Brings one program to where it shall be, as far as its owner can be reached.
    async fn program_settle(self: &Arc<Self>, id: &ProgramId) {
        let Ok(desk) = self.program_desk(id) else { return };
        let (owner, term) = (desk.fence.owner.clone(), desk.fence.term);
        let runs = match self.program_tell(&owner, ProgramAsk::Runs).await {
            Ok(ProgramTold::Runs(runs)) => runs,
            _ => Vec::new(),
        };
        let run = runs.into_iter().find(|run| run.id == *id && run.term == term);
        let asks = next(&desk, run.as_ref());
        let mut end = Ok(());
        for ask in asks {
            end = end.and(self.program_tell(&owner, ask).await.map(drop));
        }
        let hindrance = end.err().map(|error| error.to_string()).unwrap_or_default();
        self.program_look(id, &owner, hindrance).await;
    }

    /// Asks the owner how the run is.
    async fn program_look(self: &Arc<Self>, id: &ProgramId, owner: &HostId, hindrance: String) {
        if let Ok(ProgramTold::Runs(runs)) = self.program_tell(owner, ProgramAsk::Runs).await {
            self.program_heard(&runs);
        }
        if let Some(kept) = self.programs.desks.lock().get_mut(id) {
            kept.hindrance = hindrance;
        }
    }

    fn program_heard(&self, runs: &[RunTold]) {
        let mut desks = self.programs.desks.lock();
        for run in runs {
            if let Some(kept) = desks.get_mut(&run.id)
                && kept.desk.fence.term == run.term
            {
                kept.run = Some(run.clone());
            }
        }
    }

    async fn program_show(self: &Arc<Self>, id: &ProgramId) -> Result<ProgramView, Error> {
        let desk = self.program_desk(id)?;
        if let Ok(ProgramTold::Runs(runs)) = self.program_tell(&desk.fence.owner, ProgramAsk::Runs).await {
            self.program_heard(&runs);
        }
        let desks = self.programs.desks.lock();
        desks.get(id).map(Kept::view).ok_or_else(|| no_program(id))
    }

    async fn program_log(self: &Arc<Self>, id: &ProgramId, after: u64, max: u32) -> Result<Vec<LineView>, Error> {
        let owner = self.program_desk(id)?.fence.owner;
        match self
            .program_tell(&owner, ProgramAsk::Lines(id.clone(), after, max))
            .await?
        {
            ProgramTold::Lines(lines) => Ok(lines),
            _ => Err(Error::internal("a host gave an answer to another question")),
        }
    }

    /// Keeps the programs that are at home here running, until the room stops.
    pub(crate) async fn keep_programs(room: Arc<Self>) {
        let mut tick = every(RECONCILE_EVERY);
        loop {
            tokio::select! {
                _ = tick.tick() => {}
                () = room.programs.poke.notified() => {}
            }
            if !room.programs.desks.lock().is_empty() {
                room.keep_programs_once().await;
            }
        }
    }

    async fn keep_programs_once(self: &Arc<Self>) {
        let hosts: Vec<HostId> = self
            .roster
            .eligible()
            .into_iter()
            .map(|candidate| candidate.host)
            .collect();
        let heard = join_all(hosts.iter().map(|host| async move {
            match self.program_tell(host, ProgramAsk::Runs).await {
                Ok(ProgramTold::Runs(runs)) => (host.clone(), Some(runs)),
                _ => (host.clone(), None),
            }
        }))
        .await;
        let desks: Vec<Desk> = self
            .programs
            .desks
            .lock()
            .values()
            .map(|kept| kept.desk.clone())
            .collect();
        for (host, runs) in heard.iter().filter_map(|(host, runs)| Some((host, runs.as_ref()?))) {
            self.program_heard(
                &runs
                    .iter()
                    .filter(|run| {
                        desks
                            .iter()
                            .any(|desk| desk.spec.id == run.id && desk.fence.admits(host, run.term))
                    })
                    .cloned()
                    .collect::<Vec<_>>(),
            );
            // What was given to another host meanwhile.
            for run in runs
                .iter()
                .filter(|run| run.status == Status::Running || run.status == Status::Paused)
            {
                let ours = desks.iter().find(|desk| desk.spec.id == run.id);
                if ours.is_some_and(|desk| !desk.fence.admits(host, run.term))
                    && let Err(error) = self.program_tell(host, ProgramAsk::End(run.id.clone())).await
                {
                    tracing::debug!(program = %run.id, %host, %error, "a program that runs elsewhere was not ended");
                }
            }
        }
        for desk in desks.into_iter().filter(|desk| desk.spec.wanted != Wanted::Stopped) {
            let id = desk.spec.id.clone();
            let owner_well = hosts.contains(&desk.fence.owner);
            let runs = heard
                .iter()
                .find(|(host, _)| *host == desk.fence.owner)
                .and_then(|(_, runs)| runs.as_ref());
            let run = runs.and_then(|runs| runs.iter().find(|run| run.id == id && run.term == desk.fence.term));
            if !owner_well {
                self.program_move(&id, &desk).await;
            } else if runs.is_some() && !next(&desk, run).is_empty() {
                self.program_settle(&id).await;
            }
        }
    }

    /// Gives a program whose owner is gone to another host.
    async fn program_move(self: &Arc<Self>, id: &ProgramId, seen: &Desk) {
        let Some(owner) = self.program_owner(&seen.spec, None) else {
            return;
        };
        {
            let _turn = self.programs.changing.lock().await;
            let Ok(mut desk) = self.program_desk(id) else { return };
            // A run that came to its end stays where it ended.
            let ended = self.programs.desks.lock().get(id).is_some_and(|kept| {
                kept.run.as_ref().is_some_and(|run| {
                    run.term == desk.fence.term && matches!(run.status, Status::Stopped | Status::Fault)
                })
            });
            if desk.fence != seen.fence || ended {
                return;
            }
            tracing::info!(program = %id, from = %desk.fence.owner, to = %owner, "a program goes on at another host");
            desk.fence = desk.fence.given_to(owner);
            if let Err(error) = self.program_keep(desk).await {
                tracing::warn!(program = %id, %error, "a program cannot be given to another host");
                return;
            }
        }
        self.program_settle(id).await;
    }
}

/// What its owner must be asked, so that a program is where it shall be.
fn next(desk: &Desk, run: Option<&RunTold>) -> Vec<ProgramAsk> {
    let id = desk.spec.id.clone();
    let run_it = || {
        let spec = Box::new(desk.spec.clone());
        vec![ProgramAsk::Run(spec, desk.fence.term, desk.checkpoint.clone())]
    };
    match (desk.spec.wanted, run.map(|run| run.status)) {
        (Wanted::Stopped, Some(Status::Running | Status::Paused)) => vec![ProgramAsk::End(id)],
        (Wanted::Running | Wanted::Paused, None) => run_it(),
        (Wanted::Running, Some(Status::Paused)) => vec![ProgramAsk::Pause(id, false)],
        (Wanted::Paused, Some(Status::Running)) => vec![ProgramAsk::Pause(id, true)],
        // A run that has ended is not begun again by itself: it would fault for ever.
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

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
        };
        let run = |status| RunTold {
            id: ProgramId::new("p").unwrap(),
            term: 7,
            status,
            reason: String::new(),
            used_ns: 0,
            memory_bytes: 0,
            up_ms: 0,
            lines: (0, 0),
        };
        let word = |wanted, status: Option<Status>| {
            let asks = next(&desk(wanted), status.map(run).as_ref());
            asks.first().map(|ask| match ask {
                ProgramAsk::Run(_, 7, _) => "run",
                ProgramAsk::Pause(_, true) => "pause",
                ProgramAsk::Pause(_, false) => "resume",
                ProgramAsk::End(_) => "end",
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
    }
}
