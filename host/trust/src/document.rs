//! The document of trust: which keys count, for what, and how strict the cell is.
//!
//! Owns: its check, and the rule by which one replaces another. Never: is changed in part; each change is a new document.
//!
//! ```text
//! none ──signed by a root of its own──► number 1 ──higher number, signed by a root of the one before──► number 2 ──► …
//! ```

use std::collections::BTreeSet;

use bumpless_core::Digest;
use serde::{Deserialize, Serialize};

use crate::{Error, Hex, PublicKey, Role, SecretKey, key::check_name};

/// Keys of one document: people and build machines of a plant, with those that were revoked.
pub const KEYS_MAX: usize = 64;
/// Longest text of a document, in bytes: [`KEYS_MAX`] keys of 600 bytes.
const TEXT_BYTES_MAX: usize = 64 * 1024;
/// Signatures under one document.
const SEALS_MAX: usize = 8;
/// Longest reason of a revocation, in characters.
const REASON_CHARS_MAX: usize = 256;

/// How strict the cell is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Policy {
    /// Signatures are shown, and nobody is asked for one.
    Off,
    /// What lacks one comes in, with a warning and an alarm.
    Warn,
    /// What lacks one does not come in, and is not started.
    Required,
}

/// When and why a key counts no more.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Revocation {
    /// When it was said, in ms of Unix time.
    pub at_unix_ms: u64,
    /// Why.
    pub reason: String,
}

/// A key that the cell knows.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrustedKey {
    /// What people call it.
    pub name: String,
    /// The key.
    pub public: PublicKey,
    /// What it may do.
    pub roles: BTreeSet<Role>,
    /// Until when it counts, in ms of Unix time; for ever where none.
    pub expires_at_unix_ms: Option<u64>,
    /// It counts no more.
    pub revoked: Option<Revocation>,
}

/// What a cell trusts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Document {
    /// Its number; the first is 1, and each is higher than the one before.
    pub number: u64,
    /// When it was made, in ms of Unix time, by its maker's clock.
    pub made_at_unix_ms: u64,
    /// How strict the cell is.
    pub policy: Policy,
    /// Roles of which each component needs a signature, each by another key.
    pub needs: BTreeSet<Role>,
    /// The keys, with those that were revoked.
    pub keys: Vec<TrustedKey>,
}

/// A root key's signature under a document.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Seal {
    /// The key.
    pub key: PublicKey,
    /// ed25519 over the text, under a first line of its own.
    pub signature: Hex<64>,
}

/// A document as text, just as it was signed, and its signatures.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sealed {
    /// The document, as JSON.
    pub text: String,
    /// Who signed it.
    pub seals: Vec<Seal>,
}

fn message(text: &str) -> Vec<u8> {
    format!("bumpless trust 1\n{text}").into_bytes()
}

impl Document {
    /// A first document: nothing is asked for yet, and one root key may change that.
    #[must_use]
    pub fn first(root: TrustedKey, made_at_unix_ms: u64) -> Self {
        Self {
            number: 1,
            made_at_unix_ms,
            policy: Policy::Off,
            needs: BTreeSet::from([Role::Author]),
            keys: vec![root],
        }
    }

    /// The one that may follow it, still the same.
    #[must_use]
    pub fn next(&self, made_at_unix_ms: u64) -> Self {
        Self {
            number: self.number.saturating_add(1),
            made_at_unix_ms,
            ..self.clone()
        }
    }

    /// A key of it.
    #[must_use]
    pub fn key(&self, public: &PublicKey) -> Option<&TrustedKey> {
        self.keys.iter().find(|key| key.public == *public)
    }

