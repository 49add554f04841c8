//! `components label | note | export | import`, the report of a trial, and the wait until every host has a component.
//!
//! Never: decides; what the cell refuses is an error with the cell's own words.

use std::{
    collections::BTreeMap,
    fs,
    io::IsTerminal as _,
    path::Path,
    time::{Duration, Instant},
};

use bumpless_api::types::{Admission, Component, ComponentHost, Imports, RelabelRequest};
use bumpless_deploy::limits::BUNDLE_BYTES_MAX;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

use crate::{
    client::{Client, encoded},
    error::Error,
    show,
};

/// Longest wait until every host has a component: a minute in each compiler, and others before it.
const WAIT_MAX: Duration = Duration::from_secs(180);
/// Pause between two looks: a host takes some 100 ms for a small component.
const LOOK_EVERY: Duration = Duration::from_millis(300);
/// Steps from nothing to ready.
const STEPS: u64 = 3;

/// Who types, for the cell's history; empty where the system does not say.
pub(crate) fn me() -> String {
    std::env::var("USER").unwrap_or_default()
}

/// Sets or removes labels, or writes a note.
pub(crate) fn relabel(
    client: &Client,
    json: bool,
    component: &str,
    labels: Vec<(String, Option<String>)>,
    note: Option<String>,
) -> Result<(), Error> {
    let request = RelabelRequest {
        note,
        labels: labels.into_iter().collect(),
        by: me(),
    };
    let answer = client.patch(&format!("/v1/components/{}", encoded(component)), &request)?;
    if json {
        return show::json(&answer.text);
    }
    let component: Component = answer.decode()?;
    show::line(&format!(
        "{}@{}: {}{}",
        component.name,
        component.version,
        labels_line(&component.labels),
        if component.note.is_empty() {
            String::new()
        } else {
            format!(" – {}", component.note)
        }
    ))
}

/// `line=3, stage=pilot`, or "no labels".
pub(crate) fn labels_line(labels: &BTreeMap<String, String>) -> String {
    if labels.is_empty() {
        return "no labels".to_owned();
    }
    let labels: Vec<String> = labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    labels.join(", ")
}

/// Writes components into a file.
pub(crate) fn export(client: &Client, components: &[String], output: &Path) -> Result<(), Error> {
    let names: Vec<String> = components.iter().map(|name| encoded(name)).collect();
    let path = if names.is_empty() {
        "/v1/bundle".to_owned()
    } else {
        format!("/v1/bundle?components={}", names.join(","))
    };
    let bytes = client.bytes(&path, BUNDLE_BYTES_MAX as u64 + 1)?;
    fs::write(output, &bytes).map_err(|source| Error::File {
        path: output.to_owned(),
        action: "written",
        source,
    })?;
    show::line(&format!("{} ({})", output.display(), show::size(bytes.len() as u64)))
}

/// Takes in what a file holds.
pub(crate) fn import(client: &Client, json: bool, file: &Path, force: bool) -> Result<(), Error> {
    let failed = |source| Error::File {
        path: file.to_owned(),
        action: "read",
        source,
    };
    let mut opened = fs::File::open(file).map_err(failed)?;
    let length = opened.metadata().map_err(failed)?.len();
    if length > BUNDLE_BYTES_MAX as u64 {
        let path = file.display();
        return Err(Error::Usage(format!(
            "{path} has {length} bytes; a bundle has at most {BUNDLE_BYTES_MAX}"
        )));
    }
    let path = format!("/v1/bundle?force={force}&by={}", encoded(&me()));
    let answer = client.send_file(&path, "application/x-tar", length, &mut opened)?;
    let imports: Imports = answer.decode()?;
    if json {
        show::json(&answer.text)?;
    } else {
        let mut table = show::table(&["component", "outcome", "trial", "why"]);
        for import in &imports.components {
            let report = import.component.as_ref().and_then(|c| c.admission.as_ref());
            table.add_row([
                import.name.clone(),
                import.outcome.clone(),
                report.map(|report| report.verdict.clone()).unwrap_or_default(),
                [&*import.reason, &*import.cure]
                    .join("; ")
                    .trim_matches(&[';', ' '][..])
                    .to_owned(),
            ]);
        }
        show::print(&table)?;
    }
    let refused: Vec<&str> = imports
        .components
        .iter()
        .filter(|import| import.outcome == "refused")
        .map(|import| import.name.as_str())
        .collect();
    if refused.is_empty() {
        Ok(())
    } else {
        Err(Error::Refused(format!(
            "{} of {} components were not taken in: {}",
            refused.len(),
            imports.components.len(),
            refused.join(", ")
        )))
    }
}

/// A time in µs as people read it.
fn time(us: f64) -> String {
    if us < 1_000.0 {
        format!("{us:.1} µs")
    } else {
        format!("{:.2} ms", us / 1e3)
    }
}

