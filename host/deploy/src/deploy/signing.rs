//! The facade's part for signatures: what the cell trusts, and who signed what.
//!
//! Never: decides; `signing` and `bumpless-trust` do.

use bumpless_core::Digest;
use bumpless_trust::{Document, Sealed, Signature, TrustedKey};
use serde_json::{Value, json};

use super::Deploy;
use crate::{
    audit::{Act, AuditKind, Seen, shown},
    error::Error,
    signing::{SignaturesView, TrustView},
};

/// What an entry tells of a document: each key under its name, so that a change shows which one it is about.
fn told(document: Option<&Document>) -> Value {
    let Some(document) = document else { return Value::Null };
    let key = |key: &TrustedKey| {
        let roles: Vec<String> = key.roles.iter().map(ToString::to_string).collect();
        let mut text = format!("{} {}", key.public.short(), roles.join(", "));
        if let Some(revoked) = &key.revoked {
            text.push_str(", revoked: ");
            text.push_str(&revoked.reason);
        }
        (key.name.clone(), Value::from(text))
    };
    json!({
        "number": document.number,
        "policy": shown(&document.policy),
        "needs": shown(&document.needs),
        "keys": document.keys.iter().map(key).collect::<serde_json::Map<String, Value>>(),
    })
}

impl Deploy {
    /// What the cell trusts, as far as this host knows.
    #[must_use]
    pub fn trust(&self) -> TrustView {
        self.room.trust_view()
    }

    /// Puts a document of trust into force on all hosts. It must be signed by a root key of the one in force.
    ///
    /// # Errors
    /// [`Error::Refused`] with the reason, [`Error::Store`].
    pub async fn put_trust(&self, sealed: Sealed) -> Result<TrustView, Error> {
        let room = self.room.clone();
        let asked = json!({ "number": sealed.document().map_or(0, |document| document.number) });
        let work = async move {
            let before = told(room.trust_view().document.as_ref());
            let end = room.put_trust(sealed).await;
            let seen = match &end {
                Ok(view) => Seen::of(before, told(view.document.as_ref())),
                Err(_) => Seen::default(),
            };
            (end, seen)
        };
        self.room
            .audited(Act::new(AuditKind::TrustChange, "", asked), work)
            .await
    }

    /// The signatures of a component, and what they are worth now.
    #[must_use]
    pub fn signatures(&self, digest: &Digest) -> SignaturesView {
        self.room.signatures(digest)
    }

    /// Takes signatures of a component, which may come before the component does.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a signature that was not made by the key that it names over this component, [`Error::Busy`],
    /// [`Error::Store`].
    pub async fn sign(&self, digest: Digest, signatures: Vec<Signature>) -> Result<SignaturesView, Error> {
        let room = self.room.clone();
        let asked: Vec<Value> = signatures
            .iter()
            .take(bumpless_trust::SIGNATURES_MAX)
            .map(|one| json!({ "key": one.claim.key.short(), "role": one.claim.role.to_string() }))
            .collect();
        let target = digest.to_string();
        let work = async move { (room.sign(digest, &signatures).await, Seen::default()) };
        self.room
            .audited(Act::new(AuditKind::ComponentSign, &target, json!(asked)), work)
            .await
    }
}