    /// Makes sense by itself?
    ///
    /// # Errors
    /// [`Error::Document`], [`Error::Text`].
    pub fn check(&self) -> Result<(), Error> {
        let wrong = |reason: String| Err(Error::Document(reason));
        if self.number == 0 {
            return wrong("its number must be 1 or more".to_owned());
        }
        if self.keys.len() > KEYS_MAX {
            return wrong(format!("{} keys; at most {KEYS_MAX} are kept", self.keys.len()));
        }
        let mut seen = BTreeSet::new();
        for key in &self.keys {
            check_name("the name of a key", &key.name)?;
            if !seen.insert(key.public) {
                return wrong(format!("the key {} is in it twice", key.name));
            }
            if key.roles.is_empty() {
                return wrong(format!(
                    "the key {} has no role; give it root, author or approver",
                    key.name
                ));
            }
            if key
                .revoked
                .as_ref()
                .is_some_and(|revoked| revoked.reason.chars().count() > REASON_CHARS_MAX)
            {
                return wrong(format!(
                    "the reason for the revocation of {} has more than {REASON_CHARS_MAX} characters",
                    key.name
                ));
            }
        }
        if self.needs.contains(&Role::Root) {
            return wrong("components are signed by author and approver; root signs documents".to_owned());
        }
        if self.policy != Policy::Off && self.needs.is_empty() {
            return wrong(
                "its policy asks for signatures of nobody; name author or approver, or turn it off".to_owned(),
            );
        }
        if !self
            .keys
            .iter()
            .any(|key| key.roles.contains(&Role::Root) && key.revoked.is_none())
        {
            return wrong("no root key would be left, and nobody could change it again".to_owned());
        }
        Ok(())
    }

    /// Its text, signed.
    ///
    /// # Errors
    /// As [`Document::check`].
    pub fn seal(&self, root: &SecretKey) -> Result<Sealed, Error> {
        self.check()?;
        let text = serde_json::to_string(self).map_err(|error| Error::Document(error.to_string()))?;
        let signature = root.sign(&message(&text));
        Ok(Sealed {
            seals: vec![Seal {
                key: root.public(),
                signature,
            }],
            text,
        })
    }

    /// Did a root key of this document, which counts now, sign that one?
    fn sealed(&self, other: &Sealed, now_ms: u64) -> bool {
        other.seals.iter().take(SEALS_MAX).any(|seal| {
            self.key(&seal.key).is_some_and(|key| {
                key.roles.contains(&Role::Root)
                    && key.revoked.is_none()
                    && key.expires_at_unix_ms.is_none_or(|until| until > now_ms)
            }) && seal.key.verifies(&message(&other.text), &seal.signature)
        })
    }
}

impl Sealed {
    /// The document in it, whoever signed it.
    ///
    /// # Errors
    /// [`Error::Document`], [`Error::Text`].
    pub fn document(&self) -> Result<Document, Error> {
        if self.text.len() > TEXT_BYTES_MAX {
            return Err(Error::Document(format!("it has more than {TEXT_BYTES_MAX} bytes")));
        }
        let document: Document =
            serde_json::from_str(&self.text).map_err(|error| Error::Document(error.to_string()))?;
        document.check()?;
        Ok(document)
    }

    /// What tells two documents of one number apart.
    #[must_use]
    pub fn digest(&self) -> Digest {
        Digest::of(self.text.as_bytes())
    }

    /// The document in it, where it may replace the one in force. `pinned` are root keys that the first document must be signed by;
    /// any of its own will do where none is pinned. Of two with one number, which only two root keys at two ends of a cut cell can
    /// make, that with the greater digest wins everywhere.
    ///
    /// # Errors
    /// [`Error::Document`], [`Error::Text`], [`Error::Replace`].
    pub fn replaces(&self, in_force: Option<&Self>, pinned: &[PublicKey], now_ms: u64) -> Result<Document, Error> {
        let document = self.document()?;
        let no = |reason: &str| Err(Error::Replace(reason.to_owned()));
        let Some(in_force) = in_force else {
            let pinned_seal = |seal: &Seal| pinned.is_empty() || pinned.contains(&seal.key);
            if !document.sealed(self, now_ms) || !self.seals.iter().any(pinned_seal) {
                return no(
                    "the first one must be signed by a root key of its own, one that this host is told where it is told any",
                );
            }
            return Ok(document);
        };
        let before = in_force.document()?;
        if (document.number, self.digest()) <= (before.number, in_force.digest()) {
            return Err(Error::Replace(format!(
                "it has number {}, and number {} is in force; begin with that one",
                document.number, before.number
            )));
        }
        if !before.sealed(self, now_ms) {
            return no("no root key of the one in force signed it");
        }
        Ok(document)
    }
}

#[cfg(test)]
mod tests;
