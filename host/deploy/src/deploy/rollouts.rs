//! The facade's part for rollouts: begun at this host, asked about and stopped at any.
//!
//! Never: decides; the host that was asked does.

use bumpless_core::HostId;
use futures_util::future::join_all;
use serde_json::{Value, json};

use super::{Deploy, unexpected};
use crate::{
    audit::{Act, AuditKind, Seen},
    error::Error,
    limits::{ANSWER_WAIT, STAGE_WAIT},
    rollout::{RolloutDraft, RolloutList, RolloutView, place_of},
    wire::{Ask, RolloutAsk, Told},
};

/// What entries tell of a rollout.
fn named(end: &Result<RolloutView, Error>) -> Seen {
    end.as_ref()
        .map_or_else(|_| Seen::default(), |rollout| Seen::named(&rollout.id))
}

impl Deploy {
    /// Begins a rollout at this host, which keeps it and goes on with it after a restart. Returns at once.
    ///
    /// # Errors
    /// [`Error::Invalid`] for the rule, the parameters and the number of loops, [`Error::NotFound`] for the component or a
    /// loop, [`Error::Refused`] for a loop of another rollout under way here, [`Error::Busy`] for too many of these,
    /// [`Error::Store`]. Then nothing was begun.
    pub async fn start_rollout(&self, draft: RolloutDraft) -> Result<RolloutView, Error> {
        let asked = json!({
            "component": draft.component,
            "parameters": draft.parameters,
            "loops": draft.loops,
            "all_of": draft.all_of,
            "rule": draft.rule,
        });
        let room = self.room.clone();
        let work = async move {
            let end = room.start_rollout(draft).await;
            let seen = named(&end);
            (end, seen)
        };
        self.room
            .audited(Act::new(AuditKind::RolloutStart, "", asked), work)
            .await
    }

    /// The rollouts that the hosts of the cell keep. Every host is asked, and given two seconds.
    pub async fn rollouts(&self) -> RolloutList {
        let mut hosts = self.room.roster.others();
        hosts.push(self.room.here.clone());
        hosts.sort();
        let answers = join_all(hosts.iter().map(|host| async move {
            match self.room.ask(host, Ask::Rollout(RolloutAsk::List), STAGE_WAIT).await {
                Ok(Told::Rollouts(views)) => Ok(views),
                Ok(_) => Err(unexpected()),
                Err(error) => Err(error),
            }
        }));
        let mut list = RolloutList {
            rollouts: Vec::new(),
            silent: Vec::new(),
        };
        for (host, answer) in hosts.iter().zip(answers.await) {
            match answer {
                Ok(views) => list.rollouts.extend(views),
                Err(error) => list.silent.push((host.clone(), error.words().reason.clone())),
            }
        }
        list
    }

    async fn of_rollout(&self, host: &HostId, ask: RolloutAsk) -> Result<RolloutView, Error> {
        match self.room.ask(host, Ask::Rollout(ask), ANSWER_WAIT).await? {
            Told::Rollouts(views) => views.into_iter().next().ok_or_else(unexpected),
            _ => Err(unexpected()),
        }
    }

    /// One rollout, with its loops.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::Unreachable`] while its host is away.
    pub async fn rollout(&self, id: &str) -> Result<RolloutView, Error> {
        let (host, number) = place_of(id)?;
        self.of_rollout(&host, RolloutAsk::Show(number)).await
    }

    /// Stops a rollout: nothing further is changed, and what is changed stays so. One that has ended stays as it is.
    ///
    /// # Errors
    /// As [`Deploy::rollout`]; [`Error::Store`] where the stop is not on disk: it stands all the same until the host stops.
    pub async fn stop_rollout(&self, id: &str) -> Result<RolloutView, Error> {
        let (deploy, id) = (self.clone(), id.to_owned());
        let act = Act::new(AuditKind::RolloutStop, &id, Value::Null);
        let work = async move {
            let end = match place_of(&id) {
                Ok((host, number)) => deploy.of_rollout(&host, RolloutAsk::Stop(number)).await,
                Err(error) => Err(error),
            };
            let seen = named(&end);
            (end, seen)
        };
        self.room.audited(act, work).await
    }
}
