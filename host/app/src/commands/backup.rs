//! `backup` and `restore`: what people made in a cell, in one file: components, loops, alarms.
//!
//! ```text
//! backup:   the cell ─► manifest.json │ components/<digest>.tar … │ loops.json │ alarms.json        (a tar)
//!              written beside its name, synced, then renamed: a file of that name is whole
//! restore:  every file of the manifest is there, with its size and digest ─► the cell has no loops ─► components ─► loops ─► alarms
//!              └ else nothing is sent
//! ```
//! Owns: the form of the file. Never: a host's own things: its configuration, certificates, history, audit trail and last records lie
//! on its disk, and are backed up from there. A restored loop begins from what its actuators hold, as a new one does.

use std::{
    collections::BTreeMap,
    fs,
    io::{Read as _, Write as _},
    path::Path,
};

use bumpless_api::types::{AlarmDefinition, AlarmKind, Apply, Component, Imports, Loop, LoopAlarm, LoopDraft, Mode};
use bumpless_core::Digest;
use bumpless_deploy::limits::BUNDLE_BYTES_MAX;
use serde::{Deserialize, Serialize};

use super::library::me;
use crate::{
    cli::RestoreArgs,
    client::{Client, encoded},
    error::Error,
    show,
};

/// Version of the file's form.
const FORMAT: u32 = 1;
/// Bytes of a file that is read: thousands of components.
const FILE_BYTES_MAX: u64 = 4 * 1024 * 1024 * 1024;
/// Files in it.
const ENTRIES_MAX: usize = 20_000;
const MANIFEST: &str = "manifest.json";
const LOOPS: &str = "loops.json";
const ALARMS: &str = "alarms.json";

/// What is in the file, and what each part of it must be.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: u32,
    /// The program that wrote it.
    program: String,
    /// The host that was asked.
    api: String,
    files: Vec<Part>,
}

/// One file of the backup.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Part {
    path: String,
    bytes: u64,
    sha256: Digest,
}

/// An alarm of a loop, as it was defined.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Alarm {
    of: String,
    name: String,
    definition: AlarmDefinition,
}

type Files = BTreeMap<String, Vec<u8>>;

/// Writes the cell into a file.
pub(crate) fn backup(client: &Client, json: bool, output: &Path) -> Result<(), Error> {
    let components: Vec<Component> = rows(client, "/v1/components", "components")?;
    let loops: Vec<Loop> = rows(client, "/v1/loops", "loops")?;
    let alarms: Vec<LoopAlarm> = rows(client, "/v1/alarms?all=true&quiet=true", "alarms")?;
    let mut files = Files::new();
    for component in &components {
        let path = format!("/v1/bundle?components={}", component.digest);
        let bytes = client.bytes(&path, BUNDLE_BYTES_MAX as u64 + 1)?;
        files.insert(format!("components/{}.tar", component.digest), bytes);
    }
    let drafts: Vec<LoopDraft> = loops.iter().map(as_it_runs).collect();
    let alarms: Vec<Alarm> = alarms
        .into_iter()
        // Those of components come with them.
        .filter(|alarm| alarm.definition.kind != AlarmKind::Controller)
        .filter(|alarm| loops.iter().any(|held| held.name == alarm.loop_name))
        .map(|alarm| Alarm {
            of: alarm.loop_name,
            name: alarm.name,
            definition: alarm.definition,
        })
        .collect();
    files.insert(LOOPS.to_owned(), text_of(&drafts)?);
    files.insert(ALARMS.to_owned(), text_of(&alarms)?);
    let bytes = pack(client.api(), &files)?;
    keep(output, &bytes)?;
    let (components, loops, alarms) = (components.len(), drafts.len(), alarms.len());
    if json {
        let told = serde_json::json!({"file": output, "bytes": bytes.len(), "sha256": Digest::of(&bytes),
            "components": components, "loops": loops, "alarms": alarms});
        return show::json(&told.to_string());
    }
    show::line(&format!(
        "{}: {components} components, {loops} loops, {alarms} alarms ({})",
        output.display(),
        show::size(bytes.len() as u64)
    ))
}

