//! The home's part: what people ask of its programs, and what those may touch.
//!
//! Owns: the desks, on disk before anything is told. Never: waits for a host that is silent longer than for an answer.

use std::{
    collections::BTreeMap,
    sync::{Arc, atomic::Ordering},
};

use bumpless_core::{
    Fence, Grant, HostId, LoopId, PointId, ProgramId, ProgramSpec,
    limits::STATE_BYTES_MAX,
    program::{Status, Wanted},
};

use super::{
    Desk, Kept, LineView, PROGRAMS_MAX, ProgramAsk, ProgramDraft, ProgramOrder, ProgramTold, ProgramView, Row,
    no_program,
};
use crate::{book::on_disk, error::Error, room::Room};

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
            ProgramAsk::Find(id) => self.program_desk(&id).map(|_| ProgramTold::Done),
            ProgramAsk::Uses(digest) => Ok(ProgramTold::Names(self.programs.users(&digest))),
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
            ProgramAsk::RunOf(id) => Ok(ProgramTold::Runs(self.program_run_of(&id).into_iter().collect())),
            ProgramAsk::Pause(id, term, paused) => self.program_pause(&id, term, paused).map(|()| ProgramTold::Done),
            ProgramAsk::End(id, term) => {
                self.programs.runner.stop(&id, term);
                Ok(ProgramTold::Done)
            }
            ProgramAsk::Forget(id, term) => {
                self.programs.runner.forget(&id, term);
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
            ProgramAsk::Copies(desks) => Ok(ProgramTold::Copied(self.copies_come(from, desks).await)),
            ProgramAsk::Removed(id, term) => self.copy_removed(&id, term).await.map(|()| ProgramTold::Done),
            ProgramAsk::Kept(ids) => Ok(ProgramTold::Copied(self.copies_wanted(from, &ids))),
            ProgramAsk::Return(desk) => self.program_returns(*desk).await.map(|()| ProgramTold::Done),
            ProgramAsk::Known(ids) => Ok(ProgramTold::Known(self.programs_known(&ids))),
        }
    }

    pub(super) fn program_desk(&self, id: &ProgramId) -> Result<Desk, Error> {
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
    pub(super) async fn program_keep(&self, desk: Desk) -> Result<(), Error> {
        self.programs_keep(vec![desk]).await
    }

    /// As [`Room::program_keep`], for several at once.
    pub(super) async fn programs_keep(&self, mut desks: Vec<Desk>) -> Result<(), Error> {
        for desk in &mut desks {
            desk.change += 1;
            self.programs.last_term.fetch_max(desk.fence.term, Ordering::AcqRel);
        }
        let store = self.store.clone();
        let desks = on_disk(move || {
            let rows: Vec<(ProgramId, Row)> = desks
                .into_iter()
                .map(|desk| (desk.spec.id.clone(), Row::Home(Box::new(desk))))
                .collect();
            let named: Vec<(&str, &Row)> = rows.iter().map(|(id, row)| (id.as_str(), row)).collect();
            store.put_programs(&named).map(|()| rows)
        })
        .await??;
        {
            let mut kept = self.programs.desks.lock();
            for (id, row) in desks {
                let Row::Home(desk) = row else { continue };
                match kept.get_mut(&id) {
                    Some(kept) => kept.desk = *desk,
                    None => {
                        kept.insert(id, Kept::new(*desk));
                    }
                }
            }
        }
        self.programs.had_some.store(true, Ordering::Release);
        self.programs.changed.notify_one();
        Ok(())
    }

    async fn program_create(self: &Arc<Self>, draft: ProgramDraft) -> Result<ProgramView, Error> {
        let id = {
            let _turn = self.programs.changing.lock().await;
            let mut spec = self.program_spec(draft)?;
            let id = spec.id.clone();
            self.program_sure(&id)?;
            let before = self.program_desk(&id).ok();
            if before.is_none() && self.programs.desks.lock().len() >= PROGRAMS_MAX {
                return Err(Error::busy(
                    format!("host {} is home to {PROGRAMS_MAX} programs already", self.here),
                    "remove one, or use points of another host",
                ));
            }
            spec.revision = before.as_ref().map_or(1, |desk| desk.spec.revision + 1);
            let owner = self.program_owner(&spec, None).unwrap_or_else(|| self.here.clone());
            let mut desk = match before {
                Some(before) => Desk {
                    // What other code saved is not for this one.
                    checkpoint: before.checkpoint.filter(|_| before.spec.digest == spec.digest),
                    spec,
                    ..before
                },
                None => Desk {
                    spec,
                    fence: Fence {
                        owner: self.here.clone(),
                        term: self.program_term_floor(&id),
                    },
                    checkpoint: None,
                    ended: None,
                    standbys: Vec::new(),
                    former: None,
                    change: 0,
                },
            };
            desk.give(owner, 0);
            self.program_keep(desk).await?;
            id
        };
        self.program_settle(&id).await;
        self.program_show(&id).await
    }

    /// A term after which those of a program begin that is new here.
    pub(super) fn program_term_floor(&self, id: &ProgramId) -> u64 {
        let gone = self.programs.gone.lock().get(id).copied().unwrap_or(0);
        let last = self.programs.last_term.load(Ordering::Acquire);
        self.terms.floor().max(last).max(gone)
    }

    /// Is this host still the one to ask, after a start?
    pub(super) fn program_sure(&self, id: &ProgramId) -> Result<(), Error> {
        match self.programs.desks.lock().get(id) {
            Some(kept) if !kept.sure => Err(Error::busy(
                format!(
                    "host {} has just started and asks the standbys of program {id}",
                    self.here
                ),
                "ask again in a few seconds",
            )),
            _ => Ok(()),
        }
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
        let goes_on = self.programs.users(&info.digest).contains(&id);
        if let Some(words) = self.may_start(&info, goes_on)? {
            tracing::warn!(program = %id, "{words}");
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
            self.program_sure(id)?;
            let mut desk = self.program_desk(id)?;
            let over = desk.ended.is_some() || {
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
                    desk.give(owner.unwrap_or_else(|| self.here.clone()), 0);
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
        self.program_gone(id, &desk).await?;
        // A silent owner is told to end it when it is heard of again.
        let forget = ProgramAsk::Forget(id.clone(), desk.fence.term);
        if let Err(error) = self.program_tell(&desk.fence.owner, forget).await {
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
}
