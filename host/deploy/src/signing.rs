//! Whose components this cell takes: the document of trust and the signatures of components, alike on all hosts.
//!
//! Owns: both in memory and on disk, and where they are asked for: at an upload, before a loop starts a component, and again on
//! every host that makes it ready. Never: judges by itself; `bumpless-trust` does.
//!
//! ```text
//! signatures ──whole?──► kept ──┐
//! document ──signed by a root of the one in force?──► kept ──► told to all ──► each judges for itself
//!                               └─► upload, start, load: good ─► go on │ wanting: warn ─► words, alarm │ required ─► refused
//! ```
//! What runs goes on: a key that is revoked must not stop a plant. Its components stand in an alarm of the host until they are
//! signed anew or changed, and nothing starts with them.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use bumpless_core::{ComponentInfo, Digest, HostId};
use bumpless_store::Store;
use bumpless_trust::{Document, Judgement, Policy, PublicKey, SIGNATURES_MAX, Sealed, Signature, judge};
use parking_lot::RwLock;
use serde::{Deserialize, Serialize};

use crate::{
    book::{mark, on_disk},
    error::Error,
    library::title,
    limits::{ANSWER_WAIT, COMPONENTS_MAX},
    room::{Room, count},
    wire::{Ask, Told},
};

/// Row of the document; no digest is named so.
const DOCUMENT: &str = "document";
/// Components with signatures: those of the library, and as many that are signed before they are uploaded.
const SIGNED_MAX: usize = 2 * COMPONENTS_MAX;
/// Longest list in words.
const NAMED_MAX: usize = 8;

/// Everything, as hosts tell it each other.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct TrustTold {
    pub(crate) document: Option<Sealed>,
    pub(crate) signatures: Vec<(Digest, Vec<Signature>)>,
}

#[derive(Debug, Default)]
struct Kept {
    sealed: Option<Sealed>,
    /// What is in `sealed`.
    document: Option<Document>,
    signatures: BTreeMap<Digest, Vec<Signature>>,
    mark: u64,
}

impl Kept {
    fn remark(&mut self) {
        let document = self.sealed.iter().map(|sealed| mark(&[sealed.text.as_bytes()]));
        let signatures = self
            .signatures
            .values()
            .flatten()
            .map(|one| mark(&[&one.claim.message(), &one.signature.0]));
        self.mark = document.chain(signatures).fold(0, |all, one| all ^ one);
    }
}

/// What is trusted here.
#[derive(Debug)]
pub(crate) struct Signing {
    store: Store,
    /// Root keys that this host was told: the first document must be signed by one of them.
    pinned: Vec<PublicKey>,
    kept: RwLock<Kept>,
    /// One change at a time.
    changing: tokio::sync::Mutex<()>,
}

/// What the cell trusts, for people.
#[derive(Debug, Clone, PartialEq)]
pub struct TrustView {
    /// The document in force, as it was signed; none where there is none.
    pub sealed: Option<Sealed>,
    /// What is in it.
    pub document: Option<Document>,
    /// Components that loops run, and that lack a signature that the document asks for: title, digest and why.
    pub wanting: Vec<(String, Digest, String)>,
}

/// The signatures of a component, for people.
#[derive(Debug, Clone, PartialEq)]
pub struct SignaturesView {
    /// The component.
    pub digest: Digest,
    /// All that are kept.
    pub signatures: Vec<Signature>,
    /// What they are worth now.
    pub judgement: Judgement,
}

fn refused(error: &bumpless_trust::Error) -> Error {
    Error::refused(error.to_string(), "")
}

impl Signing {
    /// Reads what is on disk. Blocks.
    pub(crate) fn open(store: Store, pinned: Vec<PublicKey>) -> Result<Self, Error> {
        let mut kept = Kept::default();
        for (_, sealed) in store.trust::<Sealed>(|name| name == DOCUMENT)? {
            match sealed.document() {
                Ok(document) => {
                    kept.document = Some(document);
                    kept.sealed = Some(sealed);
                }
                // A host that forgets what it trusts would take anything.
                Err(error) => {
                    return Err(Error::Store(crate::error::Words::new(
                        format!("the document of trust on the disk cannot be read: {error}"),
                        "restore the host's data, or empty its folder so that it takes the document from another host",
                    )));
                }
            }
        }
        for (name, signatures) in store.trust::<Vec<Signature>>(|name| name != DOCUMENT)? {
            if let Ok(digest) = name.parse() {
                kept.signatures.insert(digest, signatures);
            }
        }
        kept.remark();
        Ok(Self {
            store,
            pinned,
            kept: RwLock::new(kept),
            changing: tokio::sync::Mutex::default(),
        })
    }

    /// The mark of everything, for the comparison with other hosts.
    pub(crate) fn mark(&self) -> u64 {
        self.kept.read().mark
    }

    fn told(&self) -> TrustTold {
        let kept = self.kept.read();
        TrustTold {
            document: kept.sealed.clone(),
            signatures: kept.signatures.iter().map(|(d, s)| (*d, s.clone())).collect(),
        }
    }

