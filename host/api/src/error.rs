//! The one place where an error becomes an HTTP answer: problem+json (RFC 9457) with the cure beside the cause.
//!
//! | kind | status | who can help |
//! |---|---|---|
//! | bad request, wrong content type, too large, invalid | 400, 415, 413, 422 | the asker, by asking otherwise |
//! | no such route, not found, method | 404, 404, 405 | the asker, by asking elsewhere |
//! | refused, in progress | 409 | the asker, once the cell has or does something else |
//! | precondition | 412 | the asker, who counts on what has changed |
//! | key reused | 422 | the asker, with a new key |
//! | sign in, forbidden | 401, 403 | the asker, with a credential; an administrator |
//! | too often | 429 | time |
//! | busy, unreachable | 503 | time |
//! | timeout | 504 | time; what was asked may still happen |
//! | store, internal | 500 | the operator |
//!
//! Never: an error without a body, or a status that is chosen elsewhere.

use axum::{
    http::{HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use bumpless_deploy::Error as DeployError;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Why the API could not be served.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The listener failed for good.
    #[error("the API's listener failed; is its address still this machine's?")]
    Listener(#[source] std::io::Error),
    /// Certificate or key cannot be used.
    #[error("{}: {reason}; give PEM files that belong together under [api.tls], `bumpless ca issue` makes some", path.display())]
    Tls {
        /// The file.
        path: std::path::PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// The content type of a problem.
pub(crate) const PROBLEM_JSON: HeaderValue = HeaderValue::from_static("application/problem+json");

/// What kind of problem it is: decides type, title and status.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    BadRequest,
    NoSuchRoute,
    NotFound,
    Method,
    Refused,
    InProgress,
    Precondition,
    KeyReused,
    TooLarge,
    ContentType,
    Invalid,
    SignIn,
    Forbidden,
    TooOften,
    Internal,
    Store,
    Busy,
    Unreachable,
    Timeout,
}

impl Kind {
    /// Last part of the type, title, status.
    const fn row(self) -> (&'static str, &'static str, StatusCode) {
        match self {
            Self::BadRequest => ("bad-request", "The request cannot be read", StatusCode::BAD_REQUEST),
            Self::NoSuchRoute => (
                "no-such-route",
                "There is nothing at this address",
                StatusCode::NOT_FOUND,
            ),
            Self::NotFound => ("not-found", "The cell has nothing of that name", StatusCode::NOT_FOUND),
            Self::Method => (
                "method",
                "This address does not know that method",
                StatusCode::METHOD_NOT_ALLOWED,
            ),
            Self::Refused => ("refused", "The cell refuses this now", StatusCode::CONFLICT),
            Self::InProgress => ("in-progress", "This is being worked on already", StatusCode::CONFLICT),
            Self::Precondition => (
                "precondition",
                "It is not what the request counts on",
                StatusCode::PRECONDITION_FAILED,
            ),
            Self::KeyReused => (
                "key-reused",
                "The key belongs to another request",
                StatusCode::UNPROCESSABLE_ENTITY,
            ),
            Self::TooLarge => ("too-large", "The body is too large", StatusCode::PAYLOAD_TOO_LARGE),
            Self::ContentType => (
                "content-type",
                "The body has the wrong type",
                StatusCode::UNSUPPORTED_MEDIA_TYPE,
            ),
            Self::Invalid => (
                "invalid",
                "What was given cannot be right",
                StatusCode::UNPROCESSABLE_ENTITY,
            ),
            Self::SignIn => ("sign-in", "Nobody is known by this", StatusCode::UNAUTHORIZED),
            Self::Forbidden => ("forbidden", "This may not be done", StatusCode::FORBIDDEN),
            Self::TooOften => ("too-often", "Too many in a short time", StatusCode::TOO_MANY_REQUESTS),
            Self::Internal => ("internal", "The host failed", StatusCode::INTERNAL_SERVER_ERROR),
            Self::Store => ("store", "The host's disk failed", StatusCode::INTERNAL_SERVER_ERROR),
            Self::Busy => (
                "busy",
                "A limit is reached, try again later",
                StatusCode::SERVICE_UNAVAILABLE,
            ),
            Self::Unreachable => (
                "unreachable",
                "A host that must answer is not there",
                StatusCode::SERVICE_UNAVAILABLE,
            ),
            Self::Timeout => ("timeout", "No answer in time", StatusCode::GATEWAY_TIMEOUT),
        }
    }
}

/// Why a request failed (RFC 9457).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Problem {
    /// The kind of problem, a URN: `urn:bumpless:problem:refused` and so on. To branch on.
    #[serde(rename = "type")]
    pub kind: String,
    /// The kind in words.
    pub title: String,
    /// The HTTP status again.
    pub status: u16,
    /// What happened this time, naming the place.
    pub detail: String,
    /// What helps, where it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cure: Option<String>,
    /// Seconds to wait, for the header.
    #[serde(skip)]
    retry_after_s: Option<u64>,
}

impl Problem {
    /// A problem of a kind. An empty cure is none.
    pub(crate) fn new(kind: Kind, detail: impl Into<String>, cure: impl Into<String>) -> Self {
        let (name, title, status) = kind.row();
        Self {
            kind: format!("urn:bumpless:problem:{name}"),
            title: title.to_owned(),
            status: status.as_u16(),
            detail: detail.into(),
            cure: Some(cure.into()).filter(|cure| !cure.is_empty()),
            retry_after_s: None,
        }
    }

    /// To be tried again after so many seconds.
    pub(crate) const fn after_s(mut self, seconds: u64) -> Self {
        self.retry_after_s = Some(seconds);
        self
    }

    /// A body beyond the limit of its address, in bytes.
    pub(crate) fn too_large(bytes_max: usize) -> Self {
        Self::new(
            Kind::TooLarge,
            format!("the body is longer than {bytes_max} bytes"),
            "send less: this is the limit of this address",
        )
    }
}

impl From<DeployError> for Problem {
    fn from(error: DeployError) -> Self {
        let kind = match &error {
            DeployError::NotFound(_) => Kind::NotFound,
            DeployError::Invalid(_) => Kind::Invalid,
            DeployError::Refused(_) => Kind::Refused,
            DeployError::Stale(_) => Kind::Precondition,
            DeployError::Busy(_) => Kind::Busy,
            DeployError::Unreachable(_) => Kind::Unreachable,
            DeployError::Timeout(_) => Kind::Timeout,
            DeployError::Store(_) => Kind::Store,
            DeployError::Internal(_) => Kind::Internal,
        };
        let words = error.words();
        Self::new(kind, words.reason.clone(), words.cure.clone())
    }
}

impl From<bumpless_core::NameError> for Problem {
    fn from(error: bumpless_core::NameError) -> Self {
        Self::new(Kind::Invalid, error.to_string(), "")
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        // Five strings and a number always serialise; an empty body is still an honest status.
        let body = serde_json::to_vec(&self).unwrap_or_default();
        let mut response = (status, [(header::CONTENT_TYPE, PROBLEM_JSON)], body).into_response();
        if let Some(seconds) = self.retry_after_s {
            response
                .headers_mut()
                .insert(header::RETRY_AFTER, HeaderValue::from(seconds));
        } else if status == StatusCode::SERVICE_UNAVAILABLE || self.kind.ends_with(":in-progress") {
            response
                .headers_mut()
                .insert(header::RETRY_AFTER, HeaderValue::from_static("1"));
        }
        response
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

    use super::*;

    #[test]
    fn every_error_of_the_cell_has_its_status() {
        let words = |reason: &str, cure: &str| bumpless_deploy::Words::new(reason, cure);
        let table: [(DeployError, u16, &str); 9] = [
            (DeployError::NotFound(words("a", "b")), 404, "not-found"),
            (DeployError::Invalid(words("a", "b")), 422, "invalid"),
            (DeployError::Refused(words("a", "b")), 409, "refused"),
            (DeployError::Stale(words("a", "b")), 412, "precondition"),
            (DeployError::Busy(words("a", "b")), 503, "busy"),
            (DeployError::Unreachable(words("a", "b")), 503, "unreachable"),
            (DeployError::Timeout(words("a", "b")), 504, "timeout"),
            (DeployError::Store(words("a", "b")), 500, "store"),
            (DeployError::Internal(words("a", "b")), 500, "internal"),
        ];
        for (error, status, name) in table {
            let problem = Problem::from(error);
            assert_eq!(problem.status, status, "{name}");
            assert_eq!(problem.kind, format!("urn:bumpless:problem:{name}"));
            assert_eq!((problem.detail.as_str(), problem.cure.as_deref()), ("a", Some("b")));
        }
    }

    #[test]
    fn an_empty_cure_is_left_out() {
        let text = serde_json::to_string(&Problem::new(Kind::Refused, "no", "")).expect("plain strings");
        assert!(!text.contains("cure"), "{text}");
        assert!(text.contains(r#""type":"urn:bumpless:problem:refused""#), "{text}");
    }

    #[test]
    fn what_passes_with_time_says_when_to_ask_again() {
        let response = Problem::new(Kind::Busy, "full", "").into_response();
        assert_eq!(
            response.headers().get(header::RETRY_AFTER).map(HeaderValue::as_bytes),
            Some(&b"1"[..])
        );
        assert_eq!(response.headers().get(header::CONTENT_TYPE), Some(&PROBLEM_JSON));
    }
}
