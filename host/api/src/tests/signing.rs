//! The routes about trust and signatures: what is asked arrives, what is no key and no signature is refused in words.

use axum::http::StatusCode;
use bumpless_core::Digest;
use bumpless_deploy::{SignaturesView, TrustView};
use bumpless_trust::{Claim, Document, Hex, Judgement, Policy, Revocation, Role, Seal, Sealed, Signature, TrustedKey};
use serde_json::json;

use super::{Bench, fake::Fake, get, send};
use crate::{cell::Answer, signing::Signing};

fn key(name: &str, byte: u8, roles: &[Role]) -> TrustedKey {
    TrustedKey {
        name: name.to_owned(),
        public: Hex([byte; 32]),
        roles: roles.iter().copied().collect(),
        expires_at_unix_ms: None,
        revoked: None,
    }
}

fn view(sealed: Option<Sealed>) -> TrustView {
    let mut document = Document::first(key("root", 1, &[Role::Root]), 1_000);
    document.policy = Policy::Required;
    document.keys.push(TrustedKey {
        revoked: Some(Revocation {
            at_unix_ms: 2_000,
            reason: "it was lost".to_owned(),
        }),
        ..key("ann", 2, &[Role::Author])
    });
    let text = serde_json::to_string(&document).unwrap();
    let seals = vec![Seal {
        key: Hex([1; 32]),
        signature: Hex([3; 64]),
    }];
    TrustView {
        sealed: Some(sealed.unwrap_or(Sealed { text, seals })),
        document: Some(document),
        wanting: vec![("pid@1.0.0".to_owned(), Digest::of(b"w"), "it lacks one".to_owned())],
    }
}

fn signatures(digest: &Digest) -> SignaturesView {
    let claim = Claim {
        digest: *digest,
        name: "pid".to_owned(),
        version: "1.0.0".to_owned(),
        role: Role::Author,
        key: Hex([2; 32]),
        signed_at_unix_ms: 1_500,
        expires_at_unix_ms: None,
    };
    SignaturesView {
        digest: *digest,
        signatures: vec![Signature {
            claim,
            signature: Hex([4; 64]),
        }],
        judgement: Judgement {
            by: vec![(Role::Author, "ann".to_owned())],
            wanting: vec![Role::Approver],
            reasons: vec![],
        },
    }
}

impl Signing for Fake {
    fn trust(&self) -> TrustView {
        view(None)
    }

    fn put_trust(&self, sealed: Sealed) -> Answer<TrustView> {
        self.answer(view(Some(sealed)))
    }

    fn signatures(&self, digest: &Digest) -> SignaturesView {
        signatures(digest)
    }

    fn sign(&self, digest: Digest, new: Vec<Signature>) -> Answer<SignaturesView> {
        let mut view = signatures(&digest);
        view.signatures.extend(new);
        self.answer(view)
    }
}

#[tokio::test]
async fn what_is_trusted_is_shown_and_put() {
    let bench = Bench::new();
    let (status, trust) = bench.json(get("/v1/trust")).await;
    assert_eq!(
        (status, &trust["policy"], &trust["number"], &trust["needs"]),
        (StatusCode::OK, &json!("required"), &json!(1), &json!(["author"]))
    );
    assert_eq!(trust["keys"][1]["revoked_because"], "it was lost");
    assert_eq!(trust["unsigned"][0]["component"], "pid@1.0.0");
    let document = trust["document"].clone();
    let (status, put) = bench.json(send("PUT", "/v1/trust", &document)).await;
    assert_eq!((status, &put["document"]), (StatusCode::OK, &document));
    for (what, body, part) in [
        ("no text", json!({ "seals": [] }), "text"),
        (
            "no document",
            json!({ "text": "{}", "seals": [] }),
            "no document of trust",
        ),
        (
            "no key",
            json!({ "text": "{}", "seals": [{ "key": "12", "signature": "34" }] }),
            "64 hexadecimal digits",
        ),
    ] {
        let (status, problem) = bench.json(send("PUT", "/v1/trust", &body)).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{what}: {problem}");
        assert!(problem.to_string().contains(part), "{what}: {problem}");
    }
}

#[tokio::test]
async fn signatures_are_shown_and_taken() {
    let bench = Bench::new();
    let path = format!("/v1/signatures/{}", Digest::of(b"w"));
    let (status, shown) = bench.json(get(&path)).await;
    assert_eq!(
        (status, &shown["good"], &shown["by"]),
        (StatusCode::OK, &json!(false), &json!(["author ann"]))
    );
    assert!(shown["reason"].to_string().contains("approver"), "{shown}");
    let request = json!({ "signatures": [shown["signatures"][0]] });
    let (status, taken) = bench.json(send("POST", &path, &request)).await;
    assert_eq!(
        (status, taken["signatures"].as_array().map(Vec::len)),
        (StatusCode::OK, Some(2))
    );
    let mut bad = request.clone();
    bad["signatures"][0]["signature"] = json!("00");
    for (path, body, part) in [
        ("/v1/signatures/pid", &request, "is no digest"),
        (path.as_str(), &bad, "128 hexadecimal digits"),
    ] {
        let (status, problem) = bench.json(send("POST", path, body)).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{problem}");
        assert!(problem.to_string().contains(part), "{problem}");
    }
}
