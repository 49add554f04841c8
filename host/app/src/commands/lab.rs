//! The lab on the command line: runs with a bar, tables in the terminal, reports in a folder; records and promotes.
//!
//! Only `record` and `promote` speak to a cell. Never: changes a live loop; a shadow only follows.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering::Relaxed},
};

use bumpless_api::types::{Component, Cycles, Shadow, ShadowRequest};
use bumpless_engine::{Config as EngineConfig, Engine};
use bumpless_lab::{
    Experiment, FIGURES, Lab, Library, Options, Outcome, Progress, limits::RECORDED_BYTES_MAX, recorded::Window, report,
};
use indicatif::{ProgressBar, ProgressStyle};

use crate::{
    cli::{LabCommand, LabRunArgs},
    client::{Client, encoded},
    commands::{components, history},
    error::Error,
    show, stop,
};

/// Records of one answer; the API's own bound.
const RECORDS_PER_ANSWER: u32 = 1_000;
/// Figures of the table in the terminal.
const SHOWN: [&str; 9] = [
    "iae",
    "itae",
    "overshoot",
    "settling",
    "tv",
    "delay",
    "messages-lost",
    "cycles-lost",
    "bump",
];

fn failed(source: bumpless_lab::Error) -> Error {
    Error::Failed {
        what: "the lab",
        source: source.into(),
    }
}

/// Runs what was typed. `client` is made only where a cell is spoken to.
pub(crate) fn run(client: impl Fn() -> Result<Client, Error>, json: bool, what: LabCommand) -> Result<(), Error> {
    match what {
        LabCommand::Run { files, how } => {
            let (lab, stop) = (lab(&how)?, stop::on_signals()?);
            for file in files {
                let plan = Plan::read(&file, &how)?;
                finish(json, &plan, &plan.run(&lab, &how, &stop)?, &how)?;
            }
            Ok(())
        }
        LabCommand::Report { file, how } => {
            let plan = Plan::read(&file, &how)?;
            finish(json, &plan, &plan.run(&lab(&how)?, &how, &*stop::on_signals()?)?, &how)
        }
        LabCommand::Compare { file, controllers, how } => {
            let mut plan = Plan::read(&file, &how)?;
            let cases = controllers
                .iter()
                .map(|text| case(&plan, text))
                .collect::<Result<Vec<_>, _>>()?;
            plan.change("case", toml::Value::Array(cases))?;
            finish(json, &plan, &plan.run(&lab(&how)?, &how, &*stop::on_signals()?)?, &how)
        }
        LabCommand::Sweep { file, fields, how } => {
            let mut plan = Plan::read(&file, &how)?;
            let mut sweeps = plan
                .document
                .get("sweep")
                .and_then(toml::Value::as_array)
                .cloned()
                .unwrap_or_default();
            for (field, values) in fields {
                let mut sweep = toml::Table::new();
                sweep.insert("field".to_owned(), field.into());
                let values: Vec<toml::Value> = values.split(',').map(word).collect();
                sweep.insert("values".to_owned(), values.into());
                sweeps.push(sweep.into());
            }
            plan.change("sweep", sweeps.into())?;
            finish(json, &plan, &plan.run(&lab(&how)?, &how, &*stop::on_signals()?)?, &how)
        }
        LabCommand::Record { name, last, output } => record(&client()?, json, &name, &last, &output),
        LabCommand::Fit { file } => fit(json, &file),
        LabCommand::Promote {
            file,
            name,
            case,
            by,
            cycles,
            wait,
            how,
        } => {
            let wish = Wish {
                name: &name,
                case: case.as_deref(),
                by: &by,
                cycles,
                wait,
            };
            promote(&client()?, json, &file, &wish, &how)
        }
    }
}

/// An experiment with the document that it was read from.
struct Plan {
    place: String,
    base: PathBuf,
    experiment: Experiment,
    document: toml::Table,
}

