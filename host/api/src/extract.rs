//! What comes in with a request, read with limits, each failure a problem in words.
//!
//! A JSON body must say `application/json` and an upload its own type: a web page of another origin cannot send either
//! without asking first (CORS), and this API never answers that question. Never: a body without a limit.

use axum::{
    body::Body,
    extract::{FromRequest, FromRequestParts, Path, Query, Request, rejection::JsonRejection},
    http::{HeaderMap, header, request::Parts},
};
use bumpless_core::CommandId;
use futures_util::StreamExt as _;
use serde::de::DeserializeOwned;

use crate::{
    error::{Kind, Problem},
    limits::{DISCARD_TIME_MAX, JSON_BYTES_MAX, NOTE_CHARS_MAX},
};

/// A JSON body of at most [`JSON_BYTES_MAX`].
pub(crate) struct Json<T>(pub(crate) T);

impl<S: Sync, T: DeserializeOwned> FromRequest<S> for Json<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, _: &S) -> Result<Self, Problem> {
        content_type(request.headers(), &["application/json"])?;
        let bytes = body_bytes(request.into_body(), JSON_BYTES_MAX).await?;
        let body = axum::Json::<T>::from_bytes(&bytes);
        body.map(|axum::Json(value)| Self(value)).map_err(|error| {
            // Wrong text is the asker's syntax; right text with wrong keys is his meaning.
            let kind = match error {
                JsonRejection::JsonDataError(_) => Kind::Invalid,
                _ => Kind::BadRequest,
            };
            Problem::new(kind, error.body_text(), "GET /openapi.json describes the body")
        })
    }
}

/// Parts of the path, by position.
pub(crate) struct InPath<T>(pub(crate) T);

impl<S: Send + Sync, T: DeserializeOwned + Send> FromRequestParts<S> for InPath<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let path = Path::<T>::from_request_parts(parts, state).await;
        path.map(|Path(value)| Self(value))
            .map_err(|error| Problem::new(Kind::BadRequest, format!("the address: {error}"), ""))
    }
}

/// The query, by keys.
pub(crate) struct InQuery<T>(pub(crate) T);

impl<S: Send + Sync, T: DeserializeOwned> FromRequestParts<S> for InQuery<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let query = Query::<T>::from_request_parts(parts, state).await;
        query
            .map(|Query(value)| Self(value))
            .map_err(|error| Problem::new(Kind::BadRequest, format!("the query: {error}"), ""))
    }
}

/// The command's name, from `Idempotency-Key`: a UUID or 1 to 32 hexadecimal digits.
pub(crate) struct IdempotencyKey(pub(crate) Option<CommandId>);

impl<S: Sync> FromRequestParts<S> for IdempotencyKey {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        idempotency_key(&parts.headers).map(Self)
    }
}

/// The key of a change, where it has one.
pub(crate) fn idempotency_key(headers: &HeaderMap) -> Result<Option<CommandId>, Problem> {
    let Some(value) = headers.get("idempotency-key") else {
        return Ok(None);
    };
    let id = value.to_str().ok().and_then(command_id);
    id.map(Some).ok_or_else(|| {
        Problem::new(
            Kind::BadRequest,
            "the header Idempotency-Key is no key",
            "use a UUID, or 1 to 32 hexadecimal digits, new for each change",
        )
    })
}

/// 1 to 32 hexadecimal digits, with or without the quotes and dashes of a UUID.
fn command_id(text: &str) -> Option<CommandId> {
    let digits: String = text.trim_matches('"').chars().filter(|&c| c != '-').collect();
    let good = (1..=32).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_hexdigit());
    good.then(|| u128::from_str_radix(&digits, 16).ok().map(CommandId))
        .flatten()
}

/// Is the body of one of these types?
pub(crate) fn content_type(headers: &HeaderMap, wanted: &[&str]) -> Result<(), Problem> {
    let given = headers
        .get(header::CONTENT_TYPE)
        .and_then(|value| value.to_str().ok())
        .unwrap_or("none");
    let plain = given.split(';').next().unwrap_or_default().trim();
    if wanted.iter().any(|w| plain.eq_ignore_ascii_case(w)) {
        return Ok(());
    }
    let given: String = given.chars().take(80).collect();
    Err(Problem::new(
        Kind::ContentType,
        format!("the content type is {given}"),
        format!("send the header Content-Type: {}", wanted.join(" or ")),
    ))
}

/// The whole body, read piece by piece, given up as soon as it passes the limit.
pub(crate) async fn body_bytes(body: Body, bytes_max: usize) -> Result<Vec<u8>, Problem> {
    let mut bytes = Vec::new();
    let mut pieces = body.into_data_stream();
    while let Some(piece) = pieces.next().await {
        let piece = piece.map_err(|error| {
            Problem::new(
                Kind::BadRequest,
                format!("the body broke off: {error}"),
                "send it again",
            )
        })?;
        if bytes.len() + piece.len() > bytes_max {
            return Err(Problem::too_large(bytes_max));
        }
        bytes.extend_from_slice(&piece);
    }
    Ok(bytes)
}

/// Reads a body to its end and keeps nothing, within bounds: whoever still sends when the connection is closed never sees the
/// answer.
pub(crate) async fn discard(body: Body, bytes_max: usize) {
    let mut pieces = body.into_data_stream();
    let all = async {
        let mut bytes = 0;
        while let Some(Ok(piece)) = pieces.next().await {
            bytes += piece.len();
            if bytes > bytes_max {
                return;
            }
        }
    };
    // One that dawdles gets the answer as it is.
    let _ = tokio::time::timeout(DISCARD_TIME_MAX, all).await;
}

/// A text for people from the query, else from a header; empty where there is neither.
pub(crate) fn words(query: Option<String>, headers: &HeaderMap, name: &'static str) -> Result<String, Problem> {
    let text = match (query, headers.get(name)) {
        (Some(text), _) => text,
        (None, None) => String::new(),
        (None, Some(value)) => String::from_utf8(value.as_bytes().to_vec())
            .map_err(|_| Problem::new(Kind::BadRequest, format!("the header {name} is not UTF-8"), ""))?,
    };
    if text.chars().count() > NOTE_CHARS_MAX || text.chars().any(char::is_control) {
        let detail = format!("{name} is longer than {NOTE_CHARS_MAX} characters, or has control characters");
        return Err(Problem::new(Kind::Invalid, detail, "use one short line"));
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    #[test]
    fn keys_are_uuids_or_digits() {
        let id = CommandId(0x0123_4567_89ab_cdef_0123_4567_89ab_cdef);
        for good in [
            "01234567-89ab-cdef-0123-456789abcdef",
            "\"01234567-89AB-CDEF-0123-456789ABCDEF\"",
            "0123456789abcdef0123456789abcdef",
        ] {
            assert_eq!(command_id(good), Some(id), "{good}");
        }
        assert_eq!(command_id("7"), Some(CommandId(7)));
        for bad in ["", "-", "g", "+7", "0123456789abcdef0123456789abcdef0", "ab cd"] {
            assert_eq!(command_id(bad), None, "{bad}");
        }
    }
}
