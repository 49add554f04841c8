//! `loop …`: what runs, its changes and its commands.

use std::{collections::BTreeMap, fs, path::Path};

use bumpless_api::types::{
    Apply, Command, Component, Direction, Loop, LoopDraft, Loops, ModeRequest, MoveRequest, OutputRequest,
    RollbackRequest, SetRequest, SetpointRequest, SwapRequest,
};
use serde::Serialize;

use super::history;
use crate::{
    cli::{LoopCommand, ModeWord},
    client::{Answer, Client, encoded},
    error::Error,
    show,
};

/// Bytes of a loop file; the largest honest one has a few hundred lines.
const FILE_BYTES_MAX: u64 = 256 * 1024;

/// Does one thing with one loop, or lists them.
pub(crate) fn run(client: &Client, json: bool, what: LoopCommand) -> Result<(), Error> {
    match what {
        LoopCommand::Apply { file } => {
            let draft = read(&file)?;
            applied(json, &client.put(&path(&draft.name, ""), &draft)?)
        }
        LoopCommand::List => list(client, json),
        LoopCommand::Show { name } => show_one(client, json, &name),
        LoopCommand::Set { name, values } => set(client, json, &name, values),
        LoopCommand::Setpoint { name, value } => setpoint(client, json, &name, value),
        LoopCommand::Mode { name, mode: word } => mode(client, json, &name, word),
        LoopCommand::Output { name, values } => output(client, json, &name, &values),
        LoopCommand::Swap { name, component } => {
            applied(json, &client.post(&path(&name, "/swap"), &SwapRequest { component })?)
        }
        LoopCommand::Rollback { name, to } => applied(
            json,
            &client.post(&path(&name, "/rollback"), &RollbackRequest { revision: to })?,
        ),
        LoopCommand::Delete { name } => {
            client.delete(&path(&name, ""))?;
            show::line(&format!("{name} ended; its outputs stay as they are"))
        }
        LoopCommand::History(what) => history::run(client, json, what),
        LoopCommand::Move { name, host } => {
            client.post(&path(&name, "/move"), &MoveRequest { host: host.clone() })?;
            show::line(&format!("{name} is {host}'s from the next cycle on"))
        }
    }
}

fn path(name: &str, rest: &str) -> String {
    format!("/v1/loops/{}{rest}", encoded(name))
}

/// Reads a loop file.
pub(crate) fn read(file: &Path) -> Result<LoopDraft, Error> {
    let failed = |source| Error::File {
        path: file.to_owned(),
        action: "read",
        source,
    };
    let size = fs::metadata(file).map_err(failed)?.len();
    if size > FILE_BYTES_MAX {
        let path = file.display();
        return Err(Error::Usage(format!(
            "{path} has {size} bytes; a loop file has at most {FILE_BYTES_MAX}"
        )));
    }
    parse(&fs::read_to_string(file).map_err(failed)?, file)
}

pub(super) fn parse(text: &str, file: &Path) -> Result<LoopDraft, Error> {
    toml::from_str(text).map_err(|error| Error::Config {
        path: file.to_owned(),
        place: crate::config::place(text, error.span()),
        reason: error.message().to_owned(),
    })
}

/// Prints how a change ended.
fn applied(json: bool, answer: &Answer) -> Result<(), Error> {
    if json {
        return show::json(&answer.text);
    }
    let end: Apply = answer.decode()?;
    let what = match (end.created, end.unchanged) {
        (true, _) => "created",
        (_, true) => "unchanged",
        _ => "changed",
    };
    show::line(&format!(
        "{} {what}, revision {} is in force",
        end.loop_name, end.revision
    ))?;
    if let Some(hand_over) = end.hand_over {
        let bump = show::maybe(hand_over.bump_percent);
        show::line(&format!(
            "  the state came over by {}; output bump {bump} % of span",
            hand_over.by
        ))?;
    }
    if !end.dropped_parameters.is_empty() {
        show::line(&format!(
            "  left out, as the new component does not take them: {}",
            end.dropped_parameters.join(", ")
        ))?;
    }
    if !end.dropped_ports.is_empty() {
        show::line(&format!(
            "  disconnected, as the new component lacks them: {}",
            end.dropped_ports.join(", ")
        ))?;
    }
    for warning in &end.warnings {
        show::line(&format!("  warning: {warning}"))?;
    }
    Ok(())
}

