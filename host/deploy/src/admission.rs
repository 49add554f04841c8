//! What a component must show before it comes in: its trial, the report about it, and what the report means for a loop.
//!
//! Owns: one trial at a time, on a thread of its own with the lowest priority; the verdict; the words of a refusal.
//! Never: runs anything on a cycle's thread, or lets a component see a point: its frames are made up.
//!
//! ```text
//! inspected, compiled ──trial──► findings ──► passed | warned ─────────► may come in
//!                                       └──► refused ──by force──► forced ──► may come in
//! ```

mod frames;
mod plant;
mod trial;

pub(crate) use plant::plant_descriptor;

/// What a program says of itself as the library keeps it.
pub(crate) fn program_descriptor(info: &bumpless_engine::ProgramInfo) -> bumpless_core::Descriptor {
    bumpless_core::Descriptor {
        name: info.name.clone(),
        version: info.version.clone(),
        text: info.text.clone(),
        ports: Vec::new(),
        parameters: Vec::new(),
        state_layout: 0,
    }
}

use std::{sync::Arc, time::Duration};

use bumpless_core::{
    Admission, ComponentInfo, Finding, Fit, HostId, LoopSpec, Severity, Verdict, admission::FINDINGS_MAX,
};
use bumpless_engine::{INTERFACES, Inspection, Prepared, PreparedPlant};
use tokio::{sync::oneshot, time::timeout};

use crate::{
    bench::stopping,
    error::{Error, Words},
    library::title,
    limits::{TRIAL_STACK_BYTES, TRIAL_WAIT},
    room::Room,
};

impl Room {
    /// Tries a component that was inspected. `compile_time` is none where compiled code was at hand.
    pub(crate) async fn tried(
        &self,
        prepared: Arc<Prepared>,
        imports: &[String],
        compile_time: Option<Duration>,
    ) -> Result<Admission, Error> {
        let imports = imports.to_vec();
        self.reported(imports, compile_time, move || trial::run(&prepared))
            .await
    }

    /// The same for a plant.
    pub(crate) async fn tried_plant(
        &self,
        prepared: Arc<PreparedPlant>,
        compile_time: Option<Duration>,
    ) -> Result<Admission, Error> {
        let imports = prepared.imports().to_vec();
        self.reported(imports, compile_time, move || plant::run(&prepared))
            .await
    }

    /// A trial in its turn, on a thread of its own, and its report.
    async fn reported(
        &self,
        imports: Vec<String>,
        compile_time: Option<Duration>,
        run: impl FnOnce() -> trial::Trial + Send + 'static,
    ) -> Result<Admission, Error> {
        let crowded = |_| {
            Error::busy(
                format!("other components are being tried at host {}", self.here),
                "try again",
            )
        };
        let _turn = timeout(TRIAL_WAIT, self.trials.acquire())
            .await
            .map_err(crowded)?
            .map_err(|_| stopping())?;
        let trial = on_own_thread(run).await?;
        Ok(report(
            &trial,
            self.here.clone(),
            &imports,
            compile_time,
            self.clock.unix_ms(),
        ))
    }
}

/// Tries a component as its upload would, outside of any cell: for its author. Blocks for as long as a trial lasts, and needs
/// 1 MiB of stack. `host` is who the report says that tried it, `at_unix_ms` when.
#[must_use]
pub fn examined(prepared: &Arc<Prepared>, inspection: &Inspection, host: HostId, at_unix_ms: u64) -> Admission {
    report(
        &trial::run(prepared),
        host,
        &inspection.imports,
        inspection.compile_time,
        at_unix_ms,
    )
}

/// Runs work on a thread of its own that any other work may hold up.
async fn on_own_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Error> {
    let (sender, receiver) = oneshot::channel();
    std::thread::Builder::new()
        .name("bl-trial".to_owned())
        .stack_size(TRIAL_STACK_BYTES)
        .spawn(move || {
            // On Linux this is the thread's own; without it the trial is only less polite.
            if let Err(error) = rustix::process::setpriority_process(None, 19) {
                tracing::debug!(%error, "the priority of a trial stays as it is");
            }
            // Whoever asked may have gone.
            let _ = sender.send(work());
        })
        .map_err(|error| {
            Error::Internal(Words::new(
                format!("the thread of a trial cannot be started: {error}"),
                "check the limits on threads and memory of this machine",
            ))
        })?;
    receiver
        .await
        .map_err(|_| Error::internal("the trial of a component ended badly"))
}