/// Brings what a file holds into a cell without loops.
pub(crate) fn restore(client: impl Fn() -> Result<Client, Error>, json: bool, args: &RestoreArgs) -> Result<(), Error> {
    let files =
        unpack(&read(&args.file)?).map_err(|reason| Error::Refused(format!("{}: {reason}", args.file.display())))?;
    let mut drafts: Vec<LoopDraft> = parsed(&files, LOOPS)?;
    let alarms: Vec<Alarm> = parsed(&files, ALARMS)?;
    let bundles: Vec<(&String, &Vec<u8>)> = files
        .iter()
        .filter(|(path, _)| path.starts_with("components/"))
        .collect();
    let what = format!(
        "{} components, {} loops, {} alarms",
        bundles.len(),
        drafts.len(),
        alarms.len()
    );
    if args.check {
        return show::line(&format!("{}: whole: {what}", args.file.display()));
    }
    let client = client()?;
    let there: Vec<Loop> = rows(&client, "/v1/loops", "loops")?;
    if let Some(first) = there.first() {
        return Err(Error::Refused(format!(
            "the cell has {} loops, {:?} among them; a backup is restored into a cell without any, so nothing was changed",
            there.len(),
            first.name
        )));
    }
    for (path, bytes) in &bundles {
        let length = bytes.len() as u64;
        let to = format!("/v1/bundle?force=true&by={}", encoded(&me()));
        let answer = client.send_file(&to, "application/x-tar", length, &mut bytes.as_slice())?;
        let imports: Imports = answer.decode()?;
        if let Some(refused) = imports.components.iter().find(|import| import.outcome == "refused") {
            return Err(Error::Refused(format!("{path}: {}; {}", refused.reason, refused.cure)));
        }
    }
    for draft in &mut drafts {
        if args.manual {
            draft.mode = Mode::Manual;
        }
        let _end: Apply = client
            .put(&format!("/v1/loops/{}", encoded(&draft.name)), draft)?
            .decode()?;
    }
    for Alarm { of, name, definition } in &alarms {
        client.put(
            &format!("/v1/loops/{}/alarms/{}", encoded(of), encoded(name)),
            definition,
        )?;
    }
    if json {
        let told = serde_json::json!({"components": bundles.len(), "loops": drafts.len(), "alarms": alarms.len()});
        return show::json(&told.to_string());
    }
    show::line(&format!("restored: {what}"))
}

fn rows<T: serde::de::DeserializeOwned>(client: &Client, path: &str, key: &str) -> Result<Vec<T>, Error> {
    let all: BTreeMap<String, serde_json::Value> = client.list(path, key)?.decode()?;
    let rows = all.get(key).cloned().unwrap_or_default();
    serde_json::from_value(rows).map_err(|error| Error::Answer {
        api: client.api().to_owned(),
        reason: format!("its list of {key}: {error}"),
    })
}

/// The loop as it would be written now: what was commanded since its last change is in it, and its component is named by its bytes.
fn as_it_runs(held: &Loop) -> LoopDraft {
    let mut draft = held.spec.clone();
    draft.component.clone_from(&held.digest);
    draft.mode = held.mode.unwrap_or(draft.mode);
    draft.setpoint = held.setpoint.unwrap_or(draft.setpoint);
    draft
}

fn text_of<T: Serialize>(value: &T) -> Result<Vec<u8>, Error> {
    serde_json::to_vec_pretty(value).map_err(|source| Error::Failed {
        what: "the backup",
        source: source.into(),
    })
}

fn pack(api: &str, files: &Files) -> Result<Vec<u8>, Error> {
    let part = |(path, bytes): (&String, &Vec<u8>)| Part {
        path: path.clone(),
        bytes: bytes.len() as u64,
        sha256: Digest::of(bytes),
    };
    let manifest = Manifest {
        format: FORMAT,
        program: concat!("bumpless ", env!("CARGO_PKG_VERSION")).to_owned(),
        api: api.to_owned(),
        files: files.iter().map(part).collect(),
    };
    let manifest = text_of(&manifest)?;
    let mut tar = tar::Builder::new(Vec::new());
    // The manifest comes first: of a file that is cut short it is known what is missing.
    let first = MANIFEST.to_owned();
    for (path, bytes) in std::iter::once((&first, &manifest)).chain(files) {
        let mut header = tar::Header::new_ustar();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o600);
        header.set_mtime(0);
        let added = tar.append_data(&mut header, path, bytes.as_slice());
        added.map_err(|source| Error::Failed {
            what: "the backup",
            source: source.into(),
        })?;
    }
    tar.into_inner().map_err(|source| Error::Failed {
        what: "the backup",
        source: source.into(),
    })
}

