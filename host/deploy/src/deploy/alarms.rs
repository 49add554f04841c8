//! The facade's part for alarms: listed for the cell, acted on at the loop's home.
//!
//! Never: decides; the home does.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{HostId, LoopId};
use futures_util::future::join_all;
use serde_json::{Value, json};
use tokio::sync::broadcast;

use super::{Deploy, unexpected};
use crate::{
    alarms::{AlarmAct, AlarmEvent, AlarmList, AlarmLoad, AlarmView},
    audit::{Act, Asker, AuditKind, Seen, shown},
    error::Error,
    limits::{ALARM_PAST_MAX, ANSWER_WAIT},
    self_watch::host_of_board,
    webhook::WebhookView,
    wire::{AlarmAsk, Ask, Told},
};

const fn kind(act: &AlarmAct) -> AuditKind {
    match act {
        AlarmAct::Acknowledge { .. } => AuditKind::AlarmAcknowledge,
        AlarmAct::Reset => AuditKind::AlarmReset,
        AlarmAct::Shelve { .. } => AuditKind::AlarmShelve,
        AlarmAct::Unshelve => AuditKind::AlarmUnshelve,
        AlarmAct::TakeOut { .. } => AuditKind::AlarmTakeOut,
        AlarmAct::PutBack => AuditKind::AlarmPutBack,
        AlarmAct::Define(_) => AuditKind::AlarmDefine,
        AlarmAct::Remove => AuditKind::AlarmRemove,
    }
}

fn asked(act: &AlarmAct) -> Value {
    match act {
        AlarmAct::Acknowledge { note } => json!({ "note": note }),
        AlarmAct::Shelve { seconds, reason } => json!({ "seconds": seconds, "reason": reason }),
        AlarmAct::TakeOut { reason } => json!({ "reason": reason }),
        AlarmAct::Define(definition) => shown(definition),
        AlarmAct::Reset | AlarmAct::Unshelve | AlarmAct::PutBack | AlarmAct::Remove => Value::Null,
    }
}

/// What entries tell of an alarm.
fn stood(view: Option<&AlarmView>) -> Value {
    let Some(standing) = view.map(|view| &view.standing) else {
        return Value::Null;
    };
    json!({
        "state": standing.state,
        "acknowledged_by": standing.acknowledged_by,
        "shelf": standing.shelf,
        "out_of_service": standing.out_of_service,
        "definition": standing.definition,
    })
}

impl Deploy {
    /// The alarms of all loops and hosts, the most urgent and newest first. Every host is asked.
    pub async fn alarms(&self) -> AlarmList {
        let hosts = self.every_host();
        let answers = join_all(
            hosts
                .iter()
                .map(|host| self.room.ask(host, Ask::Alarm(AlarmAsk::List), ANSWER_WAIT)),
        );
        let (mut alarms, mut floods, mut silent) = (Vec::new(), BTreeMap::new(), Vec::new());
        for (host, answer) in hosts.iter().zip(answers.await) {
            match answer {
                Ok(Told::Alarms(of_host, flood)) => {
                    alarms.extend(of_host);
                    floods.insert(host.clone(), flood);
                }
                Ok(_) => silent.push((host.clone(), unexpected().to_string())),
                Err(error) => silent.push((host.clone(), error.to_string())),
            }
        }
        alarms.sort_by(|a, b| {
            let urgency = |view: &AlarmView| (view.standing.definition.priority, view.standing.since_ns);
            urgency(b)
                .cmp(&urgency(a))
                .then_with(|| (&a.loop_id, &a.standing.definition.name).cmp(&(&b.loop_id, &b.standing.definition.name)))
        });
        AlarmList { alarms, floods, silent }
    }

    /// What happened to alarms, newest first, at most `max` (1 to 10,000) of each home. Homes that do not answer are left out
    /// with a warning.
    ///
    /// # Errors
    /// [`Error::Invalid`] for `max`.
    pub async fn alarm_past(&self, max: u32) -> Result<Vec<AlarmEvent>, Error> {
        if !(1..=ALARM_PAST_MAX).contains(&max) {
            return Err(Error::invalid(
                format!("{max} changes"),
                format!("ask for 1 to {ALARM_PAST_MAX}"),
            ));
        }
        let hosts = self.every_host();
        let answers = join_all(
            hosts
                .iter()
                .map(|host| self.room.ask(host, Ask::Alarm(AlarmAsk::Past(max)), ANSWER_WAIT)),
        );
        let mut past = Vec::new();
        for (host, answer) in hosts.iter().zip(answers.await) {
            match answer {
                Ok(Told::AlarmPast(events)) => past.extend(events),
                Ok(_) => tracing::warn!(%host, "a host's alarms are missing from the list"),
                Err(error) => tracing::warn!(%host, %error, "a host's alarms are missing from the list"),
            }
        }
        past.sort_by_key(|event| std::cmp::Reverse(event.change.at_ns));
        past.truncate(max as usize);
        Ok(past)
    }