fn report(
    trial: &trial::Trial,
    host: HostId,
    imports: &[String],
    compile_time: Option<Duration>,
    checked_at_unix_ms: u64,
) -> Admission {
    let mut findings = trial.findings.clone();
    let names: Vec<&str> = imports.iter().map(|import| interface(import)).collect();
    findings.push(Finding {
        severity: Severity::Info,
        text: format!(
            "it imports {} of the {} interfaces that a controller may be granted: {}",
            names.len(),
            INTERFACES.len(),
            if names.is_empty() {
                "none".to_owned()
            } else {
                names.join(", ")
            }
        )
        .chars()
        .take(bumpless_core::limits::TEXT_CHARS_MAX)
        .collect(),
    });
    findings.truncate(FINDINGS_MAX);
    let worst = findings.iter().map(|finding| finding.severity).max();
    Admission {
        checked_at_unix_ms,
        host,
        verdict: match worst {
            Some(Severity::Refusal) => Verdict::Refused,
            Some(Severity::Warning) => Verdict::Warned,
            _ => Verdict::Passed,
        },
        cycles: trial.cycles,
        steps: u32::try_from(trial.steps_ns.len()).unwrap_or(u32::MAX),
        step_p50_ns: trial.percentile_ns(50),
        step_p99_ns: trial.percentile_ns(99),
        step_worst_ns: trial.percentile_ns(100),
        start_ns: trial.start_ns,
        migrated: trial.migrated,
        migrate_ns: trial.migrate_ns,
        state_bytes: trial.state_bytes,
        memory_bytes: trial.memory_bytes,
        compile_ms: compile_time.map(|time| u64::try_from(time.as_millis()).unwrap_or(u64::MAX)),
        findings,
    }
}

/// Lets a component in by its report, or by force; or says why not.
pub(crate) fn let_in(mut admission: Admission, name: &str, force: bool, by: &str) -> Result<Admission, Error> {
    if admission.verdict != Verdict::Refused {
        return Ok(admission);
    }
    if !force {
        let reasons: Vec<&str> = admission.of(Severity::Refusal).collect();
        return Err(Error::invalid(
            format!("component {name} failed its trial: {}", reasons.join("; ")),
            "mend it; a dry run shows the whole report, and force takes it in nevertheless",
        ));
    }
    admission.verdict = Verdict::Forced;
    admission.findings.insert(
        0,
        Finding {
            severity: Severity::Warning,
            text: format!("taken in by force by {by}").chars().take(256).collect(),
        },
    );
    admission.findings.truncate(FINDINGS_MAX);
    Ok(admission)
}

/// The short name of an interface: `bumpless:control/net@0.1.0` is `net`.
fn interface(import: &str) -> &str {
    let name = import.rsplit('/').next().unwrap_or(import);
    name.split('@').next().unwrap_or(name)
}

/// What a person should know before a component runs a loop; or why it may not.
pub(crate) fn warnings(info: &ComponentInfo, spec: &LoopSpec, ran_before: bool) -> Result<Vec<String>, Error> {
    let mut warnings = step_warnings(info, spec, ran_before)?;
    warnings.extend(grant_warnings(info, spec));
    warnings.extend(late_limit(spec));
    Ok(warnings)
}

/// A step limit so long that the home looks for another owner before a step that never ends is stopped: then probation cannot
/// lead back within that cycle.
fn late_limit(spec: &LoopSpec) -> Option<String> {
    let (limit_us, takeover_us) = (
        spec.step_limit_ns() as f64 / 1e3,
        spec.period_ns as f64 * spec.policy.takeover_part / 1e3,
    );
    (limit_us >= takeover_us).then(|| {
        format!(
            "policy.step_limit_us = {limit_us:.0} lasts beyond the time at which a cycle is overdue, {takeover_us:.0} µs: a step \
             that never ends is gone back from in a later cycle, not in its own"
        )
    })
}

/// Where the loop grants what the component does not ask for. Points are granted by the ports, alarms and log lines to everyone;
/// what a loop grants by its own choice are the topics that it listens to. A component that could listen and is granted no topic
/// is no mistake: the stock laws join a chain of loops only where they are told to.
fn grant_warnings(info: &ComponentInfo, spec: &LoopSpec) -> Option<String> {
    let imports_net = info.imports.iter().any(|import| interface(import) == "net");
    let (title, id) = (title(info), &spec.id);
    (!imports_net && !spec.listens.is_empty()).then(|| {
        format!(
            "loop {id} listens to {}, and {title} does not import net: it will never see these messages",
            spec.listens.join(", ")
        )
    })
}

