//! Hosts and points.

use bumpless_deploy::{DrainEnd, HealthView, HostView, PointView};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Force, Quality, finite, ms};

/// The hosts of the cell, by name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Hosts {
    /// The hosts.
    pub hosts: Vec<Host>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

/// A host as the one that answers sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Host {
    /// Its name.
    pub name: String,
    /// Is it the one that answers?
    pub here: bool,
    /// Is it alive?
    pub alive: bool,
    /// Does it serve I/O?
    pub io: bool,
    /// Does it run controllers?
    pub control: bool,
    /// Is it being emptied?
    pub draining: bool,
    /// Does it stay so over a restart?
    #[serde(default)]
    pub drain_kept: bool,
    /// Words that it goes by besides its name, for what loops prefer.
    #[serde(default)]
    pub labels: Vec<String>,
    /// Address of its API.
    pub api: Option<String>,
    /// Load of the cores that it may use, in %.
    pub cpu_percent: f64,
    /// Its own use, in cores.
    pub cpu_process_cores: f64,
    /// Resident bytes.
    pub memory_bytes: u64,
    /// Smoothed latency of a step there, as the answering host measures it, in ms.
    pub latency_ms: Option<f64>,
    /// Loops that it owns now.
    pub loops_owned: u32,
    /// Loops that it holds: owned, or ready to take over.
    pub loops_held: u32,
    /// Version of its program.
    pub version: String,
}

impl From<HostView> for Host {
    fn from(view: HostView) -> Self {
        Self {
            name: view.id.to_string(),
            here: view.here,
            alive: view.alive,
            io: view.io,
            control: view.control,
            draining: view.draining,
            drain_kept: view.drain_kept,
            labels: view.labels,
            api: view.api,
            cpu_percent: rounded(f64::from(view.cpu) * 100.0),
            cpu_process_cores: rounded(f64::from(view.cpu_process)),
            memory_bytes: view.memory_bytes,
            latency_ms: view.latency_ns.map(ms),
            loops_owned: view.loops_owned,
            loops_held: view.loops_held,
            version: view.version,
        }
    }
}

/// The process answers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Alive {
    /// The host.
    pub host: String,
    /// Always true: what is not alive does not answer.
    pub alive: bool,
}

/// How well a host is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Health {
    /// The host.
    pub host: String,
    /// May work be sent to it? All checks hold.
    pub ready: bool,
    /// For how long its process runs, in s.
    pub up_s: f64,
    /// Each thing that must hold.
    pub checks: Vec<HealthCheck>,
}

/// One thing that must hold before work is sent to a host.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct HealthCheck {
    /// `bus`, `cell`, `store`, `service` (it is not being emptied) or `io`.
    pub name: String,
    /// Does it hold?
    pub good: bool,
    /// How it stands, in words.
    pub text: String,
}

impl From<HealthView> for Health {
    fn from(view: HealthView) -> Self {
        Self {
            host: view.host.to_string(),
            ready: view.ready,
            up_s: view.up_ms as f64 / 1e3,
            checks: view
                .checks
                .into_iter()
                .map(|check| HealthCheck {
                    name: check.name,
                    good: check.good,
                    text: check.text,
                })
                .collect(),
        }
    }
}

/// Empties a host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DrainRequest {
    /// Shall it stay empty over a restart, until it is undrained?
    pub keep: bool,
}

/// How far a host is with being emptied, or filled again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Drain {
    /// The host.
    pub host: String,
    /// Is it being emptied?
    pub draining: bool,
    /// Does that hold over a restart?
    pub kept: bool,
    /// Loops that it still owns. After an order to drain, more than none means: nobody else can take them, or their next
    /// cycle is yet to come.
    pub loops_owned: u32,
    /// Loops that it holds: owned, or ready to take over.
    pub loops_held: u32,
    /// Does it hold all that it shall?
    pub ready: bool,
}

impl From<DrainEnd> for Drain {
    fn from(end: DrainEnd) -> Self {
        Self {
            host: end.host.to_string(),
            draining: end.draining,
            kept: end.kept,
            loops_owned: end.loops_owned,
            loops_held: end.loops_held,
            ready: end.ready,
        }
    }
}

/// Three decimals: a sampled load has no more.
fn rounded(value: f64) -> f64 {
    finite((value * 1e3).round() / 1e3).unwrap_or_default()
}

/// The points of all hosts, by name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Points {
    /// The points.
    pub points: Vec<Point>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

/// A point as its I/O host sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Point {
    /// Its name.
    pub name: String,
    /// Its I/O host.
    pub host: String,
    /// Its bus.
    pub bus: String,
    /// Unit.
    pub unit: String,
    /// Least and greatest value.
    pub range: [f64; 2],
    /// May it be written?
    pub writable: bool,
    /// Value now, or the last good one.
    pub value: Option<f64>,
    /// How far it may be trusted.
    pub quality: Quality,
    /// Why there is no value; empty where there is one.
    pub reason: String,
    /// Age of the value, in ms.
    pub age_ms: u64,
    /// The loop that writes it.
    pub written_by: Option<String>,
    /// One line for people.
    pub text: String,
    /// Who holds it at its value by hand; null where nobody does.
    pub force: Option<Force>,
}

impl From<PointView> for Point {
    fn from(view: PointView) -> Self {
        Self {
            name: view.id.to_string(),
            host: view.host.to_string(),
            bus: view.bus,
            unit: view.unit,
            range: [view.range.0, view.range.1],
            writable: view.writable,
            value: view.value.and_then(finite),
            quality: view.quality.into(),
            reason: view.reason,
            age_ms: view.age_ms,
            written_by: view.written_by.map(Into::into),
            text: view.text,
            force: view.force.map(Into::into),
        }
    }
}
