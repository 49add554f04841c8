//! The documents of an OCI image layout, as far as a bundle needs them (image-spec 1.0, wasm artifacts).
//!
//! Owns: their shape and media types. Never: believes a size or digest in them; `bundle` checks each against the bytes.

use std::collections::BTreeMap;

use bumpless_core::{ComponentInfo, Descriptor};
use bumpless_trust::Signature;
use serde::{Deserialize, Serialize};

/// Says that a folder is an image layout.
pub(super) const LAYOUT: &str = "oci-layout";
/// Lists what is in it.
pub(super) const INDEX: &str = "index.json";
/// Where the contents are, by digest.
pub(super) const BLOBS: &str = "blobs/sha256/";

pub(super) const VERSION: &str = "1.0.0";
pub(super) const INDEX_TYPE: &str = "application/vnd.oci.image.index.v1+json";
pub(super) const MANIFEST_TYPE: &str = "application/vnd.oci.image.manifest.v1+json";
/// Config of a wasm artifact, as other tools for components write it.
pub(super) const CONFIG_TYPE: &str = "application/vnd.wasm.config.v0+json";
/// A component's bytes.
pub(super) const COMPONENT_TYPE: &str = "application/wasm";
/// `name@version`.
pub(super) const REF_NAME: &str = "org.opencontainers.image.ref.name";
/// What a tool that is not ours says about a component.
pub(super) const DESCRIPTION: &str = "org.opencontainers.image.description";

/// `oci-layout`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Layout {
    pub(super) image_layout_version: String,
}

/// What something is, and which bytes it has.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Content {
    pub(super) media_type: String,
    /// `sha256:` and 64 digits.
    pub(super) digest: String,
    pub(super) size: u64,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub(super) annotations: BTreeMap<String, String>,
}

/// `index.json`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Index {
    pub(super) schema_version: u32,
    #[serde(default)]
    pub(super) media_type: String,
    pub(super) manifests: Vec<Content>,
}

/// One component.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Manifest {
    pub(super) schema_version: u32,
    #[serde(default)]
    pub(super) media_type: String,
    pub(super) config: Content,
    pub(super) layers: Vec<Content>,
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub(super) annotations: BTreeMap<String, String>,
}

/// The config of a wasm artifact, with what the cell knows besides.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Config {
    #[serde(default)]
    pub(super) architecture: String,
    #[serde(default)]
    pub(super) os: String,
    #[serde(default)]
    pub(super) layer_digests: Vec<String>,
    #[serde(default)]
    pub(super) component: Option<Surface>,
    /// None in artifacts of other tools.
    #[serde(default)]
    pub(super) bumpless: Option<About>,
}

/// What a component offers and needs.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Surface {
    #[serde(default)]
    pub(super) exports: Vec<String>,
    #[serde(default)]
    pub(super) imports: Vec<String>,
    #[serde(default)]
    pub(super) target: Option<String>,
}

/// What people wrote about a component, and what it says of itself. The descriptor is for readers of the file: a host asks
/// the component again.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct About {
    pub(super) name: String,
    pub(super) version: String,
    #[serde(default)]
    pub(super) note: String,
    #[serde(default)]
    pub(super) labels: BTreeMap<String, String>,
    #[serde(default)]
    pub(super) uploaded_by: String,
    #[serde(default)]
    pub(super) uploaded_at_unix_ms: u64,
    #[serde(default)]
    pub(super) descriptor: Option<Descriptor>,
    #[serde(default)]
    pub(super) signatures: Vec<Signature>,
}

impl From<&ComponentInfo> for Config {
    fn from(info: &ComponentInfo) -> Self {
        Self {
            architecture: "wasm".to_owned(),
            // The only word that the artifact's specification has for components.
            os: "wasip2".to_owned(),
            layer_digests: vec![format!("sha256:{}", info.digest)],
            component: Some(Surface {
                exports: vec!["bumpless:control/control@0.1.0".to_owned()],
                imports: info.imports.clone(),
                target: Some(info.world.clone()),
            }),
            bumpless: Some(About {
                name: info.name.clone(),
                version: info.version.clone(),
                note: info.note.clone(),
                labels: info.labels.clone(),
                uploaded_by: info.uploaded_by.clone(),
                uploaded_at_unix_ms: info.uploaded_at_unix_ms,
                descriptor: Some(info.descriptor.clone()),
                signatures: Vec::new(),
            }),
        }
    }
}
