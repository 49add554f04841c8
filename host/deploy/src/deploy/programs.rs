//! The facade's part for programs: asked of their homes, wherever a question comes in.
//!
//! Never: decides; the home does.

use bumpless_core::{HostId, PointId, ProgramId};
use futures_util::{StreamExt as _, future::join_all, stream::FuturesUnordered};
use serde_json::{Value, json};

use super::{Deploy, unexpected};
use crate::{
    audit::{Act, AuditKind, Seen, shown},
    error::Error,
    limits::{ANSWER_WAIT, APPLY_WAIT, STAGE_WAIT},
    programs::{LineView, ProgramAsk, ProgramDraft, ProgramList, ProgramOrder, ProgramTold, ProgramView, no_program},
    room::Room,
    wire::{Ask, Told},
};

/// What entries tell of a program.
fn of(end: &Result<ProgramView, Error>) -> Seen {
    end.as_ref().map_or_else(
        |_| Seen::default(),
        |view| Seen {
            target: Some(view.spec.id.to_string()),
            ..Seen::of(
                Value::Null,
                json!({ "wanted": view.spec.wanted, "owner": view.fence.owner, "term": view.fence.term }),
            )
        },
    )
}

fn one(told: ProgramTold) -> Result<ProgramView, Error> {
    match told {
        ProgramTold::Views(views) => views.into_iter().next().ok_or_else(unexpected),
        _ => Err(unexpected()),
    }
}

impl Deploy {
    async fn of_programs(
        room: &std::sync::Arc<Room>,
        host: &HostId,
        ask: ProgramAsk,
        wait: std::time::Duration,
    ) -> Result<ProgramTold, Error> {
        match room.ask(host, Ask::Program(Box::new(ask)), wait).await? {
            Told::Program(told) => Ok(*told),
            _ => Err(unexpected()),
        }
    }

    /// The host that a program is at home at.
    async fn program_home(room: &std::sync::Arc<Room>, id: &ProgramId) -> Result<HostId, Error> {
        if room.programs.desks.lock().contains_key(id) {
            return Ok(room.here.clone());
        }
        let copy = room
            .programs
            .copies
            .lock()
            .get(id)
            .map(|copy| copy.desk.spec.home.clone());
        let mut silent = copy
            .filter(|home| !room.roster.there(home))
            .map(|home| (home, "it is away".to_owned()));
        let mut asked: FuturesUnordered<_> = room
            .roster
            .others()
            .into_iter()
            .map(|host| async move {
                let answer = Self::of_programs(room, &host, ProgramAsk::Find(id.clone()), STAGE_WAIT).await;
                (host, answer)
            })
            .collect();
        while let Some((host, answer)) = asked.next().await {
            match answer {
                Ok(_) => return Ok(host),
                Err(Error::NotFound(_)) => {}
                Err(error) => silent = Some((host, error.to_string())),
            }
        }
        Err(match silent {
            Some((host, reason)) => Error::unreachable(
                format!("program {id} may be at home at host {host}, which did not answer: {reason}"),
                "wait until the host is back",
            ),
            None => no_program(id),
        })
    }

    async fn list_programs(room: &std::sync::Arc<Room>) -> ProgramList {
        let mut hosts = room.roster.others();
        hosts.push(room.here.clone());
        hosts.sort();
        let answers = join_all(
            hosts
                .iter()
                .map(|host| Self::of_programs(room, host, ProgramAsk::List, STAGE_WAIT)),
        )
        .await;
        let mut list = ProgramList {
            programs: Vec::new(),
            silent: Vec::new(),
        };
        for (host, answer) in hosts.into_iter().zip(answers) {
            match answer {
                Ok(ProgramTold::Views(views)) => list.programs.extend(views),
                Ok(_) => list.silent.push((host, unexpected().to_string())),
                Err(error) => list.silent.push((host, error.to_string())),
            }
        }
        list.programs.sort_by(|a, b| a.spec.id.cmp(&b.spec.id));
        list
    }

