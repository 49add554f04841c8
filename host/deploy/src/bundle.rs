//! Components in a file, for plants without a network: an OCI image layout in a tar.
//!
//! Owns: what is in the file, and the check of every digest and size in it.
//! Never: writes a file, unpacks to a disk, or takes anything in; what comes out goes through the same admission as an
//! upload.
//!
//! ```text
//! oci-layout      index.json ──► blobs/sha256/MANIFEST ──┬─► blobs/sha256/CONFIG     note, labels, descriptor
//!                   (one entry per component)            └─► blobs/sha256/COMPONENT  the bytes, by their digest
//! ```

mod oci;

use std::{collections::BTreeMap, io::Cursor};

use bumpless_core::{ComponentInfo, Digest, limits::COMPONENT_BYTES_MAX};
use bumpless_trust::{SIGNATURES_MAX, Signature};
use serde::{Serialize, de::DeserializeOwned};

use crate::{
    error::Error,
    library::title,
    limits::{BUNDLE_BYTES_MAX, BUNDLE_COMPONENTS_MAX, BUNDLE_DOCUMENT_BYTES_MAX, BUNDLE_ENTRIES_MAX},
};
use oci::{
    BLOBS, COMPONENT_TYPE, CONFIG_TYPE, Config, Content, DESCRIPTION, INDEX, INDEX_TYPE, Index, LAYOUT, Layout,
    MANIFEST_TYPE, Manifest, REF_NAME, VERSION,
};

/// One component of a bundle, with every digest checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Parcel {
    pub(crate) digest: Digest,
    pub(crate) bytes: Vec<u8>,
    pub(crate) note: String,
    pub(crate) labels: BTreeMap<String, String>,
    /// As they stand in the file; whoever takes them in judges them.
    pub(crate) signatures: Vec<Signature>,
}

/// Signatures of components.
pub(crate) type Signed = BTreeMap<Digest, Vec<Signature>>;

/// One entry of a bundle: what it is called there, and what it is or why it is nothing.
pub(crate) type Entry = (String, Result<Parcel, Error>);

/// A file of the layout.
struct Files(Vec<(String, Vec<u8>)>);

impl Files {
    /// Keeps bytes under their digest; gives what a document says about them.
    fn blob(&mut self, media_type: &str, bytes: Vec<u8>) -> Content {
        let digest = Digest::of(&bytes);
        let content = Content {
            media_type: media_type.to_owned(),
            digest: format!("sha256:{digest}"),
            size: bytes.len() as u64,
            annotations: BTreeMap::new(),
        };
        let path = format!("{BLOBS}{digest}");
        if self.0.iter().all(|(known, _)| *known != path) {
            self.0.push((path, bytes));
        }
        content
    }
}

fn json<T: Serialize>(value: &T) -> Result<Vec<u8>, Error> {
    serde_json::to_vec_pretty(value)
        .map_err(|error| Error::internal(format!("a document of a bundle cannot be written: {error}")))
}

/// The file with these components. The same components give the same bytes.
///
/// # Errors
/// [`Error::Invalid`] for none, too many, or more than 128 MiB.
pub(crate) fn pack(components: Vec<(ComponentInfo, Vec<u8>)>, signed: &Signed) -> Result<Vec<u8>, Error> {
    if components.is_empty() || components.len() > BUNDLE_COMPONENTS_MAX {
        return Err(Error::invalid(
            format!(
                "{} components: a bundle holds 1 to {BUNDLE_COMPONENTS_MAX}",
                components.len()
            ),
            "name others",
        ));
    }
    let size: usize = components.iter().map(|(_, bytes)| bytes.len()).sum();
    let too_big = |size: usize| {
        Error::invalid(
            format!("{size} bytes: a bundle has at most {BUNDLE_BYTES_MAX}"),
            "make several bundles",
        )
    };
    if size >= BUNDLE_BYTES_MAX {
        return Err(too_big(size));
    }
    let mut files = Files(Vec::new());
    let mut manifests = Vec::new();
    for (info, bytes) in components {
        let mut config = Config::from(&info);
        if let (Some(about), Some(signatures)) = (&mut config.bumpless, signed.get(&info.digest)) {
            about.signatures.clone_from(signatures);
        }
        let config = files.blob(CONFIG_TYPE, json(&config)?);
        let layer = files.blob(COMPONENT_TYPE, bytes);
        let manifest = Manifest {
            schema_version: 2,
            media_type: MANIFEST_TYPE.to_owned(),
            config,
            layers: vec![layer],
            annotations: BTreeMap::new(),
        };
        let mut content = files.blob(MANIFEST_TYPE, json(&manifest)?);
        content.annotations.insert(REF_NAME.to_owned(), title(&info));
        manifests.push(content);
    }
    let layout = Layout {
        image_layout_version: VERSION.to_owned(),
    };
    let index = Index {
        schema_version: 2,
        media_type: INDEX_TYPE.to_owned(),
        manifests,
    };
    let first = [(LAYOUT.to_owned(), json(&layout)?), (INDEX.to_owned(), json(&index)?)];
    let failed = |error: std::io::Error| Error::internal(format!("a bundle cannot be written: {error}"));
    let mut tar = tar::Builder::new(Vec::with_capacity(size + 64 * 1024));
    for (path, bytes) in first.into_iter().chain(files.0) {
        let mut header = tar::Header::new_ustar();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        header.set_mtime(0);
        tar.append_data(&mut header, &path, bytes.as_slice()).map_err(failed)?;
    }
    let bundle = tar.into_inner().map_err(failed)?;
    if bundle.len() > BUNDLE_BYTES_MAX {
        return Err(too_big(bundle.len()));
    }
    Ok(bundle)
}