/// Prints how a command ended.
fn commanded(json: bool, name: &str, answer: &Answer) -> Result<(), Error> {
    if json {
        return show::json(&answer.text);
    }
    let end: Command = answer.decode()?;
    show::line(&format!(
        "{name}: {}, setpoint {}, in force with cycle {} of term {}",
        end.mode.name(),
        show::maybe(end.setpoint),
        end.seq,
        end.term
    ))
}

fn command(client: &Client, json: bool, name: &str, what: &str, body: &impl Serialize) -> Result<(), Error> {
    commanded(json, name, &client.post(&path(name, what), body)?)
}

fn setpoint(client: &Client, json: bool, name: &str, setpoint: f64) -> Result<(), Error> {
    command(client, json, name, "/setpoint", &SetpointRequest { setpoint })
}

fn mode(client: &Client, json: bool, name: &str, mode: ModeWord) -> Result<(), Error> {
    command(client, json, name, "/mode", &ModeRequest { mode: mode.into() })
}

/// What `set` means, before words are looked up in the component.
#[derive(Debug, Default, PartialEq)]
struct Setting {
    setpoint: Option<f64>,
    strategy: Option<bumpless_core::Strategy>,
    numbers: BTreeMap<String, f64>,
    words: BTreeMap<String, String>,
}

impl Setting {
    fn new(values: Vec<(String, String)>) -> Result<Self, Error> {
        let mut setting = Self::default();
        for (key, value) in values {
            match key.as_str() {
                "setpoint" => {
                    let number = value
                        .parse()
                        .map_err(|_| Error::Usage(format!("setpoint={value}: use a number")))?;
                    setting.setpoint = Some(number);
                }
                "strategy" => {
                    let strategy = value
                        .parse()
                        .map_err(|e: bumpless_core::SpecError| Error::Usage(e.to_string()))?;
                    setting.strategy = Some(strategy);
                }
                _ => match value.parse() {
                    Ok(number) => drop(setting.numbers.insert(key, number)),
                    Err(_) => drop(setting.words.insert(key, value)),
                },
            }
        }
        Ok(setting)
    }
}

fn set(client: &Client, json: bool, name: &str, values: Vec<(String, String)>) -> Result<(), Error> {
    let mut setting = Setting::new(values)?;
    if !setting.words.is_empty() {
        let component = component(client, name)?;
        for (key, word) in std::mem::take(&mut setting.words) {
            let number = choice(&component, &key, &word)?;
            setting.numbers.insert(key, number);
        }
    }
    if !setting.numbers.is_empty() || setting.strategy.is_some() {
        let request = SetRequest {
            parameters: setting.numbers,
            strategy: setting.strategy.map(Into::into),
        };
        applied(json, &client.post(&path(name, "/set"), &request)?)?;
    }
    match setting.setpoint {
        Some(value) => setpoint(client, json, name, value),
        None => Ok(()),
    }
}

/// The component in force.
fn component(client: &Client, name: &str) -> Result<Component, Error> {
    let found: Loop = client.get(&path(name, ""))?.decode()?;
    client
        .get(&format!("/v1/components/{}", encoded(&found.digest)))?
        .decode()
}

/// The number of a parameter's word.
pub(super) fn choice(component: &Component, key: &str, word: &str) -> Result<f64, Error> {
    let Some(parameter) = component.parameters.iter().find(|p| p.name == key) else {
        let known: Vec<&str> = component.parameters.iter().map(|p| p.name.as_str()).collect();
        return Err(Error::Usage(format!(
            "{} has no parameter {key:?}; use setpoint, strategy, {}",
            component.name,
            known.join(", ")
        )));
    };
    match parameter.choices.iter().position(|choice| choice == word) {
        Some(index) => Ok(index as f64),
        None if parameter.choices.is_empty() => Err(Error::Usage(format!("{key}={word}: use a number"))),
        None => Err(Error::Usage(format!(
            "{key}={word}: use {}",
            parameter.choices.join(" or ")
        ))),
    }
}

