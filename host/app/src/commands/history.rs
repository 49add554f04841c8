//! `loop cycles | replay | backtest | shadow | shadows`: looking back, and trying components.

use std::{
    collections::BTreeMap,
    io::IsTerminal as _,
    path::Path,
    time::{Duration, Instant},
};

use bumpless_api::types::{
    BacktestRequest, Component, Cycles, Loop, Replay, ReplayRequest, Shadow, ShadowRequest, Shadows, Skipped, Trial,
};
use indicatif::ProgressBar;

use super::{curves, loops, step};
use crate::{
    cli::HistoryCommand,
    client::{Answer, Client, encoded},
    error::Error,
    show,
};

/// Pause between two looks at a shadow that is waited for.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// Longest wait for a shadow beyond the time that its cycles take: a loop may stand still while hosts change.
const WAIT_MARGIN: Duration = Duration::from_secs(60);

/// Does one thing.
pub(crate) fn run(client: &Client, json: bool, what: HistoryCommand) -> Result<(), Error> {
    match what {
        HistoryCommand::Cycles { name, last } => {
            let answer = client.get(&path(&name, &format!("/cycles?last={}", encoded(&last))))?;
            if json {
                show::json(&answer.text)
            } else {
                cycles(&answer.decode()?)
            }
        }
        HistoryCommand::Step {
            name,
            last,
            from,
            count,
            with,
            core,
        } => step::run(
            client,
            json,
            &step::Asked {
                name,
                last,
                from,
                count,
                with,
                core,
            },
        ),
        HistoryCommand::Replay { name, last } => {
            let request = ReplayRequest {
                last: Some(last),
                ..ReplayRequest::default()
            };
            let answer = client.post(&path(&name, "/replay"), &request)?;
            if json {
                show::json(&answer.text)
            } else {
                replay(&answer.decode()?)
            }
        }
        HistoryCommand::Backtest { name, candidate, last } => {
            let request = BacktestRequest {
                parameters: parameters(client, &candidate.component, &candidate.parameters)?,
                component: candidate.component,
                last: Some(last),
                from_unix_us: None,
                to_unix_us: None,
            };
            let answer = client.post(&path(&name, "/backtest"), &request)?;
            tried(json, &answer, &answer.decode()?, candidate.plot.as_deref())
        }
        HistoryCommand::Shadow {
            name,
            candidate,
            cycles,
            wait,
        } => {
            let request = ShadowRequest {
                parameters: parameters(client, &candidate.component, &candidate.parameters)?,
                component: candidate.component,
                cycles,
            };
            let answer = client.post(&path(&name, "/shadows"), &request)?;
            let started: Shadow = answer.decode()?;
            if wait {
                let answer = waited(client, &name, &started)?;
                return shadow(json, &answer, candidate.plot.as_deref());
            }
            if json {
                return show::json(&answer.text);
            }
            show::line(&format!(
                "shadow {} follows {name} with {} for {cycles} cycles; `bumpless loop shadows {name} {}` shows it",
                started.id, started.report.component, started.id
            ))
        }
        HistoryCommand::Shadows { name, id: None, .. } => {
            let answer = client.get(&path(&name, "/shadows"))?;
            if json {
                show::json(&answer.text)
            } else {
                list(&answer.decode()?)
            }
        }
        HistoryCommand::Shadows {
            name,
            id: Some(id),
            stop,
            plot,
        } => {
            let path = path(&name, &format!("/shadows/{id}"));
            let answer = if stop { client.delete(&path) } else { client.get(&path) }?;
            shadow(json, &answer, plot.as_deref())
        }
    }
}

pub(crate) fn path(name: &str, rest: &str) -> String {
    format!("/v1/loops/{}{rest}", encoded(name))
}

/// Numbers as they are, words as the candidate's choices have them.
pub(super) fn parameters(
    client: &Client,
    reference: &str,
    given: &[(String, String)],
) -> Result<BTreeMap<String, f64>, Error> {
    let mut component: Option<Component> = None;
    let mut values = BTreeMap::new();
    for (key, text) in given {
        let value = match text.parse() {
            Ok(number) => number,
            Err(_) => {
                let known = match component.take() {
                    Some(known) => known,
                    None => client
                        .get(&format!("/v1/components/{}", encoded(reference)))?
                        .decode()?,
                };
                loops::choice(component.insert(known), key, text)?
            }
        };
        values.insert(key.clone(), value);
    }
    Ok(values)
}

