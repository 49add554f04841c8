//! What the cell trusts, and who signed what.

use bumpless_deploy::{SignaturesView, TrustView};
use bumpless_trust as trust;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// How strict the cell is about signatures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum TrustPolicy {
    /// Nobody is asked for one.
    Off,
    /// What lacks one comes in, with a warning.
    Warn,
    /// What lacks one does not come in, and is not started.
    Required,
}

/// What a key may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum KeyRole {
    /// Signs documents of trust.
    Root,
    /// Signs what it made.
    Author,
    /// Signs what somebody else made.
    Approver,
}

/// A key that the cell knows.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct TrustedKey {
    /// What people call it.
    pub name: String,
    /// The public key: 64 hexadecimal digits.
    pub public: String,
    /// What it may do.
    pub roles: Vec<KeyRole>,
    /// Until when it counts, in ms since 1970-01-01 UTC; null for ever.
    pub expires_at_unix_ms: Option<u64>,
    /// Since when it counts no more, in ms since 1970-01-01 UTC; null where it does.
    pub revoked_at_unix_ms: Option<u64>,
    /// Why it counts no more; empty where it does.
    pub revoked_because: String,
}

/// A root key's signature under a document.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TrustSeal {
    /// The key: 64 hexadecimal digits.
    pub key: String,
    /// ed25519: 128 hexadecimal digits.
    pub signature: String,
}

/// A document of trust as it was signed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TrustDocument {
    /// The document, JSON as text, byte for byte as it was signed.
    pub text: String,
    /// Who signed it.
    pub seals: Vec<TrustSeal>,
}

/// A component that runs without a signature that is asked for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Unsigned {
    /// `name@version`.
    pub component: String,
    /// Its digest.
    pub digest: String,
    /// What it lacks, and why.
    pub reason: String,
}

/// What the cell trusts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Trust {
    /// Number of the document in force; 0 where there is none.
    pub number: u64,
    /// How strict the cell is.
    pub policy: TrustPolicy,
    /// Roles of which each component needs a signature, each by another key.
    pub needs: Vec<KeyRole>,
    /// The keys.
    pub keys: Vec<TrustedKey>,
    /// The document in force as it was signed; null where there is none.
    pub document: Option<TrustDocument>,
    /// Components that loops run without such a signature. They go on; nothing starts with them.
    pub unsigned: Vec<Unsigned>,
}

/// One signature of a component.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ComponentSignature {
    /// The component: 64 hexadecimal digits.
    pub digest: String,
    /// Its name, as it says itself.
    pub name: String,
    /// Its version, as it says itself.
    pub version: String,
    /// In which role it was signed.
    pub role: KeyRole,
    /// By which key: 64 hexadecimal digits.
    pub key: String,
    /// When, in ms since 1970-01-01 UTC, by the signer's clock.
    pub signed_at_unix_ms: u64,
    /// Until when it holds, in ms since 1970-01-01 UTC; null for ever.
    pub expires_at_unix_ms: Option<u64>,
    /// ed25519: 128 hexadecimal digits.
    pub signature: String,
}

/// Signatures of one component.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SignRequest {
    /// The signatures, 1 to 8.
    pub signatures: Vec<ComponentSignature>,
}

/// Who signed a component, and what that is worth.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Signatures {
    /// The component.
    pub digest: String,
    /// Is it signed as the cell asks?
    pub good: bool,
    /// Why not; empty where it is.
    pub reason: String,
    /// Whose signatures count: `author ann`.
    pub by: Vec<String>,
    /// All that are kept.
    pub signatures: Vec<ComponentSignature>,
}

impl From<trust::Policy> for TrustPolicy {
    fn from(policy: trust::Policy) -> Self {
        match policy {
            trust::Policy::Off => Self::Off,
            trust::Policy::Warn => Self::Warn,
            trust::Policy::Required => Self::Required,
        }
    }
}

impl From<trust::Role> for KeyRole {
    fn from(role: trust::Role) -> Self {
        match role {
            trust::Role::Root => Self::Root,
            trust::Role::Author => Self::Author,
            trust::Role::Approver => Self::Approver,
        }
    }
}

impl From<KeyRole> for trust::Role {
    fn from(role: KeyRole) -> Self {
        match role {
            KeyRole::Root => Self::Root,
            KeyRole::Author => Self::Author,
            KeyRole::Approver => Self::Approver,
        }
    }
}