/// What a component's measured steps mean for a loop: words of warning, or a refusal. A loop that ran it before within
/// this limit is only warned: going back must always be possible.
fn step_warnings(info: &ComponentInfo, spec: &LoopSpec, ran_before: bool) -> Result<Vec<String>, Error> {
    let Some(admission) = &info.admission else {
        return Ok(Vec::new());
    };
    let limit_ns = spec.step_limit_ns();
    let us = |ns: u64| ns as f64 / 1e3;
    let (p99, worst, limit) = (us(admission.step_p99_ns), us(admission.step_worst_ns), us(limit_ns));
    let host = &admission.host;
    match admission.fit(limit_ns) {
        Fit::Fits => Ok(Vec::new()),
        Fit::Beyond if !ran_before => Err(Error::refused(
            format!(
                "{} is too slow for loop {}: its longest step took {worst:.1} µs in its trial on host {host} (99 of 100 took \
                 at most {p99:.1} µs), and the loop's limit is {limit:.1} µs",
                title(info),
                spec.id
            ),
            "raise policy.step_limit_us or the period, or use a faster component",
        )),
        Fit::Near | Fit::Beyond => Ok(vec![format!(
            "the longest step of {} took {worst:.1} µs in its trial on host {host}; the loop's limit is {limit:.1} µs",
            title(info)
        )]),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

    use bumpless_core::Migrated;

    use super::*;

    fn trial(findings: &[(Severity, &str)]) -> trial::Trial {
        trial::Trial {
            cycles: 100,
            steps_ns: (1..=200).map(|n| n * 100).collect(),
            start_ns: 5,
            migrated: Migrated::Accepted,
            migrate_ns: 6,
            state_bytes: 7,
            memory_bytes: 8,
            findings: findings
                .iter()
                .map(|(severity, text)| Finding {
                    severity: *severity,
                    text: (*text).to_owned(),
                })
                .collect(),
        }
    }

    fn admission(findings: &[(Severity, &str)]) -> Admission {
        let imports = [
            "bumpless:control/io@0.1.0".to_owned(),
            "bumpless:control/log@0.1.0".to_owned(),
        ];
        report(
            &trial(findings),
            HostId::new("h").unwrap(),
            &imports,
            Some(Duration::from_millis(12)),
            1,
        )
    }

    #[test]
    fn the_gravest_finding_is_the_verdict() {
        let passed = admission(&[]);
        assert_eq!((passed.verdict, passed.findings.len()), (Verdict::Passed, 1));
        assert!(
            passed
                .findings
                .iter()
                .any(|f| f.text.ends_with("may be granted: io, log"))
        );
        assert_eq!(
            (
                passed.step_p50_ns,
                passed.step_p99_ns,
                passed.step_worst_ns,
                passed.steps
            ),
            (10_000, 19_800, 20_000, 200)
        );
        assert_eq!((passed.compile_ms, passed.check()), (Some(12), Ok(())));
        assert_eq!(admission(&[(Severity::Warning, "w")]).verdict, Verdict::Warned);
        let refused = admission(&[(Severity::Refusal, "it trapped"), (Severity::Warning, "w")]);
        assert_eq!(refused.verdict, Verdict::Refused);
        assert_eq!(admission(&[]).step_p99_ns, 19_800);
    }

    #[test]
    fn a_refusal_says_why_and_force_is_written_down() {
        let refused = admission(&[(Severity::Refusal, "it trapped"), (Severity::Warning, "w")]);
        let error = let_in(refused.clone(), "law@1.0.0", false, "ann").expect_err("refused");
        assert!(
            matches!(&error, Error::Invalid(w) if w.reason == "component law@1.0.0 failed its trial: it trapped"),
            "{error:?}"
        );
        let forced = let_in(refused, "law@1.0.0", true, "ann").unwrap();
        assert_eq!(forced.verdict, Verdict::Forced);
        assert_eq!(forced.findings.first().unwrap().text, "taken in by force by ann");
        let passed = let_in(admission(&[]), "law@1.0.0", true, "ann").unwrap();
        assert_eq!(
            passed.verdict,
            Verdict::Passed,
            "force that was not needed leaves no mark"
        );
    }
}
