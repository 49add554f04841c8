//! The components of the cell: which there are, what they are called, and which were removed.
//!
//! Owns: the rule that one name and version means one component, and the memory of removals.
//! Never: runs a component; `bench` does.
//!
//! ```text
//! unknown ──upload or copy──► in the library (labels and notes change) ──remove──► removed (remembered by its upload) ──upload again──► in the library
//! ```

use std::{collections::BTreeMap, sync::Arc};

use bumpless_core::{ComponentInfo, Digest, Edition};
use bumpless_store::Store;
use parking_lot::RwLock;

use crate::{
    book::{mark, on_disk},
    error::Error,
    limits::{COMPONENTS_MAX, REMOVALS_REMEMBERED_MAX},
};

/// Name of the setting that remembers removals.
const REMOVED: &str = "components-removed";

/// Fewest digits of a digest that may stand for it.
const DIGITS_MIN: usize = 8;

/// A component that was removed, and when the upload that was taken back came in, in ms of Unix time.
pub(crate) type Dated = (Digest, u64);

#[derive(Debug, Default)]
struct Shelves {
    infos: BTreeMap<Digest, Arc<ComponentInfo>>,
    /// In the order in which this host heard of them, each with the upload that was taken back: its time in ms of Unix time.
    removed: Vec<(Digest, u64)>,
}

/// The library.
#[derive(Debug)]
pub(crate) struct Library {
    store: Store,
    shelves: RwLock<Shelves>,
}

/// `name@version`.
pub(crate) fn title(info: &ComponentInfo) -> String {
    format!("{}@{}", info.name, info.version)
}

/// A component that a loop can run; or why it cannot.
pub(crate) fn as_controller(info: Arc<ComponentInfo>) -> Result<Arc<ComponentInfo>, Error> {
    if info.is_program() {
        return Err(Error::invalid(
            format!("{} is a program, and no controller", title(&info)),
            "start it as a program",
        ));
    }
    if info.is_plant() {
        return Err(Error::invalid(
            format!("{} is a plant, and no controller", title(&info)),
            format!("a simulated bus runs it: plant = \"library:{}\"", info.name),
        ));
    }
    Ok(info)
}

/// The bytes of a plant of the library that is on this disk, for a simulated bus that names it: by name, `name@version`, or
/// digest. Blocks.
///
/// # Errors
/// [`Error::NotFound`], [`Error::Refused`] where the reference means more than one, [`Error::Invalid`] for a controller,
/// [`Error::Store`].
pub fn plant_bytes(store: &Store, reference: &str) -> Result<Vec<u8>, Error> {
    let info = Library::open(store.clone())?.resolve(reference).map_err(|error| match error {
        Error::NotFound(words) => Error::not_found(
            words.reason,
            "upload it at any host of the cell while this one runs, without the bus for the first time; then start this one again",
        ),
        other => other,
    })?;
    if !info.is_plant() {
        return Err(Error::invalid(
            format!("{} is a controller, and no plant", title(&info)),
            "name a component of the world plant",
        ));
    }
    store.component(&info.digest)?.ok_or_else(|| {
        Error::not_found(
            format!("the bytes of {} are not on this disk", title(&info)),
            "upload it again",
        )
    })
}

/// A version's numbers, for the order. The descriptor's check has made sure that there are three.
fn numbers(version: &str) -> Vec<u64> {
    version.split('.').map(|part| part.parse().unwrap_or(0)).collect()
}

impl Library {
    /// Reads what is on disk. Blocks.
    pub(crate) fn open(store: Store) -> Result<Self, Error> {
        let infos = store
            .infos()?
            .into_iter()
            .map(|info| (info.digest, Arc::new(info)))
            .collect();
        let removed = store.host_value(REMOVED)?.unwrap_or_default();
        Ok(Self {
            store,
            shelves: RwLock::new(Shelves { infos, removed }),
        })
    }

    pub(crate) fn get(&self, digest: &Digest) -> Option<Arc<ComponentInfo>> {
        self.shelves.read().infos.get(digest).cloned()
    }

    /// By name, then version.
    pub(crate) fn all(&self) -> Vec<Arc<ComponentInfo>> {
        let mut all: Vec<_> = self.shelves.read().infos.values().cloned().collect();
        all.sort_by(|a, b| (&a.name, numbers(&a.version), a.digest).cmp(&(&b.name, numbers(&b.version), b.digest)));
        all
    }

    pub(crate) fn len(&self) -> usize {
        self.shelves.read().infos.len()
    }

    /// The mark of everything, for the comparison with other hosts. Removals do not count: they are told with the list.
    pub(crate) fn mark(&self) -> u64 {
        self.shelves.read().infos.values().fold(0, |sum, info| {
            let edition = info.edition();
            let parts = [edition.uploaded_at_unix_ms, edition.changes, edition.mark].map(u64::to_le_bytes);
            let [uploaded, changes, text] = &parts;
            sum ^ mark(&[info.digest.as_bytes(), uploaded, changes, text])
        })
    }

    /// Components and how new each copy is, and removals with their times.
    pub(crate) fn heads(&self) -> (Vec<(Digest, Edition)>, Vec<Dated>) {
        let shelves = self.shelves.read();
        (
            shelves.infos.values().map(|i| (i.digest, i.edition())).collect(),
            shelves.removed.clone(),
        )
    }