impl Plan {
    fn read(file: &Path, how: &LabRunArgs) -> Result<Self, Error> {
        let (experiment, document) = Experiment::read(file).map_err(failed)?;
        let mut plan = Self {
            place: file.display().to_string(),
            base: file.parent().unwrap_or(Path::new("")).to_owned(),
            experiment,
            document,
        };
        if let Some(seeds) = how.seeds {
            plan.change("seeds", i64::from(seeds).into())?;
        }
        Ok(plan)
    }

    /// Sets a field at the top.
    fn change(&mut self, key: &str, value: toml::Value) -> Result<(), Error> {
        self.document.insert(key.to_owned(), value);
        self.experiment = Experiment::from_table(self.document.clone(), &self.place).map_err(failed)?;
        Ok(())
    }

    fn run(&self, lab: &Lab, how: &LabRunArgs, stop: &AtomicBool) -> Result<Outcome, Error> {
        let bar = ProgressBar::new(1);
        if let Ok(style) = ProgressStyle::with_template("{msg} {bar:40} {pos}/{len} runs {eta}") {
            bar.set_style(style);
        }
        bar.set_message(self.experiment.name.clone());
        let progress = |p: Progress| {
            bar.set_length(p.runs as u64);
            bar.set_position(p.done as u64);
        };
        let options = Options {
            jobs: how.jobs,
            kept_in: (!how.fresh).then(|| how.out.join("kept")),
            base: self.base.clone(),
        };
        let outcome = lab.run(&self.experiment, &self.document, &self.place, &options, stop, &progress);
        bar.finish_and_clear();
        match outcome {
            Err(bumpless_lab::Error::Stopped) if stop.load(Relaxed) => Err(Error::Usage(
                "stopped; what was made is kept, and the next run goes on from there".to_owned(),
            )),
            other => other.map_err(failed),
        }
    }
}

fn lab(how: &LabRunArgs) -> Result<Lab, Error> {
    // Components are the engineer's own files here: compiled in this process, and nothing is kept of them.
    let config = EngineConfig {
        instances_max: 4096,
        ..EngineConfig::default()
    };
    let engine = Engine::new(config).map_err(|e| Error::start("the sandbox", e))?;
    Ok(Lab::new(Library::new(
        engine,
        bumpless_lab::folders(how.components.as_deref()),
    )))
}

/// A value as TOML would have it; what is none is a word.
fn word(text: &str) -> toml::Value {
    let text = text.trim();
    toml::from_str::<toml::Table>(&format!("x = {text}"))
        .ok()
        .and_then(|mut table| table.remove("x"))
        .unwrap_or_else(|| text.into())
}

/// `pidplus` or `pidplus:k=2,ti=3` as a case.
fn case(plan: &Plan, text: &str) -> Result<toml::Value, Error> {
    let (component, parameters) = match text.split_once(':') {
        Some((component, rest)) => (component, Some(rest)),
        None => (text, None),
    };
    let mut set = toml::Table::new();
    let own = |n: usize| plan.experiment.loops.get(n).is_some_and(|l| l.controller.is_some());
    let mut places: Vec<String> = Vec::new();
    if (0..plan.experiment.loops.len()).any(|n| !own(n)) {
        places.push("controller".to_owned());
    }
    places.extend(
        (0..plan.experiment.loops.len())
            .filter(|n| own(*n))
            .map(|n| format!("loop.{n}.controller")),
    );
    for place in places {
        match parameters {
            None => {
                set.insert(format!("{place}.component"), component.into());
            }
            Some(rest) => {
                let mut table = toml::Table::new();
                for pair in rest.split(',').filter(|p| !p.is_empty()) {
                    let (name, value) = pair.split_once('=').ok_or_else(|| {
                        Error::Usage(format!(
                            "{text}: write parameters as NAME=VALUE, with commas between them"
                        ))
                    })?;
                    table.insert(name.trim().to_owned(), word(value));
                }
                let mut controller = toml::Table::new();
                controller.insert("component".to_owned(), component.into());
                controller.insert("parameters".to_owned(), table.into());
                set.insert(place, controller.into());
            }
        }
    }
    let name: String = text
        .chars()
        .map(|c| {
            if c.is_ascii_alphanumeric() || ".-_+".contains(c) {
                c
            } else {
                '-'
            }
        })
        .take(64)
        .collect();
    let mut case = toml::Table::new();
    case.insert("name".to_owned(), name.into());
    case.insert("set".to_owned(), set.into());
    Ok(case.into())
}