    /// Creates a program, or changes one of the name: its run then begins anew.
    ///
    /// # Errors
    /// [`Error::Invalid`], [`Error::NotFound`] for component and points, [`Error::Refused`] for a point with another writer.
    pub async fn create_program(&self, draft: ProgramDraft) -> Result<ProgramView, Error> {
        let act = Act::new(AuditKind::ProgramCreate, &draft.name, shown(&draft));
        let room = self.room.clone();
        let work = async move {
            let end = async {
                let id = ProgramId::new(&draft.name).map_err(|error| Error::invalid(error.to_string(), ""))?;
                let now = match Self::program_home(&room, &id).await {
                    Ok(home) => Some(home),
                    Err(Error::NotFound(_)) => None,
                    Err(error) => return Err(error),
                };
                let home = match draft.grants.values().next() {
                    None => now.clone().unwrap_or_else(|| room.here.clone()),
                    Some(grant) => {
                        let point =
                            PointId::new(&grant.point).map_err(|error| Error::invalid(error.to_string(), ""))?;
                        room.host_of(&point).await?
                    }
                };
                if let Some(now) = now.filter(|now| *now != home) {
                    return Err(Error::refused(
                        format!("there is a program {id}, and its points are those of host {now}"),
                        "remove it first, or choose another name",
                    ));
                }
                one(Self::of_programs(&room, &home, ProgramAsk::Create(Box::new(draft)), APPLY_WAIT * 2).await?)
            }
            .await;
            let seen = of(&end);
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// A person's order to a program.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Refused`] for one that does not run, [`Error::Unreachable`] for its home.
    pub async fn order_program(&self, id: ProgramId, order: ProgramOrder) -> Result<ProgramView, Error> {
        let kind = match order {
            ProgramOrder::Start => AuditKind::ProgramStart,
            ProgramOrder::Stop => AuditKind::ProgramStop,
            ProgramOrder::Pause => AuditKind::ProgramPause,
            ProgramOrder::Resume => AuditKind::ProgramResume,
        };
        let act = Act::new(kind, id.as_str(), Value::Null);
        let room = self.room.clone();
        let work = async move {
            let end = async {
                let home = Self::program_home(&room, &id).await?;
                one(Self::of_programs(&room, &home, ProgramAsk::Order(id, order), APPLY_WAIT * 2).await?)
            }
            .await;
            let seen = of(&end);
            (end, seen)
        };
        self.room.audited(act, work).await
    }

    /// Ends a program and forgets it, with its checkpoint.
    ///
    /// # Errors
    /// As [`Deploy::order_program`].
    pub async fn remove_program(&self, id: ProgramId) -> Result<(), Error> {
        let act = Act::new(AuditKind::ProgramRemove, id.as_str(), Value::Null);
        let room = self.room.clone();
        let work = async move {
            let end = async {
                let home = Self::program_home(&room, &id).await?;
                Self::of_programs(&room, &home, ProgramAsk::Remove(id), APPLY_WAIT)
                    .await
                    .map(drop)
            }
            .await;
            (end, Seen::default())
        };
        self.room.audited(act, work).await
    }

    /// The programs of the cell. Every host is asked, and given two seconds.
    pub async fn programs(&self) -> ProgramList {
        Self::list_programs(&self.room).await
    }

    /// One program, as its owner says now.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`].
    pub async fn program(&self, id: ProgramId) -> Result<ProgramView, Error> {
        let home = Self::program_home(&self.room, &id).await?;
        one(Self::of_programs(&self.room, &home, ProgramAsk::Show(id), ANSWER_WAIT).await?)
    }

    /// Lines of its present or last run after one of that number, the newest so many, oldest first.
    ///
    /// # Errors
    /// As [`Deploy::program`].
    pub async fn program_log(&self, id: ProgramId, after: u64, max: u32) -> Result<Vec<LineView>, Error> {
        let home = Self::program_home(&self.room, &id).await?;
        match Self::of_programs(&self.room, &home, ProgramAsk::Log(id, after, max), ANSWER_WAIT).await? {
            ProgramTold::Lines(lines) => Ok(lines),
            _ => Err(unexpected()),
        }
    }

    /// What it saved last; none where it saved nothing.
    ///
    /// # Errors
    /// As [`Deploy::program`].
    pub async fn program_checkpoint(&self, id: ProgramId) -> Result<Option<Vec<u8>>, Error> {
        let home = Self::program_home(&self.room, &id).await?;
        match Self::of_programs(&self.room, &home, ProgramAsk::Checkpoint(id), ANSWER_WAIT).await? {
            ProgramTold::Checkpoint(bytes) => Ok(bytes),
            _ => Err(unexpected()),
        }
    }

    /// The script in a component of the library, byte by byte as it was uploaded.
    ///
    /// # Errors
    /// [`Error::NotFound`] for the component, or where it has no script.
    pub async fn script(&self, reference: &str) -> Result<Vec<u8>, Error> {
        let info = self.room.library.resolve(reference)?;
        let bytes = self.room.component_bytes(&info.digest).await?;
        bumpless_engine::split(&bytes)
            .1
            .map(|script| script.text)
            .ok_or_else(|| {
                Error::not_found(
                    format!("{} has no script in it", crate::library::title(&info)),
                    "download the component instead",
                )
            })
    }
}
