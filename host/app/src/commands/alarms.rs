//! `alarm list | history | ack | reset | shelve | unshelve | out | back | define | remove`.
//!
//! Never: decides; the loop's home does.

use std::{collections::BTreeMap, path::Path};

use bumpless_api::types::{
    AlarmActRequest, AlarmActWord, AlarmDefinition, AlarmHistory, AlarmState, LoopAlarm, LoopAlarms, Priority,
};

use crate::{
    cli::{AlarmCommand, AlarmOf},
    client::{Answer, Client, encoded},
    error::Error,
    show, watch,
};

/// Alarms in one file; a loop has at most 64.
const DEFINITIONS_MAX: usize = 10_000;

/// Does one thing.
pub(crate) fn run(client: &Client, json: bool, what: AlarmCommand) -> Result<(), Error> {
    let act = |of: &AlarmOf, act, note: &str, reason: &str, seconds| {
        let request = AlarmActRequest {
            act,
            by: of.by.clone(),
            note: note.to_owned(),
            reason: reason.to_owned(),
            seconds,
        };
        told(json, &client.post(&path(&of.loop_name, &of.alarm), &request)?)
    };
    match what {
        AlarmCommand::List { loop_name, all } => {
            let of = loop_name
                .map(|name| format!("&loop={}", encoded(&name)))
                .unwrap_or_default();
            let answer = client.list(&format!("/v1/alarms?all={all}{of}"), "alarms")?;
            if json {
                return show::json(&answer.text);
            }
            list(&answer.decode()?)
        }
        AlarmCommand::History { loop_name, limit } => {
            let of = loop_name
                .map(|name| format!("&loop={}", encoded(&name)))
                .unwrap_or_default();
            let answer = client.get(&format!("/v1/alarms/history?limit={limit}{of}"))?;
            if json {
                return show::json(&answer.text);
            }
            history(&answer.decode()?)
        }
        AlarmCommand::Watch { loop_name, count } => watch::alarms(client, json, loop_name.as_deref(), count),
        AlarmCommand::Ack { of, note } => act(&of, AlarmActWord::Acknowledge, &note, "", 0.0),
        AlarmCommand::Reset { of } => act(&of, AlarmActWord::Reset, "", "", 0.0),
        AlarmCommand::Shelve { of, seconds, reason } => act(&of, AlarmActWord::Shelve, "", &reason, seconds),
        AlarmCommand::Unshelve { of } => act(&of, AlarmActWord::Unshelve, "", "", 0.0),
        AlarmCommand::Out { of, reason } => act(&of, AlarmActWord::TakeOut, "", &reason, 0.0),
        AlarmCommand::Back { of } => act(&of, AlarmActWord::PutBack, "", "", 0.0),
        AlarmCommand::Define { file } => define(client, json, &file),
        AlarmCommand::Remove { of } => {
            client.delete(&path(&of.loop_name, &of.alarm))?;
            if json {
                return Ok(());
            }
            show::line(&format!("alarm {} of loop {} is gone", of.alarm, of.loop_name))
        }
    }
}

fn path(loop_name: &str, alarm: &str) -> String {
    format!("/v1/loops/{}/alarms/{}", encoded(loop_name), encoded(alarm))
}

fn told(json: bool, answer: &Answer) -> Result<(), Error> {
    if json {
        return show::json(&answer.text);
    }
    let alarm: LoopAlarm = answer.decode()?;
    let quiet = if alarm.quiet { ", kept quiet" } else { "" };
    show::line(&format!(
        "alarm {} of loop {}: {}{quiet}",
        alarm.name,
        alarm.loop_name,
        state(alarm.state)
    ))
}

/// Defines each alarm of a file; the first that cannot be ends it, and says how many came before.
fn define(client: &Client, json: bool, file: &Path) -> Result<(), Error> {
    let text = std::fs::read_to_string(file)
        .map_err(|error| Error::Usage(format!("{} cannot be read: {error}", file.display())))?;
    let tables: BTreeMap<String, BTreeMap<String, AlarmDefinition>> =
        toml::from_str(&text).map_err(|error| Error::Usage(format!("{}: {error}", file.display())))?;
    let all: Vec<(&String, &String, &AlarmDefinition)> = tables
        .iter()
        .flat_map(|(of, alarms)| alarms.iter().map(move |(name, definition)| (of, name, definition)))
        .collect();
    if all.is_empty() || all.len() > DEFINITIONS_MAX {
        return Err(Error::Usage(format!(
            "{} has {} alarms; write 1 to {DEFINITIONS_MAX} tables like [pressure.high]",
            file.display(),
            all.len()
        )));
    }
    for (done, (loop_name, alarm, definition)) in all.iter().enumerate() {
        let answer = client.put(&path(loop_name, alarm), definition).inspect_err(|_| {
            show::note(&format!("{done} of {} alarms were defined before this one", all.len()));
        })?;
        told(json, &answer)?;
    }
    Ok(())
}

const fn state(state: AlarmState) -> &'static str {
    match state {
        AlarmState::Normal => "normal",
        AlarmState::Active => "active",
        AlarmState::Acknowledged => "acknowledged",
        AlarmState::Returned => "returned, not acknowledged",
        AlarmState::Latched => "latched, waits for a reset",
    }
}

const fn priority(priority: Priority) -> &'static str {
    match priority {
        Priority::Low => "low",
        Priority::Medium => "medium",
        Priority::High => "high",
    }
}

fn list(found: &LoopAlarms) -> Result<(), Error> {
    let mut table = show::table(&[
        "priority",
        "loop",
        "alarm",
        "state",
        "value",
        "limit",
        "age",
        "quiet",
        "what to do",
    ]);
    for alarm in &found.alarms {
        let quiet = match (&alarm.shelf, &alarm.out_of_service) {
            (Some(shelf), _) => format!("shelved: {}", shelf.reason),
            (None, Some(why)) => format!("out of service: {why}"),
            (None, None) if alarm.suppressed => "suppressed".to_owned(),
            (None, None) => String::new(),
        };
        let first = if alarm.first_out { " (first)" } else { "" };
        table.add_row([
            priority(alarm.priority).to_owned(),
            alarm.loop_name.clone(),
            format!("{}{first}", alarm.name),
            state(alarm.state).to_owned(),
            show::maybe(alarm.value),
            show::maybe(alarm.definition.limit),
            alarm.age_s.map(|s| show::age((s * 1e3) as u64)).unwrap_or_default(),
            quiet,
            alarm.definition.response.clone(),
        ]);
    }
    show::print(&table)?;
    for flood in found.floods.iter().filter(|flood| flood.is_flood) {
        show::note(&format!(
            "an alarm flood: {} alarms in ten minutes from loops at home at {}",
            flood.comings, flood.host
        ));
    }
    for silent in &found.silent {
        show::note(&format!("host {} did not say: {}", silent.host, silent.reason));
    }
    Ok(())
}

fn history(found: &AlarmHistory) -> Result<(), Error> {
    let mut table = show::table(&["µs since 1970", "loop", "alarm", "what", "value", "by", "note"]);
    for change in &found.changes {
        table.add_row([
            change.at_unix_us.to_string(),
            change.loop_name.clone(),
            change.alarm.clone(),
            change.what.clone(),
            show::maybe(change.value),
            change.by.clone().unwrap_or_default(),
            change.note.clone(),
        ]);
    }
    show::print(&table)
}