    /// Does something with an alarm, in the name of `by`. On disk at the loop's home when this returns. None where it was
    /// removed.
    ///
    /// # Errors
    /// [`Error::NotFound`] for the loop or the alarm, [`Error::Refused`] where it is not in the state for it,
    /// [`Error::Invalid`] for a definition or a shelf, [`Error::Unreachable`], [`Error::Store`].
    pub async fn act_on_alarm(
        &self,
        loop_id: &LoopId,
        alarm: &str,
        act: AlarmAct,
        by: &str,
    ) -> Result<Option<AlarmView>, Error> {
        let by = match by {
            "" => Asker::current().by,
            by => by.to_owned(),
        };
        let entry = Act::on_loop(kind(&act), loop_id, asked(&act)).named(alarm).by(&by);
        let (deploy, loop_id, alarm) = (self.clone(), loop_id.clone(), alarm.to_owned());
        let work = async move {
            let show = AlarmAsk::Show(loop_id.clone(), alarm.clone());
            let before = deploy.at_alarm(&loop_id, show).await.ok().flatten();
            let ask = AlarmAsk::Act {
                loop_id: loop_id.clone(),
                alarm,
                act,
                by,
            };
            let end = deploy.at_alarm(&loop_id, ask).await;
            let seen = match &end {
                Ok(after) => Seen::of(stood(before.as_ref()), stood(after.as_ref())),
                Err(_) => Seen::default(),
            };
            (end, seen)
        };
        self.room.audited(entry, work).await
    }

    async fn at_alarm(&self, loop_id: &LoopId, ask: AlarmAsk) -> Result<Option<AlarmView>, Error> {
        let home = match host_of_board(loop_id) {
            Some(host) => host,
            None => self.room.book.home(loop_id)?,
        };
        match self.room.ask(&home, Ask::Alarm(ask), ANSWER_WAIT).await? {
            Told::Alarms(mut views, _) => Ok(views.pop()),
            _ => Err(unexpected()),
        }
    }

    /// How many alarms operators had in the last day, joined over all homes; and the hosts that did not answer.
    pub async fn alarm_load(&self) -> (AlarmLoad, Vec<(HostId, String)>) {
        let (mut load, mut silent) = (AlarmLoad::default(), Vec::new());
        for (host, answer) in self.ask_all(&Ask::AlarmLoad).await {
            match answer {
                Ok(Told::AlarmLoad(of_host)) => load.join(&of_host),
                Ok(_) => silent.push((host, unexpected().to_string())),
                Err(error) => silent.push((host, error.to_string())),
            }
        }
        (load, silent)
    }

    /// How the webhooks of all hosts do; and the hosts that did not answer.
    pub async fn webhooks(&self) -> (Vec<WebhookView>, Vec<(HostId, String)>) {
        let (mut views, mut silent) = (Vec::new(), Vec::new());
        for (host, answer) in self.ask_all(&Ask::Webhooks).await {
            match answer {
                Ok(Told::Webhooks(of_host)) => views.extend(of_host),
                Ok(_) => silent.push((host, unexpected().to_string())),
                Err(error) => silent.push((host, error.to_string())),
            }
        }
        (views, silent)
    }

    async fn ask_all(&self, ask: &Ask) -> Vec<(HostId, Result<Told, Error>)> {
        let hosts = self.every_host();
        let answers = join_all(hosts.iter().map(|host| self.room.ask(host, ask.clone(), ANSWER_WAIT))).await;
        hosts.into_iter().zip(answers).collect()
    }

    /// What happens to the alarms of all loops and hosts of the cell, from now on.
    #[must_use]
    pub fn alarm_events(&self) -> broadcast::Receiver<Arc<AlarmEvent>> {
        self.room.alarms.subscribe()
    }
}
