//! Signatures of components, and what they are worth under a document.
//!
//! Owns: the bytes that are signed, and the judgement. Never: keeps anything.

use std::{collections::BTreeSet, fmt};

use bumpless_core::Digest;
use serde::{Deserialize, Serialize};

use crate::{Document, Error, Hex, Policy, PublicKey, SecretKey, key::check_name};

/// Signatures of one component that are kept: some of each role, and as many from keys that have gone.
pub const SIGNATURES_MAX: usize = 8;

/// What a key may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Signs documents of trust.
    Root,
    /// Signs what it made.
    Author,
    /// Signs what it looked at, and somebody else made.
    Approver,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Root => "root",
            Self::Author => "author",
            Self::Approver => "approver",
        })
    }
}

/// What is said of a component.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Claim {
    /// Its bytes.
    pub digest: Digest,
    /// Its name, as it says itself.
    pub name: String,
    /// Its version, as it says itself.
    pub version: String,
    /// In which role it was signed.
    pub role: Role,
    /// By which key.
    pub key: PublicKey,
    /// When, in ms of Unix time, by the signer's clock.
    pub signed_at_unix_ms: u64,
    /// Until when it holds, in ms of Unix time; for ever where none.
    pub expires_at_unix_ms: Option<u64>,
}

/// A claim with the proof that its key made it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Signature {
    /// What is said.
    pub claim: Claim,
    /// ed25519 over [`Claim::message`].
    pub signature: Hex<64>,
}

impl Claim {
    /// The bytes that are signed: one field per line, under a first line that no other use of a key has.
    #[must_use]
    pub fn message(&self) -> Vec<u8> {
        let expires = self
            .expires_at_unix_ms
            .map_or_else(|| "-".to_owned(), |ms| ms.to_string());
        format!(
            "bumpless component 1\n{}\n{}\n{}\n{}\n{}\n{}\n{expires}\n",
            self.digest, self.name, self.version, self.role, self.key, self.signed_at_unix_ms
        )
        .into_bytes()
    }

    fn check(&self) -> Result<(), Error> {
        // A line feed in a name would shift the lines that are signed.
        check_name("the name of a signed component", &self.name)?;
        check_name("the version of a signed component", &self.version)?;
        if self.role == Role::Root {
            return Err(Error::Text {
                what: "the role of a signature",
                text: self.role.to_string(),
                cure: "components are signed as author or approver; root keys sign documents of trust",
            });
        }
        Ok(())
    }
}

impl Signature {
    /// Signs a claim; its key is set to the signing one.
    ///
    /// # Errors
    /// [`Error::Text`] for names or the role.
    pub fn make(mut claim: Claim, key: &SecretKey) -> Result<Self, Error> {
        claim.key = key.public();
        claim.check()?;
        let signature = key.sign(&claim.message());
        Ok(Self { claim, signature })
    }

    /// Is it whole: made by the key that it names, over what it says?
    ///
    /// # Errors
    /// [`Error::Signature`], [`Error::Text`].
    pub fn check(&self) -> Result<(), Error> {
        self.claim.check()?;
        if self.claim.key.verifies(&self.claim.message(), &self.signature) {
            return Ok(());
        }
        Err(self.not("it was not made by that key over this component; sign it again"))
    }

    fn not(&self, reason: impl Into<String>) -> Error {
        Error::Signature {
            key: self.claim.key.short(),
            reason: reason.into(),
        }
    }

