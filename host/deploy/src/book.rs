//! The intents of the cell, in memory and on disk, and how new each copy is.
//!
//! Owns: that what is in memory is on disk first, and that a newer copy wins wherever it comes from.
//! Never: decides what shall run.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use bumpless_core::{Digest, HostId, Intent, LoopId, PointId};
use bumpless_store::{Store, Tombstone};
use parking_lot::RwLock;

use crate::{
    error::{Error, Words},
    wire::Position,
};

/// A mark of one entry: equal for equal entries on every host and version. Marks are joined by xor, so their order does
/// not matter and one entry can be taken out again. FNV-1a with SplitMix64's last mix: nobody gains by forging it, a
/// missed difference only waits for the next change.
pub(crate) fn mark(parts: &[&[u8]]) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for part in parts {
        // The length keeps ("ab", "c") apart from ("a", "bc").
        for byte in part.iter().copied().chain((part.len() as u64).to_le_bytes()) {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
    hash = (hash ^ (hash >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    hash = (hash ^ (hash >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    hash ^ (hash >> 31)
}

fn mark_of(id: &LoopId, position: Position) -> u64 {
    mark(&[
        id.as_str().as_bytes(),
        &position.0.to_le_bytes(),
        &position.1.to_le_bytes(),
    ])
}

/// Runs what waits for the disk off the async threads.
pub(crate) async fn on_disk<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Error> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|error| Error::internal(format!("work for the disk ended badly: {error}")))
}

#[derive(Debug, Default)]
struct Pages {
    intents: BTreeMap<LoopId, Arc<Intent>>,
    removed: BTreeMap<LoopId, u64>,
    mark: u64,
}

impl Pages {
    fn insert(&mut self, intent: Arc<Intent>) -> bool {
        let id = intent.loop_id.clone();
        let position = intent.position();
        if self.intents.get(&id).is_some_and(|old| old.position() >= position) {
            return false;
        }
        if let Some(old) = self.intents.insert(id.clone(), intent) {
            self.mark ^= mark_of(&id, old.position());
        }
        self.mark ^= mark_of(&id, position);
        true
    }

    fn remove(&mut self, tombstone: &Tombstone) -> bool {
        let id = &tombstone.loop_id;
        let last = self.removed.entry(id.clone()).or_default();
        *last = (*last).max(tombstone.last_revision);
        match self.intents.get(id).map(|i| i.position()) {
            Some(position) if position.0 <= tombstone.last_revision => {
                self.mark ^= mark_of(id, position);
                self.intents.remove(id);
                true
            }
            _ => false,
        }
    }
}

/// All intents.
#[derive(Debug)]
pub(crate) struct Book {
    store: Store,
    pages: RwLock<Pages>,
    /// Loops that the disk knew when this host started.
    from_disk: BTreeSet<LoopId>,
}

impl Book {
    /// Reads what is on disk. Blocks.
    pub(crate) fn open(store: Store) -> Result<Self, Error> {
        let mut pages = Pages::default();
        for tombstone in store.tombstones()? {
            pages.remove(&tombstone);
        }
        for intent in store.intents()? {
            pages.insert(Arc::new(intent));
        }
        Ok(Self {
            store,
            from_disk: pages.intents.keys().cloned().collect(),
            pages: RwLock::new(pages),
        })
    }

    /// Did the disk know the loop when this host started? Then it may have had an owner in an earlier life of this host.
    pub(crate) fn was_there(&self, id: &LoopId) -> bool {
        self.from_disk.contains(id)
    }

    pub(crate) fn get(&self, id: &LoopId) -> Option<Arc<Intent>> {
        self.pages.read().intents.get(id).cloned()
    }

    /// The intent, or the error for people.
    pub(crate) fn find(&self, id: &LoopId) -> Result<Arc<Intent>, Error> {
        self.get(id)
            .ok_or_else(|| Error::not_found(format!("there is no loop {id:?}"), "list the loops for their names"))
    }

    pub(crate) fn all(&self) -> Vec<Arc<Intent>> {
        self.pages.read().intents.values().cloned().collect()
    }

    pub(crate) fn len(&self) -> usize {
        self.pages.read().intents.len()
    }

    /// The mark of everything, for the comparison with other hosts.
    pub(crate) fn mark(&self) -> u64 {
        self.pages.read().mark
    }

    /// How new each copy is, and what was removed and did not come again.
    pub(crate) fn heads(&self) -> (Vec<(LoopId, Position)>, Vec<Tombstone>) {
        let pages = self.pages.read();
        let heads = pages
            .intents
            .iter()
            .map(|(id, intent)| (id.clone(), intent.position()))
            .collect();
        let gone = pages.removed.iter().filter(|(id, _)| !pages.intents.contains_key(*id));
        let gone = gone
            .map(|(id, &last_revision)| Tombstone {
                loop_id: id.clone(),
                last_revision,
            })
            .collect();
        (heads, gone)
    }

    /// Would a copy of this position be news?
    pub(crate) fn wants(&self, id: &LoopId, position: Position) -> bool {
        let pages = self.pages.read();
        let dead = pages.removed.get(id).is_some_and(|&last| position.0 <= last);
        !dead && pages.intents.get(id).is_none_or(|held| held.position() < position)
    }

    /// Would this removal be news?
    pub(crate) fn mourns(&self, tombstone: &Tombstone) -> bool {
        let pages = self.pages.read();
        pages
            .removed
            .get(&tombstone.loop_id)
            .is_none_or(|&last| last < tombstone.last_revision)
    }

    /// Keeps a copy, on disk first. Says whether it was news; an older one is not, and is no error.
    pub(crate) async fn keep(&self, intent: Arc<Intent>) -> Result<bool, Error> {
        let (store, copy) = (self.store.clone(), Arc::clone(&intent));
        match on_disk(move || store.put_intent(&copy)).await? {
            Ok(()) => Ok(self.pages.write().insert(intent)),
            Err(bumpless_store::Error::Stale { .. } | bumpless_store::Error::Removed { .. }) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    /// Keeps a change that is made here: an older copy is an error then.
    pub(crate) async fn change(&self, intent: Intent) -> Result<Arc<Intent>, Error> {
        let intent = Arc::new(intent);
        let (store, copy) = (self.store.clone(), Arc::clone(&intent));
        on_disk(move || store.put_intent(&copy))
            .await?
            .map_err(|error| match error {
                bumpless_store::Error::Stale { .. } | bumpless_store::Error::Removed { .. } => {
                    Error::Busy(Words::new(crate::error::chain(&error), ""))
                }
                other => other.into(),
            })?;
        self.pages.write().insert(Arc::clone(&intent));
        Ok(intent)
    }

    /// Removes a loop, on disk first; none where there was none.
    pub(crate) async fn remove(&self, id: &LoopId) -> Result<Option<Tombstone>, Error> {
        let (store, copy) = (self.store.clone(), id.clone());
        let tombstone = on_disk(move || store.remove_intent(&copy)).await??;
        if let Some(tombstone) = &tombstone {
            self.pages.write().remove(tombstone);
        }
        Ok(tombstone)
    }

    /// Takes another host's word that a loop was removed, on disk first. Says whether one was removed here.
    pub(crate) async fn bury(&self, tombstone: Tombstone) -> Result<bool, Error> {
        let (store, copy) = (self.store.clone(), tombstone.clone());
        on_disk(move || store.put_tombstone(&copy)).await??;
        Ok(self.pages.write().remove(&tombstone))
    }

    /// The last revision of a removed loop of this name; 0 where there was none.
    pub(crate) async fn last_removed(&self, id: &LoopId) -> Result<u64, Error> {
        let (store, id) = (self.store.clone(), id.clone());
        Ok(on_disk(move || store.last_removed_revision(&id)).await??)
    }

    /// The loop that writes this point now, or is about to. A specification's limits name its connected outputs.
    pub(crate) fn writer_of(&self, point: &PointId, except: Option<&LoopId>) -> Option<LoopId> {
        let pages = self.pages.read();
        let writes = |intent: &Intent| {
            std::iter::once(&intent.current)
                .chain(&intent.pending)
                .any(|spec| spec.limits.keys().any(|port| spec.ports.get(port) == Some(point)))
        };
        pages
            .intents
            .values()
            .find(|i| Some(&i.loop_id) != except && writes(i))
            .map(|i| i.loop_id.clone())
    }

    /// All written points with their loops.
    pub(crate) fn writers(&self) -> BTreeMap<PointId, LoopId> {
        let pages = self.pages.read();
        let mut writers = BTreeMap::new();
        for intent in pages.intents.values() {
            for point in intent
                .current
                .limits
                .keys()
                .filter_map(|port| intent.current.ports.get(port))
            {
                writers.insert(point.clone(), intent.loop_id.clone());
            }
        }
        writers
    }

    /// The loops that need each component: for what runs, for what is on its way, and for every earlier revision that can
    /// be gone back to, with their fallbacks.
    pub(crate) fn users(&self) -> BTreeMap<Digest, Vec<LoopId>> {
        let mut users: BTreeMap<Digest, Vec<LoopId>> = BTreeMap::new();
        for intent in self.pages.read().intents.values() {
            for digest in intent.components() {
                users.entry(digest).or_default().push(intent.loop_id.clone());
            }
        }
        users
    }

    /// The home of a loop.
    pub(crate) fn home(&self, id: &LoopId) -> Result<HostId, Error> {
        self.find(id).map(|intent| intent.home.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::mark;

    #[test]
    fn marks_tell_parts_apart() {
        assert_ne!(mark(&[b"ab", b"c"]), mark(&[b"a", b"bc"]));
        assert_ne!(mark(&[b"a"]), mark(&[b"b"]));
        assert_eq!(mark(&[b"a"]) ^ mark(&[b"b"]) ^ mark(&[b"a"]), mark(&[b"b"]));
    }
}