impl From<trust::TrustedKey> for TrustedKey {
    fn from(key: trust::TrustedKey) -> Self {
        Self {
            name: key.name,
            public: key.public.to_string(),
            roles: key.roles.into_iter().map(Into::into).collect(),
            expires_at_unix_ms: key.expires_at_unix_ms,
            revoked_at_unix_ms: key.revoked.as_ref().map(|revoked| revoked.at_unix_ms),
            revoked_because: key.revoked.map(|revoked| revoked.reason).unwrap_or_default(),
        }
    }
}

impl From<trust::Sealed> for TrustDocument {
    fn from(sealed: trust::Sealed) -> Self {
        let seal = |seal: trust::Seal| TrustSeal {
            key: seal.key.to_string(),
            signature: seal.signature.to_string(),
        };
        Self {
            text: sealed.text,
            seals: sealed.seals.into_iter().map(seal).collect(),
        }
    }
}

impl TryFrom<TrustDocument> for trust::Sealed {
    type Error = String;

    fn try_from(document: TrustDocument) -> Result<Self, String> {
        let seal = |seal: TrustSeal| {
            Ok(trust::Seal {
                key: seal
                    .key
                    .parse()
                    .map_err(|cure| format!("key {:?}: {cure}", cut(&seal.key)))?,
                signature: seal.signature.parse().map_err(|cure| format!("signature: {cure}"))?,
            })
        };
        Ok(Self {
            text: document.text,
            seals: document.seals.into_iter().map(seal).collect::<Result<_, String>>()?,
        })
    }
}

fn cut(text: &str) -> String {
    text.chars().take(80).collect()
}

impl From<trust::Signature> for ComponentSignature {
    fn from(one: trust::Signature) -> Self {
        let trust::Signature { claim, signature } = one;
        Self {
            digest: claim.digest.to_string(),
            name: claim.name,
            version: claim.version,
            role: claim.role.into(),
            key: claim.key.to_string(),
            signed_at_unix_ms: claim.signed_at_unix_ms,
            expires_at_unix_ms: claim.expires_at_unix_ms,
            signature: signature.to_string(),
        }
    }
}

impl TryFrom<ComponentSignature> for trust::Signature {
    type Error = String;

    fn try_from(one: ComponentSignature) -> Result<Self, String> {
        Ok(Self {
            claim: trust::Claim {
                digest: one
                    .digest
                    .parse()
                    .map_err(|error: bumpless_core::digest::DigestError| error.to_string())?,
                name: one.name,
                version: one.version,
                role: one.role.into(),
                key: one
                    .key
                    .parse()
                    .map_err(|cure| format!("key {:?}: {cure}", cut(&one.key)))?,
                signed_at_unix_ms: one.signed_at_unix_ms,
                expires_at_unix_ms: one.expires_at_unix_ms,
            },
            signature: one.signature.parse().map_err(|cure| format!("signature: {cure}"))?,
        })
    }
}

impl From<TrustView> for Trust {
    fn from(view: TrustView) -> Self {
        let (number, policy) = view
            .document
            .as_ref()
            .map_or((0, trust::Policy::Off), |document| (document.number, document.policy));
        let (needs, keys) = view
            .document
            .map(|document| (document.needs, document.keys))
            .unwrap_or_default();
        let unsigned = |(component, digest, reason): (String, bumpless_core::Digest, String)| Unsigned {
            component,
            digest: digest.to_string(),
            reason,
        };
        Self {
            number,
            policy: policy.into(),
            needs: needs.into_iter().map(Into::into).collect(),
            keys: keys.into_iter().map(Into::into).collect(),
            document: view.sealed.map(Into::into),
            unsigned: view.wanting.into_iter().map(unsigned).collect(),
        }
    }
}

impl From<SignaturesView> for Signatures {
    fn from(view: SignaturesView) -> Self {
        let good = view.judgement.is_good();
        Self {
            digest: view.digest.to_string(),
            good,
            reason: if good { String::new() } else { view.judgement.words() },
            by: view
                .judgement
                .by
                .iter()
                .map(|(role, name)| format!("{role} {name}"))
                .collect(),
            signatures: view.signatures.into_iter().map(Into::into).collect(),
        }
    }
}