    /// Does it count under a document, now, in ms of Unix time? Gives the name of its key.
    ///
    /// # Errors
    /// [`Error::Signature`] with the reason.
    pub fn counts<'a>(&self, document: &'a Document, digest: &Digest, now_ms: u64) -> Result<&'a str, Error> {
        self.check()?;
        if self.claim.digest != *digest {
            return Err(self.not("it is of another component"));
        }
        let Some(key) = document.key(&self.claim.key) else {
            return Err(self.not("the cell does not know the key; a root key can add it"));
        };
        if let Some(revoked) = &key.revoked {
            return Err(self.not(format!("the key {} was revoked: {}", key.name, revoked.reason)));
        }
        if !key.roles.contains(&self.claim.role) {
            return Err(self.not(format!("the key {} is no {}", key.name, self.claim.role)));
        }
        let over = |until: Option<u64>| until.is_some_and(|until| until <= now_ms);
        if over(key.expires_at_unix_ms) {
            return Err(self.not(format!("the key {} has expired", key.name)));
        }
        if over(self.claim.expires_at_unix_ms) {
            return Err(self.not("it has expired; sign the component again"));
        }
        Ok(&key.name)
    }
}

/// What a component's signatures are worth.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Judgement {
    /// Roles that are filled, by the name of whose key.
    pub by: Vec<(Role, String)>,
    /// Roles that the document asks for and nobody fills.
    pub wanting: Vec<Role>,
    /// Why signatures that are there do not count.
    pub reasons: Vec<String>,
}

impl Judgement {
    /// Is it signed as the document asks?
    #[must_use]
    pub fn is_good(&self) -> bool {
        self.wanting.is_empty()
    }

    /// What is wanting, in words.
    #[must_use]
    pub fn words(&self) -> String {
        let roles: Vec<String> = self.wanting.iter().map(ToString::to_string).collect();
        let mut text = format!("it lacks a valid signature of {}", roles.join(" and "));
        if !self.reasons.is_empty() {
            text.push_str(" (");
            text.push_str(&self.reasons.join("; "));
            text.push(')');
        }
        text
    }
}

/// Judges a component: each role that the document asks for must be filled by a key of its own. Where there is no document, or its
/// policy is off, nothing is asked for.
#[must_use]
pub fn judge(document: Option<&Document>, digest: &Digest, signatures: &[Signature], now_ms: u64) -> Judgement {
    let mut judgement = Judgement {
        by: Vec::new(),
        wanting: Vec::new(),
        reasons: Vec::new(),
    };
    let Some(document) = document else { return judgement };
    let mut counted: Vec<(Role, PublicKey, &str)> = Vec::new();
    for signature in signatures.iter().take(SIGNATURES_MAX) {
        match signature.counts(document, digest, now_ms) {
            Ok(name) => counted.push((signature.claim.role, signature.claim.key, name)),
            Err(error) => judgement.reasons.push(error.to_string()),
        }
    }
    let needs: Vec<Role> = if document.policy == Policy::Off {
        Vec::new()
    } else {
        document.needs.iter().copied().collect()
    };
    // Each role a key of its own: with two roles and few keys every choice can be tried.
    let filled = fill(&needs, &counted, &BTreeSet::new());
    for (role, _, name) in &filled {
        judgement.by.push((*role, (*name).to_owned()));
    }
    judgement.wanting = needs
        .into_iter()
        .filter(|role| filled.iter().all(|(filled, ..)| filled != role))
        .collect();
    for (role, _, name) in counted {
        let entry = (role, name.to_owned());
        if !judgement.by.contains(&entry) {
            judgement.by.push(entry);
        }
    }
    judgement
}

/// The greatest choice of signatures in which no key stands twice; of equal ones the one that fills the first roles.
fn fill<'a>(
    needs: &[Role],
    counted: &[(Role, PublicKey, &'a str)],
    taken: &BTreeSet<PublicKey>,
) -> Vec<(Role, PublicKey, &'a str)> {
    let Some((role, rest)) = needs.split_first() else {
        return Vec::new();
    };
    let mut best = fill(rest, counted, taken);
    for signature in counted.iter().filter(|(of, key, _)| of == role && !taken.contains(key)) {
        let mut taken = taken.clone();
        taken.insert(signature.1);
        let mut filled = fill(rest, counted, &taken);
        filled.insert(0, *signature);
        let skips = best.first().is_none_or(|(of, ..)| of != role);
        if filled.len() > best.len() || skips && filled.len() == best.len() {
            best = filled;
        }
    }
    best
}
