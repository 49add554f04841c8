//! `rollout start | list | show | stop`: one component for many loops.
//!
//! Never: decides; the host that keeps the rollout does.

use std::{
    collections::BTreeMap,
    io::IsTerminal as _,
    time::{Duration, Instant},
};

use bumpless_api::types::{Rollout, RolloutLoop, RolloutRequest, RolloutStage, RolloutState, Rollouts};
use indicatif::{ProgressBar, ProgressStyle};

use super::history;
use crate::{
    cli::{RolloutArgs, RolloutCommand},
    client::{Answer, Client, encoded},
    error::Error,
    show,
};

/// Pause between two looks at a rollout that is waited for.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Longest silence of its host while a rollout is waited for: hosts restart.
const SILENCE_MAX: Duration = Duration::from_secs(120);

/// Does one thing.
pub(crate) fn run(client: &Client, json: bool, what: RolloutCommand) -> Result<(), Error> {
    match what {
        RolloutCommand::Start(args) => start(client, json, args),
        RolloutCommand::List => {
            let answer = client.list("/v1/rollouts", "rollouts")?;
            if json {
                return show::json(&answer.text);
            }
            list(&answer.decode()?)
        }
        RolloutCommand::Show { id } => one(json, &client.get(&path(&id, ""))?),
        RolloutCommand::Stop { id } => one(json, &client.post(&path(&id, "/stop"), &())?),
    }
}

fn path(id: &str, rest: &str) -> String {
    format!("/v1/rollouts/{}{rest}", encoded(id))
}

fn start(client: &Client, json: bool, args: RolloutArgs) -> Result<(), Error> {
    let request = RolloutRequest {
        parameters: history::parameters(client, &args.component, &args.parameters)?,
        component: args.component,
        loops: args.loops,
        all_of: args.all_of,
        cycles: args.cycles,
        factor: args.factor,
        at_once: args.at_once,
        on_failure: args.on_failure.into(),
    };
    let answer = client.post("/v1/rollouts", &request)?;
    let started: Rollout = answer.decode()?;
    if args.wait {
        let answer = waited(client, &started)?;
        one(json, &answer)?;
        let end: Rollout = answer.decode()?;
        return match end.state {
            RolloutState::Done => Ok(()),
            RolloutState::Stopped => Err(Error::Refused(format!("rollout {} was stopped", end.id))),
            _ => Err(Error::Refused(format!(
                "rollout {} failed: {}",
                end.id,
                end.failure.unwrap_or_default()
            ))),
        };
    }
    if json {
        return show::json(&answer.text);
    }
    let first = started
        .loops
        .first()
        .map(|one| one.loop_name.clone())
        .unwrap_or_default();
    show::line(&format!(
        "rollout {} brings {} to {} loops, {first} first; `bumpless rollout show {}` shows it",
        started.id, started.component, started.total, started.id
    ))
}