/// Writes the report and tells what came out.
fn finish(json: bool, plan: &Plan, outcome: &Outcome, how: &LabRunArgs) -> Result<(), Error> {
    let files = report::write(outcome, &how.out).map_err(failed)?;
    if json {
        let text = fs::read_to_string(&files.json).map_err(|source| Error::File {
            path: files.json.clone(),
            action: "read",
            source,
        })?;
        return show::json(text.trim_end());
    }
    show::line(&format!(
        "{}: {}",
        plan.experiment.name,
        plan.experiment.text.lines().next().unwrap_or_default()
    ))?;
    for (n, name) in outcome.loops.iter().enumerate() {
        let figures: Vec<_> = report::told(outcome, n)
            .into_iter()
            .filter(|f| SHOWN.contains(&f.key))
            .collect();
        let mut header = vec![if outcome.loops.len() == 1 {
            "case"
        } else {
            name.as_str()
        }];
        header.extend(figures.iter().map(|f| f.name));
        let mut table = show::table(&header);
        for v in &outcome.variants {
            let mut row = vec![v.title()];
            row.extend(figures.iter().map(|f| {
                v.summary(n, f.key)
                    .map_or_else(|| "–".to_owned(), |s| report::interval(&s))
            }));
            table.add_row(row);
        }
        show::print(&table)?;
    }
    for v in &outcome.variants {
        for why in v.runs.iter().filter_map(|r| r.failed.as_deref()) {
            show::line(&format!("failed: {why}"))?;
        }
    }
    show::line(&format!("report: {}; tables beside it", files.html.display()))
}

/// Asks for a window, answer by answer, until nothing is left of it. `ask` gets the query, and gives the answer with the size
/// of its text, in bytes. A window beyond `bytes_max` is refused: the lab could not read its file, and a part of it that
/// looks like the whole would be worse.
fn gather(
    name: &str,
    last: &str,
    bytes_max: u64,
    mut ask: impl FnMut(&str) -> Result<(Cycles, usize), Error>,
) -> Result<Cycles, Error> {
    let mut whole: Option<Cycles> = None;
    let mut query = format!("last={}", encoded(last));
    let mut bytes = 0;
    loop {
        let (answer, size) = ask(&query)?;
        bytes += size as u64;
        let (more, newest) = (answer.more, answer.records.last().map(|r| r.at_unix_us));
        match &mut whole {
            None => whole = Some(answer),
            Some(whole) => {
                whole.records.extend(answer.records);
                whole.unread = whole.unread.max(answer.unread);
            }
        }
        match newest.filter(|_| more) {
            Some(_) if bytes > bytes_max => {
                let so_far = whole.map_or(0, |w| w.records.len());
                return Err(Error::Usage(format!(
                    "the last {last} of {name} are more than the {} MB that a file of cycles may have, which {so_far} of them \
                     fill; ask for less with --last",
                    bytes_max >> 20
                )));
            }
            Some(at_unix_us) => query = format!("from_unix_us={}", at_unix_us + 1),
            None => break,
        }
    }
    let mut cycles = whole
        .filter(|c| c.records.len() > 1)
        .ok_or_else(|| Error::Usage(format!("{name} has fewer than two recorded cycles in that time")))?;
    cycles.more = false;
    Ok(cycles)
}

