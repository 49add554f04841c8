//! Components in and out of the cell: upload, trial, download, labels and notes, removal.
//!
//! ```text
//! bytes ──inspected, compiled──► one name and version, one component ──tried──► disk ──► announced ──► copied by every host
//! ```
//! Never: takes in what failed its trial, except by force; leaves anything of what it refused.

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{
    ComponentInfo, Digest, ProgramId,
    component::{CONTROLLER_WORLD, PLANT_WORLD, PROGRAM_WORLD, check_labels},
    limits::TEXT_CHARS_MAX,
};
use bumpless_engine::Either;
use futures_util::future::join_all;
use tokio::time::timeout;
use tracing::{Instrument as _, info_span};

use crate::{
    SPANS,
    admission::{let_in, plant_descriptor, program_descriptor},
    bench::{engine_error, stopping},
    book::on_disk,
    bundle,
    error::Error,
    library::title,
    limits::{BUNDLE_BYTES_MAX, BUNDLE_COMPONENTS_MAX, STAGE_WAIT, UPLOAD_WAIT},
    programs::{ProgramAsk, ProgramTold},
    room::{Room, count},
    view::{Imported, Relabel, Upload},
    wire::{Ask, Notice, Told},
};

/// May these words be kept?
fn check_words(by: &str, note: &str) -> Result<(), Error> {
    for (what, text) in [("the uploader's name", by), ("the note", note)] {
        if text.chars().count() > TEXT_CHARS_MAX {
            return Err(Error::invalid(
                format!("{what} is longer than {TEXT_CHARS_MAX} characters"),
                "shorten it",
            ));
        }
    }
    Ok(())
}

impl Room {
    /// Takes a component in.
    pub(crate) async fn upload(self: &Arc<Self>, bytes: Vec<u8>, upload: &Upload) -> Result<Arc<ComponentInfo>, Error> {
        let bytes = match &upload.script {
            Some(name) => self.wrapped(bytes, name).await?,
            None => bytes,
        };
        let span =
            info_span!(target: SPANS, "upload", bytes = bytes.len(), by = upload.by, name = tracing::field::Empty);
        let end = self.take_in(bytes.into(), upload).instrument(span).await;
        count(if end.is_ok() {
            &self.tallies.uploads
        } else {
            &self.tallies.uploads_refused
        });
        end
    }

    /// What taking it in would find. Nothing stays.
    pub(crate) async fn try_out(self: &Arc<Self>, bytes: Vec<u8>, upload: &Upload) -> Result<ComponentInfo, Error> {
        let bytes = match &upload.script {
            Some(name) => self.wrapped(bytes, name).await?,
            None => bytes,
        };
        let (info, _) = self.examined(&bytes.into(), upload).await?;
        self.forget_unkept(&info.digest);
        Ok(info)
    }