    /// Would this copy be news?
    pub(crate) fn wants(&self, digest: &Digest, edition: &Edition) -> bool {
        let shelves = self.shelves.read();
        let removed = shelves
            .removed
            .iter()
            .any(|(d, at_ms)| d == digest && *at_ms >= edition.uploaded_at_unix_ms);
        !removed
            && match shelves.infos.get(digest) {
                Some(known) => known.edition() < *edition,
                None => shelves.infos.len() < COMPONENTS_MAX,
            }
    }

    /// What a reference means: `name@version`, `name` (its newest version), a digest or its first digits.
    pub(crate) fn resolve(&self, reference: &str) -> Result<Arc<ComponentInfo>, Error> {
        let all = self.all();
        let (name, version) = reference
            .split_once('@')
            .map_or((reference, None), |(n, v)| (n, Some(v)));
        let named: Vec<_> = all
            .iter()
            .filter(|i| i.name == name && version.is_none_or(|v| i.version == v))
            .collect();
        let short: String = reference.chars().take(80).collect();
        if let Some(newest) = named.last() {
            let twins: Vec<_> = named.iter().filter(|i| i.version == newest.version).collect();
            if twins.len() > 1 {
                let digests = twins.iter().map(|i| i.digest.short()).collect::<Vec<_>>().join(", ");
                return Err(Error::refused(
                    format!("{} means more than one component: {digests}", title(newest)),
                    "name one by its digest, or delete the others",
                ));
            }
            return Ok(Arc::clone(newest));
        }
        let is_digest = reference.len() >= DIGITS_MIN && reference.bytes().all(|b| b.is_ascii_hexdigit());
        let digits = reference.to_ascii_lowercase();
        let mut matching = all
            .iter()
            .filter(|i| is_digest && i.digest.to_string().starts_with(&digits));
        match (matching.next(), matching.next()) {
            (Some(info), None) => Ok(Arc::clone(info)),
            (Some(_), Some(_)) => Err(Error::refused(
                format!("more than one component's digest begins with {short}"),
                "give more digits",
            )),
            (None, _) => {
                let versions: Vec<_> = all.iter().filter(|i| i.name == name).map(|i| title(i)).collect();
                let known = if versions.is_empty() {
                    all.iter().map(|i| title(i)).collect()
                } else {
                    versions
                };
                let cure = match known.as_slice() {
                    [] => "the library is empty; upload a component".to_owned(),
                    known => format!(
                        "the library has {}",
                        known.iter().take(20).cloned().collect::<Vec<_>>().join(", ")
                    ),
                };
                Err(Error::not_found(format!("there is no component {short:?}"), cure))
            }
        }
    }

    /// As [`Library::resolve`], of something that a loop can run.
    pub(crate) fn controller(&self, reference: &str) -> Result<Arc<ComponentInfo>, Error> {
        as_controller(self.resolve(reference)?)
    }

    /// May this component come in by upload? `Ok(Some)` where it is there already.
    pub(crate) fn admit(&self, info: &ComponentInfo) -> Result<Option<Arc<ComponentInfo>>, Error> {
        let shelves = self.shelves.read();
        if let Some(known) = shelves.infos.get(&info.digest) {
            return Ok(Some(Arc::clone(known)));
        }
        if let Some(other) = shelves
            .infos
            .values()
            .find(|i| i.name == info.name && i.version == info.version)
        {
            return Err(Error::refused(
                format!(
                    "the library has another component {} ({})",
                    title(info),
                    other.digest.short()
                ),
                "raise the version, or delete the old one",
            ));
        }
        if shelves.infos.len() >= COMPONENTS_MAX {
            return Err(Error::busy(
                format!("the library is full: {COMPONENTS_MAX} components"),
                "delete components that no loop uses",
            ));
        }
        Ok(None)
    }

    /// Keeps a component, bytes and summary, on disk first. The bytes are what the digest says, or nothing is kept.
    pub(crate) async fn keep(&self, info: Arc<ComponentInfo>, bytes: Option<Arc<[u8]>>) -> Result<(), Error> {
        let (store, copy) = (self.store.clone(), Arc::clone(&info));
        on_disk(move || {
            if let Some(bytes) = bytes {
                let digest = store.put_component(&bytes)?;
                if digest != copy.digest {
                    store.remove_component(&digest)?;
                    return Err(Error::internal(format!(
                        "the bytes of component {} are those of {}",
                        copy.digest.short(),
                        digest.short()
                    )));
                }
            }
            Ok(store.put_info(&copy)?)
        })
        .await??;
        self.shelves.write().infos.insert(info.digest, info);
        Ok(())
    }

    /// Takes back the upload of a time in ms of Unix time, and those before it. Says whether there was one.
    pub(crate) async fn remove(&self, digest: Digest, at_ms: u64) -> Result<bool, Error> {
        let removed = {
            let mut shelves = self.shelves.write();
            let known = shelves
                .removed
                .iter()
                .any(|(d, known_ms)| *d == digest && *known_ms >= at_ms);
            if known {
                return Ok(false);
            }
            shelves.removed.retain(|(d, _)| *d != digest);
            shelves.removed.push((digest, at_ms));
            let extra = shelves.removed.len().saturating_sub(REMOVALS_REMEMBERED_MAX);
            shelves.removed.drain(..extra);
            shelves.removed.clone()
        };
        let there = self.get(&digest).is_some_and(|info| info.uploaded_at_unix_ms <= at_ms);
        let store = self.store.clone();
        on_disk(move || {
            store.set_host_value(REMOVED, &removed)?;
            if there {
                store.remove_info(&digest)?;
                store.remove_component(&digest)?;
            }
            Ok::<_, bumpless_store::Error>(())
        })
        .await??;
        if there {
            self.shelves.write().infos.remove(&digest);
        }
        Ok(there)
    }
}