/// Writes one file of a recorded window.
fn record(client: &Client, json: bool, name: &str, last: &str, output: &Path) -> Result<(), Error> {
    let cycles = gather(name, last, RECORDED_BYTES_MAX, |query| {
        let path = history::path(name, &format!("/cycles?{query}&limit={RECORDS_PER_ANSWER}"));
        let answer = client.get(&path)?;
        Ok((answer.decode()?, answer.text.len()))
    })?;
    let text = serde_json::to_string(&cycles).map_err(|e| Error::start("the file of cycles", e))?;
    fs::write(output, &text).map_err(|source| Error::File {
        path: output.to_owned(),
        action: "written",
        source,
    })?;
    if json {
        return show::json(&text);
    }
    show::line(&format!(
        "{} cycles of {name} are in {}",
        cycles.records.len(),
        output.display()
    ))
}

fn fit(json: bool, file: &Path) -> Result<(), Error> {
    let window = Window::read(file).map_err(failed)?;
    let Some(fit) = window.fit() else {
        return Err(Error::Usage(format!(
            "{}: no first-order process explains this window; record one in which setpoint or output moves",
            file.display()
        )));
    };
    if json {
        return show::json(&format!(
            "{{\"gain\":{},\"tau\":{},\"dead-time\":{},\"rest\":{},\"explained\":{}}}",
            fit.gain, fit.tau_s, fit.dead_time_s, fit.rest, fit.explained
        ));
    }
    show::line(&format!(
        "# {:.1} % of the measurement's variance over {:.1} s is explained\n[plant]\nmodel = \"component:fopdt\"\nconstants = {{ \
         gain = {:.6}, tau = {:.6}, dead-time = {:.6}, rest = {:.6} }}",
        fit.explained * 100.0,
        window.duration_s(),
        fit.gain,
        fit.tau_s,
        fit.dead_time_s,
        fit.rest
    ))
}

/// What shall be promoted where.
struct Wish<'a> {
    name: &'a str,
    case: Option<&'a str>,
    by: &'a str,
    cycles: u64,
    wait: bool,
}