/// Waits until a shadow has ended.
pub(crate) fn waited(client: &Client, name: &str, started: &Shadow) -> Result<Answer, Error> {
    let found: Loop = client.get(&path(name, ""))?.decode()?;
    let cycles_s = found.spec.period_ms * 1e-3 * started.cycles_wanted as f64;
    let longest = Duration::try_from_secs_f64(cycles_s * 2.0)
        .unwrap_or(Duration::MAX)
        .saturating_add(WAIT_MARGIN);
    let bar = ProgressBar::new(started.cycles_wanted);
    let began = Instant::now();
    loop {
        let answer = client.get(&path(name, &format!("/shadows/{}", started.id)))?;
        let now: Shadow = answer.decode()?;
        bar.set_position(now.report.cycles);
        if now.ended.is_some() {
            bar.finish_and_clear();
            return Ok(answer);
        }
        if began.elapsed() > longest {
            return Err(Error::Usage(format!(
                "shadow {} has seen {} of {} cycles, and the wait is over; it goes on, and `bumpless loop shadows {name} {}` shows it",
                now.id, now.report.cycles, now.cycles_wanted, now.id
            )));
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

fn cycles(found: &Cycles) -> Result<(), Error> {
    let mut table = show::table(&[
        "cycle",
        "term",
        "mode",
        "setpoint",
        "measured",
        "outputs",
        "stepped by",
        "step",
        "events",
    ]);
    for record in &found.records {
        let outputs: Vec<String> = record.outputs.values().map(|value| show::maybe(*value)).collect();
        table.add_row([
            record.seq.to_string(),
            record.term.to_string(),
            record.mode.name().to_owned(),
            show::maybe(record.setpoint),
            show::maybe(record.measurement),
            outputs.join(", "),
            record.stepped_by.clone(),
            format!("{} µs", show::number(record.step_us)),
            record.events.len().to_string(),
        ]);
    }
    show::print(&table)?;
    if found.more {
        show::note("there are more in the window than one answer has: ask for fewer, or for JSON with times");
    }
    unread(found.unread)
}

fn unread(pieces: u64) -> Result<(), Error> {
    match pieces {
        0 => Ok(()),
        pieces => show::line(&format!(
            "{pieces} pieces of the log could not be read and are left out"
        )),
    }
}

fn replay(report: &Replay) -> Result<(), Error> {
    let verdict = match (report.compared, report.compared - report.equal.min(report.compared)) {
        (0, _) => "nothing could be compared".to_owned(),
        (compared, 0) => format!("all {compared} steps came out equal to the last bit"),
        (compared, other) => format!("{other} of {compared} steps came out otherwise"),
    };
    show::line(&format!("{}: {verdict}", report.loop_name))?;
    if let Some(difference) = &report.first_difference {
        show::line(&format!(
            "  the first is cycle {} of term {}: {}",
            difference.seq, difference.term, difference.text
        ))?;
    }
    skipped(&report.skipped)?;
    unread(report.unread)?;
    early(report.stopped_early.as_deref())
}

fn skipped(all: &[Skipped]) -> Result<(), Error> {
    all.iter()
        .try_for_each(|s| show::line(&format!("  left out: {} ({})", s.cycles, s.reason)))
}

fn early(reason: Option<&str>) -> Result<(), Error> {
    reason.map_or(Ok(()), |reason| {
        show::line(&format!("  stopped before the end of the window: {reason}"))
    })
}

fn list(found: &Shadows) -> Result<(), Error> {
    let mut table = show::table(&[
        "id",
        "component",
        "cycles",
        "missed",
        "verdict",
        "greatest difference",
        "state",
    ]);
    for shadow in &found.shadows {
        let report = &shadow.report;
        let worst = report.outputs.iter().filter_map(|o| o.max_percent).fold(0.0, f64::max);
        table.add_row([
            shadow.id.to_string(),
            report.component.clone(),
            format!("{} of {}", report.cycles, shadow.cycles_wanted),
            shadow.missed.to_string(),
            report.verdict.map_or("–", |verdict| verdict.name()).to_owned(),
            format!("{} %", show::number(worst)),
            shadow.ended.clone().unwrap_or_else(|| "follows".to_owned()),
        ]);
    }
    show::print(&table)
}

pub(crate) fn shadow(json: bool, answer: &Answer, plot: Option<&Path>) -> Result<(), Error> {
    let found: Shadow = answer.decode()?;
    if !json {
        let state = found.ended.as_deref().unwrap_or("it follows");
        show::line(&format!(
            "shadow {}: {} of {} cycles, {} missed; {state}",
            found.id, found.report.cycles, found.cycles_wanted, found.missed
        ))?;
    }
    tried(json, answer, &found.report, plot)
}

/// Prints what a candidate did, draws it where the output is a terminal, and writes it to a file where that was asked for.
fn tried(json: bool, answer: &Answer, trial: &Trial, plot: Option<&Path>) -> Result<(), Error> {
    if let Some(file) = plot {
        curves::write_svg(trial, file)?;
    }
    if json {
        return show::json(&answer.text);
    }
    report(trial)?;
    if std::io::stdout().is_terminal() {
        curves::draw(trial)?;
    }
    match plot {
        Some(file) => show::line(&format!("the curves are in {}", file.display())),
        None => Ok(()),
    }
}

fn report(trial: &Trial) -> Result<(), Error> {
    let verdict = trial.verdict.map_or("no verdict", |verdict| verdict.name());
    show::line(&format!(
        "{} on {}: {verdict}: {}",
        trial.component, trial.loop_name, trial.reason
    ))?;
    let mut table = show::table(&["output", "max", "mean", "rms", "travel recorded", "travel candidate"]);
    for output in &trial.outputs {
        let percent = |value: Option<f64>| format!("{} %", show::maybe(value));
        table.add_row([
            output.port.clone(),
            percent(output.max_percent),
            percent(output.mean_percent),
            percent(output.rms_percent),
            show::with_unit(output.recorded_travel, &output.unit),
            show::with_unit(output.candidate_travel, &output.unit),
        ]);
    }
    show::print(&table)?;
    let held = if trial.held > 0 {
        format!(", {} without a good input", trial.held)
    } else {
        String::new()
    };
    show::line(&format!(
        "  {} cycles over {} s, {} compared, {} faults{held}",
        trial.cycles,
        show::number(trial.indices.duration_s),
        trial.compared,
        trial.faults
    ))?;
    let by = trial.taken_over_by.as_deref().unwrap_or("no way");
    show::line(&format!(
        "  the state came over by {by}; bump in the first cycle {} % of span, {} % is allowed",
        show::maybe(trial.bump_percent),
        show::number(trial.bump_limit_percent)
    ))?;
    show::line(&format!(
        "  a step took {} µs of the processor, 99 of 100 at most {} µs, the longest {} µs",
        show::number(trial.steps.p50_us),
        show::number(trial.steps.p99_us),
        show::number(trial.steps.worst_us)
    ))?;
    let unit = &trial.measured_unit;
    show::line(&format!(
        "  the loop meanwhile: IAE {}, ISE {}, ITAE {}, Id {} %",
        show::with_unit(
            trial.indices.iae,
            &if unit.is_empty() {
                String::new()
            } else {
                format!("{unit}·s")
            }
        ),
        show::maybe(trial.indices.ise),
        show::maybe(trial.indices.itae),
        show::maybe(trial.indices.id_percent)
    ))?;
    if trial.anchored_anew > 0 {
        show::line(&format!(
            "  it began anew {} times, because cycles were missing",
            trial.anchored_anew
        ))?;
    }
    for (what, names) in [
        ("parameters", &trial.dropped_parameters),
        ("ports", &trial.dropped_ports),
    ] {
        if !names.is_empty() {
            show::line(&format!("  {what} that it does not take: {}", names.join(", ")))?;
        }
    }
    skipped(&trial.skipped)?;
    unread(trial.unread)?;
    early(trial.stopped_early.as_deref())?;
    show::line("  the plant was moved by the recorded controller, not by the candidate")
}
