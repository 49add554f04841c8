//! What is known of a component beside what it says of itself: its trial, its history, where it is, bundles.

use std::collections::BTreeMap;

use bumpless_deploy as deploy;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Component, us};

/// What a component's trial at its upload found. Times are the component's own processor time on the host that tried it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Admission {
    /// `passed`, `warned`, `refused` (only in a dry run) or `forced`.
    pub verdict: String,
    /// When it was tried, in ms since 1970-01-01 UTC.
    pub checked_at_unix_ms: u64,
    /// The host that tried it.
    pub host: String,
    /// Cycles that were tried.
    pub cycles: u32,
    /// Good steps among them, which the times are of.
    pub steps: u32,
    /// Half of the steps took no longer, in µs.
    pub step_p50_us: f64,
    /// 99 of 100 steps took no longer, in µs.
    pub step_p99_us: f64,
    /// The longest step, in µs.
    pub step_worst_us: f64,
    /// Time of `start`, in µs.
    pub start_us: f64,
    /// What it did with a state of its own: `accepted`, `declined` or `untried`.
    pub migrated: String,
    /// Time of that `migrate`, in µs.
    pub migrate_us: f64,
    /// The largest state that it returned, in bytes.
    pub state_bytes: u64,
    /// Linear memory of its instance, in bytes.
    pub memory_bytes: u64,
    /// Time of the compilation, in ms; null where compiled code was at hand.
    pub compile_ms: Option<u64>,
    /// What was found, the gravest first.
    pub findings: Vec<AdmissionFinding>,
}

/// One thing that a trial found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct AdmissionFinding {
    /// `info`, `warning` or `refusal`.
    pub severity: String,
    /// What, in words.
    pub text: String,
}

impl From<bumpless_core::Admission> for Admission {
    fn from(report: bumpless_core::Admission) -> Self {
        Self {
            verdict: report.verdict.name().to_owned(),
            checked_at_unix_ms: report.checked_at_unix_ms,
            host: report.host.to_string(),
            cycles: report.cycles,
            steps: report.steps,
            step_p50_us: us(report.step_p50_ns),
            step_p99_us: us(report.step_p99_ns),
            step_worst_us: us(report.step_worst_ns),
            start_us: us(report.start_ns),
            migrated: report.migrated.name().to_owned(),
            migrate_us: us(report.migrate_ns),
            state_bytes: report.state_bytes,
            memory_bytes: report.memory_bytes,
            compile_ms: report.compile_ms,
            findings: report
                .findings
                .into_iter()
                .map(|finding| AdmissionFinding {
                    severity: match finding.severity {
                        bumpless_core::Severity::Info => "info",
                        bumpless_core::Severity::Warning => "warning",
                        bumpless_core::Severity::Refusal => "refusal",
                    }
                    .to_owned(),
                    text: finding.text,
                })
                .collect(),
        }
    }
}

/// One thing that happened to a component in the library.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ComponentEvent {
    /// When, in ms since 1970-01-01 UTC.
    pub at_unix_ms: u64,
    /// Who.
    pub by: String,
    /// What, in words.
    pub what: String,
}

/// A host and how far it is with a component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ComponentHost {
    /// The host.
    pub host: String,
    /// `nothing`, `bytes`, `compiling`, `ready`, `failed` or `unknown`.
    pub stage: String,
    /// Why it failed, or why nothing is known; empty otherwise.
    pub reason: String,
}

impl From<deploy::StageView> for ComponentHost {
    fn from(view: deploy::StageView) -> Self {
        let (stage, reason) = match view.stage {
            deploy::Stage::Nothing => ("nothing", String::new()),
            deploy::Stage::Bytes => ("bytes", String::new()),
            deploy::Stage::Compiling => ("compiling", String::new()),
            deploy::Stage::Ready => ("ready", String::new()),
            deploy::Stage::Failed(why) => ("failed", why),
            deploy::Stage::Unknown(why) => ("unknown", why),
        };
        Self {
            host: view.host.to_string(),
            stage: stage.to_owned(),
            reason,
        }
    }
}

/// A change of what people wrote about a component.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RelabelRequest {
    /// Another note; left out where it stays, empty to remove it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// Labels to set, and to remove where the value is null. A key has 1 to 64 lower-case letters, digits, dots, dashes,
    /// underscores and slashes; a value 1 to 64 characters without commas.
    #[serde(default)]
    pub labels: BTreeMap<String, Option<String>>,
    /// Who changes it, for people.
    #[serde(default)]
    pub by: String,
}

/// What became of the components of a bundle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Imports {
    /// In the bundle's order.
    pub components: Vec<Import>,
}

/// What became of one component of a bundle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Import {
    /// What the bundle calls it.
    pub name: String,
    /// `taken`, `known` (it was in the library before, and nothing changed) or `refused`.
    pub outcome: String,
    /// Why it was refused; empty otherwise.
    pub reason: String,
    /// What helps against that; may be empty.
    pub cure: String,
    /// The component; null where it was refused.
    pub component: Option<Component>,
}

impl From<deploy::Imported> for Import {
    fn from(end: deploy::Imported) -> Self {
        match end.end {
            Ok(info) => Self {
                name: end.name,
                outcome: if end.known { "known" } else { "taken" }.to_owned(),
                reason: String::new(),
                cure: String::new(),
                component: Some(Component::from(deploy::ComponentView {
                    info,
                    used_by: Vec::new(),
                    ready_on: Vec::new(),
                })),
            },
            Err(error) => Self {
                name: end.name,
                outcome: "refused".to_owned(),
                reason: error.words().reason.clone(),
                cure: error.words().cure.clone(),
                component: None,
            },
        }
    }
}