    fn judge(&self, digest: &Digest, now_ms: u64) -> (Policy, Judgement) {
        let kept = self.kept.read();
        let none = Vec::new();
        let signatures = kept.signatures.get(digest).unwrap_or(&none);
        let policy = kept.document.as_ref().map_or(Policy::Off, |document| document.policy);
        (policy, judge(kept.document.as_ref(), digest, signatures, now_ms))
    }

    /// Takes a document that may replace the one in force. Says whether it was news.
    async fn take_document(&self, sealed: Sealed, now_ms: u64) -> Result<bool, Error> {
        let _turn = self.changing.lock().await;
        let in_force = self.kept.read().sealed.clone();
        if in_force.as_ref() == Some(&sealed) {
            return Ok(false);
        }
        let document = sealed
            .replaces(in_force.as_ref(), &self.pinned, now_ms)
            .map_err(|error| refused(&error))?;
        let (store, copy) = (self.store.clone(), sealed.clone());
        on_disk(move || store.put_trust(DOCUMENT, &copy)).await??;
        let mut kept = self.kept.write();
        (kept.sealed, kept.document) = (Some(sealed), Some(document));
        kept.remark();
        Ok(true)
    }

    /// Takes signatures of a component beside those that there are. Says whether one was news.
    async fn take_signatures(&self, digest: Digest, new: &[Signature], now_ms: u64) -> Result<bool, Error> {
        for one in new.iter().take(SIGNATURES_MAX) {
            one.check().map_err(|error| Error::invalid(error.to_string(), ""))?;
            if one.claim.digest != digest {
                return Err(Error::invalid(
                    format!("a signature of {} is of another component", one.claim.key.short()),
                    "sign the component that is meant",
                ));
            }
        }
        let _turn = self.changing.lock().await;
        let mut all = {
            let kept = self.kept.read();
            let known = kept.signatures.get(&digest);
            if known.is_none() && kept.signatures.len() >= SIGNED_MAX {
                return Err(Error::busy(
                    format!("{SIGNED_MAX} components are signed, the most that are kept"),
                    "delete components that no loop uses",
                ));
            }
            let mut all: BTreeSet<Signature> = known.into_iter().flatten().cloned().collect();
            let before = all.len();
            all.extend(new.iter().take(SIGNATURES_MAX).cloned());
            if all.len() == before {
                return Ok(false);
            }
            let mut all: Vec<Signature> = all.into_iter().collect();
            // Where there are more than are kept, those that count stay; all hosts choose alike.
            if let Some(document) = &kept.document {
                all.sort_by_key(|one| one.counts(document, &digest, now_ms).is_err());
            }
            all
        };
        all.truncate(SIGNATURES_MAX);
        if self.kept.read().signatures.get(&digest) == Some(&all) {
            return Ok(false);
        }
        let (store, copy) = (self.store.clone(), all.clone());
        on_disk(move || store.put_trust(&digest.to_string(), &copy)).await??;
        let mut kept = self.kept.write();
        kept.signatures.insert(digest, all);
        kept.remark();
        Ok(true)
    }

    /// Forgets the signatures of a removed component.
    pub(crate) async fn forget(&self, digest: &Digest) -> Result<(), Error> {
        let _turn = self.changing.lock().await;
        if self.kept.read().signatures.contains_key(digest) {
            let (store, name) = (self.store.clone(), digest.to_string());
            on_disk(move || store.remove_trust(&name)).await??;
            let mut kept = self.kept.write();
            kept.signatures.remove(digest);
            kept.remark();
        }
        Ok(())
    }
}

impl Room {
    /// The mark of library and trust together.
    pub(crate) fn library_mark(&self) -> u64 {
        self.library.mark() ^ self.signing.mark().rotate_left(7)
    }

    /// Everything that this host trusts.
    pub(crate) fn trust_told(&self) -> Told {
        Told::Trust(Box::new(self.signing.told()))
    }

    /// May this component come in, or start? Words of warning, or a refusal.
    pub(crate) fn signed(&self, name: &str, digest: &Digest) -> Result<Option<String>, Error> {
        let (policy, judgement) = self.signing.judge(digest, self.clock.unix_ms());
        if policy == Policy::Off || judgement.is_good() {
            return Ok(None);
        }
        let words = format!("{name} is not signed as this cell asks: {}", judgement.words());
        if policy == Policy::Warn {
            return Ok(Some(words));
        }
        Err(Error::refused(
            words,
            "sign it with a key that the cell trusts: bumpless sign FILE --key KEY, then upload it again",
        ))
    }

    /// As [`Room::signed`], for a component that a loop or a program shall start. What it runs, or falls back to by itself, may go on.
    pub(crate) fn may_start(&self, info: &ComponentInfo, goes_on: bool) -> Result<Option<String>, Error> {
        match self.signed(&title(info), &info.digest) {
            Err(error) if goes_on => Ok(Some(error.words().reason.clone())),
            end => end,
        }
    }

