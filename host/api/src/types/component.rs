//! Components of the library.

use std::collections::BTreeMap;

use bumpless_deploy::ComponentView;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Admission, ComponentEvent, ComponentHost, Direction, PortKind};

/// The library, by name and version.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Components {
    /// The components.
    pub components: Vec<Component>,
    /// Where the next part begins, where there are more: ask again with `after` set to it. The header `Link` has the address.
    #[serde(default)]
    pub next: Option<String>,
}

/// One uploaded component and where it stands.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Component {
    /// SHA-256 of its bytes, 64 hexadecimal digits: its only name.
    pub digest: String,
    /// The algorithm's name.
    pub name: String,
    /// The algorithm's semantic version.
    pub version: String,
    /// One line for people.
    pub text: String,
    /// Ports, by number.
    pub ports: Vec<Port>,
    /// Parameters, in order.
    pub parameters: Vec<Parameter>,
    /// Version of the layout of its state.
    pub state_layout: u32,
    /// The world that it was taken in for.
    pub world: String,
    /// Interfaces that it imports.
    pub imports: Vec<String>,
    /// Its size in bytes.
    pub size_bytes: u64,
    /// When it was uploaded, in ms since 1970-01-01 UTC.
    pub uploaded_at_unix_ms: u64,
    /// Who uploaded it.
    pub uploaded_by: String,
    /// What people wrote about it.
    pub note: String,
    /// What it is sorted by.
    pub labels: BTreeMap<String, String>,
    /// The last things that happened to it, the newest last.
    pub history: Vec<ComponentEvent>,
    /// What its trial found; null where it had none.
    pub admission: Option<Admission>,
    /// Loops that run it, or keep it to go back to.
    pub used_by: Vec<String>,
    /// Hosts that hold it compiled.
    pub ready_on: Vec<String>,
    /// How far each host is with it; only where one component is asked for, null otherwise.
    #[serde(default)]
    pub hosts: Option<Vec<ComponentHost>>,
}

/// One named value that a component reads or writes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Port {
    /// Short name.
    pub name: String,
    /// Which way its values flow.
    pub direction: Direction,
    /// What its numbers mean.
    pub kind: PortKind,
    /// Unit as text; empty for none.
    pub unit: String,
    /// Must a loop connect it?
    pub required: bool,
    /// One line for people.
    pub text: String,
}

/// One named number that tunes a component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Parameter {
    /// Short name.
    pub name: String,
    /// Unit as text; empty for none.
    pub unit: String,
    /// Value where the loop sets none.
    pub default: f64,
    /// Least value allowed.
    pub minimum: f64,
    /// Greatest value allowed.
    pub maximum: f64,
    /// Where not empty, the value is an index into these words.
    pub choices: Vec<String>,
    /// One line for people.
    pub text: String,
}

impl From<ComponentView> for Component {
    fn from(view: ComponentView) -> Self {
        let ComponentView {
            info,
            used_by,
            ready_on,
            ..
        } = view;
        Self {
            digest: info.digest.to_string(),
            name: info.name,
            version: info.version,
            text: info.descriptor.text,
            ports: info
                .descriptor
                .ports
                .into_iter()
                .map(|p| Port {
                    name: p.name,
                    direction: p.direction.into(),
                    kind: p.kind.into(),
                    unit: p.unit,
                    required: p.required,
                    text: p.text,
                })
                .collect(),
            parameters: info
                .descriptor
                .parameters
                .into_iter()
                .map(|p| Parameter {
                    name: p.name,
                    unit: p.unit,
                    default: p.default,
                    minimum: p.minimum,
                    maximum: p.maximum,
                    choices: p.choices,
                    text: p.text,
                })
                .collect(),
            state_layout: info.descriptor.state_layout,
            world: info.world,
            imports: info.imports,
            size_bytes: info.bytes,
            uploaded_at_unix_ms: info.uploaded_at_unix_ms,
            uploaded_by: info.uploaded_by,
            note: info.note,
            labels: info.labels,
            history: info
                .history
                .into_iter()
                .map(|event| ComponentEvent {
                    at_unix_ms: event.at_unix_ms,
                    by: event.by,
                    what: event.what,
                })
                .collect(),
            admission: info.admission.map(Into::into),
            used_by: used_by.iter().map(ToString::to_string).collect(),
            ready_on: ready_on.iter().map(ToString::to_string).collect(),
            hosts: None,
        }
    }
}