fn output(client: &Client, json: bool, name: &str, values: &[String]) -> Result<(), Error> {
    let component = component(client, name)?;
    let ports: Vec<&str> = component
        .ports
        .iter()
        .filter(|p| p.direction == Direction::Output)
        .map(|p| p.name.as_str())
        .collect();
    let outputs = outputs(&ports, values)?;
    command(client, json, name, "/output", &OutputRequest { outputs })
}

/// Values by port; bare ones go to the ports in their order.
fn outputs(ports: &[&str], values: &[String]) -> Result<BTreeMap<String, f64>, Error> {
    let mut outputs = BTreeMap::new();
    for (i, text) in values.iter().enumerate() {
        let (port, number) = match text.split_once('=') {
            Some((port, number)) => (port, number),
            None => match ports.get(i) {
                Some(port) => (*port, text.as_str()),
                None => {
                    return Err(Error::Usage(format!(
                        "{} values for the outputs {}",
                        values.len(),
                        ports.join(", ")
                    )));
                }
            },
        };
        let number = number
            .parse()
            .map_err(|_| Error::Usage(format!("{text:?}: use VALUE or PORT=VALUE")))?;
        outputs.insert(port.to_owned(), number);
    }
    Ok(outputs)
}

fn list(client: &Client, json: bool) -> Result<(), Error> {
    let answer = client.list("/v1/loops", "loops")?;
    if json {
        return show::json(&answer.text);
    }
    let Loops { loops, .. } = answer.decode()?;
    let mut table = show::table(&[
        "loop",
        "component",
        "mode",
        "setpoint",
        "measured",
        "outputs",
        "owner",
        "term",
        "strategy",
        "age",
    ]);
    for l in loops {
        let unit = l.measured_unit.clone().unwrap_or_default();
        let outputs: Vec<String> = l.outputs.values().map(|value| show::maybe(*value)).collect();
        table.add_row([
            l.name,
            l.component,
            l.mode.map_or("–", |mode| mode.name()).to_owned(),
            show::with_unit(l.setpoint, &unit),
            show::with_unit(l.measurement, &unit),
            outputs.join(", "),
            l.owner.unwrap_or_else(|| "–".to_owned()),
            l.term.map_or_else(|| "–".to_owned(), |term| term.to_string()),
            l.spec.strategy.name().into_owned(),
            l.last_age_ms.map_or_else(|| "–".to_owned(), show::age),
        ]);
    }
    show::print(&table)
}