    /// Everything before the decision: whether it is a controller or a plant, whether there may be one of its name, how its trial
    /// went. `true` where the library has it already.
    async fn examined(self: &Arc<Self>, bytes: &Arc<[u8]>, upload: &Upload) -> Result<(ComponentInfo, bool), Error> {
        check_words(&upload.by, &upload.note)?;
        check_labels(&upload.labels).map_err(|error| Error::invalid(error.to_string(), ""))?;
        let crowded = |_| {
            Error::busy(
                format!("other components are being uploaded at host {}", self.here),
                "try again",
            )
        };
        let _place = timeout(UPLOAD_WAIT, self.uploads.acquire())
            .await
            .map_err(crowded)?
            .map_err(|_| stopping())?;
        let copy = Arc::clone(bytes);
        let digest = on_disk(move || Digest::of(&copy)).await?;
        if let Some(known) = self.library.get(&digest) {
            return Ok(((*known).clone(), true));
        }
        let (engine, copy) = (self.bench.engine.clone(), Arc::clone(bytes));
        // Inspected here, compiled in a process of its own.
        let opened = on_disk(move || engine.open_either(&copy))
            .instrument(info_span!(target: SPANS, "compile"))
            .await?
            .map_err(|error| engine_error(&error))?;
        let (descriptor, world, imports) = match &opened {
            Either::Controller(inspection, _) => {
                let imports = inspection.imports.clone();
                (inspection.descriptor.clone(), CONTROLLER_WORLD, imports)
            }
            Either::Plant(plant, _) => (plant_descriptor(plant.info()), PLANT_WORLD, plant.imports().to_vec()),
            Either::Program(program, _) => (
                program_descriptor(program.info()),
                PROGRAM_WORLD,
                program.imports().to_vec(),
            ),
        };
        let mut info = ComponentInfo {
            digest,
            name: descriptor.name.clone(),
            version: descriptor.version.clone(),
            descriptor,
            world: world.to_owned(),
            imports,
            bytes: bytes.len() as u64,
            uploaded_at_unix_ms: self.clock.unix_ms(),
            uploaded_by: upload.by.clone(),
            note: upload.note.clone(),
            labels: upload.labels.clone(),
            changes: 0,
            history: Vec::new(),
            admission: None,
        };
        // Before the trial, which takes longer; and once more when it comes in.
        if self.library.admit(&info)?.is_some() {
            return Ok((info, true));
        }
        tracing::Span::current().record("name", title(&info));
        // Force lets in what failed its trial, and nobody past the policy: that is a root key's to change.
        let unsigned = self.signed(&title(&info), &digest)?;
        let span = info_span!(target: SPANS, "trial");
        let admission = match opened {
            Either::Controller(inspection, prepared) => {
                let trial = self.tried(prepared, &info.imports, inspection.compile_time);
                Some(trial.instrument(span).await?)
            }
            Either::Plant(plant, compile_time) => Some(self.tried_plant(plant, compile_time).instrument(span).await?),
            // It has no step to be tried on: what it does wrong becomes its status.
            Either::Program(..) => None,
        };
        info.admission = admission;
        if let (Some(text), Some(admission)) = (unsigned, &mut info.admission) {
            admission.warn(&text);
        }
        info.check().map_err(|error| Error::invalid(error.to_string(), ""))?;
        Ok((info, false))
    }

    /// Compiled code of what did not come in is of no use.
    fn forget_unkept(&self, digest: &Digest) {
        if self.library.get(digest).is_none() {
            self.bench.engine.forget(digest);
        }
    }

    async fn take_in(self: &Arc<Self>, bytes: Arc<[u8]>, upload: &Upload) -> Result<Arc<ComponentInfo>, Error> {
        let (mut info, known) = self.examined(&bytes, upload).await?;
        if known {
            return Ok(Arc::new(info));
        }
        if let Some(admission) = info.admission.take() {
            let end = let_in(admission, &title(&info), upload.force, &upload.by);
            info.admission = Some(end.inspect_err(|_| self.forget_unkept(&info.digest))?);
        }
        let forced = info
            .admission
            .as_ref()
            .is_some_and(|a| a.verdict == bumpless_core::Verdict::Forced);
        let info = {
            let _admission = self.admission.lock().await;
            if let Some(known) = self.library.admit(&info)? {
                return Ok(known);
            }
            // Later than its own removal, also where that was said by a host whose clock is ahead.
            let (_, removals) = self.library.heads();
            let removed_ms = removals
                .iter()
                .find(|(digest, _)| *digest == info.digest)
                .map_or(0, |(_, at_ms)| at_ms + 1);
            info.uploaded_at_unix_ms = info.uploaded_at_unix_ms.max(removed_ms);
            let what = if forced { "taken in by force" } else { "uploaded" };
            info.remember(info.uploaded_at_unix_ms, &upload.by, what);
            let info = Arc::new(info);
            let kept = self.library.keep(Arc::clone(&info), Some(bytes));
            kept.instrument(info_span!(target: SPANS, "keep")).await?;
            info
        };
        self.announce(&Notice::Component(info.digest, info.edition()));
        // Ready here at once, so that what is uploaded can be called. A full engine is told when it matters.
        if !info.is_plant()
            && !info.is_program()
            && let Err(error) = self.prepared(info.digest, None).await
        {
            tracing::warn!(digest = %info.digest, %error, "an uploaded component is not ready here yet");
        }
        Ok(info)
    }

