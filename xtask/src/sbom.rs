//! `cargo xtask sbom`: what the product is made of, and from what it was built.
//!
//! ```text
//!   cargo metadata (locked) ─► packages that are in the binary, or that made it ─┐
//!   Cargo.lock ─► their checksums                                                ├─► target/sbom/bumpless.cdx.json
//!   git, rustc, cargo ─► revision, toolchain                                     ├─► target/sbom/bumpless.provenance.json
//!   the files of the release ─► their SHA-256                                    ┘
//! ```
//! The list is CycloneDX 1.6, the provenance an in-toto statement (SLSA provenance 1.0), both JSON. The same tree, toolchain and files
//! give the same bytes: no times and no random numbers. Owns both files. Never: builds the release; it tells of what is there.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    fs,
    path::{Path, PathBuf},
};

use bumpless_core::Digest;
use serde::Deserialize;
use serde_json::{Value, json};

use crate::{
    Error, components,
    run::{cargo, output, program, say, target_folder},
};

/// The package whose binary is the product.
const PRODUCT: &str = "bumpless-app";
/// The binary.
const BINARY: &str = "bumpless";

#[derive(Deserialize)]
struct Metadata {
    packages: Vec<Package>,
    resolve: Resolve,
}

#[derive(Deserialize)]
struct Package {
    id: String,
    name: String,
    version: String,
    license: Option<String>,
    description: Option<String>,
    repository: Option<String>,
    /// None for packages of this workspace.
    source: Option<String>,
}

#[derive(Deserialize)]
struct Resolve {
    nodes: Vec<Node>,
}

#[derive(Deserialize)]
struct Node {
    id: String,
    deps: Vec<Dep>,
}

#[derive(Deserialize)]
struct Dep {
    pkg: String,
    dep_kinds: Vec<DepKind>,
}

#[derive(Deserialize)]
struct DepKind {
    /// None for ordinary ones, "build" or "dev".
    kind: Option<String>,
}

/// Where something comes from.
struct Origin {
    revision: String,
    is_clean: bool,
    rustc: String,
    host: String,
}

/// Writes both files. `files` are those of the release; the release's binary and the stock components where none are named.
///
/// # Errors
/// [`Error::Failed`] where cargo or git say nothing, [`Error::File`].
pub fn write(files: &[PathBuf]) -> Result<(), Error> {
    let host = rustc_line("host: ")?;
    let origin = Origin {
        revision: said(program("git").args(["rev-parse", "HEAD"]), "git rev-parse HEAD")?,
        is_clean: output(program("git").args(["status", "--porcelain"])).is_some_and(|text| text.is_empty()),
        rustc: said(program("rustc").arg("--version"), "rustc --version")?,
        host,
    };
    let text = said(
        cargo("metadata --format-version 1 --locked --filter-platform").arg(&origin.host),
        "cargo metadata",
    )?;
    let metadata: Metadata = serde_json::from_str(&text).map_err(|error| Error::Failed {
        command: "cargo metadata".to_owned(),
        status: error.to_string(),
    })?;
    let lock = components::workspace_root().join("Cargo.lock");
    let checksums = checksums(&read(&lock)?);
    let files = if files.is_empty() { release() } else { files.to_vec() };
    let mut subjects = Vec::new();
    for path in &files {
        let bytes = fs::read(path).map_err(|source| Error::File {
            path: path.clone(),
            source,
        })?;
        subjects.push((name_of(path), Digest::of(&bytes).to_string()));
    }
    subjects.sort();
    let folder = target_folder().join("sbom");
    fs::create_dir_all(&folder).map_err(|source| Error::File {
        path: folder.clone(),
        source,
    })?;
    let bill = bill(&metadata, &checksums, &origin, &subjects);
    let count = bill["components"].as_array().map_or(0, Vec::len);
    for (name, document) in [
        ("bumpless.cdx.json", bill),
        (
            "bumpless.provenance.json",
            provenance(&metadata, &checksums, &origin, &subjects),
        ),
    ] {
        let path = folder.join(name);
        fs::write(&path, format!("{document:#}\n")).map_err(|source| Error::File {
            path: path.clone(),
            source,
        })?;
        say(&path.display().to_string());
    }
    say(&format!(
        "{count} packages, {} files, revision {}{}",
        subjects.len(),
        origin.revision,
        if origin.is_clean {
            ""
        } else {
            " with changes that are not committed"
        }
    ));
    Ok(())
}

fn read(path: &Path) -> Result<String, Error> {
    fs::read_to_string(path).map_err(|source| Error::File {
        path: path.to_owned(),
        source,
    })
}

fn said(command: &mut std::process::Command, words: &str) -> Result<String, Error> {
    output(command).ok_or_else(|| Error::Failed {
        command: words.to_owned(),
        status: "no answer".to_owned(),
    })
}

fn rustc_line(start: &str) -> Result<String, Error> {
    let text = said(program("rustc").arg("-vV"), "rustc -vV")?;
    let line = text.lines().find_map(|line| line.strip_prefix(start));
    line.map(str::to_owned).ok_or_else(|| Error::Failed {
        command: "rustc -vV".to_owned(),
        status: format!("no line {start:?}"),
    })
}

