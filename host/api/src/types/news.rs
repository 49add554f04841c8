//! What happens to points, jobs and standbys, as the live feed tells it.
//!
//! Never: judges.

use bumpless_deploy::commissioning::FieldEvent;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Force, Job, finite};

/// What happened to a point or a job: the data of the live feed's `field` events.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "kebab-case")]
pub enum FieldNews {
    /// A job was taken in, began, or ended; without its result.
    Job(Job),
    /// A point is held at a value.
    Forced(PointForced),
    /// A point is held no more.
    Unforced(PointUnforced),
    /// A point was written by hand.
    Written(PointWritten),
    /// A host that stands by for another's device can take it over no more, or can again.
    Standby(StandbyTold),
}

/// A point is held at a value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PointForced {
    /// The point.
    pub point: String,
    /// Its host.
    pub host: String,
    /// The value, by whom, why and until when.
    pub force: Force,
}

/// A point is held no more.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PointUnforced {
    /// The point.
    pub point: String,
    /// Its host.
    pub host: String,
    /// By whom, or that its time was over.
    pub by: String,
}

/// A point was written by hand.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PointWritten {
    /// The point.
    pub point: String,
    /// Its host.
    pub host: String,
    /// The value.
    pub value: Option<f64>,
    /// By whom.
    pub by: String,
}

/// A host that stands by for another's device can take it over no more, or can again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct StandbyTold {
    /// The bus.
    pub bus: String,
    /// The host that stands by.
    pub host: String,
    /// The one that it stands by for.
    pub with: String,
    /// It could take over.
    pub ready: bool,
    /// Why not; empty where it could.
    pub reason: String,
}

impl From<FieldEvent> for FieldNews {
    fn from(event: FieldEvent) -> Self {
        match event {
            FieldEvent::Job(view) => Self::Job(view.into()),
            FieldEvent::Forced { point, host, force } => Self::Forced(PointForced {
                point: point.to_string(),
                host: host.to_string(),
                force: force.into(),
            }),
            FieldEvent::Unforced { point, host, by } => Self::Unforced(PointUnforced {
                point: point.to_string(),
                host: host.to_string(),
                by,
            }),
            FieldEvent::Written { point, host, value, by } => Self::Written(PointWritten {
                point: point.to_string(),
                host: host.to_string(),
                value: finite(value),
                by,
            }),
            FieldEvent::Standby {
                bus,
                host,
                with,
                ready,
                reason,
            } => Self::Standby(StandbyTold {
                bus,
                host: host.to_string(),
                with: with.to_string(),
                ready,
                reason,
            }),
        }
    }
}