    /// May this host make the component ready? Asked again on every host, for whoever asked may have been deceived.
    pub(crate) fn may_load(&self, digest: &Digest) -> Result<(), Error> {
        let name = self
            .library
            .get(digest)
            .map_or_else(|| digest.short(), |info| title(&info));
        let end = self.signed(&name, digest).map(drop);
        // A program is known to its home and its standbys alone: those may go on with it, a host that never had it begins nothing.
        if end.is_err() && (self.in_force().contains(digest) || !self.programs.users(digest).is_empty()) {
            return Ok(());
        }
        end
    }

    /// Components that loops run now, or fall back to.
    fn in_force(&self) -> BTreeSet<Digest> {
        let all = self.book.all();
        all.iter()
            .flat_map(|intent| std::iter::once(intent.current.digest).chain(intent.current.fallback))
            .collect()
    }

    /// Components in force that lack a signature: title, digest and why.
    pub(crate) fn wanting(&self) -> Vec<(String, Digest, String)> {
        let now_ms = self.clock.unix_ms();
        let of = |digest: Digest| {
            let (policy, judgement) = self.signing.judge(&digest, now_ms);
            if policy == Policy::Off || judgement.is_good() {
                return None;
            }
            let name = self
                .library
                .get(&digest)
                .map_or_else(|| digest.short(), |info| title(&info));
            Some((name, digest, judgement.words()))
        };
        self.in_force().into_iter().filter_map(of).collect()
    }

    /// What the cell trusts.
    pub(crate) fn trust_view(&self) -> TrustView {
        let (sealed, document) = {
            let kept = self.signing.kept.read();
            (kept.sealed.clone(), kept.document.clone())
        };
        TrustView {
            sealed,
            document,
            wanting: self.wanting(),
        }
    }

    /// Puts a document into force, here and on all hosts.
    pub(crate) async fn put_trust(self: &Arc<Self>, sealed: Sealed) -> Result<TrustView, Error> {
        if self.signing.take_document(sealed, self.clock.unix_ms()).await? {
            self.trust_changed();
        }
        Ok(self.trust_view())
    }

    /// The signatures of a component, be it in the library or not.
    pub(crate) fn signatures(&self, digest: &Digest) -> SignaturesView {
        let signatures = self.signing.kept.read().signatures.get(digest).cloned();
        SignaturesView {
            digest: *digest,
            signatures: signatures.unwrap_or_default(),
            judgement: self.signing.judge(digest, self.clock.unix_ms()).1,
        }
    }

    /// Takes signatures of a component, which may come before it does.
    pub(crate) async fn sign(
        self: &Arc<Self>,
        digest: Digest,
        signatures: &[Signature],
    ) -> Result<SignaturesView, Error> {
        if signatures.is_empty() || signatures.len() > SIGNATURES_MAX {
            return Err(Error::invalid(
                format!("{} signatures: 1 to {SIGNATURES_MAX} are taken", signatures.len()),
                "send others",
            ));
        }
        if self
            .signing
            .take_signatures(digest, signatures, self.clock.unix_ms())
            .await?
        {
            self.trust_changed();
        }
        Ok(self.signatures(&digest))
    }

    /// Others hear of it at once, and a component that was kept out may be made ready now.
    fn trust_changed(self: &Arc<Self>) {
        self.announce_standing();
        self.poke();
        let wanting = self.wanting();
        if !wanting.is_empty() {
            let names: Vec<&str> = wanting.iter().take(NAMED_MAX).map(|(name, ..)| name.as_str()).collect();
            tracing::warn!(
                components = names.join(", "),
                "loops run components that are not signed as the cell asks"
            );
        }
    }

    /// Takes what another host trusts and this one may.
    pub(crate) async fn compare_trust(self: &Arc<Self>, from: &HostId) -> Result<(), Error> {
        let Told::Trust(told) = self.ask(from, Ask::Trust, ANSWER_WAIT).await? else {
            return Err(Error::internal("the answer is not what is trusted"));
        };
        let TrustTold { document, signatures } = *told;
        let now_ms = self.clock.unix_ms();
        let mut changed = false;
        if let Some(sealed) = document {
            match self.signing.take_document(sealed, now_ms).await {
                Ok(news) => changed |= news,
                // Most often it is the older one, and the other host takes ours.
                Err(error) => tracing::debug!(%from, %error, "a document of trust was not taken"),
            }
        }
        for (digest, signatures) in signatures.iter().take(SIGNED_MAX) {
            match self.signing.take_signatures(*digest, signatures, now_ms).await {
                Ok(news) => changed |= news,
                Err(error @ Error::Store(_)) => return Err(error),
                Err(error) => {
                    count(&self.tallies.malformed);
                    tracing::debug!(%from, %error, "signatures were not taken");
                }
            }
        }
        if changed {
            self.trust_changed();
        }
        Ok(())
    }
}