    /// Changes what people wrote about a component, on every host.
    pub(crate) async fn relabel(&self, reference: &str, change: &Relabel) -> Result<Arc<ComponentInfo>, Error> {
        check_words(&change.by, change.note.as_deref().unwrap_or_default())?;
        let _admission = self.admission.lock().await;
        let mut info = (*self.library.resolve(reference)?).clone();
        let mut what = Vec::new();
        for (key, value) in &change.labels {
            match value {
                Some(value) if info.labels.get(key) != Some(value) => {
                    what.push(format!("label {key}={value}"));
                    info.labels.insert(key.clone(), value.clone());
                }
                Some(_) => {}
                None => {
                    if info.labels.remove(key).is_none() {
                        return Err(Error::not_found(
                            format!("{} has no label {key:?}", title(&info)),
                            format!("it has {}", list(&info.labels)),
                        ));
                    }
                    what.push(format!("label {key} removed"));
                }
            }
        }
        check_labels(&info.labels).map_err(|error| Error::invalid(error.to_string(), ""))?;
        if let Some(note) = change.note.as_ref().filter(|note| **note != info.note) {
            what.push(
                if note.is_empty() {
                    "note removed"
                } else {
                    "note changed"
                }
                .to_owned(),
            );
            info.note.clone_from(note);
        }
        if what.is_empty() {
            return Ok(Arc::new(info));
        }
        info.changes += 1;
        info.remember(self.clock.unix_ms(), &change.by, &what.join(", "));
        info.check().map_err(|error| Error::invalid(error.to_string(), ""))?;
        let info = Arc::new(info);
        self.library.keep(Arc::clone(&info), None).await?;
        self.announce(&Notice::Component(info.digest, info.edition()));
        Ok(info)
    }

    /// Removes a component from the library of the cell.
    pub(crate) async fn remove_component(self: &Arc<Self>, reference: &str) -> Result<(), Error> {
        let _admission = self.admission.lock().await;
        let info = self.library.resolve(reference)?;
        let users = self.book.users().remove(&info.digest).unwrap_or_default();
        if let Some(program) = self.program_with(&info.digest).await {
            return Err(Error::refused(
                format!("component {} is used by program {program}", title(&info)),
                "remove the program first",
            ));
        }
        if !users.is_empty() {
            let names = users
                .iter()
                .take(8)
                .map(ToString::to_string)
                .collect::<Vec<_>>()
                .join(", ");
            return Err(Error::refused(
                format!("component {} is used by {} loops: {names}", title(&info), users.len()),
                "swap or delete them; a loop also needs the components of its earlier revisions (at most 16) and of their fallbacks, so \
                 that each can be gone back to",
            ));
        }
        // Dated by the upload that it takes back, and not by a clock: whatever this host's date is, it takes back that one and none
        // that comes after it.
        let at_ms = info.uploaded_at_unix_ms;
        self.component_gone(info.digest, at_ms).await?;
        self.announce(&Notice::ComponentGone(info.digest, at_ms));
        Ok(())
    }

    /// A file with these components.
    pub(crate) async fn export(self: &Arc<Self>, references: &[String]) -> Result<Vec<u8>, Error> {
        let (mut infos, mut size) = (BTreeMap::new(), 0);
        for reference in references.iter().take(BUNDLE_COMPONENTS_MAX + 1) {
            let info = self.library.resolve(reference)?;
            infos.insert((info.name.clone(), info.version.clone(), info.digest), info);
        }
        let mut components = Vec::new();
        for info in infos.values() {
            // Before the bytes are fetched, so that a long list does not fill the memory.
            size += usize::try_from(info.bytes).unwrap_or(usize::MAX);
            if size > BUNDLE_BYTES_MAX {
                return Err(Error::invalid(
                    format!("the components have more than {BUNDLE_BYTES_MAX} bytes in all"),
                    "make several bundles",
                ));
            }
            components.push(((**info).clone(), self.bytes_of(info.digest, None).await?));
        }
        let signed: bundle::Signed = components
            .iter()
            .map(|(info, _)| (info.digest, self.signatures(&info.digest).signatures))
            .collect();
        on_disk(move || bundle::pack(components, &signed)).await?
    }