fn show_one(client: &Client, json: bool, name: &str) -> Result<(), Error> {
    let answer = client.get(&path(name, ""))?;
    if json {
        return show::json(&answer.text);
    }
    let l: Loop = answer.decode()?;
    let unit = l.measured_unit.clone().unwrap_or_default();
    let mut table = show::table(&["loop", &l.name]);
    let mut row = |key: &str, value: String| {
        table.add_row([key.to_owned(), value]);
    };
    row("component", format!("{} ({})", l.component, show::short(&l.digest)));
    row(
        "revision",
        l.revision.to_string()
            + &l.pending_revision
                .map(|n| format!(", {n} on its way"))
                .unwrap_or_default(),
    );
    row(
        "past revisions",
        l.past_revisions
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>()
            .join(", "),
    );
    row("period", format!("{} ms", show::number(l.spec.period_ms)));
    row("mode", l.mode.map_or("–", |mode| mode.name()).to_owned());
    row("setpoint", show::with_unit(l.setpoint, &unit));
    row("measured", show::with_unit(l.measurement, &unit));
    row(
        "outputs",
        l.outputs
            .iter()
            .map(|(p, v)| format!("{p} = {}", show::maybe(*v)))
            .collect::<Vec<_>>()
            .join(", "),
    );
    row(
        "ports",
        l.spec
            .ports
            .iter()
            .map(|(p, t)| format!("{p} ↔ {t}"))
            .collect::<Vec<_>>()
            .join(", "),
    );
    row(
        "parameters",
        l.spec
            .parameters
            .iter()
            .map(|(k, v)| format!("{k} = {}", show::number(*v)))
            .collect::<Vec<_>>()
            .join(", "),
    );
    row(
        "strategy",
        format!("{} over {}", l.spec.strategy.name(), l.members.join(", ")),
    );
    if let Some(redundancy) = &l.redundancy {
        row(
            "replicas",
            format!("{} of {} can step", redundancy.have, redundancy.want),
        );
        if let Some(vote) = &redundancy.vote {
            row(
                "vote",
                format!(
                    "{} of {} answers agreed, {} needed; {} dissents so far",
                    vote.agreed, vote.answers, vote.needed, vote.dissents
                ),
            );
            for a in &vote.aside {
                row(
                    "without a vote",
                    format!(
                        "{}: {} of {} clean steps, {} dissents",
                        a.host, a.clean, a.clean_needed, a.dissents
                    ),
                );
            }
        }
    }
    row("home", l.home.clone());
    row(
        "owner",
        format!(
            "{}, term {}",
            l.owner.as_deref().unwrap_or("–"),
            l.term.unwrap_or_default()
        ),
    );
    if let Some(t) = l.tally {
        row(
            "cycles",
            format!("{} taken, {} lost, {} skipped", t.taken, t.lost, t.skipped),
        );
        row("takeovers", format!("{} ({} commits refused)", t.takeovers, t.refused));
    }
    if let Some(age) = l.last_age_ms {
        row("last record", format!("{} ago", show::age(age)));
    }
    for failure in &l.failures {
        row(
            "failure",
            format!(
                "revision {}: {} ({} tries)",
                failure.revision, failure.reason, failure.tries
            ),
        );
    }
    show::print(&table)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(text: &str) -> Vec<(String, String)> {
        text.split(' ')
            .filter_map(|p| p.split_once('='))
            .map(|(k, v)| (k.to_owned(), v.to_owned()))
            .collect()
    }

    #[test]
    fn set_sorts_what_it_is_given() {
        let setting = Setting::new(pairs("setpoint=1.5 strategy=p2c k=2 action=direct")).expect("good");
        assert_eq!(setting.setpoint, Some(1.5));
        assert_eq!(setting.strategy, Some(bumpless_core::Strategy::P2c));
        assert_eq!(setting.numbers, [("k".to_owned(), 2.0)].into());
        assert_eq!(setting.words, [("action".to_owned(), "direct".to_owned())].into());
        for (bad, part) in [("setpoint=high", "use a number"), ("strategy=best", "use round-robin")] {
            let error = Setting::new(pairs(bad)).expect_err(bad);
            assert!(error.to_string().contains(part), "{error}");
            assert_eq!(error.exit_code(), 2);
        }
    }

    #[test]
    fn outputs_by_port_or_in_order() {
        let ports = ["valve", "pump"];
        let values = |text: &str| outputs(&ports, &text.split(' ').map(str::to_owned).collect::<Vec<_>>());
        assert_eq!(
            values("40 2").expect("good"),
            [("valve".to_owned(), 40.0), ("pump".to_owned(), 2.0)].into()
        );
        assert_eq!(values("pump=2").expect("good"), [("pump".to_owned(), 2.0)].into());
        assert!(
            values("1 2 3")
                .expect_err("too many")
                .to_string()
                .contains("3 values for the outputs valve, pump")
        );
        assert!(values("x").expect_err("no number").to_string().contains("PORT=VALUE"));
    }

    #[test]
    fn loop_files_are_checked_with_line_and_key() {
        let good = "name = \"l\"\ncomponent = \"pid\"\nperiod_ms = 100\nsetpoint = 1\n[ports]\npv = \"a\"\n";
        assert_eq!(parse(good, Path::new("l.toml")).expect("good").period_ms, 100.0);
        for (bad, parts) in [
            (
                good.replace("period_ms", "periode_ms"),
                ["line 3, key periode_ms", "`period_ms`"],
            ),
            (good.replace("= 100", "= \"fast\""), ["line 3, key period_ms", "f64"]),
            (
                format!("strategy = \"best\"\n{good}"),
                ["line 1, key strategy", "use round-robin"],
            ),
            (good.replace("name = \"l\"", ""), ["l.toml", "missing field `name`"]),
        ] {
            let error = parse(&bad, Path::new("l.toml")).expect_err(&bad).to_string();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }
}