/// The binary with optimisation and the stock components, as far as they are built.
fn release() -> Vec<PathBuf> {
    let folder = target_folder().join("components");
    let stock = fs::read_dir(&folder)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path());
    let mut files: Vec<PathBuf> = stock
        .filter(|path| path.extension().is_some_and(|e| e == "wasm"))
        .collect();
    files.push(target_folder().join("release").join(BINARY));
    files.retain(|path| path.is_file());
    files.sort();
    files
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// SHA-256 of the packages of registries, by name and version, as Cargo.lock has them.
fn checksums(lock: &str) -> BTreeMap<(String, String), String> {
    let mut found = BTreeMap::new();
    for part in lock.split("[[package]]").skip(1) {
        let field = |name: &str| {
            let line = part
                .lines()
                .find_map(|line| line.strip_prefix(&format!("{name} = \"")))?;
            line.strip_suffix('"').map(str::to_owned)
        };
        if let (Some(name), Some(version), Some(checksum)) = (field("name"), field("version"), field("checksum")) {
            found.insert((name, version), checksum);
        }
    }
    found
}

/// What the product needs: to run, and to be built. Dependencies of tests are no part of it.
fn needed(metadata: &Metadata) -> BTreeSet<&str> {
    let nodes: BTreeMap<&str, &Node> = metadata
        .resolve
        .nodes
        .iter()
        .map(|node| (node.id.as_str(), node))
        .collect();
    let start = metadata.packages.iter().find(|package| package.name == PRODUCT);
    let mut waiting: VecDeque<&str> = start.iter().map(|package| package.id.as_str()).collect();
    let mut found = BTreeSet::new();
    while let Some(id) = waiting.pop_front() {
        if !found.insert(id) {
            continue;
        }
        for dep in nodes.get(id).iter().flat_map(|node| &node.deps) {
            if dep.dep_kinds.iter().any(|kind| kind.kind.as_deref() != Some("dev")) {
                waiting.push_back(&dep.pkg);
            }
        }
    }
    found
}

fn purl(package: &Package) -> String {
    format!("pkg:cargo/{}@{}", package.name, package.version)
}

fn bill(
    metadata: &Metadata,
    checksums: &BTreeMap<(String, String), String>,
    origin: &Origin,
    subjects: &[(String, String)],
) -> Value {
    let needed = needed(metadata);
    let mut packages: Vec<&Package> = metadata
        .packages
        .iter()
        .filter(|package| needed.contains(package.id.as_str()))
        .collect();
    packages.sort_by_key(|package| purl(package));
    let purls: BTreeMap<&str, String> = packages
        .iter()
        .map(|package| (package.id.as_str(), purl(package)))
        .collect();
    let component = |package: &Package| {
        let mut row = json!({
            "type": "library",
            "bom-ref": purl(package),
            "name": package.name,
            "version": package.version,
            "purl": purl(package),
        });
        if let Some(licence) = &package.license {
            // Older packages part choices by a slash; the expression's word is OR.
            row["licenses"] = json!([{ "expression": licence.replace('/', " OR ") }]);
        }
        if let Some(text) = &package.description {
            row["description"] = json!(text.split_whitespace().collect::<Vec<_>>().join(" "));
        }
        if let Some(checksum) = checksums.get(&(package.name.clone(), package.version.clone())) {
            row["hashes"] = json!([{ "alg": "SHA-256", "content": checksum }]);
        }
        if let Some(address) = package.repository.as_ref().filter(|_| package.source.is_some()) {
            row["externalReferences"] = json!([{ "type": "vcs", "url": address }]);
        }
        row
    };
    let dependencies: Vec<Value> = metadata
        .resolve
        .nodes
        .iter()
        .filter_map(|node| {
            let purl = purls.get(node.id.as_str())?;
            let mut on: Vec<&String> = node
                .deps
                .iter()
                .filter(|dep| dep.dep_kinds.iter().any(|kind| kind.kind.as_deref() != Some("dev")))
                .filter_map(|dep| purls.get(dep.pkg.as_str()))
                .collect();
            on.sort();
            on.dedup();
            Some(json!({ "ref": purl, "dependsOn": on }))
        })
        .collect();
    let product = packages.iter().find(|package| package.name == PRODUCT);
    let files: Vec<Value> = subjects
        .iter()
        .map(|(name, digest)| {
            json!({ "type": "file", "bom-ref": format!("file:{name}"), "name": name, "hashes": [{ "alg": "SHA-256", "content": digest }] })
        })
        .collect();
    let mut components: Vec<Value> = packages
        .iter()
        .filter(|package| package.name != PRODUCT)
        .map(|package| component(package))
        .collect();
    components.extend(files);
    json!({
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {
            "component": product.map(|package| {
                let mut row = component(package);
                row["type"] = json!("application");
                row["name"] = json!(BINARY);
                row
            }),
            "tools": { "components": [{ "type": "application", "name": "cargo xtask sbom", "version": env!("CARGO_PKG_VERSION") }] },
            "properties": [
                { "name": "bumpless:revision", "value": origin.revision },
                { "name": "bumpless:clean", "value": origin.is_clean.to_string() },
                { "name": "bumpless:rustc", "value": origin.rustc },
                { "name": "bumpless:target", "value": origin.host },
            ],
        },
        "components": components,
        "dependencies": dependencies,
    })
}