/// What is in a file. The file itself must be whole; a component in it that is not is an entry with words.
///
/// # Errors
/// [`Error::Invalid`] where it is no bundle.
pub(crate) fn unpack(bytes: &[u8]) -> Result<Vec<Entry>, Error> {
    if bytes.len() > BUNDLE_BYTES_MAX {
        return Err(Error::invalid(
            format!(
                "the bundle has {} bytes; at most {BUNDLE_BYTES_MAX} are taken",
                bytes.len()
            ),
            "make several bundles",
        ));
    }
    let files = list(bytes)?;
    let layout: Layout = document(&files, LAYOUT)?;
    if !layout.image_layout_version.starts_with("1.") {
        let version: String = layout.image_layout_version.chars().take(20).collect();
        return Err(no_bundle(&format!("its layout has version {version:?}, not 1")));
    }
    let index: Index = document(&files, INDEX)?;
    let count = index.manifests.len();
    if count == 0 || count > BUNDLE_COMPONENTS_MAX {
        return Err(no_bundle(&format!(
            "its index lists {count} components, not 1 to {BUNDLE_COMPONENTS_MAX}"
        )));
    }
    let entries = index.manifests.iter().map(|content| {
        let name = content.annotations.get(REF_NAME).unwrap_or(&content.digest);
        (name.chars().take(128).collect(), parcel(&files, content))
    });
    Ok(entries.collect())
}

fn no_bundle(reason: &str) -> Error {
    Error::invalid(
        format!("this is no bundle: {reason}"),
        "export one again; a bundle is an OCI image layout in a tar that is not compressed",
    )
}

/// The files by path, where they stand in the archive. Nothing is copied.
fn list(bytes: &[u8]) -> Result<BTreeMap<String, &[u8]>, Error> {
    let broken = |error: std::io::Error| no_bundle(&format!("the tar cannot be read: {error}"));
    let mut archive = tar::Archive::new(Cursor::new(bytes));
    let mut files = BTreeMap::new();
    for (number, entry) in archive.entries().map_err(broken)?.enumerate() {
        if number >= BUNDLE_ENTRIES_MAX {
            return Err(no_bundle(&format!(
                "the tar has more than {BUNDLE_ENTRIES_MAX} entries"
            )));
        }
        let entry = entry.map_err(broken)?;
        // Folders are of no matter; links and sparse files are not what they seem.
        if entry.header().entry_type() != tar::EntryType::Regular {
            continue;
        }
        let path = entry.path().map_err(broken)?.to_string_lossy().into_owned();
        let part = usize::try_from(entry.raw_file_position())
            .ok()
            .zip(usize::try_from(entry.size()).ok())
            .and_then(|(from, size)| bytes.get(from..from.checked_add(size)?));
        let short: String = path.chars().take(100).collect();
        let Some(part) = part else {
            return Err(no_bundle(&format!("file {short:?} is cut short")));
        };
        let plain = path.strip_prefix("./").unwrap_or(&path).to_owned();
        if files.insert(plain, part).is_some() {
            return Err(no_bundle(&format!("file {short:?} is in it twice")));
        }
    }
    Ok(files)
}