    /// Takes in what a file holds, one component after the other, each through its own trial.
    pub(crate) async fn import(
        self: &Arc<Self>,
        bytes: Vec<u8>,
        by: &str,
        force: bool,
    ) -> Result<Vec<Imported>, Error> {
        check_words(by, "")?;
        let entries = on_disk(move || bundle::unpack(&bytes)).await??;
        let mut ends = Vec::with_capacity(entries.len());
        for (name, parcel) in entries {
            let (known, end) = match parcel {
                Ok(parcel) => {
                    let known = self.library.get(&parcel.digest).is_some();
                    // What is wrong with them the upload says, where anybody asks for signatures.
                    if !parcel.signatures.is_empty()
                        && let Err(error) = self.sign(parcel.digest, &parcel.signatures).await
                    {
                        tracing::warn!(digest = %parcel.digest, %error, "signatures of a bundle were not taken");
                    }
                    let upload = Upload {
                        by: by.to_owned(),
                        note: parcel.note,
                        labels: parcel.labels,
                        force,
                        script: None,
                    };
                    (known, self.upload(parcel.bytes, &upload).await)
                }
                Err(error) => {
                    count(&self.tallies.uploads_refused);
                    (false, Err(error))
                }
            };
            ends.push(Imported {
                name,
                end: end.map(|info| (*info).clone()),
                known,
            });
        }
        Ok(ends)
    }

    /// A component's bytes, from this host or another.
    pub(crate) async fn component_bytes(self: &Arc<Self>, digest: &Digest) -> Result<Vec<u8>, Error> {
        self.bytes_of(*digest, None).await
    }
}

/// `a=1, b=2`, or "none".
fn list(labels: &BTreeMap<String, String>) -> String {
    if labels.is_empty() {
        return "none".to_owned();
    }
    let labels: Vec<String> = labels.iter().map(|(key, value)| format!("{key}={value}")).collect();
    labels.join(", ")
}

impl Room {
    /// A program of the cell that needs a component, as far as the hosts that are there say.
    async fn program_with(self: &Arc<Self>, digest: &Digest) -> Option<ProgramId> {
        let mut hosts = self.roster.others();
        hosts.push(self.here.clone());
        let asked = hosts.iter().map(|host| {
            let ask = Ask::Program(Box::new(ProgramAsk::Uses(*digest)));
            self.ask(host, ask, STAGE_WAIT)
        });
        let names = join_all(asked).await.into_iter().filter_map(|answer| match answer {
            Ok(Told::Program(told)) => match *told {
                ProgramTold::Names(names) => names.into_iter().next(),
                _ => None,
            },
            _ => None,
        });
        names.min()
    }
}

/// The interpreter of scripts, as the library calls it.
const INTERPRETER: &str = "lua3c";

impl Room {
    /// A script in its interpreter. One that is in the library, letter by letter, comes back as it is there; another one gets the
    /// next version of its name.
    async fn wrapped(self: &Arc<Self>, text: Vec<u8>, name: &str) -> Result<Vec<u8>, Error> {
        let interpreter = self.library.resolve(INTERPRETER).map_err(|_| {
            Error::not_found(
                format!("there is no {INTERPRETER} in the library to run scripts"),
                format!("upload {INTERPRETER}.wasm first"),
            )
        })?;
        let newest = self.library.resolve(name).ok();
        let mut version = "1.0.0".to_owned();
        if let Some(newest) = newest.filter(|info| info.name == name) {
            let bytes = self.bytes_of(newest.digest, None).await?;
            if bumpless_engine::split(&bytes)
                .1
                .is_some_and(|script| script.text == text)
            {
                return Ok(bytes);
            }
            version = next_version(&newest.version);
        }
        let base = self.bytes_of(interpreter.digest, None).await?;
        let script = bumpless_engine::Script {
            name: name.to_owned(),
            version,
            text,
        };
        bumpless_engine::wrap(&base, &script).map_err(|error| engine_error(&error))
    }
}

/// `1.2.3` is followed by `1.2.4`.
fn next_version(version: &str) -> String {
    match version.rsplit_once('.') {
        Some((front, last)) => format!("{front}.{}", last.parse::<u64>().map_or(0, |n| n + 1)),
        None => "1.0.0".to_owned(),
    }
}