/// What is in the bytes; or why they are no whole backup.
fn unpack(bytes: &[u8]) -> Result<Files, String> {
    let broken = |error: std::io::Error| format!("it is no whole tar ({error}); take another copy");
    let mut files = Files::new();
    let mut archive = tar::Archive::new(bytes);
    for (number, entry) in archive.entries().map_err(broken)?.enumerate() {
        if number >= ENTRIES_MAX {
            return Err(format!("it has more than {ENTRIES_MAX} files"));
        }
        let mut entry = entry.map_err(broken)?;
        let path = entry.path().map_err(broken)?.to_string_lossy().into_owned();
        let mut content = Vec::new();
        entry.read_to_end(&mut content).map_err(broken)?;
        if files.insert(path.clone(), content).is_some() {
            return Err(format!("{path:?} is in it twice; it is no backup of this program"));
        }
    }
    let manifest = files
        .remove(MANIFEST)
        .ok_or("it has no manifest.json, so it is no backup")?;
    let manifest: Manifest =
        serde_json::from_slice(&manifest).map_err(|error| format!("its manifest.json: {error}"))?;
    if manifest.format != FORMAT {
        return Err(format!(
            "it has format {}, this program reads format {FORMAT}; use the program that wrote it ({})",
            manifest.format, manifest.program
        ));
    }
    for part in &manifest.files {
        let Some(bytes) = files.get(&part.path) else {
            return Err(format!(
                "{} is missing: it is half a backup; take another copy",
                part.path
            ));
        };
        if bytes.len() as u64 != part.bytes || Digest::of(bytes) != part.sha256 {
            return Err(format!(
                "{} is not what the manifest says; take another copy",
                part.path
            ));
        }
    }
    let listed = |path: &String| manifest.files.iter().any(|part| part.path == *path);
    if let Some(path) = files.keys().find(|path| !listed(path)) {
        return Err(format!("{path:?} is in it, and not in its manifest; take another copy"));
    }
    Ok(files)
}

fn parsed<T: serde::de::DeserializeOwned>(files: &Files, path: &str) -> Result<T, Error> {
    let bytes = files
        .get(path)
        .ok_or_else(|| Error::Refused(format!("the backup has no {path}")))?;
    serde_json::from_slice(bytes).map_err(|error| Error::Refused(format!("{path} of the backup: {error}")))
}

fn read(file: &Path) -> Result<Vec<u8>, Error> {
    let failed = |source| Error::File {
        path: file.to_owned(),
        action: "read",
        source,
    };
    let size = fs::metadata(file).map_err(failed)?.len();
    if size > FILE_BYTES_MAX {
        return Err(Error::Usage(format!(
            "{} has {size} bytes; a backup has at most {FILE_BYTES_MAX}",
            file.display()
        )));
    }
    fs::read(file).map_err(failed)
}

/// Writes beside the name, syncs, renames: whoever sees the name sees all of it.
fn keep(output: &Path, bytes: &[u8]) -> Result<(), Error> {
    let failed = |source| Error::File {
        path: output.to_owned(),
        action: "written",
        source,
    };
    let mut draft = output.as_os_str().to_owned();
    draft.push(".draft");
    let draft = Path::new(&draft);
    let write = || {
        let mut file = fs::File::create(draft)?;
        file.write_all(bytes)?;
        file.sync_all()
    };
    write().and_then(|()| fs::rename(draft, output)).map_err(failed)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn files() -> Files {
        Files::from([
            (LOOPS.to_owned(), b"[]".to_vec()),
            (ALARMS.to_owned(), b"[]".to_vec()),
            ("components/x.tar".to_owned(), vec![7; 2_000]),
        ])
    }

    #[test]
    fn a_backup_comes_back_as_it_went() {
        assert_eq!(unpack(&pack("http://x", &files()).unwrap()).unwrap(), files());
    }

    #[test]
    fn half_a_backup_is_refused_with_what_is_missing() {
        let whole = pack("http://x", &files()).unwrap();
        for end in (0..whole.len() - 1024).step_by(97) {
            let reason = unpack(&whole[..end]).unwrap_err();
            let known = ["no whole tar", "is missing", "no manifest.json", "is not what"];
            assert!(known.iter().any(|part| reason.contains(part)), "{end}: {reason}");
        }
        let at = whole.windows(8).position(|bytes| bytes == [7; 8]).unwrap();
        let mut turned = whole.clone();
        turned[at] ^= 1;
        assert_eq!(
            unpack(&turned).unwrap_err(),
            "components/x.tar is not what the manifest says; take another copy"
        );
        let newer = String::from_utf8_lossy(&whole).find("\"format\": 1").unwrap();
        let mut newer_bytes = whole;
        newer_bytes[newer + 10] = b'9';
        assert!(unpack(&newer_bytes).unwrap_err().contains("it has format 9"));
    }
}