/// The report of a trial, in lines for people.
pub(crate) fn report(report: &Admission) -> Vec<String> {
    let compiled = report
        .compile_ms
        .map_or_else(|| "compiled before".to_owned(), |ms| format!("compiled in {ms} ms"));
    let mut lines = vec![
        format!(
            "trial     {}: {} cycles on host {}, {compiled}",
            report.verdict, report.cycles, report.host
        ),
        format!(
            "step      half within {}, 99 % within {}, longest {} ({} steps, processor time)",
            time(report.step_p50_us),
            time(report.step_p99_us),
            time(report.step_worst_us),
            report.steps
        ),
        format!(
            "start     {}; its own state is {}{}",
            time(report.start_us),
            match report.migrated.as_str() {
                "accepted" => "taken over",
                "declined" => "declined",
                _ => "not tried",
            },
            if report.migrate_us > 0.0 {
                format!(" in {}", time(report.migrate_us))
            } else {
                String::new()
            }
        ),
        format!(
            "memory    {}, state {}",
            show::size(report.memory_bytes),
            show::size(report.state_bytes)
        ),
    ];
    lines.extend(
        report
            .findings
            .iter()
            .map(|finding| format!("{:<9} {}", finding.severity, finding.text)),
    );
    lines
}

/// How far a stage is on the way to ready.
fn position(stage: &str) -> u64 {
    match stage {
        "bytes" => 1,
        "compiling" => 2,
        "ready" => STEPS,
        _ => 0,
    }
}

/// `compiling`, or `failed: no memory`.
pub(crate) fn stage_line(host: &ComponentHost) -> String {
    if host.reason.is_empty() {
        host.stage.clone()
    } else {
        format!("{}: {}", host.stage, host.reason)
    }
}

/// Waits until every host has a component ready, and shows how far each is: as bars where somebody looks, as lines elsewhere.
pub(crate) fn wait(client: &Client, digest: &str) -> Result<(), Error> {
    let until = Instant::now() + WAIT_MAX;
    let bars = MultiProgress::new();
    let looked_at = std::io::stderr().is_terminal();
    let mut shown: BTreeMap<String, (ProgressBar, String)> = BTreeMap::new();
    loop {
        let component: Component = client.get(&format!("/v1/components/{digest}"))?.decode()?;
        let hosts = component.hosts.unwrap_or_default();
        for host in &hosts {
            let line = stage_line(host);
            let (bar, last) = shown.entry(host.host.clone()).or_insert_with(|| {
                let bar = if looked_at {
                    bars.add(ProgressBar::new(STEPS))
                } else {
                    ProgressBar::hidden()
                };
                if let Ok(style) = ProgressStyle::with_template("{prefix:>12} {bar:24} {msg}") {
                    bar.set_style(style);
                }
                bar.set_prefix(host.host.clone());
                (bar, String::new())
            });
            bar.set_position(position(&host.stage));
            bar.set_message(line.clone());
            if !looked_at && *last != line {
                show::note(&format!("{}: {line}", host.host));
            }
            *last = line;
        }
        if !hosts.is_empty() && hosts.iter().all(|host| host.stage == "ready") {
            for (bar, _) in shown.values() {
                bar.finish();
            }
            return Ok(());
        }
        let waiting = || {
            let late = hosts.iter().filter(|host| host.stage != "ready");
            late.map(|host| format!("{} ({})", host.host, stage_line(host)))
                .collect::<Vec<_>>()
                .join(", ")
        };
        let all_ended = hosts
            .iter()
            .all(|host| matches!(host.stage.as_str(), "ready" | "failed"));
        if !hosts.is_empty() && all_ended || Instant::now() >= until {
            for (bar, _) in shown.values() {
                bar.abandon();
            }
            return Err(Error::Unready(format!("not every host has it ready: {}", waiting())));
        }
        std::thread::sleep(LOOK_EVERY);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use bumpless_api::types::AdmissionFinding;

    use super::*;

    #[test]
    fn a_report_is_read_in_a_few_lines() {
        let admission = Admission {
            verdict: "warned".into(),
            checked_at_unix_ms: 0,
            host: "plant".into(),
            cycles: 473,
            steps: 316,
            step_p50_us: 1.25,
            step_p99_us: 2.5,
            step_worst_us: 1_500.0,
            start_us: 4.0,
            migrated: "accepted".into(),
            migrate_us: 3.0,
            state_bytes: 48,
            memory_bytes: 1_114_112,
            compile_ms: Some(210),
            findings: vec![AdmissionFinding {
                severity: "warning".into(),
                text: "it never wrote an output".into(),
            }],
        };
        assert_eq!(
            report(&admission),
            [
                "trial     warned: 473 cycles on host plant, compiled in 210 ms",
                "step      half within 1.2 µs, 99 % within 2.5 µs, longest 1.50 ms (316 steps, processor time)",
                "start     4.0 µs; its own state is taken over in 3.0 µs",
                "memory    1.1 MiB, state 48 B",
                "warning   it never wrote an output",
            ]
        );
    }

    #[test]
    fn a_host_is_ready_at_the_end_of_its_bar() {
        let places: Vec<u64> = ["nothing", "bytes", "compiling", "ready", "failed"]
            .map(position)
            .to_vec();
        assert_eq!(places, [0, 1, 2, STEPS, 0]);
        let failed = ComponentHost {
            host: "a".into(),
            stage: "failed".into(),
            reason: "no memory".into(),
        };
        assert_eq!(stage_line(&failed), "failed: no memory");
    }
}
