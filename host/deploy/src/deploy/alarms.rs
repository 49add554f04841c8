//! The facade's part for alarms: listed for the cell, acted on at the loop's home.
//!
//! Never: decides; the home does.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::LoopId;
use futures_util::future::join_all;
use tokio::sync::broadcast;

use super::{Deploy, unexpected};
use crate::{
    alarms::{AlarmAct, AlarmEvent, AlarmList, AlarmView},
    error::Error,
    limits::{ALARM_PAST_MAX, ANSWER_WAIT},
    wire::{AlarmAsk, Ask, Told},
};

impl Deploy {
    /// The alarms of all loops, the most urgent and newest first. Every host that serves points is asked.
    pub async fn alarms(&self) -> AlarmList {
        let hosts = self.room.roster.with_io();
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
        let hosts = self.room.roster.with_io();
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
        let home = self.room.book.home(loop_id)?;
        let ask = AlarmAsk::Act {
            loop_id: loop_id.clone(),
            alarm: alarm.to_owned(),
            act,
            by: by.to_owned(),
        };
        match self.room.ask(&home, Ask::Alarm(ask), ANSWER_WAIT).await? {
            Told::Alarms(mut views, _) => Ok(views.pop()),
            _ => Err(unexpected()),
        }
    }

    /// What happens to the alarms of loops at home here, from now on.
    #[must_use]
    pub fn alarm_events(&self) -> broadcast::Receiver<Arc<AlarmEvent>> {
        self.room.alarms.subscribe()
    }
}