fn provenance(
    metadata: &Metadata,
    checksums: &BTreeMap<(String, String), String>,
    origin: &Origin,
    subjects: &[(String, String)],
) -> Value {
    let needed = needed(metadata);
    let mut materials: Vec<(String, &String)> = metadata
        .packages
        .iter()
        .filter(|package| needed.contains(package.id.as_str()))
        .filter_map(|package| {
            let checksum = checksums.get(&(package.name.clone(), package.version.clone()))?;
            Some((purl(package), checksum))
        })
        .collect();
    materials.sort();
    let materials: Vec<Value> = materials
        .into_iter()
        .map(|(uri, checksum)| json!({ "uri": uri, "digest": { "sha256": checksum } }))
        .collect();
    let revision = json!({ "uri": "git+https://example.invalid/bumpless", "digest": { "gitCommit": origin.revision } });
    let all: Vec<Value> = std::iter::once(revision).chain(materials).collect();
    let subjects: Vec<Value> = subjects
        .iter()
        .map(|(name, digest)| json!({ "name": name, "digest": { "sha256": digest } }))
        .collect();
    json!({
        "_type": "https://in-toto.io/Statement/v1",
        "subject": subjects,
        "predicateType": "https://slsa.dev/provenance/v1",
        "predicate": {
            "buildDefinition": {
                "buildType": "https://example.invalid/bumpless/cargo-release/v1",
                "externalParameters": { "command": "cargo build --release --locked --package bumpless-app", "target": origin.host },
                "internalParameters": { "rustc": origin.rustc, "clean": origin.is_clean },
                "resolvedDependencies": all,
            },
            "runDetails": { "builder": { "id": "https://example.invalid/bumpless/local" } },
        },
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn metadata() -> Metadata {
        let package = |name: &str, source: Option<&str>| {
            json!({
                "id": name, "name": name, "version": "1.0.0", "license": "MIT/Apache-2.0", "description": "a\n b",
                "repository": "https://example.invalid/x", "source": source,
            })
        };
        let dep = |name: &str, kinds: &[Option<&str>]| {
            let kinds: Vec<Value> = kinds.iter().map(|kind| json!({ "kind": kind })).collect();
            json!({ "pkg": name, "dep_kinds": kinds })
        };
        let value = json!({
            "packages": [
                package(PRODUCT, None), package("used", Some("registry")), package("builds", Some("registry")),
                package("tests", Some("registry")), package("both", Some("registry")), package("stranger", None),
            ],
            "resolve": { "nodes": [
                { "id": PRODUCT, "deps": [dep("used", &[None]), dep("tests", &[Some("dev")]), dep("both", &[Some("dev"), None])] },
                { "id": "used", "deps": [dep("builds", &[Some("build")])] },
                { "id": "builds", "deps": [] }, { "id": "tests", "deps": [] }, { "id": "both", "deps": [] },
                { "id": "stranger", "deps": [dep("tests", &[None])] },
            ] },
        });
        serde_json::from_value(value).unwrap()
    }

    fn origin() -> Origin {
        Origin {
            revision: "abc".to_owned(),
            is_clean: true,
            rustc: "rustc 1".to_owned(),
            host: "x86_64".to_owned(),
        }
    }

    #[test]
    fn the_bill_lists_what_is_in_the_product_and_what_built_it_and_nothing_of_the_tests() {
        let lock = "version = 4\n\n[[package]]\nname = \"used\"\nversion = \"1.0.0\"\nchecksum = \"00ff\"\n\n[[package]]\nname = \"both\"\nversion = \"1.0.0\"\n";
        let checksums = checksums(lock);
        assert_eq!(checksums.len(), 1);
        let subjects = [("bumpless".to_owned(), "11".to_owned())];
        let bill = bill(&metadata(), &checksums, &origin(), &subjects);
        let names: Vec<&str> = bill["components"]
            .as_array()
            .unwrap()
            .iter()
            .map(|row| row["name"].as_str().unwrap())
            .collect();
        assert_eq!(names, ["both", "builds", "used", "bumpless"]);
        assert_eq!(bill["metadata"]["component"]["name"], "bumpless");
        let used = &bill["components"][2];
        assert_eq!(used["hashes"][0]["content"], "00ff");
        assert_eq!(used["licenses"][0]["expression"], "MIT OR Apache-2.0");
        assert_eq!(used["description"], "a b");
        assert!(bill["dependencies"].to_string().contains("pkg:cargo/builds@1.0.0"));
        let provenance = provenance(&metadata(), &checksums, &origin(), &subjects);
        assert_eq!(provenance["subject"][0]["digest"]["sha256"], "11");
        let materials = &provenance["predicate"]["buildDefinition"]["resolvedDependencies"];
        assert_eq!(materials[0]["digest"]["gitCommit"], "abc");
        assert_eq!(materials[1]["uri"], "pkg:cargo/used@1.0.0");
    }
}