/// Waits until a rollout has ended, and shows how far it is: as a bar where somebody looks, as lines elsewhere.
fn waited(client: &Client, started: &Rollout) -> Result<Answer, Error> {
    let looked_at = std::io::stderr().is_terminal();
    let bar = if looked_at {
        ProgressBar::new(u64::from(started.total))
    } else {
        ProgressBar::hidden()
    };
    if let Ok(style) = ProgressStyle::with_template("{prefix} {bar:24} {pos}/{len} {wide_msg}") {
        bar.set_style(style);
    }
    bar.set_prefix(started.id.clone());
    let mut told: BTreeMap<String, RolloutStage> = BTreeMap::new();
    let mut heard = Instant::now();
    loop {
        let answer = match client.get(&path(&started.id, "")) {
            Ok(answer) => answer,
            // Its host may be on its way back; it goes on with it then.
            Err(error) if error.exit_code() != 3 && heard.elapsed() < SILENCE_MAX => {
                std::thread::sleep(LOOK_EVERY);
                continue;
            }
            Err(error) => return Err(error),
        };
        heard = Instant::now();
        let now: Rollout = answer.decode()?;
        bar.set_position(u64::from(now.done));
        let at_work = |one: &&RolloutLoop| !matches!(one.stage, RolloutStage::Waiting | RolloutStage::Done);
        let first_waiting = now.loops.iter().find(|one| one.stage == RolloutStage::Waiting);
        let doing: Vec<String> = now
            .loops
            .iter()
            .filter(at_work)
            .chain(first_waiting)
            .map(|one| format!("{} {}", one.loop_name, stage(one, now.cycles)))
            .collect();
        bar.set_message(doing.join(", "));
        for one in &now.loops {
            let before = told.insert(one.loop_name.clone(), one.stage);
            if !looked_at && before != Some(one.stage) && one.stage != RolloutStage::Waiting {
                show::note(&format!("{}: {}", one.loop_name, stage(one, now.cycles)));
            }
        }
        if now.state != RolloutState::Running {
            bar.finish_and_clear();
            return Ok(answer);
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

/// `watched (7 of 200)`.
fn stage(one: &RolloutLoop, cycles: u32) -> String {
    match one.stage {
        RolloutStage::Waiting if one.cycles_before > 0 => {
            format!("waiting ({} of {cycles} before)", one.cycles_before)
        }
        RolloutStage::Waiting => "waiting".to_owned(),
        RolloutStage::Changing => "changing".to_owned(),
        RolloutStage::Watched => format!("watched ({} of {cycles})", one.cycles),
        RolloutStage::Done => "done".to_owned(),
        RolloutStage::Refused => "refused".to_owned(),
        RolloutStage::GoingBack => "going back".to_owned(),
        RolloutStage::Failed => "failed".to_owned(),
        RolloutStage::RolledBack => "rolled back".to_owned(),
    }
}

fn list(found: &Rollouts) -> Result<(), Error> {
    let mut table = show::table(&["rollout", "component", "done", "state", "failure"]);
    for rollout in &found.rollouts {
        table.add_row([
            rollout.id.clone(),
            rollout.component.clone(),
            format!("{} of {}", rollout.done, rollout.total),
            rollout.state.name().to_owned(),
            rollout.failure.clone().unwrap_or_default(),
        ]);
    }
    show::print(&table)?;
    for silent in &found.silent {
        show::note(&format!("host {} did not say: {}", silent.host, silent.reason));
    }
    Ok(())
}

fn one(json: bool, answer: &Answer) -> Result<(), Error> {
    if json {
        return show::json(&answer.text);
    }
    let found: Rollout = answer.decode()?;
    let failure = found.failure.as_ref().map(|why| format!(": {why}")).unwrap_or_default();
    show::line(&format!(
        "rollout {} of {}: {}, {} of {} loops done{failure}",
        found.id,
        found.component,
        found.state.name(),
        found.done,
        found.total
    ))?;
    let mut table = show::table(&["loop", "stage", "revision", "error before", "error", "why"]);
    for leg in &found.loops {
        let revisions = match leg.revision {
            Some(revision) if revision != leg.revision_before => format!("{} → {revision}", leg.revision_before),
            _ => leg.revision_before.to_string(),
        };
        table.add_row([
            leg.loop_name.clone(),
            stage(leg, found.cycles),
            revisions,
            show::maybe(leg.error_before),
            show::maybe(leg.error),
            leg.reason.clone(),
        ]);
    }
    show::print(&table)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_says_how_far_it_is() {
        let leg = |stage, cycles_before, cycles| RolloutLoop {
            loop_name: "l".into(),
            stage,
            reason: String::new(),
            cycles_before,
            cycles,
            revision_before: 1,
            revision: None,
            error_before: None,
            error: None,
        };
        for (one, wanted) in [
            (leg(RolloutStage::Waiting, 0, 0), "waiting"),
            (leg(RolloutStage::Waiting, 12, 0), "waiting (12 of 200 before)"),
            (leg(RolloutStage::Watched, 200, 7), "watched (7 of 200)"),
            (leg(RolloutStage::GoingBack, 200, 7), "going back"),
        ] {
            assert_eq!(stage(&one, 200), wanted);
        }
    }
}