fn document<T: DeserializeOwned>(files: &BTreeMap<String, &[u8]>, path: &str) -> Result<T, Error> {
    let bytes = files.get(path).ok_or_else(|| no_bundle(&format!("it has no {path}")))?;
    if bytes.len() > BUNDLE_DOCUMENT_BYTES_MAX {
        return Err(no_bundle(&format!("its {path} has {} bytes", bytes.len())));
    }
    serde_json::from_slice(bytes).map_err(|error| no_bundle(&format!("its {path}: {error}")))
}

/// The bytes of a content, which are what its digest and size say.
fn blob<'a>(files: &BTreeMap<String, &'a [u8]>, what: &str, content: &Content) -> Result<&'a [u8], Error> {
    let said: String = content.digest.chars().take(80).collect();
    let cure = "export it again, and compare the file with the original";
    let digest: Digest = said
        .strip_prefix("sha256:")
        .and_then(|digits| digits.parse().ok())
        .ok_or_else(|| Error::invalid(format!("{what} has the digest {said:?}, which is no SHA-256"), cure))?;
    let bytes = files
        .get(&format!("{BLOBS}{digest}"))
        .ok_or_else(|| Error::invalid(format!("{what} ({}) is not in the bundle", digest.short()), cure))?;
    if bytes.len() as u64 != content.size || Digest::of(bytes) != digest {
        return Err(Error::invalid(
            format!("{what} is not what its digest {} says", digest.short()),
            cure,
        ));
    }
    Ok(bytes)
}

fn read<T: DeserializeOwned>(what: &str, bytes: &[u8]) -> Result<T, Error> {
    if bytes.len() > BUNDLE_DOCUMENT_BYTES_MAX {
        return Err(Error::invalid(format!("{what} has {} bytes", bytes.len()), ""));
    }
    serde_json::from_slice(bytes).map_err(|error| Error::invalid(format!("{what} cannot be read: {error}"), ""))
}

fn parcel(files: &BTreeMap<String, &[u8]>, content: &Content) -> Result<Parcel, Error> {
    if content.media_type != MANIFEST_TYPE {
        let found: String = content.media_type.chars().take(100).collect();
        return Err(Error::invalid(
            format!("the entry is of type {found:?}"),
            format!("only {MANIFEST_TYPE} is taken"),
        ));
    }
    let manifest: Manifest = read("the manifest", blob(files, "the manifest", content)?)?;
    let config: Config = if manifest.config.media_type == CONFIG_TYPE {
        read("the config", blob(files, "the config", &manifest.config)?)?
    } else {
        let found: String = manifest.config.media_type.chars().take(100).collect();
        return Err(Error::invalid(
            format!("the config is of type {found:?}"),
            format!("only {CONFIG_TYPE} is taken"),
        ));
    };
    let [layer] = manifest.layers.as_slice() else {
        return Err(Error::invalid(
            format!("the manifest has {} layers", manifest.layers.len()),
            "a component is one layer",
        ));
    };
    if layer.media_type != COMPONENT_TYPE {
        let found: String = layer.media_type.chars().take(100).collect();
        return Err(Error::invalid(
            format!("the layer is of type {found:?}"),
            format!("only {COMPONENT_TYPE} is taken"),
        ));
    }
    if layer.size > COMPONENT_BYTES_MAX as u64 {
        return Err(Error::invalid(
            format!(
                "the component has {} bytes; at most {COMPONENT_BYTES_MAX} are taken",
                layer.size
            ),
            "",
        ));
    }
    let bytes = blob(files, "the component", layer)?.to_vec();
    let described = || {
        manifest
            .annotations
            .get(DESCRIPTION)
            .or_else(|| content.annotations.get(DESCRIPTION))
    };
    let (note, labels, mut signatures) = match config.bumpless {
        Some(about) => (about.note, about.labels, about.signatures),
        None => (described().cloned().unwrap_or_default(), BTreeMap::new(), Vec::new()),
    };
    signatures.truncate(SIGNATURES_MAX);
    Ok(Parcel {
        digest: Digest::of(&bytes),
        bytes,
        note,
        labels,
        signatures,
    })
}

#[cfg(test)]
mod tests;