fn promote(client: &Client, json: bool, file: &Path, wish: &Wish<'_>, how: &LabRunArgs) -> Result<(), Error> {
    if !FIGURES.iter().any(|f| f.key == wish.by) {
        let keys: Vec<&str> = FIGURES.iter().map(|f| f.key).collect();
        return Err(Error::Usage(format!(
            "{:?} is no figure; use one of {}",
            wish.by,
            keys.join(", ")
        )));
    }
    let (lab, plan) = (lab(how)?, Plan::read(file, how)?);
    let outcome = plan.run(&lab, how, &*stop::on_signals()?)?;
    let winner = outcome.winner(wish.by, wish.case);
    let Some((winner, best)) = winner.and_then(|w| w.results.first().copied().map(|best| (w, best))) else {
        return Err(Error::Usage(match wish.case {
            Some(case) if outcome.variants.iter().all(|v| v.case != case) => {
                format!("{} has no case {case:?}", plan.place)
            }
            _ => format!(
                "no case of {} reached its end everywhere with a {}",
                plan.place, wish.by
            ),
        }));
    };
    let chosen = lab
        .controller_of(
            &plan.experiment,
            &plan.document,
            &plan.place,
            &plan.base,
            (&best.case, &best.at),
        )
        .map_err(failed)?;
    let note = format!(
        "note={}",
        encoded(&format!(
            "from the experiment {}, case {}",
            plan.experiment.name,
            winner.title()
        ))
    );
    let (component, _): (Component, String) = components::send(client, &chosen.file, &note, !json)?;
    let request = ShadowRequest {
        component: chosen.digest.to_string(),
        parameters: chosen.parameters,
        cycles: wish.cycles,
    };
    let answer = client.post(&history::path(wish.name, "/shadows"), &request)?;
    let started: Shadow = answer.decode()?;
    if !json {
        let mean = match (winner.results.len(), best.summary(0, wish.by)) {
            (1, Some(s)) => report::interval(&s),
            (points, _) => format!("{}, the mean of {points} points", report::number(winner.score)),
        };
        show::line(&format!(
            "{} ({} {mean}) is {}@{}: uploaded, and shadow {} follows {} for {} cycles",
            winner.title(),
            wish.by,
            component.name,
            component.version,
            started.id,
            wish.name,
            wish.cycles
        ))?;
    }
    if wish.wait {
        let answer = history::waited(client, wish.name, &started)?;
        return history::shadow(json, &answer, None);
    }
    if json {
        return show::json(&answer.text);
    }
    show::line(&format!(
        "`bumpless loop shadows {0} {1}` shows what it finds; `bumpless loop swap {0} {2}` brings it in",
        wish.name, started.id, component.name
    ))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    #[test]
    fn values_are_read_as_toml_and_what_is_none_is_a_word() {
        assert_eq!(word("2"), toml::Value::Integer(2));
        assert_eq!(word(" 2.5"), toml::Value::Float(2.5));
        assert_eq!(word("direct"), toml::Value::String("direct".to_owned()));
    }

    #[test]
    fn a_window_is_gathered_whole_or_refused() {
        let cycles = |from: u64, more: bool| -> Cycles {
            let records: Vec<_> = (from..from + 3)
                .map(|n| {
                    serde_json::json!({
                        "loop": "l", "term": 1, "seq": n, "revision": 1, "digest": "", "owner": "a", "stepped_by": "a",
                        "at_unix_us": n, "dt_ms": 1.0, "mode": "automatic", "setpoint": 1.0, "measurement": 1.0,
                        "readings": [], "wanted": {}, "outputs": {}, "state_bytes": 0, "faults_in_row": 0,
                        "probation_cycles_left": null, "applied": [], "events": [], "alarms": [], "messages": [],
                        "log": [], "step_us": 1.0, "cycle_us": 1.0, "committed_after_us": 1.0,
                    })
                })
                .collect();
            let answer = serde_json::json!({ "loop": "l", "records": records, "more": more, "unread": 0 });
            serde_json::from_value(answer).unwrap()
        };
        let mut asked = Vec::new();
        let whole = gather("l", "5m", 1 << 20, |query| {
            asked.push(query.to_owned());
            let n = asked.len() as u64;
            Ok((cycles(3 * n, n < 2_000), 10))
        })
        .unwrap();
        assert_eq!((whole.records.len(), whole.more), (6_000, false));
        assert_eq!(asked[..2], ["last=5m", "from_unix_us=6"]);
        let refused = gather("l", "9d", 1 << 20, |_| Ok((cycles(0, true), 1 << 19))).unwrap_err();
        let said = refused.to_string();
        assert!(
            said.contains("the last 9d of l are more than the 1 MB") && said.contains("--last"),
            "{said}"
        );
        let few = gather("l", "1", 1 << 20, |_| {
            Ok((cycles(0, false), 10)).map(|(mut c, n): (Cycles, usize)| {
                c.records.truncate(1);
                (c, n)
            })
        });
        assert!(few.is_err());
    }

    #[test]
    fn a_controller_becomes_a_case_for_every_loop() {
        let text = r#"
            name = "t"
            duration_s = 1
            plant = { model = "pilot" }
            controller = { component = "pid" }
            [[loop]]
            name = "a"
            ports = {}
            period_ms = 100
            setpoint = [{ at_s = 0, to = 1 }]
            [[loop]]
            name = "b"
            controller = { component = "on-off" }
            ports = {}
            period_ms = 100
            setpoint = [{ at_s = 0, to = 1 }]
        "#;
        let (experiment, document) = Experiment::parse(text, "t").unwrap();
        let plan = Plan {
            place: "t".to_owned(),
            base: PathBuf::new(),
            experiment,
            document,
        };
        let one = case(&plan, "pidplus").unwrap();
        let set = one.get("set").unwrap().as_table().unwrap();
        assert_eq!(
            set.keys().collect::<Vec<_>>(),
            ["controller.component", "loop.1.controller.component"]
        );
        let other = case(&plan, "pidplus:k=2,action=direct").unwrap();
        assert_eq!(other["set"]["controller"]["parameters"]["k"], toml::Value::Integer(2));
        assert_eq!(
            other["name"],
            toml::Value::String("pidplus-k-2-action-direct".to_owned())
        );
        assert!(case(&plan, "pidplus:k").is_err());
    }
}
