//! `/v1/trust` and `/v1/signatures`: what the cell trusts, and who signed what.
//!
//! Never: judges; the cell does.

use axum::{Json as JsonAnswer, extract::State};
use bumpless_core::Digest;

use crate::{
    error::{Kind, Problem},
    extract::{InPath, Json},
    server::{App, finish},
    types::{SignRequest, Signatures, Trust, TrustDocument},
};

fn invalid(reason: String) -> Problem {
    Problem::new(Kind::Invalid, reason, "")
}

/// What the cell trusts: the document in force, its keys, and components that run without a signature that it asks for.
#[utoipa::path(get, operation_id = "show_trust", path = "/v1/trust", tag = "components",
    responses(
        (status = 200, description = "What is trusted", body = Trust),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn show(State(app): State<App>) -> JsonAnswer<Trust> {
    JsonAnswer(app.cell.trust().into())
}

/// Puts a document of trust into force on every host. It must have a higher number than the one in force, and a root key of that
/// one must have signed it; the first may be signed by any root key of its own.
#[utoipa::path(put, operation_id = "put_trust", path = "/v1/trust", tag = "components",
    request_body = TrustDocument,
    responses(
        (status = 200, description = "What is trusted now", body = Trust),
        (status = 409, description = "It may not replace the one in force; says why", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "No document; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn put(
    State(app): State<App>,
    Json(document): Json<TrustDocument>,
) -> Result<JsonAnswer<Trust>, Problem> {
    let sealed = bumpless_trust::Sealed::try_from(document).map_err(invalid)?;
    sealed.document().map_err(|error| invalid(error.to_string()))?;
    Ok(JsonAnswer(finish(app.cell.put_trust(sealed)).await?.into()))
}

fn digest(text: &str) -> Result<Digest, Problem> {
    text.parse()
        .map_err(|error: bumpless_core::digest::DigestError| invalid(error.to_string()))
}

/// Who signed a component, and what that is worth now. The component need not be in the library.
#[utoipa::path(get, operation_id = "show_signatures", path = "/v1/signatures/{digest}", tag = "components", params(("digest" = String, Path)),
    responses(
        (status = 200, description = "The signatures", body = Signatures),
        (status = "default", description = "What went wrong", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn of_component(
    State(app): State<App>,
    InPath(text): InPath<String>,
) -> Result<JsonAnswer<Signatures>, Problem> {
    Ok(JsonAnswer(app.cell.signatures(&digest(&text)?).into()))
}

/// Takes signatures of a component, beside those that there are. They may come before the component does.
#[utoipa::path(post, operation_id = "sign_component", path = "/v1/signatures/{digest}", tag = "components", params(("digest" = String, Path)),
    request_body = SignRequest,
    responses(
        (status = 200, description = "The signatures now", body = Signatures),
        (status = 422, description = "Not made by the key that it names over this component; says why", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Anything else", body = Problem, content_type = "application/problem+json")))]
pub(crate) async fn sign(
    State(app): State<App>,
    InPath(text): InPath<String>,
    Json(request): Json<SignRequest>,
) -> Result<JsonAnswer<Signatures>, Problem> {
    let digest = digest(&text)?;
    let signatures = request
        .signatures
        .into_iter()
        .map(bumpless_trust::Signature::try_from)
        .collect::<Result<Vec<_>, _>>()
        .map_err(invalid)?;
    Ok(JsonAnswer(finish(app.cell.sign(digest, signatures)).await?.into()))
}
